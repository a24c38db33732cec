"""`surrogate.Simulation`: OpenMM's and MDTraj's own reporters give our files; what is not there raises."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surrogate.models.weights import Weights
from surrogate.sampling.runner import RolloutConfig, rollout
from surrogate.sampling.simulation import Simulation
from systems.errors import InputError, OutOfDomainError, SimulationError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

N_FRAMES = 20  # two whole chunks of seven frames and a part


@pytest.fixture(scope="module")
def ours(tmp_path_factory: pytest.TempPathFactory, small_weights: Weights, alanine_dipeptide: Scene) -> np.ndarray:
    """Our own rollout, `(20, 22, 3)` nm."""
    out = tmp_path_factory.mktemp("ours") / "ours.h5"
    config = RolloutConfig(time_ps=float(N_FRAMES), seed=5, solver_steps=2, precision="fp32", guard="off")
    rollout(alanine_dipeptide, small_weights, [out], config)
    with open_trajectory(out) as reader:
        return reader.read()


@pytest.fixture
def simulation(small_weights: Weights, alanine_dipeptide: Scene) -> Simulation:
    return Simulation(alanine_dipeptide, small_weights, seed=5, solver_steps=2, precision="fp32")


def test_openmm_and_mdtraj_reporters_write_our_frames(
    tmp_path: Path, simulation: Simulation, ours: np.ndarray, alanine_dipeptide: Scene
) -> None:
    import mdtraj
    from mdtraj.reporters import DCDReporter as MdtrajDCDReporter
    from mdtraj.reporters import HDF5Reporter
    from openmm import app

    log = io.StringIO()
    dcd, xtc, pdb, h5, subset = (str(tmp_path / n) for n in ("a.dcd", "a.xtc", "a.pdb", "a.h5", "b.dcd"))
    simulation.reporters += [
        app.DCDReporter(dcd, 1),
        app.XTCReporter(xtc, 4),
        app.PDBReporter(pdb, 10),
        app.StateDataReporter(log, 5, step=True, time=True, speed=True, elapsedTime=True, progress=True,
                              remainingTime=True, totalSteps=N_FRAMES),
        HDF5Reporter(h5, 2, cell=False, potentialEnergy=False, kineticEnergy=False, temperature=False),
        MdtrajDCDReporter(subset, 3, atomSubset=[0, 4, 6]),
    ]  # fmt: skip
    simulation.step(13)
    simulation.step(7)
    assert simulation.currentStep == N_FRAMES
    for reporter in simulation.reporters[4:]:
        reporter.close()
    top = alanine_dipeptide.to_mdtraj_topology()
    # A DCD is in Å: two roundings of 6e-8.
    np.testing.assert_allclose(mdtraj.load(dcd, top=top).xyz, ours, rtol=1.2e-7, atol=0)
    written = mdtraj.load(h5)
    assert np.array_equal(written.xyz, ours[1::2]) and np.array_equal(written.time, np.arange(2, 21, 2))
    np.testing.assert_allclose(mdtraj.load(xtc, top=top).xyz, ours[3::4], rtol=0, atol=5.1e-4)
    np.testing.assert_allclose(mdtraj.load(pdb).xyz, ours[9::10], rtol=0, atol=5.1e-5)
    np.testing.assert_allclose(mdtraj.load(subset, top=top.subset([0, 4, 6])).xyz, ours[2::3][:, [0, 4, 6]], atol=2e-7)
    rows = [line.split(",") for line in log.getvalue().splitlines()[1:]]
    assert [float(row[2]) for row in rows] == [5.0, 10.0, 15.0, 20.0]
    assert [int(row[1]) for row in rows] == [5, 10, 15, 20]


def test_our_own_dcd_holds_the_same_frames(
    tmp_path: Path, simulation: Simulation, small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    import mdtraj
    from openmm import app

    out = tmp_path / "ours.dcd"
    rollout(alanine_dipeptide, small_weights, [out],
            RolloutConfig(time_ps=float(N_FRAMES), seed=5, solver_steps=2, precision="fp32", guard="off"))  # fmt: skip
    simulation.reporters.append(app.DCDReporter(str(tmp_path / "theirs.dcd"), 1))
    simulation.step(N_FRAMES)
    simulation.reporters.clear()
    top = alanine_dipeptide.to_mdtraj_topology()
    ours, theirs = (mdtraj.load(str(tmp_path / f"{name}.dcd"), top=top) for name in ("ours", "theirs"))
    np.testing.assert_allclose(ours.xyz, theirs.xyz, rtol=1.2e-7, atol=0)
    assert ours.n_frames == theirs.n_frames == N_FRAMES


@pytest.mark.parametrize("column", ["kineticEnergy", "totalEnergy", "temperature", "potentialEnergy", "volume",
                                    "density"])  # fmt: skip
def test_columns_that_do_not_exist_raise(simulation: Simulation, column: str) -> None:
    from openmm import app

    simulation.reporters.append(app.StateDataReporter(io.StringIO(), 1, **{column: True}))
    with pytest.raises(SimulationError, match="surrogate has no"):
        simulation.step(1)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_mdtraj_reporters_write_that_there_is_no_cell(
    tmp_path: Path, simulation: Simulation, ours: np.ndarray, alanine_dipeptide: Scene
) -> None:
    import mdtraj
    from mdtraj.reporters import DCDReporter, XTCReporter

    simulation.reporters += [DCDReporter(str(tmp_path / "a.dcd"), 2), XTCReporter(str(tmp_path / "a.xtc"), 2)]
    simulation.step(8)
    for name, reporter in zip(("a.dcd", "a.xtc"), simulation.reporters, strict=True):
        reporter.close()
        written = mdtraj.load(str(tmp_path / name), top=alanine_dipeptide.to_mdtraj_topology())
        assert written.unitcell_lengths is None
        np.testing.assert_allclose(written.xyz, ours[1:8:2], rtol=0, atol=5.1e-4)


def test_states_hold_what_was_asked_for(simulation: Simulation, alanine_dipeptide: Scene, ours: np.ndarray) -> None:
    from openmm import unit

    simulation.step(3)
    state = simulation.context.getState(positions=True)
    assert np.array_equal(state.getPositions(asNumpy=True).value_in_unit(unit.nanometer), ours[2])
    assert state.getPositions()[4].x == pytest.approx(float(ours[2, 4, 0]))
    assert state.getTime() == 3.0 * unit.picoseconds and state.getStepCount() == 3
    assert simulation.context.getState(getPositions=True).positions_nm.shape == (22, 3)
    assert simulation.context.getSystem().getNumParticles() == 22
    assert simulation.context.getIntegrator().getStepSize() == 1.0 * unit.picoseconds
    for getter in ("getVelocities", "getForces", "getKineticEnergy", "getPeriodicBoxVolume"):
        with pytest.raises(SimulationError, match="has no"):
            getattr(simulation.context.getState(positions=True, velocities=True, forces=True, energy=True), getter)()
    with pytest.raises(SimulationError, match="no energy to minimise"):
        simulation.minimizeEnergy()


@pytest.mark.parametrize("where", ["path", "file"])
def test_a_checkpoint_continues_bit_for_bit(
    tmp_path: Path, simulation: Simulation, small_weights: Weights, alanine_dipeptide: Scene, where: str
) -> None:
    simulation.step(10)  # within the second chunk
    target: Any = tmp_path / "state.chk" if where == "path" else io.BytesIO()
    simulation.saveCheckpoint(target)
    simulation.step(9)
    expected = simulation.positions_nm
    other = Simulation(alanine_dipeptide, small_weights, seed=5, solver_steps=2, precision="fp32")
    if where == "file":
        target.seek(0)
    other.loadCheckpoint(target)
    assert other.currentStep == 10
    other.step(9)
    assert np.array_equal(other.positions_nm, expected)
    assert not np.array_equal(expected, simulation.scene.positions_nm)


def test_openmm_checkpoint_reporter(tmp_path: Path, simulation: Simulation) -> None:
    from openmm import app

    path = str(tmp_path / "last.chk")
    simulation.reporters.append(app.CheckpointReporter(path, 6))
    simulation.step(8)
    at_eight = simulation.positions_nm
    simulation.loadCheckpoint(path)
    assert simulation.currentStep == 6
    simulation.step(2)
    assert np.array_equal(simulation.positions_nm, at_eight)


def test_foreign_and_damaged_checkpoints_are_refused(
    tmp_path: Path, simulation: Simulation, small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    path = tmp_path / "state.chk"
    simulation.step(4)
    simulation.saveCheckpoint(path)
    other = Simulation(alanine_dipeptide, small_weights, seed=6, solver_steps=2, precision="fp32")
    with pytest.raises(InputError, match="saved with seed = 5, not seed = 6"):
        other.loadCheckpoint(path)
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"not a zip", data[:200] + bytes(8) + data[208:]):
        path.write_bytes(broken)
        with pytest.raises(InputError, match="cannot be read as a checkpoint"):
            simulation.loadCheckpoint(path)
    assert simulation.currentStep == 4


def test_positions_can_be_set_and_other_molecules_are_refused(
    simulation: Simulation, small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    from openmm import unit

    moved = alanine_dipeptide.positions_nm + np.array([1.0, 0.0, 0.0])
    simulation.step(2)
    simulation.context.setPositions(moved * 10.0 * unit.angstrom)
    np.testing.assert_allclose(simulation.positions_nm, moved, atol=1e-6)
    simulation.step(1)
    assert abs(float(simulation.positions_nm.mean(axis=0)[0]) - float(moved.mean(axis=0)[0])) < 0.1
    with pytest.raises(InputError, match="22 x 3"):
        simulation.context.setPositions(moved[:5])
    with pytest.raises(OutOfDomainError, match="mirror image"):
        simulation.context.setPositions(moved * [-1.0, 1.0, 1.0])
    mirrored = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * [-1.0, 1.0, 1.0])
    with pytest.raises(OutOfDomainError, match="mirror image"):
        Simulation(mirrored, small_weights)
    strained = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * 1.6)
    assert [d.what for d in Simulation(strained, small_weights, force=True).deviations] == ["start"]


def test_names_do_as_well_as_objects(alanine_dipeptide: Scene) -> None:
    import surrogate

    simulation = surrogate.Simulation("alanine-dipeptide", "alanine-dipeptide", solver_steps=1)
    simulation.step(1)
    assert simulation.weights.path.name == "alanine-dipeptide.safetensors"
    assert simulation.positions_nm.shape == alanine_dipeptide.positions_nm.shape
