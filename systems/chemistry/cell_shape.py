"""Periodic cells: box vectors from lengths and angles, and back."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]


def lengths_and_angles(cell_nm: npt.ArrayLike) -> tuple[Float64Array, Float64Array]:
    """Return `(lengths (n, 3) nm, angles (n, 3) degrees)` of box vectors `(n, 3, 3)` nm (rows a, b, c).

    Angles are alpha (between b and c), beta (a and c) and gamma (a and b).
    """
    cell = np.asarray(cell_nm, dtype=np.float64)
    lengths = np.linalg.norm(cell, axis=2)
    unit = cell / lengths[:, :, None]
    pairs = ((1, 2), (0, 2), (0, 1))
    cosines = np.stack([(unit[:, i] * unit[:, j]).sum(axis=1) for i, j in pairs], axis=1)
    # An arc cosine of rounding noise shows 90.00000000000001.
    return lengths, np.round(np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0))), 10)


def box_vectors(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> Float64Array:
    """Return box vectors `(n, 3, 3)` nm, a along x and b in the xy plane, from `(n, 3)` lengths and angles."""
    lengths = np.asarray(lengths_nm, dtype=np.float64)
    cosine = np.cos(np.radians(np.asarray(angles_deg, dtype=np.float64)))
    cosine[np.abs(cosine) < 1e-7] = 0.0
    alpha, beta, gamma = cosine[:, 0], cosine[:, 1], cosine[:, 2]
    sine_gamma = np.sqrt(1.0 - gamma**2)
    cell = np.zeros((len(lengths), 3, 3))
    cell[:, 0, 0] = 1.0
    cell[:, 1, 0], cell[:, 1, 1] = gamma, sine_gamma
    cell[:, 2, 0], cell[:, 2, 1] = beta, (alpha - beta * gamma) / sine_gamma
    cell[:, 2, 2] = np.sqrt(1.0 - cell[:, 2, 0] ** 2 - cell[:, 2, 1] ** 2)
    scaled: Float64Array = cell * lengths[:, :, None]
    return scaled


def read_cells(lengths_nm: npt.ArrayLike, angles_deg: npt.ArrayLike) -> Float64Array | None:
    """Return the box vectors `(n, 3, 3)` nm of the lengths and angles `(n, 3)` in a file; None where a length is zero,
    as files without a cell have it."""
    lengths = np.asarray(lengths_nm, dtype=np.float64)
    return None if (lengths == 0.0).any() else box_vectors(lengths, angles_deg)
