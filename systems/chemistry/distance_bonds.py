"""Bonds by distance, where neither the file nor a residue template says what is bonded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm, is_metal
from systems.chemistry.geometry import near_pairs
from systems.scene import Scene

_TOLERANCE_NM = 0.04
# More than any bond is longer than the sum of radii.
_SLACK_NM = 0.1


def with_bonds_by_distance(scene: Scene) -> Scene:
    """Return the scene with bonds, by covalent radii, for residues that hold an atom without any; else as it is.

    Two atoms are bonded when they are nearer than the sum of their radii and 0.04 nm. Ions and rare gases stay alone.
    Where residues stand in pieces, because a file's atoms are shuffled, every atom is looked at, and bonds that other
    programs have made of the pieces are dropped where they are impossibly long.
    """
    if scene.positions_nm.any() and _are_in_pieces(scene):
        return _all_by_distance(scene)
    bonded = np.zeros(scene.n_atoms, dtype=bool)
    bonded[scene.bonds.ravel()] = True
    residue = scene.residue_of_atom
    size = np.bincount(residue, minlength=len(scene.residue_names))
    open_residues = np.unique(residue[~bonded & (size[residue] > 1)])
    if not len(open_residues) or not scene.positions_nm.any():
        return scene
    atoms = np.flatnonzero(np.isin(residue, open_residues))
    found = bonds_by_distance([scene.elements[i] for i in atoms], scene.positions_nm[atoms])
    return _with_more(scene, atoms[found])


def _are_in_pieces(scene: Scene) -> bool:
    """Whether a residue comes back after another one with other atoms; with the same ones it is a copy."""
    names: dict[tuple[str, str, str], list[set[str]]] = {}
    pieces: list[set[str]] = [set() for _ in scene.residue_names]
    for name, r in zip(scene.atom_names, scene.residue_of_atom.tolist(), strict=True):
        pieces[r].add(name)
    for key, piece in zip(zip(scene.chain_of_residue, scene.residue_ids, scene.residue_names), pieces, strict=True):
        names.setdefault(key, []).append(piece)
    return any(len(own) > 1 and sum(map(len, own)) == len(set().union(*own)) for own in names.values())


def _all_by_distance(scene: Scene) -> Scene:
    i, j = scene.bonds.T
    length = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=1)
    radii = np.array([covalent_radius_nm(e) for e in scene.elements])
    good = length < radii[i] + radii[j] + _SLACK_NM
    # Orders and charges that were perceived in wrong bonds are none.
    nothing = np.zeros(int(good.sum())), np.zeros_like(scene.formal_charges)
    kept = replace(scene, bonds=scene.bonds[good], bond_orders=nothing[0], formal_charges=nothing[1])
    atoms = np.flatnonzero([not is_metal(e) for e in scene.elements])
    return _with_more(kept, atoms[bonds_by_distance([scene.elements[k] for k in atoms], scene.positions_nm[atoms])])


def _with_more(scene: Scene, found: npt.NDArray[np.int64]) -> Scene:
    known = {tuple(b) for b in scene.bonds.tolist()}
    orders = dict(zip(map(tuple, scene.bonds.tolist()), scene.bond_orders.tolist(), strict=True))
    rows = sorted(known | {(i, j) for i, j in found.tolist()})
    return replace(
        scene,
        bonds=np.array(rows, dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([orders.get(row, 0.0) for row in rows], dtype=np.float64),
    )


def bonds_by_distance(elements: Sequence[str], positions_nm: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return the pairs i < j nearer than the sum of their covalent radii and 0.04 nm; hydrogen bonds to its nearest."""
    x = np.asarray(positions_nm, dtype=np.float64)
    radii = np.array([covalent_radius_nm(e) for e in elements])
    near = near_pairs(x, 2.0 * float(radii.max(initial=0.0)) + _TOLERANCE_NM, "the molecule")
    length = np.linalg.norm(x[near[:, 0]] - x[near[:, 1]], axis=1)
    close = length < radii[near[:, 0]] + radii[near[:, 1]] + _TOLERANCE_NM
    best: dict[int, tuple[float, int]] = {}
    rows = []
    for (i, j), d in sorted(zip(map(tuple, near[close].tolist()), length[close].tolist(), strict=True)):
        hydrogens = [k for k in (i, j) if elements[k] == "H"]
        if not hydrogens:
            rows.append((i, j))
        for h in hydrogens:
            best[h] = min(best.get(h, (np.inf, -1)), (d, i + j - h))
    rows += [(min(h, k), max(h, k)) for h, (_, k) in best.items()]
    return np.array(sorted(set(rows)), dtype=np.int64).reshape(-1, 2)
