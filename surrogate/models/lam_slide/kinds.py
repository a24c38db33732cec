"""Kinds of windows: which rare state of a torsion a chunk of frames visits, for networks that take it as an input."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import torsion

# Around the circle.
N_BINS = 12
BinArray = npt.NDArray[np.int8]
IntArray = npt.NDArray[np.int64]
Quad = tuple[int, int, int, int]
# How many frames of each window lie in any of these bins of this torsion: (n,).
CountFn = Callable[[Quad, Sequence[int]], IntArray]


@dataclass(frozen=True)
class Kind:
    """Windows that visit the bin `visited` of the torsion `quad` and also leave its `rare` bins, or, without a
    `visited` bin, those that never leave them."""

    quad: Quad
    rare: tuple[int, ...]
    visited: int | None = None


def torsion_bins(positions_nm: npt.ArrayLike, quads: npt.ArrayLike) -> BinArray:
    """Return the bin `(n_quads, n_frames)`, of N_BINS, of each torsion in frames `(n_frames, n_atoms, 3)`."""
    turns = (torsion(positions_nm, quads).T + np.pi) / (2 * np.pi)
    return (turns * N_BINS).astype(np.int8) % np.int8(N_BINS)


def kinds_by_counts(kinds: Sequence[Kind], count: CountFn, n: int, length: int) -> IntArray:
    """Return for each of `n` windows of `length` frames the place, from 1, of the first kind that it is of; else 0."""
    found = np.zeros(n, dtype=np.int64)
    for place, kind in reversed(list(enumerate(kinds, start=1))):
        inside = count(kind.quad, kind.rare)
        if kind.visited is None:
            fits = inside == length
        else:
            fits = (inside < length) & (count(kind.quad, (kind.visited,)) > 0)
        found[fits] = place
    return found


def kinds_of_windows(windows_nm: npt.NDArray[np.floating[Any]], kinds: Sequence[Kind]) -> IntArray:
    """Return the kind `(n,)` of windows `(n, length, n_atoms, 3)`."""
    n, length = windows_nm.shape[:2]
    flat = windows_nm.reshape(-1, *windows_nm.shape[2:])
    bins = {quad: torsion_bins(flat, [quad])[0].reshape(n, length) for quad in {kind.quad for kind in kinds}}
    return kinds_by_counts(kinds, lambda quad, some: np.isin(bins[quad], some).sum(axis=1), n, length)
