"""SIMD replicas in explicit water: OpenMM's forces and steps, rigid waters, waters that trade places, resuming."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mdtraj
import numpy as np
import openmm
import pytest

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import MDConfig
from md_reference.run.replicas import simulate_batch
from md_reference.simd import force_field
from md_reference.simd.force_field import SimdReplicas
from md_reference.simd.system_terms import SimdUnavailableError, _within_solute
from systems.errors import InputError, SimulationError, UnknownNameError
from systems.library.named_scenes import prepare
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
TIP3P = ForceFieldSpec("auto", "tip3p")
# Of the root mean square force: single precision leaves 1e-5.
FORCES, ENERGY_KJ_MOL = 5e-5, 0.05


@cache
def wet(name: str, ionic_strength_molar: float = 0.0, padding_nm: float = 1.0) -> tuple[Scene, Any]:
    dry = prepare(name)
    box = WaterBox(padding_nm=padding_nm, ionic_strength_molar=ionic_strength_molar)
    scene = solvate(dry, resolve(dry, TIP3P), box, seed=2)
    return scene, build_system(scene, TIP3P)


def test_exceptions_between_waters_are_refused() -> None:
    force, row = openmm.NonbondedForce(), np.ones(8)
    force.addException(4, 5, 0.0, 1.0, 0.0)  # the last of one water and the first of the next, after two other atoms
    with pytest.raises(SimdUnavailableError, match="exceptions between molecules of water"):
        _within_solute(force, np.arange(8), row, row, row, 2, row)


def replicas(system: Any, **how: Any) -> SimdReplicas:
    settings = {"temperature_k": 300.0, "friction_per_ps": 1.0, "timestep_ps": 0.002, "seed": 3}
    return SimdReplicas(system, **{**settings, **how})


@cache
def relaxed(name: str, ionic_strength_molar: float = 0.0, padding_nm: float = 1.0) -> FloatArray:
    """Positions of a scene after some steps of OpenMM."""
    scene, system = wet(name, ionic_strength_molar, padding_nm)
    integrator = openmm.LangevinMiddleIntegrator(300.0, 10.0, 0.002)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("CPU"), {"Threads": "1"})
    context.setPositions(scene.positions_nm)
    openmm.LocalEnergyMinimizer.minimize(context, maxIterations=50)
    context.setVelocitiesToTemperature(300.0, 1)
    integrator.step(100)
    return np.asarray(context.getState(positions=True).getPositions(asNumpy=True)._value)


def started(name: str, **how: Any) -> SimdReplicas:
    run = replicas(wet(name)[1], **how)
    run.set_positions(np.repeat(relaxed(name)[None], run.n_replicas, axis=0))
    run.thermalise()
    return run


def by_openmm(system: Any, positions_nm: FloatArray, platform: str = "Reference") -> tuple[float, FloatArray]:
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform(platform))
    context.setPositions(positions_nm.astype(np.float32))
    state = context.getState(energy=True, forces=True)
    return state.getPotentialEnergy()._value, state.getForces(asNumpy=True)._value


def off_openmm(system: Any, positions_nm: FloatArray, platform: str = "Reference") -> tuple[float, float]:
    """Return how far forces (relative root mean square) and energy (kJ/mol) are off; another replica elsewhere."""
    run = replicas(system)
    given = np.repeat(positions_nm[None], run.n_replicas, axis=0)
    given[1:] += 0.37
    energies, forces = run.energies_and_forces(given)
    energy, exact = by_openmm(system, given[1], platform)
    size = np.sqrt(np.mean(exact**2))
    return float(np.sqrt(np.mean((forces[1] - exact) ** 2)) / size), abs(float(energies[1]) - energy)


@pytest.mark.parametrize(
    "name, molar",
    [("alanine-dipeptide", 0.0), ("sequence:ACE-LYS-NME", 0.15), ("smiles:OCCO", 0.0), ("sequence:ALA-GLU-ALA", 0.0)],
)
def test_forces_and_energies_are_those_of_openmm(name: str, molar: float) -> None:
    forces, energy = off_openmm(wet(name, molar)[1], relaxed(name, molar))
    assert forces < FORCES and energy < ENERGY_KJ_MOL


@pytest.mark.parametrize("width", [8, 4])
def test_narrower_registers(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs with AVX2, and with NEON or SSE but for their estimate of a root."""
    if force_field.n_replicas() <= width:
        pytest.skip("the registers of this processor are no wider")
    program = force_field._program.__wrapped__(width)
    monkeypatch.setattr(force_field, "_program", lambda: program)
    run = started("alanine-dipeptide", timestep_ps=0.004)
    assert run.n_replicas == width
    forces, energy = off_openmm(wet("alanine-dipeptide")[1], relaxed("alanine-dipeptide"))
    assert forces < FORCES and energy < ENERGY_KJ_MOL
    run.step(100)
    legs = np.linalg.norm(np.diff(run.positions_nm[:, 22:].reshape(width, -1, 3, 3)[:, :, :2], axis=2), axis=-1)
    np.testing.assert_allclose(legs, 0.09572, atol=2e-6)


def test_a_slanted_cell_and_a_grid_of_other_factors() -> None:
    slanted = ("sequence:ALA-GLU", 0.0, 1.9)
    scene, system = wet(*slanted)
    assert scene.cell_nm is not None and scene.cell_nm[2, 0] > 0
    nonbonded = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    nonbonded.setPMEParameters(3.0, 28, 27, 21)
    # OpenMM 8.6's Reference platform leaves out pairs in slanted cells, its CPU platform does not.
    forces, energy = off_openmm(system, relaxed(*slanted), "CPU")
    nonbonded.setPMEParameters(0, 0, 0, 0)
    assert forces < FORCES and energy < ENERGY_KJ_MOL


def test_a_reaction_field_is_openmms() -> None:
    system = build_system(wet("alanine-dipeptide")[0], TIP3P)
    nonbonded = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    nonbonded.setNonbondedMethod(nonbonded.CutoffPeriodic)
    forces, energy = off_openmm(system, relaxed("alanine-dipeptide"))
    assert forces < FORCES and energy < ENERGY_KJ_MOL


def _wrong_sign(force: Any) -> None:
    charge, sigma, epsilon = force.getParticleParameters(5)
    force.setParticleParameters(5, -charge, sigma, epsilon)


def _missing_exclusion(force: Any) -> None:
    a, b, _, sigma, epsilon = force.getExceptionParameters(0)
    force.setExceptionParameters(0, a, b, 0.1, sigma, epsilon)


def _other_cutoff(force: Any) -> None:
    force.setCutoffDistance(0.75)


def _other_alpha(force: Any) -> None:
    force.setPMEParameters(2.6, 20, 20, 20)


@pytest.mark.parametrize("change", [None, _wrong_sign, _missing_exclusion, _other_cutoff, _other_alpha, "cell"])
def test_what_differs_from_openmm_is_noticed(change: Callable[[Any], None] | str | None) -> None:
    scene, system = wet("alanine-dipeptide")
    other = build_system(scene, TIP3P)
    if change == "cell":
        other.setDefaultPeriodicBoxVectors(*(row * 1.01 for row in np.asarray(scene.cell_nm)))
    elif callable(change):
        change(next(f for f in other.getForces() if isinstance(f, openmm.NonbondedForce)))
    run = replicas(system)
    if change is None:
        run.check(other, relaxed("alanine-dipeptide"))
    else:
        with pytest.raises(SimulationError, match="differs from OpenMM"):
            run.check(other, relaxed("alanine-dipeptide"))


def test_steps_without_a_bath_are_those_of_openmm() -> None:
    """Leapfrog of both from the same velocities: SHAKE and SETTLE. Only here velocities are projected before a move."""
    _, system = wet("alanine-dipeptide")
    run = started("alanine-dipeptide", friction_per_ps=0.0)
    integrator = openmm.VerletIntegrator(0.002)
    integrator.setConstraintTolerance(1e-8)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions(run.positions_nm[0])
    context.setVelocities(run.velocities_nm_ps[0])
    context.applyVelocityConstraints(1e-8)
    run.step(10)
    integrator.step(10)
    theirs = context.getState(positions=True).getPositions(asNumpy=True)._value
    assert np.abs(run.positions_nm[0] - theirs).max() < 2e-5
    assert np.abs(run.positions_nm[0] - relaxed("alanine-dipeptide")).max() > 5e-3


def test_waters_without_forces_turn_for_ever() -> None:
    """Rounding in SETTLE had changed the kinetic energy by 2e-8 in each step, always the same way."""
    system = build_system(wet("alanine-dipeptide")[0], TIP3P)
    force = next(f for f in system.getForces() if isinstance(f, openmm.NonbondedForce))
    force.setNonbondedMethod(force.CutoffPeriodic)
    force.setCutoffDistance(0.3)
    for k in range(22, force.getNumParticles()):
        force.setParticleParameters(k, 0.0, 0.3, 0.0)
    run = replicas(system, friction_per_ps=0.0)
    run.set_positions(np.repeat(relaxed("alanine-dipeptide")[None], run.n_replicas, axis=0))
    run.thermalise()
    run.step(500)
    before = run.temperatures_of_solute_and_water_k()[1]
    run.step(6000)
    changes = run.temperatures_of_solute_and_water_k()[1] / before - 1.0
    # Velocities lie half a step beside positions, where rotation has 5e-4 more, by 1e-5 more or less in each replica.
    assert abs(changes.mean()) < 3e-5


def test_waters_stay_rigid_and_warm() -> None:
    run = started("alanine-dipeptide", timestep_ps=0.004, friction_per_ps=10.0)
    run.step(500)
    temperatures = []
    for _ in range(8):
        run.step(50)
        temperatures.append(np.concatenate([t[:, None] for t in run.temperatures_of_solute_and_water_k()], axis=1))
    water = run.positions_nm[:, 22:].reshape(run.n_replicas, -1, 3, 3)
    legs = np.linalg.norm(water[:, :, [1, 2, 2]] - water[:, :, [0, 0, 1]], axis=-1)
    np.testing.assert_allclose(legs, np.broadcast_to([0.09572, 0.09572, 0.15139], legs.shape), atol=2e-6)
    solute, wet_k = np.mean(temperatures, axis=(0, 1))
    # 16 x 8 samples, every 0.2 ps at 10/ps: of the solute's 54 degrees of freedom 3 K, of the water's 0.5 K.
    assert abs(solute - 300.0) < 15.0 and abs(wet_k - 300.0) < 5.0


@pytest.mark.slow
def test_waters_trade_places_without_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each water's path is continuous under its name; places stay nearer to their sites than without trading."""

    def off_sites(run: SimdReplicas) -> float:
        middles = run._positions[22:].reshape(-1, 3, 3, run.n_replicas)[:, 1:].mean(axis=1)
        away = np.moveaxis(middles - run._sites[:, :, None], -1, 0) @ np.linalg.inv(np.asarray(run.cell_nm))
        return float(np.linalg.norm((away - np.round(away)) @ np.asarray(run.cell_nm), axis=-1).mean())

    found = []
    for reach in (0.45, 0.0):
        monkeypatch.setattr(force_field, "_TRADED_NM", reach)
        run = started("alanine-dipeptide", timestep_ps=0.004)
        before = run.positions_nm
        for _ in range(40):
            run.step(40)
            now = run.positions_nm
            assert np.abs(now - before).max() < 0.4  # 160 fs; a cell is 2.15 nm wide
            before = now
        found.append(off_sites(run))
        assert (np.sort(run._names, axis=0) == np.arange(len(run._names))[:, None]).all()
        assert (run._names != np.arange(len(run._names))[:, None]).any() == (reach > 0)
        energies, forces = run.energies_and_forces(before)
        np.testing.assert_allclose(energies, run.energies(), atol=0.1)
        assert np.isfinite(forces).all()
    assert found[0] < 0.8 * found[1]


def test_it_goes_on_as_if_nothing_had_been() -> None:
    run = started("alanine-dipeptide", timestep_ps=0.004)
    run.step(500)
    blob = run.checkpoint()
    run.step(500)
    other = replicas(wet("alanine-dipeptide")[1], timestep_ps=0.004, seed=9)
    other.restore(blob)
    other.step(500)
    np.testing.assert_array_equal(run.positions_nm, other.positions_nm)
    np.testing.assert_array_equal(run.velocities_nm_ps, other.velocities_nm_ps)
    with pytest.raises(InputError, match="another molecule"):
        other.restore(blob[:-4])


def test_what_it_does_not_know_is_refused() -> None:
    scene, _ = wet("alanine-dipeptide")
    narrow = replace(scene, cell_nm=np.asarray(scene.cell_nm) * 0.97)
    with pytest.raises(SimdUnavailableError, match=r"at least 2\.103 nm"):
        replicas(build_system(narrow, TIP3P))
    opc = ForceFieldSpec("ff14SB", "opc")
    with pytest.raises(SimdUnavailableError, match="virtual sites"):
        replicas(build_system(solvate(prepare("alanine-dipeptide"), opc, WaterBox()), opc))
    charmm = ForceFieldSpec("charmm36", "tip3p")
    with pytest.raises(SimdUnavailableError, match="does not support"):
        replicas(build_system(solvate(prepare("alanine-dipeptide"), charmm, WaterBox()), charmm))


@pytest.mark.parametrize("keep", ["auto", "all"])
def test_files_hold_the_solute_whole_or_everything(tmp_path: Path, keep: str) -> None:
    scene, _ = wet("alanine-dipeptide")
    config = MDConfig(force=TIP3P, time_ps=0.4, save_every_ps=0.2, equilibrate_ps=0.2, platform="simd", keep=keep)
    outs = [tmp_path / f"r{k}.h5" for k in range(2)]
    simulate_batch(scene, config, outs, starts_nm=relaxed("alanine-dipeptide")[None])
    frames = mdtraj.load(outs[1])
    n = 22 if keep == "auto" else scene.n_atoms
    assert frames.xyz.shape == (2, n, 3)
    np.testing.assert_allclose(frames.unitcell_vectors, np.repeat(np.asarray(scene.cell_nm)[None], 2, 0), rtol=1e-6)
    lengths = np.linalg.norm(frames.xyz[:, scene.bonds[:21, 0]] - frames.xyz[:, scene.bonds[:21, 1]], axis=-1)
    assert lengths.max() < 0.17
    with open_trajectory(outs[0]) as reader:
        assert reader.record["completed"] and reader.scene.n_atoms == n
        assert abs(reader.record["summary"]["temperature_k"]["mean"] - 300) < 40
    with pytest.raises(UnknownNameError, match="auto, solute, all"):
        simulate_batch(scene, replace(config, keep="water"), [tmp_path / "no.h5"])
