"""One peptide in training: its frames, how likely each is in equilibrium, and the windows drawn from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.equilibrium import equilibrium_weights
from surrogate.data.frames import TrainingFrames
from surrogate.models.peptides.chains import ChainFeatures
from surrogate.models.peptides.model import PeptideConfig, PeptideSlide
from surrogate.models.peptides.torsion_states import FIRST_OF_SIDE_CHAIN
from systems.errors import InputError

# Share of windows whose frames are evenly spaced, as in rollouts; the others' times are drawn one by one.
_EVEN_SHARE = 0.5
# Share of batches whose windows are as long as a chunk; others are shorter, as chunks at long lags are.
_WHOLE_SHARE = 0.5
# Share of windows whose later frames are drawn from equilibrium, at a time when the given one is forgotten.
_FORGOTTEN_SHARE = 0.1
# Share of windows that are made to hold a change of some torsion's state, of phi or of a side chain by turns.
_CROSSING_SHARE = 0.15
_LIKELIEST = 0.9
_MARKOV_LAG_PS = 50.0
_BLOCK = 20_000
_TRIES = 20


@dataclass(eq=False)
class PeptideSubject:
    """One sequence's frames, its input features, and the stretches that windows may be taken from.

    `weights` (n_frames,): of frames in equilibrium, of mean 1 where they are kept, zero in what is held out. Without
    them no window is read backwards.
    """

    frames: TrainingFrames
    chain: ChainFeatures
    weights: npt.NDArray[np.float64] | None = None

    def in_equilibrium(self, positive_phi_kt: Mapping[str, float]) -> PeptideSubject:
        """Return this subject with weights, or itself where its runs do not tell how likely its states are."""
        ranges = self.frames.split.ranges(self.frames.starts, validation=False)
        kept = np.concatenate([np.arange(low, high) for low, high in ranges])
        states, shares = self._signs_of_phi(kept, positive_phi_kt)
        found = equilibrium_weights(
            [self._torsions(low, high) for low, high in ranges], max(1, round(_MARKOV_LAG_PS / self.frames.lag_ps)),
            states=states if len(shares) > 1 else None, shares=shares,
        )  # fmt: skip
        if found is None:
            return self
        weights = np.zeros(self.frames.n_frames)
        weights[kept] = found
        return replace(self, weights=weights)

    def _signs_of_phi(
        self, kept: npt.NDArray[np.int64], positive_phi_kt: Mapping[str, float]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """Return the pattern of phi's signs of each frame `kept` (n,), as a number, and the population of each pattern.

        Residues are taken to be independent; those whose free energy is not given play no part, nor do those before a
        proline, whose ring leaves them no room at phi > 0: how likely they are there is left to their own runs.
        """
        types = (*self.chain.code.layout.types, "")
        states, shares = np.zeros(len(kept), dtype=np.int64), np.ones(1)
        for residue in self.chain.signed.tolist():
            name = self.frames.scene.residue_names[residue]
            if name in positive_phi_kt and types[residue + 1] != "PRO":
                states = states + len(shares) * self._states[kept, residue, 0]
                odds = float(np.exp(-positive_phi_kt[name]))
                shares = np.concatenate([shares, shares * odds])
        return states, shares

    @cached_property
    def _states(self) -> npt.NDArray[np.int8]:
        """The states of torsions in each frame: `(n_frames, n_residues, MOST_TORSIONS)`."""
        blocks = (
            self._frames(k, min(k + _BLOCK, self.frames.n_frames)) for k in range(0, self.frames.n_frames, _BLOCK)
        )
        return torch.cat([self.chain.states(block).to(torch.int8).cpu() for block in blocks]).numpy()

    def _frames(self, low: int, high: int) -> Tensor:
        return torch.from_numpy(self.frames.positions_nm(np.arange(low, high))).to(self.chain.places.device)

    def _torsions(self, low: int, high: int) -> npt.NDArray[np.float64]:
        """Return cosines and sines `(n, 2 n_torsions)` of frames."""
        at = self.chain.code.turning_at
        found = []
        for start in range(low, high, _BLOCK):
            tokens = self.chain.code.encode(self._frames(start, min(start + _BLOCK, high)))
            found.append(tokens.flatten(-2)[:, torch.cat([at, at + 1])].cpu())
        return torch.cat(found).double().numpy()

    def windows(
        self, n: int, config: PeptideConfig, generator: torch.Generator, *, later: int | None = None,
        validation: bool = False,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Draw windows: frames `(n, 1 + later)` and the times `(n, later)` ps after the first; `later` is
        `chunk_frames` where it is not given.

        Times are evenly spaced at a lag drawn evenly in its logarithm, or drawn one by one in the same way; none is
        longer than the configuration's, and all frames of a window are of one stretch. With weights half of them are
        read backwards, and in some the later frames are any of equilibrium, `forgotten_ps` after the first.

        Runs from chosen starts tell well what happens to states that they hold more often than equilibrium does, and
        detailed balance tells the rest: windows start from the former as they are read forwards, from the latter
        backwards. (From a common state, runs forwards show rare ones hardly entered; averaged with windows that do
        enter them, they would halve the rate.)
        """
        lag = self.frames.lag_ps
        ranges = np.array(self.frames.split.ranges(self.frames.starts, validation=validation))
        longest = min(int(config.longest_ps / lag), int((ranges[:, 1] - ranges[:, 0]).max()) - 1)
        if longest < config.chunk_frames:
            raise InputError(
                f"{self.frames.scene.name}: runs hold no window of {config.chunk_frames} frames; run longer."
            )
        t = later or config.chunk_frames
        even = torch.rand(n, 1, generator=generator) < _EVEN_SHARE
        top = float(np.log(longest / t))
        stride = torch.exp(torch.rand(n, 1, generator=generator) * top).round().clamp(1, longest // t)
        drawn = torch.exp(torch.rand(n, t, generator=generator) * float(np.log(longest))).round().long()
        drawn = _distinct(drawn.sort(dim=1).values, longest)
        ahead = torch.where(even, (stride * torch.arange(1, t + 1)).long(), drawn)
        span = ahead[:, -1].numpy()
        first = self._starts(span, ranges, generator)
        idx = torch.cat([first[:, None], first[:, None] + ahead], dim=1)
        times = ahead.float() * lag
        if self.weights is None or validation:
            return idx, times
        often = torch.from_numpy(self.weights < 1.0)
        for _ in range(_TRIES):
            again = ~often[first]
            first = torch.where(again, self._starts(span, ranges, generator), first)
        starts, found = self._likely_starts(span, ranges, generator)
        backwards = found & (torch.rand(n, generator=generator) < 0.5)
        idx = torch.cat([first[:, None], first[:, None] + ahead], dim=1)
        turned = starts[:, None] + ahead[:, -1:] - torch.cat([torch.zeros_like(ahead[:, :1]), ahead], dim=1)
        idx = torch.where(backwards[:, None], turned, idx)
        forgotten = torch.rand(n, 1, generator=generator) < _FORGOTTEN_SHARE
        anywhere = self._likely(n * t, generator).reshape(n, t)
        idx[:, 1:] = torch.where(forgotten, anywhere, idx[:, 1:])
        return idx, torch.where(forgotten, config.forgotten_ps, times)

    def _starts(self, span: npt.NDArray[np.int64], ranges: npt.NDArray[np.int64], generator: torch.Generator) -> Tensor:
        """Draw first frames `(n,)` of windows that reach `span` (n,) frames further, each as likely as any other."""
        rooms = np.maximum(np.diff(ranges, axis=1) - span, 0).cumsum(axis=0)
        place = torch.rand(len(span), generator=generator, dtype=torch.float64).numpy()
        at = (place * rooms[-1]).astype(np.int64)
        which = (rooms <= at).sum(axis=0)
        before = np.where(which > 0, rooms[which - 1, np.arange(len(span))], 0)
        return torch.from_numpy(ranges[which, 0] + at - before)

    def _likely_starts(
        self, span: npt.NDArray[np.int64], ranges: npt.NDArray[np.int64], generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw first frames `(n,)` by their weights, of windows that end where runs are less often than equilibrium;
        False `(n,)` where none was met."""
        assert self.weights is not None
        totals, members, rooms = self._likely_from
        first = np.zeros(len(span), dtype=np.int64)
        found = np.zeros(len(span), dtype=bool)
        for _ in range(_TRIES):
            rows = np.flatnonzero(~found)
            place = torch.rand(2, len(rows), generator=generator, dtype=torch.float64).numpy()
            for row, group, share in zip(rows, np.searchsorted(totals, place[0] * totals[-1]), place[1], strict=True):
                n = int(np.searchsorted(-rooms[group], -span[row]))
                if n:
                    first[row] = members[group][int(share * n)]
                    found[row] = self.weights[first[row] + span[row]] >= 1.0
        return torch.from_numpy(first), torch.from_numpy(found)

    @cached_property
    def _likely_from(
        self,
    ) -> tuple[npt.NDArray[np.float64], list[npt.NDArray[np.int64]], list[npt.NDArray[np.int64]]]:
        """Return the sums of weights of groups of frames alike, each group's frames, and how many follow each in its
        run, the most first.

        Rare states lie early in runs that start there, so frames with long runs behind them are no fair sample of all;
        within a group of one weight, which is one cell of the Markov model, they are.
        """
        assert self.weights is not None
        room = np.zeros(len(self.weights), dtype=np.int64)
        for low, high in self.frames.split.ranges(self.frames.starts, validation=False):
            room[low:high] = high - np.arange(low, high)
        values, group = np.unique(self.weights, return_inverse=True)
        kept = [np.flatnonzero(group == k) for k in range(len(values)) if values[k] > 0]
        members = [frames[np.argsort(-room[frames], kind="stable")] for frames in kept]
        sums = np.array([self.weights[frames].sum() for frames in members])
        return np.cumsum(sums), members, [room[frames] for frames in members]

    def _likely(self, n: int, generator: torch.Generator) -> Tensor:
        """Draw frames `(n,)` by their weights."""
        place = torch.rand(n, generator=generator, dtype=torch.float64).numpy()
        return torch.from_numpy(np.searchsorted(self._cumulative, place * self._cumulative[-1], side="right"))

    @cached_property
    def _cumulative(self) -> npt.NDArray[np.float64]:
        assert self.weights is not None
        return np.cumsum(self.weights)

    def batch(self, n: int, config: PeptideConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw windows as a flow sees them: half of the batches of whole chunks, the others of fewer frames.

        Returns frames and times as `windows` does. Some windows hold a change of a torsion's state: a flow that is told
        of it may see as many as it needs.
        """
        later = config.chunk_frames
        if float(torch.rand(1, generator=generator)) >= _WHOLE_SHARE:
            later = int(torch.randint(1, later + 1, (1,), generator=generator))
        idx, times = self.windows(n, config, generator, later=later)
        return self._with_crossings(idx, times, config, generator)

    def _with_crossings(
        self, idx: Tensor, times: Tensor, config: PeptideConfig, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Put windows over crossings in the place of some, their spacing kept; half are read backwards if any are.

        Read forwards, crossings need no weights. Backwards, the frame that the run came from must be as likely as
        equilibrium has it among those on its own side.
        """
        kinds, relative = self._crossings
        if not kinds:
            return idx, times
        asked = (torch.rand(len(idx), generator=generator) < _CROSSING_SHARE) & (times[:, 0] < config.forgotten_ps)
        backwards = torch.rand(len(idx), generator=generator) < (0.0 if self.weights is None else 0.5)
        ranges = np.array(self.frames.split.ranges(self.frames.starts, validation=False))
        for row in torch.nonzero(asked)[:, 0].tolist():
            ahead = (times[row] / self.frames.lag_ps).round().long()
            span = int(ahead[-1])
            draws = torch.rand(3, _TRIES, generator=generator, dtype=torch.float64).numpy()
            crossings = kinds[row % len(kinds)]
            first = crossings[(draws[0] * len(crossings)).astype(np.int64)] - (draws[1] * span).astype(np.int64)
            which = np.searchsorted(ranges[:, 0], first, side="right") - 1
            fits = (
                (first >= ranges[which.clip(min=0), 0]) & (first + span < ranges[which.clip(min=0), 1]) & (which >= 0)
            )
            if bool(backwards[row]):
                fits &= draws[2] < relative[first.clip(min=0)]
            if fits.any():
                start = int(first[fits][0])
                steps = torch.cat([ahead.new_zeros(1), ahead])
                idx[row] = start + (span - steps if bool(backwards[row]) else steps)
        return idx, times

    @cached_property
    def _crossings(self) -> tuple[list[npt.NDArray[np.int64]], npt.NDArray[np.float64]]:
        """Return the frames after which some phi changes its state, and those after which a side chain does, where
        there are any; and how likely each frame `(n_frames,)` is to be kept so that those of one pattern of phi are as
        in equilibrium, the likeliest (but for a few) always."""
        ranges = self.frames.split.ranges(self.frames.starts, validation=False)
        kinds = []
        for which in self._rare_torsions():
            moved = (np.diff(self._states[:, which[0], which[1]], axis=0) != 0).any(axis=1)
            kinds.append(np.concatenate([low + np.flatnonzero(moved[low : high - 1]) for low, high in ranges]))
        pattern = (self._states[:, :, 0] << np.arange(self._states.shape[1])).sum(axis=1)
        relative = np.ones(len(pattern))
        if self.weights is not None:
            for one in np.unique(pattern):
                inside = pattern == one
                kept = self.weights[inside & (self.weights > 0)]
                if len(kept):
                    relative[inside] = self.weights[inside] / np.quantile(kept, _LIKELIEST)
        return [some for some in kinds if len(some)], relative

    def _rare_torsions(self) -> list[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
        """Return residues and slots of phi, and those of heavy side chains: psi and rotors turn often enough."""
        stated = self.chain.stated.to(torch.device("cpu"))
        residue, slot = stated.residue.numpy(), stated.slot.numpy()
        rotor = np.array([self.frames.scene.elements[quad[0]] == "H" for quad in stated.quads.tolist()], dtype=bool)
        masks = (slot == 0, (slot >= FIRST_OF_SIDE_CHAIN) & ~rotor)
        return [(residue[which], slot[which]) for which in masks]

    def states(self, idx: Tensor) -> Tensor:
        """Return the states of torsions `(*idx.shape, n_residues, MOST_TORSIONS)` in frames."""
        return torch.from_numpy(self._states[idx.numpy()]).long()

    def seen(self, model: PeptideSlide, idx: Tensor) -> tuple[Tensor, Tensor]:
        """Return the model's numbers `(*idx.shape, n_residues, n_slots)` of frames, and the states of their torsions,
        `(*idx.shape, n_residues, MOST_TORSIONS)`."""
        frames = torch.from_numpy(self.frames.positions_nm(idx.numpy())).to(model.token_mean.device)
        return model.normalised(frames, self.chain)


def _distinct(ahead: Tensor, longest: int) -> Tensor:
    """Return ascending whole numbers `(n, t)` from 1 to `longest`, each once in its row, near those given."""
    found = ahead.clone()
    for k in range(1, found.shape[1]):
        found[:, k] = torch.maximum(found[:, k], found[:, k - 1] + 1)
    top = torch.arange(longest - found.shape[1] + 1, longest + 1)
    return torch.minimum(found, top)
