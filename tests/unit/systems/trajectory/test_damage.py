"""Trajectory files under crashes, full disks and damage."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from chain_files import RECORD, SUFFIXES, TOLERANCES, chain, frames, left_behind, read, write
from systems.errors import InputError, StorageError, TrajectoryError
from systems.files import whole_file
from systems.scene import Scene
from systems.trajectory import hdf5_file, store
from systems.trajectory.codec import open_trajectory, open_writer


def test_every_prefix_of_every_append_is_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of two frames, so that indices split: after any write what the journal leaves are the old frames.

    Looked at are the first appends, those after which an index has split, and what ends in the middle of chunks.
    """
    write(tmp_path / "first.dcd")  # loads all formats before `write_whole` is replaced
    monkeypatch.setattr(hdf5_file, "_CHUNK_BYTES", 24)
    monkeypatch.setitem(store.add_column.__kwdefaults__, "chunk", 2)
    path, copy = tmp_path / "a.h5", tmp_path / "b.h5"
    positions = frames(180, 1)
    state = {"old": 0, "prefixes": 0, "undone": 0, "looked at": False}
    write_whole = whole_file.write_whole

    def written_and_looked_at(descriptor: int, data: bytes, offset: int) -> None:
        write_whole(descriptor, data, offset)
        if not state["looked at"]:
            return
        shutil.copyfile(path, copy)
        shutil.copyfile(whole_file.journal_path(path), whole_file.journal_path(copy))
        np.testing.assert_array_equal(read(copy), positions[: state["old"]])
        whole_file.journal_path(copy).unlink()
        try:  # negative control: without the journal other frames are seen, or none
            state["undone"] += len(read(copy)) != state["old"]
        except TrajectoryError:
            state["undone"] += 1
        state["prefixes"] += 1

    monkeypatch.setattr(whole_file, "write_whole", written_and_looked_at)
    with open_writer(path, chain(1), {}) as writer:
        k = 0
        for turn, size in enumerate([1, 3, 2, 6, 24] * 5):
            state |= {"old": k, "looked at": turn < 5 or turn >= 19}
            writer.append(positions[k : k + size], np.arange(k, k + size), scalars={"e": np.zeros(size)})
            k += size
        state["old"] = k
        writer.update_record({"long": "x" * 6000})
        writer.truncate(k - 11)
        state["old"] = k - 11
        writer.append(positions[k - 11 :], np.arange(k - 11, 180.0), scalars={"e": np.zeros(11)})
    assert state["prefixes"] > 300 and state["undone"] > 20
    np.testing.assert_array_equal(read(path), positions)


def test_kill_minus_nine(tmp_path: Path, repository: Path) -> None:
    """A process killed while it appends leaves files that open whole and are continued."""
    program = tmp_path / "writer.py"
    program.write_text(
        f"import sys; sys.path[:0] = [{str(repository)!r}, {str(repository / 'tests' / 'helpers')!r}]\n"
        "import numpy as np\nfrom pathlib import Path\n"
        "from chain_files import chain\nfrom systems.trajectory.codec import open_writer\n"
        "w = open_writer(Path(sys.argv[1]), chain(50), {}, append=Path(sys.argv[1]).exists())\n"
        "begun = w.n_frames\n"
        "while True:\n"
        "    n = w.n_frames; k = n % 37 + 1\n"
        "    x = np.arange(n, n + k, dtype=np.float32)[:, None, None] * np.ones((1, 50, 3), dtype=np.float32)\n"
        "    w.append(x, np.arange(n, n + k), flags=np.zeros(k, dtype=int), chunk_idx=n)\n"
        "    if n == begun: print('one append is on disk', flush=True)\n"
    )
    for suffix in SUFFIXES:
        path, last = tmp_path / f"{suffix[1:]}{suffix}", 0  # each has a record of its own
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
    write(path, 8, block=4)
    with h5py.File(path, "r+") as file:
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
            f"import sys; sys.path[:0] = [{str(repository)!r}, {str(repository / 'tests' / 'helpers')!r}]\n"
            "from chain_files import chain\nfrom systems.trajectory.codec import open_trajectory, open_writer\n"
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
    for suffix in SUFFIXES:
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
    rtol, atol = TOLERANCES[suffix]
    np.testing.assert_allclose(read(path), positions[:written], rtol=rtol, atol=atol)
    with open_writer(path, chain(40), {}, append=True) as writer:
        writer.append(positions[written:], np.arange(written, 4000.0))
    np.testing.assert_allclose(read(path), positions, rtol=rtol, atol=atol)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_file_size_limit_of_the_system(tmp_path: Path, suffix: str, repository: Path) -> None:
    """The real thing: the kernel refuses to let the file grow."""
    path = tmp_path / f"a{suffix}"
    program = (
        f"import sys; sys.path[:0] = [{str(repository)!r}, {str(repository / 'tests' / 'helpers')!r}]\n"
        "import resource, numpy as np\nfrom chain_files import chain, frames\n"
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
    rtol, atol = TOLERANCES[suffix]
    np.testing.assert_allclose(read(path), np.concatenate([frames(100, 22)] * (n // 100)), rtol=rtol, atol=atol)


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
            writer._atomic._keep(len(whole), [(0, whole[:8])])
        with open_trajectory(path) as reader:
            assert reader.n_frames == 3
        held = [fd for fd in list(Path("/proc/self/fd").iterdir()) if fd.exists() and fd.samefile(path)]
        assert len(held) == 1  # the writer's
