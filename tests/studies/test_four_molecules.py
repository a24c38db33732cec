"""Potentials of four molecules: densities of distances, and when a replica is lost."""

from __future__ import annotations

import four_molecules as study
import numpy as np
import pytest

from systems.chemistry.validity import geometry_from_frames
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene


@pytest.fixture(scope="module")
def ethanol() -> Scene:
    return scene_from_smiles("CCO")


def shaken(scene: Scene, n: int, width_nm: float, seed: int) -> FloatArray:
    """Frames `(n, n_atoms, 3)` nm about the scene's own."""
    return scene.positions_nm + width_nm * np.random.default_rng(seed).normal(size=(n, scene.n_atoms, 3))


def test_densities_are_of_distances_in_angstrom(ethanol: Scene) -> None:
    still = ethanol.positions_nm[None]
    density = study.distance_density([still])
    assert density.sum() * 0.02 == pytest.approx(1.0)
    apart = np.linalg.norm(still[0][:, None] - still[0], axis=-1)[np.triu_indices(ethanol.n_atoms, 1)]
    middles = 5.0 * (study.EDGES_NM[1:] + study.EDGES_NM[:-1])
    assert (middles * density).sum() * 0.02 == pytest.approx(10.0 * apart.mean(), abs=0.02)
    assert study.density_error(density, density) == 0.0
    assert study.density_error(density, study.distance_density([2.0 * still])) > 1.5


def test_equal_runs_are_nearer_than_hotter_ones(ethanol: Scene) -> None:
    runs = [study.distance_density([shaken(ethanol, 2000, 0.01, seed)]) for seed in (1, 2)]
    hotter = study.distance_density([shaken(ethanol, 2000, 0.02, 3)])
    assert study.density_error(*runs) < 0.06
    assert study.density_error(runs[0], hotter) > 0.12


def test_replicas_count_until_a_bond_is_half_an_angstrom_off(ethanol: Scene) -> None:
    md = [shaken(ethanol, 400, 0.002, seed) for seed in (1, 2)]
    reference = study.ReferenceForces.__new__(study.ReferenceForces)
    reference.geometry = geometry_from_frames(ethanol, np.concatenate(md))
    reference.densities = [study.distance_density([run]) for run in md]
    whole, lost = shaken(ethanol, 100, 0.002, 3), shaken(ethanol, 100, 0.002, 4)
    bond = ethanol.bonds[0]
    along = ethanol.positions_nm[bond[1]] - ethanol.positions_nm[bond[0]]
    lost[40, bond[1]] += 0.06 * along / np.linalg.norm(along)  # and the frames behind it are fine again
    words, far = reference.compare([whole, lost], 0.1)
    assert words == "7 of 10 ps, 1 of 2 lost"
    assert all(float(value) < 0.25 for value in far.split(" and "))
    lost[40, bond[1]] -= 0.02 * along / np.linalg.norm(along)
    assert reference.compare([whole, lost], 0.1)[0] == "10 of 10 ps, 0 of 2 lost"
    lost[:, 0] = np.nan
    assert reference.compare([lost], 0.1) == ["0 of 10 ps, 1 of 1 lost", "no frames"]


def test_forces_are_compared_in_kcal_per_mol_and_angstrom() -> None:
    zero = np.zeros((2, 3, 3))
    assert study.force_error(zero + 41.84, zero) == pytest.approx(1.0)
