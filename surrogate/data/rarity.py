"""Windows that show rare events, drawn more often and weighted down by as much: the expected loss stays what it was.

A state that one window in ten thousand visits is hardly seen in a training of some hundred thousand windows. Drawing
its windows a thousand times as often, each with a thousandth of the weight, leaves the mean of the loss alone and takes
most of its variance over the rare state away (importance sampling with a mixture that holds the plain draw).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from systems.errors import InputError

# A frame is rare in a torsion when it lies in one of the least populated bins, which together hold at most this share.
RARE_SHARE = 0.02
N_BINS = 12
_BLOCK = 65536
BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class WindowSampler:
    """Draws windows: plainly with probability `1 - rare_draws`, else from one of `pools`, each as likely as the others.

    `starts` (n,) first frames of all windows; `pools` the places in `starts` of each pool's windows; `weights` (n,)
    what a window drawn so must count, its plain probability over that of this draw. Their mean over draws is one.
    """

    starts: Tensor
    pools: tuple[Tensor, ...]
    rare_draws: float
    weights: Tensor

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return first frames `(n,)` and weights `(n,)`."""
        idx = torch.randint(len(self.starts), (n,), generator=generator)
        if self.pools:
            rare = torch.rand(n, generator=generator) < self.rare_draws
            which = torch.randint(len(self.pools), (n,), generator=generator)
            place = torch.rand(n, generator=generator, dtype=torch.float64)
            for k, members in enumerate(self.pools):
                chosen = rare & (which == k)
                idx[chosen] = members[(place[chosen] * len(members)).long()]
        return self.starts[idx], self.weights[idx]


def window_sampler(frames: TrainingFrames, length: int, rare_draws: float) -> WindowSampler:
    """Return the sampler of training windows of `length` frames; `rare_draws` 0 is the plain one.

    Each rotatable torsion gives two pools: windows that visit its rare bins, and windows that both visit and leave
    them. Raises InputError when `rare_draws` is not in [0, 1) or the scene has no rotatable torsion to tell by.
    """
    if not 0.0 <= rare_draws < 1.0:
        raise InputError(f"the share of rare windows must be at least 0 and less than 1, not {rare_draws:g}.")
    starts = frames.window_starts(length, validation=False)
    pools = np.zeros((0, len(starts)), dtype=bool)
    if rare_draws > 0.0:
        rare = rare_frames(frames)
        if not len(rare):
            raise InputError(f"{frames.scene.name} has no rotatable torsion; rare windows cannot be told: use 0.")
        counts = np.concatenate([np.zeros((len(rare), 1), dtype=np.int64), rare.cumsum(axis=1)], axis=1)
        visits = counts[:, starts + length] - counts[:, starts]
        pools = np.concatenate([visits > 0, (visits > 0) & (visits < length)])
        pools = pools[pools.any(axis=1)]
    weights = np.ones(len(starts))
    if len(pools):
        shares = pools.mean(axis=1)
        weights = 1.0 / ((1.0 - rare_draws) + rare_draws * (pools / shares[:, None]).mean(axis=0))
    members = tuple(torch.from_numpy(np.flatnonzero(pool)) for pool in pools)
    return WindowSampler(torch.from_numpy(starts), members, rare_draws, torch.from_numpy(weights.astype(np.float32)))


def rare_frames(frames: TrainingFrames) -> BoolArray:
    """Return `(n_torsions, n_frames)`: whether a frame lies in one of the torsion's rare bins (RARE_SHARE)."""
    from systems.chemistry import rotatable_torsions
    from systems.geometry import torsion

    quads = rotatable_torsions(frames.scene)
    bins = np.empty((len(quads), frames.n_frames), dtype=np.int8)
    for start in range(0, frames.n_frames if len(quads) else 0, _BLOCK):
        idx = np.arange(start, min(start + _BLOCK, frames.n_frames))
        angles = torsion(frames.positions_nm(idx), quads)
        bins[:, idx] = (((angles.T + np.pi) / (2 * np.pi) * N_BINS).astype(np.int8)) % N_BINS
    rare = np.zeros(bins.shape, dtype=bool)
    for k, row in enumerate(bins):
        counts = np.bincount(row, minlength=N_BINS)
        order = np.argsort(counts, kind="stable")
        least = order[np.cumsum(counts[order]) <= RARE_SHARE * frames.n_frames]
        rare[k] = np.isin(row, least)
    return rare
