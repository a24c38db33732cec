"""Trainings of forecast tasks in calls that end early and go on, the paper's sizes, too."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from surrogate.bench.reproduce.forecast_methods import Settings
from surrogate.bench.reproduce.n_body import reproduce
from surrogate.cli.main import app
from surrogate.models.particles import trainer
from systems.errors import UnfinishedError


@pytest.mark.parametrize("method", ["lam-slide", "lam-slide-particles"])
def test_calls_that_end_early_go_on_to_the_same_numbers(method: str, tmp_path: Path) -> None:
    sizes = {"train": 6, "validation": 2, "test": 3}
    whole = Settings(tmp_path / "whole", budget_s=None, steps=4, solver_steps=2)
    run = lambda s: reproduce("n-body-charged", s, methods=[method], sizes=sizes, workers=1)  # noqa: E731
    expected = run(whole).rows[0]
    parts = replace(whole, folder=tmp_path / "parts", call_s=1e-6)
    ended = 0
    for _ in range(10):
        try:
            found = run(parts).rows[0]
            break
        except UnfinishedError as error:
            assert "resume=True" in str(error)
            ended += 1
            parts = replace(parts, resume=True)
    assert ended >= 2
    assert (found.ade, found.fde) == (expected.ade, expected.fde)


def test_the_paper_size_runs_in_calls_until_its_epochs_are_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command for a GPU, with batches and epochs for a CPU; sizes are the published ones."""
    monkeypatch.setattr(trainer, "PAPER_SIZES", replace(trainer.PAPER_SIZES, batches=(4, 2)))
    monkeypatch.setattr(trainer, "PAPER_STEPS", 4)
    asked = ["reproduce", "n-body-charged", "--method", "lam-slide", "--paper-size", "--device", "cpu"]
    asked += ["--call", "0.001s", "--solver-steps", "1", "-o", str(tmp_path), "--workers", "1"]
    asked += ["--train", "4", "--validation", "2", "--test", "2"]
    calls = [CliRunner().invoke(app, asked)]
    while len(calls) < 4 and calls[-1].exit_code != 0:
        calls.append(CliRunner().invoke(app, [*asked, "--resume"]))
    assert [call.exit_code for call in calls] == [1, 1, *(len(calls) - 3) * [1], 0]
    assert "the same command again with --resume" in calls[0].stderr
    assert "lam-slide" in calls[-1].stdout
    with (tmp_path / "lam-slide.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert {row["stage"]: int(row["step"]) for row in rows} == {"autoencoder": 2, "flow": 2}
    record = json.loads((tmp_path / "n-body-charged.json").read_text())
    assert record["rows"][0]["n_parameters"] > 5_000_000
