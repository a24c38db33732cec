"""One peptide in training: its frames, how likely each is in equilibrium, and the windows drawn from them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data import TrainingFrames
from surrogate.models.peptides.chains import FIRST_OF_SIDE_CHAIN, MOST_TORSIONS, ChainFeatures
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.model import PeptideSlide
from systems.errors import InputError
from systems.scene import FloatArray, IntArray

# Weights that turn frames of short runs from chosen starts into equilibrium, by a reversible Markov model. Forward
# windows need none, whatever they start from: a propagator is conditional. A window read backwards does: it starts
# where a run ended up, so that exits from a rare state become entries, as many as there are seeds. Weighted by how
# likely equilibrium is to be where the run came from, there are as many as detailed balance asks for (Wu et al., Proc.
# Natl. Acad. Sci. 113, E3221 (2016)).


_CELLS = 150
_FRAMES_A_CELL = 30
_CLUSTERED_FRAMES = 20_000
_DIMENSIONS = 6
# No frame counts more than so many average ones: a cell hardly visited would otherwise be drawn over and over.
_LARGEST = 20.0
# How many jumps between any two frames each run stands for, its beginning and its end; a frame's probabilities to take
# part grow with this power of its place in its run.
_JUMPS_A_RUN, _LATE = 2.0, 2
# Where a Markov model fails, cells whose frames come so many times later than the earliest cell's, or less, weigh
# nothing.
_LEFT = 3.0
_CONVERGED, _MOST_ITERATIONS = 1e-6, 20_000
_CLUSTER_SEED = 1


def equilibrium_weights(
    runs: Sequence[FloatArray], lag_frames: int, *, states: IntArray | None = None, shares: FloatArray | None = None
) -> FloatArray | None:
    """Return a weight for each frame, of mean 1, in the order of the runs. None for runs too short for the lag.

    `runs`: features `(n, k)` that separate slow states (cosines and sines of torsions), one array for each run.
    Populations from elsewhere (metadynamics) are given by `states` (n_frames,), the state of each frame, and `shares`
    (n_states,), which need no norm: between states these weigh frames, within each the Markov model does.

    Where hardly any run goes between two states, a Markov model would put all weight into one that by chance was
    entered and not left. So each run is taken to begin and to end with a jump between any two frames, late frames
    (relaxed ones) more likely. TICA, k-means and the reversible maximum-likelihood model (Trendelkamp-Schroer et al.,
    J. Chem. Phys. 143, 174101 (2015)) are deeptime's.
    """
    cells = _cells(runs, lag_frames)
    if cells is None:
        return None
    weights = _of_cells(cells, lag_frames)[np.concatenate(cells)]
    if states is not None and shares is not None:
        total = np.bincount(states, weights=weights, minlength=len(shares))
        weights = weights * (shares / np.maximum(total, 1e-12))[states]
    weights = np.minimum(weights / weights.mean(), _LARGEST)
    return np.asarray(weights / weights.mean(), dtype=np.float64)


def _cells(runs: Sequence[FloatArray], lag_frames: int) -> list[npt.NDArray[np.int32]] | None:
    """Return the cell of each frame of each run, by k-means in the slow subspace; None for too few frames."""
    from deeptime.clustering import KMeans
    from deeptime.decomposition import TICA

    long_enough = [x for x in runs if len(x) > lag_frames]
    if sum(len(x) - lag_frames for x in long_enough) < 2 * _FRAMES_A_CELL:
        return None
    covariance = TICA.covariance_estimator(lagtime=lag_frames)
    for x in long_enough:
        covariance.partial_fit((x[:-lag_frames], x[lag_frames:]))
    slow = TICA(lagtime=lag_frames, dim=_DIMENSIONS, scaling="kinetic_map").fit_from_covariances(covariance)
    projected = [np.ascontiguousarray(slow.fetch_model().transform(x)) for x in runs]
    every = np.concatenate(projected)
    n_cells = max(2, min(_CELLS, len(every) // _FRAMES_A_CELL))
    sample = every[:: max(1, len(every) // _CLUSTERED_FRAMES)]
    cells = KMeans(n_cells, max_iter=100, fixed_seed=_CLUSTER_SEED, n_jobs=1).fit(sample).fetch_model()
    return [cells.transform(x, n_jobs=1).astype(np.int32) for x in projected]


def _of_cells(cells: Sequence[npt.NDArray[np.int32]], lag_frames: int) -> FloatArray:
    """Return what a frame of each cell weighs `(n_cells,)`."""
    from deeptime.markov import TransitionCountEstimator

    counted = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding", sparse=False).fit(list(cells))
    counts = np.asarray(counted.fetch_model().count_matrix, dtype=np.float64)
    lateness = np.concatenate([(np.arange(1, len(x) + 1) / len(x)) ** _LATE for x in cells])
    late = np.asarray(np.bincount(np.concatenate(cells), weights=lateness, minlength=len(counts)), dtype=np.float64)
    # Transitions are counted once at each frame of the lag, and so are the jumps.
    counts += _JUMPS_A_RUN * len(cells) * lag_frames * np.outer(late, late) / late.sum() ** 2
    visited, found = np.flatnonzero(late > 0), None
    while found is None:
        try:
            found = _stationary(counts[np.ix_(visited, visited)])
        except RuntimeError:
            # States that runs begin in and leave at once, one after the other, are unlikely beyond what numbers hold.
            visited = visited[late[visited] > _LEFT * late[visited].min()]
    n_frames = np.bincount(np.concatenate(cells), minlength=len(counts))
    weights = np.zeros(len(counts))
    weights[visited] = found / n_frames[visited]
    return weights


def _stationary(counts: FloatArray) -> FloatArray:
    """Return the stationary distribution `(n,)` of the reversible Markov model of counts `(n, n)`. Raises RuntimeError
    where parts of it underflow."""
    from deeptime.markov import TransitionCountModel
    from deeptime.markov.msm import MaximumLikelihoodMSM
    from deeptime.util.exceptions import NotConvergedWarning

    with warnings.catch_warnings():
        # What is left to converge after so many iterations is nothing beside the scatter of counts.
        warnings.simplefilter("ignore", NotConvergedWarning)
        model = MaximumLikelihoodMSM(reversible=True, maxerr=_CONVERGED, maxiter=_MOST_ITERATIONS)
        found = model.fit(TransitionCountModel(counts)).fetch_model().stationary_distribution
    return np.asarray(found, dtype=np.float64)


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
    """One sequence's frames and input features. `weights` (n_frames,): of frames in equilibrium, of mean 1 where they
    are kept, zero in what is held out. Without them no window is read backwards."""

    frames: TrainingFrames
    chain: ChainFeatures
    weights: FloatArray | None = None

    def in_equilibrium(self, positive_phi_kt: Mapping[str, float]) -> PeptideSubject:
        """Return this subject with weights, or itself where its runs do not show how likely its states are."""
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

    def _signs_of_phi(self, kept: IntArray, positive_phi_kt: Mapping[str, float]) -> tuple[IntArray, FloatArray]:
        """Return the pattern of phi's signs of each frame `kept` (n,), as a number, and the population of each pattern:
        residues are taken to be independent, and those whose free energy is not given play no part."""
        states, shares = np.zeros(len(kept), dtype=np.int64), np.ones(1)
        for residue in self.chain.signed:
            name = self.frames.scene.residue_names[residue]
            if name in positive_phi_kt:
                states = states + len(shares) * self._states[kept, residue, 0]
                probabilities = float(np.exp(-positive_phi_kt[name]))
                shares = np.concatenate([shares, shares * probabilities])
        return states, shares

    @cached_property
    def _states(self) -> npt.NDArray[np.int8]:
        """The states of torsions in each frame: `(n_frames, n_residues, MOST_TORSIONS)`."""
        blocks = self._blocks(0, self.frames.n_frames)
        return torch.cat([self.chain.states(block).to(torch.int8).cpu() for block in blocks]).numpy()

    def _blocks(self, low: int, high: int) -> Iterator[Tensor]:
        for start in range(low, high, _BLOCK):
            idx = np.arange(start, min(start + _BLOCK, high))
            yield torch.from_numpy(self.frames.positions_nm(idx)).to(self.chain.places.device)

    def _torsions(self, low: int, high: int) -> FloatArray:
        """Return cosines and sines `(n, 2 n_torsions)` of frames."""
        at = self.chain.code.turning_at
        both = torch.cat([at, at + 1])
        found = [self.chain.code.encode(block).flatten(-2)[:, both].cpu() for block in self._blocks(low, high)]
        return torch.cat(found).double().numpy()

    def windows(
        self, n: int, config: PeptideConfig, generator: torch.Generator, *, later: int | None = None,
        validation: bool = False,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Draw windows: frames `(n, 1 + later)` of one stretch and the times `(n, later)` ps after the first; `later`
        is `chunk_frames` where it is not given.

        Times are evenly spaced at a lag drawn evenly in its logarithm, or drawn one by one in the same way. With
        weights half of the windows are read backwards, and in some the later frames are any of equilibrium,
        `forgotten_ps` after the first. Windows start from states that runs hold more often than equilibrium does as
        they are read forwards, from others backwards: from a common state runs hardly enter rare ones, and averaged
        with windows that do they would halve the rate.
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

    def _starts(self, span: IntArray, ranges: IntArray, generator: torch.Generator) -> Tensor:
        """Draw first frames `(n,)` of windows that reach `span` (n,) frames further, each as likely as any other."""
        rooms = np.maximum(np.diff(ranges, axis=1) - span, 0).cumsum(axis=0)
        place = torch.rand(len(span), generator=generator, dtype=torch.float64).numpy()
        at = (place * rooms[-1]).astype(np.int64)
        which = (rooms <= at).sum(axis=0)
        before = np.where(which > 0, rooms[which - 1, np.arange(len(span))], 0)
        return torch.from_numpy(ranges[which, 0] + at - before)

    def _likely_starts(self, span: IntArray, ranges: IntArray, generator: torch.Generator) -> tuple[Tensor, Tensor]:
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
    def _likely_from(self) -> tuple[FloatArray, list[IntArray], list[IntArray]]:
        """Return the sums of weights of groups of frames of one weight, each group's frames, and how many follow each
        in its run, the most first. Only within a group (a cell of the Markov model) are frames with long runs behind
        them a fair sample: rare states lie early in runs that start there."""
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

    def in_turn(self, n: int, ahead: int, generator: torch.Generator) -> tuple[Tensor, float]:
        """Draw frames `(n,)` by their weights, those that as many as `ahead` follow in their run, none where none has;
        and return how many windows of that length, one after the other, tell as much as all such frames."""
        assert self.weights is not None
        try:
            starts = torch.from_numpy(self.frames.window_starts(ahead + 1, validation=False))
        except InputError:
            return torch.zeros(0, dtype=torch.long), 0.0
        likely = torch.from_numpy(self.weights)[starts]
        if not likely.sum() > 0:
            return starts[:0], 0.0
        alike = float(likely.sum() ** 2 / likely.square().sum())
        return starts[torch.multinomial(likely, n, True, generator=generator)], alike / ahead

    @cached_property
    def _cumulative(self) -> FloatArray:
        return np.cumsum(cast(FloatArray, self.weights))

    def batch(self, n: int, config: PeptideConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw windows as `windows` does: half of the batches of whole chunks, the others of fewer frames. Some hold a
        change of a torsion's state: a flow conditioned on it may see as many as it needs."""
        later = config.chunk_frames
        if float(torch.rand(1, generator=generator)) >= _WHOLE_SHARE:
            later = int(torch.randint(1, later + 1, (1,), generator=generator))
        idx, times = self.windows(n, config, generator, later=later)
        return self._with_crossings(idx, times, config, generator)

    def _with_crossings(
        self, idx: Tensor, times: Tensor, config: PeptideConfig, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Put windows over crossings in the place of some, their spacing kept; half are read backwards if any are: then
        the frame that the run came from must be as likely as equilibrium has it among those on its own side."""
        crossings, relative = self._crossings
        if not crossings:
            return idx, times
        asked = (torch.rand(len(idx), generator=generator) < _CROSSING_SHARE) & (times[:, 0] < config.forgotten_ps)
        backwards = torch.rand(len(idx), generator=generator) < (0.0 if self.weights is None else 0.5)
        ranges = np.array(self.frames.split.ranges(self.frames.starts, validation=False))
        for row in torch.nonzero(asked)[:, 0].tolist():
            ahead = (times[row] / self.frames.lag_ps).round().long()
            span = int(ahead[-1])
            draws = torch.rand(3, _TRIES, generator=generator, dtype=torch.float64).numpy()
            some = crossings[row % len(crossings)]
            first = some[(draws[0] * len(some)).astype(np.int64)] - (draws[1] * span).astype(np.int64)
            which = np.searchsorted(ranges[:, 0], first, side="right") - 1
            low, high = ranges[which.clip(min=0)].T
            fits = (first >= low) & (first + span < high) & (which >= 0)
            if bool(backwards[row]):
                fits &= draws[2] < relative[first.clip(min=0)]
            if fits.any():
                start = int(first[fits][0])
                steps = torch.cat([ahead.new_zeros(1), ahead])
                idx[row] = start + (span - steps if bool(backwards[row]) else steps)
        return idx, times

    @cached_property
    def _crossings(self) -> tuple[list[IntArray], FloatArray]:
        """Return the frames after which some phi changes its state, and those after which a side chain does, where
        there are any; and how likely each frame `(n_frames,)` is to be kept so that those of one pattern of phi are as
        in equilibrium, the likeliest (but for a few) always."""
        ranges = self.frames.split.ranges(self.frames.starts, validation=False)
        crossings = []
        for which in self._rare_torsions():
            moved = (np.diff(self._states[:, which[0], which[1]], axis=0) != 0).any(axis=1)
            crossings.append(np.concatenate([low + np.flatnonzero(moved[low : high - 1]) for low, high in ranges]))
        pattern = (self._states[:, :, 0] << np.arange(self._states.shape[1])).sum(axis=1)
        relative = np.ones(len(pattern))
        if self.weights is not None:
            for one in np.unique(pattern):
                inside = pattern == one
                kept = self.weights[inside & (self.weights > 0)]
                if len(kept):
                    relative[inside] = self.weights[inside] / np.quantile(kept, _LIKELIEST)
        return [some for some in crossings if len(some)], relative

    def _rare_torsions(self) -> list[tuple[IntArray, IntArray]]:
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


# Windows from which the probabilities of changes of states are learned: what is rare is drawn more often than it
# occurs. Rare starts may be, since probabilities are conditional on them; rare changes, and windows chosen for another
# torsion's sake, if each then counts less in the loss, in proportion.

_POOL = 16_384
# Changes are to be in this share of the windows that could hold them; nothing is drawn more than so much too often.
_SOUGHT, _MOST = 0.05, 50.0
# Of all windows, those drawn so; the others are drawn evenly, so that none counts many times.
_FOR_RARE = 0.6
_POOL_SEED = 0


class StateWindows(NamedTuple):
    """Windows of one sequence: frames `idx` (n, 1 + t), `times_ps` (n, t), how likely each is drawn, summed up (n,),
    and what it then counts for each torsion, `share` (n, n_residues, MOST_TORSIONS)."""

    idx: Tensor
    times_ps: Tensor
    cumulative: Tensor
    share: Tensor

    @staticmethod
    def of(subject: PeptideSubject, config: PeptideConfig) -> StateWindows:
        """Return windows drawn as `PeptideSubject.windows` does, and their probabilities."""
        idx, times = subject.windows(_POOL, config, torch.Generator().manual_seed(_POOL_SEED))
        stated = subject.chain.stated
        states = subject.states(idx)[..., stated.residue.cpu(), stated.slot.cpu()]
        started = balanced_starts(states[:, 0])
        probabilities = rare_changes(states) * started.max(dim=1).values
        probabilities = 1.0 - _FOR_RARE + _FOR_RARE * probabilities / probabilities.mean()
        share = torch.zeros(len(idx), stated.n_residues, MOST_TORSIONS)
        share[:, stated.residue, stated.slot] = (
            probabilities.sum() / started.sum(0) * started / probabilities[:, None]
        ).float()
        return StateWindows(idx, times, probabilities.cumsum(0), share)

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Return frames `(n, 1 + t)`, times `(n, t)` ps and what each counts `(n, n_residues, MOST_TORSIONS)`."""
        place = torch.rand(n, generator=generator, dtype=torch.float64) * self.cumulative[-1]
        at = torch.searchsorted(self.cumulative, place, right=True).clamp(max=len(self.cumulative) - 1)
        return self.idx[at], self.times_ps[at], self.share[at]


def balanced_starts(first: Tensor) -> Tensor:
    """States `(n, torsions)` that windows start from -> how much more often `(n, torsions)`, float64, each should be
    drawn for the rarer states of a torsion to be as frequent as its others."""
    probabilities = torch.ones(first.shape, dtype=torch.float64)
    for k in range(first.shape[1]):
        _, which, counts = first[:, k].unique(return_inverse=True, return_counts=True)
        probabilities[:, k] = (len(first) / (len(counts) * counts.double()))[which]
    return probabilities.clamp(1.0, _MOST)


def rare_changes(states: Tensor) -> Tensor:
    """States `(n, 1 + t, torsions)` of windows -> how much more often `(n,)`, float64, each should be drawn for the
    rarest change from one state to another that it holds."""
    found = torch.ones(len(states), dtype=torch.float64)
    before, after = states[:, :-1], states[:, 1:]
    n_states = int(states.max()) + 1 if states.numel() else 0
    for one in range(n_states):
        for other in range(n_states):
            if one == other:
                continue
            held = ((before == one) & (after == other)).any(1)  # (n, torsions)
            could = (before == one).any(1).sum(0)
            wanted = (_SOUGHT * could / held.sum(0).clamp(min=1)).clamp(1.0, _MOST).double()
            found = torch.maximum(found, torch.where(held, wanted, 1.0).max(1).values)
    return found
