"""The gates of the weights `peptides`: what is measured is seen to be right for MD and wrong for something else."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from surrogate.bench.recipes import peptide_gates
from surrogate.bench.recipes.peptide_rollouts import free_energy
from surrogate.data.weights import load_weights
from systems.errors import InputError
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


def test_the_seeds_gate_sets_both_models_beside_md(
    reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (("REPLICAS", 2), ("REPLICA_PS", 500.0)):
        monkeypatch.setattr(peptide_gates, name, value)
    peptide_gates.train([reference], tmp_path / "lag.safetensors", steps=2, innovation=True)
    runs = tmp_path / "ALA"
    runs.mkdir()
    (runs / "run_000.h5").symlink_to(reference)
    lag = tmp_path / "lag.safetensors"
    arguments = ["seeds", str(tmp_path), "--runs", str(runs), "--weights", str(lag)]
    arguments += ["--test", str(reference), str(reference), "--steps", "2"]
    peptide_gates.main(arguments)
    record = json.loads((tmp_path / "seeds.json").read_text())
    assert record["MD"]["distance"] == [0.0], "the same run twice"
    assert len(record["seeds"]["distance"]) == len(record["lag"]["distance"]) == 4
    assert all(0 < d < 0.84 for name in ("lag", "seeds") for d in record[name]["distance"])
    assert '"seeds"' in capsys.readouterr().out


def test_a_free_energy_is_that_of_the_mean_share() -> None:
    found = free_energy([0.1, 0.2, 0.3])
    assert found["free_energy_kt"] == pytest.approx(np.log(4))
    assert found["error_kt"] == pytest.approx(0.1 / 3**0.5 / 0.16)
    assert free_energy([0.0, 0.0]) == {"free_energy_kt": None, "error_kt": None}


def test_the_pairs_gate_rolls_unseen_molecules_and_sets_them_beside_md_and_the_library(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, test = tmp_path / "train", tmp_path / "test"

    def write(path: Path, sequence: str, n: int, seed: int) -> None:
        scene = build_peptide(sequence)
        x = scene.positions_nm + 0.004 * np.random.default_rng(seed).normal(size=(n, scene.n_atoms, 3))
        path.parent.mkdir(parents=True, exist_ok=True)
        record = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
        with open_writer(path, scene, record) as writer:
            writer.append(x.astype(np.float32), 1.0 + np.arange(n))

    first, second = next(p.residues for p in peptide_gates.training_peptides() if len(p.residues) == 2)
    for names in ((first,), (second,), (first, second)):
        write(runs / "-".join(names) / "run_000.h5", "-".join(("ACE", *names, "NME")), 900, len(names))
    for k in range(2):
        write(test / "unseen" / "300K" / f"unseen_300K_r{k}.h5", f"ACE-{first}-{second}-NME", 200, 10 + k)
    arguments = ["pairs", str(tmp_path / "out"), "--train", str(runs), "--test", str(test), "--steps", "2"]
    with pytest.raises(InputError, match="1 pairs, 2 are asked for"):
        peptide_gates.main([*arguments, "--pairs", "2"])
    with pytest.raises(InputError, match="0 chains, 1 are asked for"):
        peptide_gates.main([*arguments, "--pairs", "1", "--chains", "1"])
    chain = next(p.residues for p in peptide_gates.training_peptides() if len(p.residues) > 2)
    write(runs / "-".join(chain) / "run_000.h5", "-".join(("ACE", *chain, "NME")), 900, 3)
    peptide_gates.main([*arguments, "--pairs", "1", "--chains", "1"])
    longest = load_weights(tmp_path / "out" / "pairs-1-chains-1.safetensors").domain.members[-1].scene
    assert set(chain) < set(longest.residue_names)
    peptide_gates.main([*arguments, "--pairs", "1"])
    rows = json.loads((tmp_path / "out" / "pairs.json").read_text())
    assert [r["source"] for r in rows] == ["MD", "model", "library"]
    least, model, library = (r["single"] for r in rows)
    assert 0 < least < min(model, library) and max(model, library) < 0.83
    assert rows[0]["valid"] == 1.0 and 0.0 <= rows[1]["valid"] <= 1.0 and np.isnan(rows[2]["valid"])
    assert "| 1 | unseen | MD |" in capsys.readouterr().out


def test_the_free_energy_of_positive_phi_is_that_of_known_surfaces() -> None:
    phi = np.linspace(-np.pi, np.pi, 61)
    kt = 0.00831446261815324 * 300.0
    flat = np.zeros((61, 61))
    assert peptide_gates.positive_phi_kt(flat) == pytest.approx(0.0, abs=1e-12)
    step = np.where(phi > 0, 2.0 * kt, 0.0) * np.ones((61, 1))
    # both ends and phi = 0 lie on the lower side of the step, by half of them on the other side of the sum
    low, high = 29.0, 29.0
    expected = -np.log((high * np.exp(-2.0) + 1.0) / (low + 1.0))
    assert peptide_gates.positive_phi_kt(step) == pytest.approx(expected, abs=1e-9)
    assert peptide_gates.positive_phi_kt(step[:, ::-1]) < -1.5, "the other way round"
