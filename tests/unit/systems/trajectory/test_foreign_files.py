"""Trajectories through other programs: ours read by them, theirs read by us."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from chain_files import RECORD, SUFFIXES, chain, frames, read
from systems.errors import InputError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import pdb_text


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_mdtraj_and_mdanalysis_read_it(tmp_path: Path, suffix: str, alanine_dipeptide: Scene) -> None:
    mdtraj, mda = pytest.importorskip("mdtraj"), pytest.importorskip("MDAnalysis")
    path, n = tmp_path / f"a{suffix}", 7
    positions = alanine_dipeptide.positions_nm + frames(n, 22) * 0.01
    with open_writer(path, alanine_dipeptide, RECORD) as writer:
        writer.append(positions[:4], 3.0 + np.arange(4) * 0.5)
        writer.append(positions[4:], 5.0 + np.arange(3) * 0.5)
    pdb = tmp_path / "a.pdb"
    if suffix == ".h5":
        pdb.write_text(pdb_text(alanine_dipeptide))
    seen = mdtraj.load(str(path)) if suffix == ".h5" else mdtraj.load(str(path), top=str(pdb))
    coarse = 5.1e-4 if suffix == ".xtc" else 0.0  # nm; it keeps three decimals
    np.testing.assert_allclose(seen.xyz, positions, atol=1e-6 + coarse)
    assert [a.name for a in seen.topology.atoms] == list(alanine_dipeptide.atom_names)
    assert [a.element.symbol for a in seen.topology.atoms] == list(alanine_dipeptide.elements)
    bonds = sorted(tuple(sorted((b.atom1.index, b.atom2.index))) for b in seen.topology.bonds)
    assert bonds == sorted(map(tuple, alanine_dipeptide.bonds.tolist()))
    if suffix != ".dcd":
        np.testing.assert_array_equal(seen.time, 3.0 + np.arange(n) * 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = mda.Universe(str(pdb), str(path), format="H5MD" if suffix == ".h5" else None)
        assert universe.trajectory.n_frames == n
        if suffix != ".h5":  # MDAnalysis reads times, but no dt, from H5MD
            assert universe.trajectory.dt == pytest.approx(0.5, rel=1e-6)
        for k, step in enumerate(universe.trajectory):
            np.testing.assert_allclose(step.positions, positions[k] * 10.0, atol=1e-4 + 10 * coarse)
            assert step.time == pytest.approx(3.0 + 0.5 * k, rel=1e-6)
            assert step.dimensions is None
            if suffix != ".dcd":
                assert step.data["step"] == round((3.0 + 0.5 * k) / 0.004)


def test_other_peoples_hdf5(shared_data: Path) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    for name in ("ala2.h5", "frame0.h5"):
        path = shared_data / "mdtraj" / name
        seen = mdtraj.load(str(path))
        with open_trajectory(path) as reader:
            np.testing.assert_array_equal(reader.read(), seen.xyz)
            np.testing.assert_allclose(reader.time_ps, seen.time)
            assert (reader.record, reader.flags, reader.chunk_idx, reader.scalars) == ({}, None, None, {})
            assert reader.scene is not None
            assert reader.scene.atom_names == tuple(a.name for a in seen.topology.atoms)
            assert len(reader.scene.bonds) == seen.topology.n_bonds


def test_a_foreign_hdf5_is_not_continued(shared_data: Path, tmp_path: Path) -> None:
    path = tmp_path / "ala2.h5"
    shutil.copyfile(shared_data / "mdtraj" / "ala2.h5", path)
    before = path.read_bytes()
    with pytest.raises(TrajectoryError, match="was not written by surromd"):
        open_writer(path, chain(22), {}, append=True)
    assert path.read_bytes() == before


def test_other_peoples_dcd(shared_data: Path) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    folder = shared_data / "alanine-dipeptide"
    path, top = folder / "trajectory-0.dcd", folder / "ala2.pdb"
    seen = mdtraj.load(str(path), top=str(top))
    with open_trajectory(path, top=top) as reader:
        assert (reader.record, reader.flags) == ({}, None)
        assert reader.n_frames == 9999
        np.testing.assert_allclose(reader.read(10, 20), seen.xyz[10:20], atol=1e-6)
        np.testing.assert_array_equal(np.diff(reader.time_ps), np.ones(9998))
        assert reader.scene is not None
        assert len(reader.scene.bonds) == 21
    with open_trajectory(path) as reader:
        assert reader.scene is None
    with pytest.raises(InputError, match="22"):
        open_trajectory(path, top=shared_data / "adk" / "adk_open.pdb")


def test_a_run_that_stopped_early_is_read_with_a_warning(shared_data: Path, tmp_path: Path) -> None:
    """CHARMM states the frames it intends: the header of this published file says 500, it holds 98."""
    folder = shared_data / "adk"
    with pytest.warns(UserWarning, match="states 500 frames, the file holds 98"):
        reader = open_trajectory(folder / "adk_dims.dcd", top=folder / "adk_open.pdb")
    assert (reader.n_frames, reader.n_atoms) == (98, 3341)
    assert reader.scene is not None  # the file has no element column, and CA is no calcium
    assert set(reader.scene.elements) == {"H", "C", "N", "O", "S"}
    assert 2.0 in reader.scene.bond_orders
    reader.close()
    data = (folder / "adk_dims.dcd").read_bytes()
    (tmp_path / "cut.dcd").write_bytes(data[:-1000])
    with pytest.raises(TrajectoryError, match="cut short"):
        open_trajectory(tmp_path / "cut.dcd")


def test_xtc_through_mdtraj(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    positions = alanine_dipeptide.positions_nm + frames(3, 22) * 0.01
    topology = alanine_dipeptide.to_mdtraj_topology()
    mdtraj.Trajectory(positions, topology, time=np.array([2.0, 4.0, 6.0])).save_xtc(str(tmp_path / "a.xtc"))
    (tmp_path / "top.pdb").write_text(pdb_text(alanine_dipeptide))
    with open_trajectory(tmp_path / "a.xtc", top=tmp_path / "top.pdb") as reader:
        np.testing.assert_allclose(reader.read(1, None), positions[1:], atol=1e-3)
        np.testing.assert_allclose(reader.time_ps, [2.0, 4.0, 6.0])
        assert reader.scene is not None
        assert reader.scene.elements == alanine_dipeptide.elements
    with open_trajectory(tmp_path / "a.xtc") as reader:
        assert reader.scene is None and reader.n_atoms == 22


def test_big_endian_dcd_with_cell(tmp_path: Path) -> None:
    positions = frames(3, 2)
    fields = np.zeros(20, dtype=">i4")
    fields[[0, 2, 10, 19]] = 3, 1, 1, 24
    fields[9:10] = np.array([1.0], dtype=">f4").view(">i4")
    mark = np.array([84], dtype=">i4").tobytes()
    data = mark + b"CORD" + fields.tobytes() + mark + mark + np.array([1], dtype=">i4").tobytes() + b" " * 80 + mark
    data += np.array([4, 2, 4], dtype=">i4").tobytes()
    for frame in positions:
        edge = np.array([48], dtype=">i4").tobytes()
        data += edge + np.zeros(6, dtype=">f8").tobytes() + edge
        for axis in range(3):
            edge = np.array([8], dtype=">i4").tobytes()
            data += edge + (frame[:, axis] * 10).astype(">f4").tobytes() + edge
    path = tmp_path / "b.dcd"
    path.write_bytes(data)
    np.testing.assert_allclose(read(path), positions, rtol=1e-6)
    with warnings.catch_warnings(), open_trajectory(path) as reader:
        warnings.simplefilter("error")
        assert reader.read_cells() is None, "a cell of zeros is none"
    whole = data.replace(np.zeros(6, dtype=">f8").tobytes(), np.array([30, 90, 40, 90, 90, 50], ">f8").tobytes())
    path.write_bytes(whole)
    with open_trajectory(path) as reader:
        np.testing.assert_allclose(reader.read_cells(), [np.diag([3.0, 4.0, 5.0])] * 3)


def test_an_unknown_format_is_refused_in_one_whole_sentence(tmp_path: Path) -> None:
    (tmp_path / "bad.xyzz").write_text("x")
    with pytest.raises(TrajectoryError, match=r"cannot be read by MDTraj or MDAnalysis.*'\.$"):
        open_trajectory(tmp_path / "bad.xyzz")
