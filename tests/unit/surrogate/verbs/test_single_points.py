"""Energies of a reference at frames of a potential's rollout: which frames, what is kept, and the sign."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from md_reference.forces.quantum import Potential
from md_reference.run.machine import available_cores
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.models.architecture import shipped_weights
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights, load_weights
from surrogate.verbs.run import single_points
from surrogate.verbs.run.run_record import ENERGIES_NAME
from surrogate.verbs.run.single_points import ask_reference, differences
from systems.chemistry.validity import CHIRALITY
from systems.errors import InputError
from systems.interrupts import stop_when
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.codec import frame_factors

pytest.importorskip("tblite")


@pytest.fixture(scope="module")
def general() -> Weights:
    return load_weights(shipped_weights()["drug-like-gfn2-xtb"])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return prepare("smiles:CO")


def rolled(scene: Scene, n: int = 6) -> Ensemble:
    rng = np.random.default_rng(0)
    frames = [
        (scene.positions_nm + 0.002 * rng.normal(size=(n, scene.n_atoms, 3))).astype(np.float32) for _ in range(2)
    ]
    flags = [np.zeros(n, dtype=np.uint16) for _ in range(2)]
    flags[1][3] = CHIRALITY
    return Ensemble("surrogate", frames, 1.0, scene, flags=flags)


def test_every_valid_frame_has_the_reference_s_energy_less_the_potential_s(
    tmp_path: Path, scene: Scene, general: Weights
) -> None:
    frames = rolled(scene)
    ask_reference(scene, general, frames, tmp_path, 60.0, 0)
    assert isinstance(general.model, PainetPotential)
    own = general.model.energies(torch.from_numpy(frames.segments[0].astype(np.float64)), Molecule.of(scene)).mean(-1)
    right = [Potential(scene)(x.astype(np.float64))[0] for x in frames.segments[0]] - own.detach().numpy()
    found = differences(tmp_path, frames.segment_lengths)
    assert found[0] == pytest.approx(right, abs=1e-4)
    assert np.isnan(found[1]).tolist() == [k == 3 for k in range(6)], "an invalid frame is not asked for"
    factors = frame_factors(found, 300.0)
    energies = -0.0083144626 * 300.0 * np.log(factors[0])
    assert energies - energies[0] == pytest.approx(found[0] - found[0][0], abs=1e-6)
    assert np.nansum(np.concatenate(factors)) == pytest.approx(1.0)
    # More frames are asked for, those that are known stay.
    before = (tmp_path / ENERGIES_NAME).read_text().splitlines()
    ask_reference(scene, general, rolled(scene, 8), tmp_path, 60.0, 1)
    after = (tmp_path / ENERGIES_NAME).read_text().splitlines()
    assert set(before) < set(after) and len(after) == len(before) + 4


def test_what_was_asked_before_the_time_was_up_is_kept(
    tmp_path: Path, scene: Scene, general: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(single_points, "_TOGETHER", 1)
    calls = iter(range(100))
    with pytest.raises(KeyboardInterrupt), stop_when(lambda: next(calls) > 2):
        ask_reference(scene, general, rolled(scene, 40), tmp_path, 600.0, 0)
    found = np.concatenate(differences(tmp_path, [40, 40]))
    assert 0 < np.isfinite(found).sum() < 79
    monkeypatch.setattr(single_points.Labeller, "energies", lambda self, x: np.full(len(x), np.inf))
    with pytest.raises(InputError, match="no energy of any frame"):
        ask_reference(scene, general, rolled(scene), tmp_path / "none", 60.0, 0)
    assert not (tmp_path / "none").exists()


def test_where_there_is_no_time_a_few_frames_are_asked_for_all_the_same(
    tmp_path: Path, scene: Scene, general: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(single_points, "_TOGETHER", 1)
    ask_reference(scene, general, rolled(scene, 40), tmp_path, -1.0, 0)
    assert 0 < np.isfinite(np.concatenate(differences(tmp_path, [40, 40]))).sum() <= available_cores()


def test_a_damaged_file_is_refused_in_a_line(tmp_path: Path) -> None:
    for text in ("replica,frame,difference_kj_mol\n0,1\n", "a\n0,x,1.0\n", "a\n0,1,1.0,2\n"):
        (tmp_path / ENERGIES_NAME).write_text(text)
        with pytest.raises(InputError, match=r"energies\.csv cannot be read"):
            differences(tmp_path, [4])
    (tmp_path / ENERGIES_NAME).write_text("a\n0,1,2.5\n-1,1,9.0\n0,7,9.0\n5,0,9.0\n")
    (found,) = differences(tmp_path, [4])
    assert found[1] == 2.5 and np.isnan(found[[0, 2, 3]]).all(), "frames that are not there are left out"


def test_a_frame_of_another_molecule_weighs_nothing() -> None:
    factors = frame_factors([np.array([1.0, np.inf, np.nan]), np.array([3.494, np.nan, np.nan])], 300.0)
    assert factors[0][1] == 0.0 and np.isnan(factors[0][2]) and np.isnan(factors[1][1:]).all()
    assert factors[1][0] / factors[0][0] == pytest.approx(np.exp(-1.0), abs=1e-3)
