"""The gate `verdicts`: halves of MD are compared as they should be, and the table says what the comparison found."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import surrogate.api
from surrogate.bench.recipes import peptide_gates
from surrogate.bench.recipes.peptide_verdicts import verdict_row, verdicts_table
from systems.errors import InputError


def estimate(value: float, half: float = 1.0) -> SimpleNamespace:
    return SimpleNamespace(value=value, low=value - half, high=value + half)


def judged() -> Any:
    rows = {
        "tic0_timescale": SimpleNamespace(reference=estimate(260), candidate=estimate(82), replicate=estimate(257)),
        "msm_jsd": SimpleNamespace(reference=None, candidate=estimate(0.09, 0.05), replicate=estimate(0.05, 0.02)),
    }

    def row(key: str) -> SimpleNamespace:
        if key not in rows:
            raise InputError("no such row")
        return rows[key]

    worth = [
        SimpleNamespace(measure="φ/ψ map", worth_ps=23_600.0, low_ps=11_600.0, high_ps=None),
        SimpleNamespace(measure="TIC 0", worth_ps=4_000.0, low_ps=2_000.0, high_ps=9_000.0),
    ]
    return SimpleNamespace(status="broken", verdict="Broken.", compared_ps=1e5, row=row, worth=worth)


def test_the_table_has_the_model_beside_md_and_the_least_worth() -> None:
    row = verdict_row(judged())
    assert row["tic0_timescale"]["MD"] == [260, 259, 261] and row["msm_jsd"]["MD"] is None
    assert "temperature" not in row and row["worth_ns"]["φ/ψ map"] == [23.6, 11.6, None]
    line = verdicts_table({"LEU-SER": row}).splitlines()[-1]
    assert line == (
        "| LEU-SER | 82 [81, 83] / 260 [259, 261] / 257 [256, 258] | - | 0.09 [0.04, 0.14] / 0.05 [0.03, 0.07] | - | - "
        "| 4 [2, 9] |"
    )


def test_the_first_half_of_md_judges_and_the_other_is_the_replicate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A molecule with too few rollouts is left out."""
    for name, n in (("VAL-ASN", 4), ("ALA", 1)):
        for folder, stem, k in ((tmp_path / "pairs-60", "run_000-", n), (tmp_path / "test", "run_00", 4)):
            (folder / name).mkdir(parents=True)
            for i in range(k):
                (folder / name / f"{stem}{i}.h5").touch()
    asked = []

    def compare(reference: list[Path], candidates: list[list[Path]], out: Path, **kwargs: Any) -> Any:
        asked.append(([p.name for p in reference], [p.name for p in candidates[0]], kwargs["replicate"][0].name))
        return SimpleNamespace(judgements=[judged()])

    monkeypatch.setattr(surrogate.api, "compare", compare)
    peptide_gates.main(["verdicts", str(tmp_path), "--rollouts", "pairs-60", "--test", str(tmp_path / "test")])
    assert asked == [(["run_000.h5", "run_001.h5"], ["run_000-0.h5", "run_000-1.h5"], "run_002.h5")]
    assert list(json.loads((tmp_path / "verdicts.json").read_text())) == ["VAL-ASN"]
    assert "| VAL-ASN |" in capsys.readouterr().out
