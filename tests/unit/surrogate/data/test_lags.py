"""The lag as an input: windows of every stride, one model for a range of lags, rollouts at the interval they keep."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.data import StrideSampler, TrainingFrames, strides_up_to
from surrogate.models.architecture import weights_path
from surrogate.models.lam_slide.model import LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide, window_frames
from surrogate.models.weights import Weights, load_weights, save_weights
from surrogate.sampling.domain import choose_lag, fit_weights, under_conditions
from surrogate.sampling.runner import RolloutConfig, rollout
from surrogate.sampling.simulation import Simulation
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

QUICK = TrainingConfig(
    stage_one_steps=60, stage_two_steps=30, stage_one_batch=32, stage_two_batch=8, bf16=False, validate_every_s=1e9,
    longest_lag_ps=20.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def weights(harmonic_frames: TrainingFrames, small_model_config: LamSlideConfig,
            tmp_path_factory: pytest.TempPathFactory) -> Weights:  # fmt: skip
    out = tmp_path_factory.mktemp("lags") / "lags.safetensors"
    trained = load_weights(train_lam_slide(harmonic_frames, out, small_model_config, QUICK))
    # After a second of training it hardly moves, for which guards would stop it.
    domain = replace(trained.domain, jumps=tuple((lag, 1e-9, 1.0) for lag, _, _ in trained.domain.jumps))
    # What starts at zero has hardly left it: filled, so that what the flow is conditioned on carries signal.
    with torch.no_grad():
        for layer in (trained.model.approximator.modulation, trained.model.approximator.final):
            layer.weight.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
    save_weights(out, trained.model, domain, trained.provenance)
    return load_weights(out)


def test_strides_are_even_in_their_logarithm() -> None:
    strides = strides_up_to(1000)
    assert strides[0] == 1 and strides[-1] == 1000
    assert 20 <= len(strides) <= 25
    assert max(np.diff(np.log(strides))) <= np.log(2) + 1e-9
    assert strides_up_to(1) == (1,)


def test_windows_of_a_stride_stay_inside_a_trajectory_and_its_part(harmonic_frames: TrainingFrames) -> None:
    length, strides = 8, (1, 5, 20)
    sampler = StrideSampler.of(harmonic_frames, length, strides)
    first, stride = sampler.draw(4000, torch.Generator().manual_seed(0))
    idx = window_frames(first, length, torch.Generator(), time_reversal=False, stride=stride)
    assert torch.equal(idx.diff(dim=1), stride[:, None].expand(-1, length - 1))
    assert (idx[:, 0] // 400 == idx[:, -1] // 400).all(), "a window crosses two trajectories"
    assert (idx % 400).max() < 380, "a held-out frame is trained on"
    shares = [(stride == s).double().mean().item() for s in strides]
    np.testing.assert_allclose(shares, 1 / 3, atol=0.03)
    # Held-out stretches of twenty frames hold windows of stride one alone.
    assert StrideSampler.of(harmonic_frames, length, strides, validation=True).strides == (1,)
    with pytest.raises(InputError, match="60 ps apart fits"):
        StrideSampler.of(harmonic_frames, length, (1, 60))


def test_weights_say_the_range_and_the_jumps_at_each_lag(weights: Weights, harmonic_frames: TrainingFrames,
                                                         small_model_config: LamSlideConfig,
                                                         tmp_path: Path) -> None:  # fmt: skip
    assert (weights.domain.lag_ps, weights.domain.longest_lag_ps) == (1.0, 20.0)
    assert "frames 1 to 20 ps apart" in weights.domain.describe()
    assert weights.model.config.approximator.lag_range_ps == (1.0, 20.0)
    measured = load_weights(train_lam_slide(harmonic_frames, tmp_path / "m.safetensors", small_model_config,
                                            replace(QUICK, stage_one_steps=2, stage_two_steps=2))).domain  # fmt: skip
    # Frames one apart are correlated (0.8), those twenty apart are not: they differ by more.
    assert measured.jumps[-1][1] > 1.2 * measured.jumps[0][1] > 0.0
    assert measured.limits is not None and measured.jumps[0][1] == pytest.approx(measured.limits["jump_min_nm"])


def test_the_lag_follows_from_what_is_kept(weights: Weights, monkeypatch: pytest.MonkeyPatch) -> None:
    assert choose_lag(weights, None, None) == 1.0
    assert choose_lag(weights, None, 7.0) == 7.0
    assert choose_lag(weights, None, 60.0) == 20.0
    assert choose_lag(weights, None, 50.0) == pytest.approx(50.0 / 3)
    assert choose_lag(weights, 2.5, 50.0) == 2.5
    monkeypatch.setattr(weights.model, "usual_lag_ps", 10.0)
    assert choose_lag(weights, None, 60.0) == 10.0 and choose_lag(weights, 20.0, 60.0) == 20.0
    # Longer steps that keep populations are taken where the save interval is a multiple of them.
    monkeypatch.setattr(weights.model, "keeps_populations", lambda lag_ps: lag_ps <= 10.0 or lag_ps > 15.0)
    assert choose_lag(weights, None, 60.0) == 20.0 and choose_lag(weights, None, 30.0) == 10.0


@pytest.mark.parametrize(("lag_ps", "save_every_ps"), [(0.5, None), (21.0, None), (None, 0.5)])
def test_lags_outside_the_trained_range_are_refused_in_one_line(
    weights: Weights, alanine_dipeptide: Scene, tmp_path: Path, lag_ps: float | None, save_every_ps: float | None
) -> None:
    config = RolloutConfig(time_ps=42.0, lag_ps=lag_ps, save_every_ps=save_every_ps)
    with pytest.raises(InputError, match=r"lags of 1 ps to 20 ps, not for .*`lag_ps") as refused:
        rollout(alanine_dipeptide, weights, [tmp_path / "x.h5"], config)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "x.h5").exists()


def test_weights_of_one_lag_take_no_other(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    same, _ = fit_weights(alanine_dipeptide, small_weights, lag_ps=1.0)
    assert same is small_weights
    with pytest.raises(InputError, match="takes no other lag"):
        fit_weights(alanine_dipeptide, small_weights, lag_ps=2.0)


def test_a_rollout_steps_at_the_interval_that_is_kept(weights: Weights, alanine_dipeptide: Scene,
                                                      tmp_path: Path) -> None:  # fmt: skip
    def roll(name: str, **more: float) -> tuple[np.ndarray, np.ndarray, dict]:
        config = RolloutConfig(time_ps=70.0, solver_steps=2, precision="fp32", guard="off", **more)
        rollout(alanine_dipeptide, weights, [tmp_path / name], config)
        with open_trajectory(tmp_path / name) as reader:
            return reader.read().astype(np.float64), reader.time_ps, dict(reader.record)

    kept, times, record = roll("ten.h5", save_every_ps=10.0)
    np.testing.assert_allclose(times, 10.0 * np.arange(1, 8))
    assert record["lag_ps"] == 10.0
    assert record["cost"]["network_evaluations"] == 2, "one chunk of seven frames, none of which is thrown away"
    finer, _, record = roll("five.h5", save_every_ps=10.0, lag_ps=5.0)
    assert record["lag_ps"] == 5.0 and record["cost"]["network_evaluations"] == 4
    assert np.abs(finer - kept).max() > 1e-5
    every, times, _ = roll("one.h5")
    assert len(every) == 70 and times[0] == 1.0
    # The first chunk has the same noise and start at each lag: what differs is the lag that the network takes.
    assert np.abs(every[:7] - kept).max() > 1e-5


def test_the_guards_limit_of_jumps_is_that_of_the_lag(weights: Weights, alanine_dipeptide: Scene) -> None:
    jumps = ((1.0, 0.01, 0.1), (4.0, 0.03, 0.2), (20.0, 0.05, 0.4))
    measured = replace(weights, domain=replace(weights.domain, jumps=jumps))
    for lag, least, most in ((1.0, 0.01, 0.1), (4.0, 0.03, 0.2), (2.0, 0.01, 0.2), (20.0, 0.05, 0.4)):
        fitted, _ = fit_weights(alanine_dipeptide, measured, lag_ps=lag)
        assert fitted.domain.lag_ps == lag and fitted.domain.limits is not None
        assert (fitted.domain.limits["jump_min_nm"], fitted.domain.limits["jump_max_nm"]) == (least, most)


def test_a_simulation_steps_at_its_lag(weights: Weights, alanine_dipeptide: Scene) -> None:
    simulation = Simulation(alanine_dipeptide, weights, lag_ps=5.0, solver_steps=2)
    assert simulation.lag_ps == 5.0
    simulation.step(2)
    assert simulation.context.getState().getTime()._value == pytest.approx(10.0)


def test_longest_lags_that_the_frames_do_not_have_are_refused(
    harmonic_frames: TrainingFrames, small_model_config: LamSlideConfig, tmp_path: Path
) -> None:
    for longest, why in ((1.0, "at least twice"), (100.0, "ps apart fits"), (2.5, "frames' spacing")):
        with pytest.raises(InputError, match=why):
            train_lam_slide(harmonic_frames, tmp_path / "x.safetensors", small_model_config,
                            replace(QUICK, longest_lag_ps=longest))  # fmt: skip


def test_steps_in_a_further_solvent_are_shorter_where_nothing_is_said() -> None:
    weights = load_weights(weights_path("peptides"))
    for solvent, lag_ps in ((None, 100.0), ("obc2", 100.0), ("tip3p", 20.0)):
        meant = under_conditions(weights, {"solvent": solvent})
        assert choose_lag(meant, None, 100.0) == lag_ps and choose_lag(meant, 50.0, 100.0) == 50.0
