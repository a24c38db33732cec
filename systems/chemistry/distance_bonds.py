"""Bonds by distance, where neither the file nor a residue template says what is bonded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.geometry import near_pairs
from systems.scene import Scene

_TOLERANCE_NM = 0.04
# A bond longer than so many sums of covalent radii is none.
_BOND_STRETCH = 1.3


def with_bonds_by_distance(scene: Scene) -> Scene:
    """Return the scene with bonds, by covalent radii, for residues that hold an atom without any; else as it is.

    Two atoms are bonded when they are nearer than the sum of their radii and 0.04 nm. Ions and rare gases stay alone.
    """
    bonded = np.zeros(scene.n_atoms, dtype=bool)
    bonded[scene.bonds.ravel()] = True
    residue = scene.residue_of_atom
    size = np.bincount(residue, minlength=len(scene.residue_names))
    open_residues = np.unique(residue[~bonded & (size[residue] > 1)])
    if not len(open_residues) or not scene.positions_nm.any():
        return scene
    atoms = np.flatnonzero(np.isin(residue, open_residues))
    found = bonds_by_distance([scene.elements[i] for i in atoms], scene.positions_nm[atoms])
    known = {tuple(b) for b in scene.bonds.tolist()}
    orders = dict(zip(map(tuple, scene.bonds.tolist()), scene.bond_orders.tolist(), strict=True))
    rows = sorted(known | {(int(atoms[i]), int(atoms[j])) for i, j in found.tolist()})
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
