"""Numbers as people read them, headline numbers, and the table that lays candidates side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from surrogate.comparison.comparison import Comparison, Evaluation
from surrogate.comparison.convergence import Convergence
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.rows.rows import GROUPS, Row
from systems.units import format_time_ps

MARKS = {"agrees": "✓", "close": "≈", "differs": "✗", "fails": "‼", "undecided": "?"}
STATUS_MARKS = {"indistinguishable": "✓", "close": "≈", "different": "✗", "broken": "‼", "undecided": "?"}
GROUP_TITLES = {
    "validity": "Validity of frames",
    "structure": "Structure",
    "populations": "Populations",
    "distributions": "Distributions",
    "kinetics": "Kinetics",
}
_SEVERITY = ("agrees", "undecided", "close", "differs", "fails")
_UNITS = {"_per_ps": "/ps", "_k": "K", "_ps": "ps", "_da": "Da", "_nm": "nm", "_s": "s"}


def number(estimate: Estimate | None) -> str:
    """Return the value, with as many digits as its error leaves meaningful (one more than the first uncertain one)."""
    if estimate is None:
        return "–"
    value, error = estimate.value, estimate.error
    if not math.isfinite(value):
        return "not defined"
    if math.isfinite(error) and error > 0:
        return _rounded(value, _decimals(abs(value), error))
    return f"{value:.4g}"


def _decimals(size: float, error: float) -> int:
    return min(max(1 - math.floor(math.log10(error)), 0), 4 if size < 10 else 3)


def _rounded(value: float, decimals: int) -> str:
    """Return the value with so many decimals, or with two digits where it would read as zero."""
    shown = f"{value:.{decimals}f}"
    return f"{value:.2g}" if value and not float(shown) else shown


def interval(estimate: Estimate | None) -> str:
    """Return the 95 % interval in brackets, or an empty string."""
    if estimate is None or not (math.isfinite(estimate.low) and math.isfinite(estimate.high)):
        return ""
    if estimate.low == estimate.high:
        return ""
    low, high, error = estimate.low, estimate.high, estimate.error
    if not (math.isfinite(error) and error > 0):
        return f"[{low:.4g}, {high:.4g}]"
    decimals = _decimals(max(abs(low), abs(high)), error)
    if f"{low:.{decimals}f}" == f"{high:.{decimals}f}":
        return f"[{low:.2g}, {high:.2g}]"
    return f"[{low:.{decimals}f}, {high:.{decimals}f}]"


def plain(estimate: Estimate | None) -> str:
    """Return a ratio with two or three digits."""
    if estimate is None or not math.isfinite(estimate.value):
        return "–"
    return f"{estimate.value:.2f}" if estimate.value < 10 else f"{estimate.value:.3g}"


def sort_key(estimate: Estimate | None) -> str:
    """Return the number that a table sorts by; empty where there is none."""
    return "" if estimate is None or not math.isfinite(estimate.value) else f"{estimate.value:.9g}"


def setting(key: str, value: object) -> str:
    """Return an entry of a record for people: ('temperature_k', 300.0) -> 'temperature 300 K'."""
    shown = f"{value:g}" if isinstance(value, float) else str(value)
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} {shown} {unit}"
    return f"{key.replace('_', ' ')} {shown}"


def per_day(ns_per_day: float | None) -> str:
    """Return a speed, or that it is not recorded."""
    if ns_per_day is None:
        return "not recorded"
    return f"{ns_per_day / 1000:.3g} µs/day" if ns_per_day >= 1000 else f"{ns_per_day:.3g} ns/day"


def severity(row: Row) -> int:
    """Return how bad a row's word is, 0 for 'agrees'."""
    return _SEVERITY.index(row.verdict)


def worst(rows: Sequence[Row]) -> Row | None:
    """Return the row with the worst word, among equals the one with the greatest value; None for no rows."""
    return max(rows, key=lambda r: (severity(r), r.candidate.value), default=None)


STATE_HEADS = ("State", "Share", "By quarters of each replica", "Drift, p", "Split R-hat", "Relaxes in", "In, out",
               "Left their start", "Allowed")  # fmt: skip
_MOST_STATES = 40


def state_lines(found: Convergence) -> list[tuple[str, ...]]:
    """Return the states of a convergence as lines of `STATE_HEADS`, what is not converged first; no more than forty."""
    order = sorted(found.states, key=lambda s: (not s.fault, min(s.share, 1.0 - s.share) < 1e-3))
    out: list[tuple[str, ...]] = []
    for s in order[:_MOST_STATES]:
        is_state = s.entries is not None
        quarters = "; ".join(f"{100 * q:.3g} ± {100 * e:.2g}" if is_state else f"{q:.2g} ± {e:.2g}"
                             for q, e in zip(s.quarters, s.quarter_errors, strict=True))  # fmt: skip
        out.append((
            s.label,
            f"{100 * s.share:.3g} ± {100 * s.error:.2g} %" if is_state else "",
            quarters + (" %" if is_state else ""),
            f"{s.drift_p:.2g}" if math.isfinite(s.drift_p) else "–",
            f"{s.r_hat:.3g}" if math.isfinite(s.r_hat) else "–",
            format_time_ps(s.relaxation_ps, 2) if math.isfinite(s.relaxation_ps) else "–",
            f"{s.entries}, {s.exits}" if is_state else "",
            f"{s.left} of {s.started}" if is_state else "",
            f"{100 * s.low:.2g} to {100 * s.high:.2g} %" if is_state else "",
        ))  # fmt: skip
    return out


class Card(NamedTuple):
    """One headline number; `verdict` is the word of the row behind it, or empty."""

    title: str
    value: str
    note: str
    verdict: str


class Line(NamedTuple):
    """One metric over all candidates: the first reference's row, and each candidate's own (None where it has none)."""

    group: str
    metric: str
    unit: str
    first: Row
    rows: tuple[Row | None, ...]

    @property
    def all_agree(self) -> bool:
        """Whether no candidate is off in this metric."""
        return all(row is None or row.verdict == "agrees" for row in self.rows)


def cards(evaluation: Evaluation) -> list[Card]:
    """Return the headline numbers: what it is worth, validity, the worst joint map and relaxation time, speed."""
    valid = evaluation.row("valid:all")
    others = "" if valid.reference is None else f"reference {number(valid.reference)} %"
    out = []
    if evaluation.equivalent_time_words and evaluation.equivalent_time:
        best = evaluation.equivalent_time[0]
        out.append(
            Card(
                f"Equivalent MD time, by its {best.measure}",
                f"{best.in_words().split(' [')[0]} of MD",
                best.in_words(),
                "",
            )
        )
    out.append(Card("Valid frames", f"{number(valid.candidate)} %", others, valid.verdict))
    joint = worst([r for r in evaluation.rows if r.key.startswith("joint_jsd")])
    if joint is not None:
        note = f"{plain(joint.ratio)} × a replicate's ({number(joint.replicate)})" if joint.ratio else ""
        out.append(Card(joint.metric, number(joint.candidate), note, joint.verdict))
    slow = worst([r for r in evaluation.rows if r.key.startswith("correlation_time")])
    if slow is not None and slow.reference is not None:
        note = f"reference {number(slow.reference)} ps, ratio {plain(slow.ratio)}"
        out.append(Card(slow.metric, f"{number(slow.candidate)} ps", note, slow.verdict))
    ratio = evaluation.speed_ratio
    if evaluation.summary.ns_per_day is None:
        note = "the file's record holds no cost"
    else:
        note = f"{ratio:.3g} × the reference's" if ratio is not None else "the reference's cost is not recorded"
    return [*out, Card("Speed", per_day(evaluation.summary.ns_per_day), note, "")]


def side_by_side(comparison: Comparison) -> list[Line]:
    """Return every metric that any candidate has, in the table's order, with the row of each candidate.

    Rows are matched by key, so that a metric whose name carries its finding (which bond is farthest off) is one line.
    """
    by_key: dict[str, list[Row | None]] = {}
    n = len(comparison.evaluations)
    for k, evaluation in enumerate(comparison.evaluations):
        for row in evaluation.rows:
            by_key.setdefault(row.key, [None] * n)[k] = row
    lines = []
    for found in by_key.values():
        first = next(row for row in found if row is not None)
        names = {row.metric for row in found if row is not None}
        metric = first.metric if len(names) == 1 else first.metric.split(":")[0]
        lines.append(Line(first.group, metric, first.unit, first, tuple(found)))
    return sorted(lines, key=lambda line: GROUPS.index(line.first.group))
