"""The trajectory codec: round trips and refusals."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from chain_files import RECORD, SUFFIXES, chain, frames, left_behind, read, write
from systems.errors import InputError, StorageError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

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
        tolerance = 3e-7 if suffix == ".dcd" else 0.0  # nm to Å and back in float32; XTC packs ten atoms or more
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
