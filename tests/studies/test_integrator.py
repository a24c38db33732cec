"""The comparison of integrators, held against an exact one and against one that heats what it integrates."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from integrator import IntegratorReport, angles, bonds, compare_integrator
from torch import Tensor

from surrogate.data import TrainingFrames, quantise
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.scene import Scene

LAG_PS, STIFFNESS = 0.002, 20_000.0
MASSES = np.array([2.0, 3.0, 2.0])


@pytest.fixture(scope="module")
def springs() -> Scene:
    """Three atoms, each tied to its own place: an angle of a right triangle."""
    return Scene(
        name="springs", atom_names=("A", "B", "C"), elements=("C", "N", "C"),
        residue_of_atom=np.zeros(3, dtype=np.int64), residue_names=("MOL",),
        residue_ids=("1",), chain_of_residue=("A",),
        bonds=np.array([[0, 1], [1, 2]]), bond_orders=np.ones(2), formal_charges=np.zeros(3, dtype=np.int64),
        masses_da=MASSES, positions_nm=np.array([[0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.15, 0.0]]),
    )  # fmt: skip


class ExactSprings(Propagator):
    """The exact flow of independent harmonic wells; `heating` multiplies every chunk's last velocity."""

    arch: ClassVar[str] = "springs"

    n_conditioning = 1
    n_new = 5

    def __init__(self, scene: Scene, heating: float = 1.0) -> None:
        super().__init__()
        self.rest = torch.tensor(scene.positions_nm)
        self.omega = torch.from_numpy(np.sqrt(STIFFNESS / MASSES))[:, None]
        self.heating = heating

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (0,)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        assert last_velocities_nm_ps is not None
        x, v = last_frames_nm[:, -1].double() - self.rest, last_velocities_nm_ps.double()
        turn = [self.omega * LAG_PS * (t + 1) for t in range(5)]
        found = torch.stack([self.rest + x * a.cos() + v / self.omega * a.sin() for a in turn], dim=1)
        end = v * turn[-1].cos() - x * self.omega * turn[-1].sin()
        return Chunk(found.float(), self.heating * end.float())


def energy(x: np.ndarray) -> float:
    rest = np.array([[0.15, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.15, 0.0]])
    return float(0.5 * STIFFNESS * np.square(x - rest).sum())


def evaluated(scene: Scene, **settings: Any) -> IntegratorReport:
    rng = np.random.default_rng(0)
    kt = 2.494
    x = scene.positions_nm + rng.normal(size=(400, 3, 3)) * np.sqrt(kt / STIFFNESS)
    v = rng.normal(size=(400, 3, 3)) * np.sqrt(kt / MASSES)[:, None]
    frames = TrainingFrames(scene, quantise(x), np.array([0, 400]), LAG_PS, False, {}, (), v.astype(np.float32))
    model = ExactSprings(scene, **settings)
    return compare_integrator(model, frames, energy, nve=model, starts=24, chunks=20)


def test_an_exact_integrator_does_not_drift_and_samples_what_it_should(springs: Scene) -> None:
    report = evaluated(springs)
    assert abs(report.drift) < 1e-3
    assert report.spread < 1e-3
    assert report.finite == 1.0
    assert report.bond_ratio == pytest.approx(1.0, abs=0.25)
    assert report.angle_ratio == pytest.approx(1.0, abs=0.25)
    assert report.reference_potential == pytest.approx(4.5 * 2.494, rel=0.15)
    assert report.potential == pytest.approx(report.reference_potential, rel=0.3)


def test_one_that_heats_is_seen_to_drift(springs: Scene) -> None:
    report = evaluated(springs, heating=1.05)
    assert report.drift > 10 * report.drift_error
    assert report.bond_ratio > 1.25
    assert report.potential > 1.5 * report.reference_potential
    lost = evaluated(springs, heating=float("nan"))
    assert lost.finite == 0.0
    assert np.isnan(lost.drift) and np.isnan(lost.bond_ratio)


def test_bonds_and_angles_are_those_of_the_scene(springs: Scene) -> None:
    x = springs.positions_nm[None]
    np.testing.assert_allclose(bonds(springs, x), [[0.15, 0.15]])
    np.testing.assert_allclose(angles(springs, x), [[np.pi / 2]])
