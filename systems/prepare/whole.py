"""Molecules that their periodic cell cuts, made whole by cell vectors."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.cell_images import bonded_images, images_of_whole
from systems.errors import listed
from systems.prepare.bonding import links_residues
from systems.prepare.read.records import StructureFile

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


def made_whole(found: StructureFile) -> StructureFile:
    """Return the structure with every molecule that its cell cuts in one piece, and a note of it; else as it is.

    Atoms of one residue are bonded where an image of one is within a bond's length of the other; those of two residues
    where a record says so, or where it is one of the bonds that link polymers. What stands beside a molecule that was
    cut is moved to the image nearest to the largest one. Only whole cell vectors are added.
    """
    if found.cell_nm is None or len(found.atoms) < 2:
        return found
    x = np.array([a.position_angstrom for a in found.atoms]) / 10.0
    pairs = _bonds_in_cell(found, x)
    images = images_of_whole(x, found.cell_nm, pairs)
    if not images.any():
        return found
    cut = sorted(np.flatnonzero(images.any(axis=1)).tolist())
    names = dict.fromkeys(f"{a.residue_name} {a.chain}{a.residue_id}" for a in (found.atoms[i] for i in cut))
    note = f"made whole by the periodic cell: moved by cell vectors, {len(cut)} of the atoms of {listed(list(names))}"
    x = x + images @ found.cell_nm
    beside = _beside_the_largest(x, found.cell_nm, pairs)
    if beside.any():
        note += f", and other molecules to the nearest image ({int(beside.any(axis=1).sum())} atoms)"
    moved = np.round(10.0 * (x + beside @ found.cell_nm), 6).tolist()
    changed: list[bool] = np.any(images + beside, axis=1).tolist()
    atoms = [
        replace(atom, position_angstrom=(px, py, pz)) if change else atom
        for atom, (px, py, pz), change in zip(found.atoms, moved, changed, strict=True)
    ]
    return replace(found, atoms=atoms, notes=[*found.notes, note])


def _bonds_in_cell(found: StructureFile, x: FloatArray) -> IntArray:
    """What is bonded, `(n, 2)`, images being alike."""
    assert found.cell_nm is not None
    atoms = found.atoms
    stated = set(found.conect)
    pairs, length = bonded_images([a.element for a in atoms], x, found.cell_nm)
    rows = [
        (i, j)
        for (i, j), d in zip(pairs.tolist(), length.tolist(), strict=True)
        if atoms[i].residue_key == atoms[j].residue_key or (i, j) in stated or links_residues(atoms[i], atoms[j], d)
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


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
