"""A run's folder and record: what is kept, what may go on, what is refused; and the words that an outcome is put in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from surrogate import api
from surrogate.comparison.answer import Answer, StateEnergy
from surrogate.comparison.equivalent_time import EquivalentTime
from surrogate.verbs.options import RunOptions
from surrogate.verbs.run.decision import Way, decide
from surrogate.verbs.run.rates import Rates, Rolls
from surrogate.verbs.run.run_record import (
    Outcome,
    RunRecord,
    RunResult,
    StageEntry,
    read_run,
    settings_of_run,
    write_run,
)
from surrogate.verbs.run.stages import Costs, costs_of, lines_of, outcome
from systems.errors import InputError, PreparationError

RATES = Rates(22, 2, 1.0, False, "OBC2", 25e-6, 0.004, 320.0, "", Rolls("alanine-dipeptide", 1.0, 1600.0))
CHEAP = Costs(10.0, 0.0, 200.0, 60.0)
OPTIONS = RunOptions(budget_s=600.0, weights=Path("mine.safetensors"))


def record() -> RunRecord:
    return RunRecord(
        "smiles:CCO", "CCO", "C2H6O", "abc", settings_of_run(OPTIONS), {"openmm": "8"}, "now", 12.5, {"rollout": 9.0},
        RATES, decide(RATES, 600.0, "surrogate"), (StageEntry("rollout", "out of time", 9.0),),
        ("trajectory/surrogate_r0.h5",),
        outcome=Outcome("head", "close", "so", 10.0, 20.0, "at least 10 ns", None, "It does.", True, ("note",)),
    )  # fmt: skip


def test_a_record_comes_back_as_it_was(tmp_path: Path) -> None:
    write_run(tmp_path, record())
    assert read_run(tmp_path) == record()
    found = json.loads((tmp_path / "run.json").read_text())
    (tmp_path / "run.json").write_text(json.dumps(found | {"stages": [{"name": "rollout", "status": "fine"}]}))
    with pytest.raises(InputError, match="stages"):
        read_run(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps(found | {"format": 99}))
    with pytest.raises(InputError, match="another version"):
        read_run(tmp_path)


def test_only_the_same_run_goes_on(tmp_path: Path) -> None:
    same = settings_of_run(replace(OPTIONS, resume=True, quiet=True))
    record().check_same(same, "abc", tmp_path)
    with pytest.raises(InputError, match="seed = 0, not 3"):
        record().check_same(settings_of_run(replace(OPTIONS, seed=3)), "abc", tmp_path)
    with pytest.raises(InputError, match=r"budget_s = 600\.0, not 60\.0"):
        record().check_same(settings_of_run(replace(OPTIONS, budget_s=60.0)), "abc", tmp_path)
    record().check_same(settings_of_run(replace(OPTIONS, budget_s=6000.0)), "abc", tmp_path)
    with pytest.raises(InputError, match="another molecule"):
        record().check_same(same, "other", tmp_path)


def test_folders_that_are_not_a_runs_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="not empty"):
        api.run("smiles:CCO", tmp_path, budget_s=60.0, overwrite=True, quiet=True)
    write_run(tmp_path, record())
    with pytest.raises(InputError, match=r"resume=True"):
        api.run("smiles:CCO", tmp_path, budget_s=60.0, quiet=True)
    with pytest.raises(InputError, match="exclude each other"):
        api.run("smiles:CCO", tmp_path, budget_s=60.0, resume=True, overwrite=True, quiet=True)
    with pytest.raises(InputError, match="`out`"):
        api.run("smiles:CCO", budget_s=60.0, quiet=True)
    assert (tmp_path / "thesis.tex").exists()


def test_without_ambertools_a_run_ends_in_one_line_and_peptides_are_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("gaff", "programs"):
        monkeypatch.setattr(f"md_reference.forces.{place}.find_ambertools", lambda: None)
    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path / "cache"))
    for resume in (False, True):
        with pytest.raises(PreparationError, match="GAFF2 parameters need AmberTools") as caught:
            api.run("smiles:CCSCC", tmp_path / "run", budget_s=60.0, resume=resume, quiet=True)
        assert "\n" not in str(caught.value)
    api.run("sequence:ACE-GLY-NME", budget_s=60.0, dry_run=True, quiet=True)


def equivalent_time(bound: str = "", low_ps: float | None = 8_000.0, **more: Any) -> EquivalentTime:
    given: dict[str, Any] = {"equivalent_ps": 10_000.0, "high_ps": 12_000.0, "share": 1.0, "errors_low": ()} | more
    of: Any = bound
    return EquivalentTime("map", "distribution", "φ/ψ map", low_ps=low_ps, bound=of, candidate_error=0.1,
                 lengths_ps=(1e3, 1e4, 1e5), errors=(3.0, 2.0, 1.0), errors_high=(), **given)  # fmt: skip


def convergence(**more: Any) -> Any:
    given = {
        "converged": True,
        "verdict": "",
        "remedy": "",
        "needed_ps": None,
        "replica_ps": 375.0,
        "n_replicas": 32,
    } | more
    return SimpleNamespace(**given)


SHORT = convergence(converged=False, verdict="32 replicas of 380 ps, not converged: it drifts.", needed_ps=3_750.0,
                    remedy="replicas of 3.8 ns or more would tell")  # fmt: skip


def summary(total_ps: float, n: int) -> Any:
    return SimpleNamespace(total_ps=total_ps, n_segments=n)


def evaluation(found: EquivalentTime | None, status: str = "close") -> Any:
    return SimpleNamespace(summary=summary(50_000.0, 16), equivalent_time=(found,) if found else (), status=status,
                           equivalent_time_words="words" if found else "", verdict="Close.", effective_samples=4.0,
                           in_short=("Use it.", "Right: all.", "Why: so."))  # fmt: skip


def told(
    way: Way, found: EquivalentTime | None, costs: Costs = CHEAP, answer: Any = None, of: Any = None, **more: Any
) -> Outcome:
    half, evaluated = summary(6_000.0, 16), evaluation(found, "close" if found else "undecided")
    comparison: Any = SimpleNamespace(
        evaluations=(evaluated,), reference=half, replicate=half, convergence=of or convergence()
    )
    return outcome(way, comparison, costs, answer, **more)


def state(**more: Any) -> StateEnergy:
    return replace(StateEnergy("ALA 2", "α", 0.5, 0.01, 0.0, 0.1, 32, 20, 0.52, 0.01), **more)


def answer(**more: Any) -> Answer:
    given: dict[str, Any] = {
        "method": "Markov model", "n_replicas": 32, "replica_ps": 375.0, "lag_ps": 1.0, "model_lag_ps": 10.0,
        "timescales_ps": (900.0,), "timescale_errors_ps": (90.0,), "tests": "a Markov model", "holds": True,
        "has_images": False, "states": (state(), state(state="β")), "maps": {}, "missing": (), "weights": (),
    }  # fmt: skip
    return Answer(**(given | more))


def test_the_first_line_says_use_it_or_not_and_the_details_what_it_is_equivalent_to() -> None:
    found = told("rollout", equivalent_time(), answer=answer())
    assert found.in_short == (
        "Use MD's answer.",
        "For populations and free energies of 2 states, each to 1 % or better (one standard error), "
        "and relaxation times.",
        "Why: MD is 32 replicas of 380 ps, weighed by a Markov model; the slowest process takes 900 ps ± 90 ps.",
    )
    assert found.headline == " ".join(found.in_short) and found.converged
    assert "16 replicas of 3.1 ns of the surrogate: equivalent to 10 ns [8 ns, 12 ns]" in found.details
    assert (
        found.speed_up == pytest.approx(8_000.0 / (200.0 * 10.0))
        and "Speed-up at equal accuracy at least 4;" in found.details
    )
    simd = replace(CHEAP, replicas=32, by="SIMD")
    assert (
        "MD by SIMD, the fastest here, makes 32 replicas of 62 ps" in told("rollout", equivalent_time(), simd).details
    )


def test_an_answer_that_does_not_hold_is_not_to_be_used() -> None:
    found = told("rollout", None, answer=answer(holds=False))
    assert found.in_short[0] == "Do not use MD's populations yet." and not found.converged
    assert "has not converged" in found.in_short[2]
    wrong = answer(holds=False, states=(state(surrogate=0.9),))
    assert "differ" in wrong.on_surrogate and "differ" not in told("rollout", None, answer=wrong).details
    assert "cannot say whether" in told("rollout", None, answer=wrong).on_surrogate
    stuck = answer(timescales_ps=(), missing=("not connected: ALA 2 β",), states=(state(surrogate=0.9),))
    assert "cannot say whether" in told("rollout", None, answer=stuck).details, "one state, and what was never left"
    assert told("rollout", None, answer=stuck).in_short[0] == "Do not use MD's populations yet."
    few = told("rollout", None, answer=answer(states=(), missing=("only 3 of 896 frames are effective",), holds=False))
    assert few.in_short[0] == "Do not use MD's frames yet." and few.in_short[1].startswith("No torsion has two states.")
    part = told("rollout", None, answer=answer(missing=("ALA 2 left-handed: not connected",)))
    assert (
        "except for states that few or no transitions connect" in part.in_short[0]
        and "ALA 2 left-handed" in part.in_short[1]
    )
    assert told("rollout", None).in_short == ("Use it.", "Right: all.", "Why: so."), "no torsion turns"


def test_where_md_is_too_short_the_surrogate_counts_with_it_unless_md_contradicts_it() -> None:
    vague = (state(error=0.18), state(state="β", error=0.18))
    short = answer(holds=False, states=vague)
    joint = replace(short, states=tuple(replace(s, error=0.07, md_share=s.share, md_error=s.error) for s in vague))
    found = told("rollout", None, answer=joint)
    assert found.in_short[0] == "Use MD's and the surrogate's populations together, for now." and not found.converged
    assert "each to 7 % or better" in found.in_short[1] and "by itself off by up to 18 %" in found.in_short[2]
    assert lines_of("rollout", evaluation(None), joint) == joint.in_short
    assert joint.to_dict()["populations_by"] == "MD and surrogate" and answer().to_dict()["populations_by"] == "MD"
    assert "; MD 50.0 ± 18.0 %; surrogate" in joint.table()[0][1] and "MD" not in short.table()[0][1]
    assert found.on_surrogate.startswith("MD moves the surrogate's populations most in ALA 2")
    assert answer(holds=False, states=vague).wants_surrogate and answer(states=vague).wants_surrogate
    assert not answer(states=tuple(replace(s, error=0.02) for s in vague)).wants_surrogate, "MD is sure by itself"
    assert not answer(states=tuple(replace(s, surrogate=None) for s in vague)).wants_surrogate
    for error, surrogate, contradicts in (
        (0.05, 0.2, False),
        (0.05, 0.9, True),
        (0.12, 0.29, False),
        (0.12, 0.7, True),
    ):
        more = state(state="left-handed", share=0.01, error=error, surrogate=surrogate)
        other = replace(joint, states=(*joint.states, more))
        assert other.contradicts == contradicts, "so far no data move a surrogate that errs by 10 %"
    assert not replace(short, states=(*vague, more)).contradicts, "MD alone takes no surrogate in"


def test_a_longer_budget_is_named_only_where_its_replicas_outlast_what_is_slow() -> None:
    short = told("rollout", None, of=SHORT)
    assert "replicas of 3.8 ns or more would tell: a budget of about 10 min." in short.details
    assert "12 ns" not in short.details, "the sum of many short replicas is no length"
    unseen = told("rollout", None, of=replace_in(SHORT, needed_ps=None, remedy="starts spread over all states"))
    assert "budget" not in unseen.details and "starts spread over all states" in unseen.details
    none = replace_in(SHORT, n_replicas=0, reasons=("no replica has 16 frames",))
    assert "too short to be tested: no replica has 16 frames." in told("rollout", None, of=none).details
    assert "a budget of about 5 min would tell" in told("rollout", None).details, "replicas outlast it"


def replace_in(found: Any, **more: Any) -> Any:
    return SimpleNamespace(**(vars(found) | more))


def test_the_lines_over_the_comparison_agree_with_md_s_answer() -> None:
    evaluated = evaluation(None, "different")
    assert lines_of("md", evaluated, answer()) == answer().in_short
    assert lines_of("rollout", evaluated, answer())[0] == "Use the surrogate for populations."
    wrong = answer(states=(state(surrogate=0.9), state(state="β")))
    use, for_what, why = lines_of("rollout", evaluation(None, "agrees"), wrong)
    assert use == "Use MD's populations, not the surrogate's." and "1 of 2 states. Wrong: ALA 2 α." in for_what
    assert "90 % instead of 50.0 ± 1.0 %" in why
    assert lines_of("rollout", evaluated, answer(holds=False))[0].startswith("Not known yet")
    assert lines_of("rollout", evaluation(None, "broken"), answer())[0] == "Use it.", "the comparison's own words"


def test_a_reweighted_rollout_is_the_answer_and_claims_no_md() -> None:
    reweighted = answer(energies=(1000, 300.4))
    found = told("rollout", None, answer=reweighted, by_itself=True)
    assert found.in_short[0] == "Use the reweighted rollout."
    assert "by its reference's energies at 1000 frames, of which 300 are effective" in found.in_short[2]
    assert not found.equivalent_time and found.speed_up is None and found.held_out_ps == 0.0
    assert (
        "16 replicas of 3.1 ns of the surrogate, compared with 32 replicas of 380 ps of the same rollout: undecided."
        in (found.details)
    )
    assert "agree with the reweighted ones in all 2 states" in found.on_surrogate
    told_of = reweighted.to_dict()
    assert told_of["populations_by"] == "reweighting" and not reweighted.wants_surrogate
    # Monte Carlo turned its torsions.
    assert "relaxation" not in found.headline and "process" not in found.headline and not told_of["timescales_ps"]
    assert answer().to_dict()["timescales_ps"] == [900.0]
    assert lines_of("rollout", evaluation(None), reweighted) == reweighted.in_short
    unsure = told("rollout", None, answer=answer(energies=(1000, 20.0), holds=False), by_itself=True)
    assert "are effective; it has not converged" in unsure.in_short[2]
    assert (
        unsure.in_short[0] == "Do not use the reweighted populations yet." and "The rollout has not" in unsure.details
    )
    single = answer(states=(), energies=(10, 9.0))
    assert single.in_short[0] == "Use the reweighted frames." and answer(states=()).in_short[0] == "Use MD's frames."


def test_costs_are_of_training_and_rolling_beside_the_faster_md() -> None:
    rolled = SimpleNamespace(wall_s=7.0)
    comparison: Any = SimpleNamespace(evaluations=(SimpleNamespace(summary=rolled),))
    spent = {"train": 120.0, "rollout": 9.0, "held-out md": 10.0, "report": 50.0}
    run = replace(record(), spent_in=spent)
    assert costs_of(run, comparison, 1_000.0) == Costs(7.0, 120.0, RATES.md_ps_per_s, 600.0, 2, "OpenMM")
    assert costs_of(run, comparison, 5_000.0).md_ps_per_s == 500.0, "MD came to more than was measured"
    rolled.wall_s = None
    assert costs_of(run, comparison, 1_000.0).rolling_s == 9.0


def test_a_capped_equivalent_time_is_at_least_what_md_there_is() -> None:
    found = told("rollout", equivalent_time("at least", None, share=0.5))
    assert "at least 10 ns" in found.details
    assert found.speed_up == pytest.approx(10_000.0 / (200.0 * 5.0)), "by the part of the rollout that it takes"


def test_where_md_was_the_better_choice_it_is_said() -> None:
    expensive = Costs(10.0, 90.0, 200.0, 60.0)
    found = told("potential", equivalent_time(), expensive)
    assert found.speed_up == pytest.approx(0.4)
    assert "No speed-up at equal accuracy is shown: at least 0.4" in found.details
    assert "training included" in found.details
    none = told("rollout", equivalent_time("less than", None))
    assert none.speed_up == 0.0


def test_md_claims_no_speed_up() -> None:
    found = told("md", equivalent_time())
    assert found.speed_up is None
    assert found.details.startswith(
        "All frames counted alike, 16 replicas of 3.1 ns of MD evaluated by 32 replicas of 380 ps: equivalent to 10 ns"
    )
    assert "of the surrogate: undecided, without an equivalent MD time." in told("rollout", None).details


def test_a_result_has_a_headline_files_and_a_picture(tmp_path: Path) -> None:
    done = Outcome("Use it. For all. So.", "close", "so", 1.0, 2.0, in_short=("Use <it>.", "For all.", "So."))
    write_run(tmp_path, replace(record(), outcome=done, held_out=("reference/held_out_r0.h5",)))
    found = RunResult.of(tmp_path)
    assert found.headline == "Use it. For all. So." and found["outcome"]["status"] == "close"
    assert found.trajectory == [tmp_path / "trajectory/surrogate_r0.h5"]
    assert found.md == [tmp_path / "reference/held_out_r0.h5"]
    shown = found._repr_html_()
    assert "<b>Use &lt;it&gt;.</b><br>For all.<br>So." in shown and "report.html" in shown
    assert len(found.plot().axes) == 1 and not found.answer, "control"
    maps = {"ALA 2": np.zeros((36, 36))}
    (tmp_path / "equilibrium.json").write_text(json.dumps(answer(maps=maps).to_dict()))
    axes = found.plot().axes
    assert len(axes) == 3 and axes[1].get_title() == "ALA 2, kJ/mol"
    assert [t.get_text() for t in axes[0].get_yticklabels()] == ["ALA 2 α", "ALA 2 β"]
    write_run(tmp_path, replace(record(), outcome=None))
    assert "not done" in RunResult.of(tmp_path).headline
