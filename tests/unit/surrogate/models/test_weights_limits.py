"""Weights of an older version, given limits afterwards: nothing else of them changes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from add_limits import add_limits

from surrogate.data.frames import TrainingFrames
from surrogate.models.weights import Weights, load_weights, save_weights
from systems.errors import InputError
from systems.trajectory.codec import open_writer


@pytest.mark.parametrize("half", [False, True])
def test_limits_are_added_and_nothing_else_changes(
    tmp_path: Path, small_weights: Weights, harmonic_frames: TrainingFrames, half: bool
) -> None:
    old, new = tmp_path / "old.safetensors", tmp_path / "new.safetensors"
    bare = replace(small_weights.domain, limits=None)
    save_weights(old, small_weights.model, bare, small_weights.provenance, half=half)
    references = []
    for k in range(2):
        references.append(tmp_path / f"r{k}.h5")
        idx = np.arange(400 * k, 400 * (k + 1))
        with open_writer(references[-1], harmonic_frames.scene, {"kind": "reference", **bare.conditions}) as writer:
            writer.append(harmonic_frames.positions_nm(idx), np.arange(400) + 1.0)
    before, after = load_weights(old), load_weights(add_limits(old, references, new))
    assert before.domain.limits is None and after.domain.limits is not None
    assert np.allclose(after.domain.limits["angle_max_rad"], small_weights.domain.limits["angle_max_rad"], atol=2e-2)
    assert replace(after.domain, limits=None, scene=before.domain.scene) == before.domain
    assert after.provenance == before.provenance
    states = (before.model.state_dict(), after.model.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert abs(old.stat().st_size - new.stat().st_size) < 20_000, "in the precision they had"
    with open_writer(tmp_path / "hot.h5", harmonic_frames.scene, {**bare.conditions, "temperature_k": 400.0}) as writer:
        writer.append(harmonic_frames.positions_nm(np.arange(100)), np.arange(100) + 1.0)
    with pytest.raises(InputError, match="trained under"):
        add_limits(old, [tmp_path / "hot.h5"], tmp_path / "other.safetensors")
