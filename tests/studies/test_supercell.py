"""Many cells side by side are the same System as one."""

from itertools import product

import numpy as np
import openmm
import pytest
from openmm import unit
from supercell import repeated

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from systems.scene import Scene


def energy_and_forces(system: openmm.System, x: np.ndarray) -> tuple[float, np.ndarray]:
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(x)
    state = context.getState(energy=True, forces=True)
    forces = state.getForces(asNumpy=True).value_in_unit(unit.kilojoule_per_mole / unit.nanometer)
    return state.getPotentialEnergy().value_in_unit(unit.kilojoule_per_mole), np.asarray(forces)


def test_eight_cells_have_eight_times_the_energy_and_each_the_forces_of_one(alanine_dipeptide: Scene) -> None:
    system = build_system(alanine_dipeptide, ForceFieldSpec("ff14SB", "vacuum"))
    edge = 2.4
    system.setDefaultPeriodicBoxVectors(*(edge * v for v in np.eye(3)))
    (nonbonded,) = [f for f in system.getForces() if f.getName() == "NonbondedForce"]
    nonbonded.setNonbondedMethod(openmm.NonbondedForce.PME)
    nonbonded.setCutoffDistance(0.9)
    nonbonded.setEwaldErrorTolerance(1e-6)
    x = alanine_dipeptide.positions_nm
    cells = edge * np.array(list(product(range(2), repeat=3)))
    many = repeated(system, 2)
    assert many.getNumParticles() == 8 * len(x) and many.getNumConstraints() == 8 * system.getNumConstraints()
    energy, forces = energy_and_forces(system, x)
    of_many, forces_of_many = energy_and_forces(many, (cells[:, None] + x).reshape(-1, 3))
    assert of_many == pytest.approx(8 * energy, abs=0.05)
    np.testing.assert_allclose(forces_of_many.reshape(8, -1, 3), np.broadcast_to(forces, (8, *forces.shape)), atol=0.2)
