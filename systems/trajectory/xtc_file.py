"""Files that hold positions alone, with all else in `NAME.meta.h5`: what DCD (`dcd_file`) and XTC share, and XTC.

`NAME.xtc` holds positions in nm to three decimals and times as float32. Frames are compressed and read by MDTraj. No
library appends to a file whose last frame is cut short, or cuts one to a number of frames: where each frame ends stands
in `NAME.meta.h5`, so that a run goes on behind the last whole one.
"""

from __future__ import annotations

import os
import tempfile
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, SurromdError, TrajectoryError, first_line
from systems.files.whole_file import create_whole, storage_error, write_whole
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter
from systems.trajectory.companion_writer import meta_path
from systems.trajectory.store import (
    CELLS,
    ENDS,
    FRAMES,
    Columns,
    Float32Array,
    Float64Array,
    FrameBlock,
    add_column,
    consistent_length,
    damage_reported,
    open_hdf5,
)


class CompanionWriter(TrajectoryWriter):
    """Writes frames and their companions; see `systems.trajectory.codec.open_writer` for the arguments and errors.
    Frames go to the file first and to `NAME.meta.h5` then: what lies behind the frames that it counts was in flight."""

    _fd = -1

    def __init__(self, path: Path, *args: Any, **how: Any) -> None:
        super().__init__(path, *args, **how)
        try:
            self._fd = os.open(path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
            self._set_length(self.n_frames, self.file)
        except OSError as error:
            self.close()
            raise storage_error(path, error, "nothing was changed") from error

    @staticmethod
    def _store_of(path: Path) -> Path:
        return meta_path(path)

    @abstractmethod
    def _encoded(self, block: FrameBlock) -> tuple[bytes, Columns, Columns]:
        """Return a block as the file has it, the columns that go with it, and what has a checksum (`FrameStore`).
        Raises InputError for frames that the format cannot hold."""

    @abstractmethod
    def _offset(self, n_frames: int, record: h5py.File) -> int:
        """Return where in the file the first `n_frames` frames end, bytes; `record`: the open `NAME.meta.h5`."""

    def _restate(self, n_frames: int, first_times_ps: Float64Array) -> None:
        """Make the header say so many frames, where there is one: one small write, which is atomic. Raises OSError."""

    def _append(self, block: FrameBlock) -> None:
        with self._open():
            start = self._offset(self.n_frames, self.file)
            times_ps = np.concatenate([self.file["time"][:2], block.time_ps])
        data, columns, stored = self._encoded(block)
        try:
            write_whole(self._fd, data, start)
            self._restate(self.n_frames + len(block), times_ps)
            os.ftruncate(self._fd, start + len(data))
            os.fsync(self._fd)
            self._store(block, columns, stored)
        except BaseException as error:
            failed = self.failed(error) if isinstance(error, OSError) else error
            # The companion may hold these frames, where its own last step failed: what it lacks is cut off. Taking
            # space back needs none, so this also succeeds on a full disk; and frames too many do no harm.
            with suppress(OSError, SurromdError), open_hdf5(meta_path(self.path)) as file:
                self._set_length(consistent_length(file, self.path), file)
            self.close()
            raise failed from error

    def _set_length(self, n_frames: int, record: h5py.File) -> None:
        """Make header and file size say `n_frames`."""
        times_ps, end = record["time"][: min(n_frames, 2)], self._offset(n_frames, record)
        if record is self.file and self._atomic.failure is not None:  # HDF5 makes zeros of what could not be read
            raise self._atomic.failure
        self._restate(n_frames, times_ps)
        os.ftruncate(self._fd, end)

    def truncate(self, n_frames: int) -> None:
        super().truncate(n_frames)
        try:
            self._set_length(n_frames, self.file)
        except OSError as error:
            raise self.failed(error) from error

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        super().close()


class CompanionReader(TrajectoryReader):
    """Reads positions from one file and all else from `NAME.meta.h5`; both are refused unless they fit each other."""

    def _read_companion(self, top: Path | None) -> None:
        meta = meta_path(self.path)
        with open_hdf5(meta) as file, damage_reported(meta):
            if "surromd" not in file:
                raise TrajectoryError(f"{meta} is not the record of {self.path.name}; move it to read the DCD alone.")
            self._read_stored(file, meta)
            if ENDS in file:
                self._ends: npt.NDArray[np.int64] = file[ENDS][: self.n_frames]
        assert self.scene is not None
        self.n_atoms = self.scene.n_atoms
        if top is not None:
            self.notes = (f"{top} is not used: the file holds its own topology.",)


def is_of_xtc(path: Path) -> bool:
    """Whether `NAME.meta.h5` beside a DCD or XTC is the record of an XTC. Raises TrajectoryError where it cannot be
    read."""
    if not meta_path(path).exists():
        return False
    with open_hdf5(meta_path(path)) as file:
        return ENDS in file


def check_size(path: Path, n_frames: int, end: int, *, completed: bool) -> None:
    """Raise TrajectoryError unless a file holds the recorded frames, which end at byte `end`; behind them a run may
    have some in flight."""
    size = path.stat().st_size
    if size < end or (size > end and completed):
        raise TrajectoryError(
            f"{path} holds {size} bytes where {meta_path(path).name} records {n_frames} frames of {end}: one of "
            "them is cut short or replaced; restore both from one copy."
        )


# ---- XTC ------------------------------------------------------------------------------------------------------------


# Three decimals in 32-bit integers.
_MOST_NM = 2.0e6
_DECODED_AT_ONCE = 4096


class XtcWriter(CompanionWriter):
    """Writes an XTC and its companions; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    def _lay_out(self, file: h5py.File, scene: Scene, columns: Sequence[str]) -> None:
        add_column(file, ENDS, 0, "<i8")

    def _begin(self, path: Path, scene: Scene) -> None:
        create_whole(path, b"")

    def _adopt(self) -> None:
        if ENDS not in self.file:
            raise TrajectoryError(f"{meta_path(self.path)} is not the record of {self.path.name}; choose another name.")
        check_size(self.path, self.n_frames, self._offset(self.n_frames, self.file), completed=False)

    def _offset(self, n_frames: int, record: h5py.File) -> int:
        return int(record[ENDS][n_frames - 1]) if n_frames else 0

    def _encoded(self, block: FrameBlock) -> tuple[bytes, Columns, Columns]:
        beyond = ~(np.abs(block.positions_nm) < _MOST_NM).all(axis=(1, 2))
        if beyond.any():
            raise InputError(
                f"{self.path}: frame {self.n_frames + int(np.argmax(beyond))} has positions that are not finite or too "
                "large for an XTC; write an .h5."
            )
        data, sizes = _compressed(block, self._steps(block.time_ps, np.int32))
        # Checksums are of what a reader gets.
        positions, boxes = _decompressed(data, len(block), self.path, self.n_frames)
        stored: Columns = {FRAMES: positions} if block.cell_nm is None else {FRAMES: positions, CELLS: boxes}
        return data, {ENDS: self._offset(self.n_frames, self.file) + np.cumsum(sizes)}, stored


class XtcReader(CompanionReader):
    """Reads our XTC files with their companions; those of other programs MDTraj reads (`foreign_readers`). Raises
    TrajectoryError when the file is cut short or damaged."""

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        self._read_companion(top)
        end = int(self._ends[-1]) if self.n_frames else 0
        check_size(path, self.n_frames, end, completed=self.record.get("completed") is True)

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        frames = np.concatenate([x[::stride] for x, _ in self._decoded(start, stop, stride)])
        self._check_read(FRAMES, frames, slice(start, stop, stride))
        return frames

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if CELLS not in self.checksums:
            return None
        if start >= stop:
            return np.empty((0, 3, 3))
        cells = np.concatenate([boxes[::stride] for _, boxes in self._decoded(start, stop, stride)])
        self._check_read(CELLS, cells, slice(start, stop, stride))
        return cells.astype(np.float64)

    def _decoded(self, start: int, stop: int, stride: int) -> Iterator[tuple[Float32Array, Float32Array]]:
        """Yield positions and boxes of frames `start:stop`, in blocks that begin at multiples of the stride."""
        each = max(_DECODED_AT_ONCE // stride, 1) * stride
        with self.path.open("rb") as file:
            for first in range(start, stop, each):
                last = min(first + each, stop)
                begin = int(self._ends[first - 1]) if first else 0
                file.seek(begin)
                data = file.read(int(self._ends[last - 1]) - begin)
                yield _decompressed(data, last - first, self.path, first)


def _compressed(block: FrameBlock, steps: npt.NDArray[np.int32]) -> tuple[bytes, npt.NDArray[np.int64]]:
    """Return frames as an XTC file has them, and the size of each, bytes."""
    from mdtraj.formats import XTCTrajectoryFile

    boxes = None if block.cell_nm is None else np.ascontiguousarray(block.cell_nm, dtype=np.float32)
    with _scratch() as path:
        with XTCTrajectoryFile(str(path), "w") as file:
            file.write(block.positions_nm, time=block.time_ps.astype(np.float32), step=steps, box=boxes)
        data = path.read_bytes()
        with XTCTrajectoryFile(str(path)) as file:
            starts = np.asarray(file.offsets, dtype=np.int64)
    return data, np.diff(np.append(starts, len(data)))


def _decompressed(data: bytes, n_frames: int, path: Path, first: int) -> tuple[Float32Array, Float32Array]:
    """Return positions `(n_frames, n_atoms, 3)` and box vectors `(n_frames, 3, 3)` nm of frames' bytes. Raises
    TrajectoryError, which says where in `path`, when they are damaged."""
    from mdtraj.formats import XTCTrajectoryFile

    with _scratch() as copy:
        copy.write_bytes(data)
        try:
            with XTCTrajectoryFile(str(copy)) as file:
                positions, _, _, boxes = file.read()
        except Exception as error:  # MDTraj raises errors of many classes
            raise TrajectoryError(
                f"{path} is damaged in frames {first} to {first + n_frames} ({first_line(error)}); restore it from a "
                "whole copy."
            ) from error
    if len(positions) != n_frames:
        raise TrajectoryError(f"{path} is damaged at frame {first + len(positions)}; restore it from a whole copy.")
    return positions, boxes


@contextmanager
def _scratch() -> Any:
    """Make a path for MDTraj's library in C, which takes ASCII and files alone."""
    with tempfile.TemporaryDirectory(prefix="surromd-") as folder:
        yield Path(folder) / "frames.xtc"
