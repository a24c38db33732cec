"""The trajectory codec: round trips, other programs' eyes, crashes, full disks, damage."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from systems.errors import InputError, StorageError, TrajectoryError
from systems.files import atomic_file
from systems.scene import Scene
from systems.trajectory import frame_store, hdf5_file
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.topology_file import pdb_text

SUFFIXES = (".h5", ".dcd")
RECORD = {"kind": "reference", "timestep_ps": 0.004, "save_every_ps": 1.0, "seed": 7, "completed": False}


def chain(n_atoms: int, *, name: str = "chain") -> Scene:
    """A chain of carbons, one residue for every two atoms."""
    n_residues = (n_atoms + 1) // 2
    return Scene(
        name=name,
        atom_names=tuple(f"C{i + 1}" for i in range(n_atoms)),
        elements=("C",) * n_atoms,
        residue_of_atom=np.arange(n_atoms) // 2,
        residue_names=("UNK",) * n_residues,
        residue_ids=tuple(str(i + 1) for i in range(n_residues)),
        chain_of_residue=("A",) * n_residues,
        bonds=np.array([(i, i + 1) for i in range(n_atoms - 1)], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.ones(max(n_atoms - 1, 0)),
        formal_charges=np.zeros(n_atoms, dtype=np.int64),
        masses_da=np.full(n_atoms, 12.011),
        positions_nm=np.arange(3.0 * n_atoms).reshape(n_atoms, 3) * 0.1,
    )


def frames(n: int, n_atoms: int = 5, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, n_atoms, 3)).astype(np.float32)


def write(path: Path, n: int = 10, *, n_atoms: int = 5, block: int = 4, **keywords: Any) -> np.ndarray:
    positions = frames(n, n_atoms)
    with open_writer(path, chain(n_atoms), RECORD, **keywords) as writer:
        for k in range(0, n, block):
            part = positions[k : k + block]
            writer.append(part, np.arange(k, k + len(part)) + 1.0)
    return positions


def read(path: Path, **keywords: Any) -> np.ndarray:
    with open_trajectory(path, **keywords) as reader:
        return reader.read()


def left_behind(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


# ---- round trips ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sizes=st.lists(st.integers(0, 7), min_size=1, max_size=5),
    n_atoms=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
    start=st.integers(-12, 40),
    stop=st.one_of(st.none(), st.integers(-12, 40)),
    stride=st.integers(1, 9),
)
def test_what_is_written_is_read(
    tmp_path: Path, suffix: str, sizes: list[int], n_atoms: int, seed: int, start: int, stop: int | None, stride: int
) -> None:
    path = tmp_path / f"a{suffix}"
    generator = np.random.default_rng(seed)
    n = sum(sizes)
    positions = generator.normal(scale=10.0, size=(n, n_atoms, 3)).astype(np.float32)
    times = np.cumsum(generator.uniform(0.1, 2.0, n))
    flags = generator.integers(0, 128, n).astype(np.uint16)
    energy = generator.normal(size=n)
    scene = chain(n_atoms)
    with open_writer(path, scene, RECORD, overwrite=True) as writer:
        k = 0
        for chunk, size in enumerate(sizes):
            part = slice(k, k + size)
            writer.append(positions[part], times[part], flags=flags[part], chunk_idx=chunk,
                          scalars={"energy_kj_mol": energy[part]})  # fmt: skip
            k += size
        assert writer.n_frames == n
        assert writer.last_time_ps == (times[-1] if n else None)
    with open_trajectory(path) as reader:
        tolerance = 0.0 if suffix == ".h5" else 3e-7  # nm to Å and back in float32
        np.testing.assert_allclose(reader.read(), positions, rtol=tolerance, atol=0)
        np.testing.assert_allclose(
            reader.read(start, stop, stride), positions[start:stop:stride], rtol=tolerance, atol=0
        )
        assert reader.read().dtype == np.float32
        assert (reader.n_frames, reader.n_atoms) == (n, n_atoms)
        np.testing.assert_array_equal(reader.time_ps, times)
        assert reader.chunk_idx is not None
        np.testing.assert_array_equal(reader.chunk_idx, np.repeat(np.arange(len(sizes)), sizes))
        if n:
            np.testing.assert_array_equal(reader.flags, flags)
            np.testing.assert_array_equal(reader.scalars["energy_kj_mol"], energy)
        assert reader.record == RECORD
        assert reader.scene is not None
        assert reader.scene.to_dict() == scene.to_dict()
        if n:
            np.testing.assert_array_equal(np.concatenate(list(reader.iter_blocks(3))), reader.read())


def test_long_strided_reads_cross_blocks(tmp_path: Path) -> None:
    positions = write(tmp_path / "a.h5", 20_000, n_atoms=1, block=20_000)
    with open_trajectory(tmp_path / "a.h5") as reader:
        np.testing.assert_array_equal(reader.read(3, 19_999, 7), positions[3:19_999:7])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_record_scalars_and_absent_flags(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    with open_writer(path, chain(5), RECORD) as writer:
        writer.append(frames(2), [1.0, 2.0])
        writer.append(frames(2), [3.0, 4.0], scalars={"late": [5.0, 6.0]}, chunk_idx=None)
        writer.append(frames(2), [5.0, 6.0], scalars={"late": [7.0, 8.0]}, chunk_idx=[3, 4])
        writer.update_record({"cost": {"wall_s": np.float64(1.5), "steps": np.arange(2)}, "completed": True})
        writer.update_record({"long": "x" * 20_000})
    with open_trajectory(path) as reader:
        assert reader.flags is None
        np.testing.assert_array_equal(reader.scalars["late"], [np.nan, np.nan, 5.0, 6.0, 7.0, 8.0])
        np.testing.assert_array_equal(reader.chunk_idx, [-1, -1, -1, -1, 3, 4])
        assert reader.record == RECORD | {
            "cost": {"wall_s": 1.5, "steps": [0, 1]}, "completed": True, "long": "x" * 20_000
        }  # fmt: skip


def test_frames_that_are_not_finite_survive(tmp_path: Path) -> None:
    positions = frames(3)
    positions[1] = np.nan
    with open_writer(tmp_path / "a.h5", chain(5), RECORD) as writer:
        writer.append(positions, [1.0, 2.0, 3.0], flags=np.array([0, 1, 0]))
    np.testing.assert_array_equal(read(tmp_path / "a.h5"), positions)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_append_truncate_and_continue(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    positions = write(path, 10)
    with open_writer(path, chain(5), {"seed": 8, "resumed": True}, append=True) as writer:
        assert (writer.n_frames, writer.last_time_ps) == (10, 10.0)
        writer.truncate(6)
        assert (writer.n_frames, writer.last_time_ps) == (6, 6.0)
        writer.append(positions[6:], np.arange(7.0, 11.0))
    with open_trajectory(path) as reader:
        np.testing.assert_allclose(reader.read(), positions, rtol=3e-7)
        np.testing.assert_array_equal(reader.time_ps, np.arange(1.0, 11.0))
        assert reader.record == RECORD | {"resumed": True}  # what was recorded stays
    with open_writer(path, chain(5), {}, append=True) as writer:
        writer.truncate(0)
        assert writer.last_time_ps is None
        writer.append(positions, np.arange(10.0), flags=np.zeros(10, dtype=int))
    assert len(read(path)) == 10


# ---- other programs' eyes ------------------------------------------------------------------------------------------


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
    np.testing.assert_allclose(seen.xyz, positions, atol=1e-6)
    assert [a.name for a in seen.topology.atoms] == list(alanine_dipeptide.atom_names)
    assert [a.element.symbol for a in seen.topology.atoms] == list(alanine_dipeptide.elements)
    bonds = sorted(tuple(sorted((b.atom1.index, b.atom2.index))) for b in seen.topology.bonds)
    assert bonds == sorted(map(tuple, alanine_dipeptide.bonds.tolist()))
    if suffix == ".h5":
        np.testing.assert_array_equal(seen.time, 3.0 + np.arange(n) * 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = mda.Universe(str(pdb), str(path), format="H5MD" if suffix == ".h5" else "DCD")
        assert universe.trajectory.n_frames == n
        if suffix == ".dcd":  # MDAnalysis reads times, but no dt, from H5MD
            assert universe.trajectory.dt == pytest.approx(0.5, rel=1e-6)
        for k, step in enumerate(universe.trajectory):
            np.testing.assert_allclose(step.positions, positions[k] * 10.0, atol=1e-4)
            assert step.time == pytest.approx(3.0 + 0.5 * k, rel=1e-6)
            assert step.dimensions is None
            if suffix == ".h5":
                assert step.data["step"] == round((3.0 + 0.5 * k) / 0.004)


def test_h5md_costs_no_space(tmp_path: Path) -> None:
    write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        position = file["particles/trajectory/position"]
        assert position["value"] == file["coordinates"]
        assert position["time"] == file["time"]
        assert position["value"].attrs["unit"] == "nm"
        assert file["coordinates"].attrs["units"] == b"nanometers"
        assert file.attrs["conventions"] == b"Pande"
        assert file["particles/trajectory/species"][:].tolist() == [6] * 5


def test_atom_order_survives_scattered_residues(tmp_path: Path) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    scene = chain(4)
    record = scene.to_dict() | {"residue_of_atom": [1, 0, 1, 0], "chain_of_residue": ["B", "A"]}
    scene = Scene.from_dict(record)
    with open_writer(tmp_path / "a.h5", scene, {}) as writer:
        writer.append(frames(1, 4), [0.0])
    assert [a.name for a in mdtraj.load(str(tmp_path / "a.h5")).topology.atoms] == ["C1", "C2", "C3", "C4"]


def test_interval_that_is_no_whole_number_of_steps(tmp_path: Path) -> None:
    mda = pytest.importorskip("MDAnalysis")
    with open_writer(tmp_path / "a.dcd", chain(5), {"timestep_ps": 0.004}) as writer:
        writer.append(frames(3), [0.0, 0.7777, 1.5554])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = mda.Universe(str(tmp_path / "a.pdb"), str(tmp_path / "a.dcd"))
        assert universe.trajectory.dt == pytest.approx(0.7777, rel=1e-6)


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


# ---- what is refused before anything is touched --------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_existing_files_are_kept(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    positions = write(path)
    with pytest.raises(TrajectoryError, match="exists already"):
        open_writer(path, chain(5), {})
    np.testing.assert_allclose(read(path), positions, rtol=3e-7)
    write(path, 3, overwrite=True)
    assert len(read(path)) == 3


def test_a_users_pdb_beside_the_dcd_is_never_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.pdb").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(TrajectoryError, match=r"a\.pdb"):
            open_writer(tmp_path / "a.dcd", chain(5), {}, overwrite=overwrite)
    assert left_behind(tmp_path) == ["a.pdb"]
    assert (tmp_path / "a.pdb").read_text() == "mine"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_another_topology_is_not_continued(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / f"a{suffix}")
    with pytest.raises(TrajectoryError, match="choose another file"):
        open_writer(tmp_path / f"a{suffix}", chain(6), {}, append=True)


def test_usage_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.xyz"):
        open_writer(tmp_path / "a.xyz", chain(5), {})
    with pytest.raises(InputError, match="exclude"):
        open_writer(tmp_path / "a.h5", chain(5), {}, append=True, overwrite=True)
    with pytest.raises(TrajectoryError, match="does not exist"):
        open_writer(tmp_path / "a.h5", chain(5), {}, append=True)
    for suffix in (".h5", ".dcd", ".xtc"):
        with pytest.raises(TrajectoryError, match="does not exist"):
            open_trajectory(tmp_path / f"a{suffix}")
    with pytest.raises(InputError, match="JSON"):
        open_writer(tmp_path / "a.h5", chain(5), {"bad": object()})
    for suffix in SUFFIXES:
        with pytest.raises(StorageError, match="folder does not exist"):
            open_writer(tmp_path / "none" / f"a{suffix}", chain(5), {})
    assert left_behind(tmp_path) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("positions", "times", "keywords"),
    [
        (frames(2, 4), [3.0, 4.0], {}),
        (frames(2), [3.0], {}),
        (frames(2), [3.0, 3.0], {}),
        (frames(2), [2.0, 3.0], {}),
        (frames(2), [3.0, np.nan], {}),
        (frames(2), [3.0, 4.0], {"flags": [0, 0]}),
        (frames(2), [3.0, 4.0], {"flags": [0.5, 0.5]}),
        (frames(2), [3.0, 4.0], {"chunk_idx": [0, 1, 2]}),
        (frames(2), [3.0, 4.0], {"chunk_idx": 0.5}),
        (frames(2), [3.0, 4.0], {"scalars": {"e": [1.0]}}),
        (frames(2), [3.0, 4.0], {"scalars": {"a/b": [1.0, 2.0]}}),
    ],
)
def test_frames_that_do_not_fit_are_refused(
    tmp_path: Path, suffix: str, positions: Any, times: Any, keywords: Any
) -> None:
    path = tmp_path / f"a{suffix}"
    with open_writer(path, chain(5), RECORD) as writer:
        writer.append(frames(2), [1.0, 2.0])
        with pytest.raises(InputError):
            writer.append(positions, times, **keywords)
        if "flags" not in keywords:
            writer.append(frames(2), [3.0, 4.0])  # the refusal did no harm
            assert writer.n_frames == 4
    with pytest.raises(InputError, match="closed"):
        writer.append(frames(1), [9.0])
    assert len(read(path)) >= 2


# ---- crashes -------------------------------------------------------------------------------------------------------


def test_every_prefix_of_every_append_is_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of two frames, so that indices split: after any write we see the old frames, others those or the new."""
    monkeypatch.setattr(hdf5_file, "_CHUNK_BYTES", 24)
    monkeypatch.setitem(frame_store.add_column.__kwdefaults__, "chunk", 2)
    path, copy = tmp_path / "a.h5", tmp_path / "b.h5"
    positions = frames(180, 1)
    state = {"old": 0, "new": 0, "prefixes": 0, "undone": 0}
    write_whole = atomic_file.write_whole

    def written_and_looked_at(descriptor: int, data: bytes, offset: int) -> None:
        write_whole(descriptor, data, offset)
        shutil.copyfile(path, copy)
        shutil.copyfile(atomic_file.journal_path(path), atomic_file.journal_path(copy))
        found = read(copy)
        np.testing.assert_array_equal(found, positions[: state["old"]])
        if state["new"] > state["old"]:  # what is cut off is for the journal alone
            atomic_file.journal_path(copy).unlink()
            with h5py.File(copy) as file:
                n = len(file["coordinates"])
                assert n in (state["old"], state["new"])
                np.testing.assert_array_equal(file["coordinates"][: state["old"]], positions[: state["old"]])
                state["undone"] += n > len(found)
        state["prefixes"] += 1

    monkeypatch.setattr(atomic_file, "write_whole", written_and_looked_at)
    with open_writer(path, chain(1), {}) as writer:
        k = 0
        for size in [1, 3, 2, 6, 24] * 5:
            state |= {"old": k, "new": k + size}
            writer.append(positions[k : k + size], np.arange(k, k + size), scalars={"e": np.zeros(size)})
            k += size
        state |= {"old": k, "new": k}
        writer.update_record({"long": "x" * 6000})
        writer.truncate(k - 40)
        state |= {"old": k - 40, "new": k - 40}
        writer.append(positions[k - 40 :], np.arange(k - 40, 180.0), scalars={"e": np.zeros(220 - k)})
    assert state["prefixes"] > 300 and state["undone"] > 20
    np.testing.assert_array_equal(read(path), positions)


def test_kill_minus_nine(tmp_path: Path, repository: Path) -> None:
    """A process killed while it appends leaves files that open whole and are continued."""
    program = tmp_path / "writer.py"
    program.write_text(
        f"import sys; sys.path[:0] = [{str(repository)!r}, {str(Path(__file__).parent)!r}]\n"
        "import numpy as np\nfrom pathlib import Path\n"
        "from test_trajectory import chain\nfrom systems.trajectory.codec import open_writer\n"
        "w = open_writer(Path(sys.argv[1]), chain(50), {}, append=Path(sys.argv[1]).exists())\n"
        "begun = w.n_frames\n"
        "while True:\n"
        "    n = w.n_frames; k = n % 37 + 1\n"
        "    x = np.arange(n, n + k, dtype=np.float32)[:, None, None] * np.ones((1, 50, 3), dtype=np.float32)\n"
        "    w.append(x, np.arange(n, n + k), flags=np.zeros(k, dtype=int), chunk_idx=n)\n"
        "    if n == begun: print('one append is on disk', flush=True)\n"
    )
    for suffix in SUFFIXES:
        path, last = tmp_path / f"a{suffix}", 0
        for trial in range(3):
            process = subprocess.Popen([sys.executable, str(program), str(path)], stdout=subprocess.PIPE)
            assert process.stdout is not None
            assert process.stdout.readline() == b"one append is on disk\n"
            time.sleep(0.03 + 0.037 * trial)
            process.send_signal(signal.SIGKILL)
            process.wait()
            process.stdout.close()
            with open_trajectory(path) as reader:
                expected = np.arange(reader.n_frames, dtype=np.float32)
                np.testing.assert_allclose(reader.read()[:, 7, 1], expected, rtol=3e-7)
                np.testing.assert_array_equal(reader.time_ps, expected)
                assert reader.n_frames > last
                last = reader.n_frames


def test_columns_of_different_length(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    positions = write(path, 8, block=4)
    with h5py.File(path, "r+") as file:  # as a crash of an earlier version may leave it: one column ahead by one append
        file["surromd"].attrs["largest_append"] = 4
        file["coordinates"].resize(12, axis=0)
    np.testing.assert_array_equal(read(path), positions)
    with h5py.File(path, "r+") as file:  # and as no crash leaves it
        file["coordinates"].resize(13, axis=0)
    with pytest.raises(TrajectoryError, match="differ in length"):
        open_trajectory(path)
    with pytest.raises(TrajectoryError, match="differ in length"):
        open_writer(path, chain(5), {}, append=True)


def test_a_dcd_append_in_flight_is_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "a.dcd"
    positions = write(path, 8, block=4)
    whole = path.read_bytes()
    for extra in (10, 84, 4 * 84):  # a frame of five atoms has 84 bytes
        path.write_bytes(whole + whole[-extra:])
        np.testing.assert_allclose(read(path), positions, rtol=3e-7)
        with open_writer(path, chain(5), {}, append=True) as writer:
            assert writer.n_frames == 8
        assert path.read_bytes() == whole
    with open_writer(path, chain(5), {}, append=True) as writer:
        writer.update_record({"completed": True})
    path.write_bytes(whole + whole[-84:])
    with pytest.raises(TrajectoryError, match="records 8"):
        open_trajectory(path)


def test_a_running_trajectory_can_be_read_but_not_written(tmp_path: Path, repository: Path) -> None:
    path = tmp_path / "a.h5"
    with open_writer(path, chain(5), RECORD) as writer:
        writer.append(frames(3), [1.0, 2.0, 3.0])
        program = (
            f"import sys; sys.path[:0] = [{str(repository)!r}, {str(Path(__file__).parent)!r}]\n"
            "from test_trajectory import chain\nfrom systems.trajectory.codec import open_trajectory, open_writer\n"
            f"print(open_trajectory({str(path)!r}).n_frames)\nopen_writer({str(path)!r}, chain(5), {{}}, append=True)\n"
        )
        run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
        assert run.stdout == "3\n"
        assert "being written by another process" in run.stderr
        writer.append(frames(1), [4.0])
    assert len(read(path)) == 4


# ---- damage --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_truncated_file_is_refused_in_one_line(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write(path, 50, n_atoms=22)
    whole = path.read_bytes()
    for share in (0.0, 0.001, 0.1, 0.5, 0.9, 0.999):
        path.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(TrajectoryError) as caught:
            open_trajectory(path)
        assert "\n" not in str(caught.value)
        assert path.name in str(caught.value)
        with pytest.raises(TrajectoryError):
            open_writer(path, chain(22), {}, append=True)


def test_a_truncated_dcd_without_record_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.dcd"
    positions = write(path)
    (tmp_path / "a.meta.h5").unlink()
    with open_trajectory(path) as reader:  # unmarked, but whole: the companion PDB still names the atoms
        assert (reader.record, reader.flags, reader.n_frames) == ({}, None, len(positions))
        assert reader.scene is not None
    with pytest.raises(TrajectoryError, match="cannot be continued"):
        open_writer(path, chain(5), {}, append=True)
    whole = path.read_bytes()
    for cut in (len(whole) - 1, len(whole) - 84, 120):
        path.write_bytes(whole[:cut])
        with pytest.raises(TrajectoryError, match="cut short"):
            open_trajectory(path)
    damaged = bytearray(whole)
    damaged[-84 * 3 : -84 * 3 + 4] = b"\xff" * 4
    path.write_bytes(damaged)
    with open_trajectory(path) as reader, pytest.raises(TrajectoryError, match="damaged at frame 7"):
        reader.read()


def test_rubbish_and_missing_parts_are_refused(tmp_path: Path) -> None:
    for suffix in (*SUFFIXES, ".xtc"):
        path = tmp_path / f"rubbish{suffix}"
        path.write_bytes(np.random.default_rng(1).bytes(5000))
        with pytest.raises(TrajectoryError) as caught:
            open_trajectory(path, top=tmp_path / "none.pdb" if suffix == ".xtc" else None)
        assert "\n" not in str(caught.value)
    path = tmp_path / "a.h5"
    for name in ("time", "surromd/record", "surromd/scene", "coordinates"):
        write(path, overwrite=True)
        with h5py.File(path, "r+") as file:
            del file[name]
        with pytest.raises(TrajectoryError, match=r"damaged|no /coordinates"):
            open_trajectory(path)


def test_overwritten_bytes_never_pass_as_frames(tmp_path: Path) -> None:
    """A block of zeros anywhere in the headers is an error or leaves all frames as they were."""
    path = tmp_path / "a.h5"
    positions = write(path, 20)
    whole = path.read_bytes()
    with h5py.File(path) as file:
        chunk = file["coordinates"].id.get_chunk_info(0)
    data = range(chunk.byte_offset, chunk.byte_offset + chunk.size)
    refused = 0
    for start in range(0, min(len(whole), 30_000), 512):
        if start in data or start + 511 in data:
            continue
        path.write_bytes(whole[:start] + bytes(512) + whole[start + 512 :])
        try:
            seen = read(path)
        except (TrajectoryError, InputError):
            refused += 1
        else:
            np.testing.assert_array_equal(seen, positions)
    assert refused > 3


# ---- a full disk ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("failing", range(1, 12, 2))
def test_full_disk_at_any_write(tmp_path: Path, suffix: str, failing: int, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"a{suffix}"
    positions = frames(4000, 40)
    pwrite, count = os.pwrite, 0

    def small_disk(descriptor: int, data: Any, offset: int) -> int:
        nonlocal count
        if offset + len(data) > os.fstat(descriptor).st_size:  # only what needs space can fail
            count += 1
            if count >= failing:
                raise OSError(errno.ENOSPC, "No space left on device")
        return pwrite(descriptor, data, offset)

    written = 0
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", small_disk)
        with pytest.raises(StorageError, match="full") as caught, open_writer(path, chain(40), RECORD) as writer:
            for k in range(0, 4000, 400):
                writer.append(positions[k : k + 400], np.arange(k, k + 400.0))
                written = writer.n_frames
        assert "\n" not in str(caught.value)
        assert caught.value.__cause__ is not None
    if not path.exists():
        assert left_behind(tmp_path) == []
        return
    np.testing.assert_allclose(read(path), positions[:written], rtol=3e-7)
    with open_writer(path, chain(40), {}, append=True) as writer:
        writer.append(positions[written:], np.arange(written, 4000.0))
    np.testing.assert_allclose(read(path), positions, rtol=3e-7)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_file_size_limit_of_the_system(tmp_path: Path, suffix: str, repository: Path) -> None:
    """The real thing: the kernel refuses to let the file grow."""
    path = tmp_path / f"a{suffix}"
    program = (
        f"import sys; sys.path[:0] = [{str(repository)!r}, {str(Path(__file__).parent)!r}]\n"
        "import resource, numpy as np\nfrom test_trajectory import chain, frames\n"
        "from systems.errors import StorageError\nfrom systems.trajectory.codec import open_writer\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (600_000, 600_000))\n"
        f"w = open_writer({str(path)!r}, chain(22), {{}})\n"
        "try:\n"
        "    while True:\n"
        "        w.append(frames(100, 22), np.arange(w.n_frames, w.n_frames + 100.0))\n"
        "except StorageError as error:\n"
        "    print(w.n_frames, error)\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    n = int(run.stdout.split()[0])
    assert n >= 500
    assert f"the {n} frames written before are complete" in run.stdout
    np.testing.assert_allclose(read(path), np.concatenate([frames(100, 22)] * (n // 100)), rtol=3e-7)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the open files of a process are listed by Linux")
@pytest.mark.parametrize("unfinished", [False, True])
def test_a_reader_beside_a_journal_leaves_nothing_open(
    tmp_path: Path, alanine_dipeptide: Scene, unfinished: bool
) -> None:
    path = tmp_path / "a.h5"
    frames = alanine_dipeptide.positions_nm[None].repeat(3, axis=0)
    with open_writer(path, alanine_dipeptide, {}) as writer:
        writer.append(frames, [1.0, 2.0, 3.0])
        if unfinished:
            whole = path.read_bytes()
            writer._store._atomic._keep(len(whole), [(0, whole[:8])])
        with open_trajectory(path) as reader:
            assert reader.n_frames == 3
        held = [fd for fd in list(Path("/proc/self/fd").iterdir()) if fd.exists() and fd.samefile(path)]
        assert len(held) == 1  # the writer's
