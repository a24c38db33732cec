"""The benchmark of forecasters: what it fits, what it matches, what it counts as unseen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import forecasters
import numpy as np
import pytest
import torch
from forecasters import (
    Cost,
    _working_parameters,
    compare_errors,
    cut,
    exponent,
    matched_width,
    measure_cost,
    window_errors,
)
from painet_modes import ModalConfig, ModalEgnn, ModalPainet

from surrogate.data import TrainingFrames, quantise
from surrogate.models.painet.model import PainetTraining
from systems.errors import InputError
from systems.scene import Scene

SMALL = ModalConfig(n_new=2, width=16, n_heads=2, head_dim=8, n_decoder_layers=1, lag_ps=0.01)


@pytest.fixture(scope="module")
def drifting(alanine_dipeptide: Scene) -> TrainingFrames:
    return _drifting(alanine_dipeptide, 100)


def _drifting(alanine_dipeptide: Scene, n_frames: int) -> TrainingFrames:
    """Atoms that move on straight lines from where they stand."""
    rng = np.random.default_rng(0)
    v = rng.normal(size=(1, 22, 3)) * 0.1
    v -= (alanine_dipeptide.masses_da / alanine_dipeptide.masses_da.sum()) @ v
    x = alanine_dipeptide.positions_nm + v * 0.01 * np.arange(n_frames)[:, None, None]
    x = x - np.einsum("a,nad->nd", alanine_dipeptide.masses_da / alanine_dipeptide.masses_da.sum(), x)[:, None]
    velocities = np.broadcast_to(v, x.shape).astype(np.float32)
    starts = np.array([0, n_frames])
    return TrainingFrames(alanine_dipeptide, quantise(x), starts, 0.01, False, {}, (), velocities)


def test_the_exponent_of_a_power_law_is_found() -> None:
    costs = [Cost(n, 0.02 * n**1.3, None) for n in (10, 100, 1000)]
    assert exponent(costs) == pytest.approx(1.3)


def test_a_chunk_costs_processor_time_in_both_forms() -> None:
    cost = measure_cost(10, SMALL, 1)
    assert cost.atoms == 10
    assert 0 < cost.linear_ms < 1e4
    assert cost.dense_ms is not None


def test_egnn_is_given_at_least_the_parameters_and_hardly_more() -> None:
    width = matched_width(SMALL)
    target = _working_parameters(ModalPainet(SMALL))
    assert width > SMALL.width
    assert target <= _working_parameters(ModalEgnn(replace(SMALL, width=width))) < 1.2 * target


def test_the_unseen_part_is_the_last_and_nothing_else(drifting: TrainingFrames) -> None:
    known, unseen = cut(drifting, 0.2)
    assert (known.n_frames, unseen.n_frames) == (80, 20)
    assert np.array_equal(np.concatenate([known.coordinates, unseen.coordinates]), drifting.coordinates)
    assert np.array_equal(unseen.velocities, drifting.velocities[80:])


def test_the_error_is_per_coordinate_in_square_angstrom(drifting: TrainingFrames) -> None:
    """A model that keeps everything in place is wrong by v t: its mean square follows from the velocities."""
    model = ModalPainet(SMALL)
    with torch.no_grad():
        for name, p in model.decoder.named_parameters():
            if "factor.2" in name:
                p.zero_()
    expected = 100.0 * np.mean([np.square(drifting.velocities[0] * 0.01 * (t + 1)).mean() for t in range(2)])
    assert window_errors(model, drifting).mean() == pytest.approx(expected, rel=0.05)
    assert len(window_errors(model, drifting, 7)) == 7


def test_a_comparison_goes_on_from_what_is_there_and_says_how_sure_it_is(
    alanine_dipeptide: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = _drifting(alanine_dipeptide, 500)
    monkeypatch.setattr(forecasters, "collect_frames", lambda *args, **kwargs: longer)
    training = PainetTraining(steps=3, batch=4, noise=0.0, pushforward=0.0, velocity_weight=0.0)
    settings = replace(SMALL, n_modes=4, free_rotation=True)
    first = compare_errors(Path("drifting.h5"), settings, training, tmp_path)
    assert first.constant_velocity < 1e-4 < first.frozen
    assert first.spans == 50
    assert first.ratio.low <= first.ratio.value <= first.ratio.high
    assert first.ratio.value == pytest.approx(first.painet / first.egnn, rel=0.1)
    made = {path: path.stat().st_mtime_ns for path in tmp_path.glob("drifting.*.safetensors")}
    assert len(made) == 2
    again = compare_errors(Path("drifting.h5"), settings, training, tmp_path)
    assert again == first
    assert {path: path.stat().st_mtime_ns for path in made} == made
    with pytest.raises(InputError, match="of other settings"):
        compare_errors(Path("drifting.h5"), replace(settings, n_modes=5), training, tmp_path)
