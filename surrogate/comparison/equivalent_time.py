"""The equivalent MD time of a candidate: the length at which MD is as far from the reference as the candidate is, by
histograms of torsions and by autocorrelation.

Reference and replicate are one simulation, run twice. Pieces of the one, of every length, are compared with the whole
of the other, and so is the candidate; both with the same reference, so its own noise is in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.distributions import TORSION_BINS
from surrogate.comparison.measure.slow_motion import longest_correlation, slow_torsions
from surrogate.comparison.measure.statistics import (
    Blocks,
    Estimate,
    FloatArray,
    Piece,
    block_length,
    bootstrap_weights,
    make_blocks,
)
from surrogate.comparison.measure.structure import MOST_HISTOGRAMS, Backbone, Features, evenly
from surrogate.comparison.rows.charts import Line, LineChart
from surrogate.comparison.rows.kinetics_rows import turning
from surrogate.comparison.rows.rows import distance_estimate
from surrogate.comparison.rows.torsion_rows import MOST_MAPS, joint_counts
from systems.units import format_time_ps

Kind = Literal["distribution", "kinetics"]
# (reference, candidate, replicate): features and their blocks.
Three = Sequence[tuple[Features, Blocks]]

_MANY_PIECES = 8
_NORMAL_95 = 1.959964
# Pieces run from the whole length down to this share of it, halving each time.
SHORTEST_SHARE = 128
_LEAST_FRAMES = 10
_LAGS = 40
_DRAWS = 400


@dataclass(frozen=True)
class EquivalentTime:
    """The equivalent MD time of a candidate by one measure, in ps of MD, with its 95 % interval.

    `candidate_error` is its distance to the reference; MD of `lengths_ps` `(n,)`, ascending, has `errors` `(n,)`, the
    geometric mean over pieces, which scatter between `errors_low` and `errors_high` (10 % and 90 % quantiles). `bound`:
    beyond which end of the MD at hand it lies; an end of the interval beyond that range is None. `share`: of the
    candidate, where MD at hand ends first: the shortest parts that come as near.
    """

    key: str
    kind: Kind
    measure: str
    equivalent_ps: float
    low_ps: float | None
    high_ps: float | None
    bound: Literal["", "at least", "less than"]
    candidate_error: float
    lengths_ps: tuple[float, ...]
    errors: tuple[float, ...]
    errors_low: tuple[float, ...]
    errors_high: tuple[float, ...]
    share: float = 1.0

    def in_words(self) -> str:
        """Return such as '38 ns [25 ns, 60 ns]', 'at least 100 ns' or 'less than 0.8 ns'."""
        length = format_time_ps(self.equivalent_ps, 2)
        if self.bound == "less than" or (self.bound == "at least" and self.low_ps is None):
            return f"{self.bound} {length}"
        ends = ((self.low_ps, "<", self.lengths_ps[0]), (self.high_ps, ">", self.lengths_ps[-1]))
        low, high = (f"{sign} {format_time_ps(at, 2)}" if x is None else format_time_ps(x, 2) for x, sign, at in ends)
        return f"{self.bound} {length} [{low}, ...]" if self.bound else f"{length} [{low}, {high}]"

    def error_at(self, share: float) -> float:
        """Return the error of MD of `share` of the longest length, between neighbouring lengths on logarithmic axes."""
        at = math.log(share * self.lengths_ps[-1])
        return float(np.exp(np.interp(at, np.log(self.lengths_ps), np.log(np.maximum(self.errors, 1e-12)))))


class Measure(NamedTuple):
    """A squared distance between two trajectories, made of sums over blocks of frames. `sums` are of (reference,
    candidate, replicate), `(n_blocks, n_sums)`, the first and the last in equal parts of equal lengths in order of
    time; `squared(p, q)` maps sums `(n, n_sums)` of a trajectory and `(n_sums,)` of the reference to squared distances
    `(n,)`."""

    key: str
    kind: Kind
    name: str
    sums: tuple[FloatArray, FloatArray, FloatArray]
    squared: Callable[[FloatArray, FloatArray], FloatArray]

    def to_references(self, sums: FloatArray) -> FloatArray:
        """Return the squared distances `(n,)` of sums `(n, n_sums)`, the mean over reference and replicate."""
        ends = (self.sums[0].sum(0), self.sums[2].sum(0))
        return np.asarray(np.mean([self.squared(sums, end) for end in ends], axis=0))

    def own_draws(self, seed: int) -> FloatArray:
        """Return the candidate's squared distance in every bootstrap draw of its blocks, `(n_draws,)`."""
        own = self.sums[1]
        return self.to_references(bootstrap_weights(len(own), _DRAWS, np.random.default_rng([seed, 7])) @ own)


def errors_by_length(measure: Measure, length_ps: float) -> tuple[FloatArray, FloatArray]:
    """Return how far parts of the candidate, `length_ps` long, of every length are from the reference: lengths in ps
    and distances (geometric means over the parts), both `(n,)`, ascending."""
    own = measure.sums[1]
    found = _logs_by_length(len(own), lambda n_each: measure.to_references(_pieces(own, n_each)))
    errors = [math.exp(0.5 * float(logs.mean())) for _, logs in found]
    return length_ps / len(own) * np.array([n_each for n_each, _ in found]), np.asarray(errors)


def _logs_by_length(n_blocks: int, squared: Callable[[int], FloatArray]) -> list[tuple[int, FloatArray]]:
    """Return, of pieces of every number of blocks, doubling up to all of them, the logarithms of their squared
    distances to the reference."""
    lengths = sorted({*(1 << k for k in range(n_blocks.bit_length())), n_blocks})
    errors = [squared(n_each) for n_each in lengths]
    found = [(n, np.log(e[np.isfinite(e) & (e > 0)])) for n, e in zip(lengths, errors, strict=True)]
    return [(n, logs) for n, logs in found if len(logs)]


def distance_to_reference(measure: Measure, seed: int = 0) -> Estimate:
    """Return the candidate's distance to the reference (the root mean square of those to reference and replicate) with
    its 95 % interval: block bootstrap of the candidate alone."""
    own = measure.sums[1]
    value = math.sqrt(float(measure.to_references(own.sum(0)[None])[0]))
    return distance_estimate(value, np.sqrt(measure.own_draws(seed)), len(own))


def equivalent_time_by(measure: Measure, length_ps: float, seed: int = 0) -> EquivalentTime | None:
    """Return the equivalent MD time by one measure; `length_ps` is that of reference and of replicate. None when it
    has no value.

    Length and error of MD are read from geometric means over all pieces of one length (a typical piece: a rare event
    makes few pieces very wrong), made monotone by isotonic regression and interpolated on logarithmic axes. The
    interval combines the error of that mean with the candidate's own: its block bootstrap, or the scatter of MD pieces
    of such a time where that is larger, because no trajectory knows by itself which states it has missed.
    """
    from scipy.optimize import isotonic_regression

    first, own, second = measure.sums
    pairs = ((second, first.sum(0)), (first, second.sum(0)))

    def squared(n_each: int) -> FloatArray:
        return np.concatenate([measure.squared(_pieces(blocks, n_each), reference) for blocks, reference in pairs])

    found = _logs_by_length(len(first), squared)
    lengths = [length_ps * n_each / len(first) for n_each, _ in found]
    means = [float(logs.mean()) for _, logs in found]
    scatter = [float(logs.std(ddof=1)) if len(logs) >= _MANY_PIECES else math.nan for _, logs in found]
    spans = [np.exp(0.5 * np.quantile(logs, [0.1, 0.9])) for _, logs in found]
    # The two trajectories held whole against each other are one number, twice.
    counts = [1 if n_each == len(first) else len(logs) for n_each, logs in found]
    value = float(measure.to_references(own.sum(0)[None])[0])
    if len(lengths) < 3 or not math.isfinite(value):
        return None
    weights = np.asarray(counts, dtype=np.float64)
    curve = np.asarray(isotonic_regression(np.asarray(means), weights=weights, increasing=False).x)
    log_lengths, log_error = np.log(lengths), math.log(max(value, 1e-300))
    at = _length_at(log_error, log_lengths, curve)
    # Where pieces are few their scatter is not known; it grows with length as rare events come in one by one.
    spread = np.maximum.accumulate(np.nan_to_num(scatter, nan=0.0))
    of_mean = float(np.interp(at, log_lengths, spread / np.sqrt(counts)))
    draws = measure.own_draws(seed)
    draws = draws[np.isfinite(draws) & (draws > 0)]
    few = len(draws) < 2 or len(own) < 2
    bootstrapped = math.inf if few else float(np.log(draws).std()) * math.sqrt(len(own) / (len(own) - 1))
    own_error = max(bootstrapped, float(np.interp(at, log_lengths, spread)))
    combined = math.hypot(own_error, of_mean)
    low, high = (_crossing(log_error + s * _NORMAL_95 * combined, log_lengths, curve) for s in (1, -1))
    bound: Literal["", "at least", "less than"] = ""
    if log_error <= curve[-1]:
        bound = "at least"
    elif log_error >= curve[0]:
        bound = "less than"
    return EquivalentTime(
        key=measure.key,
        kind=measure.kind,
        measure=measure.name,
        equivalent_ps=float(math.exp(at)),
        low_ps=low,
        high_ps=high,
        bound=bound,
        candidate_error=math.sqrt(value),
        lengths_ps=tuple(lengths),
        errors=tuple(math.exp(0.5 * x) for x in means),
        errors_low=tuple(float(s[0]) for s in spans),
        errors_high=tuple(float(s[1]) for s in spans),
        share=_share_needed(measure, math.exp(0.5 * float(curve[-1]))) if bound == "at least" else 1.0,
    )


def _share_needed(measure: Measure, error: float) -> float:
    """Return the least share of the candidate from which on parts of it are as near to the reference as `error`."""
    shares, errors = errors_by_length(measure, 1.0)
    too_far = np.flatnonzero(errors > error)
    first = int(too_far[-1]) + 1 if len(too_far) else 0
    return float(shares[first]) if first < len(shares) else 1.0


def _pieces(blocks: FloatArray, n_each: int) -> FloatArray:
    """Return the sums over every `n_each` blocks that follow each other, `(n_pieces, n_sums)`."""
    n_pieces = len(blocks) // n_each
    return np.asarray(blocks[: n_pieces * n_each].reshape(n_pieces, n_each, -1).sum(1))


def _length_at(log_error: float, log_lengths: FloatArray, curve: FloatArray) -> float:
    """Return the (log) length with this (log) error; beyond the curve its end. Flat stretches give their middle."""
    left = float(np.interp(-log_error, -curve - 1e-12 * np.arange(len(curve))[::-1], log_lengths))
    right = float(np.interp(-log_error, -curve + 1e-12 * np.arange(len(curve)), log_lengths))
    return 0.5 * (left + right)


def _crossing(log_error: float, log_lengths: FloatArray, curve: FloatArray) -> float | None:
    """Return the length in ps with this error, or None where no MD at hand is as good or as bad."""
    if not curve[-1] < log_error < curve[0]:
        return None
    return float(math.exp(_length_at(log_error, log_lengths, curve)))


def headline(
    found: Sequence[EquivalentTime], cost_ratio: Callable[[EquivalentTime], float | None], length_ps: float
) -> str:
    """Return 'Equivalent MD time 38 ns [25 ns, 60 ns] by its φ/ψ map, at 1/900 of its cost; by its kinetics 3 ns
    [...].' Empty without a measure. `cost_ratio(found)`: the cost of that much MD over that of the share of the
    candidate which equals it, None when a cost is unknown; `length_ps`: of the candidate."""
    first = next((w for w in found if w.kind == "distribution"), None)
    if first is None:
        return ""
    text = f"Equivalent MD time {first.in_words()} by its {first.measure}"
    ratio = cost_ratio(first)
    if ratio is not None and first.bound != "less than":
        part = (
            "" if first.share >= 1.0 else f" for the {format_time_ps(first.share * length_ps, 2)} of it that this takes"
        )
        text += f", at {_cost_words(ratio)} its cost{part}"
    moving = next((w for w in found if w.kind == "kinetics"), None)
    return text + (f"; by its kinetics ({moving.measure}) {moving.in_words()}." if moving else ".")


def _cost_words(ratio: float) -> str:
    """Return '1/900 of' for MD that costs 900 times as much, '67 % of' for 1.5 times, '3.2 times' for MD that is
    cheaper."""
    if ratio < 1.0:
        return f"{float(f'{1 / ratio:.2g}'):g} times"
    return f"{100 / ratio:.0f} % of" if ratio < 10.0 else f"1/{float(f'{ratio:.2g}'):,g} of"


def equivalent_time_charts(found: Sequence[EquivalentTime]) -> list[LineChart]:
    """Return one chart a measure: the error of MD against its length, and the candidate's error as a level line."""
    charts = []
    caption = (
        "Distance to the reference of reference MD of each length (typical piece; band: 10 to 90 % of the pieces) and "
        "of the candidate. Where the lines cross, MD is as good as the candidate."
    )
    for w in found:
        unit, scale = ("ns", 1e-3) if w.lengths_ps[-1] >= 1e3 else ("ps", 1.0)
        x = np.asarray(w.lengths_ps) * scale
        of_md = (np.asarray(errors) for errors in (w.errors, w.errors_low, w.errors_high))
        level = Line("candidate", "candidate", x, np.full(len(x), w.candidate_error))
        title, x_label = f"Equivalent MD time by {w.measure}: {w.in_words()}", f"length of MD / {unit}"
        lines = (Line("MD", "reference", x, *of_md), level)
        charts.append(
            LineChart("equivalent_time", title, caption, x_label, "distance to the reference", lines, True, True)
        )
    return charts


def equivalent_times(
    reference: Features, candidate: Features, replicate: Features, torsions: Backbone, seed: int = 0
) -> tuple[EquivalentTime, ...]:
    """Return the equivalent MD time by each measure that applies: histograms of torsions, autocorrelation. The
    candidate enters with all its frames; reference and replicate are cut to one length."""
    three = _equal_parts(reference, candidate, replicate)
    if three is None:
        return ()
    length_ps = three[0][0].total_ps
    found = [equivalent_time_by(m, length_ps, seed) for m in _measures(three, torsions)]
    return tuple(w for w in found if w is not None)


def joint_measure(
    reference: Features, candidate: Features, replicate: Features, torsions: Backbone
) -> tuple[Measure, float] | None:
    """Return the φ/ψ map alone as a measure, and the length in ps of reference and replicate; None where there is no
    residue with φ and ψ, or too few frames."""
    three = _equal_parts(reference, candidate, replicate)
    if three is None or not torsions.residues:
        return None
    return _joint_measure(three, torsions), three[0][0].total_ps


def _equal_parts(reference: Features, candidate: Features, replicate: Features) -> Three | None:
    """Cut reference and replicate to one length and divide all three into blocks; None where frames are too few."""
    n = min(reference.n_frames, replicate.n_frames)
    n_blocks = 1 << int(math.log2(max(min(SHORTEST_SHARE, n // _LEAST_FRAMES), 1)))
    if n_blocks < 8:
        return None
    ref, other = reference.frames(0, n), replicate.frames(0, n)
    own = make_blocks(candidate.segment_lengths, block_length(candidate.n_frames, longest_correlation(ref, other)))
    even = [even_blocks(f.segment_lengths, n_blocks) for f in (ref, other)]
    return [(ref, even[0]), (candidate, own), (other, even[1])]


def even_blocks(segment_lengths: Sequence[int], n_blocks: int) -> Blocks:
    """Return `n_blocks` blocks of equally many frames (but for one), counted through the segments in order."""
    edges = np.linspace(0, sum(segment_lengths), n_blocks + 1).astype(int)
    pieces, offset = [], 0
    for segment, n in enumerate(segment_lengths):
        for block in range(n_blocks):
            start, stop = max(int(edges[block]) - offset, 0), min(int(edges[block + 1]) - offset, n)
            if start < stop:
                pieces.append(Piece(segment, start, stop, block))
        offset += n
    return Blocks(tuple(pieces), n_blocks, max(int(np.diff(edges).max()), 1))


def _measures(three: Three, torsions: Backbone) -> list[Measure]:
    """Return the measure by the φ/ψ map, or by single torsions where there is none, and that by autocorrelation; none
    where nothing turns."""
    columns = _torsion_columns(three[0][0], torsions)
    if not columns:
        return []
    if torsions.residues:
        found = _joint_measure(three, torsions)
    else:
        counts = [[distributions.block_counts(f.column(*c), TORSION_BINS, b) for f, b in three] for c in columns]
        found = _histogram_measure("torsion_jsd", "single torsions", counts)
    moving = _correlation_measure(three)
    return [found] if moving is None else [found, moving]


def _torsion_columns(reference: Features, torsions: Backbone) -> list[tuple[Any, int]]:
    """Return the series and the column of phi and psi, or, where there are none, of rotatable torsions; of rotors where
    nothing else turns."""
    backbone = [("phi", k) for k in range(len(torsions.phi))] + [("psi", k) for k in range(len(torsions.psi))]
    rotors = [k for k, t in enumerate(reference.probes.torsions) if t.kind == "rotor"] if reference.probes else []
    further = [("torsions", k) for k in slow_torsions(reference) or rotors]
    return evenly(backbone or further, MOST_HISTOGRAMS)


def _joint_measure(three: Three, torsions: Backbone) -> Measure:
    per_residue = [[joint_counts(f, b, r) for f, b in three] for r in evenly(torsions.residues, MOST_MAPS)]
    return _histogram_measure("joint_jsd", "φ/ψ map", per_residue)


def _histogram_measure(key: str, name: str, counts: Sequence[Sequence[FloatArray]]) -> Measure:
    """Return the measure whose square is the mean Jensen-Shannon divergence over several histograms; `counts`: of each
    those of (reference, candidate, replicate) per block."""
    visited = [sum(c.sum(0) for c in three) > 0 for three in counts]
    kept = [[c[:, v] for c in three] for three, v in zip(counts, visited, strict=True)]
    edges = np.cumsum([int(v.sum()) for v in visited])[:-1]
    first, own, second = (np.concatenate([three[k] for three in kept], axis=1) for k in range(3))

    def squared(p: FloatArray, q: FloatArray) -> FloatArray:
        parts = zip(np.split(p, edges, axis=1), np.split(q, edges), strict=True)
        return np.asarray(np.mean([distributions.divergence(a, b[None]) for a, b in parts], axis=0))

    return Measure(key, "distribution", name, (first, own, second), squared)


def _correlation_measure(three: Three) -> Measure | None:
    """Return the root mean square difference of the autocorrelations of cos psi (of rotatable torsions where there is
    no psi), at lags even on a log scale up to the first zero of the reference's slowest. None where none moves."""
    moving = [turning(f) for f, _ in three]
    chosen = evenly(range(len(moving[0])), MOST_MAPS)
    series = [[m[k][2] for m in moving] for k in chosen]
    longest = max((kinetics.zero_crossing(per_sample[0])[0] for per_sample in series), default=0)
    longest = min(longest, *(max(f.segment_lengths) - 1 for f, _ in three))
    if longest < 2:
        return None
    lags = np.unique(np.geomspace(1, longest, _LAGS).astype(int))
    kept = np.concatenate([[0], lags])
    sums = []
    for k, (_, own) in enumerate(three):
        parts = [kinetics.lag_sums(per_sample[k], own, int(lags[-1]) + 1) for per_sample in series]
        sums.append(np.concatenate([a[:, kept] for s in parts for a in (s.xy, s.head, s.tail, s.n)], axis=1))

    def curves(flat: FloatArray) -> FloatArray:
        each = np.split(flat, 4 * len(series), axis=1)
        found = [
            kinetics.autocorrelation(kinetics.LagSums(*each[4 * k : 4 * k + 4]), np.eye(len(flat)))[:, 1:]
            for k in range(len(series))
        ]
        return np.concatenate(found, axis=1)

    def squared(p: FloatArray, q: FloatArray) -> FloatArray:
        return np.asarray(((curves(p) - curves(q[None])) ** 2).mean(-1))

    name = "autocorrelation of cos ψ" if moving[0][0][0] else "autocorrelation of rotatable torsions"
    return Measure("psi_correlation", "kinetics", name, (sums[0], sums[1], sums[2]), squared)
