"""A run's folder and record: what is kept, what may go on, what is refused; and the words that an outcome is put in."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from surrogate import api
from surrogate.judge.worth import Worth
from surrogate.verbs.options import RunOptions
from surrogate.verbs.run.decision import Way, decide
from surrogate.verbs.run.outcome_words import Costs, outcome
from surrogate.verbs.run.rates import Rates, Rolls
from surrogate.verbs.run.run_record import (
    Outcome,
    RunRecord,
    StageEntry,
    read_run,
    settings_of_run,
    write_run,
)
from surrogate.verbs.run.stages import costs_of
from systems.errors import InputError, PreparationError

RATES = Rates(22, 2, 1.0, False, "OBC2", 25e-6, 0.004, 320.0, "", Rolls("alanine-dipeptide", 1.0, 1600.0))
CHEAP = Costs(10.0, 0.0, 200.0, 60.0)
OPTIONS = RunOptions(budget_s=600.0, weights=Path("mine.safetensors"))


def record() -> RunRecord:
    return RunRecord(
        "smiles:CCO", "CCO", "C2H6O", "abc", settings_of_run(OPTIONS), {"openmm": "8"}, "now", 12.5, {"rollout": 9.0},
        RATES, decide(RATES, 600.0), (StageEntry("rollout", "out of time", 9.0),), ("trajectory/surrogate_r0.h5",),
        outcome=Outcome("head", "close", "so", 10.0, 20.0, "at least 10 ns", None, "MD.", "It does.", True, ("note",)),
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
    for place in ("gaff", "ambertools"):
        monkeypatch.setattr(f"md_reference.forces.small_molecules.{place}.find_ambertools", lambda: None)
    monkeypatch.setenv("SURROMD_CACHE", str(tmp_path / "cache"))
    for resume in (False, True):
        with pytest.raises(PreparationError, match="GAFF2 parameters need AmberTools") as caught:
            api.run("smiles:CCSCC", tmp_path / "run", budget_s=60.0, resume=resume, quiet=True)
        assert "\n" not in str(caught.value)
    api.run("sequence:ACE-GLY-NME", budget_s=60.0, dry_run=True, quiet=True)


def worth(bound: str = "", low_ps: float | None = 8_000.0, **more: Any) -> Worth:
    given: dict[str, Any] = {"worth_ps": 10_000.0, "high_ps": 12_000.0, "share": 1.0, "errors_low": ()} | more
    of: Any = bound
    return Worth("map", "distribution", "φ/ψ map", low_ps=low_ps, bound=of, candidate_error=0.1,
                 lengths_ps=(1e3, 1e4, 1e5), errors=(3.0, 2.0, 1.0), errors_high=(), **given)  # fmt: skip


def told(way: Way, found: Worth | None, costs: Costs = CHEAP, answer: Any = None) -> Outcome:
    account = SimpleNamespace(total_ps=50_000.0, n_segments=16)
    status, worths = ("close", (found,)) if found else ("undecided", ())
    judged = SimpleNamespace(account=account, worth=worths, worth_words="words" if found else "", status=status,
                             verdict="Close.", effective_samples=4.0)  # fmt: skip
    half = SimpleNamespace(total_ps=6_000.0)
    comparison: Any = SimpleNamespace(judgements=(judged,), reference=half, replicate=half)
    return outcome(way, comparison, costs, answer)


def answer(method: str, **more: Any) -> Any:
    given = {"headline": "Equilibrium from MD.", "on_surrogate": "It agrees.", "holds": True, "missing": ()} | more
    return SimpleNamespace(method=method, **given)


def test_the_headline_says_held_out_worth_and_least_gain() -> None:
    found = told("rollout", worth())
    assert found.headline.startswith("12 ns of held-out MD; the 50 ns of the surrogate are worth 10 ns [8 ns, 12 ns]")
    assert found.gain == pytest.approx(8_000.0 / (200.0 * 10.0)) and "gain at least 4:" in found.headline


def test_md_s_answer_comes_first_and_short_replicas_tell_no_equivalent_time() -> None:
    long = told("rollout", worth(), answer=answer("plain averages"))
    assert long.headline.startswith("Equilibrium from MD. It agrees. 12 ns of held-out MD") and long.gain
    assert long.converged and long.answer == "Equilibrium from MD." and long.on_surrogate == "It agrees."
    short = told("rollout", worth(), answer=answer("Markov model"))
    assert "No equivalent MD time" in short.headline and short.gain is None and not short.worth
    assert not told("rollout", worth(), answer=answer("Markov model", missing=("ALA 2 β",))).converged


def test_costs_are_of_training_and_rolling_beside_the_faster_md() -> None:
    account = SimpleNamespace(wall_s=7.0)
    comparison: Any = SimpleNamespace(judgements=(SimpleNamespace(account=account),))
    spent = {"train": 100.0, "training md": 20.0, "rollout": 9.0, "held-out md": 10.0, "report": 50.0}
    run = replace(record(), spent_in=spent)
    assert costs_of(run, comparison, 1_000.0) == Costs(7.0, 120.0, RATES.md_ps_per_s, 600.0)
    assert costs_of(run, comparison, 5_000.0).md_ps_per_s == 500.0, "MD came to more than was measured"
    account.wall_s = None
    assert costs_of(run, comparison, 1_000.0).rolling_s == 9.0


def test_a_capped_worth_is_at_least_what_md_there_is() -> None:
    found = told("rollout", worth("at least", None, share=0.5))
    assert "at least 10 ns" in found.headline
    assert found.gain == pytest.approx(10_000.0 / (200.0 * 5.0)), "by the part of the rollout that it takes"


def test_where_md_was_the_better_choice_it_is_said() -> None:
    dear = Costs(10.0, 90.0, 200.0, 60.0)
    found = told("potential", worth(), dear)
    assert found.gain == pytest.approx(0.4)
    assert "MD was the better choice" in found.headline and "training included" in found.headline
    unsure = told("potential", worth(high_ps=None), dear)
    assert "no gain is shown" in unsure.headline, "its upper end is not known"
    none = told("rollout", worth("less than", None))
    assert none.gain == 0.0


def test_md_claims_no_gain_and_what_has_no_worth_says_so() -> None:
    found = told("md", worth())
    assert found.gain is None and "62 ns to use" in found.headline
    assert found.headline.startswith("50 ns of MD in 16 replicas of 3.1 ns, and 12 ns of held-out MD")
    untold = told("rollout", None).headline
    assert "tell no worth" in untold and "a budget of about 5 min would tell" in untold
