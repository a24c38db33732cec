"""What a molecule's symmetry makes equal is measured together: it does not matter which is called the first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
T = TypeVar("T")

# Of more bonds or angles than this, evenly chosen ones have histograms: those of a protein say the same many times.
MOST_HISTOGRAMS = 128


def equal_rows(rows: npt.NDArray[np.int64], classes: npt.NDArray[np.int64]) -> list[npt.NDArray[np.intp]]:
    """Return the groups of `rows` of atoms `(k, m)`, forwards or backwards, that the molecule's symmetry makes equal.

    `classes` `(n_atoms,)` are equal for atoms without an identity of their own. Groups come in order of their first
    row: the six C-H bonds of two equal methyl groups are one, and which hydrogen is called the first does not matter.
    """
    found: dict[tuple[int, ...], list[int]] = {}
    for k, row in enumerate(classes[rows].tolist()):
        found.setdefault(min(tuple(row), tuple(row[::-1])), []).append(k)
    return [np.array(group, dtype=np.intp) for group in found.values()]


def group_labels(labels: Sequence[str], groups: Sequence[npt.NDArray[np.intp]]) -> list[str]:
    """Return the name of the first of each group, and how many more are equal to it."""
    return [labels[g[0]] + (f" and {len(g) - 1} equal" if len(g) > 1 else "") for g in groups]


def evenly(items: Sequence[T], most: int) -> list[T]:
    """Return all items, or at most `most` of them, evenly chosen."""
    return list(items[:: -(-len(items) // most)]) if items else []


def over_groups(values: FloatArray, groups: Sequence[npt.NDArray[np.intp]]) -> FloatArray:
    """Return the means over groups of the last axis, `(..., n_groups)`."""
    if not groups:
        return values[..., :0]
    return np.stack([values[..., g].mean(axis=-1) for g in groups], axis=-1)
