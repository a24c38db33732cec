"""Handedness of amino acids in records: L or D, and whether preparation left it as it was."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from systems.chemistry.geometry import signed_volumes
from systems.errors import PreparationError, listed
from systems.prepare.read.records import AtomRecord

# (centre, a, b, c): positive signed volume is the natural form (L; 2S,3R threonine; 2S,3S isoleucine).
_ALPHA = ("CA", "N", "C", "CB")
_BETA = {"THR": ("CB", "CA", "OG1", "CG2"), "ILE": ("CB", "CA", "CG1", "CG2")}
_FLAT_NM3 = 2e-4

ResidueKey = tuple[str, str, str]
Handedness = dict[tuple[ResidueKey, str], int]


def handedness(residues: Iterable[tuple[ResidueKey, str, Mapping[str, AtomRecord]]]) -> Handedness:
    """Return +1 (natural), -1 (inverted) or 0 (flat) of each stereocentre whose atoms are all there.

    `residues`: (key, standard name, heavy atoms under their standard names). Centres are CA, and CB of THR and ILE.
    """
    found: Handedness = {}
    for key, name, heavy in residues:
        for row in (_ALPHA, _BETA[name]) if name in _BETA else (_ALPHA,):
            if not set(row) <= set(heavy):
                continue
            at = np.array([heavy[a].position_angstrom for a in row]) / 10.0
            volume = float(signed_volumes(at, [[0, 1, 2, 3]])[0])
            found[key, row[0]] = 0 if abs(volume) < _FLAT_NM3 else (1 if volume > 0 else -1)
    return found


def refuse_changed(before: Handedness, after: Handedness) -> None:
    """Raise PreparationError when a stereocentre changed, or one that was built anew is not the natural form."""
    for (key, centre), sign in after.items():
        expected = before.get((key, centre), 1)
        if expected and sign != expected:
            raise PreparationError(
                f"{_label(key)}: {centre} came out {'inverted' if sign else 'flat'} when atoms were added; "
                "give the residue with all its heavy atoms."
            )


def say_inverted(found: Handedness, notes: list[str]) -> None:
    """Note the residues that are not L, or whose side chain is the other diastereomer, as the file has them."""
    for centre, words in (("CA", "D-residues, as the file has them"), ("CB", "the other diastereomer at CB")):
        names = [_label(key) for (key, atom), sign in found.items() if atom == centre and sign < 0]
        if names:
            notes.append(f"{words}: {listed(names)}")
    flat = [f"{_label(key)} {atom}" for (key, atom), sign in found.items() if sign == 0]
    if flat:
        notes.append(f"flat stereocentres, as the file has them: {listed(flat)}")


def heavy_of_records(records: Sequence[AtomRecord]) -> dict[ResidueKey, dict[str, AtomRecord]]:
    """Heavy atoms by residue and name, for records under standard names."""
    out: dict[ResidueKey, dict[str, AtomRecord]] = {}
    for atom in records:
        if atom.element != "H":
            out.setdefault(atom.residue_key, {})[atom.name] = atom
    return out


def _label(key: ResidueKey) -> str:
    return f"{key[2]} {key[0]}{key[1]}"
