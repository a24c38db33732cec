"""The shipped PAINET weights: an integrator that rolls without help and does not stand still."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from surrogate.bench.integrator import bonds
from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.runner import rollout
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.trajectory.codec import open_trajectory


def test_its_frames_are_valid_and_move_as_the_reference_does(tmp_path: Path) -> None:
    weights = load_weights(weights_path("alanine-dipeptide-painet"))
    assert weights_path("alanine-dipeptide-painet").stat().st_size < 2e6
    scene, geometry = weights.domain.scene, Geometry.from_dict(weights.domain.geometry)
    out = tmp_path / "a.h5"
    rollout(scene, weights, [out], RolloutConfig(time_ps=300 * weights.domain.lag_ps, seed=3, guard="flag"))
    with open_trajectory(out) as reader:
        frames = reader.read()
    assert not (check_frames(frames, geometry) & np.uint16(INVALID)).any()
    # From the relaxed template to the width of bonds at 300 K: 0.0035 nm and less for heavy ones.
    settled = bonds(scene, frames[100:].astype(np.float64)).std(0)
    assert 0.0015 < np.median(settled) < 0.005
    assert np.abs(frames[-1] - frames[100]).max() > 0.02
