"""How many nanoseconds of MD a candidate is worth: the length at which MD is as far from the reference as the
candidate is, by histograms of torsions and of TIC 0, bonds, autocorrelation.

Reference and replicate are one simulation, run twice. Pieces of the one, of every length, are held against the whole
of the other, and so is the candidate; both stand against the same reference, so its own noise is in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.distributions import TORSION_BINS
from surrogate.comparison.measure.slow_motion import longest_correlation, slow_torsions, tica_features
from surrogate.comparison.measure.statistics import (
    Blocks,
    Estimate,
    FloatArray,
    Piece,
    block_length,
    bootstrap_weights,
    estimate,
    make_blocks,
)
from surrogate.comparison.measure.structure import MOST_HISTOGRAMS, Backbone, Features, evenly
from surrogate.comparison.rows.charts import Line, LineChart
from surrogate.comparison.rows.kinetics_rows import turning
from surrogate.comparison.rows.rows import Options
from surrogate.comparison.rows.torsion_rows import MOST_MAPS, joint_counts
from systems.units import format_time_ps

Kind = Literal["distribution", "kinetics"]
# (reference, candidate, replicate): features and their blocks.
Three = Sequence[tuple[Features, Blocks]]

_MANY_PIECES = 8
_UNITS = (("us", 1e6), ("ns", 1e3), ("ps", 1.0))
_NORMAL_95 = 1.959964
# Pieces run from the whole length down to this share of it, halving each time.
SHORTEST_SHARE = 128
_LEAST_FRAMES = 10
_LAGS = 40


@dataclass(frozen=True)
class EquivalentTime:
    """The equivalent MD time of a candidate by one measure, in ps of MD, with its 95 % interval.

    `candidate_error` is its distance to the reference; MD of `lengths_ps` `(n,)`, ascending, has `errors` `(n,)`, the
    geometric mean over pieces, which scatter between `errors_low` and `errors_high` (10 % and 90 % quantiles).
    `bound` says where the equivalent MD time lies when the candidate is better than the longest MD at hand ("at least")
    or worse than the shortest ("less than"); an end of the interval beyond that range is None. `share` of the candidate
    is what this much is the equivalent MD time of: all of it, or, where MD at hand ends first, the shortest parts that
    come as near.
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
        longest = self.equivalent_ps if self.bound else self.lengths_ps[-1] if self.high_ps is None else self.high_ps
        unit, factor = next((u for u in _UNITS if longest >= u[1]), _UNITS[-1])

        def words(time_ps: float) -> str:
            return f"{float(f'{time_ps / factor:.2g}'):g} {unit}"

        low = f"< {words(self.lengths_ps[0])}" if self.low_ps is None else words(self.low_ps)
        high = f"> {words(self.lengths_ps[-1])}" if self.high_ps is None else words(self.high_ps)
        if self.bound:
            return f"{self.bound} {length} [{low}, ...]"
        return f"{length} [{low}, {high}]"

    def error_at(self, share: float) -> float:
        """Return the error of MD of `share` of the longest length, between neighbouring lengths on logarithmic axes."""
        at = math.log(share * self.lengths_ps[-1])
        return float(np.exp(np.interp(at, np.log(self.lengths_ps), np.log(np.maximum(self.errors, 1e-12)))))


@dataclass(frozen=True, eq=False)
class Measure:
    """A squared distance between two trajectories, made of sums over blocks of frames.

    `sums` are of (reference, candidate, replicate), `(n_blocks, n_sums)`, the blocks of the first and the last being
    equal parts of equal lengths in order of time; `squared(p, q)` maps sums `(n, n_sums)` of a trajectory and
    `(n_sums,)` of the reference to squared distances `(n,)`.
    """

    key: str
    kind: Kind
    name: str
    sums: tuple[FloatArray, FloatArray, FloatArray]
    squared: Callable[[FloatArray, FloatArray], FloatArray]

    def to_references(self, sums: FloatArray) -> FloatArray:
        """Return the squared distances `(n,)` of sums `(n, n_sums)`, the mean over reference and replicate."""
        ends = (self.sums[0].sum(0), self.sums[2].sum(0))
        return np.asarray(np.mean([self.squared(sums, end) for end in ends], axis=0))

    def own_draws(self, seed: int, n_draws: int) -> FloatArray:
        """Return the candidate's squared distance in every bootstrap draw of its blocks, `(n_draws,)`."""
        own = self.sums[1]
        return self.to_references(bootstrap_weights(len(own), n_draws, np.random.default_rng([seed, 7])) @ own)


def errors_by_length(measure: Measure, length_ps: float) -> tuple[FloatArray, FloatArray]:
    """Return how far parts of the candidate of every length are from the reference: lengths in ps and distances, both
    `(n,)`, ascending; the candidate is `length_ps` long. As for MD in `equivalent_time_by`: geometric means over the
    parts.
    """
    own = measure.sums[1]
    lengths, found = [], []
    n_each = 1
    while n_each <= len(own):
        errors = measure.to_references(_pieces(own, n_each))
        logs = np.log(errors[np.isfinite(errors) & (errors > 0)])
        if len(logs):
            lengths.append(length_ps * n_each / len(own))
            found.append(math.exp(0.5 * float(logs.mean())))
        n_each = 2 * n_each if 2 * n_each <= len(own) or n_each == len(own) else len(own)
    return np.asarray(lengths), np.asarray(found)


def distance_to_reference(measure: Measure, seed: int = 0, n_draws: int = 400) -> Estimate:
    """Return the candidate's distance to the reference (the root mean square of those to reference and replicate) with
    its 95 % interval: block bootstrap of the candidate alone, of the squared distance."""
    own = measure.sums[1]
    value = float(measure.to_references(own.sum(0)[None])[0])
    squared = estimate(value, measure.own_draws(seed, n_draws), len(own))
    low, high = (math.sqrt(max(x, 0.0)) if math.isfinite(x) else math.nan for x in (squared.low, squared.high))
    return Estimate(math.sqrt(value), low, high, (high - low) / (2 * _NORMAL_95), n_blocks=len(own))


def equivalent_time_by(measure: Measure, length_ps: float, seed: int = 0, n_draws: int = 400) -> EquivalentTime | None:
    """Return the equivalent MD time by one measure; `length_ps` is that of reference and of replicate. None when it
    has no value.

    Length and error of MD are read from geometric means over all pieces of one length (a typical piece: a rare event
    makes few pieces very wrong), made monotone by isotonic regression and interpolated on logarithmic axes. The
    interval combines the error of that mean with the candidate's own: its block bootstrap, or the scatter of MD pieces
    of such a time where that is larger, because no trajectory knows by itself which states it has missed.
    """
    from scipy.optimize import isotonic_regression

    first, own, second = measure.sums
    n_blocks = len(first)
    lengths, means, scatter, spans, counts = [], [], [], [], []
    n_each = 1
    while n_each <= n_blocks:
        pairs = ((second, first.sum(0)), (first, second.sum(0)))
        errors = np.concatenate([measure.squared(_pieces(blocks, n_each), reference) for blocks, reference in pairs])
        logs = np.log(errors[np.isfinite(errors) & (errors > 0)])
        if len(logs):
            lengths.append(length_ps * n_each / n_blocks)
            means.append(float(logs.mean()))
            scatter.append(float(logs.std(ddof=1)) if len(logs) >= _MANY_PIECES else math.nan)
            spans.append(np.exp(0.5 * np.quantile(logs, [0.1, 0.9])))
            # The two trajectories held whole against each other are one number, twice.
            counts.append(1 if n_each == n_blocks else len(logs))
        n_each *= 2
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
    draws = measure.own_draws(seed, n_draws)
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
    [...].'

    `cost_ratio(worth)`: the cost of that much MD over that of the share of the candidate which is worth it, None when a
    cost is unknown; `length_ps`: of the candidate. Where a part of it suffices, that is said and alone charged for.
    Empty without a measure.
    """
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
    reference: Features, candidate: Features, replicate: Features, torsions: Backbone, options: Options
) -> tuple[EquivalentTime, ...]:
    """Return the equivalent MD time by each measure that applies: histograms of the torsions and of TIC 0, bonds,
    autocorrelation.

    The candidate enters with all its frames; reference and replicate are cut to one length.
    """
    three = _equal_parts(reference, candidate, replicate)
    if three is None:
        return ()
    length_ps = three[0][0].total_ps
    found = [equivalent_time_by(m, length_ps, options.seed) for m in _measures(three, torsions, options)]
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


def _measures(three: Three, torsions: Backbone, options: Options) -> list[Measure]:
    out = [_joint_measure(three, torsions)] if torsions.residues else []
    name, columns = _torsion_columns(three[0][0], torsions)
    if columns:
        counts = [[distributions.block_counts(f.column(*c), TORSION_BINS, b) for f, b in three] for c in columns]
        out.append(_histogram_measure("torsion_jsd", name, counts))
        out += _tica_measures(three, options)
        moving = _correlation_measure(three)
        out += [moving] if moving is not None else []
    elif n_bonds := three[0][0].bonds_nm[0].shape[1]:
        bonds = [[[x[:, k] for x in f.bonds_nm] for f, _ in three] for k in range(n_bonds)]
        counts = [
            [distributions.block_counts(x, distributions.normal_bins(of[0]), b) for x, (_, b) in zip(of, three)]
            for of in bonds
        ]
        out.append(_histogram_measure("bond_jsd", "bond lengths", counts))
    return out


def _torsion_columns(reference: Features, torsions: Backbone) -> tuple[str, list[tuple[Any, int]]]:
    """Return what the torsions are called together, and each as the series it is in and its column: phi and psi, or,
    where there are none, rotatable torsions; rotors of what has nothing else that turns."""
    backbone = [("phi", k) for k in range(len(torsions.phi))] + [("psi", k) for k in range(len(torsions.psi))]
    if backbone:
        return "single φ and ψ", evenly(backbone, MOST_HISTOGRAMS)
    rotors = [k for k, t in enumerate(reference.probes.torsions) if t.kind == "rotor"] if reference.probes else []
    for chosen, name in ((slow_torsions(reference), "single rotatable torsions"), (rotors, "single rotors")):
        if chosen:
            return name, evenly([("torsions", k) for k in chosen], MOST_HISTOGRAMS)
    return "", []


def _joint_measure(three: Three, torsions: Backbone) -> Measure:
    per_residue = [[joint_counts(f, b, r) for f, b in three] for r in evenly(torsions.residues, MOST_MAPS)]
    return _histogram_measure("joint_jsd", "φ/ψ map", per_residue)


def _histogram_measure(key: str, name: str, counts: Sequence[Sequence[FloatArray]]) -> Measure:
    """Return the measure whose square is the mean Jensen-Shannon divergence over several histograms.

    `counts`: for each histogram those of (reference, candidate, replicate) per block.
    """
    visited = [sum(c.sum(0) for c in three) > 0 for three in counts]
    kept = [[c[:, v] for c in three] for three, v in zip(counts, visited, strict=True)]
    edges = np.cumsum([int(v.sum()) for v in visited])[:-1]
    first, own, second = (np.concatenate([three[k] for three in kept], axis=1) for k in range(3))

    def squared(p: FloatArray, q: FloatArray) -> FloatArray:
        parts = zip(np.split(p, edges, axis=1), np.split(q, edges), strict=True)
        return np.asarray(np.mean([distributions.divergence(a, b[None]) for a, b in parts], axis=0))

    return Measure(key, "distribution", name, (first, own, second), squared)


def _tica_measures(three: Three, options: Options) -> list[Measure]:
    lag = max(1, round(options.tica_lag_ps / three[0][0].lag_ps))
    features = [tica_features(f) for f, _ in three]
    model = kinetics.fit_tica(features[0], lag) if max(map(len, features[0])) > 10 * lag else None
    if model is None:
        return []
    projected = [[model.project(x) for x in segments] for segments in features]
    bins = distributions.reference_bins(projected[0])
    counts = [distributions.block_counts(x, bins, b) for x, (_, b) in zip(projected, three, strict=True)]
    return [_histogram_measure("tic0_jsd", "TIC 0", [counts])]


def _correlation_measure(three: Three) -> Measure | None:
    """Return the root mean square difference of the autocorrelations of cos psi (of rotatable torsions where there is
    no psi), at lags even on a log scale.

    Lags run to the first zero crossing of the reference's slowest torsion. None where none moves.
    """
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
