"""The recipe of PAINET's alanine dipeptide: which frames it trains on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.bench.recipes import alanine_dipeptide_painet as recipe
from surrogate.data.frames import TrainingFrames, quantise
from surrogate.data.splits import Split
from surrogate.data.weights import load_weights, save_weights
from surrogate.models.painet.model import Painet
from surrogate.training.provenance import training_domain
from systems.scene import Scene


@pytest.fixture
def frames(alanine_dipeptide: Scene) -> TrainingFrames:
    """Three runs of 1,000 frames, numbered by their first coordinate; the last is held out."""
    x = np.zeros((3000, alanine_dipeptide.n_atoms, 3))
    x[:, 0, 0] = 1e-3 * np.arange(3000)
    velocities = np.zeros(x.shape, dtype=np.float32)
    velocities[:, 0, 0] = np.arange(3000)
    return TrainingFrames(alanine_dipeptide, quantise(x), np.array([0, 1000, 2000, 3000]), 0.001, False,
                          {"temperature_k": 300.0}, ({"file": "a"},), velocities, Split(held=(2,)))  # fmt: skip


def numbers(frames: TrainingFrames, idx: np.ndarray) -> list[int]:
    assert frames.velocities is not None
    return [round(float(n)) for n in frames.velocities[idx, 0, 0]]


def test_pieces_of_the_runs_are_taken_and_held_out_runs_stay_whole(frames: TrainingFrames) -> None:
    thinned = recipe.thin(frames)
    pieces = np.split(np.arange(thinned.n_frames), thinned.starts[1:-1])
    assert [len(p) for p in pieces] == 6 * [recipe.PIECE] + [1000]
    assert [numbers(thinned, p[:1])[0] for p in pieces] == [0, 400, 800, 1000, 1400, 1800, 2000]
    training = thinned.window_starts(9, validation=False)
    assert max(numbers(thinned, training)) < 2000 <= min(numbers(thinned, thinned.window_starts(9, validation=True)))
    np.testing.assert_allclose(thinned.positions_nm(training)[:, 0, 0] * 1e3, numbers(thinned, training), atol=0.2)


def test_joined_frames_hold_out_what_the_first_do(frames: TrainingFrames) -> None:
    other = replace(frames, conditions={"temperature_k": 450.0}, sources=({"file": "b"},))
    joined = recipe.join(frames, other)
    assert joined.starts.tolist() == [0, 1000, 2000, 3000, 4000, 5000, 6000]
    assert joined.conditions == {"temperature_k": 300.0}
    assert [s["file"] for s in joined.sources] == ["a", "b"]
    held = joined.window_starts(9, validation=True)
    assert (held >= 2000).all() and (held < 3000).all()
    assert numbers(joined, np.array([4321])) == [1321]


def test_what_is_shipped_differs_by_its_bath_alone(tmp_path: Path, frames: TrainingFrames) -> None:
    torch.manual_seed(0)
    model = Painet(replace(recipe.model_config(), width=8, n_heads=1, head_dim=4, n_radial=3))
    save_weights(tmp_path / "a.safetensors", model, training_domain(frames), {"seed": 0})
    shipped = load_weights(recipe.ship(tmp_path / "a.safetensors", tmp_path / "b.safetensors"))
    assert shipped.model.config == replace(model.config, friction_per_ps=recipe.BATH_PER_PS)
    assert shipped.provenance == {"seed": 0}
    assert all(torch.equal(p, shipped.model.state_dict()[name]) for name, p in model.state_dict().items())
