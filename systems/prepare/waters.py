"""Waters that stay: their bonds, and hydrogens where the file has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from systems.prepare.read.records import AtomRecord

FloatArray = npt.NDArray[np.float64]

WATER_BOND_ANGSTROM = 1.3
_OH_ANGSTROM = 0.9572
_HALF_HOH = np.radians(104.52 / 2)
_SEEN_ANGSTROM = 3.5
_DIRECTIONS = 64


def complete_waters(
    waters: Sequence[AtomRecord], others: Sequence[AtomRecord], notes: list[str]
) -> tuple[list[AtomRecord], npt.NDArray[np.int64]]:
    """Return the waters as oxygen and two hydrogens each, in the file's order, and their bonds `(n_bonds, 2)`.

    A hydrogen belongs to the nearest oxygen, within 1.3 Å. Oxygens without their two are given new ones, turned away
    from what stands near (of `others` and the waters); `notes` says to how many.
    """
    from scipy.spatial import cKDTree

    oxygens = [a for a in waters if a.element == "O"]
    places = np.array([a.position_angstrom for a in oxygens])
    own: list[list[AtomRecord]] = [[] for _ in oxygens]
    tree = cKDTree(places)
    for atom in waters:
        if atom.element == "H":
            gap, k = tree.query(atom.position_angstrom)
            if gap < WATER_BOND_ANGSTROM:
                own[int(k)].append(atom)
    bare = [k for k, hydrogens in enumerate(own) if len(hydrogens) != 2]
    around = np.array([a.position_angstrom for a in [*others, *waters]])
    crowd = cKDTree(around)
    rng = np.random.default_rng(0)
    for k in bare:
        near = around[crowd.query_ball_point(places[k], _SEEN_ANGSTROM)]
        pair = _freest(places[k], near, rng)
        own[k] = [
            replace(oxygens[k], serial="", name=name, element="H", position_angstrom=(x, y, z))
            for name, (x, y, z) in zip(("H1", "H2"), pair.tolist(), strict=True)
        ]
        around = np.concatenate([around, pair])
    n = len(oxygens)
    notes.append(
        f"{n} water molecule{'s' if n > 1 else ''} kept" + (f", hydrogens placed on {len(bare)}" if bare else "")
    )
    records = [a for oxygen, hydrogens in zip(oxygens, own, strict=True) for a in (oxygen, *hydrogens)]
    first = 3 * np.arange(n)
    bonds = np.stack([np.stack([first, first + k], axis=1) for k in (1, 2)], axis=1).reshape(-1, 2)
    return records, bonds


def _freest(oxygen: FloatArray, near: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return two hydrogens `(2, 3)` Å of a water, of many directions those whose nearest neighbour is farthest."""
    axes = rng.normal(size=(_DIRECTIONS, 2, 3))
    along = axes[:, 0] / np.linalg.norm(axes[:, 0], axis=1, keepdims=True)
    across = axes[:, 1] - (axes[:, 1] * along).sum(axis=1, keepdims=True) * along
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    side = np.stack([across, -across], axis=1) * np.sin(_HALF_HOH)
    pairs: FloatArray = oxygen + _OH_ANGSTROM * (along[:, None] * np.cos(_HALF_HOH) + side)
    others = near[np.linalg.norm(near - oxygen, axis=1) > _OH_ANGSTROM / 2]
    if not len(others):
        return pairs[0]
    gaps = np.linalg.norm(pairs[:, :, None] - others[None, None], axis=3).min(axis=(1, 2))
    return pairs[int(gaps.argmax())]
