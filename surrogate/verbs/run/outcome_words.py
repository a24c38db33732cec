"""What came of a run, in words: MD's answer first, then the rollout beside it and what it saved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from surrogate.judge.remarks import LEAST_SAMPLES
from surrogate.verbs.run.decision import Way
from surrogate.verbs.run.run_record import Outcome
from systems.units import format_time_ps, format_wall

if TYPE_CHECKING:
    from surrogate.judge.comparison import Comparison
    from surrogate.judge.md_answer import Answer
    from surrogate.judge.worth import Worth


@dataclass(frozen=True)
class Costs:
    """Wall seconds of a candidate: of rolling it, and of training its weights here; `md_ps_per_s`: what MD simulates in
    such a second; `budget_s`: of all."""

    rolling_s: float
    training_s: float
    md_ps_per_s: float
    budget_s: float


def outcome(
    way: Way, comparison: Comparison, costs: Costs, answer: Answer | None = None, notes: tuple[str, ...] = ()
) -> Outcome:
    """Return what a run comes to: its MD's `answer`, and a comparison of its trajectory with its held-out MD.

    Where replicas are too short to have forgotten their starts, no equivalent MD time is told.
    """
    judged = comparison.judgements[0]
    held_ps = comparison.reference.total_ps
    if comparison.replicate is not None:
        held_ps += comparison.replicate.total_ps
    rolled_ps = judged.account.total_ps
    forgot = answer is None or answer.method == "plain averages"
    worth = None
    if judged.worth_words and forgot:
        worth = next((w for w in judged.worth if w.kind == "distribution"), None)
    gain = _least_gain(worth, costs) if way != "md" else None
    held = f"{format_time_ps(held_ps, 2)} of held-out MD"
    if way == "md":
        replicas = judged.account.n_segments
        each = f" in {replicas} replicas of {format_time_ps(rolled_ps / replicas, 2)}" if replicas > 1 else ""
        head = f"{format_time_ps(rolled_ps, 2)} of MD{each}, and {held} that judges it"
        head += f": worth {worth.in_words()} of MD by its {worth.measure}." if worth else f": {judged.status}."
        head += f" With the held-out half there are {format_time_ps(rolled_ps + held_ps, 2)} to use."
    elif not forgot:
        head = (
            f"No equivalent MD time of the {format_time_ps(rolled_ps, 2)} of the surrogate: MD's replicas are too "
            "short for averages of theirs, and begin where the surrogate was."
        )
    elif worth is None:
        head = (
            f"{held} tell no worth of the {format_time_ps(rolled_ps, 2)} of the surrogate, which are {judged.status}."
        )
    else:
        head = (
            f"{held}; the {format_time_ps(rolled_ps, 2)} of the surrogate are worth {worth.in_words()} of MD by its "
            f"{worth.measure}; {_gain_words(worth, gain, costs)}"
        )
    if judged.status == "undecided" and 0.0 < judged.effective_samples < LEAST_SAMPLES:
        n = judged.effective_samples
        longer = format_wall(float(f"{costs.budget_s * LEAST_SAMPLES / n:.2g}"))
        head += f" Of the slowest motion {n:.2g} independent samples were seen, of {LEAST_SAMPLES} that it takes: "
        head += f"a budget of about {longer} would tell."
    if answer is not None:
        head = " ".join(filter(None, (answer.headline, answer.on_surrogate, head)))
    return Outcome(
        head,
        judged.status,
        judged.verdict,
        held_ps,
        rolled_ps,
        worth.in_words() if worth else "",
        gain,
        answer.headline if answer else "",
        answer.on_surrogate if answer else "",
        answer.holds and not answer.missing if answer else False,
        notes,
    )


def _least_ps(worth: Worth) -> float:
    """Return the least that a worth may be, in ps of MD."""
    if worth.bound == "less than":
        return 0.0
    if worth.low_ps is not None:
        return worth.low_ps
    return worth.worth_ps if worth.bound == "at least" else 0.0


def _least_gain(worth: Worth | None, costs: Costs) -> float | None:
    """Return what MD of a worth's lower end would cost, over what the candidate did; training here counts."""
    if worth is None or costs.md_ps_per_s <= 0.0:
        return None
    # Where MD at hand ends first, the part of the rollout that comes as near is what it is the worth of.
    spent_s = costs.training_s + worth.share * costs.rolling_s
    return _least_ps(worth) / (costs.md_ps_per_s * max(spent_s, 1e-9))


def _gain_words(worth: Worth, gain: float | None, costs: Costs) -> str:
    if gain is None:
        return "what MD of it would cost is not known."
    spent_s = costs.training_s + worth.share * costs.rolling_s
    training = f", training included ({format_wall(costs.training_s)})" if costs.training_s else ""
    bought = format_time_ps(costs.md_ps_per_s * spent_s, 2)
    if gain >= 1.0:
        return f"gain at least {gain:.2g}: in the {format_wall(spent_s)} that took{training}, MD makes {bought}."
    most_ps = worth.high_ps if worth.bound == "" else None if worth.bound == "at least" else worth.worth_ps
    if most_ps is not None and most_ps < costs.md_ps_per_s * spent_s:
        return f"MD was the better choice: in the {format_wall(spent_s)} that took{training}, it makes {bought}."
    return (
        f"no gain is shown (at least {gain:.2g}): in the {format_wall(spent_s)} that took{training}, MD makes {bought}."
    )
