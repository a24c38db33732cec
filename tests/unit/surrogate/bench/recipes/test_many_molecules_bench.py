"""What the measurements of one model for many molecules, and of the lag, say of frames whose faults are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import heavy_atoms
import numpy as np
import pytest

from surrogate.bench import lag_errors
from surrogate.bench.recipes import many_molecules
from surrogate.bench.recipes.many_molecules import change_per_frame, measure, summary, table
from surrogate.data.frames import TrainingFrames
from surrogate.data.weights import load_weights
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide


@pytest.fixture(scope="module")
def frames(harmonic_frames: TrainingFrames) -> np.ndarray:
    return harmonic_frames.positions_nm(np.arange(800)).astype(np.float64)


def test_the_other_half_of_a_reference_passes_and_faults_show(
    frames: np.ndarray, harmonic_frames: TrainingFrames
) -> None:
    scene, truth, other = harmonic_frames.scene, frames[:400], frames[400:]
    fair = measure(scene, truth, [other], "MD")
    assert fair.valid == 1.0 and fair.bond_pm < 1.5
    assert fair.spread == pytest.approx(1.0, abs=0.1) and fair.step == pytest.approx(1.0, abs=0.1)
    stretched = measure(scene, truth, [1.1 * other], "stretched")
    assert stretched.bond_pm > 8.0 > 5.0 * fair.bond_pm
    exploded = measure(scene, truth, [2.0 * other], "exploded")
    assert exploded.valid == 0.0 and exploded.loose == 1.0
    still = measure(scene, truth, [np.repeat(other[:1], 100, axis=0)], "still")
    assert still.step == 0.0 and still.spread < 1e-6 and still.torsion_jsd > 2 * fair.torsion_jsd
    shuffled = measure(scene, truth, [np.random.default_rng(0).permutation(other)], "shuffled")
    # Frames correlated by 0.8 change by sqrt(0.2) of what strangers do.
    assert shuffled.step == pytest.approx(1.0 / np.sqrt(0.2), rel=0.1)
    assert "| MD | 400 | 100.00 % |" in table([fair])


def test_means_over_molecules_keep_seen_and_unseen_and_their_references_apart(
    frames: np.ndarray, harmonic_frames: TrainingFrames
) -> None:
    one = measure(harmonic_frames.scene, frames[:400], [frames[400:]], "reference, other half")
    rows = [
        replace(one, molecule=name, model=model, valid=valid)
        for name, kind, valid in (("CC", "seen", 0.9), ("CCC", "seen", 1.0), ("CCO", "unseen", 0.5))
        for model, valid in ((one.model, 1.0), (f"one for all, {kind}", valid))
    ]
    said = {line.split("|")[1].strip(): line for line in summary(rows).splitlines()[2:]}
    assert "| 2 | 95.000 ± 5 |" in said["one for all, seen"] and "| 1 | 50.000 |" in said["one for all, unseen"]
    assert "| 2 | 100.000 ± 0 |" in said["reference, other half (seen)"]
    assert "| 1 | 100.000 |" in said["reference, other half (unseen)"]


def test_strangers_change_by_more_than_neighbours(frames: np.ndarray) -> None:
    assert change_per_frame(frames[:400], 20) > 2.0 * change_per_frame(frames[:400])


def test_correlation_and_distance_of_known_processes() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=20_000)
    assert lag_errors._correlation(x, 0.6 * x + 0.8 * rng.normal(size=20_000)) == pytest.approx(0.6, abs=0.02)
    assert lag_errors._correlation(x, rng.normal(size=20_000)) == pytest.approx(0.0, abs=0.02)
    angles = rng.uniform(-np.pi, np.pi, (20_000, 2))
    assert lag_errors.joint_distance(angles, angles) == 0.0
    assert lag_errors.joint_distance(angles, 0.1 * angles) > 0.7


def test_rows_of_a_lag_hold_md_and_the_model(
    harmonic_frames: TrainingFrames, small_model_config: LamSlideConfig, tmp_path: Path
) -> None:
    settings = TrainingConfig(stage_one_steps=40, stage_two_steps=2, stage_one_batch=32, stage_two_batch=4, bf16=False,
                              longest_lag_ps=20.0)  # fmt: skip
    weights = load_weights(train_lam_slide(harmonic_frames, tmp_path / "w.safetensors", small_model_config, settings))
    rows = {r.source: r for r in lag_errors.measure(weights, replace(harmonic_frames), 10.0, 64)}
    assert set(rows) == {"MD", "model", "model, told the shortest"}
    # Ten frames on, nothing is left of where correlated (0.8) motion began.
    assert abs(rows["MD"].psi) < 0.5 and rows["MD"].valid == 1.0 and rows["MD"].jsd < 0.6
    assert many_molecules.UNSEEN and not set(many_molecules.UNSEEN) & set(many_molecules.TRAINED)


def test_hydrogens_of_all_three_kinds_are_held_against_md(
    harmonic_frames: TrainingFrames,
    small_model_config: LamSlideConfig,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    settings = TrainingConfig(stage_one_steps=60, stage_two_steps=30, stage_one_batch=32, stage_two_batch=8, bf16=False)

    def train(references: list[Path], out: Path, kind: str, budget_s: float) -> None:
        train_lam_slide(harmonic_frames, out, replace(small_model_config, **heavy_atoms.KINDS[kind]), settings)

    monkeypatch.setattr(heavy_atoms, "train", train)
    monkeypatch.setattr("surrogate.data.frames.collect_frames", lambda paths: harmonic_frames)
    heavy_atoms.main([str(tmp_path), "--train", "a.h5", "--test", "b.h5", "--starts", "32"])
    rows = json.loads((tmp_path / "heavy_atoms.json").read_text())["rows"]
    assert [row["source"] for row in rows] == ["MD", "modelled", "placed", "residue"]
    assert rows[0]["valid"] == 1.0 and all(row["starts"] == 32 for row in rows)
    # So short a training leaves frames as rough as heavy atoms of 0.004 nm of noise are, with hydrogens in their place.
    assert rows[2]["valid"] > 0.9 and all(row["ms_a_frame"] > 0.0 for row in rows[1:])
    assert "| residue |" in capsys.readouterr().out
