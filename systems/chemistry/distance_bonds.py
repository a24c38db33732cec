"""Bonds by distance, where neither the file nor a residue template says what is bonded; bonds too long to be any."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm, is_metal
from systems.chemistry.geometry import near_pairs
from systems.errors import PreparationError
from systems.scene import PARTICLE, Scene

_TOLERANCE_NM = 0.04
# A bond longer than so many sums of covalent radii is none.
_BOND_STRETCH = 1.3
# More than any bond is longer than the sum of radii.
_SLACK_NM = 0.1


def with_bonds_by_distance(scene: Scene, cell_nm: npt.ArrayLike | None = None) -> Scene:
    """Return the scene with bonds, by covalent radii, for residues that hold an atom without any; else as it is.

    Two atoms are bonded when they, or images of theirs in the cell `(3, 3)` nm (rows a, b, c), are nearer than the sum
    of their radii and 0.04 nm. Ions, rare gases and virtual sites stay alone. Where residues stand in pieces, because a
    file's atoms are shuffled, every atom is looked at, and bonds that other programs have made of the pieces are
    dropped where they are impossibly long.
    """
    if scene.positions_nm.any() and _are_in_pieces(scene):
        return _all_by_distance(scene)
    virtual = np.array([e == PARTICLE for e in scene.elements])
    bonded = virtual.copy()
    bonded[scene.bonds.ravel()] = True
    residue = scene.residue_of_atom
    size = np.bincount(residue, minlength=len(scene.residue_names))
    open_residues = np.unique(residue[~bonded & (size[residue] > 1)])
    if not len(open_residues) or not scene.positions_nm.any():
        return scene
    atoms = np.flatnonzero(np.isin(residue, open_residues) & ~virtual)
    found = bonds_by_distance([scene.elements[i] for i in atoms], scene.positions_nm[atoms], cell_nm)
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
    radii = np.array([0.0 if e == PARTICLE else covalent_radius_nm(e) for e in scene.elements])
    good = length < radii[i] + radii[j] + _SLACK_NM
    # Orders and charges that were perceived in wrong bonds are none.
    nothing = np.zeros(int(good.sum())), np.zeros_like(scene.formal_charges)
    kept = replace(scene, bonds=scene.bonds[good], bond_orders=nothing[0], formal_charges=nothing[1])
    atoms = np.flatnonzero([not is_metal(e) and e != PARTICLE for e in scene.elements])
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


def bonds_by_distance(
    elements: Sequence[str], positions_nm: npt.ArrayLike, cell_nm: npt.ArrayLike | None = None
) -> npt.NDArray[np.int64]:
    """Return the pairs i < j nearer than the sum of their covalent radii and 0.04 nm; hydrogen bonds to its nearest.

    With a cell `(3, 3)` nm that is wide enough to tell images apart the nearest ones count.
    """
    x = np.asarray(positions_nm, dtype=np.float64)
    radii = np.array([covalent_radius_nm(e) for e in elements])
    reach = 2.0 * float(radii.max(initial=0.0)) + _TOLERANCE_NM
    atoms = np.arange(len(x))
    if cell_nm is not None and _least_width_nm(np.asarray(cell_nm, dtype=np.float64)) > 2.0 * reach:
        atoms, x = _with_images(x, np.asarray(cell_nm, dtype=np.float64), reach)
    near = near_pairs(x, reach, "the molecule")
    length = np.linalg.norm(x[near[:, 0]] - x[near[:, 1]], axis=1)
    near = np.sort(atoms[near], axis=1)
    close = (length < radii[near[:, 0]] + radii[near[:, 1]] + _TOLERANCE_NM) & (near[:, 0] < near[:, 1])
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


def refuse_long_bonds(
    elements: Sequence[str], positions_nm: npt.NDArray[np.float64], bonds: npt.ArrayLike, label: Callable[[int], str]
) -> None:
    """Raise PreparationError, which names the longest of them, where bonds `(n, 2)` are longer than any bond is:
    the sum of their covalent radii and 0.04 nm."""
    rows = np.asarray(bonds, dtype=np.int64).reshape(-1, 2)
    radii = np.array([covalent_radius_nm(e) for e in elements])
    length = np.linalg.norm(positions_nm[rows[:, 0]] - positions_nm[rows[:, 1]], axis=1)
    excess = length - radii[rows].sum(axis=1) - _TOLERANCE_NM
    wrong = int((excess > 0).sum())
    if wrong:
        k = int(excess.argmax())
        i, j = rows[k].tolist()
        more = f" ({wrong - 1} more are too long)" if wrong > 1 else ""
        raise PreparationError(
            f"the bond {label(i)} - {label(j)} is {10 * length[k]:.2f} Å long{more}: the molecule is broken; make it "
            "whole (unwrap it from its periodic cell, or write the cell into the file), or correct the coordinates."
        )


def _least_width_nm(cell: npt.NDArray[np.float64]) -> float:
    """Return the least distance between opposite faces, 0 of a cell without volume (placeholders in PDB files)."""
    if not abs(np.linalg.det(cell)) > 0.0:
        return 0.0
    return float(1.0 / np.linalg.norm(np.linalg.inv(cell), axis=0).max())


def _with_images(
    x: npt.NDArray[np.float64], cell: npt.NDArray[np.float64], reach_nm: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return which atoms, and where `(n, 3)` nm: all of them inside the cell, and their images up to `reach_nm`
    outside."""
    inverse = np.linalg.inv(cell)
    inside = (x @ inverse) % 1.0
    margin = reach_nm * np.linalg.norm(inverse, axis=0)
    shifts = np.array(list(itertools.product((0, -1, 1), repeat=3)), dtype=np.float64)
    places = (inside[None] + shifts[:, None]).reshape(-1, 3)
    kept = ((places > -margin) & (places < 1.0 + margin)).all(axis=1)
    return np.tile(np.arange(len(x)), len(shifts))[kept], places[kept] @ cell


def changed_bond(scene: Scene, positions_nm: npt.ArrayLike, *, stretch: float = _BOND_STRETCH) -> str:
    """Return what of the scene's bonds does not hold at `positions_nm` (n_atoms, 3), in words; empty where all hold.

    A bond is lost where it is longer than `stretch` sums of covalent radii; a hydrogen has moved where it is nearest,
    in units of that sum, to an atom it is not bonded to.
    """
    if not len(scene.bonds):
        return ""
    x = np.asarray(positions_nm, dtype=np.float64)
    radii = np.array([covalent_radius_nm(e) for e in scene.elements])
    length = np.linalg.norm(x[:, None] - x[None], axis=-1)
    reach = length / (radii[:, None] + radii[None])
    np.fill_diagonal(reach, np.inf)
    bonded = np.zeros_like(reach, dtype=bool)
    first, second = scene.bonds.T
    bonded[first, second] = bonded[second, first] = True
    name = scene.atom_names
    for h in (k for k, e in enumerate(scene.elements) if e == "H" and bonded[k].any()):
        nearest, parent = int(np.argmin(reach[h])), int(np.argmin(np.where(bonded[h], reach[h], np.inf)))
        if not bonded[h, nearest]:
            return f"{name[h]} moves from {name[parent]} to {name[nearest]} ({length[h, parent] * 10:.2f} Å away)"
    i, j = scene.bonds[int(np.argmax(reach[first, second]))].tolist()
    return f"{name[i]} - {name[j]} breaks ({length[i, j] * 10:.2f} Å)" if reach[i, j] > stretch else ""
