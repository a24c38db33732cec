"""Training: it learns, it resumes exactly, it refuses leaks and bad files, and it stops on NaN."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from surrogate.data import TrainingFrames, collect_frames, is_windows, load_frames, quantise
from surrogate.models.lam_slide.model import LamSlide, LamSlideConfig, draw_identifiers
from surrogate.models.lam_slide.trainer import TrainingConfig, flow_loss, train_lam_slide, window_frames
from surrogate.models.weights import Weights, load_weights, provenance_of, read_header, save_weights
from surrogate.training.loop import Stage, StageConfig, StagePlace, learning_rate_factor, run_stage
from systems.errors import InputError, SimulationError, WeightsError
from systems.options import read_toml
from systems.scene import Scene
from systems.trajectory.codec import open_writer

QUICK = TrainingConfig(
    stage_one_steps=12, stage_two_steps=8, stage_one_batch=8, stage_two_batch=4, bf16=False, validate_every_s=1e9
)


def test_stage_one_learns_the_frames(tmp_path: Path, harmonic_frames: TrainingFrames,
                                     small_model_config: LamSlideConfig) -> None:  # fmt: skip
    config = replace(QUICK, stage_one_steps=150, stage_one_batch=64, stage_two_steps=2, validate_every_s=0.3)
    out = train_lam_slide(harmonic_frames, tmp_path / "m.safetensors", small_model_config, config)
    rows = [r for r in csv.DictReader(out.with_suffix(".csv").open()) if r["stage"] == "autoencoder"]
    curve = [float(r["validation_rmsd_nm"]) for r in rows]
    assert curve[-1] < 0.03 < curve[0], curve
    # The template itself spreads over 0.3 nm: an encoder that ignored its input could not get below the motion's size.
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.csv", "m.safetensors"]


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path, harmonic_frames: TrainingFrames,
                                                   small_model_config: LamSlideConfig) -> None:  # fmt: skip
    whole = train_lam_slide(harmonic_frames, tmp_path / "whole.safetensors", small_model_config, QUICK)

    class Stop(Exception):
        pass

    calls = 0

    def stop_later(stage: str, share: float, metrics: dict[str, float]) -> None:
        nonlocal calls
        calls += bool(metrics) and stage == "flow"
        if calls == 3:
            raise Stop

    cut = tmp_path / "cut.safetensors"
    often = replace(QUICK, validate_every_s=0.0)
    with pytest.raises(Stop):
        train_lam_slide(harmonic_frames, cut, small_model_config, often, progress=stop_later)
    assert cut.with_name("cut.flow.train.safetensors").exists()
    train_lam_slide(harmonic_frames, cut, small_model_config, often, resume=True)
    first, second = load_weights(whole).model.state_dict(), load_weights(cut).model.state_dict()
    for name in first:
        assert torch.equal(first[name], second[name]), name
    # Negative control: another seed gives other weights.
    other = train_lam_slide(harmonic_frames, tmp_path / "o.safetensors", small_model_config, replace(QUICK, seed=1))
    assert not torch.equal(load_weights(other).model.state_dict()["autoencoder.queries"], first["autoencoder.queries"])


def test_training_goes_on_from_weights(tmp_path: Path, harmonic_frames: TrainingFrames, small_weights: Weights,
                                       small_model_config: LamSlideConfig) -> None:  # fmt: skip
    out = train_lam_slide(harmonic_frames, tmp_path / "m.safetensors", small_model_config, QUICK, start=small_weights)
    further = load_weights(out)
    before, after = small_weights.model.state_dict(), further.model.state_dict()
    for name, tensor in before.items():
        if name.startswith(("autoencoder", "latent_")):
            assert torch.equal(after[name], tensor), name
    # Eight steps move the second stage a little: it neither stood still nor began anew.
    name = next(k for k in before if k.startswith("approximator.layers") and k.endswith("weight"))
    change = float((after[name] - before[name]).norm() / before[name].norm())
    assert 0.0 < change < 0.3
    assert further.provenance["from"]["hash"] == small_weights.hash
    assert {r["stage"] for r in csv.DictReader(out.with_suffix(".csv").open())} == {"flow"}


def test_weights_tell_each_trajectory_of_their_ancestors_once(small_weights: Weights) -> None:
    def sources(*files: str, **more: Any) -> dict[str, Any]:
        return {"sources": [{"file": name, "sha256": name} for name in files], **more}

    eldest = {"hash": "0", **sources("a", "b"), "spent_s": 1.0}
    start = replace(small_weights, provenance=sources("b", "c", **{"from": eldest, "spent_s": 2.0}), hash="1")
    made = provenance_of(sources("c", "d"), {}, start)
    assert [source["file"] for source in made["sources"]] == ["c", "d"]
    assert made["from"] == {
        "hash": "1",
        **sources("b"),
        "spent_s": 2.0,
        "from": {"hash": "0", **sources("a"), "spent_s": 1.0},
    }
    assert start.provenance["sources"] == sources("b", "c")["sources"], "which stay as they are"


def test_training_goes_on_only_from_weights_that_fit(tmp_path: Path, harmonic_frames: TrainingFrames,
                                                     small_weights: Weights,
                                                     small_model_config: LamSlideConfig) -> None:  # fmt: skip
    def refused(frames: TrainingFrames, config: LamSlideConfig, why: str) -> None:
        with pytest.raises(InputError, match=why):
            train_lam_slide(frames, tmp_path / "m.safetensors", config, QUICK, start=small_weights)

    refused(harmonic_frames, replace(small_model_config, position_scale_nm=0.3), "another configuration")
    refused(replace(harmonic_frames, lag_ps=2.0), small_model_config, "1 ps from frame to frame")
    scene = replace(harmonic_frames.scene, atom_names=tuple(reversed(harmonic_frames.scene.atom_names)))
    refused(replace(harmonic_frames, scene=scene), small_model_config, "in this atom order")


def test_training_stops_on_nan_and_says_where(tmp_path: Path) -> None:
    module = torch.nn.Linear(2, 1)

    def loss_fn(generator: torch.Generator) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return module(torch.full((1, 2), float("nan"))).sum(), {}

    with pytest.raises(SimulationError, match="not finite at step 0"):
        run_stage(Stage(module, StageConfig("toy", 1, 1e-3, steps=3, bf16=False), loss_fn, dict),
                  StagePlace(tmp_path / "s", tmp_path / "l.csv", torch.device("cpu")))  # fmt: skip
    assert torch.isfinite(module.weight).all(), "the last good parameters are kept"


def test_learning_rate_warms_up_and_falls_to_a_hundredth() -> None:
    assert learning_rate_factor(0, 0.0, 100) == pytest.approx(0.01)
    assert learning_rate_factor(500, 0.0, 100) == pytest.approx(1.0)
    assert learning_rate_factor(500, 0.5, 100) == pytest.approx(0.505)
    assert learning_rate_factor(500, 1.0, 100) == pytest.approx(0.01)


def test_no_window_crosses_a_boundary_or_reaches_from_training_into_validation(
    harmonic_frames: TrainingFrames,
) -> None:
    length = 8
    train = harmonic_frames.window_starts(length, validation=False)
    held = harmonic_frames.window_starts(length, validation=True)
    frames_of = lambda starts: {int(s) + k for s in starts for k in range(length)}  # noqa: E731
    assert not frames_of(train) & frames_of(held), "a validation frame is trained on"
    for starts in (train, held):
        assert all((s < 400) == (s + length - 1 < 400) for s in starts), "a window crosses two trajectories"
    assert frames_of(train) | frames_of(held) == set(range(800)), "no frame is wasted"
    with pytest.raises(InputError, match="longer trajectories"):
        harmonic_frames.window_starts(200, validation=True)


def test_identifiers_of_algorithm_1_are_distinct_and_random() -> None:
    drawn = draw_identifiers(22, 32, 500, torch.Generator().manual_seed(0))
    assert drawn.shape == (500, 22)
    assert all(len(set(row.tolist())) == 22 for row in drawn)
    counts = torch.bincount(drawn.flatten(), minlength=32).double()
    assert (counts / 500 - 22 / 32).abs().max() < 0.1, "every embedding gets its share of updates"
    with pytest.raises(ValueError, match="pool"):
        draw_identifiers(33, 32, 1, None)


def test_frames_file_round_trip_and_refusals(tmp_path: Path, harmonic_frames: TrainingFrames) -> None:
    path = tmp_path / "w.h5"
    harmonic_frames.save(path)
    again = load_frames(path)
    assert is_windows(path)
    assert np.array_equal(again.coordinates, harmonic_frames.coordinates)
    assert again.scene.topology_hash == harmonic_frames.scene.topology_hash
    assert (again.lag_ps, again.canonical, again.conditions) == (1.0, True, harmonic_frames.conditions)
    (tmp_path / "x.h5").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a windows file"):
        load_frames(tmp_path / "x.h5")
    with pytest.raises(InputError, match="whole"):
        quantise(np.full((1, 1, 3), 7.0))


def test_references_that_do_not_belong_together_are_refused(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    rng = np.random.default_rng(0)

    def write(name: str, lag: float, temperature: float) -> Path:
        frames = alanine_dipeptide.positions_nm + 0.003 * rng.normal(size=(20, alanine_dipeptide.n_atoms, 3))
        with open_writer(tmp_path / name, alanine_dipeptide, {"temperature_k": temperature}) as writer:
            writer.append(frames, np.arange(1, 21) * lag)
        return tmp_path / name

    a, b, c = write("a.h5", 1.0, 300.0), write("b.h5", 2.0, 300.0), write("c.h5", 1.0, 350.0)
    assert collect_frames([a]).n_frames == 20
    with pytest.raises(InputError, match="every 2 ps"):
        collect_frames([a, b])
    with pytest.raises(InputError, match="350"):
        collect_frames([a, c])


def test_canonical_frames_are_superposed_on_the_template(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    from surrogate.data import QUANTUM_NM

    scene = alanine_dipeptide
    angle = 1.0
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    frames = np.stack([scene.positions_nm, scene.positions_nm @ turn.T + 3.0])
    with open_writer(tmp_path / "t.h5", scene, {}) as writer:
        writer.append(frames, [1.0, 2.0])
    held = collect_frames([tmp_path / "t.h5"])
    assert np.abs(held.coordinates[0].astype(int) - held.coordinates[1]).max() * QUANTUM_NM < 5e-4
    loose = collect_frames([tmp_path / "t.h5"], canonical=False)
    assert np.abs(loose.coordinates[0].astype(int) - loose.coordinates[1]).max() * QUANTUM_NM > 0.1


def test_damaged_weights_are_refused_in_one_line(tmp_path: Path, small_weights: Weights) -> None:
    good = small_weights.path.read_bytes()
    bad = tmp_path / "bad.safetensors"
    with pytest.raises(InputError, match="does not exist"):
        read_header(bad)
    bad.write_bytes(good[: len(good) // 2])
    with pytest.raises(WeightsError, match="damaged"):
        load_weights(bad)
    bad.write_bytes(b"nothing of ours")
    with pytest.raises(WeightsError):
        load_weights(bad)
    model = LamSlide(small_weights.model.config)
    model.load_state_dict(small_weights.model.state_dict())
    with torch.no_grad():
        next(model.approximator.parameters())[:] = float("nan")
    save_weights(bad, model, small_weights.domain, {})
    with pytest.raises(WeightsError, match="not finite"):
        load_weights(bad)


def test_unknown_setting_is_refused_with_the_nearest(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    path.write_text("[approximator]\nwidht = 128\n")
    with pytest.raises(InputError, match=r"widht.*width"):
        LamSlideConfig.from_dict(read_toml(path))
    path.write_text("canonical = false\n[approximator]\nwidth = 128\n")
    config = LamSlideConfig.from_dict(read_toml(path))
    assert not config.canonical
    assert config.approximator.width == 128
    assert LamSlideConfig.from_dict(config.to_dict()) == config


def test_given_frames_count_in_the_loss_where_they_are_asked_to(small_model_config: LamSlideConfig) -> None:
    class Zeros(torch.nn.Module):
        def forward(self, o: torch.Tensor, *others: torch.Tensor, **named: torch.Tensor) -> torch.Tensor:
            return torch.zeros_like(o)

    latents, tau = torch.randn(3, 8, 4, 12, generator=torch.Generator().manual_seed(0)), torch.full((3,), 0.5)
    for on_given, counted in ((False, latents[:, 2:]), (True, latents)):
        stage_two = replace(small_model_config.approximator, n_conditioning=2, precondition=False, auxiliary_frames=0,
                            loss_on_given=on_given)  # fmt: skip
        model = LamSlide(replace(small_model_config, approximator=stage_two))
        model.approximator = Zeros()
        loss, _ = flow_loss(model, latents, 22, tau, torch.Generator().manual_seed(1))
        torch.testing.assert_close(loss, counted.square().mean())
    with pytest.raises(InputError, match="clean_conditioning"):
        replace(stage_two, clean_conditioning=True)


def test_rotation_augmentation_trains_without_canonical_frames(tmp_path: Path, harmonic_frames: TrainingFrames,
                                                               small_model_config: LamSlideConfig) -> None:  # fmt: skip
    loose = replace(harmonic_frames, canonical=False)
    config = replace(small_model_config, canonical=False)
    out = train_lam_slide(loose, tmp_path / "a.safetensors", config, QUICK)
    assert load_weights(out).model.config.canonical is False
    with pytest.raises(InputError, match="disagree"):
        train_lam_slide(harmonic_frames, tmp_path / "b.safetensors", config, QUICK)


def test_time_reversal_turns_about_every_other_window_round() -> None:
    first = torch.arange(0, 4000, 10)
    forward = window_frames(first, 5, torch.Generator().manual_seed(0), time_reversal=False)
    assert torch.equal(forward, first[:, None] + torch.arange(5))
    drawn = window_frames(first, 5, torch.Generator().manual_seed(0), time_reversal=True)
    assert torch.equal(drawn.sort(1).values, forward)
    steps = drawn.diff(dim=1)
    assert ((steps == 1).all(1) | (steps == -1).all(1)).all()
    assert 0.4 < (steps[:, 0] == -1).double().mean() < 0.6
