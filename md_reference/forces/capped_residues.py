"""A residue cut out of its chain with its neighbours' ends: the molecule on which its charges are computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.element_data import atomic_weight_da
from systems.errors import PreparationError
from systems.scene import FloatArray, IntArray, Scene

_VALENCE = {"C": 4, "N": 3, "O": 2, "S": 2, "P": 5}
_HYDROGEN_NM = 0.109
# Bonds beyond the residue that are kept: N-methyl amide after it, acetyl before it.
_REACH = 2


@dataclass(frozen=True)
class CappedResidue:
    """A residue cut out of its chain. `scene`: it with its ends; `atoms (n_atoms,)`: the chain's atom of each of its
    atoms, -1 for a hydrogen that closes a cut; `n_own`: how many of them, the first, are the residue's own.
    """

    scene: Scene
    atoms: IntArray
    n_own: int


def cap(scene: Scene, residue: int) -> CappedResidue:
    """Return a residue with the atoms up to two bonds beyond it, hydrogens closing the cuts.

    Inside a chain of amides that is ACE-X-NME. Raises PreparationError when it fits no Lewis structure.
    """
    near = scene.neighbours()
    kept = [i for i in range(scene.n_atoms) if scene.residue_of_atom[i] == residue]
    n_own = len(kept)
    for _ in range(_REACH):
        kept += sorted({j for i in kept for j in near[i]} - set(kept))
    where = {i: k for k, i in enumerate(kept)}
    positions = [scene.positions_nm[i] for i in kept]
    elements = [scene.elements[i] for i in kept]
    bonds = [(where[i], where[j]) for i, j in scene.bonds.tolist() if i in where and j in where]
    for i in kept:
        beyond = [j for j in near[i] if j not in where]
        inside = [j for j in near[i] if j in where]
        needed = _VALENCE.get(scene.elements[i], len(near[i])) - len(inside) if beyond else 0
        for direction in _directions(scene, i, beyond, inside)[:needed]:
            bonds.append((where[i], len(elements)))
            positions.append(scene.positions_nm[i] + _HYDROGEN_NM * direction)
            elements.append("H")
    n = len(elements)
    pairs = np.sort(np.array(bonds, dtype=np.int64).reshape(-1, 2), axis=1)
    label = f"{scene.residue_names[residue]} {scene.residue_ids[residue]}"
    try:
        orders, charges = perceive(elements, pairs)
    except ValenceError as error:
        raise PreparationError(f"{label} of scene {scene.name!r}, cut out of its chain, fits no valence.") from error
    capped = Scene(
        name=f"{label} of {scene.name} with its neighbours' ends",
        atom_names=tuple(f"{e}{k + 1}" for k, e in enumerate(elements)),
        elements=tuple(elements),
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=(scene.residue_names[residue],),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=pairs,
        bond_orders=orders,
        formal_charges=charges,
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=np.array(positions),
    )
    return CappedResidue(capped, np.array([*kept, *[-1] * (n - len(kept))], dtype=np.int64), n_own)


def _directions(scene: Scene, i: int, beyond: list[int], inside: list[int]) -> list[FloatArray]:
    """Unit vectors from atom i for up to three closing hydrogens: towards what was cut off, then away from the rest."""
    out = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in beyond]
    others = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in inside]
    while len(out) < 3:
        out.append(_unit(-np.sum([*out, *others], axis=0) + 0.3 * np.eye(3)[len(out)]))
    return out


def _unit(vector: Any) -> FloatArray:
    return np.asarray(vector, dtype=np.float64) / max(float(np.linalg.norm(vector)), 1e-9)
