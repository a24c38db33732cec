"""Model systems as scenes: files, and everything that asks for elements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.graph import backbone_torsions, match_atoms, molecule_key, rotatable_torsions, stereocentres
from systems.chemistry.validity import NOT_FINITE, check_frames, geometry_from_frames, geometry_from_scene
from systems.errors import InputError, OutOfDomainError
from systems.library.named_scenes import double_well, harmonic_oscillator, particles
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import pdb_text

SCENES = {"harmonic": harmonic_oscillator, "double-well": double_well}


@pytest.fixture(params=SCENES, ids=SCENES)
def scene(request: pytest.FixtureRequest) -> Scene:
    return SCENES[request.param]()


# ---- everything that asks for elements -----------------------------------------------------------------------------


def test_a_scene_survives_its_record(scene: Scene) -> None:
    again = Scene.from_dict(scene.to_dict())
    assert again.topology_hash == scene.topology_hash
    assert again.interactions == scene.interactions
    assert replace(scene, interactions=None).topology_hash != scene.topology_hash


@pytest.mark.parametrize("suffix", [".h5", ".dcd"])
def test_mdtraj_and_mdanalysis_read_particles(scene: Scene, tmp_path: Path, suffix: str) -> None:
    import MDAnalysis
    import mdtraj

    path = tmp_path / f"a{suffix}"
    frames = scene.positions_nm + np.random.default_rng(0).normal(size=(5, scene.n_atoms, 3))
    with open_writer(path, scene, {"kind": "reference"}) as writer:
        writer.append(frames, np.arange(1.0, 6.0))
    with open_trajectory(path) as reader:
        assert reader.scene is not None
        assert reader.scene.topology_hash == scene.topology_hash
        np.testing.assert_allclose(reader.read(), frames, atol=1e-6)
    pdb = path.with_suffix(".pdb")
    if suffix == ".h5":
        pdb.write_text(pdb_text(scene))
    loaded = mdtraj.load(str(path)) if suffix == ".h5" else mdtraj.load(str(path), top=str(pdb))
    np.testing.assert_allclose(loaded.xyz, frames, atol=1e-5)
    universe = MDAnalysis.Universe(str(pdb), str(path), **({"format": "H5MD"} if suffix == ".h5" else {}))
    np.testing.assert_allclose([f.positions / 10.0 for f in universe.trajectory], frames, atol=1e-5)


def test_chemistry_finds_nothing_in_particles(scene: Scene) -> None:
    assert len(stereocentres(scene)) == len(rotatable_torsions(scene)) == 0
    assert not any(len(rows) for rows in backbone_torsions(scene).values())
    assert scene.formula == f"{scene.n_atoms} particle" + ("s" if scene.n_atoms > 1 else "")
    assert scene.to_openmm_topology().getNumAtoms() == scene.to_mdtraj_topology().n_atoms == scene.n_atoms


def test_particles_may_meet_but_not_vanish(scene: Scene) -> None:
    frames = np.zeros((3, scene.n_atoms, 3))  # all on one point
    frames[2, 0, 0] = np.nan
    for geometry in (geometry_from_scene(scene), geometry_from_frames(scene, frames[:2] + scene.positions_nm)):
        np.testing.assert_array_equal(check_frames(frames, geometry), [0, 0, NOT_FINITE])


def test_another_law_is_another_system() -> None:
    well = double_well()
    deeper = replace(well, interactions={**(well.interactions or {}), "barrier_kj_mol": 7.0})
    np.testing.assert_array_equal(match_atoms(double_well(), well), [0])
    assert molecule_key(double_well()) == molecule_key(well) != molecule_key(deeper)
    for template in (deeper, harmonic_oscillator()):
        with pytest.raises(OutOfDomainError, match="different laws"):
            match_atoms(well, template)


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "said"),
    [
        ({"kind": "magnetism"}, "magnetism"),
        ({"kind": "harmonic", "force_constants_kj_mol_nm2": [1.0]}, "three"),
        ({"kind": "harmonic"}, "force_constants_kj_mol_nm2"),
        ({"kind": "harmonic", "force_constants_kj_mol_nm2": [1.0, 1.0, 1.0], "mass": 1.0}, "mass"),
    ],
)
def test_a_law_that_does_not_fit_is_refused_in_one_line(law: dict, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        particles("x", law, np.zeros((2, 3)))
    assert "\n" not in str(caught.value)
