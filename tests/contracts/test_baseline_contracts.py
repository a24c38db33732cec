"""The baselines, held against the contract and against what each of them must reproduce."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.data import TrainingFrames
from surrogate.models.baselines import (
    Baseline,
    BaselineConfig,
    FrozenFrame,
    NormalModes,
    TrainingFrameResampling,
    autoregression,
    fit_baseline,
)
from surrogate.models.conformance import PropagatorContract
from surrogate.models.propagator import Propagator
from surrogate.models.weights import load_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory


def normal(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


class TestFrozenFrame(PropagatorContract):
    equivariant = reflects = permutes = True
    uses_noise = False
    bf16_error = None

    def make(self, n_atoms: int) -> Propagator:
        return FrozenFrame(BaselineConfig(n_new=4))


class TestResampling(PropagatorContract):
    uses_frames = False
    bf16_error = None

    def make(self, n_atoms: int) -> Propagator:
        model = TrainingFrameResampling(BaselineConfig(4, n_atoms, n_frames=50))
        model.frames_nm.copy_(normal(50, n_atoms, 3))
        return model


class TestNormalModes(PropagatorContract):
    bf16_error = None

    def make(self, n_atoms: int) -> Propagator:
        model = NormalModes(BaselineConfig(4, n_atoms, n_modes=min(5, 3 * n_atoms)))
        model.modes.copy_(torch.linalg.qr(normal(3 * n_atoms, model.config.n_modes))[0].T)
        model.coefficients.copy_(torch.tensor([[1.2], [-0.6], [0.1]]))
        return model


def test_a_baseline_fitted_to_one_molecule_refuses_another() -> None:
    model = TestNormalModes().make(4)
    molecule = TestNormalModes().molecule(5)
    with pytest.raises(InputError, match="4 atoms, not 5"):
        model.next_chunk(torch.zeros(1, 2, 5, 3), molecule, torch.zeros(1, 4, 5))


def test_an_oscillator_is_forecast_exactly_and_an_overdamped_mode_keeps_its_relaxation() -> None:
    """c = cos(omega t + phase) with random phases has r1 = cos(omega), r2 = cos(2 omega)."""
    rng = np.random.default_rng(0)
    phase = rng.uniform(0, 2 * np.pi, size=20_000)
    t = np.arange(3)
    oscillator = np.cos(0.7 * t + phase[:, None])
    relaxing = np.zeros((20_000, 3))
    relaxing[:, 0] = rng.normal(size=20_000)
    for k in (1, 2):
        relaxing[:, k] = 0.6 * relaxing[:, k - 1] + 0.8 * rng.normal(size=20_000)
    a, b, s = autoregression(np.stack([oscillator, relaxing], axis=-1))
    assert a[0] == pytest.approx(2 * np.cos(0.7), abs=0.01)
    assert b[0] == pytest.approx(-1.0, abs=0.01)
    assert s[0] < 0.1
    np.testing.assert_allclose([a[1], b[1], s[1]], [0.6, 0.0, 0.8], atol=0.02)


def rolled(kind: type[Baseline], frames: TrainingFrames, folder: Path, n_frames: int, replicas: int = 1) -> np.ndarray:
    weights = load_weights(fit_baseline(kind, frames, folder / "w.safetensors"))
    outs = [folder / f"{k}.h5" for k in range(replicas)]
    rollout(frames.scene, weights, outs, RolloutConfig(time_ps=float(n_frames), precision="fp32"))
    found = []
    for out in outs:
        with open_trajectory(out) as reader:
            assert reader.record["model"] == kind.arch
            found.append(reader.read())
    return np.stack(found)


def test_frozen_frames_stay_where_they_start(
    tmp_path: Path, harmonic_frames: TrainingFrames, alanine_dipeptide: Scene
) -> None:
    found = rolled(FrozenFrame, harmonic_frames, tmp_path, 40)
    np.testing.assert_allclose(found[0], np.broadcast_to(alanine_dipeptide.positions_nm, found[0].shape), atol=2e-6)


def test_normal_modes_keep_variance_and_correlation_through_a_rollout(
    tmp_path: Path, harmonic_frames: TrainingFrames
) -> None:
    """The fixture's frames are a linear process with correlation 0.8 from frame to frame, 0.004 nm wide."""
    found = rolled(NormalModes, harmonic_frames, tmp_path, 400, replicas=6).astype(np.float64)[:, 50:]
    lengths = np.linalg.norm(found[:, :, 1] - found[:, :, 4], axis=-1)
    reference = harmonic_frames.positions_nm(np.arange(800)).astype(np.float64)
    ref = np.linalg.norm(reference[:, 1] - reference[:, 4], axis=-1)
    assert lengths.std() == pytest.approx(ref.std(), rel=0.15)
    z = lengths - lengths.mean()
    assert (z[:, 1:] * z[:, :-1]).mean() / z.var() == pytest.approx(0.8, abs=0.06)


def test_resampled_frames_are_training_frames(tmp_path: Path, harmonic_frames: TrainingFrames) -> None:
    starts = harmonic_frames.window_starts(1, validation=False)
    distances = lambda x: np.linalg.norm(x[:, :, None] - x[:, None], axis=-1).reshape(len(x), -1)  # noqa: E731
    found = rolled(TrainingFrameResampling, harmonic_frames, tmp_path, 32)[0]
    gaps = np.abs(distances(found)[:, None] - distances(harmonic_frames.positions_nm(starts))[None]).max(-1)
    assert gaps.min(1).max() < 5e-6
    assert len(set(gaps.argmin(1))) > 8, "not one and the same frame"


@pytest.mark.parametrize(("kind", "at_random"), [(TrainingFrameResampling, True), (NormalModes, False)])
def test_frames_drawn_at_random_have_no_limit_of_jumps(
    tmp_path: Path, harmonic_frames: TrainingFrames, kind: type[Baseline], at_random: bool
) -> None:
    limits = load_weights(fit_baseline(kind, harmonic_frames, tmp_path / "w.safetensors")).domain.limits
    assert limits is not None and (len(limits["jump_idx"]) == 0) == at_random
