"""The shipped PAINET weights: an integrator that rolls without help and does not stand still, and a potential."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from md_reference.forces.quantum import Potential
from surrogate.bench.integrator import bonds
from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights
from surrogate.sampling.config import RolloutConfig
from surrogate.sampling.openmm.learned_forces import LearnedForces
from surrogate.sampling.runner import rollout
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.prepare.molecule import scene_from_smiles
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


def test_the_potential_has_the_forces_of_its_truth() -> None:
    pytest.importorskip("tblite")
    path = weights_path("paracetamol-gfn2-xtb")
    assert path.stat().st_size < 2e6
    scene = scene_from_smiles("OC1=CC=C(NC(C)=O)C=C1")  # in another order than the weights have
    truth, learned = Potential(scene), LearnedForces(scene, path)
    rng, wrong, size = np.random.default_rng(0), [], []
    for _ in range(4):
        x = scene.positions_nm + 0.003 * rng.normal(size=scene.positions_nm.shape)
        forces = truth(x)[1]
        wrong.append(np.abs(learned(x)[1] - forces).mean())
        size.append(np.abs(forces).mean())
    # 21 kJ/mol/nm on MD at 300 K, 31 on hotter states (its card).
    assert np.mean(wrong) < 60.0 < 0.1 * np.mean(size)
