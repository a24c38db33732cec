"""The shipped weights for many molecules: an ethanol that they never saw, in any atom order, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from many_molecules import TRAINED, UNSEEN, change_per_frame

from surrogate import api
from surrogate.data.shipped import weights_path
from surrogate.data.weights import load_weights
from surrogate.sampling.domain import find_deviations
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.validity import BOND_20_PERCENT, INVALID, check_frames, geometry_from_scene
from systems.errors import InputError
from systems.prepare.molecule import scene_from_smiles
from systems.trajectory.codec import open_trajectory

NAME = "alkanes-alcohols-ethers"


def test_shipped_weights_are_described_by_name() -> None:
    found = api.info(NAME)
    assert f"{len(TRAINED)} molecules of up to 20 atoms" in found["summary"] and found["covers_unseen_molecules"]
    with pytest.raises(InputError, match="no such file"):
        api.info(NAME + "s")


def test_unseen_ethanol_rolls_and_its_frames_are_valid(tmp_path: Path) -> None:
    weights = load_weights(weights_path(NAME))
    assert weights_path(NAME).stat().st_size < 6e6
    assert len(weights.domain.members) == len(TRAINED)
    scene = scene_from_smiles("CCO")
    assert find_deviations(scene, weights.domain) == ()
    outs = [tmp_path / f"{k}.h5" for k in range(4)]
    rollout(scene, weights, outs, RolloutConfig(time_ps=35.0, seed=3, guard="off"))
    parts = []
    for out in outs:
        with open_trajectory(out) as reader:
            assert reader.record["unseen_molecule"] is True
            parts.append(reader.read().astype(np.float64))
    frames, geometry = np.concatenate(parts), geometry_from_scene(scene)
    flags = check_frames(frames, geometry)
    assert ((flags & INVALID) > 0).sum() <= 1 and ((flags & BOND_20_PERCENT) > 0).mean() < 0.05
    i, j = scene.bonds.T
    has_hydrogen = np.array([scene.elements[a] == "H" or scene.elements[b] == "H" for a, b in scene.bonds.tolist()])
    spread = np.linalg.norm(frames[:, i] - frames[:, j], axis=-1).std(axis=0)
    assert spread[has_hydrogen].max() < 1e-5, "the references hold them rigid"
    assert spread[~has_hydrogen].min() > 0.0015 and spread[~has_hydrogen].max() < 0.008
    # MD: 0.03 nm from frame to frame.
    assert 0.015 < change_per_frame(parts[0]) < 0.06


@pytest.mark.parametrize(
    ("text", "what"), [("CCN", "elements"), ("CC=O", "bond types"), ("CCCCCCC", "size"), ("C1CC1", "atom environments")]
)
def test_what_is_unlike_the_molecules_trained_on_is_refused(text: str, what: str) -> None:
    domain = load_weights(weights_path(NAME)).domain
    assert what in {d.what for d in find_deviations(scene_from_smiles(text), domain)}
    # The control: nothing is held against the molecules that were held out.
    for unseen in UNSEEN:
        assert find_deviations(scene_from_smiles(unseen), domain) == ()
    assert replace(domain, further=()).members[0].scene.formula == "C2H6"
