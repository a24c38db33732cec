"""What a structure file is held to: chain breaks, handedness, molecules that their cell cuts, atoms too close."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product

import networkx as nx
import numpy as np

from systems.chemistry.distance_bonds import bonded_images, images_of_whole
from systems.chemistry.geometry import extend, near_pairs, signed_volumes
from systems.errors import PreparationError, counted, listed
from systems.prepare.bonding import links_residues
from systems.prepare.records import AtomRecord, Bonding, Residue, StructureFile, distance_angstrom
from systems.scene import FloatArray, IntArray, neighbours_of

# Lengths in Å and angles in degrees of Engh and Huber, Acta Cryst. A47, 392 (1991).
_C_N, _C_O, _C_CH3, _N_CH3 = 1.335, 1.231, 1.52, 1.45
_C_N_CA, _CH3_C_N, _O_C_N = 121.7, 116.2, 123.0
_NH_ANGSTROM = 1.3
_PHI = (-65.0, -85.0, -110.0, -135.0, -160.0, 180.0, 60.0, 90.0, 120.0, 150.0)


def close_gaps(structure: StructureFile, bonding: Bonding, *, cap_breaks: bool, notes: list[str]) -> list[AtomRecord]:
    """Return the heavy atoms of an NME before and an ACE after each break of a chain, trans, clear of the other atoms.

    A chain breaks where no bond joins C and N of neighbours in it, neither an end by its atoms, a cap or TER.
    Raises PreparationError where a chain breaks and `cap_breaks` is not asked for, or where an end has not the atoms
    that a cap is built from.
    """
    atoms = structure.atoms
    bonded = {i for pair in bonding.peptide_bonds for i in pair}
    gaps = []
    for before, residue in pairwise(bonding.residues):
        ends = {before.heavy.get("C", -1), residue.heavy.get("N", -1)}
        if ends & {-1, *bonded} or before.key[0] != residue.key[0]:
            continue
        names = [r.template.name for r in (before, residue) if r.template is not None]
        is_end = "OXT" in before.heavy or structure.chain_ends & set(before.atoms)
        if len(names) == 2 and names[0] not in ("NME", "NH2") and names[1] != "ACE" and not is_end:
            gaps.append((before, residue))
    caps: list[AtomRecord] = []
    for before, residue in gaps:
        if not cap_breaks:
            gap = np.linalg.norm(_at(atoms, before, "C") - _at(atoms, residue, "N"))
            more = f", and in {counted(len(gaps) - 1, 'more place')}" if len(gaps) > 1 else ""
            raise PreparationError(
                f"the chain breaks between {before.label} and {residue.label} (C and N are {gap:.1f} Å apart){more}; "
                "fill the gap, add `cap_breaks=True` to close both ends with caps, or end the chain there with a TER "
                "record."
            )
        if not {"CA", "C", "O"} <= set(before.heavy) or not {"N", "CA", "C"} <= set(residue.heavy):
            raise PreparationError(
                f"{before.label} or {residue.label} lacks backbone atoms, which a cap is built from."
            )
        ca, c, o = (_at(atoms, before, a) for a in ("CA", "C", "O"))
        n = c + _C_N * _between(c, ca, o)
        caps += _records("NME", _beside(before, 1), {"N": n, "C": extend(ca, c, n, _N_CH3, _C_N_CA, 180.0)})
        n = _at(atoms, residue, "N")
        others = np.array([a.position_angstrom for a in (*atoms, *caps) if a.element != "H"])
        others = others[np.linalg.norm(others - n, axis=1) > 2.0]  # CA and what else is bonded to the nitrogen
        acetyls = _acetyls(atoms, residue)
        clear = [np.linalg.norm(others - np.array(list(each.values()))[:, None], axis=2).min() for each in acetyls]
        caps += _records("ACE", _beside(residue, -1), acetyls[int(np.argmax(clear))])
    if gaps:
        notes.append(f"caps added where the chain breaks: {listed([f'{a.label} | {b.label}' for a, b in gaps])}")
    return caps


def _acetyls(atoms: Sequence[AtomRecord], residue: Residue) -> list[dict[str, FloatArray]]:
    """Possible ACE before a residue: the one that its nitrogen's other atoms leave, else one for each φ."""
    n, ca, c = (_at(atoms, residue, a) for a in ("N", "CA", "C"))
    nitrogen = atoms[residue.heavy["N"]]
    third = [
        atoms[i]
        for i in residue.atoms
        if atoms[i].element == "H" and distance_angstrom(atoms[i], nitrogen) < _NH_ANGSTROM
    ]
    if "CD" in residue.heavy and residue.template is not None and residue.template.name == "PRO":
        third = [atoms[residue.heavy["CD"]]]
    if len(third) == 1:
        carbons = [n + _C_N * _between(n, ca, np.array(third[0].position_angstrom))]
    else:
        carbons = [extend(c, ca, n, _C_N, _C_N_CA, phi) for phi in _PHI]
    return [
        {
            "C": carbon,
            "O": extend(ca, n, carbon, _C_O, _O_C_N, 0.0),
            "CH3": extend(ca, n, carbon, _C_CH3, _CH3_C_N, 180.0),
        }
        for carbon in carbons
    ]


def _records(name: str, place: tuple[str, str], positions: dict[str, FloatArray]) -> list[AtomRecord]:
    return [AtomRecord(atom, atom[0], name, *place, tuple(at.tolist())) for atom, at in positions.items()]


def _beside(residue: Residue, step: int) -> tuple[str, str]:
    """Chain and number of the residue before or after."""
    chain, number, _ = residue.key
    digits = re.match(r"-?\d+", number)
    return chain, str(int(digits[0]) + step) if digits else number


def _at(atoms: Sequence[AtomRecord], residue: Residue, name: str) -> FloatArray:
    return np.array(atoms[residue.heavy[name]].position_angstrom)


def _between(centre: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """The third direction of a planar centre with two neighbours, a unit vector."""
    a, b = centre - first, centre - second
    away: FloatArray = a / np.linalg.norm(a) + b / np.linalg.norm(b)
    return away / np.linalg.norm(away)


# ---- handedness of amino acids: L or D, and whether preparation left it as it was -----------------------------------


# (centre, a, b, c): positive signed volume is the natural form (L; 2S,3R threonine; 2S,3S isoleucine).
_ALPHA = ("CA", "N", "C", "CB")
_BETA = {"THR": ("CB", "CA", "OG1", "CG2"), "ILE": ("CB", "CA", "CG1", "CG2")}
_FLAT_NM3 = 2e-4

# Of a residue by its label, and the centre.
Handedness = dict[tuple[str, str], int]


def handedness(residues: Iterable[tuple[str, str, Mapping[str, AtomRecord]]]) -> Handedness:
    """Return +1 (natural), -1 (inverted) or 0 (flat) of each stereocentre whose atoms are all there. `residues`:
    (label, standard name, heavy atoms under their standard names). Centres are CA, and CB of THR and ILE."""
    found: Handedness = {}
    for label, name, heavy in residues:
        for row in (_ALPHA, _BETA[name]) if name in _BETA else (_ALPHA,):
            if set(row) <= set(heavy):
                at = np.array([heavy[a].position_angstrom for a in row]) / 10.0
                volume = float(signed_volumes(at, [[0, 1, 2, 3]])[0])
                found[label, row[0]] = 0 if abs(volume) < _FLAT_NM3 else (1 if volume > 0 else -1)
    return found


def refuse_changed(before: Handedness, after: Handedness) -> None:
    """Raise PreparationError when a stereocentre changed, or one that was built anew is not the natural form."""
    for (label, centre), sign in after.items():
        expected = before.get((label, centre), 1)
        if expected and sign != expected:
            raise PreparationError(
                f"{label}: {centre} came out {'inverted' if sign else 'flat'} when atoms were added; "
                "give the residue with all its heavy atoms."
            )


def say_inverted(found: Handedness, notes: list[str]) -> None:
    """Note the residues that are not L, flat, or the other diastereomer at CB, as the file has them."""
    for centre, words in (("CA", "D-residues, as the file has them"), ("CB", "the other diastereomer at CB")):
        for sign, said in ((-1, words), (0, f"flat at {centre}, as the file has them")):
            if names := [label for (label, atom), of in found.items() if atom == centre and of == sign]:
                notes.append(f"{said}: {listed(names)}")


# ---- molecules made whole by cell vectors ---------------------------------------------------------------------------


def made_whole(found: StructureFile, notes: list[str]) -> StructureFile:
    """Return the structure with every molecule that its cell cuts in one piece, with a note; else as it is.

    Atoms of one residue are bonded where an image of one is within a bond's length of the other; those of two residues
    where a record says so, or where it is one of the bonds that link polymers. What stands beside a molecule that was
    cut is moved to the image nearest to the largest one. Only whole cell vectors are added.
    """
    if found.cell_nm is None or len(found.atoms) < 2:
        return found
    x = np.array([a.position_angstrom for a in found.atoms]) / 10.0
    atoms, stated = list(found.atoms), set(found.conect)
    near, lengths = bonded_images([a.element for a in atoms], x, found.cell_nm)
    rows = [
        (i, j)
        for (i, j), d in zip(near.tolist(), lengths.tolist(), strict=True)
        if atoms[i].residue_key == atoms[j].residue_key or (i, j) in stated or links_residues(atoms[i], atoms[j], d)
    ]
    pairs = np.array(rows, dtype=np.int64).reshape(-1, 2)
    images = images_of_whole(x, found.cell_nm, pairs)
    if not images.any():
        return found
    x = x + images @ found.cell_nm
    beside = _beside_the_largest(x, found.cell_nm, pairs)
    moved = np.round(10.0 * (x + beside @ found.cell_nm), 6)
    changed = np.flatnonzero((images + beside).any(axis=1)).tolist()
    for i in changed:
        atoms[i] = replace(atoms[i], position_angstrom=tuple(moved[i].tolist()))
    names = dict.fromkeys(f"{atoms[i].residue_name} {atoms[i].chain}{atoms[i].residue_id}" for i in changed)
    notes.append(
        f"made whole by the periodic cell: moved by cell vectors, {len(changed)} of the atoms of {listed(list(names))}"
    )
    return replace(found, atoms=atoms)


def _beside_the_largest(x: FloatArray, cell_nm: FloatArray, pairs: IntArray) -> IntArray:
    """Return how many of each cell vector bring every molecule nearest to the largest, `(n_atoms, 3)`."""
    from scipy.spatial import cKDTree

    graph = nx.Graph(pairs.tolist())
    graph.add_nodes_from(range(len(x)))
    molecules = [sorted(m) for m in nx.connected_components(graph)]
    largest = max(molecules, key=len)
    tree = cKDTree(x[largest])
    shifts = np.array(sorted(product((-1, 0, 1), repeat=3), key=lambda s: sum(map(abs, s))), dtype=np.int64)
    gaps = np.stack([tree.query(x + shift @ cell_nm)[0] for shift in shifts])
    images = np.zeros((len(x), 3), dtype=np.int64)
    for molecule in molecules:
        if molecule is not largest:
            images[molecule] = shifts[int(gaps[:, molecule].min(axis=1).round(6).argmin())]
    return images


# ---- atoms too close ------------------------------------------------------------------------------------------------


# Nearer than this two atoms have one place, and nothing says which way they part.
_COINCIDE_ANGSTROM = 0.1
# Heavy atoms, a heavy atom and a hydrogen, hydrogens: models have them before any refinement. Whether bonds and
# stereocentres survive the minimisation is seen then (`md_reference.run.engine.refuse_damaged`).
_CLOSE_ANGSTROM = (1.5, 1.1, 0.9)


def check_contacts(atoms: Sequence[AtomRecord], bonds: IntArray) -> list[str]:
    """Return a note of atoms that are close, with more than three bonds between them; none where all keep apart. Raises
    PreparationError for atoms that have the same place."""
    neighbours = neighbours_of(bonds, len(atoms))
    x = np.array([a.position_angstrom for a in atoms])
    found = []
    for i, j in near_pairs(x, max(_CLOSE_ANGSTROM), "the structure").tolist():
        gap = distance_angstrom(atoms[i], atoms[j])
        kind = sum(atoms[k].element == "H" for k in (i, j))
        if gap < _CLOSE_ANGSTROM[kind] and not _is_near(neighbours, i, j):
            found.append((gap, i, j))
    if not found:
        return []
    gap, i, j = min(found)
    more = f" ({counted(len(found) - 1, 'more close pair')})" if len(found) > 1 else ""
    what = f"{atoms[i].label} and {atoms[j].label} are {gap:.2f} Å apart and not bonded{more}"
    if gap < _COINCIDE_ANGSTROM:
        raise PreparationError(f"{what}: atoms have the same place; take one of them out, or model them again.")
    return [f"{what}; energy minimisation must separate them"]


def _is_near(neighbours: list[list[int]], i: int, j: int) -> bool:
    reached = {i}
    for _ in range(3):
        reached |= {b for a in reached for b in neighbours[a]}
    return j in reached
