"""What came of a run, in words: MD's answer in three lines, then the rollout beside it and what it saved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from surrogate.comparison.verdict import LEAST_SAMPLES
from surrogate.verbs.run.decision import Way
from surrogate.verbs.run.run_record import Outcome
from systems.units import format_time_ps, format_wall

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison, Evaluation, Summary
    from surrogate.comparison.equivalent_time import EquivalentTime
    from surrogate.comparison.md_answer import Answer


@dataclass(frozen=True)
class Costs:
    """Wall seconds of a candidate: of rolling it, and of training its weights here; `md_ps_per_s`: what MD simulates in
    such a second by the fastest way here, `by` which and in how many `replicas`; `budget_s`: of all."""

    rolling_s: float
    training_s: float
    md_ps_per_s: float
    budget_s: float
    replicas: int = 1
    by: str = "OpenMM"


def outcome(
    way: Way, comparison: Comparison, costs: Costs, answer: Answer | None = None, notes: tuple[str, ...] = ()
) -> Outcome:
    """Return what a run comes to: its MD's `answer`, and a comparison of its trajectory with its held-out MD."""
    evaluated = comparison.evaluations[0]
    held = [comparison.reference, *([] if comparison.replicate is None else [comparison.replicate])]
    equivalent_time = (
        next((w for w in evaluated.equivalent_time if w.kind == "distribution"), None)
        if evaluated.equivalent_time_words
        else None
    )
    speed_up = _least_speed_up(equivalent_time, costs) if way != "md" else None
    rolled = _length([evaluated.summary])
    if way == "md":
        said = f"{rolled} of MD, evaluated by {_length(held)}"
        said += (
            f": equivalent to {equivalent_time.in_words()} of MD by its {equivalent_time.measure}."
            if equivalent_time
            else f": {evaluated.status}."
        )
    elif equivalent_time is None:
        said = f"No equivalent MD time is told of {rolled} of the surrogate, which are {evaluated.status}."
    else:
        said = f"{rolled} of the surrogate are equivalent to {equivalent_time.in_words()} of MD by its "
        said += f"{equivalent_time.measure}; "
        said += _speed_up_words(equivalent_time, speed_up, costs)
    lines = evaluated.in_short if answer is None else answer.in_short
    on_surrogate = answer.on_surrogate if answer else ""
    if answer is not None and on_surrogate and not answer.is_sure and not answer.is_by_surrogate:
        on_surrogate = "MD has not converged, and cannot say whether the surrogate's populations are right."
    return Outcome(
        headline=" ".join(lines),
        in_short=lines,
        details=" ".join(filter(None, (on_surrogate, said, _remedy(comparison, costs)))),
        status=evaluated.status,
        verdict=evaluated.verdict,
        held_out_ps=sum(a.total_ps for a in held),
        rolled_ps=evaluated.summary.total_ps,
        equivalent_time=equivalent_time.in_words() if equivalent_time else "",
        speed_up=speed_up,
        on_surrogate=on_surrogate,
        converged=answer.holds and not answer.missing if answer else False,
        notes=notes,
    )


def lines_of(way: Way, evaluated: Evaluation, answer: Answer | None) -> tuple[str, str, str]:
    """Return the three lines on top of the report, which say of the trajectory what MD's answer says: a comparison
    counts all frames of MD alike, and MD's transitions weigh them."""
    if answer is None or evaluated.status == "broken":
        return evaluated.in_short
    if way == "md":
        return answer.in_short
    if answer.is_by_surrogate:
        return answer.in_short
    told = [s for s in answer.states if s.surrogate is not None and not s.missing]
    off = [s for s in told if s.differs]
    if not answer.is_sure or not told:
        use, for_what = "Not known yet whether the surrogate can be used.", "It found the states that MD began in."
        return use, for_what, "Why: the MD it is compared with has not converged."
    right = f"Right: populations of {len(told) - len(off)} of {len(told)} states."
    if off:
        wrong = ", ".join(f"{s.torsion} {s.state}" for s in off[:3]) + (", and more" if len(off) > 3 else "")
        return "Use MD's populations, not the surrogate's.", f"{right} Wrong: {wrong}.", f"Why: {answer.on_surrogate}"
    if answer.method == "plain averages" or evaluated.status in ("agrees", "close"):
        return evaluated.in_short
    return "Use the surrogate for populations.", right, f"Why: {answer.on_surrogate}"


def _length(summaries: list[Summary]) -> str:
    """Return such as '32 replicas of 3.8 ns', which is no length of one run."""
    n = sum(a.n_segments for a in summaries)
    each = format_time_ps(sum(a.total_ps for a in summaries) / n, 2)
    return f"{n} replicas of {each}" if n > 1 else each


def _remedy(comparison: Comparison, costs: Costs) -> str:
    """Return what would tell more; a longer budget where its replicas outlast the slowest relaxation that was seen."""
    found, evaluated = comparison.convergence, comparison.evaluations[0]
    if found is not None and not found.converged and not found.n_replicas:
        return f"the MD it is compared with is too short to be tested: {found.reasons[0]}."
    if found is not None and not found.converged:
        said = f"MD, {found.verdict.rstrip('.')}; {found.remedy}"
        if found.needed_ps is None or found.needed_ps <= found.replica_ps:
            return f"{said}."
        return f"{said}: a budget of about {_wall(costs.budget_s * found.needed_ps / found.replica_ps)}."
    n = evaluated.effective_samples
    if evaluated.status == "undecided" and 0.0 < n < LEAST_SAMPLES:
        return (
            f"Of the slowest motion {n:.2g} independent samples were seen, of {LEAST_SAMPLES} that it takes: a budget "
            f"of about {_wall(costs.budget_s * LEAST_SAMPLES / n)} would tell."
        )
    return ""


def _wall(seconds: float) -> str:
    return format_wall(float(f"{seconds:.2g}"))


def _least_speed_up(equivalent_time: EquivalentTime | None, costs: Costs) -> float | None:
    """Return what MD of an equivalent MD time's lower end would cost, over what the candidate did; training here
    counts."""
    if equivalent_time is None or costs.md_ps_per_s <= 0.0:
        return None
    least_ps = (
        equivalent_time.low_ps
        if equivalent_time.low_ps is not None
        else equivalent_time.equivalent_ps
        if equivalent_time.bound == "at least"
        else 0.0
    )
    # Where MD at hand ends first, the part of the rollout that comes as near is what it is the equivalent MD time of.
    spent_s = costs.training_s + equivalent_time.share * costs.rolling_s
    return (0.0 if equivalent_time.bound == "less than" else least_ps) / (costs.md_ps_per_s * max(spent_s, 1e-9))


def _speed_up_words(equivalent_time: EquivalentTime, speed_up: float | None, costs: Costs) -> str:
    if speed_up is None:
        return "what MD of it would cost is not known."
    spent_s = costs.training_s + equivalent_time.share * costs.rolling_s
    training = f", training included ({format_wall(costs.training_s)})" if costs.training_s else ""
    each = format_time_ps(costs.md_ps_per_s * spent_s / costs.replicas, 2)
    bought = f"{costs.replicas} replicas of {each}" if costs.replicas > 1 else each
    rival = f"in the {format_wall(spent_s)} that took{training}, MD by {costs.by}, the fastest here, makes {bought}."
    if speed_up >= 1.0:
        return f"speed-up at equal accuracy at least {speed_up:.2g}: {rival}"
    most_ps = (
        equivalent_time.high_ps
        if equivalent_time.bound == ""
        else None
        if equivalent_time.bound == "at least"
        else equivalent_time.equivalent_ps
    )
    if most_ps is not None and most_ps < costs.md_ps_per_s * spent_s:
        return f"MD was the better choice: {rival}"
    return f"no speed-up is shown (at least {speed_up:.2g}): {rival}"
