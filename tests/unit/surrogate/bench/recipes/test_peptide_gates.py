"""The gates of the weights `peptides`: what is measured is seen to be right for MD and wrong for something else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from surrogate.bench.recipes import peptide_gates
from systems.prepare.peptide import build_peptide
from systems.trajectory.codec import open_writer


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames that tremble about one structure, each on its own."""
    scene = build_peptide("ACE-ALA-NME")
    rng = np.random.default_rng(0)
    x = scene.positions_nm + 0.004 * rng.normal(size=(900, scene.n_atoms, 3))
    path = tmp_path_factory.mktemp("gate") / "ref.h5"
    record = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
    with open_writer(path, scene, record) as writer:
        writer.append(x.astype(np.float32), 1.0 + np.arange(900))
    return path


def test_the_lag_gate_trains_measures_and_keeps_its_table(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peptide_gates, "LAGS_PS", (1, 100, 5000))
    arguments = [
        "lag",
        str(tmp_path),
        "--train",
        str(reference),
        "--test",
        str(reference),
        "--steps",
        "2",
        "--starts",
        "12",
    ]
    peptide_gates.main(arguments)
    record = json.loads((tmp_path / "lag.json").read_text())
    assert [(r["lag_ps"], r["source"]) for r in record["rows"]] == [
        (1, "MD"), (1, "model"), (100, "MD"), (100, "model"),
    ]  # fmt: skip
    assert all(abs(r["psi"]) < 0.9 for r in record["rows"] if r["source"] == "MD"), "these frames forget at once"
    assert 0 < record["halves of MD"] < 1
    assert "| 100 | model |" in capsys.readouterr().out
    # What is there is not trained again.
    before = (tmp_path / "lag.safetensors").read_bytes()
    peptide_gates.main(arguments)
    assert (tmp_path / "lag.safetensors").read_bytes() == before
