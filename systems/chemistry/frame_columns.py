"""Distances, angles, volumes and torsions of many frames at once, frames last in memory.

Coordinates are `(3, n_atoms, n_frames)`: picking an atom then copies one contiguous row of all frames, which is several
times faster than picking it from each frame in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]

_BLOCK_VALUES = 262_144


def column_blocks(positions_nm: FloatArray, widest: int) -> Iterator[tuple[int, FloatArray]]:
    """Yield `(first frame, coordinates (3, n_atoms, n))` of frames `(n_frames, n_atoms, 3)` nm, block by block.

    `widest` is the number of rows of the largest intermediate array; blocks are cut so that it stays in the cache.
    """
    size = max(_BLOCK_VALUES // (3 * max(widest, positions_nm.shape[1], 1)), 16)
    kind = np.float64 if positions_nm.dtype == np.float64 else np.float32
    for start in range(0, len(positions_nm), size):
        yield start, np.ascontiguousarray(positions_nm[start : start + size].transpose(2, 1, 0), dtype=kind)


def squared_distance(columns: FloatArray, pairs: IntArray) -> FloatArray:
    """Return squared distances `(k, n)` nm² for pairs `(k, 2)` of coordinates `(3, n_atoms, n)` nm."""
    out = np.zeros((len(pairs), columns.shape[2]), dtype=columns.dtype)
    for axis in columns:
        step = axis[pairs[:, 0]]
        step -= axis[pairs[:, 1]]
        step *= step
        out += step
    return out


def signed_volume(columns: FloatArray, quads: IntArray) -> FloatArray:
    """Return the signed volumes `(k, n)` nm³ of (centre, a, b, c) in coordinates `(3, n_atoms, n)` nm."""
    centre = columns[:, quads[:, 0]]
    a, b, c = (columns[:, quads[:, k]] - centre for k in (1, 2, 3))
    volume: FloatArray = (cross(a, b) * c).sum(axis=0)
    return volume


def torsion_cosine(columns: FloatArray, quads: IntArray) -> FloatArray:
    """Return the cosines `(k, n)` of torsions `(k, 4)` in coordinates `(3, n_atoms, n)` nm; 0 where undefined."""
    first, second, third = (columns[:, quads[:, k + 1]] - columns[:, quads[:, k]] for k in range(3))
    left, right = cross(first, second), cross(second, third)
    scale = np.sqrt((left * left).sum(axis=0) * (right * right).sum(axis=0))
    cosine: FloatArray = (left * right).sum(axis=0) / np.maximum(scale, np.finfo(columns.dtype).tiny)
    return cosine


def torsion_angle(columns: FloatArray, quads: IntArray) -> FloatArray:
    """Return the torsions `(k, n)` in [-pi, pi], IUPAC sign, of quads `(k, 4)` in coordinates `(3, n_atoms, n)` nm."""
    first, second, third = (columns[:, quads[:, k + 1]] - columns[:, quads[:, k]] for k in range(3))
    left, right = cross(first, second), cross(second, third)
    sine = (first * right).sum(axis=0) * np.sqrt((second * second).sum(axis=0))
    angle: FloatArray = np.arctan2(sine, (left * right).sum(axis=0))
    return angle


def bond_angle(columns: FloatArray, triples: IntArray) -> FloatArray:
    """Return the angles `(k, n)` in [0, pi] at the middle atom of triples `(k, 3)` of coordinates `(3, n_atoms, n)`."""
    a, b = (columns[:, triples[:, k]] - columns[:, triples[:, 1]] for k in (0, 2))
    normal = cross(a, b)
    angle: FloatArray = np.arctan2(np.sqrt((normal * normal).sum(axis=0)), (a * b).sum(axis=0))
    return angle


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross products of vectors `(3, ...)`; np.cross takes several times as long."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
