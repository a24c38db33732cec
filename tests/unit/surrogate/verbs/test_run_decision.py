"""How a budget is spent, from rates that are made up: which way, which stages, and that they fill the budget."""

from __future__ import annotations

from dataclasses import replace

import pytest

from md_reference.run.machine import available_cores
from surrogate.verbs.options import RunOptions
from surrogate.verbs.run.decision import (
    Decision,
    PlannedStage,
    decide,
    expected_errors,
    report_s,
    seconds_of_first,
    table,
)
from surrogate.verbs.run.rates import Rates, Rolls, measured_stretch
from surrogate.verbs.run.stage_clock import Pace
from systems.errors import InputError

# Alanine dipeptide on two cores: 20 ns of MD in a minute, and weights that roll five times as fast.
FAST = Rolls("alanine-dipeptide", 1.0, 1600.0)
COVERED = Rates(22, 2, 1.0, False, "OBC2; about 1", 25e-6, 0.004, 320.0, "trained on it", FAST)
UNCOVERED = replace(COVERED, rolls=None, coverage="elements: S not seen")
DEAR = replace(UNCOVERED, dear=True, step_s=16e-3, timestep_ps=0.0005, md_ps_per_s=0.0625)


def named(decision: Decision) -> list[str]:
    return [stage.name for stage in decision.stages]


def test_weights_that_outrun_md_find_states_and_md_has_most_of_the_time() -> None:
    found = decide(COVERED, 600.0)
    assert found.way == "rollout"
    assert named(found) == ["rollout", "held-out md", "report"]
    assert found.seconds("held-out md") > 5 * found.seconds("rollout")
    assert found.expected_rollout_ps == pytest.approx(1600.0 * found.seconds("rollout"))


def test_weights_slower_than_md_are_not() -> None:
    slow = replace(COVERED, rolls=replace(FAST, ps_per_s=300.0))
    found = decide(slow, 600.0)
    assert found.way == "md" and "no surrogate pays" in found.why[0]
    assert decide(slow, 600.0, "surrogate").way == "rollout", "but by request"


def test_cheap_truth_that_nothing_covers_is_md_with_half_held_out() -> None:
    found = decide(UNCOVERED, 600.0)
    assert found.way == "md" and named(found) == ["md", "report"], "replicas judge each other"
    alone = decide(replace(UNCOVERED, cores=1), 600.0)
    assert named(alone) == ["md", "held-out md", "report"] and alone.seconds("md") == alone.seconds("held-out md")
    assert "S not seen" in found.why[1]
    assert decide(UNCOVERED, 600.0, "surrogate").way == "trained"


def test_no_potential_learns_in_alpb_water() -> None:
    """It would learn the forces of the vacuum and be judged by MD in water."""
    dear = replace(UNCOVERED, dear=True)
    assert decide(dear, 3600.0).way == "potential"
    found = decide(replace(dear, in_water=True), 3600.0)
    assert found.way == "md" and "learns forces in vacuum" in found.why[0]
    with pytest.raises(InputError, match="leave `solvent` out"):
        decide(replace(dear, in_water=True), 3600.0, "surrogate")


def test_md_in_lanes_is_a_rival_of_the_surrogate() -> None:
    simd = replace(COVERED, platform="simd", at_once=16, md_ps_per_s=3200.0)
    found = decide(simd, 600.0)
    assert found.way == "md" and "0.5 times as fast as MD runs here by SIMD: no surrogate pays" in found.why[0]
    lines = dict(table(simd, found, 600.0))
    assert lines["by OpenMM"].startswith("27.6 us a day on 2 cores") and lines["by SIMD"].startswith("276 us a day")
    assert lines["by rollout"] == "138 us a day, 8 replicas of alanine-dipeptide"
    assert simd.replicas == 32 and found.equilibrate_ps == pytest.approx(0.1 * found.expected_md_ps / 32)
    one_core = decide(replace(simd, cores=1), 600.0)
    assert named(one_core) == ["md", "report"], "sixteen replicas of one core judge each other"
    without = replace(COVERED, without_simd="no C++ compiler")
    assert decide(without, 600.0).way == "rollout"
    assert dict(table(without, decide(without, 600.0), 600.0))["by SIMD"] == "no C++ compiler"


@pytest.mark.parametrize("busy", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("foreseen", [1.0, 3.0])
@pytest.mark.parametrize("alone", [1.0, 0.5])
def test_md_ends_when_the_report_of_what_there_is_fits_into_the_rest(
    busy: float, foreseen: float, alone: float
) -> None:
    budget_s = 120.0
    rates = replace(UNCOVERED, stretch=foreseen, md_ps_per_s=320.0 / foreseen, alone=alone)
    found = decide(rates, budget_s)
    wall_s, may_s = 0.0, 1.0
    while wall_s < may_s:
        wall_s += 0.5
        pace = Pace(wall_s, 2 * wall_s / busy)
        may_s = seconds_of_first(found.stages, rates, found.save_every_ps, budget_s, 0, pace)
    frames = pace.processor_s * 160.0 / found.save_every_ps
    assert wall_s + report_s(rates, frames, busy) == pytest.approx(budget_s, rel=0.05)


def test_stages_before_the_last_leave_the_others_what_was_planned() -> None:
    found = decide(COVERED, 600.0)
    planned = sum(stage.seconds for stage in found.stages[1:])
    assert seconds_of_first(found.stages, COVERED, 1.0, 600.0, 0, Pace(50.0, 10.0)) == pytest.approx(600.0 - planned)
    late = [PlannedStage("held-out md", 100.0), PlannedStage("report", 30.0)]
    assert seconds_of_first(late, COVERED, 1.0, 10.0, 0, Pace(0.0, 0.0)) == 2.0, "what is over the budget is short"


def test_what_forgets_its_start_is_expected_to_be_as_good_as_many_starts_and_else_is_not() -> None:
    simd = replace(COVERED, platform="simd", at_once=16, md_ps_per_s=1000.0)
    found = decide(simd, 120.0)
    assert found.way == "rollout"
    slow, fast = (expected_errors(simd, found, tau_ps, 0.05) for tau_ps in (2000.0, 10.0))
    assert slow["MD from one start"] > 2 * slow["MD from many"]
    assert fast["MD from one start"] < 1.2 * fast["MD from many"]
    assert slow["the rollout alone"] > 0.05 and slow["rollout and MD"] < 1.2 * slow["MD from many"]
    longer = expected_errors(simd, decide(simd, 480.0), 2000.0, 0.05)
    assert longer["rollout and MD"] == pytest.approx(slow["rollout and MD"] / 2, rel=0.1)
    assert "rollout and MD" not in expected_errors(UNCOVERED, decide(UNCOVERED, 120.0), 100.0, 0.0)


def test_dear_truth_is_learned_where_there_is_time_to() -> None:
    assert decide(DEAR, 3600.0).way == "potential"
    short = decide(DEAR, 60.0)
    assert short.way == "md" and "needs a budget of 4 min" in short.why[0]
    assert decide(DEAR, 3600.0, "md").way == "md"


def test_the_least_budget_that_is_named_is_enough_although_measuring_took_some_of_it() -> None:
    assert decide(DEAR, 230.0, whole_s=240.0).way == "potential"
    assert decide(DEAR, 230.0, whole_s=239.0).way == "md", "control"


@pytest.mark.parametrize("rates", [COVERED, UNCOVERED, DEAR])
@pytest.mark.parametrize("way", ["auto", "md", "surrogate"])
@pytest.mark.parametrize("budget_s", [30.0, 60.0, 600.0, 36_000.0])
def test_stages_fill_the_budget(rates: Rates, way: str, budget_s: float) -> None:
    found = decide(rates, budget_s, way)
    assert 0.95 * budget_s < sum(stage.seconds for stage in found.stages) <= budget_s
    assert min(stage.seconds for stage in found.stages) > 0.0
    assert table(rates, found, budget_s)[-1][0] == "in all"


def test_frames_are_saved_no_more_often_than_the_judge_can_read() -> None:
    short, long = decide(COVERED, 60.0), decide(COVERED, 36_000.0)
    assert short.save_every_ps < long.save_every_ps
    for found in (short, long):
        assert found.save_every_ps % FAST.lag_ps == 0.0
    assert long.expected_rollout_ps / long.save_every_ps < 400_000
    assert decide(COVERED, 36_000.0, save_every_ps=1.0).save_every_ps == 1.0


def test_work_beside_us_stretches_time() -> None:
    assert 1.0 <= measured_stretch(1, 0.05) <= 30.0
    assert measured_stretch(4 * available_cores(), 0.2) > 2.0, "four threads on each core"


def test_a_budget_in_which_nothing_can_be_judged_is_refused() -> None:
    with pytest.raises(InputError, match="20 s it takes"):
        decide(COVERED, 5.0)
    with pytest.raises(InputError, match="busy"):
        decide(replace(COVERED, stretch=6.0), 22.0)
    decide(COVERED, 22.0)


def test_a_budget_that_is_not_given_is_ten_minutes() -> None:
    assert RunOptions().budget_s == 600.0 and RunOptions(budget_s=60.0).budget_s == 60.0
