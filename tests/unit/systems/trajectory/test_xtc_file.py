"""XTC files as they are written: what other programs read, cells, whose the record beside is, and what is refused."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import MDAnalysis
import mdtraj
import numpy as np
import pytest

from chain_files import RECORD, chain, frames, left_behind, read, write
from systems.errors import InputError, TrajectoryError
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.xtc_file import XtcReader

N_ATOMS = 22


def test_other_programs_read_positions_times_and_cells_in_a_folder_of_any_name(tmp_path: Path) -> None:
    folder = tmp_path / "Zürich 分子"
    folder.mkdir()
    cells = np.array([np.diag([3.0, 3.1, 3.2]), [[3.0, 0, 0], [0.5, 3.0, 0], [0.25, 0.75, 2.5]]])
    scene = replace(chain(N_ATOMS), cell_nm=cells[0])
    positions, path = frames(2, N_ATOMS), folder / "a.xtc"
    with open_writer(path, scene, RECORD) as writer:
        writer.append(positions[:1], [100.0])  # the scene's own cell
        writer.append(positions[1:], [102.5], cell_nm=cells[1:])
    assert left_behind(folder) == ["a.meta.h5", "a.pdb", "a.xtc"]
    with open_trajectory(path) as ours:
        assert isinstance(ours, XtcReader)
        np.testing.assert_allclose(ours.read_cells(), cells, atol=1e-6)
        np.testing.assert_allclose(ours.read_cells(1), cells[1:], atol=1e-6)
        np.testing.assert_array_equal(ours.time_ps, [100.0, 102.5])
    linked = tmp_path / "link"  # these libraries take ASCII
    linked.symlink_to(folder)
    seen = mdtraj.load(str(linked / "a.xtc"), top=str(linked / "a.pdb"))
    np.testing.assert_allclose(seen.xyz, positions, atol=5.1e-4)
    np.testing.assert_array_equal(seen.time, [100.0, 102.5])
    np.testing.assert_allclose(seen.unitcell_vectors, cells, atol=1e-6)
    universe = MDAnalysis.Universe(str(linked / "a.pdb"), str(linked / "a.xtc"))
    assert [frame.time for frame in universe.trajectory] == [100.0, 102.5]
    assert [frame.data["step"] for frame in universe.trajectory] == [25_000, 25_625]  # of 4 fs
    for k, frame in enumerate(universe.trajectory):
        np.testing.assert_allclose(frame.positions, 10 * positions[k], atol=5.1e-3)
        np.testing.assert_allclose(frame.triclinic_dimensions, 10 * cells[k], atol=1e-4)


def test_an_append_in_flight_is_cut_off_at_the_last_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.xtc"
    positions = write(path, 8, n_atoms=N_ATOMS)
    whole = path.read_bytes()
    for extra in (1, 50, 300):  # within a frame, and more than one
        path.write_bytes(whole + whole[:extra])
        np.testing.assert_allclose(read(path), positions, atol=5.1e-4)
        with open_writer(path, chain(N_ATOMS), {}, append=True) as writer:
            assert writer.n_frames == 8
        assert path.read_bytes() == whole
    with open_writer(path, chain(N_ATOMS), {}, append=True) as writer:
        writer.update_record({"completed": True})
    path.write_bytes(whole + whole[:300])
    with pytest.raises(TrajectoryError, match="records 8 frames"):
        open_trajectory(path)


def test_cut_and_continued_is_the_same_file_byte_for_byte(tmp_path: Path) -> None:
    positions = write(tmp_path / "a.xtc", 12, n_atoms=N_ATOMS)
    write(tmp_path / "b.xtc", 12, n_atoms=N_ATOMS)
    with open_writer(tmp_path / "b.xtc", chain(N_ATOMS), {}, append=True) as writer:
        writer.truncate(5)
        assert len(mdtraj.load(str(tmp_path / "b.xtc"), top=str(tmp_path / "b.pdb"))) == 5
        writer.append(positions[5:], np.arange(6.0, 13.0))
    assert (tmp_path / "a.xtc").read_bytes() == (tmp_path / "b.xtc").read_bytes()


def test_changed_bytes_never_pass_as_frames(tmp_path: Path) -> None:
    path = tmp_path / "a.xtc"
    write(path, 4, n_atoms=N_ATOMS)
    whole = bytearray(path.read_bytes())
    each = len(whole) // 4
    for at in (2 * each + 100, 2 * each + 150, 3 * each - 30):
        damaged = whole.copy()
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        with open_trajectory(path) as reader, pytest.raises(TrajectoryError, match=r"a\.xtc"):
            reader.read()


def test_frames_that_an_xtc_cannot_hold_are_refused(tmp_path: Path) -> None:
    for value in (np.nan, np.inf, 3e6):
        positions = frames(3, N_ATOMS)
        positions[1, 4, 2] = value
        path = tmp_path / "a.xtc"
        with (
            open_writer(path, chain(N_ATOMS), RECORD, overwrite=True) as writer,
            pytest.raises(InputError, match="frame 1 has positions"),
        ):
            writer.append(positions, [1.0, 2.0, 3.0])
        assert len(read(path)) == 0
    with pytest.raises(InputError, match="XTC files hold positions only"):
        open_writer(tmp_path / "b.xtc", chain(N_ATOMS), RECORD, columns=["velocities"])


def test_a_record_is_of_one_file(tmp_path: Path) -> None:
    """The same name with another suffix: a converted copy is read alone, and another run is refused."""
    positions = write(tmp_path / "a.dcd", 6, n_atoms=N_ATOMS)
    mdtraj.load(str(tmp_path / "a.dcd"), top=str(tmp_path / "a.pdb"))[:4].save_xtc(str(tmp_path / "a.xtc"))
    with open_trajectory(tmp_path / "a.xtc") as reader:
        assert (reader.n_frames, reader.record) == (4, {})
        assert reader.scene is not None  # by a.pdb
    with pytest.raises(TrajectoryError, match=r"is the record of a\.dcd"):
        write(tmp_path / "a.xtc", 6, n_atoms=N_ATOMS, overwrite=True)
    np.testing.assert_allclose(read(tmp_path / "a.dcd"), positions, rtol=3e-7)
    write(tmp_path / "b.xtc", 6, n_atoms=N_ATOMS)
    os.replace(tmp_path / "a.dcd", tmp_path / "b.dcd")
    with open_trajectory(tmp_path / "b.dcd") as reader:
        assert (reader.n_frames, reader.record) == (6, {})
    with pytest.raises(TrajectoryError, match="not written by surromd"):
        open_writer(tmp_path / "b.dcd", chain(N_ATOMS), {}, append=True)
