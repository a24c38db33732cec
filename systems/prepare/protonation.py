"""Protonation: the hydrogens OpenMM's Modeller is asked to add to each residue, and what the pH decided."""

from __future__ import annotations

from collections.abc import Sequence

from systems.chemistry.components import component, hydrogens_of
from systems.chemistry.residues import template_for
from systems.errors import PreparationError, listed
from systems.prepare.bonded_residues import Residue
from systems.prepare.missing_atoms import links_of
from systems.prepare.read.records import AtomRecord

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


def protonation_account(
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
