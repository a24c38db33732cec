"""The decision how a budget is spent on a scene: by MD, or by a surrogate that MD then judges, from measured rates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

from surrogate.verbs.run.rates import Rates
from surrogate.verbs.run.stage_clock import Pace
from systems.errors import InputError
from systems.units import format_time_ps, format_wall

Way = Literal["md", "rollout", "potential", "trained"]
Stage = Literal["training md", "train", "rollout", "md", "held-out md", "report"]

WAYS: dict[Way, str] = {
    "md": "MD for the whole budget, from many starts",
    "rollout": "a rollout finds the states, MD from its frames weighs them",
    "potential": "a potential that learns from GFN2-xTB finds the states, MD weighs them",
    "trained": "weights trained on MD made here find the states, other MD weighs them",
}
# Shares of what is left when the report is paid for; MD that is held out comes last, and takes what others leave. MD
# that judges itself is split by replicas, or by stages if there is one replica.
_BY_STAGES: tuple[tuple[Stage, float], ...] = (("md", 0.5), ("held-out md", 0.5))
_SHARES: dict[Way, tuple[tuple[Stage, float], ...]] = {
    "md": (("md", 1.0),),
    "rollout": (("rollout", 0.15), ("held-out md", 0.85)),
    "potential": (("train", 0.6), ("rollout", 0.1), ("held-out md", 0.3)),
    "trained": (("training md", 0.3), ("train", 0.4), ("rollout", 0.1), ("held-out md", 0.2)),
}
LEAST_BUDGET_S = 20.0
# Of a budget: what is planned with, for stages take a while to stop and estimates are none of the best.
_AIM = 0.97
# Processor seconds before the first step of a stage of MD: processes start, forces are built.
_START_S = 4.0
# In fewer a stage that goes on makes nothing more.
RESTART_S = 2.0
# Of a run; no stage of MD spends more of its length on coming to equilibrium.
_EQUILIBRATION_SHARE = 0.1
# Below this a potential has no time to learn from as many states as it needs.
LEAST_TRAINING_S = 240.0
# The judge: processor seconds until its libraries are loaded (while the last MD runs), then at all, of an atom, and of
# an atom in a frame; what it is meant to take of a budget, and may.
_JUDGE_LOADING_S, _JUDGE_S, _JUDGE_ATOM_S, _JUDGE_ATOM_FRAME_S = 3.5, 3.0, 0.055, 7e-7
_JUDGE_SHARE, _MOST_FOR_REPORT = 0.1, 0.5
# After so long it is known from a stage of MD how busy the machine is.
_PACE_TOLD_S = 5.0
_LEAST_STAGE_S = 2.0
_MOST_FRAMES, _LEAST_FRAMES = 400_000, 4_000
_MOST_STRETCH_FORESEEN = 2.0
MD_STAGES: tuple[Stage, ...] = ("training md", "md", "held-out md")
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
    rates: Rates, budget_s: float, way: str = "auto", *, save_every_ps: float | None = None, whole_s: float = 0.0
) -> Decision:
    """Return how `budget_s` (what is left of it, in s of wall time) is spent; `way`: md, surrogate or auto.

    `whole_s`: the budget that was asked for, of which measuring has taken some seconds already; it decides whether a
    potential has time to learn, so that the least budget that is named is enough when it is given.

    Raises InputError for a budget in which nothing can be judged.
    """
    chosen, why = _choose(rates, max(budget_s, whole_s), way)
    shares = _shares(rates, chosen)
    least_s = least_budget_s(rates, chosen)
    if budget_s < least_s:
        raise InputError(
            f"{format_wall(max(budget_s, 0.0))} are left, too few to simulate and judge anything on this machine, as "
            f"busy as it is: {format_wall(least_s)} it takes. Use a longer `budget_s`."
        )
    budget_s *= _AIM
    most = _frames(rates, budget_s)
    found = _divided(rates, chosen, why, shares, budget_s, most)
    every_ps = save_every_ps or _interval(rates, chosen, max(found.expected_md_ps, found.expected_rollout_ps) / most)
    # Of a slow scene fewer frames come together than the judge could read.
    frames = min(most, int((found.expected_md_ps + found.expected_rollout_ps) / every_ps))
    return replace(_divided(rates, chosen, why, shares, budget_s, frames), save_every_ps=every_ps)


def _shares(rates: Rates, way: Way) -> dict[Stage, float]:
    return dict(_BY_STAGES if way == "md" and rates.replicas == 1 else _SHARES[way])


def least_budget_s(rates: Rates, way: Way) -> float:
    """Return the wall seconds that the stages of a way need to come to anything."""
    n_md = sum(name in MD_STAGES for name in _shares(rates, way))
    # A machine may be less busy in a while: where it is not, stages come to nothing, and say so.
    seconds = _JUDGE_LOADING_S + _judge_s(rates, 0) + 2.0 * n_md * _START_S
    return max(LEAST_BUDGET_S, seconds * min(rates.stretch, _MOST_STRETCH_FORESEEN))


def least_md_s(rates: Rates) -> float:
    """Return the wall seconds in which a stage of MD comes to something, as busy as the machine is."""
    return _START_S * max(2.0, rates.stretch)


def report_s(rates: Rates, frames: float, stretch: float) -> float:
    """Return the wall seconds that judging so many frames takes, on one core; `stretch`: as of `Rates`, by now."""
    return _judge_s(rates, frames) * max(1.0, stretch * rates.alone)


def _judge_s(rates: Rates, frames: float) -> float:
    """Return the processor seconds of judging so many frames."""
    return _JUDGE_S + (_JUDGE_ATOM_S + _JUDGE_ATOM_FRAME_S * frames) * rates.n_atoms


def seconds_of_first(
    pending: Sequence[PlannedStage], rates: Rates, save_every_ps: float, left_s: float, frames: int, pace: Pace
) -> float:
    """Return the wall seconds that the first stage may take, when `left_s` of the budget are left at its beginning.

    The others keep what was planned for them. If MD is the last before the report, its `pace` says how busy the machine
    is by now, and so what a report will take of the frames that there are: `frames` before, and its own.
    """
    first, *later = pending
    others_s = sum(stage.seconds for stage in later)
    is_last = [stage.name for stage in later] == ["report"]
    if is_last and first.name in MD_STAGES and pace.wall_s >= _PACE_TOLD_S:
        stretch = rates.cores * pace.wall_s / max(pace.processor_s, 1e-3)
        ps_of_core_s = rates.md_ps_per_s * rates.stretch / rates.cores
        frames += round(pace.processor_s * ps_of_core_s / save_every_ps)
        others_s = min(report_s(rates, frames, stretch), _MOST_FOR_REPORT * left_s)
    return max(left_s - others_s, _LEAST_STAGE_S)


def _divided(
    rates: Rates, way: Way, why: tuple[str, ...], shares: dict[Stage, float], budget_s: float, frames: int
) -> Decision:
    """Return the decision for a way: the budget divided by its `shares`, when so many frames are read at the end."""
    judge_s = min(_MOST_FOR_REPORT * budget_s, report_s(rates, frames, rates.stretch))
    left_s = budget_s - judge_s
    stages = [PlannedStage(name, left_s * share) for name, share in shares.items()]
    found = Decision(way, why, (*stages, PlannedStage("report", judge_s)), 0.0, 0.0, 0.0, 0.0)
    expected_ps = {name: md_ps(rates, found, name) for name in shares if name in MD_STAGES}
    return replace(
        found,
        equilibrate_ps=_EQUILIBRATION_SHARE * min(expected_ps.values()) / rates.replicas,
        expected_md_ps=sum(expected_ps.values()),
        expected_rollout_ps=found.seconds("rollout") * (rates.rolls.ps_per_s if rates.rolls else 0.0),
    )


def md_ps(rates: Rates, decision: Decision, name: Stage) -> float:
    """Return what a stage of MD should come to, in ps, replicas together."""
    return max(decision.seconds(name) - _START_S * rates.stretch, 1.0) * rates.md_ps_per_s


def _choose(rates: Rates, budget_s: float, way: str) -> tuple[Way, tuple[str, ...]]:
    if way == "md":
        return "md", ("asked for",)
    by_simd = " by SIMD" if rates.at_once > 1 else ""
    if rates.rolls is not None:
        ratio = rates.rolls.ps_per_s / rates.md_ps_per_s
        speeds = f"{rates.rolls.weights} rolls {ratio:.2g} times as fast as MD runs here{by_simd}"
        if ratio > 1.0 or way == "surrogate":
            return "rollout", (speeds, rates.coverage)
        return "md", (f"{speeds}: no surrogate pays", rates.coverage)
    none = f"no weights: {rates.coverage}"
    if rates.dear and rates.in_water:
        if way == "surrogate":
            raise InputError("a potential learns forces in vacuum; leave `solvent` out, or take `way='md'`.")
        return "md", ("a potential learns forces in vacuum: MD for a molecule in ALPB water", none)
    if rates.dear:
        if budget_s >= LEAST_TRAINING_S or way == "surrogate":
            force_ms = 1e3 * rates.step_s
            return "potential", (f"a force of the truth takes {force_ms:.3g} ms; a potential learns it", none)
        least = format_wall(LEAST_TRAINING_S)
        return "md", (f"a potential needs a budget of {least} or more to learn in: MD, however little", none)
    if way == "surrogate":
        return "trained", ("asked for; MD is cheap, and what it is trained on would answer by itself", none)
    day = format_time_ps(rates.md_ps_per_s * 86_400, 2)
    return "md", (f"MD is cheap ({day} a day{by_simd}) and nothing covers the scene: no surrogate would pay", none)


def _frames(rates: Rates, budget_s: float) -> int:
    """Return how many frames in all the judge reads in its share of the budget."""
    at_all_s = _judge_s(rates, 0)
    judge_s = max(0.5 * at_all_s, _JUDGE_SHARE * budget_s - at_all_s)
    return int(min(_MOST_FRAMES, max(_LEAST_FRAMES, judge_s / (_JUDGE_ATOM_FRAME_S * rates.n_atoms))))


def _interval(rates: Rates, way: Way, least_ps: float) -> float:
    """Return the interval between saved frames: a round multiple of what the surrogate, or else MD, steps by."""
    base_ps = rates.rolls.lag_ps if rates.rolls and way != "md" else 0.1 if rates.dear else 1.0
    return base_ps * next((n for n in _NICE if n * base_ps >= least_ps), _NICE[-1])


def expected_errors(rates: Rates, decision: Decision, relaxation_ps: float, model_error: float) -> dict[str, float]:
    """Return the error to expect of the population of a state that is there half of the time, at the end of a budget.

    Of all MD together `sqrt(relaxation / length) / sqrt(2)` (independent samples are two relaxation times apart:
    Müller-Krumbhaar and Binder, J. Stat. Phys. 8, 1 (1973)). Replicas from one start have their mean bias beside that,
    half of `(1 - exp(-t)) / t` with t their length over the relaxation time; those from many are weighted by their
    transitions and have none. A rollout has its `model_error`.
    """
    seconds = sum(stage.seconds for stage in decision.stages if stage.name != "report")

    def sampling(total_ps: float) -> float:
        return min(0.5, math.sqrt(0.5 * relaxation_ps / max(total_ps, 1e-9)))

    all_md_ps = rates.md_ps_per_s * seconds
    lengths = max(all_md_ps / rates.replicas / max(relaxation_ps, 1e-9), 1e-9)
    bias = 0.5 * -math.expm1(-lengths) / lengths
    found = {"MD from one start": math.hypot(sampling(all_md_ps), bias), "MD from many": sampling(all_md_ps)}
    if rates.rolls is not None and decision.way != "md":
        own_ps = rates.md_ps_per_s * decision.seconds("held-out md")
        found["the rollout alone"] = math.hypot(sampling(rates.rolls.ps_per_s * seconds), model_error)
        found["rollout and MD"] = sampling(own_ps)
    return found


def table(rates: Rates, decision: Decision, budget_s: float) -> list[tuple[str, str]]:
    """Return the decision and what it rests on, as lines of a name and a text."""

    def per_day(ps_per_s: float) -> str:
        return f"{format_time_ps(ps_per_s * 86_400, 3)} a day"

    busy = f", of which other work takes {1.0 - 1.0 / rates.stretch:.0%}" if rates.stretch > 1.1 else ""
    cores = "one core" if rates.cores == 1 else f"{rates.cores} cores"
    lines = [
        ("MD", rates.md.rsplit("; about", 1)[0]),
        ("by OpenMM", f"{per_day(rates.openmm_ps_per_s)} on {cores}{busy}, a replica on each"),
    ]
    if rates.at_once > 1:
        lines.append(("by SIMD", f"{per_day(rates.md_ps_per_s)}, {rates.at_once} replicas on each core"))
    elif rates.without_simd:
        lines.append(("by SIMD", rates.without_simd))
    if (rolls := rates.rolls) is not None:
        lines.append(("by rollout", f"{per_day(rolls.ps_per_s)}, {rolls.replicas} replicas of {rolls.weights}"))
    lines.append(("way", WAYS[decision.way]))
    lines += [("because", reason) for reason in decision.why]
    lines += [(stage.name, f"{format_wall(stage.seconds)}{_to_come(stage.name, decision, rates)}")
              for stage in decision.stages]  # fmt: skip
    lines.append(("in all", f"{format_wall(budget_s)}, frames every {format_time_ps(decision.save_every_ps)}"))
    return lines


def _to_come(name: Stage, decision: Decision, rates: Rates) -> str:
    """Return what a stage is expected to come to."""
    if name in MD_STAGES:
        return f", about {format_time_ps(md_ps(rates, decision, name), 2)}"
    if name == "rollout" and decision.expected_rollout_ps:
        return f", about {format_time_ps(decision.expected_rollout_ps, 2)}"
    return ""
