"""Sugars bonded to peptides and to each other: which template of GLYCAM each is, by its name, links and handedness.

GLYCAM_06j-1 (Kirschner et al., J. Comput. Chem. 29, 622 (2008)) has a template for each sugar, anomer and set of linked
oxygens; epimers have the same bonds, so that bonds alone do not tell them apart.
"""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

from systems.chemistry.geometry import signed_volumes
from systems.scene import Scene

GLYCAM_FILE = "amber14/GLYCAM_06j-1.xml"
# Names in the Protein Data Bank: GLYCAM's letters of sugar and anomer, and the handedness of C1 to C5 (the sign of the
# volume spanned by the two ring neighbours and the hydrogen), computed by docs/studies/preparation/sugar_handedness.py.
SUGARS = {
    "NAG": ("YB", "++-+-"), "NDG": ("YA", "-+-+-"), "NGA": ("VB", "++---"), "A2G": ("VA", "-+---"),
    "MAN": ("MA", "---+-"), "BMA": ("MB", "+--+-"), "GLC": ("GA", "-+-+-"), "BGC": ("GB", "++-+-"),
    "GAL": ("LB", "++---"), "GLA": ("LA", "-+---"), "FUC": ("fA", "+-+++"), "FUL": ("fB", "--+++"),
    "XYP": ("XB", "++-+."), "XYS": ("XA", "-+-+."), "RAM": ("hA", "+++-+"),
}  # fmt: skip
CENTRES = (("C1", "C2", "O5", "H1"), ("C2", "C1", "C3", "H2"), ("C3", "C2", "C4", "H3"), ("C4", "C3", "C5", "H4"),
            ("C5", "C4", "O5", "H5"))  # fmt: skip
# Amino acids that carry sugars, under their own and under GLYCAM's names.
_ANCHORS = ("ASN", "SER", "THR", "HYP", "NLN", "OLS", "OLT", "OLP")
# Oxygens that are linked onwards, and the letter that GLYCAM has for them.
_LINKS = {
    "": "0", "2": "2", "3": "3", "4": "4", "6": "6", "23": "Z", "24": "Y", "26": "X", "34": "W", "36": "V", "46": "U",
    "234": "T", "236": "S", "246": "R", "346": "Q", "2346": "P",
}  # fmt: skip


def glycan_templates(scene: Scene) -> dict[int, str]:
    """Return GLYCAM's template of each residue that is a sugar bonded at its C1, by its number in the scene.

    Residues named as in the Protein Data Bank whose handedness is that of their name, and residues named as in GLYCAM.
    Others, a free reducing end among them, are left out.
    """
    found = {}
    members: list[list[int]] | None = None
    for r, name in enumerate(scene.residue_names):
        if name not in SUGARS and name not in _named_as_glycam(name):
            continue
        if members is None:
            members = _members(scene)
        code = name if name not in SUGARS else _code(scene, name, members[r])
        if code in glycam_names():
            found[r] = code
    return found


def covered_by_glycam(scene: Scene) -> set[int]:
    """Return the sugars that GLYCAM has, and the amino acids to which one of them is bonded at its C1."""
    sugars = set(glycan_templates(scene))
    of_atom, names = scene.residue_of_atom, scene.residue_names
    anchors = {
        int(of_atom[b])
        for i, j in scene.bonds.tolist()
        for a, b in ((i, j), (j, i))
        if int(of_atom[a]) in sugars and scene.atom_names[a] == "C1" and names[of_atom[b]] in _ANCHORS
    }
    return sugars | anchors


def _code(scene: Scene, name: str, atoms: list[int]) -> str:
    """Return GLYCAM's name of a sugar, or an empty string."""
    near = scene.neighbours()
    at = {scene.atom_names[i]: i for i in atoms}
    letters, signs = SUGARS[name]
    hydrogen = {a: next((j for j in near[at[a]] if scene.elements[j] == "H"), -1) for a in at if a[0] == "C"}
    own = set(atoms)
    for (centre, a, b, _), sign in zip(CENTRES, signs, strict=True):
        if sign == ".":
            continue
        row = [at.get(centre, -1), at.get(a, -1), at.get(b, -1), hydrogen.get(centre, -1)]
        if min(row) < 0 or (signed_volumes(scene.positions_nm, [row])[0] > 0) != (sign == "+"):
            return ""
    beyond = {a for a, i in at.items() if any(j not in own for j in near[i])}
    if "C1" not in beyond or not all(a == "C1" or re.fullmatch(r"O[2346]", a) for a in beyond):
        return ""
    links = "".join(sorted(a[1] for a in beyond if a[0] == "O"))
    return _LINKS.get(links, "?") + letters


def _members(scene: Scene) -> list[list[int]]:
    out: list[list[int]] = [[] for _ in scene.residue_names]
    for i, r in enumerate(scene.residue_of_atom.tolist()):
        out[r].append(i)
    return out


def _named_as_glycam(name: str) -> frozenset[str]:
    """Names of sugars as GLYCAM writes them: three characters, the last an anomer."""
    return glycam_names() if re.fullmatch(r"[0-9P-Z][A-Za-z][AB]", name) else frozenset()


@cache
def glycam_names() -> frozenset[str]:
    """Return the names of GLYCAM's templates."""
    from openmm import app

    text = (Path(app.__file__).parent / "data" / GLYCAM_FILE).read_text()
    return frozenset(re.findall(r'<Residue name="(\w+)"', text))
