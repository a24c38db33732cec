"""What a run stores and states: ensembles, velocities and forces, the summary; and what an interruption costs."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run import simulate as module
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import PlatformChoice
from md_reference.run.simulate import MDConfig, checkpoint_path, simulate
from systems.errors import InputError, SimulationError, TrajectoryError, UnknownNameError
from systems.scene import Scene
from systems.trajectory.checkpoint import read_checkpoint, write_checkpoint
from systems.trajectory.codec import open_trajectory, open_writer
from systems.units import GAS_CONSTANT_KJ_MOL_K

FLEXIBLE = ForceFieldSpec(solvent="vacuum", hydrogen_mass_da=None, constrain_hydrogens=False)
RIGID = ForceFieldSpec(solvent="vacuum", hydrogen_mass_da=None)
# Frames 1 fs apart: close enough to differentiate.
FINE = MDConfig(
    time_ps=0.02,
    save_every_ps=0.001,
    timestep_ps=0.0005,
    equilibrate_ps=0.2,
    seed=5,
    platform="Reference",
    force=FLEXIBLE,
    ensemble="nve",
    save_velocities=True,
    save_forces=True,
)
SHORT = MDConfig(time_ps=2.0, save_every_ps=0.2, equilibrate_ps=0.4, seed=7, platform="Reference", force=RIGID,
                 timestep_ps=0.002)  # fmt: skip


# ---- ensembles -----------------------------------------------------------------------------------------------------


def test_an_unknown_ensemble_is_refused_with_the_nearest(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'npt'"):
        simulate(alanine_dipeptide, replace(SHORT, ensemble="nptt"), tmp_path / "a.h5")
    with pytest.raises(InputError, match="no periodic cell"):
        simulate(alanine_dipeptide, replace(SHORT, ensemble="NPT"), tmp_path / "a.h5")
    with pytest.raises(InputError, match="nve is not available with OPC"):
        simulate(alanine_dipeptide, replace(FINE, force=ForceFieldSpec("ff19SB", "opc")), tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_velocities_and_forces_are_derivatives_of_what_is_stored(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = simulate(alanine_dipeptide, FINE, tmp_path / "a.h5")
    with open_trajectory(out) as reader:
        x, v, f = reader.read(), reader.read_velocities(), reader.read_forces()
        record, scalars = reader.record, reader.scalars
    assert v is not None and f is not None
    # Central differences over 2 fs: the error of the third derivative is some per cent for the stiffest bonds, and
    # float32 positions add 1e-7 nm / 2 fs.
    from_positions = (x[2:].astype(float) - x[:-2]) / 0.002
    assert np.linalg.norm(from_positions - v[1:-1]) / np.linalg.norm(v[1:-1]) < 0.05
    mass = np.array(alanine_dipeptide.masses_da)[:, None]
    from_velocities = mass * (v[2:].astype(float) - v[:-2]) / 0.002
    assert np.linalg.norm(from_velocities - f[1:-1]) / np.linalg.norm(f[1:-1]) < 0.1
    # The temperature is that of the stored velocities, and the centre of mass is at rest.
    kinetic = 0.5 * (mass * v.astype(float) ** 2).sum(axis=(1, 2))
    n_dof = record["summary"]["degrees_of_freedom"]
    assert n_dof == 3 * 22 - 3
    np.testing.assert_allclose(2 * kinetic / (n_dof * GAS_CONSTANT_KJ_MOL_K), scalars["temperature_k"], rtol=1e-4)
    assert np.abs((mass * v).sum(axis=1)).max() < 0.01  # of 19 in a bath; OpenMM's masses have other digits
    # Forces belong to these positions and this field: the energy along a displacement says so.
    with Engine(alanine_dipeptide, Conditions(force=FLEXIBLE, platform="Reference")) as engine:
        push = np.zeros((22, 3))
        push[4] = [1e-4, -2e-4, 1e-4]
        slope = (engine.energy(x[3] + push) - engine.energy(x[3] - push)) / 2
        assert slope == pytest.approx(-float((engine.forces(x[3]) * push).sum()), rel=1e-4)
        np.testing.assert_allclose(engine.forces(x[3]), f[3], atol=2.0)
    assert record["integrator"] == "VelocityVerlet"
    assert record["summary"]["temperature_k"]["target"] is None


def test_rigid_bonds_stay_rigid_without_a_bath(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    config = replace(FINE, force=RIGID, time_ps=0.2, save_every_ps=0.01, timestep_ps=0.001)
    with open_trajectory(simulate(alanine_dipeptide, config, tmp_path / "a.h5")) as reader:
        x, v = reader.read().astype(float), reader.read_velocities()
    assert v is not None
    symbols = np.array(alanine_dipeptide.elements)
    to_hydrogen = [(i, j) for i, j in alanine_dipeptide.bonds.tolist() if "H" in (symbols[i], symbols[j])]
    i, j = np.array(to_hydrogen).T
    lengths = np.linalg.norm(x[:, i] - x[:, j], axis=2)
    assert lengths.std(axis=0).max() < 1e-5
    along = ((x[:, i] - x[:, j]) * (v[:, i] - v[:, j])).sum(axis=2) / lengths
    assert np.abs(along).max() < 1e-4
    assert np.abs(v).max() > 0.1


@pytest.mark.slow
def test_constant_pressure_moves_the_walls(tmp_path: Path) -> None:
    from md_reference.forces.solvation import solvate
    from systems.library.named_scenes import load

    spec = ForceFieldSpec(solvent="tip3p", hydrogen_mass_da=None)
    scene = solvate(load("alanine-dipeptide"), spec, WaterBox(), seed=1)
    config = MDConfig(time_ps=0.8, save_every_ps=0.1, timestep_ps=0.002, equilibrate_ps=1.0, platform="CPU",
                      ensemble="npt", force=spec)  # fmt: skip
    with open_trajectory(simulate(scene, config, tmp_path / "a.h5")) as reader:
        cells, volumes, record = reader.read_cells(), reader.scalars["volume_nm3"], reader.record
    assert cells is not None
    np.testing.assert_allclose(np.linalg.det(cells), volumes, rtol=1e-12)
    assert len(set(volumes)) > 2
    assert record["summary"]["density_g_ml"]["mean"] == pytest.approx(1.0, abs=0.1)
    fixed = replace(config, ensemble="nvt", time_ps=0.2, equilibrate_ps=0.1)
    with open_trajectory(simulate(scene, fixed, tmp_path / "b.h5")) as reader:
        cells = reader.read_cells()
        assert "volume_nm3" not in reader.scalars
    np.testing.assert_allclose(cells, np.tile(scene.cell_nm, (2, 1, 1)), atol=1e-6)


# ---- the summary ---------------------------------------------------------------------------------------------------


def test_the_summary_is_that_of_the_frames(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    with open_trajectory(simulate(alanine_dipeptide, replace(SHORT, time_ps=4.0), tmp_path / "a.h5")) as reader:
        record, scalars = reader.record, reader.scalars
    summary = record["summary"]
    assert summary["n_frames"] == 20
    assert summary["temperature_k"]["mean"] == pytest.approx(scalars["temperature_k"].mean())
    assert summary["temperature_k"]["target"] == 300.0
    assert summary["potential_kj_mol"]["mean"] == pytest.approx(scalars["potential_kj_mol"].mean())
    independent = scalars["temperature_k"].std(ddof=1) / np.sqrt(20)
    assert independent * 0.999 <= summary["temperature_k"]["standard_error"] < 4 * independent
    assert "drift" not in summary


# ---- interruptions -------------------------------------------------------------------------------------------------


def frames(path: Path) -> Any:
    with open_trajectory(path) as reader:
        assert reader.record["completed"]
        return reader.read()


@contextmanager
def stop_after(n_questions: int) -> Iterator[Callable[[], bool]]:
    """Ask to stop from the n-th time on that a run looks."""
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > n_questions

    yield stop


@pytest.mark.parametrize("ensemble", ["nvt", "nve"])
@pytest.mark.parametrize(("n_questions", "stage"), [(3, "equilibration"), (655, "production")])
def test_a_run_stopped_anywhere_goes_on_as_if_nothing_had_happened(
    alanine_dipeptide: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ensemble: str,
    n_questions: int,
    stage: str,
) -> None:
    config = replace(SHORT, ensemble=ensemble, save_velocities=True)
    out = tmp_path / "a.h5"
    with monkeypatch.context() as patch:
        patch.setattr(module, "deferred_interrupt", lambda: stop_after(n_questions))
        patch.setattr(module, "_SIGNAL_S", 0.0)  # look after every few steps, so that the stop falls inside a frame
        with pytest.raises(KeyboardInterrupt):
            simulate(alanine_dipeptide, config, out)
    assert out.exists() == checkpoint_path(out).exists() == (stage == "production")
    if stage == "production":
        assert 0 < read_checkpoint(checkpoint_path(out))[0]["files"][0]["n_frames"] < 10
    simulate(alanine_dipeptide, config, out, resume=True)
    whole = simulate(alanine_dipeptide, config, tmp_path / "whole.h5")
    np.testing.assert_array_equal(frames(out), frames(whole))
    assert not checkpoint_path(out).exists()


def test_what_progress_has_reported_survives_a_kill(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    """A checkpoint stands behind every block."""
    reported: list[int] = []

    def look(done: int, _: int, note: str | None = None) -> None:
        if note is not None:
            return
        reported.append(read_checkpoint(checkpoint_path(tmp_path / "a.h5"))[0]["files"][0]["n_frames"])
        if done < 10:
            assert reported[-1] == done

    simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5", progress=look)
    assert len(reported) > 2


def stopped(scene: Scene, config: MDConfig, out: Path, **more: Any) -> Path:
    def stop(done: int, _: int, note: str | None = None) -> None:
        if done >= 4 and note is None:
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        simulate(scene, config, out, progress=stop, **more)
    return out


def test_a_resumed_run_keeps_its_platform(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    config = replace(SHORT, platform="auto", time_ps=4.0)
    out = stopped(alanine_dipeptide, config, tmp_path / "a.h5", choice=PlatformChoice("CPU", 1, "measured once"))
    simulate(alanine_dipeptide, config, out, resume=True)  # which by its size would choose Reference
    with open_trajectory(out) as reader:
        assert reader.record["platform"] == "CPU"
        assert reader.record["platform_reason"] == "measured once"
    # Negative control: on another platform the checkpoint is of no use.
    out = stopped(alanine_dipeptide, config, tmp_path / "b.h5", choice=PlatformChoice("CPU", 1, "measured once"))
    header, blob = read_checkpoint(checkpoint_path(out))
    write_checkpoint(checkpoint_path(out), header | {"platform": "Reference"}, blob)
    with pytest.raises(SimulationError, match="does not fit"):
        simulate(alanine_dipeptide, config, out, resume=True)


NEW_SETTINGS = ("ensemble", "pressure_bar", "save_velocities", "save_forces")


def age_record(out: Path) -> None:
    with h5py.File(out, "r+") as file:
        record = json.loads(file["surromd/record"][()])
        news = (*NEW_SETTINGS, "threads", "platform_reason", "_seal")
        old = {key: value for key, value in record.items() if key not in news}
        scene = json.loads(file["surromd/scene"][()])
        del scene["_seal"], file["surromd/checksums"], file["surromd/run_id"]
        file["surromd/scene"][()] = np.bytes_(json.dumps(scene).encode())
        file["surromd/record"][()] = np.bytes_(json.dumps(old).encode())


def test_a_complete_run_of_an_older_version_is_taken_for_one(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    whole = simulate(alanine_dipeptide, replace(SHORT, time_ps=4.0), tmp_path / "whole.h5")
    age_record(whole)
    before = whole.read_bytes()
    assert simulate(alanine_dipeptide, replace(SHORT, time_ps=4.0), whole, resume=True) == whole
    assert whole.read_bytes() == before
    checkpoint_path(whole).write_bytes(b'{"config": {}, "n_frames": 3}\n...')
    with pytest.raises(InputError, match="is none of this version's"):
        simulate(alanine_dipeptide, replace(SHORT, time_ps=8.0), whole, resume=True)
    with pytest.raises(TrajectoryError, match="was not written by surromd"):
        open_writer(whole, alanine_dipeptide, {}, append=True)
