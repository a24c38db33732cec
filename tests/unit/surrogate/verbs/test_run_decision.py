"""How a budget is spent, from rates that are made up: which way, which stages, and that they fill the budget."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from md_reference.run.machine import available_cores
from surrogate.verbs.options import RunOptions
from surrogate.verbs.run.decision import (
    Decision,
    PlannedStage,
    decide,
    expected_errors,
    seconds_of_first,
    table,
)
from surrogate.verbs.run.rates import Rates, Rolls, measured_stretch
from systems.errors import InputError

# Alanine dipeptide on two cores: 20 ns of MD in a minute, and weights that roll five times as fast.
FAST = Rolls("alanine-dipeptide", 1.0, 1600.0, 8, 2000.0)
COVERED = Rates(22, 2, 1.0, False, "OBC2; about 1", 25e-6, 0.004, 320.0, "trained on it", FAST)
UNCOVERED = replace(COVERED, rolls=None, coverage="elements: S not seen")
EXPENSIVE = replace(UNCOVERED, expensive=True, step_s=16e-3, timestep_ps=0.0005, md_ps_per_s=0.0625)


def named(decision: Decision) -> list[str]:
    return [stage.name for stage in decision.stages]


def test_where_md_forgets_its_start_too_slowly_a_rollout_finds_the_states() -> None:
    fast = replace(FAST, ps_per_s=16_000.0)
    slow = replace(COVERED, rolls=replace(fast, relaxation_ps=20_000.0))
    found = decide(slow, 60.0)
    assert found.way == "rollout" and named(found) == ["rollout", "held-out md", "report"]
    assert found.seconds("held-out md") == found.seconds("rollout"), "in a minute MD adds next to nothing"
    able = decide(replace(slow, at_once=16, md_ps_per_s=3200.0), 3600.0)
    assert able.way == "rollout" and able.seconds("held-out md") > 2 * able.seconds("rollout")
    assert found.expected_rollout_ps == pytest.approx(16_000.0 * found.seconds("rollout"))
    assert "a slowest relaxation of 20 ns, as the first rollouts show" in found.why[1]
    usual = replace(slow, rolls=replace(fast, relaxation_ps=20_000.0, usual_ps=20.0))
    assert decide(usual, 60.0).way == "md", "nor where most states are known at once"
    assert "a slowest relaxation of 20 ns, that of states 20 ps" in decide(usual, 60.0).why[1]
    quick = replace(COVERED, rolls=replace(fast, relaxation_ps=20.0))
    assert decide(quick, 60.0).way == "md", "what MD forgets at once needs no rollout"
    lame = replace(slow, rolls=replace(FAST, ps_per_s=10.0, relaxation_ps=20_000.0))
    assert decide(lame, 60.0).way == "md", "a rollout that sees no state but its first finds none"
    assert decide(lame, 60.0, "surrogate").way == "rollout", "but by request"


def test_cheap_reference_that_nothing_covers_is_md_with_half_held_out() -> None:
    found = decide(UNCOVERED, 600.0)
    assert found.way == "md" and named(found) == ["md", "report"], "replicas evaluate each other"
    alone = decide(replace(UNCOVERED, cores=1), 600.0)
    assert named(alone) == ["md", "held-out md", "report"] and alone.seconds("md") == alone.seconds("held-out md")
    assert "S not seen" in found.why[1]
    with pytest.raises(InputError, match=r"S not seen\. Train some"):
        decide(UNCOVERED, 600.0, "surrogate")


def test_no_potential_learns_in_alpb_water() -> None:
    """It would learn the forces of the vacuum and be evaluated by MD in water."""
    expensive = replace(UNCOVERED, expensive=True)
    assert decide(expensive, 3600.0).way == "potential"
    found = decide(replace(expensive, in_water=True), 3600.0)
    assert found.way == "md" and "learns forces in vacuum" in found.why[0]
    with pytest.raises(InputError, match="leave `solvent` out"):
        decide(replace(expensive, in_water=True), 3600.0, "surrogate")


def test_simd_replicas_are_a_rival_of_the_surrogate() -> None:
    simd = replace(COVERED, platform="simd", at_once=16, md_ps_per_s=3200.0)
    found = decide(simd, 600.0)
    assert found.way == "md"
    lines = dict(table(simd, found, 600.0))
    assert lines["by OpenMM"].startswith("27.6 us a day on 2 cores") and lines["by SIMD"].startswith("276 us a day")
    assert lines["by rollout"] == "138 us a day, 8 replicas of alanine-dipeptide"
    assert simd.replicas == 32 and found.equilibrate_ps == pytest.approx(0.1 * found.expected_md_ps / 32)
    one_core = decide(replace(simd, cores=1), 600.0)
    assert named(one_core) == ["md", "report"], "sixteen replicas of one core evaluate each other"
    without = replace(COVERED, without_simd="no C++ compiler")
    assert dict(table(without, decide(without, 600.0), 600.0))["by SIMD"] == "no C++ compiler"


def test_stages_before_the_last_leave_the_others_what_was_planned() -> None:
    found = decide(COVERED, 600.0, "surrogate")
    planned = sum(stage.seconds for stage in found.stages[1:])
    assert seconds_of_first(found.stages, 600.0) == pytest.approx(600.0 - planned)
    late = [PlannedStage("held-out md", 100.0), PlannedStage("report", 30.0)]
    assert seconds_of_first(late, 10.0) == 2.0, "what is over the budget is short"


def test_errors_are_those_of_two_states_that_are_simulated() -> None:
    """The formula beside what it stands for: replicas of a two-state process, all from one state."""
    tau_ps, n, ps, step_ps = 100.0, 32, 150.0, 1.0
    rng = np.random.default_rng(3)
    squares = []
    for share in rng.random(400):
        state = np.ones(n)
        mean = np.zeros(n)
        for _ in range(int(ps / step_ps)):
            leaves = np.where(state > 0, 1.0 - share, share) * -np.expm1(-step_ps / tau_ps)
            state = np.where(rng.random(n) < leaves, 1.0 - state, state)
            mean += state * step_ps / ps
        squares.append((mean.mean() - share) ** 2)
    rates = replace(UNCOVERED, cores=n, md_ps_per_s=n * ps)
    told = expected_errors(rates, 1.0 / 0.85, tau_ps)["MD from one start"]
    assert 0.7 < told / np.sqrt(np.mean(squares)) < 1.4


def test_each_way_is_expected_to_err_by_what_it_forgets_and_what_it_samples() -> None:
    rolls = replace(FAST, ps_per_s=16_000.0)
    simd = replace(COVERED, platform="simd", at_once=16, md_ps_per_s=1000.0, rolls=rolls)
    slow, fast = (expected_errors(simd, 120.0, tau_ps, 0.05) for tau_ps in (2000.0, 10.0))
    both = "MD and a rollout together"
    assert slow["MD from one start"] > 1.3 * slow["MD from many starts"] > 1.69 * slow[both]
    assert fast["MD from one start"] < 1.2 * fast["MD from many starts"] < 1.2 * fast[both]
    assert slow["a rollout alone"] > max(0.05, 0.95 * slow[both])
    wrong = expected_errors(simd, 120.0, 2000.0, 0.4)
    md = np.sqrt(0.5 * 2000.0 / (0.9 * 0.85 * 120.0 * 1000.0))
    assert 1.2 * slow[both] < wrong[both] <= md, "a rollout that errs adds nothing to MD"
    assert both not in expected_errors(replace(simd, expensive=True), 120.0), "its energies weigh it"
    assert "a rollout alone" not in expected_errors(UNCOVERED, 120.0)


def test_dear_reference_is_learned_where_there_is_time_to() -> None:
    assert decide(EXPENSIVE, 3600.0).way == "potential"
    short = decide(EXPENSIVE, 60.0)
    assert short.way == "md" and "needs a budget of 4 min" in short.why[0]
    assert decide(EXPENSIVE, 3600.0, "md").way == "md"


def test_where_forces_are_expensive_energies_of_frames_take_the_place_of_md_that_would_tell_nothing() -> None:
    covered = replace(EXPENSIVE, rolls=Rolls("drug-like-gfn2-xtb", 0.1, 100.0, 32))
    found = decide(covered, 60.0)
    assert found.way == "rollout" and named(found) == ["rollout", "energies", "report"]
    assert (
        found.seconds("rollout") == pytest.approx(7.0 / 3.0 * found.seconds("energies")) and found.equilibrate_ps == 0.0
    )
    assert "reference's energies weigh" in table(covered, found, 60.0)["way"]
    assert "%" not in found.why[1] and "no way is sure to see enough with a slowest relaxation of 1 ns" in found.why[1]
    known = replace(covered, rolls=Rolls("drug-like-gfn2-xtb", 0.1, 100.0, 32, relaxation_ps=5.0))
    assert "a rollout alone" in decide(known, 60.0).why[1], "control"
    slow = replace(covered, rolls=Rolls("drug-like-gfn2-xtb", 0.1, 10.0, 32))
    assert decide(slow, 600.0).seconds("report") < 0.5 * decide(COVERED, 600.0).seconds("report"), "few frames to read"
    longer = decide(covered, 3600.0)
    assert named(longer) == ["rollout", "energies", "held-out md", "report"] and longer.expected_md_ps > 50.0


def test_the_least_budget_that_is_named_is_enough_although_measuring_took_some_of_it() -> None:
    assert decide(EXPENSIVE, 230.0, whole_s=240.0).way == "potential"
    assert decide(EXPENSIVE, 230.0, whole_s=239.0).way == "md", "control"


@pytest.mark.parametrize("rates", [COVERED, UNCOVERED, EXPENSIVE])
@pytest.mark.parametrize("way", ["auto", "md", "surrogate"])
@pytest.mark.parametrize("budget_s", [30.0, 60.0, 600.0, 36_000.0])
def test_stages_fill_the_budget(rates: Rates, way: str, budget_s: float) -> None:
    if way == "surrogate" and rates is UNCOVERED:
        way = "auto"
    found = decide(rates, budget_s, way)
    assert 0.95 * budget_s < sum(stage.seconds for stage in found.stages) <= budget_s
    assert min(stage.seconds for stage in found.stages) > 0.0
    assert list(table(rates, found, budget_s))[-1] == "in all"


def test_frames_are_saved_no_more_often_than_the_comparison_can_read() -> None:
    short, long = (decide(COVERED, budget_s, "surrogate") for budget_s in (60.0, 36_000.0))
    assert short.save_every_ps < long.save_every_ps
    for found in (short, long):
        assert found.save_every_ps % FAST.lag_ps == 0.0
    assert long.expected_rollout_ps / long.save_every_ps < 400_000
    assert decide(COVERED, 36_000.0, save_every_ps=1.0).save_every_ps == 1.0


def test_work_beside_us_stretches_time() -> None:
    assert 1.0 <= measured_stretch(1, 0.05) <= 30.0
    assert measured_stretch(4 * available_cores(), 0.2) > 2.0, "four threads on each core"


def test_a_budget_in_which_nothing_can_be_evaluated_is_refused() -> None:
    with pytest.raises(InputError, match=r"a budget of 5 s is too short: .* takes 20 s on this machine"):
        decide(COVERED, 5.0)
    with pytest.raises(InputError, match=r"as busy as it is. Use `budget_s='40s'` or more"):
        decide(replace(COVERED, stretch=6.0), 22.0)
    decide(COVERED, 22.0)


def test_a_budget_in_explicit_water_is_enough_for_md_to_begin() -> None:
    # LEU-SER in TIP3P on one core: sixteen replicas make 16.4 ps a second, and take 16 ps each to begin.
    dry = replace(COVERED, cores=1, step_s=3.2e-3, md_ps_per_s=16.4, platform="simd", at_once=16,
                  rolls=Rolls("peptides", 10.0, 30_000.0, 8, 480.0, 130.0))  # fmt: skip
    wet = replace(dry, explicit=True)
    assert decide(dry, 60.0).seconds("held-out md") > 0.0 and dry.begins_s == 0.0
    assert wet.begins_s == pytest.approx(8.0 + 16 * 16.0 / 16.4)
    with pytest.raises(InputError, match=r"a budget of 60 s is too short: .* takes 2\.42 min .* Use `budget_s='150s'`"):
        decide(wet, 60.0)
    short, long = decide(wet, 150.0), decide(wet, 600.0)
    md_s = short.seconds("held-out md")
    assert md_s > wet.begins_s + 4 * 10.0 * 16 / 16.4, "four frames of each replica, if MD has half of the time"
    assert named(short) == ["rollout", "held-out md", "report"], "too short to begin twice"
    assert named(long) == ["rollout", "umbrella md", "held-out md", "report"]
    assert long.seconds("umbrella md") > 2 * wet.begins_s and long.seconds("umbrella md") > 2 * long.seconds(
        "held-out md"
    )
    both_ps = 16.4 * (long.seconds("umbrella md") + long.seconds("held-out md"))
    assert long.expected_md_ps == pytest.approx(both_ps)
    assert "umbrella" in table(wet, long, 600.0)["way"] and "umbrella" not in table(wet, short, 150.0)["way"]
    by_openmm = replace(wet, at_once=1, platform="auto")
    assert named(decide(dry, 600.0, "surrogate")) == named(decide(by_openmm, 3600.0, "surrogate")) == named(short)


def test_a_budget_that_is_not_given_is_ten_minutes() -> None:
    assert RunOptions().budget_s == 600.0 and RunOptions(budget_s=60.0).budget_s == 60.0
