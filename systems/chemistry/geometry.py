"""Geometry of frames: distances, angles, volumes, torsions and superposition, vectorised over frames.

Columns of coordinates are `(3, n_atoms, n_frames)`: picking an atom then copies one contiguous row of all frames,
several times faster than picking it from each frame in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError
from systems.files.outside import check_density

FloatArray = npt.NDArray[np.floating[Any]]

# Up to so many points all pairs are looked at: sooner done than the library of trees is imported.
_FEW_POINTS = 300


def torsion(positions_nm: npt.ArrayLike, quads: npt.ArrayLike) -> FloatArray:
    """Return torsion angles `(n_frames, k)` in [-pi, pi], positive by the IUPAC convention (1970, rule 1.2).
    `positions_nm (n_frames, n_atoms, 3)` or one frame `(n_atoms, 3)` (then the result is `(k,)`), `quads (k, 4)`.
    Computed in the dtype given, float32 or float64. Raises InputError for arrays of another shape."""
    x, single = _frames(positions_nm)
    angles = torsion_angle(x.transpose(2, 1, 0), np.asarray(quads, dtype=np.int64).reshape(-1, 4)).T
    return angles[0] if single else angles


def near_pairs(points: npt.ArrayLike, reach: float, what: str = "") -> npt.NDArray[np.int64]:
    """Return the pairs i < j `(n, 2)` of points `(n_points, 3)` nearer to each other than `reach`, in ascending order.
    Raises PreparationError, which names `what`, where they stand so close that atoms must coincide."""
    x = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if len(x) <= _FEW_POINTS:
        i, j = np.triu_indices(len(x), 1)
        near = ((x[i] - x[j]) ** 2).sum(axis=1) <= reach**2
        return np.stack([i[near], j[near]], axis=1)
    from scipy.spatial import cKDTree

    tree = cKDTree(x)
    check_density(tree, reach, what)
    pairs: npt.NDArray[np.int64] = tree.query_pairs(reach, output_type="ndarray").reshape(-1, 2).astype(np.int64)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def signed_volumes(positions_nm: npt.ArrayLike, quads: npt.ArrayLike) -> FloatArray:
    """Return the signed volumes `(n_frames, k)` nm^3 of (b-a) x (c-a) . (d-a) for quadruples (a, b, c, d) `(k, 4)`; one
    frame `(n_atoms, 3)` gives `(k,)`. For a stereocentre `a` with neighbours b, c, d the sign is its handedness."""
    x, single = _frames(positions_nm)
    volumes = signed_volume(x.transpose(2, 1, 0), np.asarray(quads, dtype=np.int64).reshape(-1, 4)).T
    return volumes[0] if single else volumes


def extend(
    a: npt.NDArray[np.float64],
    b: npt.NDArray[np.float64],
    c: npt.NDArray[np.float64],
    length: float,
    angle_deg: float,
    torsion_deg: float,
) -> npt.NDArray[np.float64]:
    """Return the point `(3,)` at `length` from c, at `angle_deg` to b and `torsion_deg` about b-c to a, in the unit of
    the positions `(3,)`."""
    angle, twist = np.radians(angle_deg), np.radians(torsion_deg)
    axis = (c - b) / np.linalg.norm(c - b)
    normal = np.cross(b - a, axis)
    normal = normal / np.linalg.norm(normal)
    inward = np.cross(normal, axis)
    out: npt.NDArray[np.float64] = c + length * (
        -np.cos(angle) * axis + np.sin(angle) * (np.cos(twist) * inward + np.sin(twist) * normal)
    )
    return out


def superposition(
    positions_nm: npt.ArrayLike, template_nm: npt.ArrayLike, *, idx: npt.ArrayLike | None = None
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the rotations `(n, 3, 3)` and translations `(n, 3)` nm that lay each frame over the template.

    A frame x moves to `x @ R.T + t`. `positions_nm (n, n_atoms, 3)`, `template_nm (n_atoms, 3)`; `idx` selects the
    atoms that are fitted. Rotations are proper: a mirror image stays one. Where the best rotation is not unique one of
    the best is returned. Source: quaternions of Horn, J. Opt. Soc. Am. A 4, 629 (1987). Raises InputError for shapes
    that do not fit.
    """
    x, _ = _frames(positions_nm)
    y = np.asarray(template_nm, dtype=np.float64)
    if y.shape != x.shape[1:]:
        raise InputError(f"Superposition: frames have {x.shape[1]} atoms, the template has shape {y.shape}.")
    if idx is not None:
        chosen = np.asarray(idx, dtype=np.int64)
        x, y = x[:, chosen], y[chosen]
    if len(y) == 0:
        raise InputError("Superposition: no atom to fit.")
    w = np.full(len(y), 1.0 / len(y))
    centre_x = np.tensordot(x.astype(np.float64, copy=False), w, axes=(1, 0))
    centre_y = w @ y
    target = (y - centre_y) * w[:, None]
    covariance = np.tensordot(x.astype(np.float64, copy=False), target, axes=(1, 0))
    # The target is centred: sum_a w_a (y_a - c) = 0, so frames need no centring here except for rounding.
    covariance -= centre_x[:, :, None] * target.sum(axis=0)[None, None, :]
    rotation = _best_rotations(covariance)
    translation = centre_y - np.einsum("nij,nj->ni", rotation, centre_x)
    return rotation, translation


def superpose(
    positions_nm: npt.ArrayLike, template_nm: npt.ArrayLike, *, idx: npt.ArrayLike | None = None
) -> FloatArray:
    """Return the frames laid over the template, same shape and dtype as given; `idx` says which atoms are fitted
    (`superposition`). One frame `(n_atoms, 3)` gives one frame."""
    x, single = _frames(positions_nm)
    rotation, translation = superposition(x, template_nm, idx=idx)
    moved = np.matmul(x, rotation.transpose(0, 2, 1).astype(x.dtype))
    moved += translation.astype(x.dtype)[:, None, :]
    out: FloatArray = moved[0] if single else moved
    return out


def _frames(positions_nm: npt.ArrayLike) -> tuple[FloatArray, bool]:
    x = np.asarray(positions_nm)
    if x.dtype not in (np.float32, np.float64):
        x = x.astype(np.float64)
    single = x.ndim == 2
    if single:
        x = x[None]
    if x.ndim != 3 or x.shape[2] != 3:
        raise InputError(f"Positions have shape {x.shape}, not (n_frames, n_atoms, 3).")
    return x, single


def _best_rotations(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Rotations maximising tr(R S) for S = sum_a w_a x_a y_a^T, `(n, 3, 3)`."""
    s = covariance
    key = np.empty((len(s), 4, 4))
    key[:, 0, 0] = s[:, 0, 0] + s[:, 1, 1] + s[:, 2, 2]
    key[:, 1, 1] = s[:, 0, 0] - s[:, 1, 1] - s[:, 2, 2]
    key[:, 2, 2] = s[:, 1, 1] - s[:, 0, 0] - s[:, 2, 2]
    key[:, 3, 3] = s[:, 2, 2] - s[:, 0, 0] - s[:, 1, 1]
    key[:, 0, 1] = key[:, 1, 0] = s[:, 1, 2] - s[:, 2, 1]
    key[:, 0, 2] = key[:, 2, 0] = s[:, 2, 0] - s[:, 0, 2]
    key[:, 0, 3] = key[:, 3, 0] = s[:, 0, 1] - s[:, 1, 0]
    key[:, 1, 2] = key[:, 2, 1] = s[:, 0, 1] + s[:, 1, 0]
    key[:, 1, 3] = key[:, 3, 1] = s[:, 0, 2] + s[:, 2, 0]
    key[:, 2, 3] = key[:, 3, 2] = s[:, 1, 2] + s[:, 2, 1]
    quaternion = np.full((len(s), 4), np.nan)
    finite = np.isfinite(key).all(axis=(1, 2))
    quaternion[finite] = np.linalg.eigh(key[finite])[1][:, :, -1]  # of the largest eigenvalue
    w, x, y, z = quaternion.T
    rotation = np.empty((len(s), 3, 3))
    rotation[:, 0, 0] = 1 - 2 * (y * y + z * z)
    rotation[:, 1, 1] = 1 - 2 * (x * x + z * z)
    rotation[:, 2, 2] = 1 - 2 * (x * x + y * y)
    rotation[:, 0, 1], rotation[:, 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    rotation[:, 0, 2], rotation[:, 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    rotation[:, 1, 2], rotation[:, 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return rotation


# ---- many frames at once, frames last in memory ---------------------------------------------------------------------


IntArray = npt.NDArray[np.int64]

_BLOCK_VALUES = 262_144


def column_blocks(positions_nm: FloatArray, widest: int) -> Iterator[tuple[int, FloatArray]]:
    """Yield `(first frame, coordinates (3, n_atoms, n))` of frames `(n_frames, n_atoms, 3)` nm, in blocks so that the
    largest intermediate array, of `widest` rows, stays in the cache."""
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
