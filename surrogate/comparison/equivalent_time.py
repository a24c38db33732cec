"""How many nanoseconds of MD a candidate is worth: the length at which MD is as far from the reference as the
candidate is.

Reference and replicate are one simulation, run twice. Pieces of the one, of every length, are held against the whole
of the other, and so is the candidate; both stand against the same reference, so its own noise is in both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.statistics import Estimate, bootstrap_weights, estimate
from surrogate.comparison.rows.charts import Line, LineChart
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]
Kind = Literal["distribution", "kinetics"]

_MANY_PIECES = 8
_UNITS = (("us", 1e6), ("ns", 1e3), ("ps", 1.0))
_NORMAL_95 = 1.959964


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


def errors_by_length(measure: Measure, length_ps: float) -> tuple[FloatArray, FloatArray]:
    """Return how far parts of the candidate of every length are from the reference: lengths in ps and distances, both
    `(n,)`, ascending; the candidate is `length_ps` long. As for MD in `equivalent_time_by`: geometric means over the
    parts.
    """
    first, own, second = measure.sums
    lengths, found = [], []
    n_each = 1
    while n_each <= len(own):
        parts = _pieces(own, n_each)
        errors = np.mean([measure.squared(parts, reference.sum(0)) for reference in (first, second)], axis=0)
        logs = np.log(errors[np.isfinite(errors) & (errors > 0)])
        if len(logs):
            lengths.append(length_ps * n_each / len(own))
            found.append(math.exp(0.5 * float(logs.mean())))
        n_each = 2 * n_each if 2 * n_each <= len(own) or n_each == len(own) else len(own)
    return np.asarray(lengths), np.asarray(found)


def distance_to_reference(measure: Measure, seed: int = 0, n_draws: int = 400) -> Estimate:
    """Return the candidate's distance to the reference (the root mean square of those to reference and replicate) with
    its 95 % interval: block bootstrap of the candidate alone, of the squared distance."""
    own, references = measure.sums[1], (measure.sums[0].sum(0), measure.sums[2].sum(0))
    value = float(np.mean([measure.squared(own.sum(0)[None], reference)[0] for reference in references]))
    squared = estimate(value, _own_draws(measure, references, seed, n_draws), len(own))
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
    first, own, second = measure.sums
    n_blocks = len(first)
    references = (first.sum(0), second.sum(0))
    lengths, means, scatter, spans, counts = [], [], [], [], []
    n_each = 1
    while n_each <= n_blocks:
        found = []
        for blocks, reference in ((second, references[0]), (first, references[1])):
            found.append(measure.squared(_pieces(blocks, n_each), reference))
        errors = np.concatenate(found)
        logs = np.log(errors[np.isfinite(errors) & (errors > 0)])
        if len(logs):
            lengths.append(length_ps * n_each / n_blocks)
            means.append(float(logs.mean()))
            scatter.append(float(logs.std(ddof=1)) if len(logs) >= _MANY_PIECES else math.nan)
            spans.append(np.exp(0.5 * np.quantile(logs, [0.1, 0.9])))
            # The two trajectories held whole against each other are one number, twice.
            counts.append(1 if n_each == n_blocks else len(logs))
        n_each *= 2
    value = float(np.mean([measure.squared(own.sum(0)[None], reference)[0] for reference in references]))
    if len(lengths) < 3 or not math.isfinite(value):
        return None
    curve = _falling(np.asarray(means), np.asarray(counts, dtype=np.float64))
    log_lengths, log_error = np.log(lengths), math.log(max(value, 1e-300))
    at = _length_at(log_error, log_lengths, curve)
    # Where pieces are few their scatter is not known; it grows with length as rare events come in one by one.
    spread = np.maximum.accumulate(np.nan_to_num(scatter, nan=0.0))
    of_mean = float(np.interp(at, log_lengths, spread / np.sqrt(counts)))
    own_error = max(_own_error(measure, references, seed, n_draws), float(np.interp(at, log_lengths, spread)))
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


def _own_error(measure: Measure, references: tuple[FloatArray, FloatArray], seed: int, n_draws: int) -> float:
    """Return the standard error of the logarithm of the candidate's squared distance (block bootstrap)."""
    own, draws = measure.sums[1], _own_draws(measure, references, seed, n_draws)
    draws = draws[np.isfinite(draws) & (draws > 0)]
    if len(draws) < 2 or len(own) < 2:
        return math.inf
    return float(np.log(draws).std()) * math.sqrt(len(own) / (len(own) - 1))


def _own_draws(measure: Measure, references: tuple[FloatArray, FloatArray], seed: int, n_draws: int) -> FloatArray:
    """Return the candidate's squared distance in every draw of its blocks, `(n_draws,)`."""
    own = measure.sums[1]
    drawn = bootstrap_weights(len(own), n_draws, np.random.default_rng([seed, 7])) @ own
    return np.asarray(np.mean([measure.squared(drawn, reference) for reference in references], axis=0))


def _pieces(blocks: FloatArray, n_each: int) -> FloatArray:
    """Return the sums over every `n_each` blocks that follow each other, `(n_pieces, n_sums)`."""
    n_pieces = len(blocks) // n_each
    return np.asarray(blocks[: n_pieces * n_each].reshape(n_pieces, n_each, -1).sum(1))


def _falling(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the non-increasing sequence nearest to `values` (isotonic regression)."""
    from scipy.optimize import isotonic_regression

    return np.asarray(isotonic_regression(values, weights=weights, increasing=False).x)


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
    for w in found:
        unit, scale = ("ns", 1e-3) if w.lengths_ps[-1] >= 1e3 else ("ps", 1.0)
        x = np.asarray(w.lengths_ps) * scale
        level = np.full(len(x), w.candidate_error)
        charts.append(
            LineChart(
                section="equivalent_time",
                title=f"Equivalent MD time by {w.measure}: {w.in_words()}",
                caption="Distance to the reference of reference MD of each length (typical piece; band: 10 to 90 % of "
                "the pieces) and of the candidate. Where the lines cross, MD is as good as the candidate.",
                x_label=f"length of MD / {unit}",
                y_label="distance to the reference",
                lines=(
                    Line(
                        "MD", "reference", x, np.asarray(w.errors), np.asarray(w.errors_low), np.asarray(w.errors_high)
                    ),
                    Line("candidate", "candidate", x, level),
                ),
                log_x=True,
                log_y=True,
            )
        )
    return charts
