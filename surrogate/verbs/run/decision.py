"""The decision how a budget is spent on a scene: by the error to expect at its end, from rates measured here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

from surrogate.comparison.answer import MODEL_ERROR
from surrogate.verbs.run.rates import Rates
from systems.errors import InputError
from systems.units import format_time_ps, format_wall

Way = Literal["md", "rollout", "potential"]
Stage = Literal["train", "rollout", "energies", "umbrella md", "md", "held-out md", "report"]


class Plan(NamedTuple):
    """A way in words, and its stages before the report with their shares of what the report leaves."""

    words: str
    shares: dict[Stage, float]


# A rollout's frames are reweighted by energies of an expensive reference, one of which costs as much as a step of MD.
# Some time goes into MD where that comes to so many ps; below it would tell nothing.
_REWEIGHTED: dict[Stage, float] = {"rollout": 0.7, "energies": 0.3}
_MD_BESIDE, _LEAST_MD_PS = 0.3, 50.0
# In explicit water MD is slow, and most of its time goes into replicas under an umbrella potential that the rollout
# tells, where there is so much of it that they make frames: so many times what it takes to begin.
_UMBRELLA, _UMBRELLA_BEGINS = 0.7, 4.0
# MD without a surrogate is compared with itself: it is split by replicas, or by stages if there is one replica.
PLANS: dict[Way, Plan] = {
    "md": Plan("MD for the whole budget", {"md": 1.0}),
    "rollout": Plan("a rollout finds the states, MD from its frames weighs them", {"rollout": 0.5, "held-out md": 0.5}),
    "potential": Plan(
        "a potential that learns from GFN2-xTB finds the states, GFN2-xTB's energies weigh them",
        {"train": 0.6, "rollout": 0.2, "energies": 0.05, "held-out md": 0.15},
    ),
}
_BY_STAGES: dict[Stage, float] = {"md": 0.5, "held-out md": 0.5}
# Of the time of both a rollout has that share of these by which they err least together.
_ROLLED = (0.1, 0.2, 0.3, 0.4, 0.5)
_TOGETHER = "MD and a rollout together"
# MD's answer rests on no assumption: what saves less of its error does not pay.
_PAYS = 0.9
MD_STAGES: tuple[Stage, ...] = ("md", "held-out md")
ALL_MD_STAGES: tuple[Stage, ...] = (*MD_STAGES, "umbrella md")
LEAST_BUDGET_S = 20.0
# Of a replica in explicit water.
_LEAST_MD_FRAMES = 4
# Of a budget: what is planned with, for stages take a while to stop.
_AIM = 0.97
# In fewer a stage that goes on makes nothing more, or one of MD begins in vain.
RESTART_S, LEAST_MD_S = 2.0, 8.0
# Of a run; no stage of MD spends more of its length on coming to equilibrium.
_EQUILIBRATION_SHARE = 0.1
# Of a population that nothing is known of.
_MOST_ERROR = 0.5
# Below this a potential has no time to learn from as many states as it needs.
LEAST_TRAINING_S = 240.0
# The report's share of a budget, and processor seconds that it takes at all, of an atom, and of an atom in a frame.
_REPORT_SHARE, _READING_S = 0.15, (3.0, 0.055, 7e-7)
_LEAST_FRAMES, _MOST_FRAMES = 20_000, 400_000
_NICE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


@dataclass(frozen=True)
class PlannedStage:
    """A stage and the wall seconds that it may take."""

    name: Stage
    seconds: float


@dataclass(frozen=True)
class Decision:
    """How a budget is spent. `why`: the reasons, a line each; `save_every_ps`: of all trajectories, `equilibrate_ps`
    of MD at most; `expected_md_ps`, `expected_rollout_ps`: what all stages come to."""

    way: Way
    why: tuple[str, ...]
    stages: tuple[PlannedStage, ...]
    save_every_ps: float
    equilibrate_ps: float
    expected_md_ps: float
    expected_rollout_ps: float

    def seconds(self, name: Stage) -> float:
        """Return what a stage may take; 0 for one that there is none of."""
        return sum(stage.seconds for stage in self.stages if stage.name == name)


def decide(
    rates: Rates, budget_s: float, way: str = "auto", *, save_every_ps: float | None = None, whole_s: float = 0.0,
    umbrella: bool = True,
) -> Decision:  # fmt: skip
    """Return how `budget_s` (what is left of it, in s of wall time) is spent; `way`: md, surrogate or auto.

    `whole_s`: the budget that was asked for, of which measuring has taken some seconds already; it decides whether a
    potential has time to learn, so that the least budget that is named is enough when it is given. `umbrella`: whether
    MD in explicit water may run under one; a run that goes on keeps the stages that it has begun.

    Raises InputError for a budget in which nothing can be evaluated.
    """
    chosen, why = _choose(rates, max(budget_s, whole_s), way)
    least_s = least_budget_s(rates)
    if budget_s < least_s:
        raise InputError(
            f"a budget of {format_wall(max(budget_s, whole_s, 0.0))} is too short: simulating and evaluating anything "
            f"takes {format_wall(least_s)} on this machine, as busy as it is. Use "
            f"`budget_s='{10 * math.ceil(least_s / 10.0)}s'` or more."
        )
    budget_s *= _AIM
    at_all_s, of_frame_s = _report_s(rates)
    comparison_s = min(0.5 * budget_s, max(_REPORT_SHARE * budget_s, at_all_s + _LEAST_FRAMES * of_frame_s))
    # Of what makes few frames it has less to read; half of its time is to spare.
    n_frames = budget_s * max(rates.md_ps_per_s, rates.rolls.ps_per_s if rates.rolls else 0.0) / _base_ps(rates, chosen)
    comparison_s = min(comparison_s, 2.0 * (at_all_s + n_frames * of_frame_s))
    most = int(min(_MOST_FRAMES, max(_LEAST_FRAMES, (comparison_s - at_all_s) / of_frame_s)))
    left_s = budget_s - comparison_s
    shares = _shares(rates, chosen, budget_s, left_s, umbrella=umbrella)
    stages = [PlannedStage(name, left_s * share) for name, share in shares.items()]
    found = Decision(chosen, why, (*stages, PlannedStage("report", comparison_s)), 0.0, 0.0, 0.0, 0.0)
    md = [md_ps(rates, found, name) for name in shares if name in ALL_MD_STAGES]
    rolled_ps = found.seconds("rollout") * (rates.rolls.ps_per_s if rates.rolls else 0.0)
    return replace(
        found,
        save_every_ps=save_every_ps or _interval(rates, chosen, max(sum(md), rolled_ps) / most),
        equilibrate_ps=_EQUILIBRATION_SHARE * min(md, default=0.0) / rates.replicas,
        expected_md_ps=sum(md),
        expected_rollout_ps=rolled_ps,
    )


def _shares(rates: Rates, way: Way, budget_s: float, left_s: float, *, umbrella: bool) -> dict[Stage, float]:
    """Return the shares of what the report leaves."""
    if way == "md" and rates.replicas == 1:
        return _BY_STAGES
    shares = PLANS[way].shares
    if way != "rollout" or rates.rolls is None:
        return shares
    if rates.expensive:
        beside = _MD_BESIDE if _MD_BESIDE * left_s * rates.md_ps_per_s >= _LEAST_MD_PS else 0.0
        found: dict[Stage, float] = {name: (1.0 - beside) * share for name, share in _REWEIGHTED.items()}
        return {**found, "held-out md": beside} if beside else found
    rolled = min(reversed(_ROLLED), key=lambda share: expected_errors(rates, budget_s, rolled=(share,))[_TOGETHER])
    own = 1.0 - rolled
    weighs = _UMBRELLA * own if umbrella and rates.explicit and rates.at_once > 1 else 0.0
    if weighs * left_s <= _UMBRELLA_BEGINS * rates.begins_s:
        return {"rollout": rolled, "held-out md": own}
    return {"rollout": rolled, "umbrella md": weighs, "held-out md": own - weighs}


def least_budget_s(rates: Rates) -> float:
    """Return the wall seconds in which a run comes to anything; a machine that is busy now may not be in a while. In
    explicit water MD, which has half of them beside a rollout, begins late and is slow."""
    found_s = LEAST_BUDGET_S * min(rates.stretch, 2.0)
    if rates.explicit:
        alone = rates.rolls is None
        frames_ps = _LEAST_MD_FRAMES * _base_ps(rates, "md" if alone else "rollout")
        md_s = rates.begins_s + frames_ps * rates.replicas / rates.md_ps_per_s
        found_s += md_s / ((1.0 - _REPORT_SHARE) if alone else 0.5)
    return found_s


def _report_s(rates: Rates) -> tuple[float, float]:
    """Return the wall seconds that a report takes at all, and of a frame; it runs on one core."""
    at_all_s, of_atom_s, of_atom_frame_s = _READING_S
    busy = rates.stretch
    return busy * (at_all_s + of_atom_s * rates.n_atoms), busy * of_atom_frame_s * rates.n_atoms


def seconds_of_first(pending: Sequence[PlannedStage], left_s: float) -> float:
    """Return the wall seconds that the first stage may take, when `left_s` of the budget are left at its beginning; the
    others keep what was planned for them."""
    return max(left_s - sum(stage.seconds for stage in pending[1:]), RESTART_S)


def md_ps(rates: Rates, decision: Decision, name: Stage) -> float:
    """Return what a stage of MD should come to, in ps, replicas together."""
    return decision.seconds(name) * rates.md_ps_per_s


def _choose(rates: Rates, budget_s: float, way: str) -> tuple[Way, tuple[str, ...]]:
    if way == "md":
        return "md", ("asked for",)
    if rates.rolls is not None:
        errors = expected_errors(rates, budget_s)
        best = min(error for name, error in errors.items() if "rollout" in name)
        by_md = errors["MD from many starts"]
        # Where neither comes to anything it pays at quantum level.
        pays = best < (1.0 if rates.expensive else _PAYS) * by_md or (rates.expensive and best == by_md)
        by_each = ", ".join(f"{100 * error:.2g} % by {name}" for name, error in errors.items())
        said = f"error to expect of populations: {by_each}, with {rates.relaxation_words}"
        if min(errors.values()) >= _MOST_ERROR:
            said = f"no way is sure to see enough with {rates.relaxation_words}; a rollout sees most of it"
        why = (rates.coverage, said)
        return "rollout" if pays or way == "surrogate" else "md", why
    none = f"no weights: {rates.coverage}"
    if rates.expensive and rates.in_water:
        if way == "surrogate":
            raise InputError("a potential learns forces in vacuum; leave `solvent` out, or take `way='md'`.")
        return "md", ("a potential learns forces in vacuum: MD for a molecule in ALPB water", none)
    if rates.expensive:
        if budget_s >= LEAST_TRAINING_S or way == "surrogate":
            force_ms = 1e3 * rates.step_s
            return "potential", (f"a force of the reference takes {force_ms:.3g} ms; a potential learns it", none)
        least = format_wall(LEAST_TRAINING_S)
        return "md", (f"a potential needs a budget of {least} or more to learn in: MD, however little", none)
    if way == "surrogate":
        raise InputError(f"{none}. Train some (`surromd train`) and name them with `weights`, or take `way='md'`.")
    day = format_time_ps(rates.md_ps_per_s * 86_400, 2)
    by_simd = " by SIMD" if rates.at_once > 1 else ""
    return "md", (f"MD is cheap ({day} a day{by_simd}) and nothing covers the scene: no surrogate would pay", none)


def _interval(rates: Rates, way: Way, least_ps: float) -> float:
    """Return the interval between saved frames: a round multiple of the shortest."""
    base_ps = _base_ps(rates, way)
    return base_ps * next((n for n in _NICE if n * base_ps >= least_ps), _NICE[-1])


def _base_ps(rates: Rates, way: Way) -> float:
    """Return the shortest interval between saved frames: what the surrogate, or else MD, steps by."""
    return rates.rolls.lag_ps if rates.rolls and way != "md" else 0.1 if rates.expensive else 1.0


def expected_errors(
    rates: Rates,
    budget_s: float,
    relaxation_ps: float | None = None,
    model_error: float = MODEL_ERROR,
    rolled: Sequence[float] = _ROLLED,
) -> dict[str, float]:
    """Return the root mean square error to expect of the populations of torsion states at the end of a budget, by each
    way to spend it; `relaxation_ps`: the usual one of states (`usual_relaxation`) unless given.

    `hypot(sqrt(relaxation / (2 length)), start (1 - exp(-t)) / t)`: what few independent samples leave (they are two
    relaxation times apart: Mueller-Krumbhaar and Binder, J. Stat. Phys. 8, 1 (1973)) of a `length` of all replicas
    together, and the mean of what is left of where they began, `t` being a replica's length over the relaxation time.
    `start` is 1/2 from one structure and 1/4 from starts spread evenly over two states, the means over all populations
    that the states may have. A rollout is off by `model_error` (0.1 unless given) as well; MD and a rollout that has
    one of the shares `rolled` of the time count each by its error.
    """
    relaxation_ps = max(rates.usual_ps if relaxation_ps is None else relaxation_ps, 1e-3)
    seconds = (1.0 - _REPORT_SHARE) * budget_s

    def error(ps_per_s: float, replicas: int, share: float, start: float) -> float:
        total_ps = max(ps_per_s * share * seconds, 1e-9)
        t = total_ps / replicas / relaxation_ps
        return math.hypot(math.sqrt(0.5 * relaxation_ps / total_ps), start * -math.expm1(-t) / t)

    def by_md(start: float, share: float = 1.0) -> float:
        return error(rates.md_ps_per_s, rates.replicas, share, start)

    found = {"MD from one start": by_md(0.5), "MD from many starts": by_md(0.25 + 0.25 / rates.replicas)}
    if (rolls := rates.rolls) is not None:

        def by_rollout(share: float = 1.0) -> float:
            return math.hypot(error(rolls.ps_per_s, rolls.replicas, share, 0.5), model_error)

        found["a rollout alone"] = by_rollout()
        if not rates.expensive:
            # Transitions of MD do not remember where it began.
            each = [1.0 / math.hypot(1.0 / by_md(0.0, 1.0 - s), 1.0 / by_rollout(s)) for s in rolled]
            found[_TOGETHER] = min(each)
    return {name: min(_MOST_ERROR, error) for name, error in found.items()}


def table(rates: Rates, decision: Decision, budget_s: float) -> dict[str, str]:
    """Return the decision and what it rests on, in words by name."""

    def per_day(ps_per_s: float) -> str:
        return f"{format_time_ps(ps_per_s * 86_400, 3)} a day"

    busy = f", of which other work takes {1.0 - 1.0 / rates.stretch:.0%}" if rates.stretch > 1.1 else ""
    cores = "one core" if rates.cores == 1 else f"{rates.cores} cores"
    lines = {
        "MD": rates.md.rsplit("; about", 1)[0],
        "by OpenMM": f"{per_day(rates.openmm_ps_per_s)} on {cores}{busy}, a replica on each",
    }
    if rates.at_once > 1:
        lines["by SIMD"] = f"{per_day(rates.md_ps_per_s)}, {rates.at_once} replicas on each core"
    elif rates.without_simd:
        lines["by SIMD"] = rates.without_simd
    if (rolls := rates.rolls) is not None:
        lines["by rollout"] = f"{per_day(rolls.ps_per_s)}, {rolls.replicas} replicas of {rolls.weights}"
    reweighted = decision.seconds("energies") and decision.way == "rollout"
    words = "a rollout whose frames the reference's energies weigh" if reweighted else PLANS[decision.way].words
    if decision.seconds("umbrella md"):
        words += ", under an umbrella potential of its torsions"
    lines |= {"way": words, "because": "; ".join(decision.why)}
    for name, seconds in ((stage.name, stage.seconds) for stage in decision.stages):
        lines[name] = format_wall(seconds)
        to_come_ps = decision.expected_rollout_ps if name == "rollout" else md_ps(rates, decision, name)
        if name in (*ALL_MD_STAGES, "rollout") and to_come_ps:
            lines[name] += f", about {format_time_ps(to_come_ps, 2)}"
    lines["in all"] = f"{format_wall(budget_s)}, frames every {format_time_ps(decision.save_every_ps)}"
    return lines
