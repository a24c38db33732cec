"""Model systems as scenes: starting conditions by the protocol, seeds, files, and everything that asks for elements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.graph import backbone_torsions, match_atoms, molecule_key, rotatable_torsions, stereocentres
from systems.chemistry.validity import NOT_FINITE, check_frames, geometry_from_frames, geometry_from_scene
from systems.errors import InputError, OutOfDomainError
from systems.library.particles import N_BODY, double_well, harmonic_oscillator, n_body, particles
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.topology_file import pdb_text

SCENES = {"harmonic": harmonic_oscillator, "double-well": double_well} | {
    name: (lambda name=name: n_body(name, 7)) for name in N_BODY
}
SEEDS = range(400)


@pytest.fixture(params=SCENES, ids=SCENES)
def scene(request: pytest.FixtureRequest) -> Scene:
    return SCENES[request.param]()


def mean_is(values: np.ndarray, expected: float) -> bool:
    return abs(values.mean() - expected) < 4.0 * values.std() / np.sqrt(values.size)


# ---- starting conditions -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", N_BODY)
def test_a_seed_is_a_scene(name: str) -> None:
    first, again, other = n_body(name, 3), n_body(name, 3), n_body(name, 4)
    np.testing.assert_array_equal(first.positions_nm, again.positions_nm)
    np.testing.assert_array_equal(first.velocities_nm_ps, again.velocities_nm_ps)
    assert first.interactions == again.interactions
    assert np.abs(first.positions_nm - other.positions_nm).min() > 0.0
    assert first.name == f"{name}:3"


@pytest.mark.parametrize(("name", "std", "n"), [("n-body-charged", 1.0, 5), ("n-body-spring", 0.5, 5),
                                                ("n-body-gravity", 1.0, 10)])  # fmt: skip
def test_starting_positions_have_the_published_spread(name: str, std: float, n: int) -> None:
    x = np.array([n_body(name, seed).positions_nm for seed in SEEDS])
    assert x.shape[1:] == (n, 3)
    assert mean_is(x, 0.0)
    assert mean_is(x**2, std**2)
    assert not mean_is(x**2, 1.1 * std**2)
    assert mean_is(x**4, 3.0 * std**4), "not normal"


@pytest.mark.parametrize("name", ["n-body-charged", "n-body-spring"])
def test_every_particle_starts_at_the_published_speed_in_a_random_direction(name: str) -> None:
    v = np.array([n_body(name, seed).velocities_nm_ps for seed in SEEDS])
    np.testing.assert_allclose(np.linalg.norm(v, axis=-1), 0.5, rtol=1e-12)
    for axis in range(3):
        assert mean_is(v[..., axis], 0.0)
        assert mean_is(v[..., axis] ** 2, 0.25 / 3.0)


def test_gravity_starts_with_its_centre_of_mass_at_rest() -> None:
    v = np.array([n_body("n-body-gravity", seed).velocities_nm_ps for seed in SEEDS])
    np.testing.assert_allclose(v.mean(axis=1), 0.0, atol=1e-12)
    assert mean_is(v**2, 1.0 - 1.0 / 10.0)  # the mean of ten was taken away
    assert not mean_is(v**2, 1.0)


def test_charges_and_springs_come_with_even_odds() -> None:
    charges = np.array([n_body("n-body-charged", seed).interactions["charges_e"] for seed in SEEDS])
    assert set(np.unique(charges)) == {-1.0, 1.0}
    assert mean_is(charges, 0.0)
    n_springs = np.array([len(n_body("n-body-spring", seed).interactions["pairs"]) for seed in SEEDS])
    assert mean_is(n_springs, 5.0)  # of ten pairs
    assert n_springs.var() == pytest.approx(2.5, abs=0.8)


# ---- everything that asks for elements -----------------------------------------------------------------------------


def test_a_scene_survives_its_record(scene: Scene) -> None:
    again = Scene.from_dict(scene.to_dict())
    assert again.topology_hash == scene.topology_hash
    assert again.interactions == scene.interactions
    if scene.velocities_nm_ps is None:
        assert again.velocities_nm_ps is None
    else:
        np.testing.assert_array_equal(again.velocities_nm_ps, scene.velocities_nm_ps)
        assert replace(scene, velocities_nm_ps=None).topology_hash == scene.topology_hash
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
    gravity, other = n_body("n-body-gravity", 1), n_body("n-body-gravity", 2)
    np.testing.assert_array_equal(match_atoms(other, gravity), np.arange(10))
    assert molecule_key(gravity) == molecule_key(other)
    first, second = n_body("n-body-charged", 0), n_body("n-body-charged", 1)
    assert first.interactions != second.interactions
    assert molecule_key(first) != molecule_key(second)
    for scene, template in (
        (first, second),
        (first, n_body("n-body-spring", 0)),
        (harmonic_oscillator(), double_well()),
    ):
        with pytest.raises(OutOfDomainError, match="different laws"):
            match_atoms(scene, template)


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "said"),
    [
        ({"kind": "magnetism"}, "unknown"),
        ({"kind": "coulomb", "coulomb_constant": 1.0}, "charges_e"),
        ({"kind": "coulomb", "coulomb_constant": 1.0, "charges_e": [1.0]}, "1 charges for 2"),
        ({"kind": "springs", "force_constant_kj_mol_nm2": 1.0, "pairs": [[0, 2]]}, "two of the 2"),
        ({"kind": "harmonic", "force_constants_kj_mol_nm2": [1.0]}, "three"),
        ({"kind": "gravity", "gravitational_constant": 1.0, "softening_nm": 0.1, "mass": 1.0}, "mass"),
    ],
)
def test_a_law_that_does_not_fit_is_refused_in_one_line(law: dict, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        particles("x", law, np.zeros((2, 3)), masses_da=np.ones(2))
    assert "\n" not in str(caught.value)
