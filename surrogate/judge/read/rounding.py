"""What a file's coordinates are rounded to: stated in its header, or seen in its numbers.

A coordinate that is rounded to a grid of spacing g is off by a uniform error of standard deviation g/√12, and the
length of a bond, along which two of them subtract, by g/√6. All trajectories of a comparison are laid on the coarsest
grid of any of them, so that what rounding does to lengths, angles and nearest distances it does to all alike.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.trajectory.base import TrajectoryReader

Frames = npt.NDArray[np.float32]

# Two decimals of an Å to four: what text formats write, and XTC and TNG at their usual precisions. Finer ones do not
# show in anything that is measured.
_GRIDS_NM = (1e-2, 1e-3, 1e-4)
# Fewer numbers lie on a grid by chance.
_LEAST_NUMBERS = 24
_OFF = 0.02
_WORST_OFF = 0.2


def grid_of(reader: TrajectoryReader) -> float:
    """Return what the coordinates of an open file are rounded to, nm: as its header states, else as the first, middle
    and last frame show; 0 where they are not."""
    if reader.grid_nm is not None:
        return reader.grid_nm
    some = sorted({0, reader.n_frames // 2, reader.n_frames - 1})
    x = np.concatenate([reader.read(k, k + 1).ravel() for k in some]).astype(np.float64)
    x = x[np.isfinite(x) & (x != 0.0)]
    if len(x) < _LEAST_NUMBERS:
        return 0.0
    spacing = np.spacing(np.abs(x).astype(np.float32)).astype(np.float64)
    for grid in _GRIDS_NM:
        off = np.abs(x / grid - np.rint(x / grid))
        allowed = _OFF + 4.0 * spacing / grid
        if allowed.max() < _WORST_OFF and (off <= allowed).all():
            return grid
    return 0.0


def rounded(frames_nm: npt.NDArray[Any], grid_nm: float) -> Frames:
    """Return frames with every coordinate at the nearest multiple of `grid_nm`, in a new array."""
    out = np.asarray(frames_nm, dtype=np.float32) * np.float32(1.0 / grid_nm)
    np.rint(out, out=out)
    out *= np.float32(grid_nm)
    return out


def length_error_nm(grid_nm: float) -> float:
    """Return the standard deviation that rounding gives the distance of two atoms, nm: two uniform errors, g/√6."""
    return grid_nm / math.sqrt(6.0)


def angle_variance(
    first_nm: npt.ArrayLike, second_nm: npt.ArrayLike, angle_rad: npt.ArrayLike, grid_nm: float
) -> npt.NDArray[np.float64]:
    """Return the variance that rounding gives bond angles, rad²: g²/12 times the squared gradient of the angle by all
    nine coordinates. Arms `(k,)` nm, angles `(k,)` rad; to first order."""
    a, b, angle = (np.asarray(v, dtype=np.float64) for v in (first_nm, second_nm, angle_rad))
    return np.asarray(grid_nm**2 / 6.0 * (1.0 / a**2 + 1.0 / b**2 - np.cos(angle) / (a * b)))


def rounding_note(labels: list[str], grid_nm: float) -> str:
    """Return the line on the trajectories whose rounding all are compared at."""
    error = 10.0 * length_error_nm(grid_nm)
    return (
        f"{' and '.join(labels)}: coordinates are rounded to {10.0 * grid_nm:.3g} Å, which alone makes bond lengths "
        f"vary by {error:.2g} Å; all trajectories are compared rounded alike, and what is narrower is hidden."
    )
