"""Missing heavy atoms and hydrogens of residues that are known by name, and the hydrogens that OpenMM's Modeller is
asked to add to each: what the pH decided.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from systems.chemistry.residues import PH_OF_FEWEST, Component, ResidueTemplate, component, hydrogens_of, template_for
from systems.errors import PreparationError, listed
from systems.prepare.read.records import AtomRecord, Residue


def note_missing(residues: list[Residue], atoms: Sequence[AtomRecord], bonds: npt.NDArray[np.int64]) -> None:
    """Fill `missing` and `lacks_hydrogens` of the residues that are known by their names."""
    neighbours: list[list[int]] = [[] for _ in atoms]
    for i, j in bonds.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)

    skeleton = [[j for j in around if atoms[j].element != "H"] for around in neighbours]

    def hydrogens(i: int) -> int:
        return len(neighbours[i]) - len(skeleton[i])

    for residue in residues:
        template, heavy = residue.template, residue.heavy
        if template is None or not heavy:
            continue
        links = links_of(residue, skeleton)
        absent = [a for a in template.heavy if a not in heavy and a not in template.optional]
        residue.missing = [a for a in absent if not _has_left(template, a, links, absent)]
        needed = {a: max(0, n - links.get(a, 0)) for a, n in template.hydrogens.items()}
        found = component(residue.key[2]) if template_for(residue.key[2]) is None else None
        if found is not None:
            if found.kind == "nucleotide" and "P" in heavy and "P" not in links and "OP3" not in heavy:
                residue.missing.append("OP3")
            needed = _least_hydrogens(residue, found, neighbours)
        if template.is_amino_acid and {"N", "C"} <= set(heavy):
            joined_c = any(atoms[j].element == "N" and j not in residue.atoms for j in neighbours[heavy["C"]])
            joined_n = any(atoms[j].element == "C" and j not in residue.atoms for j in neighbours[heavy["N"]])
            if not joined_c and "OXT" not in heavy and not hydrogens(heavy["C"]):
                residue.missing.append("OXT")
            if found is None:
                needed["N"] = (1 if joined_n else 2) - (template.name == "PRO")
            if template.name == "CYS" and residue.key[2].upper() != "CYM":
                needed["SG"] = 0 if "SG" in links or "SG" not in heavy else 1
        residue.lacks_hydrogens = any(hydrogens(heavy[a]) < n for a, n in needed.items() if a in heavy)
        if template.name == "HIS" and {"ND1", "NE2"} <= set(heavy):
            residue.lacks_hydrogens |= not (hydrogens(heavy["ND1"]) or hydrogens(heavy["NE2"]))


def links_of(residue: Residue, neighbours: Sequence[Sequence[int]]) -> dict[str, int]:
    """Return how many bonds each heavy atom of a residue, by its name in the template, has to other residues."""
    own = set(residue.atoms)
    counts = {name: sum(j not in own for j in neighbours[i]) for name, i in residue.heavy.items()}
    return {name: n for name, n in counts.items() if n}


def _has_left(template: ResidueTemplate, name: str, links: Mapping[str, int], absent: Sequence[str]) -> bool:
    """Whether an absent atom has made place for a bond to another residue: an oxygen of an acid that is an amide."""
    around = [b if a == name else a for a, b in template.bonds if name in (a, b)]
    if len(around) != 1 or name[0] not in "NO" or around[0] in ("C", "CA"):
        return False
    rivals = [a for a in absent if (around[0], a) in template.bonds or (a, around[0]) in template.bonds]
    return len(rivals) <= links.get(around[0], 0)


def _least_hydrogens(residue: Residue, found: Component, neighbours: list[list[int]]) -> dict[str, int]:
    """Return the least number of hydrogens on each heavy atom of a component, at any pH."""
    present = {*residue.heavy, *residue.missing}
    least: dict[str, int] = {}
    for _, parent in hydrogens_of(found, present, links_of(residue, neighbours), ph=PH_OF_FEWEST):
        least[parent] = least.get(parent, 0) + 1
    return least


# ---- protonation ----------------------------------------------------------------------------------------------------


# Hydrogens (in OpenMM's names) whose presence tells the protonation state.
TITRATED = {"ASP": ("HD2",), "GLU": ("HE2",), "LYS": ("HZ1", "HZ2", "HZ3"), "HIS": ("HD1", "HE2"), "CYS": ("HG",)}
_STATES = {
    ("ASP", (False,)): "ASP charged", ("ASP", (True,)): "ASP neutral (ASH)", ("GLU", (False,)): "GLU charged",
    ("GLU", (True,)): "GLU neutral (GLH)", ("LYS", (True, True, True)): "LYS charged",
    ("LYS", (False, True, True)): "LYS neutral (LYN)", ("LYS", (True, True, False)): "LYS neutral (LYN)",
    ("HIS", (True, True)): "HIS charged (HIP)", ("HIS", (True, False)): "HIS neutral (HID)",
    ("HIS", (False, True)): "HIS neutral (HIE)", ("CYS", (True,)): "CYS neutral",
}  # fmt: skip
# A variant of Modeller's by name, the hydrogens one by one with their heavy atoms, or None: what pH decides.
Asked = str | list[tuple[str, str]] | None
# Hydrogens that Modeller's own rules count rightly: peptide bonds, and sulfurs in disulfides.
_USUAL_LINKS = {"N": 1, "C": 1, "SG": 1}


def asked_hydrogens(
    residue: Residue, atoms: Sequence[AtomRecord], neighbours: Sequence[Sequence[int]], *, ph: float, in_cycle: bool
) -> Asked:
    """Return what to ask of Modeller for a residue.

    Standard residues are left to its rules, in the protonation that the file shows. Components of the dictionary, and
    standard residues where those rules fail (an end of the chain that a bond closes, a side chain bonded to another
    residue), are asked for hydrogen by hydrogen: those of the file where it has all, else the dictionary's at this pH.
    Raises PreparationError for a residue of which nothing is known.
    """
    assert residue.template is not None
    links = links_of(residue, neighbours)
    is_standard = template_for(residue.key[2]) is not None
    if is_standard and not in_cycle and all(n <= _USUAL_LINKS.get(atom, 0) for atom, n in links.items()):
        return variant_of(residue, atoms, neighbours)
    if not residue.lacks_hydrogens:
        return [
            (atoms[h].name, name) for name, i in residue.heavy.items() for h in neighbours[i] if atoms[h].element == "H"
        ]
    found = component(residue.template.name)
    if found is None:
        raise PreparationError(f"{residue.label} lacks hydrogens, and the dictionary does not hold it; give them.")
    return hydrogens_of(found, {*residue.heavy, *residue.missing}, links, ph=ph)


def variant_of(residue: Residue, atoms: Sequence[AtomRecord], neighbours: Sequence[Sequence[int]]) -> str | None:
    """Return Modeller's name of the protonation that the residue's own hydrogens or name show, or None."""
    name = residue.key[2].upper()
    named = {"HSD": "HID", "HSE": "HIE", "HSP": "HIP", "ASPP": "ASH", "GLUP": "GLH", "LSN": "LYN"}.get(name, name)
    if named in ("CYX", "CYS2"):  # without its partner it is a cysteine like any other
        return "CYX" if "SG" in links_of(residue, neighbours) else None
    if named in ("HID", "HIE", "HIP", "ASH", "GLH", "LYN"):
        return named
    if named == "CYM":
        return "CYX"
    template = residue.template
    if template is None or template.name not in ("HIS", "ASP", "GLU", "LYS"):
        return None
    count = {a: sum(atoms[j].element == "H" for j in neighbours[i]) for a, i in residue.heavy.items()}
    if template.name == "HIS":
        return {(1, 1): "HIP", (1, 0): "HID", (0, 1): "HIE"}.get((count.get("ND1", 0), count.get("NE2", 0)))
    if template.name == "LYS":
        return {2: "LYN", 3: "LYS"}.get(count.get("NZ", 0))
    ends = sum(count.get(a, 0) for a in ("OD1", "OD2", "OE1", "OE2"))
    if ends:
        return "ASH" if template.name == "ASP" else "GLH"
    return template.name if not residue.lacks_hydrogens else None


def protonation_summary(
    labels: Sequence[str],
    keys: Sequence[tuple[str, str, str]],
    given: Sequence[Asked],
    records: Sequence[AtomRecord],
    ph: float,
) -> list[str]:
    """One line for each kind of protonation that `ph` decided, that is where `given` holds no variant."""
    hydrogens: dict[tuple[str, str, str], set[str]] = {}
    for atom in records:
        if atom.element == "H":
            hydrogens.setdefault(atom.residue_key, set()).add(atom.name)
    states: dict[str, list[str]] = {}
    for label, key, variant in zip(labels, keys, given, strict=True):
        template = template_for(key[2])
        if variant is None and template is not None and template.name in TITRATED:
            marks = tuple(h in hydrogens.get(key, set()) for h in TITRATED[template.name])
            state = _STATES.get((template.name, marks))
            if state:
                states.setdefault(state, []).append(label)
    return [f"protonation at pH {ph:g}: {state}: {listed(found)}" for state, found in sorted(states.items())]
