"""Weights files whose record is wrong, and models that learn several lags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lag_errors import _correlation
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from surrogate.data import TrainingFrames, canonicalise, quantise
from surrogate.models.lam_slide.model import ApproximatorConfig, AutoencoderConfig, LamSlideConfig
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.training.loop import tensor_checksum
from systems.errors import WeightsError
from systems.prepare.molecule import scene_from_smiles


def record_of(path: Path) -> dict[str, Any]:
    with safe_open(path, framework="pt") as handle:
        return json.loads(handle.metadata()["surromd"])


def forged(path: Path, record: Any, tensors: dict[str, Any]) -> Path:
    text = json.dumps(record)
    metadata = {"format": "surromd-weights-1", "surromd": text, "sha256": tensor_checksum(text, tensors)}
    save_file(tensors, path, metadata=metadata)
    return path


@pytest.mark.parametrize(("part", "key", "value"), [("approximator", "n_layers", 10_000),
                                                    ("approximator", "width", 10**9)])  # fmt: skip
def test_a_model_that_its_file_cannot_hold(small_weights: Weights, tmp_path: Path, part: str, key: str,
                                           value: int) -> None:  # fmt: skip
    record = record_of(small_weights.path)
    record["config"][part][key] = value
    with pytest.raises(WeightsError, match=f"{key} = {value} in a file of"):
        load_weights(forged(tmp_path / "w.safetensors", record, load_file(small_weights.path)))


MEMORY = 0.95


@pytest.mark.slow
def test_a_trained_model_forgets_as_fast_as_its_reference(tmp_path: Path) -> None:
    """One slow mode, an autoregression of `MEMORY` a frame, whose memory at a lag of k frames is MEMORY^k."""
    scene, rng, n = scene_from_smiles("CCO"), np.random.default_rng(0), 8000
    mode = rng.normal(size=(scene.n_atoms, 3))
    along = rng.normal(size=n)
    for t in range(1, n):
        along[t] = MEMORY * along[t - 1] + np.sqrt(1 - MEMORY**2) * along[t]
    frames = scene.positions_nm + 0.02 * along[:, None, None] * mode + 0.001 * rng.normal(size=(n, scene.n_atoms, 3))
    data = TrainingFrames(scene, quantise(canonicalise(frames, scene)), np.array([0, n]), 1.0, True,
                          {"temperature_k": 300.0}, ())  # fmt: skip
    config = LamSlideConfig(
        autoencoder=AutoencoderConfig(n_latents=1, latent_dim=8, width=32, head_dim=8),
        approximator=ApproximatorConfig(chunk_frames=4, latents_per_token=1, width=64, n_layers=2, n_heads=2,
                                        auxiliary_frames=0),
    )  # fmt: skip
    settings = TrainingConfig(stage_one_steps=600, stage_two_steps=2500, stage_one_batch=64, stage_two_batch=64,
                              bf16=False, validate_every_s=1e9, longest_lag_ps=50.0)  # fmt: skip
    weights = load_weights(train_lam_slide(data, tmp_path / "w.safetensors", config, settings))
    starts = np.arange(0, 7000, 14)
    known = data.positions_nm(starts)[:, None].astype(np.float64)

    def memory(lag_ps: float) -> float:
        fitted, _ = fit_weights(scene, weights, lag_ps=lag_ps)
        ahead = ChunkSampler(fitted, precision="fp32").draw(known, list(range(len(starts)))).frames_nm[:, 0]
        here, there = (np.einsum("nad,ad->n", x - scene.positions_nm, mode) for x in (known[:, 0], ahead))
        return _correlation(here, there)

    found = {lag: memory(lag) for lag in (1.0, 5.0, 20.0, 50.0)}
    expected = {lag: MEMORY**lag for lag in found}
    for lag, value in found.items():
        assert value == pytest.approx(expected[lag], abs=0.15), (found, expected)
    assert found[1.0] > found[5.0] + 0.08 > found[20.0] + 0.2, found
