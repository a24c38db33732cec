"""Windows that show rare events, drawn more often and weighted down by as much: the expected loss stays what it was.

A state that one window in ten thousand visits is hardly seen in a training of some hundred thousand windows. Drawing
its windows a thousand times as often, each with a thousandth of the weight, leaves the mean of the loss alone and takes
most of its variance over the rare state away (importance sampling with a mixture that holds the plain draw).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from surrogate.models.lam_slide.kinds import N_BINS, CountFn, Kind, Quad, kinds_by_counts, torsion_bins
from systems.errors import InputError

# A frame is rare in a torsion when it lies in one of the least populated bins, which together hold at most this share.
RARE_SHARE = 0.02
# A torsion's bin makes a kind of window when at most this share of all windows visits it.
KIND_SHARE = 0.006
_BLOCK = 65536
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class WindowSampler:
    """Draws windows: plainly with probability `1 - rare_draws`, else from one of `pools`, each as likely as the others.

    `starts` (n,) first frames of all windows; `pools` the places in `starts` of each pool's windows; `weights` (n,)
    what a window drawn so must count, its plain probability over that of this draw. Their mean over draws is one.
    `kinds` (n,) of the windows, if they have any; each kind but 0 is then a pool.
    """

    starts: Tensor
    pools: tuple[Tensor, ...]
    rare_draws: float
    weights: Tensor
    kinds: Tensor | None = None

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return first frames `(n,)`, weights `(n,)`, and kinds `(n,)` where there are any."""
        idx = torch.randint(len(self.starts), (n,), generator=generator)
        if self.pools:
            rare = torch.rand(n, generator=generator) < self.rare_draws
            which = torch.randint(len(self.pools), (n,), generator=generator)
            place = torch.rand(n, generator=generator, dtype=torch.float64)
            for k, members in enumerate(self.pools):
                chosen = rare & (which == k)
                idx[chosen] = members[(place[chosen] * len(members)).long()]
        return self.starts[idx], self.weights[idx], None if self.kinds is None else self.kinds[idx]


def window_sampler(
    frames: TrainingFrames, length: int, rare_draws: float, kinds: IntArray | None = None
) -> WindowSampler:
    """Return the sampler of training windows of `length` frames; `rare_draws` 0 is the plain one.

    Each rotatable torsion gives two pools: windows that visit its rare bins, and windows that both visit and leave
    them. With `kinds` (n_frames,) of the windows from each frame on (`window_kinds`), each kind is a pool.
    Raises InputError when `rare_draws` is not in [0, 1) or the scene has no rotatable torsion to tell by.
    """
    if not 0.0 <= rare_draws < 1.0:
        raise InputError(f"the share of rare windows must be at least 0 and less than 1, not {rare_draws:g}.")
    starts = frames.window_starts(length, validation=False)
    pools = np.zeros((0, len(starts)), dtype=bool)
    if kinds is not None:
        pools = kinds[starts] == np.arange(1, kinds.max() + 1)[:, None]
    elif rare_draws > 0.0:
        rare = rare_frames(frames)
        if not len(rare):
            raise InputError(f"{frames.scene.name} has no rotatable torsion; rare windows cannot be told: use 0.")
        visits = visits_of(rare, starts, length)
        pools = np.concatenate([visits > 0, (visits > 0) & (visits < length)])
    pools = pools[pools.any(axis=1)] if rare_draws > 0.0 else pools[:0]
    weights = np.ones(len(starts))
    if len(pools):
        shares = pools.mean(axis=1)
        weights = 1.0 / ((1.0 - rare_draws) + rare_draws * (pools / shares[:, None]).mean(axis=0))
    return WindowSampler(
        torch.from_numpy(starts),
        tuple(torch.from_numpy(np.flatnonzero(pool)) for pool in pools),
        rare_draws,
        torch.from_numpy(weights.astype(np.float32)),
        None if kinds is None else torch.from_numpy(kinds[starts]),
    )


def rare_kinds(frames: TrainingFrames, length: int) -> tuple[Kind, ...]:
    """Return the kinds of rare window of `length` frames, the rarest first; the same backwards in time.

    A torsion's bin is rare when at most KIND_SHARE of the training windows visit it. Windows that visit a rare bin and
    also frequent ones are a kind for each bin, those that stay among rare bins another: so a kind tells whether the
    rare state is entered or left. Raises InputError where there is no rare bin.
    """
    quads, bins = _bins(frames)
    starts = frames.window_starts(length, validation=False)
    found: list[Kind] = []
    for quad, row in zip(quads, bins, strict=True):
        shares = [float((visits_of(row[None] == k, starts, length) > 0).mean()) for k in range(N_BINS)]
        rare = tuple(k for k in range(N_BINS) if 0.0 < shares[k] <= KIND_SHARE)
        found += [Kind(quad, rare, k) for k in (*rare, None)] if rare else []
    count = _counter(quads, bins, starts, length)
    shares_of = {kind: float((kinds_by_counts([kind], count, len(starts), length) > 0).mean()) for kind in found}
    found = [kind for kind in found if shares_of[kind] > 0.0]
    if not found:
        raise InputError(f"{frames.scene.name} shows no rare state of a rotatable torsion; train without rare kinds.")
    return tuple(sorted(found, key=lambda kind: (kind.visited is None, shares_of[kind])))


def window_kinds(frames: TrainingFrames, kinds: Sequence[Kind], length: int) -> IntArray:
    """Return the kind `(n_frames,)` of the window of `length` frames from each frame on: 0 ordinary, k the k-th.

    Where no training or validation window starts it is 0.
    """
    quads, bins = _bins(frames)
    starts = np.concatenate([frames.window_starts(length, validation=v) for v in (False, True)])
    found = np.zeros(frames.n_frames, dtype=np.int64)
    found[starts] = kinds_by_counts(kinds, _counter(quads, bins, starts, length), len(starts), length)
    return found


def visits_of(marked: BoolArray, starts: IntArray, length: int) -> IntArray:
    """Return how many of the marked frames `(k, n_frames)` each window holds: `(k, n_starts)`."""
    counts = np.concatenate([np.zeros((len(marked), 1), dtype=np.int64), marked.cumsum(axis=1)], axis=1)
    return counts[:, starts + length] - counts[:, starts]


def _counter(quads: Sequence[Quad], bins: npt.NDArray[np.int8], starts: IntArray, length: int) -> CountFn:
    return lambda quad, some: visits_of(np.isin(bins[quads.index(quad)], some)[None], starts, length)[0]


def _bins(frames: TrainingFrames) -> tuple[list[Quad], npt.NDArray[np.int8]]:
    """Return the rotatable torsions and the bin `(n_torsions, n_frames)` of each."""
    from systems.chemistry.graph import rotatable_torsions

    quads = rotatable_torsions(frames.scene)
    bins = np.empty((len(quads), frames.n_frames), dtype=np.int8)
    for start in range(0, frames.n_frames if len(quads) else 0, _BLOCK):
        idx = np.arange(start, min(start + _BLOCK, frames.n_frames))
        bins[:, idx] = torsion_bins(frames.positions_nm(idx), quads)
    return [(int(a), int(b), int(c), int(d)) for a, b, c, d in quads], bins


def rare_frames(frames: TrainingFrames) -> BoolArray:
    """Return `(n_torsions, n_frames)`: whether a frame lies in one of the torsion's rare bins (RARE_SHARE)."""
    _, bins = _bins(frames)
    rare = np.zeros(bins.shape, dtype=bool)
    for k, row in enumerate(bins):
        counts = np.bincount(row, minlength=N_BINS)
        order = np.argsort(counts, kind="stable")
        least = order[np.cumsum(counts[order]) <= RARE_SHARE * frames.n_frames]
        rare[k] = np.isin(row, least)
    return rare
