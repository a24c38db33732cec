"""Windows of molecules' trajectories for forecasting: some frames given, the next to predict, split by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from systems.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

# Shares of a trajectory, by time, for training, validation and test (GeoTDM, Han 2024).
SHARES = {"train": 0.6, "validation": 0.2, "test": 0.2}


@dataclass(frozen=True, eq=False)
class MoleculeWindows:
    """One molecule's trajectory and where its windows of `span` frames start. `label`: the name, and what else there is
    to say of where the frames come from.

    `elements` (n_atoms,) atomic numbers; `kinds` (n_atoms, n_atoms): 2 a bond, 1 second neighbours, 0 any other pair;
    `template_nm` (n_atoms, 3), on which frames are laid by the atoms `fitted_idx`; `frames_nm` (n_frames, n_atoms, 3)
    float64, `lag_ps` apart. `starts`: of each split the windows asked for; `every_start`: all that fit into it.
    `blocks`: for each of the windows asked for the stretch of `span` frames it starts in; windows of different ones
    count as independent.
    """

    name: str
    label: str
    elements: IntArray
    kinds: IntArray
    template_nm: FloatArray
    fitted_idx: IntArray
    frames_nm: FloatArray
    lag_ps: float
    span: int
    starts: Mapping[str, IntArray]
    every_start: Mapping[str, IntArray]
    blocks: Mapping[str, IntArray]

    @property
    def n_atoms(self) -> int:
        return len(self.elements)

    def windows(self, starts: IntArray) -> FloatArray:
        """Return windows `(n, span, n_atoms, 3)` nm."""
        return self.frames_nm[starts[:, None] + np.arange(self.span)]

    def n_independent(self, split: str) -> int:
        """Return how many windows of a split fit side by side: no more are independent, however many overlap."""
        return len(np.unique(self.blocks[split]))


def split_windows(
    n_frames: int, span: int, counts: Mapping[str, int], name: str
) -> tuple[dict[str, IntArray], dict[str, IntArray], dict[str, IntArray]]:
    """Split a trajectory by time and return `starts` (of each split `counts[split]`, evenly spaced, or all where there
    are fewer), `every_start` and `blocks` of `MoleculeWindows`.

    A window lies in its split whole, so splits share no frame. Raises InputError for too few frames.
    """
    chosen, every, blocks, begin = {}, {}, {}, 0
    for (split, _), share in zip(SHARES.items(), np.cumsum(list(SHARES.values())), strict=True):
        end = round(n_frames * float(share))
        if end - begin < span:
            raise InputError(
                f"{name}: {end - begin} {split} frames do not hold a window of {span}; simulate for longer."
            )
        every[split] = np.arange(begin, end - span + 1)
        picked = np.linspace(0, len(every[split]) - 1, min(counts[split], len(every[split])))
        chosen[split] = every[split][np.unique(picked.round().astype(np.int64))]
        # A last stretch that is not whole belongs to the one before.
        blocks[split] = np.minimum((chosen[split] - begin) // span, (end - begin) // span - 1)
        begin = end
    return chosen, every, blocks


def pair_kinds(n_atoms: int, bonds: IntArray) -> IntArray:
    """Return `kinds` (n_atoms, n_atoms) of a molecule with `bonds` (n_bonds, 2)."""
    bonded = np.zeros((n_atoms, n_atoms), dtype=bool)
    bonded[bonds[:, 0], bonds[:, 1]] = bonded[bonds[:, 1], bonds[:, 0]] = True
    second = (bonded.astype(np.int64) @ bonded.astype(np.int64) > 0) & ~bonded & ~np.eye(n_atoms, dtype=bool)
    return 2 * bonded.astype(np.int64) + second.astype(np.int64)
