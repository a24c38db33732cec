"""XTC trajectories (GROMACS' compressed format) with a PDB and a record beside them, as DCD files have.

`NAME.xtc` holds positions in nm to three decimals and times as float32. Frames are compressed and read by MDTraj. No
library appends to a file whose last frame is cut short, or cuts one to a number of frames: where each frame ends stands
in `NAME.meta.h5`, so that a run goes on behind the last whole one.
"""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError, first_line
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, unused_top_note
from systems.trajectory.companion_writer import CompanionWriter, companions
from systems.trajectory.frame_store import (
    CELLS,
    ENDS,
    FRAMES,
    Float32Array,
    Float64Array,
    FrameBlock,
    add_column,
    consistent_length,
    damage_reported,
    get_json,
    open_hdf5,
    read_record,
    read_run_id,
)
from systems.trajectory.hdf5_file import check_read, read_checksums, read_columns

# Three decimals in 32-bit integers.
_MOST_NM = 2.0e6
_DECODED_AT_ONCE = 4096


class XtcWriter(CompanionWriter):
    """Writes an XTC and its companions; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    _ends: npt.NDArray[np.int64]

    def _lay_out(self, file: h5py.File) -> None:
        add_column(file, "time", 0, "<f8")
        add_column(file, ENDS, 0, "<i8")

    def _head(self) -> bytes:
        return b""

    def _adopt(self) -> None:
        if ENDS not in self._store.file:
            raise TrajectoryError(f"{self._meta} is not the record of {self.path.name}; choose another name.")
        self._ends = self._store.file[ENDS][: self._store.n_frames]
        _check_size(self.path, self._ends, completed=False)

    def _offset(self, n_frames: int) -> int:
        return int(self._ends[n_frames - 1]) if n_frames else 0

    def _encoded(self, block: FrameBlock) -> tuple[bytes, dict[str, npt.NDArray[Any]], dict[str, npt.NDArray[Any]]]:
        beyond = ~(np.abs(block.positions_nm) < _MOST_NM).all(axis=(1, 2))
        if beyond.any():
            raise InputError(
                f"{self.path}: frame {self.n_frames + int(np.argmax(beyond))} has positions that are not finite or too "
                "large for an XTC; write an .h5."
            )
        cells = None
        if self.scene.cell_nm is not None:
            own = np.broadcast_to(np.asarray(self.scene.cell_nm, dtype=np.float64), (len(block), 3, 3))
            cells = own if block.cell_nm is None else block.cell_nm
        data, sizes = _compressed(block.positions_nm, block.time_ps, self._steps(block.time_ps), cells)
        # Checksums are of what a reader gets.
        positions, boxes = _decompressed(data, len(block), self.path, self.n_frames)
        stored: dict[str, npt.NDArray[Any]] = {FRAMES: positions}
        if cells is not None:
            stored[CELLS] = boxes
        return data, {ENDS: self._offset(self.n_frames) + np.cumsum(sizes)}, stored

    def _steps(self, time_ps: Float64Array) -> npt.NDArray[np.int32]:
        """Return the steps `(n,)` that go with times: of the integrator where the record states it, else frames."""
        timestep = self._store.record.get("timestep_ps")
        if isinstance(timestep, int | float) and timestep > 0 and time_ps[-1] / timestep < 2**31 - 1:
            return np.rint(time_ps / timestep).astype(np.int32)
        return np.arange(self.n_frames, self.n_frames + len(time_ps), dtype=np.int32)

    def _written(self, block: FrameBlock, columns: dict[str, npt.NDArray[Any]]) -> None:
        self._ends = np.concatenate([self._ends[: self.n_frames], columns[ENDS]])

    def _forgotten(self, n_frames: int) -> None:
        self._ends = self._ends[:n_frames]


class XtcReader(TrajectoryReader):
    """Reads our XTC files with their companions; those of other programs MDTraj reads (`foreign_readers`).

    Raises TrajectoryError when the file is cut short or damaged, InputError when `top` does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path, self._closed = path, False
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        meta = companions(path)[1]
        with open_hdf5(meta) as file, damage_reported(meta):
            self.n_frames = consistent_length(file, meta)
            self.time_ps, self.flags, self.chunk_idx, self.scalars = read_columns(file, meta, self.n_frames)
            self.checksums, self.run_id = read_checksums(file, self.n_frames), read_run_id(file)
            self.record = read_record(file)
            self.scene = Scene.from_dict(get_json(file, "surromd/scene"))
            self._ends = file[ENDS][: self.n_frames]
        self.n_atoms = self.scene.n_atoms
        _check_size(path, self._ends, completed=self.record.get("completed") is True)
        if top is not None:
            from systems.trajectory.foreign_scenes import scene_from_structure

            if scene_from_structure(top, name=path.stem).n_atoms != self.n_atoms:
                raise InputError(
                    f"{top} does not have the {self.n_atoms} atoms of {path}; give the matching structure."
                )
            self.notes = (unused_top_note(top),)
        if self.n_frames and not self.scene.positions_nm.any():
            self.scene = self.scene.with_positions(self._read(0, 1, 1)[0])

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        frames = np.concatenate([x[::stride] for x, _ in self._decoded(start, stop, stride)])
        check_read(self, FRAMES, frames, slice(start, stop, stride))
        return frames

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if CELLS not in self.checksums:
            return None
        if start >= stop:
            return np.empty((0, 3, 3))
        cells = np.concatenate([boxes[::stride] for _, boxes in self._decoded(start, stop, stride)])
        check_read(self, CELLS, cells, slice(start, stop, stride))
        return cells.astype(np.float64)

    def _decoded(self, start: int, stop: int, stride: int) -> list[tuple[Float32Array, Float32Array]]:
        """Return positions and boxes of frames `start:stop`, in blocks that begin at multiples of the stride."""
        if self._closed:
            raise InputError(f"{self.path} is closed.")
        blocks = []
        each = max(_DECODED_AT_ONCE // stride, 1) * stride
        with self.path.open("rb") as file:
            for first in range(start, stop, each):
                last = min(first + each, stop)
                begin = int(self._ends[first - 1]) if first else 0
                file.seek(begin)
                data = file.read(int(self._ends[last - 1]) - begin)
                blocks.append(_decompressed(data, last - first, self.path, first))
        return blocks

    def close(self) -> None:
        self._closed = True


def is_ours(path: Path) -> bool:
    """Whether `NAME.meta.h5` beside an XTC is the record of it. Raises TrajectoryError where that cannot be read."""
    meta = companions(path)[1]
    if not meta.exists():
        return False
    with open_hdf5(meta) as file:
        return ENDS in file


def _check_size(path: Path, ends: npt.NDArray[np.int64], *, completed: bool) -> None:
    """Raise TrajectoryError unless the XTC holds the recorded frames; behind them a run may have some in flight."""
    end, size = (int(ends[-1]) if len(ends) else 0), path.stat().st_size
    if size < end or (size > end and completed):
        raise TrajectoryError(
            f"{path} has {size} bytes where {companions(path)[1].name} records {len(ends)} frames of {end}: one of "
            "them is cut short or replaced; restore both from one copy."
        )


def _compressed(
    positions_nm: Float32Array, time_ps: Float64Array, steps: npt.NDArray[np.int32], cells_nm: npt.ArrayLike | None
) -> tuple[bytes, npt.NDArray[np.int64]]:
    """Return frames as an XTC file has them, and the size of each, bytes."""
    from mdtraj.formats import XTCTrajectoryFile

    boxes = None if cells_nm is None else np.ascontiguousarray(cells_nm, dtype=np.float32)
    with _scratch() as path:
        with XTCTrajectoryFile(str(path), "w") as file:
            file.write(np.ascontiguousarray(positions_nm), time=time_ps.astype(np.float32), step=steps, box=boxes)
        data = path.read_bytes()
        with XTCTrajectoryFile(str(path)) as file:
            starts = np.asarray(file.offsets, dtype=np.int64)
    return data, np.diff(np.append(starts, len(data)))


def _decompressed(data: bytes, n_frames: int, path: Path, first: int) -> tuple[Float32Array, Float32Array]:
    """Return positions `(n_frames, n_atoms, 3)` and box vectors `(n_frames, 3, 3)` nm of frames' bytes.

    Raises TrajectoryError, which says where in `path`, when they are damaged.
    """
    from mdtraj.formats import XTCTrajectoryFile

    with _scratch() as copy:
        copy.write_bytes(data)
        try:
            with XTCTrajectoryFile(str(copy)) as file:
                positions, _, _, boxes = file.read()
        except Exception as error:  # MDTraj raises several kinds
            raise TrajectoryError(
                f"{path} is damaged in frames {first} to {first + n_frames} ({first_line(error)}); restore it from a "
                "whole copy."
            ) from error
    if len(positions) != n_frames:
        raise TrajectoryError(f"{path} is damaged at frame {first + len(positions)}; restore it from a whole copy.")
    return positions, boxes


@contextlib.contextmanager
def _scratch() -> Any:
    """Make a path for MDTraj's library in C, which takes ASCII and files alone."""
    with tempfile.TemporaryDirectory(prefix="surromd-") as folder:
        yield Path(folder) / "frames.xtc"
