"""One reference run: frames and times, kills and resumes, blow-ups, full disks, refusals."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chain_files import SUFFIXES, TOLERANCES
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.engine import Engine, refuse_damaged
from md_reference.run.simulate import MDConfig, checkpoint_path, simulate
from systems.chemistry.validity import BOND_HALF_ANGSTROM, CHIRALITY, CLASH, check_frames, geometry_from_scene
from systems.errors import (
    InputError,
    PreparationError,
    SimulationError,
    StorageError,
    TrajectoryError,
    UnitError,
    UnknownNameError,
)
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.checkpoint import read_checkpoint
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import topology_bytes

SHORT = MDConfig(time_ps=4.0, save_every_ps=0.2, equilibrate_ps=0.4, seed=7, platform="Reference")
# About a second of work on a fast core: long enough to be killed three times on the way.
LONG = replace(SHORT, time_ps=240.0, save_every_ps=0.4)
TO_BE_KILLED = """
import os, signal, sys, threading
sys.path.insert(0, {repository!r})
from md_reference.run.simulate import MDConfig, simulate
from systems.library.named_scenes import load

def kill_soon(done, total, note=None):
    global timer
    if timer is None and note is None:
        timer = threading.Timer({delay_s}, os.kill, (os.getpid(), signal.SIGKILL))
        timer.start()

timer = None
config = MDConfig(time_ps=240.0, save_every_ps=0.4, equilibrate_ps=0.4, seed=7, platform="Reference")
simulate(load("alanine-dipeptide"), config, {out!r}, resume=True, progress=kill_soon)
"""


def clashing() -> Scene:
    """Four alanines whose backbone is turned until the chain's ends stand in each other."""
    scene = prepare("sequence:ACE-ALA-ALA-ALA-ALA-NME")
    neighbours: dict[int, set[int]] = {i: set() for i in range(scene.n_atoms)}
    for i, j in scene.bonds.tolist():
        neighbours[i].add(j)
        neighbours[j].add(i)
    turned = ({"N", "CA"}, {"CA", "C"})
    backbone = [(i, j) for i, j in scene.bonds.tolist() if {scene.atom_names[i], scene.atom_names[j]} in turned]
    x = scene.positions_nm.copy()
    for (i, j), angle in zip(backbone, (1.33, 1.22, 1.84, -2.29, -0.72, -2.1, -0.24, -0.72), strict=True):
        behind, ends = {i, j}, [j]
        while ends:
            ends += [k for k in neighbours[ends.pop()] - behind if not behind.add(k)]  # type: ignore[func-returns-value]
        rows = sorted(behind - {i, j})
        turn = Rotation.from_rotvec(angle * (x[j] - x[i]) / np.linalg.norm(x[j] - x[i]))
        x[rows] = x[j] + turn.apply(x[rows] - x[j])
    return scene.with_positions(x)


def contents(path: Path) -> tuple[Any, Any, dict[str, Any]]:
    with open_trajectory(path) as reader:
        return reader.read(), reader.time_ps, dict(reader.record)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from systems.library.named_scenes import load

    return simulate(load("alanine-dipeptide"), LONG, tmp_path_factory.mktemp("whole") / "whole.h5")


def test_without_equilibration_the_run_begins_at_the_minimum(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    told: list[tuple[int, str]] = []

    def tell(done: int, total: int, note: str | None = None) -> None:
        if note is not None:
            told.append((done, note))

    config = replace(SHORT, equilibrate_ps=0.0)
    simulate(alanine_dipeptide, config, tmp_path / "a.h5", progress=tell)
    assert told == [(0, "minimising")]
    positions, times, record = contents(tmp_path / "a.h5")
    assert len(positions) == config.n_frames and times[0] == pytest.approx(config.save_every_ps)
    assert record["equilibrate_ps"] == 0.0


def test_a_stereocentre_that_minimising_turns_over_is_refused(
    alanine_dipeptide: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mirrored = alanine_dipeptide.positions_nm * [1.0, 1.0, -1.0]
    refuse_damaged(alanine_dipeptide, alanine_dipeptide.positions_nm + 0.001)
    refuse_damaged(alanine_dipeptide.with_positions(mirrored), mirrored)
    flat = alanine_dipeptide.with_positions(mirrored * [1.0, 1.0, 0.0])
    refuse_damaged(flat, mirrored)

    monkeypatch.setattr(Engine, "minimise", lambda engine, **_: engine.set_positions(mirrored))
    with pytest.raises(PreparationError, match="the stereocentre CA turns over") as caught:
        simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5")
    assert "\n" not in str(caught.value)


def test_clashing_atoms_are_minimised_and_said(tmp_path: Path) -> None:
    """φ and ψ that lay the acetyl carbon 0.72 Å beside a carbonyl oxygen: all bonds and stereocentres survive."""
    scene = clashing()
    (tmp_path / "in.pdb").write_bytes(topology_bytes(scene))
    read = prepare(tmp_path / "in.pdb")
    said = " ".join(read.provenance["repairs"])
    assert "ACE A1 C and ALA A5 O are 0.72 Å apart" in said and "energy minimisation must separate them" in said
    simulate(read, replace(SHORT, equilibrate_ps=1.0), tmp_path / "a.h5")
    frames = contents(tmp_path / "a.h5")[0]
    flags = check_frames(frames, geometry_from_scene(prepare("sequence:ACE-ALA-ALA-ALA-ALA-NME")))
    assert not (flags & (BOND_HALF_ANGSTROM | CHIRALITY)).any()
    assert not (check_frames(frames[-5:], geometry_from_scene(scene)) & CLASH).any()
    assert (check_frames(scene.positions_nm[None], geometry_from_scene(scene)) & CLASH).all()  # the check sees it


def test_a_bond_that_minimising_breaks_is_refused(
    alanine_dipeptide: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = alanine_dipeptide.positions_nm.copy()
    names = list(alanine_dipeptide.atom_names)
    ca, cb = names.index("CA"), names.index("CB")
    broken[cb : cb + 4] += 0.4 * (broken[cb] - broken[ca])  # the methyl group, 1.4 times as far
    refuse_damaged(alanine_dipeptide, alanine_dipeptide.positions_nm)
    refuse_damaged(alanine_dipeptide.with_positions(broken), broken)  # as the scene has it

    monkeypatch.setattr(Engine, "minimise", lambda engine, **_: engine.set_positions(broken))
    with pytest.raises(PreparationError, match=r"breaks the bond ALA 2 CA - ALA 2 CB \(2\.1") as caught:
        simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5")
    assert "\n" not in str(caught.value)


# ---- frames and times ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_frames_times_and_record(alanine_dipeptide: Scene, tmp_path: Path, suffix: str) -> None:
    out = simulate(alanine_dipeptide, SHORT, tmp_path / f"a{suffix}")
    positions, times, record = contents(out)
    assert positions.shape == (20, 22, 3)
    np.testing.assert_array_equal(times, (1 + np.arange(20)) * 0.2)
    assert np.isfinite(positions).all()
    assert (np.abs(np.diff(positions, axis=0)).max(axis=(1, 2)) > 1e-3).all()
    assert record["completed"] is True
    assert record["kind"] == "reference"
    expected = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0, "friction_per_ps": 1.0,
                "timestep_ps": 0.004, "hydrogen_mass_da": 3.0, "save_every_ps": 0.2, "seed": 7,
                "platform": "Reference"}  # fmt: skip
    assert {key: record[key] for key in expected} == expected
    assert record["cost"]["energy_evaluations"] == 1000
    assert not checkpoint_path(out).exists()


def test_time_is_exact_over_many_frames(uninterrupted: Path) -> None:
    _, times, _ = contents(uninterrupted)
    np.testing.assert_array_equal(times, (1 + np.arange(600)) * 0.4)


@pytest.mark.parametrize(("save_every_ps", "time_ps"), [(0.3, 4.0), (0.002, 4.0), (0.2, 4.1)])
def test_uneven_intervals_are_refused(
    alanine_dipeptide: Scene, tmp_path: Path, save_every_ps: float, time_ps: float
) -> None:
    config = replace(SHORT, save_every_ps=save_every_ps, time_ps=time_ps)
    with pytest.raises(UnitError, match="whole multiple"):
        simulate(alanine_dipeptide, config, tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_not_overwritten_unasked(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = simulate(alanine_dipeptide, replace(SHORT, time_ps=0.4), tmp_path / "a.h5")
    before = out.read_bytes()
    with pytest.raises(TrajectoryError):
        simulate(alanine_dipeptide, replace(SHORT, time_ps=0.4), out)
    assert out.read_bytes() == before
    simulate(alanine_dipeptide, SHORT, out, overwrite=True)
    assert contents(out)[0].shape[0] == 20


# ---- killed and resumed --------------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="sends SIGKILL")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_resume_after_kill_9_equals_an_uninterrupted_run(
    alanine_dipeptide: Scene, uninterrupted: Path, tmp_path: Path, repository: Path, suffix: str
) -> None:
    out = tmp_path / f"a{suffix}"
    reached = []
    for delay_s in (0.02, 0.2, 0.1):
        program = TO_BE_KILLED.format(repository=str(repository), out=str(out), delay_s=delay_s)
        killed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed.stderr
        assert checkpoint_path(out).exists()
        header = {"n_frames": read_checkpoint(checkpoint_path(out))[0]["files"][0]["n_frames"]}
        with open_trajectory(out) as reader:
            assert header["n_frames"] <= reader.n_frames < 600
            assert reader.record["completed"] is False
        reached.append(header["n_frames"])
    assert reached == sorted(reached)
    assert reached[-1] > 0
    simulate(alanine_dipeptide, LONG, out, resume=True)
    positions, times, record = contents(out)
    whole, whole_times, _ = contents(uninterrupted)
    np.testing.assert_array_equal(times, whole_times)
    # A DCD holds Å in single precision, an XTC three decimals; rounding is all that may differ.
    rtol, atol = TOLERANCES[suffix]
    np.testing.assert_allclose(positions, whole, rtol=rtol, atol=atol)
    assert record["completed"] is True
    assert record["cost"]["energy_evaluations"] == 60_000
    assert not checkpoint_path(out).exists()
    # Negative control: another random stream would not have come to the same frames.
    other = simulate(alanine_dipeptide, replace(LONG, seed=8, time_ps=4.0), tmp_path / "other.h5")
    assert np.abs(contents(other)[0][-1] - whole[9]).max() > 0.01


def interrupted(scene: Scene, out: Path, config: MDConfig = SHORT, *, at_frame: int = 5) -> Path:
    """A run that stopped after some frames, its checkpoint beside it."""

    def stop(done: int, total: int, note: str | None = None) -> None:
        if done >= at_frame and note is None:
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        simulate(scene, config, out, progress=stop)
    assert checkpoint_path(out).exists()
    return out


def test_resuming_a_complete_run_changes_nothing(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5")
    before = out.read_bytes()
    assert simulate(alanine_dipeptide, SHORT, out, resume=True) == out
    assert out.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"temperature_k": 310.0}, "temperature_k"),
        ({"friction_per_ps": 2.0}, "friction_per_ps"),
        ({"timestep_ps": 0.002}, "timestep_ps"),
        ({"save_every_ps": 0.4}, "save_every_ps"),
        ({"seed": 8}, "seed"),
        ({"force": ForceFieldSpec("ff99SB-ILDN")}, "force_field"),
        ({"force": ForceFieldSpec(solvent="vacuum")}, "solvent"),
        ({"force": ForceFieldSpec(hydrogen_mass_da=2.0)}, "hydrogen_mass_da"),
    ],
)
@pytest.mark.parametrize("state", ["stopped", "complete"])
def test_other_settings_are_refused_on_resume(
    alanine_dipeptide: Scene, tmp_path: Path, change: dict[str, Any], said: str, state: str
) -> None:
    config, out = replace(SHORT, time_ps=2.0), tmp_path / "a.h5"
    if state == "stopped":
        interrupted(alanine_dipeptide, out, config, at_frame=3)
    else:
        simulate(alanine_dipeptide, config, out)
    before = out.read_bytes()
    with pytest.raises(InputError, match=f"was started with {said} =") as caught:
        simulate(alanine_dipeptide, replace(config, **change), out, resume=True)
    assert "\n" not in str(caught.value)
    assert out.read_bytes() == before


def test_a_stopped_run_may_become_longer(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = interrupted(alanine_dipeptide, tmp_path / "a.h5", replace(SHORT, time_ps=2.0))
    simulate(alanine_dipeptide, SHORT, out, resume=True)
    whole = simulate(alanine_dipeptide, SHORT, tmp_path / "whole.h5")
    np.testing.assert_array_equal(contents(out)[0], contents(whole)[0])
    assert contents(out)[2]["time_ps"] == SHORT.time_ps


def test_a_damaged_checkpoint_is_one_clear_line(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = interrupted(alanine_dipeptide, tmp_path / "a.h5")
    whole = checkpoint_path(out).read_bytes()
    for damaged in (b"", b"\x00\x01", b"[1]\n" + whole, whole[:60], whole[: len(whole) // 2], flipped(whole, 700)):
        checkpoint_path(out).write_bytes(damaged)
        with pytest.raises(InputError, match=r"cannot be read .*`overwrite|is none of this version's") as caught:
            simulate(alanine_dipeptide, SHORT, out, resume=True)
        assert "\n" not in str(caught.value)
    checkpoint_path(out).write_bytes(whole)
    simulate(alanine_dipeptide, SHORT, out, resume=True)


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def test_a_replaced_trajectory_is_refused(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    """Another run's file in its place, or its own, cut short or with another frame: none is gone on with."""
    out = interrupted(alanine_dipeptide, tmp_path / "a.h5")
    other = interrupted(alanine_dipeptide, tmp_path / "b.h5", replace(SHORT, seed=8), at_frame=8)
    mine, theirs = out.read_bytes(), other.read_bytes()
    before = checkpoint_path(out).read_bytes()
    with h5py.File(tmp_path / "a.h5") as file:
        frame = file["coordinates"].id.get_chunk_info(0).byte_offset
    for bad, said in ((theirs, "is not the file that this run wrote"), (flipped(mine, frame), "damaged at frame 0")):
        out.write_bytes(bad)
        with pytest.raises(InputError, match=said) as caught:
            simulate(alanine_dipeptide, SHORT, out, resume=True)
        assert "\n" not in str(caught.value)
        assert out.read_bytes() == bad and checkpoint_path(out).read_bytes() == before
    out.write_bytes(mine)
    with open_writer(out, alanine_dipeptide, {}, append=True) as writer:
        writer.truncate(1)
    with pytest.raises(InputError, match="holds 1 frames, its checkpoint has seen"):
        simulate(alanine_dipeptide, SHORT, out, resume=True)
    out.unlink()
    with pytest.raises(InputError, match="is not there to go on from"):
        simulate(alanine_dipeptide, SHORT, out, resume=True)
    out.write_bytes(mine)
    simulate(alanine_dipeptide, SHORT, out, resume=True)
    whole = simulate(alanine_dipeptide, SHORT, tmp_path / "whole.h5")
    np.testing.assert_array_equal(contents(out)[0], contents(whole)[0])


@pytest.mark.parametrize("state", ["stopped", "complete"])
def test_a_run_does_not_become_shorter(alanine_dipeptide: Scene, tmp_path: Path, state: str) -> None:
    out = tmp_path / "a.h5"
    if state == "stopped":
        interrupted(alanine_dipeptide, out)
    else:
        simulate(alanine_dipeptide, SHORT, out)
    before = out.read_bytes()
    with pytest.raises(InputError, match="was started for 4 ps and cannot become shorter"):
        simulate(alanine_dipeptide, replace(SHORT, time_ps=0.4), out, resume=True)
    assert out.read_bytes() == before


def test_a_users_own_file_is_not_taken_for_a_checkpoint(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    checkpoint_path(out).write_text("mine")
    for how in ({}, {"overwrite": True}, {"resume": True}):
        with pytest.raises(InputError, match="is none of this version's"):
            simulate(alanine_dipeptide, SHORT, out, **how)
    assert checkpoint_path(out).read_text() == "mine" and not out.exists()


def test_a_run_without_its_checkpoint_is_not_resumed_blindly(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = interrupted(alanine_dipeptide, tmp_path / "a.h5")
    checkpoint_path(out).unlink()
    with pytest.raises(InputError, match="its checkpoint is gone"):
        simulate(alanine_dipeptide, SHORT, out, resume=True)


def test_a_finished_run_is_not_made_longer(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    out = simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5")
    before = out.read_bytes()
    simulate(alanine_dipeptide, SHORT, out, resume=True)
    with pytest.raises(InputError, match=r"is a finished run of .* cannot be made longer.*under another name"):
        simulate(alanine_dipeptide, replace(SHORT, time_ps=2 * SHORT.time_ps), out, resume=True)
    assert out.read_bytes() == before


# ---- blow-ups ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
def test_a_blow_up_stops_with_the_good_frames_kept(alanine_dipeptide: Scene, tmp_path: Path, platform: str) -> None:
    # 6 fs is beyond the stability limit: the energy grows over about ten steps.
    config = MDConfig(
        time_ps=1.2, save_every_ps=0.006, timestep_ps=0.006, equilibrate_ps=0.006, seed=1, platform=platform
    )
    out = tmp_path / "a.h5"
    with pytest.raises(SimulationError) as caught:
        simulate(alanine_dipeptide, config, out)
    message = str(caught.value)
    assert "\n" not in message
    assert "6 fs" in message
    assert "good frames are in" in message
    with open_trajectory(out) as reader:
        assert 1 <= reader.n_frames < 100
        positions, temperature_k, record = reader.read(), reader.scalars["temperature_k"], reader.record
    assert record["completed"] is False
    assert record["failure"]
    assert np.isfinite(positions).all()
    assert temperature_k.max() < 1500.0
    lengths = np.linalg.norm(
        positions[:, alanine_dipeptide.bonds[:, 0]] - positions[:, alanine_dipeptide.bonds[:, 1]], axis=2
    )
    assert 0.05 < lengths.min() < lengths.max() < 0.25


def test_a_blow_up_before_the_first_frame_leaves_nothing(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    config = replace(SHORT, timestep_ps=0.02, save_every_ps=0.2)
    with pytest.raises(SimulationError, match="shorter `timestep_ps"):
        simulate(alanine_dipeptide, config, tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("atoms", [[5, 15], list(range(22))], ids=["two", "all"])
def test_atoms_on_top_of_each_other_are_one_clear_line(
    alanine_dipeptide: Scene, tmp_path: Path, atoms: list[int]
) -> None:
    positions = alanine_dipeptide.positions_nm.copy()
    positions[atoms] = positions[15]
    collapsed = alanine_dipeptide.with_positions(positions)
    with pytest.raises(SimulationError, match="on top of each other") as caught:
        simulate(collapsed, SHORT, tmp_path / "a.h5")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


# ---- a full disk, unknown names ------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_is_one_clear_line_and_resumable(
    alanine_dipeptide: Scene, tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, pwrite = tmp_path / f"a{suffix}", os.pwrite

    def small_disk(descriptor: int, data: Any, offset: int) -> int:
        if offset + len(data) > max(os.fstat(descriptor).st_size, 40_000 if suffix == ".h5" else 1_500):
            raise OSError(errno.ENOSPC, "No space left on device")
        return pwrite(descriptor, data, offset)

    config = replace(SHORT, time_ps=40.0)
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", small_disk)
        with pytest.raises(StorageError) as caught:
            simulate(alanine_dipeptide, config, out)
    assert "full" in str(caught.value)
    assert "\n" not in str(caught.value)
    kept = contents(out)[0].shape[0] if out.exists() else 0
    assert kept < 200
    simulate(alanine_dipeptide, config, out, resume=True)
    whole = simulate(alanine_dipeptide, config, tmp_path / "whole.h5")
    rtol, atol = TOLERANCES[suffix]
    np.testing.assert_allclose(contents(out)[0], contents(whole)[0], rtol=rtol, atol=atol)


def test_no_room_for_the_checkpoint_is_one_clear_line(
    alanine_dipeptide: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"disk .* is full") as caught:
        simulate(alanine_dipeptide, SHORT, tmp_path / "a.h5")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*.new"))


def test_an_unknown_platform_is_one_line_with_the_nearest(alanine_dipeptide: Scene, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'Reference'") as caught:
        simulate(alanine_dipeptide, replace(SHORT, platform="Referense"), tmp_path / "a.h5")
    assert "\n" not in str(caught.value)
    with pytest.raises(UnknownNameError, match="Did you mean 'simd'"):
        simulate(alanine_dipeptide, replace(SHORT, platform="smid"), tmp_path / "a.h5")
    with pytest.raises(InputError, match="for replicas of `reference` and `run`"):
        simulate(alanine_dipeptide, replace(SHORT, platform="simd"), tmp_path / "a.h5")
    assert not list(tmp_path.iterdir())
