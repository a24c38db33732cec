"""The shipped PAINET weights: potentials."""

from __future__ import annotations

import numpy as np
import pytest

from md_reference.forces.quantum import Potential
from surrogate.data.shipped import weights_path
from surrogate.sampling.openmm.learned_forces import LearnedForces
from systems.prepare.molecule import scene_from_smiles


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
