"""Equilibrium from many short MD replicas: a reversible Markov model of their transitions, or plain averages.

Replicas that are shorter than the slowest relaxation remember where they began, so their plain averages are wrong; the
transitions between states are not. A reversible maximum-likelihood Markov model turns transition counts into
stationary populations, and these into a weight for every frame (Prinz et al., J. Chem. Phys. 134, 174105 (2011)).
Where they are few, plain averages count beside them. Nothing is invented: what transitions do not connect in both
directions gets no weight and is named.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from surrogate.comparison.measure.kinetics import block_transitions
from surrogate.comparison.measure.statistics import Blocks, BoolArray, FloatArray, IntArray, Piece
from systems.errors import InputError

_N_DRAWS, _FLAT_DRAWS = 50, 20
# Of the likelihood's fixed point: change of log populations in a step at its end; change of populations, which is
# enough for a draw, and after most steps: what hardly weighs anything is found last; longest jumps, in steps and in log
# populations.
_STEP_TOLERANCE, _SETTLED, _MOST_STEPS, _FURTHEST, _LONGEST_JUMP = 1e-9, 1e-9, 5_000, 1e6, 20.0
# Numbers in the matrices that are searched for together: more no longer fit into a processor's own memory.
_AT_ONCE = 32_768
_LAGS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
# A lag leaves each replica four pairs that do not overlap.
_LAGS_A_REPLICA = 4
# Timescales are flat where no longer lag adds more than this, or two standard errors, to the logarithm of the slowest.
_FLAT = 0.15
_CK_MULTIPLES = (2, 3)
_CK_TOLERANCE = 0.05
# Replicas outlast the slowest process when they are so many times as long; three of these are left out at their start.
_OUTLASTS, _LEFT_OUT = 20.0, 3.0
_LEAST_UNITS = 8
# Of a replica of a rollout that is a prior; a piece holds hardly more than one crossing.
_PRIOR_PIECES, _LEAST_DRAWN, _SLOW_LAGS = 32, 0.05, 5.0
# What averages over frames of connected states count for beside transitions: crossings of a slow process at most.
_AVERAGES_CROSSINGS = 4.0
# Fewer transitions of a slow process, in its rarer direction, tell no populations, but of what it leads to and has a
# share no larger than this: that is off by a factor, and all else hardly.
_LEAST_CROSSINGS, _RARE = 5, 0.05
# What has fewer frames than this share is not named as missing.
_NAMED_SHARE = 0.005

# Transition matrix, stationary distribution, and the states that they are of.
_Fitted = tuple[FloatArray, FloatArray, IntArray]
Fate = Literal["only begun in", "entered and never left", "begun in and not always left", "left and never entered"]


class Unconnected(NamedTuple):
    """States that transitions do not connect with the others in both directions: which microstates, their share of
    all frames, in how many replicas, and what happened there."""

    microstates: tuple[int, ...]
    share: float
    n_replicas: int
    fate: Fate


class Rare(NamedTuple):
    """States of a small share: which microstates, and how often MD entered or left them, in the rarer direction."""

    microstates: tuple[int, ...]
    crossings: int


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """What MD says of equilibrium.

    `method`: how it was found; `lag_frames`: of the Markov model; `timescales`, `timescale_errors` `(k,)` in frames,
    descending; `flat`: whether the slowest is the same at a longer lag; `ck_error`: the largest difference between
    predicted and observed probabilities to be where one was (Chapman-Kolmogorov), `ck_holds` whether that is within
    errors; `crossings`: how often the slowest process was seen, in the rarer direction. `populations` `(n_micro,)`, 0
    outside the connected set; `draws` `(n_draws, n_micro)` of a bootstrap over replicas, whose multiplicities are
    `resampled` `(n_draws, n_units)`; `unit_of` says for each unit which replica and which frames it is. `weights`: of
    every frame, one array a replica, mean 1 over all. `unconnected`: what has no weight; `rare`: what has little and
    was entered and left a few times, more slowly than all else; `seen`: whether what is as slow and not rare was seen
    often enough. `n_own`: how many replicas are MD; those behind are images of them.
    """

    method: Literal["Markov model", "plain averages"]
    lag_frames: int
    timescales: FloatArray
    timescale_errors: FloatArray
    flat: bool
    ck_error: float
    ck_holds: bool
    crossings: int
    populations: FloatArray
    draws: FloatArray
    resampled: IntArray
    unit_of: tuple[tuple[int, int, int], ...]
    weights: tuple[FloatArray, ...]
    unconnected: tuple[Unconnected, ...]
    n_own: int
    rare: tuple[Rare, ...] = ()
    seen: bool = True

    @property
    def holds(self) -> bool:
        """Whether the model passed its tests and rests on more than a few transitions; plain averages need none."""
        return self.method == "plain averages" or (self.flat and self.ck_holds and self.seen)

    def shares(
        self, micro: Sequence[IntArray], labels: Sequence[IntArray], n: int, factors: Sequence[FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the equilibrium share `(n,)` of each label and its bootstrap draws `(n_draws, n)`.

        `micro`: what `equilibrium` was given; `labels`: a label 0 to n - 1 for each frame, -1 for none; `factors`: by
        which each frame counts in another law than it was made by, NaN where that is not known.
        """
        n_micro = len(self.populations)
        counts = np.zeros((2, len(self.unit_of), n_micro, n))
        for u, (k, start, stop) in enumerate(self.unit_of):
            m, s = micro[k][start:stop], labels[k][start:stop]
            by = np.ones(len(m)) if factors is None else factors[k][start:stop]
            known = (self.weights[k][start:stop] > 0) & (m >= 0) & (s >= 0) & np.isfinite(by)
            cells = m[known] * n + s[known]
            for of, each in zip(counts, (by[known], None), strict=True):
                of[u] = np.bincount(cells, each, minlength=n_micro * n).reshape(n_micro, n)
        draws = [_spread(p, *np.tensordot(counts, r, (1, 0))) for p, r in zip(self.draws, self.resampled, strict=True)]
        return _spread(self.populations, *counts.sum(1)), np.array(draws).reshape(-1, n)


def _spread(populations: FloatArray, weighted: FloatArray, counts: FloatArray) -> FloatArray:
    """Return populations of labels from those of microstates `(n_micro,)`, and the weight and the number of frames
    `(n_micro, n)`."""
    total = counts.sum(1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.nansum(populations[:, None] * np.where(total > 0, weighted / total, np.nan), axis=0)
    norm = found.sum()
    return np.asarray(found / norm if norm > 0 else found)


def equilibrium(micro: Sequence[IntArray], *, lag: int | None = None, seed: int = 0) -> Equilibrium:
    """Return the equilibrium of MD replicas whose frames were put into microstates.

    `micro`: one array `(n_frames,)` a replica of microstates from 0, -1 for none, frames equally far apart; `lag`: in
    frames, None for the shortest at which the slowest timescale is flat. Where every replica is twenty times as long as
    the slowest process, plain averages. Raises InputError where there is nothing to count.
    """
    micro = [np.asarray(m, dtype=np.int64) for m in micro]
    if max((int(m.max()) for m in micro), default=-1) < 0:
        raise InputError("there are no frames in any state, and so no equilibrium to tell; give longer replicas.")
    n_micro = 1 + max(int(m.max()) for m in micro)
    rng = np.random.default_rng(seed)
    longest = max(1, int(np.median([len(m) for m in micro])) // _LAGS_A_REPLICA)
    lags = [n for n in _LAGS if n <= longest] if lag is None else [lag]
    units = _units(micro, lags[-1], -(-_LEAST_UNITS // len(micro)))
    resampled = rng.multinomial(len(units), np.full(len(units), 1.0 / len(units)), size=_N_DRAWS)
    models = []
    for n in lags:
        with suppress(InputError):
            models.append(_Model(micro, units, n_micro, n))
    if not models:
        raise InputError("no reversible Markov model fits the transitions; give longer replicas.")
    chosen, flat = _choose(models, resampled)
    model = models[chosen]
    times = _drawn_times(model, resampled)
    averages = _Averages(model, micro, units)

    def found_by(of: Sequence[tuple[FloatArray, _Averages]], settled: float = _SETTLED) -> FloatArray:
        counts = [beside.beside(np.tensordot(m, model.by_unit, 1), m) for m, beside in of]
        fits = [_populations(fitted, n_micro) for fitted in _fits(counts, settled)]
        return np.array([model.populations if p is None else p for p in fits])

    populations = found_by([(np.ones(len(units)), averages)], 0.0)[0]
    draws = found_by([(m, averages.shifted(rng)) for m in resampled])
    rare, seen = _rare(model, micro, populations)
    for of in rare:
        draws[:, of.microstates] *= np.exp(math.sqrt(2.0 / of.crossings) * rng.normal(size=(len(draws), 1)))
        draws /= draws.sum(1, keepdims=True)
    with warnings.catch_warnings():  # of a process that is in no draw
        warnings.simplefilter("ignore", RuntimeWarning)
        errors = np.nanstd(times, axis=0, ddof=1)
    slowest = float(model.times[0]) if len(model.times) else 0.0
    n_frames = np.array([len(m) for m in micro])
    unconnected = _unconnected(model, micro)
    lost = any(u.fate != "left and never entered" for u in unconnected)
    ck_error, ck_holds = _chapman_kolmogorov(model, micro, units, resampled[:20])
    found = Equilibrium(
        "Markov model", model.lag, model.times, errors, flat, ck_error, ck_holds, model.crossings(micro),
        populations, draws, resampled, tuple(units), (), unconnected, len(micro), rare, seen,
    )  # fmt: skip
    if n_frames.min() >= _OUTLASTS * slowest and not lost and found.crossings > 0:
        return _averaged(found, micro, round(_LEFT_OUT * slowest))
    visits = sum(np.bincount(m[m >= 0], minlength=n_micro) for m in micro)
    with np.errstate(divide="ignore", invalid="ignore"):
        each = np.append(np.where(visits > 0, populations / visits, 0.0), 0.0)
    return replace(found, weights=with_mean_one([each[m] for m in micro]))


def with_images(found: Equilibrium, micro: Sequence[IntArray], hands: Sequence[BoolArray]) -> Equilibrium:
    """Return the same of replicas and, behind them, their mirror images, which are as likely.

    `micro`: of frames that were brought to one hand; `hands`: which of them the replicas have in the other. An image is
    in the microstate of its frame; frames of either hand, where there are both, weigh as much, and so do all frames of
    either hand, also where some microstates were seen in one alone.
    """
    n = 2 * len(found.populations)
    cells = [np.where(m < 0, n, 2 * m + h) for m, h in zip(micro, hands, strict=True)]
    each = np.bincount(np.concatenate(cells), np.concatenate(found.weights), n + 1)[:n].reshape(-1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = each.sum(1, keepdims=True) / (each * (each > 0).sum(1, keepdims=True))
    factor = np.append(np.where(each > 0, factor, 0.0).ravel(), 0.0)
    weights = tuple(w * factor[c] for w, c in zip(found.weights, cells, strict=True))
    either = np.bincount(np.concatenate(hands), np.concatenate(weights), 2)
    if (either > 0).all():
        weights = tuple(w / either[h.astype(int)] for w, h in zip(weights, hands, strict=True))
    return replace(
        found, unit_of=(*found.unit_of, *((k + len(micro), a, b) for k, a, b in found.unit_of)),
        resampled=np.hstack([found.resampled] * 2), weights=with_mean_one(weights) * 2,
    )  # fmt: skip


def with_prior(
    found: Equilibrium, micro: Sequence[IntArray], prior: Sequence[IntArray], *, crossings: float, seed: int = 0
) -> Equilibrium:
    """Return the equilibrium of MD whose transitions count together with those of a surrogate's rollout.

    `micro`, `prior`: microstates of MD's frames, the same replicas as `found` is of, and of the rollout's, in one
    numbering. The rollout's counts are scaled so that they are worth so many `crossings` of whichever of its five
    slowest processes it saw most often, and fewer of the others: a Dirichlet prior of transition probabilities. By the
    slowest, which may have been seen once, a long rollout would outweigh MD in all others. What MD sees often is MD's;
    what it hardly sees is the surrogate's. Draws resample MD's replicas, and pieces of the rollout with weights of mean
    and variance of that scale. Segments of the rollout stand behind MD's; their frames count where MD has none. Raises
    InputError where no model fits.
    """
    n, lag = 1 + max(int(m.max()) for m in (*micro, *prior)), found.lag_frames
    of_md, of_prior = list(found.unit_of), _units(list(prior), lag, _PRIOR_PIECES)
    by_unit = np.concatenate([_counts(list(m), u, n, lag) for m, u in ((micro, of_md), (prior, of_prior))])
    seen = _Model(list(prior), of_prior, n, lag).most_crossings(list(prior))
    scale = min(1.0, crossings / max(seen, 1))
    rng = np.random.default_rng(seed)
    drawn = np.maximum(rng.gamma(scale, size=(len(found.resampled), len(of_prior))), _LEAST_DRAWN * scale)
    multiplicity = np.hstack([found.resampled, drawn])
    n_md = len(of_md)

    def counts(each: FloatArray) -> FloatArray:
        md, rolled = (np.tensordot(each[part], by_unit[part], 1) for part in (slice(n_md), slice(n_md, None)))
        return _ended(md) + rolled

    all_units = _populations(_fit(counts(np.r_[np.ones(n_md), np.full(len(of_prior), scale)])), n)
    fits = [_populations(fitted, n) for fitted in _fits([counts(m) for m in multiplicity], _SETTLED)]
    draws = [(m, p) for m, p in zip(multiplicity, fits, strict=True) if p is not None]
    if all_units is None or not draws:
        raise InputError("no reversible Markov model fits the transitions of MD and of the rollout.")
    visits = [sum(np.bincount(m[m >= 0], minlength=n) for m in of) for of in (micro, prior)]
    with np.errstate(divide="ignore", invalid="ignore"):
        own = np.where(visits[0] > 0, all_units / visits[0], 0.0)
        other = np.where((visits[0] == 0) & (visits[1] > 0), all_units / visits[1], 0.0)
    weights = [np.append(of, 0.0)[m] for of, some in ((own, micro), (other, prior)) for m in some]
    return replace(
        found, method="Markov model", populations=all_units, draws=np.array([p for _, p in draws]),
        resampled=np.array([m for m, _ in draws]), unit_of=(*of_md, *((len(micro) + k, a, b) for k, a, b in of_prior)),
        weights=with_mean_one(weights),
    )  # fmt: skip


def _ended(counts: FloatArray) -> FloatArray:
    """Return MD's counts in which visits that none has ended end once: to states that were entered and never left one
    count out, in the proportions in which they were entered."""
    out = counts.copy()
    labels = _components(counts)
    for component in np.unique(labels[labels > 0]):
        inside = labels == component
        entered = counts[np.ix_(~inside, inside)]
        if entered.any() and not counts[np.ix_(inside, ~inside)].any():
            out[np.ix_(inside, ~inside)] = entered.T / entered.sum()
    return out


def with_mean_one(weights: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Return weights of frames, an array a replica, so that their mean is one."""
    mean = sum(w.sum() for w in weights) / sum(map(len, weights))
    return tuple(w / mean for w in weights)


def _averaged(found: Equilibrium, micro: list[IntArray], left_out: int) -> Equilibrium:
    """Return plain averages over all frames behind the first `left_out` of each replica, but for those in states that
    were left for good."""
    n_micro = len(found.populations)
    counted = np.append(found.populations > 0.0, False)
    weights = [((np.arange(len(m)) >= left_out) & counted[m]).astype(np.float64) for m in micro]
    counts = np.array([
        np.bincount(micro[k][a:b][weights[k][a:b] > 0], minlength=n_micro) for k, a, b in found.unit_of
    ], dtype=np.float64)  # fmt: skip
    draws = found.resampled @ counts
    draws /= np.maximum(draws.sum(1, keepdims=True), 1.0)
    total = counts.sum(0)
    averaged = replace(found, method="plain averages", populations=total / total.sum(), draws=draws, rare=())
    return replace(averaged, weights=with_mean_one(weights))


def _units(micro: list[IntArray], lag: int, pieces: int) -> list[tuple[int, int, int]]:
    """Return what a bootstrap draws from: replicas, or up to so many pieces of each where they are few."""
    units = []
    for k, m in enumerate(micro):
        n = max(1, min(pieces, len(m) // (2 * lag)))
        edges = np.linspace(0, len(m), n + 1).astype(int).tolist()
        units += [(k, a, b) for a, b in pairwise(edges)]
    return units


def _counts(micro: list[IntArray], units: list[tuple[int, int, int]], n: int, lag: int) -> FloatArray:
    """Return sliding transition counts `(n_units, n, n)` at a lag; a pair belongs to where it begins."""
    pieces = tuple(Piece(k, start, stop, u) for u, (k, start, stop) in enumerate(units))
    return block_transitions(micro, Blocks(pieces, len(units), 0), n, lag).reshape(-1, n, n)


def _components(counts: FloatArray) -> IntArray:
    """Return for each state which strongly connected set it is in; 0 is the one with most counts."""
    if (counts > 0).all():
        return np.zeros(len(counts), dtype=np.int64)
    n, labels = _connected((counts > 0).tobytes(), len(counts))
    weight = np.bincount(labels, weights=counts.sum(0) + counts.sum(1), minlength=n)
    rank = np.empty(n, dtype=np.int64)
    rank[np.argsort(-weight, kind="stable")] = np.arange(n)
    return np.asarray(rank[labels])


@lru_cache(64)  # draws of the same replicas mostly have the same transitions
def _connected(edges: bytes, n: int) -> tuple[int, IntArray]:
    """Return how many strongly connected sets there are, and in which each state is, of `(n, n)` flags."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    graph = csr_array(np.frombuffer(edges, dtype=np.bool_).reshape(n, n))
    found, labels = connected_components(graph, directed=True, connection="strong")
    return int(found), labels


def _fit(counts: FloatArray) -> _Fitted | None:
    """Return transition matrix and stationary distribution of the largest connected set, and its states; None where
    there is none, or the estimate does not converge."""
    return _fits([counts])[0]


def _fits(counts: Sequence[FloatArray], settled: float = 0.0) -> list[_Fitted | None]:
    """Return the same of many counts `(n, n)`: those of the same connected set are searched for together."""
    found: list[_Fitted | None] = [None] * len(counts)
    alike: dict[tuple[int, ...], list[int]] = {}
    for i, c in enumerate(counts):
        inside = np.flatnonzero((_components(c) == 0) & (c.sum(0) + c.sum(1) > 0))
        alike.setdefault(tuple(inside.tolist()), []).append(i)
    for states, members in alike.items():
        kept = np.array(states, dtype=np.int64)
        if len(kept) == 1:
            for i in members:
                found[i] = np.ones((1, 1)), np.ones(1), kept
        elif len(kept):
            at_once = max(1, _AT_ONCE // len(kept) ** 2)
            for some in (members[k : k + at_once] for k in range(0, len(members), at_once)):
                each = reversible(np.array([counts[i][np.ix_(kept, kept)] for i in some]), settled)
                for i, of in zip(some, each, strict=True):
                    found[i] = None if of is None else (*of, kept)
    return found


def _populations(fitted: _Fitted | None, n: int) -> FloatArray | None:
    """Return populations `(n,)` of all states by a fit, None where there is none."""
    return None if fitted is None else np.asarray(np.bincount(fitted[2], fitted[1], n), float)


def reversible(counts: FloatArray, settled: float = 0.0) -> list[tuple[FloatArray, FloatArray] | None]:
    """Return for each of some counts `(k, n, n)` that connect all states both ways the reversible transition matrix
    `(n, n)` of greatest likelihood, and its stationary distribution `(n,)`, or one whose populations change by less
    than `settled` in a step of its search; None where it is not found.

    The flux is x_ij = (c_ij + c_ji) / (c_i / x_i + c_j / x_j) with x_i its sum over j (Prinz et al., equation 30), here
    by fixed-point iteration in log x, sped up by squared extrapolation (Varadhan and Roland, Scand. J. Stat. 35, 335
    (2008)): plain iteration, deeptime's, takes many more steps where states are hardly connected.
    """
    both, out = counts + counts.transpose(0, 2, 1), counts.sum(2)
    with np.errstate(all="ignore"):  # a jump too far gives no numbers
        y = _fixed_point(both, out, np.log(both.sum(2) / both.reshape(len(both), -1).sum(1)[:, None]), settled)
        w = out * np.exp(-y)
        flux = both / (w[:, :, None] + w[:, None])
        total = flux.sum(2)
        matrix, stationary = flux / total[:, :, None], total / total.sum(1)[:, None]
    return [None if np.isnan(of[0]) else (m, s) for of, m, s in zip(y, matrix, stationary, strict=True)]


def _fixed_point(both: FloatArray, out: FloatArray, y: FloatArray, settled: float) -> FloatArray:
    """Return log populations `(k, n)` that a step no longer changes, searched for from `y`; NaN where they are not
    found."""

    def step(y: FloatArray) -> FloatArray:
        w = out * np.exp(-y)
        z = np.add.reduce(both / (w[:, :, None] + w[:, None]), 2)
        return np.asarray(np.log(z / np.add.reduce(z, 1)[:, None]))

    found, left = np.full_like(y, np.nan), np.arange(len(y))
    for _ in range(_MOST_STEPS):
        first = step(y)
        second = step(first)
        r, v = first - y, second - 2.0 * first + y
        off = np.abs(r)
        moved = (np.exp(y) * off).max(1)
        done = (off.max(1) < _STEP_TOLERANCE) | (moved < settled)
        if done.any():
            found[left[done]] = y[done]
            if done.all():
                return found
            left, both, out, y, second, r, v, moved = (a[~done] for a in (left, both, out, y, second, r, v, moved))
        length_r, length_v = (np.sqrt(a[:, None] @ a[:, :, None])[:, 0] for a in (r, v))
        further = np.minimum(np.fmax(1.0, length_r / np.maximum(length_v, 1e-300)), _FURTHEST)
        jumped = step(y + 2.0 * further * r + further**2 * v)
        # A jump too far is none.
        y = np.where(np.abs(jumped - second).max(1, keepdims=True) < _LONGEST_JUMP, jumped, second)
    near = moved < 10.0 * _SETTLED
    found[left[near]] = y[near]
    return found


def _timescales(matrix: FloatArray, stationary: FloatArray, lag: int) -> tuple[FloatArray, FloatArray]:
    """Return the five slowest timescales, descending, and their eigenfunctions `(n_states, k)`."""
    root = np.sqrt(np.maximum(stationary, 1e-300))
    values, vectors = np.linalg.eigh(0.5 * ((root[:, None] * matrix / root) + (root[:, None] * matrix / root).T))
    order = np.argsort(-values)[1:6]
    with np.errstate(divide="ignore"):
        times = -lag / np.log(np.clip(values[order], 1e-6, 1 - 1e-12))
    return times, vectors[:, order] / root[:, None]


class _Model:
    """The Markov model of all replicas at one lag."""

    def __init__(self, micro: list[IntArray], units: list[tuple[int, int, int]], n: int, lag: int) -> None:
        self.lag, self.n = lag, n
        self.by_unit = _counts(micro, units, n, lag)
        self.counts = self.by_unit.sum(0)
        fitted = _fit(self.counts)
        if fitted is None:
            raise InputError(f"no reversible Markov model fits transitions {lag} frames apart.")
        self.matrix, self.stationary, self.kept = fitted
        self.times, functions = _timescales(self.matrix, self.stationary, lag)
        self.populations = np.zeros(n)
        self.populations[self.kept] = self.stationary
        # Which side of each slow process a microstate is on, -1 outside the connected set and for no state.
        self.sides = np.full((max(functions.shape[1], 1), n + 1), -1)
        self.sides[:, self.kept] = functions.T > 0 if functions.size else 0
        self.side = self.sides[0, :n]

    def crossings(self, micro: list[IntArray]) -> int:
        """Return how often the slowest process is seen in its rarer direction, at steps of the lag."""
        return self.crossed(self.sides[0], micro)

    def most_crossings(self, micro: list[IntArray]) -> int:
        """Return the same of whichever of the slow processes was seen most often; some lags are not slow."""
        return max(self.crossed(of, micro) for of in self.slow_sides)

    @property
    def slow_sides(self) -> IntArray:
        """The sides of slow processes, at least of the slowest."""
        return self.sides[: max(1, int((self.times > _SLOW_LAGS * self.lag).sum()))]

    def crossed(self, of: IntArray, micro: list[IntArray]) -> int:
        """Return how often sides `of` microstates are changed in the rarer direction, at steps of the lag."""
        ways = np.zeros(2, dtype=int)
        for m in micro:
            side = of[m[:: self.lag]]
            side = side[side >= 0]
            for way in (0, 1):
                ways[way] += int(((side[:-1] == way) & (side[1:] == 1 - way)).sum())
        return int(ways.min())


def _rare(model: _Model, micro: list[IntArray], populations: FloatArray) -> tuple[tuple[Rare, ...], bool]:
    """Return what the slowest processes lead to that was seen a few times and has a small share, and whether the
    slowest process that leads to more was seen often enough."""
    rare: list[Rare] = []
    for of in model.slow_sides if len(model.times) else ():
        n = model.crossed(of, micro)
        if n >= _LEAST_CROSSINGS:
            break
        side = int(populations[of[:-1] == 1].sum() < populations[of[:-1] == 0].sum())
        members = np.flatnonzero((of[:-1] == side) & (populations > 0.0))
        if n == 0 or populations[members].sum() > _RARE:
            return tuple(rare), False
        rare.append(Rare(tuple(members.tolist()), n))
    return tuple(rare), True


def _drawn_times(model: _Model, resampled: IntArray) -> FloatArray:
    """Return timescales `(n_draws, k)` of resampled replicas."""
    times = np.full((len(resampled), len(model.times)), np.nan)
    fits = _fits([np.tensordot(multiplicity, model.by_unit, 1) for multiplicity in resampled], _SETTLED)
    for row, fitted in zip(times, fits, strict=True):
        if fitted is not None:
            own = _timescales(fitted[0], fitted[1], model.lag)[0][: len(row)]
            row[: len(own)] = own
    return times


class _Averages:
    """Averages over frames of MD as transitions from anywhere to anywhere, in proportion to the frames.

    Where a process was seen a few times, its transitions tell populations worse than averages over frames do. So many
    count beside them, within the connected set, that no slow process gains more than a few crossings. `shifted` draws
    what these leave open.
    """

    def __init__(self, model: _Model, micro: list[IntArray], units: Sequence[tuple[int, int, int]]) -> None:
        self.slow, self.lag = model.slow_sides[:, :-1], model.lag
        parts = [micro[k][a:b] for k, a, b in units]
        self.visits = np.array([np.bincount(m[m >= 0], minlength=model.n) for m in parts])
        self.shift = np.zeros(len(self.slow))

    def shifted(self, rng: np.random.Generator) -> _Averages:
        """Return averages moved at random along each slow process, by as much as so few crossings are off."""
        found = copy.copy(self)
        found.shift = math.sqrt(2.0 / _AVERAGES_CROSSINGS) * rng.normal(size=len(self.slow))
        return found

    def beside(self, counts: FloatArray, multiplicity: FloatArray) -> FloatArray:
        """Return counts `(n, n)` of the connected set with what the averages of so many of each unit add."""
        inside = _components(counts) == 0
        share = np.where(inside, multiplicity @ self.visits * np.exp(self.shift @ (self.slow > 0)), 0.0)
        share /= max(share.sum(), 1e-300)
        either = [share[side == 0].sum() * share[side == 1].sum() for side in self.slow]
        added = _AVERAGES_CROSSINGS * self.lag / max(*either, 0.05)
        return np.where(inside[:, None] & inside, counts, 0.0) + added * np.outer(share, share)


def _choose(models: list[_Model], resampled: IntArray) -> tuple[int, bool]:
    """Return which lag to take, the shortest from which on the slowest timescale is flat, and whether one is.

    What a longer lag adds is compared with its own error, of the same resampled replicas at both: chance makes a
    timescale long or short at all lags together. Too short a lag makes timescales short, never long (Prinz et al.).
    """
    if len(models) == 1:
        return 0, True
    slowest = [_log_slowest(m.times[None]) for m in models]
    drawn = [_log_slowest(_drawn_times(m, resampled[:_FLAT_DRAWS])) for m in models]
    for k, model in enumerate(models[:-1]):
        # A process as fast as the lag cannot be followed any longer.
        if not slowest[k][0] >= math.log(model.lag):
            return k, True
        added = [float(later[0] - slowest[k][0]) for later in slowest[k + 1 :]]
        errors = [_finite_std(later, drawn[k]) for later in drawn[k + 1 :]]
        if all(a <= max(_FLAT, 2.0 * e) for a, e in zip(added, errors, strict=True)):
            return k, True
    return len(models) - 1, False


def _finite_std(a: FloatArray, b: FloatArray) -> float:
    """Return the standard deviation of a - b where both are numbers."""
    both = np.isfinite(a) & np.isfinite(b)
    return float((a[both] - b[both]).std()) if both.sum() > 1 else 0.0


def _log_slowest(times: FloatArray) -> FloatArray:
    """Return the logarithms of the first of `times` (n, k), -infinity where there is none."""
    with np.errstate(divide="ignore"):
        return np.log(times[:, 0]) if times.shape[1] else np.full(len(times), -np.inf)


def _chapman_kolmogorov(
    model: _Model, micro: list[IntArray], units: list[tuple[int, int, int]], resampled: IntArray
) -> tuple[float, bool]:
    """Return the largest difference of predicted and observed probabilities to be on the side of the slowest process
    that one was on, after some lags, and whether it is within two standard errors, or small."""
    if len(model.kept) < 2:
        return 0.0, True
    worst, holds = 0.0, True
    sides = [model.side[model.kept] == side for side in (0, 1)]
    for multiple in _CK_MULTIPLES:
        lag = multiple * model.lag
        if lag * 2 > max(map(len, micro)):
            break
        power = np.linalg.matrix_power(model.matrix, multiple)
        by_unit = _counts(micro, units, model.n, lag)[:, model.kept][:, :, model.kept]

        def observed(counts: FloatArray, side: BoolArray) -> float:
            rows = counts[side]
            with np.errstate(invalid="ignore", divide="ignore"):
                stay = rows[:, side].sum(1) / rows.sum(1)
            weight = np.where(np.isfinite(stay), model.stationary[side], 0.0)
            return float((np.nan_to_num(stay) * weight).sum() / max(weight.sum(), 1e-300))

        for side in sides:
            if not side.any():
                continue
            weight = model.stationary[side]
            predicted = float((power[np.ix_(side, side)].sum(1) * weight).sum() / weight.sum())
            off = abs(predicted - observed(by_unit.sum(0), side))
            error = float(np.std([observed(np.tensordot(r, by_unit, 1), side) for r in resampled]))
            worst, holds = max(worst, off), holds and off <= max(_CK_TOLERANCE, 2.0 * error)
    return worst, holds


def _unconnected(model: _Model, micro: list[IntArray]) -> tuple[Unconnected, ...]:
    """Return the sets of microstates without weight that hold more than a few frames."""
    total = sum(map(len, micro))
    visits = sum((np.bincount(m[m >= 0], minlength=model.n) for m in micro), np.zeros(model.n, dtype=np.int64))
    labels = _components(model.counts)
    inside = np.zeros(model.n, dtype=bool)
    inside[model.kept] = True
    fates: dict[Fate, list[int]] = {}
    for component in np.unique(labels[(visits > 0) & ~inside]):
        members = np.flatnonzero((labels == component) & (visits > 0) & ~inside)
        if visits[members].sum() < _NAMED_SHARE * total:
            continue
        others = np.setdiff1d(np.arange(model.n), members)
        out, back = model.counts[np.ix_(members, others)].sum(), model.counts[np.ix_(others, members)].sum()
        # A replica that is still there says that it is left slowly, not that it weighs nothing.
        stayed = any(m[-1] in members for m in micro)
        fate: Fate = "only begun in"
        if out or back:
            fate = (
                "entered and never left"
                if back
                else "begun in and not always left"
                if stayed
                else "left and never entered"
            )
        fates.setdefault(fate, []).extend(members.tolist())
    return tuple(
        Unconnected(
            tuple(sorted(members)), float(visits[members].sum() / total),
            sum(bool(np.isin(m, members).any()) for m in micro), fate,
        )
        for fate, members in fates.items()
    )  # fmt: skip
