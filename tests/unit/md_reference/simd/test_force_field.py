"""Molecular dynamics by SIMD replicas: OpenMM's forces, energy conserved, the bath's temperature, rigid bonds."""

from __future__ import annotations

import copy
import shutil
import subprocess
import sys
from typing import Any

import numpy as np
import openmm
import pytest

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.simd import force_field
from md_reference.simd.force_field import SimdReplicas
from md_reference.simd.system_terms import SimdUnavailableError
from systems.errors import SimulationError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene

pytestmark = pytest.mark.skipif(not (shutil.which("g++") or shutil.which("c++")), reason="no C++ compiler")


def _system(scene: Scene, solvent: str = "obc2", **how: Any) -> Any:
    return build_system(scene, ForceFieldSpec("ff14SB", solvent, **how))


def _replicas(system: Any, **how: Any) -> SimdReplicas:
    return SimdReplicas(
        system, **{"temperature_k": 300.0, "friction_per_ps": 1.0, "timestep_ps": 0.004, "seed": 3, **how}
    )


def _placed(scene: Scene, run: SimdReplicas) -> SimdReplicas:
    run.set_positions(np.repeat(scene.positions_nm[None], run.n_replicas, axis=0))
    run.thermalise()
    return run


@pytest.mark.parametrize("sequence", ["ACE-PRO-NME", "ARG-TRP", "ACE-CYS-NME"])
@pytest.mark.parametrize("solvent", ["obc2", "vacuum"])
def test_energies_and_forces_are_those_of_openmm(sequence: str, solvent: str) -> None:
    scene = build_peptide(sequence)
    system = _system(scene, solvent)
    _replicas(system).check(system, scene.positions_nm + 30.0)


@pytest.mark.parametrize("kind", ["HarmonicAngleForce", "PeriodicTorsionForce", "NonbondedForce", "GBSAOBCForce"])
def test_a_changed_term_is_noticed(kind: str) -> None:
    scene = build_peptide("ACE-SER-NME")
    system = _system(scene)
    run = _replicas(system)
    other = copy.deepcopy(system)
    force = next(f for f in other.getForces() if type(f).__name__ == kind)
    if kind == "HarmonicAngleForce":
        *atoms, angle, stiff = force.getAngleParameters(3)
        force.setAngleParameters(3, *atoms, angle * 1.01, stiff)
    elif kind == "PeriodicTorsionForce":
        *atoms, period, phase, stiff = force.getTorsionParameters(0)
        force.setTorsionParameters(0, *atoms, period, phase, stiff + 0.5 * stiff.unit)
    else:
        charge, *rest = force.getParticleParameters(4)
        force.setParticleParameters(4, charge + 0.01 * charge.unit, *rest)
    run.check(system, scene.positions_nm)
    with pytest.raises(SimulationError, match="differs from OpenMM"):
        run.check(other, scene.positions_nm)


def test_energy_is_conserved_without_a_bath() -> None:
    scene = build_peptide("ACE-ALA-NME")
    system = _system(scene)
    warm = _placed(scene, _replicas(system))
    warm.step(500)
    totals = {}
    for timestep_ps in (0.0005, 0.001):
        run = _replicas(system, friction_per_ps=0.0, timestep_ps=timestep_ps)
        run.set_positions(warm.positions_nm)
        run.set_velocities(warm.velocities_nm_ps)
        series = []
        for _ in range(100):
            # Velocities lie half a step before positions, so the mean of two neighbours is theirs.
            before = run.temperatures_k()
            potential = run.energies()
            run.step(1)
            kinetic = 0.5 * (before + run.temperatures_k()) * 0.5 * run.n_dof * force_field.GAS_CONSTANT_KJ_MOL_K
            series.append(potential + kinetic)
            run.step(round(0.01 / timestep_ps) - 1)
        totals[timestep_ps] = np.stack(series)
    # Of some 70 kJ/mol in motion. A replica's energy follows the shape of the molecule by the square of the step (0.04
    # kJ/mol, 0.12 where a torsion turns), the mean of sixteen does not; it scatters as the square of the step.
    drift = totals[0.0005][-20:].mean(0) - totals[0.0005][:20].mean(0)
    assert abs(drift.mean()) < 0.03
    assert 3.0 < np.mean(totals[0.001].std(0) / totals[0.0005].std(0)) < 5.0


def test_the_bath_has_its_temperature_and_bonds_stay_rigid() -> None:
    scene = build_peptide("ACE-ALA-NME")
    system = _system(scene)
    run = _placed(scene, _replicas(system, friction_per_ps=10.0))
    run.step(1000)
    found = []
    for _ in range(150):
        run.step(100)
        found.append(run.temperatures_k())
    # 150 x 16 nearly independent samples of 54 degrees of freedom: 300 ± 1.2 K.
    assert abs(np.mean(found) - 300.0) < 5.0
    assert np.std(found) == pytest.approx(300.0 * np.sqrt(2 / run.n_dof), rel=0.1)
    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        bonds = np.linalg.norm(run.positions_nm[:, i] - run.positions_nm[:, j], axis=-1)
        assert np.abs(bonds - length._value).max() < 2e-5 * length._value
    # Every replica goes its own way.
    assert np.unique(run.positions_nm[:, 0, 0]).size == run.n_replicas


def test_the_mean_energy_is_that_of_openmm() -> None:
    scene = build_peptide("ACE-GLY-NME")
    system = _system(scene)
    run = _placed(scene, _replicas(system))
    run.step(5000)
    found = []
    for _ in range(400):
        run.step(250)
        found.append(run.energies())
    integrator = openmm.LangevinMiddleIntegrator(300.0, 1.0, 0.004)
    integrator.setRandomNumberSeed(5)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions(scene.positions_nm)
    context.setVelocitiesToTemperature(300.0, 5)
    integrator.step(5000)
    theirs = []
    for _ in range(120):
        integrator.step(250)
        theirs.append(context.getState(energy=True).getPotentialEnergy()._value)
    # Of 400 x 16 and 120 frames; the energy forgets within some frames: error 1 kJ/mol, seen in blocks of 20.
    error = np.std(np.array(theirs).reshape(6, 20).mean(1)) / np.sqrt(6)
    assert abs(np.mean(found) - np.mean(theirs)) < 4 * error < 6.0
    assert np.std(found) == pytest.approx(np.std(theirs), rel=0.15)


def test_what_it_does_not_know_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = build_peptide("ACE-ALA-NME")
    system = _system(scene)
    system.addForce(openmm.CustomBondForce("r"))
    with pytest.raises(SimdUnavailableError, match="CustomBondForce"):
        _replicas(system)
    watery = build_system(build_peptide("ACE-ALA-NME"), ForceFieldSpec("ff14SB", "vacuum"))
    next(f for f in watery.getForces() if isinstance(f, openmm.NonbondedForce)).setNonbondedMethod(1)
    with pytest.raises(SimdUnavailableError, match="NonbondedForce with a cutoff but without a cell; use another"):
        _replicas(watery)
    monkeypatch.setattr("systems.files.native.shutil.which", lambda _: None)
    with pytest.raises(SimdUnavailableError, match="which platform simd needs"):
        force_field._program.__wrapped__()


def test_the_process_keeps_its_arithmetic() -> None:
    """A library linked with fast mathematics has every later calculation round the smallest numbers to zero. Asked in a
    process of its own, which nothing else has changed."""
    code = (
        "import numpy as np; from md_reference.simd.force_field import n_replicas; x = np.array([1e-310]);"
        "assert n_replicas() and x[0] / 10 > 0"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
