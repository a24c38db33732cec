"""From numbers to words: is each metric as a replicate's, within tolerance, wrong; one sentence for the whole; and the
three lines on top of a report: use it or not, for what, why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

from surrogate.comparison.measure.slow_motion import rarely_crossed
from surrogate.comparison.measure.statistics import effective_samples, holm
from surrogate.comparison.rows.rows import UNLIKE_BELOW, ComparisonInput, Group, Row, Word
from surrogate.comparison.rows.validity_rows import copied_from
from systems.chemistry import validity
from systems.units import format_time_ps

Status = Literal["indistinguishable", "close", "different", "broken", "undecided"]

_FAILS_AT = 10.0
_SIGNIFICANCE = 0.05
_SHARE_SIGNIFICANCE = 0.01
_SEVERITY: dict[Word, int] = {"fails": 3, "differs": 2, "close": 1, "agrees": 0, "undecided": 0}
_MENTIONED, _MENTIONED_WHY = 3, 2
LEAST_SAMPLES = 20
# Fewer, and error bars of what follows the slow motion are themselves not known.
LEAST_FOR_TESTS = 5
# Samples that the reference itself holds, however short the candidate is.
LEAST_FOR_EQUIVALENT_TIME = 10
FINITE_KEY, STRAINED_KEY = f"valid:{validity.NOT_FINITE}", f"valid:{validity.BOND_20_PERCENT}"
ALL_KEY = "valid:all"
_WHAT: dict[Group, str] = {
    "validity": "single structures",
    "structure": "bonds, angles, shape and contacts",
    "populations": "populations of states",
    "distributions": "distributions and free energies of torsions",
    "kinetics": "relaxation times and rates",
}


class Cautions(NamedTuple):
    """Why a verdict must wait, in words, empty where it need not: `short` for slow motion sampled too little for
    anything to agree, `apart` for states between which hardly any run passes, so that a difference says nothing,
    `copied` for frames that are the reference's own, `start` for a reference that depends on where it started."""

    short: str = ""
    apart: str = ""
    copied: str = ""
    start: str = ""


SURE = Cautions()


def cautions_of(inputs: ComparisonInput, correlation: float, start: str = "") -> Cautions:
    """Return which slow motions are not sampled, in words. `correlation`: the slowest of any, frames; `start`: what of
    the reference still depends on where it started."""
    short = lost = ""
    samples = effective_samples(round(inputs.compared_ps / inputs.lag_ps), correlation)
    if samples < LEAST_SAMPLES:
        short = (
            f"the slowest motion decorrelates in {format_time_ps(correlation * inputs.lag_ps, 2)}, so there are only "
            f"{samples:.2g} independent samples ({LEAST_SAMPLES} are needed)"
        )
    known = inputs.reference.features, inputs.replicate.features
    apart = rarely_crossed(known, inputs.candidate.features, inputs.torsions)
    if apart:
        named = ", ".join(apart[:_MENTIONED]) + (f" and {len(apart) - _MENTIONED} more" if apart[_MENTIONED:] else "")
        lost = (
            f"it lies in another state of {named} than the reference, and hardly any run passes from one to the other"
        )
    return Cautions(short, lost, copied_from(inputs)[0], start)


def evaluated_rows(rows: Sequence[Row]) -> tuple[Row, ...]:
    """Return the rows with corrected p-values (Holm over all rows) and a word each; what the words mean is in the
    report's definitions."""
    corrected = holm([math.nan if r.form == "share" else r.p_value for r in rows])
    evaluated = [replace(row, p_corrected=p, verdict=_word(row, p)) for row, p in zip(rows, corrected, strict=True)]
    hard = [r.verdict for r in evaluated if r.form == "share" and r.key not in (ALL_KEY, STRAINED_KEY)]
    worst: Word = max(hard, key=lambda word: _SEVERITY[word], default="agrees")
    return tuple(replace(r, verdict=worst) if r.key == ALL_KEY else r for r in evaluated)


def _word(row: Row, p: float) -> Word:
    if row.form == "share":
        return _share_word(row)
    value = row.candidate.value
    if not math.isfinite(value):
        known = row.reference is None or math.isfinite(row.reference.value)
        return "fails" if known else "undecided"
    if not math.isfinite(p):
        return "undecided"
    within = _within_tolerance(row)
    # By a distance no greater than the replicate's own nothing is off.
    beats_replicate = row.form == "distance" and row.ratio is not None and row.ratio.value <= 1.0
    if p < _SIGNIFICANCE and not beats_replicate:
        return "close" if within else "differs"
    if row.form == "distance":
        return "agrees" if within else "undecided"
    if row.reference is None:
        return "undecided"
    # The difference that this much data could just have shown: 1.96 combined standard errors.
    combined = math.hypot(row.reference.error, row.candidate.error)
    return "agrees" if 1.96 * combined <= row.tolerance and max(combined, row.tolerance) > 0.0 else "undecided"


def _within_tolerance(row: Row) -> bool:
    """A distance is held against the replicate baseline (or a bound, where it has no ratio), a number against the
    reference's."""
    if row.form == "distance":
        measured = row.candidate.value if row.ratio is None else row.ratio.value
        return measured <= row.tolerance
    if row.reference is None:
        return False
    return abs(row.candidate.value - row.reference.value) <= row.tolerance


def _share_word(row: Row) -> Word:
    failing = 100.0 - row.candidate.value
    others = [100.0 - e.value for e in (row.reference, row.replicate) if e is not None]
    excess = failing - max(others, default=0.0)
    if not math.isfinite(excess):
        return "fails"
    # Where thermal motion cannot reach, p is NaN: no fault is put down to chance.
    if excess <= 1e-9 or row.p_value > _SHARE_SIGNIFICANCE:
        return "agrees"
    if excess <= row.tolerance:
        return "close"
    return "differs" if excess <= _FAILS_AT * row.tolerance else "fails"


def untested(rows: Sequence[Row], *, start: bool = False) -> list[Row]:
    """Return the rows of a comparison too short to test what follows the slow motion: those rows without a p-value.
    What moves within a state is left out, too, where reference and replicate differ by it: a state that they do not
    share is as good a reason as a wrong. Of a reference that depends on its `start` both share that, and only what is
    fast and steps from frame to frame is tested."""

    def tested(row: Row) -> bool:
        if row.time_scale == "slow" or (start and row.time_scale == "within states"):
            return False
        return row.time_scale == "fast" or not row.p_replicate < UNLIKE_BELOW

    return [r if tested(r) else replace(r, p_value=math.nan, p_replicate=math.nan) for r in rows]


def status(rows: Sequence[Row], cautions: Cautions = SURE) -> Status:
    """Return the word for the whole: that of the worst row; undecided when most statistical rows are, or by
    `cautions`, but that frames which are no molecule are so all the same."""
    words = [r.verdict for r in rows]
    if "fails" in words:
        return "broken"
    if cautions.copied:
        return "undecided"
    if cautions.apart and not any(r.verdict == "differs" and r.kind == "validity" for r in rows):
        return "undecided"
    if "differs" in words:
        return "different"
    statistical = [r.verdict for r in rows if r.form != "share"]
    if cautions.short or cautions.start:
        return "undecided"
    if statistical and statistical.count("undecided") > 0.5 * len(statistical):
        return "undecided"
    return "close" if "close" in words else "indistinguishable"


def findings(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return what is wrong, worst first; within one severity validity first, then by how far beyond the tolerance."""
    bad = [r for r in rows if _SEVERITY[r.verdict] > 0 and r.key != ALL_KEY and r.statement]
    # Beside what is wrong, what is within its tolerance is no finding.
    if any(_SEVERITY[r.verdict] > _SEVERITY["close"] for r in bad):
        bad = [r for r in bad if r.verdict != "close"]
    bad.sort(key=lambda r: (-_SEVERITY[r.verdict], r.key != FINITE_KEY, r.kind != "validity", -_excess(r)))
    return tuple(r.statement for r in bad)


def unlike(rows: Sequence[Row]) -> list[str]:
    """Return a warning where the replicate itself differs from the reference (Holm over all rows)."""
    corrected = holm([math.nan if r.form == "share" else r.p_replicate for r in rows])
    off = [r.metric for r, p in zip(rows, corrected, strict=True) if p < _SIGNIFICANCE]
    warning = (
        f"The replicate itself differs from the reference ({'; '.join(off)}): the two are not samples of one "
        "simulation, or too short; trust no verdict on these metrics."
    )
    return [warning] if off else []


def _excess(row: Row) -> float:
    """How many tolerances off."""
    value = row.candidate.value
    if not math.isfinite(value):
        return math.inf
    if row.form == "distance":
        off = value if row.ratio is None else row.ratio.value - 1.0
    else:
        off = abs(value - (100.0 if row.form == "share" or row.reference is None else row.reference.value))
    return off / row.tolerance if row.tolerance > 0 else off


def sentence(rows: Sequence[Row], found: Sequence[str], compared: str, cautions: Cautions = SURE) -> str:
    """Return the verdict in one or two sentences; `compared` is the compared length in words."""
    n, undecided = len(rows), sum(r.verdict == "undecided" for r in rows)
    close = sum(r.verdict == "close" for r in rows)
    more = f" (and {len(found) - _MENTIONED} more)" if len(found) > _MENTIONED else ""
    worst = f"{'; '.join(found[:_MENTIONED])}{more}"
    why = "; ".join(filter(None, reversed(cautions))) or "the error bars are wider than the tolerances"
    said = {
        "broken": f"Broken: {worst}.",
        "different": f"Differs from reference MD over {compared}: {worst}.",
        "close": f"Close to reference MD over {compared}: {close} of {n} metrics measurably off, each within its "
        f"tolerance: {worst}.",
        "undecided": f"Undecided over {compared}: {why}." + (f" Significant as it stands: {worst}." if found else ""),
        "indistinguishable": f"Indistinguishable from reference MD over {compared}: none of {n - undecided} metrics "
        "differs significantly from it.",
    }[status(rows, cautions)]
    if undecided:
        said += f" {undecided} of {n} metrics are left undecided."
    return said


def in_short(
    rows: Sequence[Row], status: Status, findings: Sequence[str], cautions: Cautions = SURE, equivalent_time: str = ""
) -> tuple[str, str, str]:
    """Return the three lines: whether to use the trajectory in place of reference MD, for what, and why."""
    good, bad, unknown = map("; ".join, _sorted(rows, cautions))
    for_what = f"Right: {good or 'nothing that could be tested'}."
    for_what += f" Wrong: {bad}." if bad else ""
    for_what += f" Not known: {unknown}." if unknown else ""
    why = "; ".join(findings[:_MENTIONED_WHY])
    if status == "broken":
        return "Do not use it.", "For nothing: frames are no molecules, or do not move as one.", f"Why: {why}."
    use = {
        "undecided": "Not known yet whether it can be used.",
        "different": "Use it only for what is listed as right.",
        "close": "Use it within its tolerances.",
    }.get(status, "Use it.")
    if status == "undecided":
        why = next(filter(None, reversed(cautions)), "the error bars are wider than what would matter")
    elif status == "different":
        why += f". What is not known waits: {cautions.start}" if cautions.start else ""
    else:
        why = (
            f"{why}, each within its tolerance"
            if why
            else "nothing measured differs from reference MD by more than chance"
        )
    return use, for_what, f"Why: {why}. {equivalent_time}".rstrip()


def _sorted(rows: Sequence[Row], cautions: Cautions) -> tuple[list[str], list[str], list[str]]:
    """Return what is right, what is wrong and what is not known, by the words of each group's rows. While slow motion
    is not sampled, only what is fast can be right; of copies nothing can."""
    found: tuple[list[str], list[str], list[str]] = ([], [], [])
    for group, name in _WHAT.items():
        words = [r.verdict for r in rows if r.group == group and r.key != ALL_KEY]
        if words:
            may_be = not cautions.copied and (group in ("validity", "structure") or not any(cautions))
            right = may_be and 2 * sum(w in ("agrees", "close") for w in words) >= len(words)
            found[1 if {"differs", "fails"} & set(words) else 0 if right else 2].append(name)
    return found
