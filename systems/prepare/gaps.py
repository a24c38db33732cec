"""Chain breaks: neighbours of one chain that no bond joins, refused or closed with the caps NME and ACE."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from systems.errors import PreparationError, listed
from systems.prepare.bonded_residues import Bonding, Residue
from systems.prepare.read.records import AtomRecord

Vector = npt.NDArray[np.float64]
# Lengths in Å and angles in degrees of Engh and Huber, Acta Cryst. A47, 392 (1991).
_C_N, _C_O, _C_CH3, _N_CH3 = 1.335, 1.231, 1.52, 1.45
_C_N_CA, _CH3_C_N, _O_C_N = 121.7, 116.2, 123.0
_PHI = (-65.0, -85.0, -110.0, -135.0, -160.0, 180.0, 60.0, 90.0, 120.0, 150.0)


def find_gaps(bonding: Bonding, chain_ends: set[int]) -> list[tuple[Residue, Residue]]:
    """Return neighbours in one chain, neither an end by its atoms, a cap or TER, whose C and N no bond joins."""
    bonded_n = {i for pair in bonding.peptide_bonds for i in pair}
    found = []
    for before, residue in pairwise(bonding.residues):
        c, n = before.heavy.get("C", -1), residue.heavy.get("N", -1)
        if min(c, n) < 0 or {c, n} & bonded_n or before.key[0] != residue.key[0] or chain_ends & set(before.atoms):
            continue
        names = (before.template.name if before.template else "", residue.template.name if residue.template else "")
        if all(names) and names[0] not in ("NME", "NH2") and names[1] != "ACE" and "OXT" not in before.heavy:
            found.append((before, residue))
    return found


def refuse_gaps(gaps: Sequence[tuple[Residue, Residue]], atoms: Sequence[AtomRecord]) -> None:
    """Raise PreparationError where a chain breaks."""
    for before, residue in gaps:
        gap = np.linalg.norm(_at(atoms, before, "C") - _at(atoms, residue, "N"))
        more = f", and in {len(gaps) - 1} more places" if len(gaps) > 1 else ""
        raise PreparationError(
            f"the chain breaks between {before.label} and {residue.label} (C and N are {gap:.1f} Å apart){more}; fill "
            "the gap, add `cap_breaks=True` to close both ends with caps, or end the chain there with a TER record."
        )


def caps_of(gaps: Sequence[tuple[Residue, Residue]], atoms: Sequence[AtomRecord], notes: list[str]) -> list[AtomRecord]:
    """Return the heavy atoms of an NME before and an ACE after each gap, trans, clear of the other atoms.

    Raises PreparationError where an end has not the atoms that a cap is built from.
    """
    caps: list[AtomRecord] = []
    for before, residue in gaps:
        for end, needed in ((before, ("CA", "C", "O")), (residue, ("N", "CA", "C"))):
            lacking = [a for a in needed if a not in end.heavy]
            if lacking:
                raise PreparationError(f"{end.label} lacks {' '.join(lacking)}, from which its cap would be built.")
        ca, c, o = (_at(atoms, before, a) for a in ("CA", "C", "O"))
        n = c + _C_N * _between(c, ca, o)
        caps += _records("NME", _beside(before, 1), {"N": n, "C": _placed(ca, c, n, _N_CH3, _C_N_CA, 180.0)})
        others = np.array([a.position_angstrom for a in (*atoms, *caps) if a.element != "H"])
        acetyls = _acetyls(atoms, residue)
        n = _at(atoms, residue, "N")
        others = others[np.linalg.norm(others - n, axis=1) > 2.0]  # CA and what else is bonded to the nitrogen
        clear = [
            min(float(np.linalg.norm(others - place, axis=1).min(initial=np.inf)) for place in each.values())
            for each in acetyls
        ]
        caps += _records("ACE", _beside(residue, -1), acetyls[int(np.argmax(clear))])
    if gaps:
        notes.append(f"caps added where the chain breaks: {listed([f'{a.label} | {b.label}' for a, b in gaps])}")
    return caps


def _acetyls(atoms: Sequence[AtomRecord], residue: Residue) -> list[dict[str, Vector]]:
    """Possible ACE before a residue: the one that its nitrogen's other atoms leave, else one for each φ."""
    n, ca, c = (_at(atoms, residue, a) for a in ("N", "CA", "C"))
    third = [i for i in residue.atoms if atoms[i].element == "H" and np.linalg.norm(_position(atoms[i]) - n) < 1.3]
    if "CD" in residue.heavy and residue.template is not None and residue.template.name == "PRO":
        third = [residue.heavy["CD"]]
    if len(third) == 1:
        carbons = [n + _C_N * _between(n, ca, _position(atoms[third[0]]))]
    else:
        carbons = [_placed(c, ca, n, _C_N, _C_N_CA, phi) for phi in _PHI]
    return [
        {
            "C": carbon,
            "O": _placed(ca, n, carbon, _C_O, _O_C_N, 0.0),
            "CH3": _placed(ca, n, carbon, _C_CH3, _CH3_C_N, 180.0),
        }
        for carbon in carbons
    ]


def _records(name: str, place: tuple[str, str], positions: dict[str, Vector]) -> list[AtomRecord]:
    chain, number = place
    return [
        AtomRecord("", atom, "", name, chain, number, (float(x), float(y), float(z)), 1.0, atom[0], False)
        for atom, (x, y, z) in positions.items()
    ]


def _beside(residue: Residue, step: int) -> tuple[str, str]:
    """Chain and number of the residue before or after."""
    chain, number, _ = residue.key
    digits = re.match(r"-?\d+", number)
    return chain, str(int(digits[0]) + step) if digits else number


def _position(atom: AtomRecord) -> Vector:
    return np.array(atom.position_angstrom, dtype=np.float64)


def _at(atoms: Sequence[AtomRecord], residue: Residue, name: str) -> Vector:
    return _position(atoms[residue.heavy[name]])


def _between(centre: Vector, first: Vector, second: Vector) -> Vector:
    """The third direction of a planar centre with two neighbours, a unit vector."""
    a, b = centre - first, centre - second
    away: Vector = a / np.linalg.norm(a) + b / np.linalg.norm(b)
    return away / np.linalg.norm(away)


def _placed(a: Vector, b: Vector, c: Vector, length: float, angle_deg: float, torsion_deg: float) -> Vector:
    """The point at `length` from c, at an angle b-c-x and a torsion a-b-c-x (natural extension reference frame)."""
    angle, torsion = np.radians(angle_deg), np.radians(torsion_deg)
    along = (c - b) / np.linalg.norm(c - b)
    normal = np.cross(b - a, along)
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, along)
    x = np.cos(torsion) * np.sin(angle) * side + np.sin(torsion) * np.sin(angle) * normal - np.cos(angle) * along
    point: Vector = c + length * x
    return point
