"""Base classes of trajectory writers and readers, and the checks that all formats share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import Checksums, OutputLock, frames_digest
from systems.scene import Scene
from systems.trajectory.frame_store import Float32Array, Float64Array, FrameBlock, FrameStore

_VERIFIED_AT_ONCE = 4096


class TrajectoryWriter(ABC):
    """Appends frames to one file. Each `append` is whole on disk, or not there at all, when it returns or raises."""

    path: Path
    scene: Scene
    n_frames: int
    last_time_ps: float | None
    lock: OutputLock | None = None
    _store: FrameStore

    @property
    def run_id(self) -> str:
        """The number of the run whose file this is."""
        return self._store.run_id

    def digest(self) -> str:
        """Return the hash of all frames written so far."""
        return self._store.digest()

    @property
    def record(self) -> dict[str, Any]:
        """What the file says of its frames."""
        return self._store.record

    def append(
        self,
        positions_nm: npt.ArrayLike,
        time_ps: npt.ArrayLike,
        *,
        flags: npt.ArrayLike | None = None,
        chunk_idx: int | npt.ArrayLike | None = -1,
        scalars: Mapping[str, npt.ArrayLike] | None = None,
        velocities_nm_ps: npt.ArrayLike | None = None,
        forces_kj_mol_nm: npt.ArrayLike | None = None,
        cell_nm: npt.ArrayLike | None = None,
    ) -> None:
        """Append frames `(n, n_atoms, 3)` nm at times `(n,)` ps, later than all before, and flush them to disk.

        `flags` `(n,)` are validity bits (systems.chemistry.validity), given for all frames of a file or for none;
        `chunk_idx` is the surrogate's chunk these frames came from, one number or `(n,)` (-1: none); `scalars` are
        further `(n,)` series by name, NaN in frames where they are not given. Velocities nm/ps and forces kJ/mol/nm,
        shaped as the positions, come with every frame of a file that was opened for them; `cell_nm` `(n, 3, 3)` holds
        the box vectors of a periodic scene (its own where not given). Raises InputError for frames that do not fit the
        scene, the times or what was appended before; StorageError when the disk is full (what was complete stays
        readable, the writer is then closed to further frames).
        """
        block = self._checked(positions_nm, time_ps, flags, chunk_idx, scalars or {})
        block = replace(
            block,
            velocities_nm_ps=self._as_frames("velocities", velocities_nm_ps, block),
            forces_kj_mol_nm=self._as_frames("forces", forces_kj_mol_nm, block),
            cell_nm=self._as_cells(cell_nm, block),
        )
        if len(block):
            self._append(block)
            self.n_frames += len(block)
            self.last_time_ps = float(block.time_ps[-1])

    def _as_frames(self, what: str, values: npt.ArrayLike | None, block: FrameBlock) -> Float32Array | None:
        if values is None:
            return None
        frames = np.ascontiguousarray(values, dtype=np.float32)
        if frames.shape != block.positions_nm.shape:
            raise InputError(f"{self.path}: {what} have shape {frames.shape}, positions {block.positions_nm.shape}.")
        return frames

    def _as_cells(self, values: npt.ArrayLike | None, block: FrameBlock) -> Float64Array | None:
        if values is None:
            return None
        cells = np.asarray(values, dtype=np.float64)
        if cells.shape != (len(block), 3, 3) or not (np.isfinite(cells).all() and (np.linalg.det(cells) > 0).all()):
            raise InputError(
                f"{self.path}: cells must be box vectors ({len(block)}, 3, 3) with a volume, not {cells.shape}."
            )
        return cells

    @abstractmethod
    def _append(self, block: FrameBlock) -> None: ...

    @abstractmethod
    def truncate(self, n_frames: int) -> None:
        """Cut the file to its first `n_frames` frames, to resume from there. Raises InputError, StorageError."""

    def series(self) -> tuple[Float64Array, dict[str, Float64Array]]:
        """Return the times `(n_frames,)` ps and the scalars by name of all frames written so far."""
        self._refuse_closed()
        return self._store.series()

    def update_record(self, entries: dict[str, Any]) -> None:
        """Merge JSON-able `entries` into the record (top-level keys are replaced). Raises InputError, StorageError."""
        self._refuse_closed()
        self._store.update_record(entries)

    def _refuse_closed(self) -> None:
        if not self._store.file:
            raise InputError(f"{self.path} is closed; open it again with append=True.")

    def close(self) -> None:
        """Close the file; twice does no harm."""
        self._store.close()
        if self.lock is not None:
            self.lock.close()

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        self.close()

    def _checked(
        self,
        positions_nm: npt.ArrayLike,
        time_ps: npt.ArrayLike,
        flags: npt.ArrayLike | None,
        chunk_idx: int | npt.ArrayLike | None,
        scalars: Mapping[str, npt.ArrayLike],
    ) -> FrameBlock:
        where = f"{self.path}, after frame {self.n_frames}"
        positions = np.ascontiguousarray(positions_nm, dtype=np.float32)
        times = np.atleast_1d(np.asarray(time_ps, dtype=np.float64))
        n = len(times)
        if positions.shape != (n, self.scene.n_atoms, 3) or times.ndim != 1:
            raise InputError(
                f"{where}: positions have shape {positions.shape} and times {times.shape}; "
                f"expected (n, {self.scene.n_atoms}, 3) and (n,)."
            )
        before = [] if self.last_time_ps is None else [self.last_time_ps]
        if not np.isfinite(times).all() or (np.diff(np.concatenate([before, times])) <= 0).any():
            raise InputError(f"{where}: times must be finite and increase from frame to frame.")
        if flags is not None:
            flags = np.asarray(flags)
            if flags.shape != (n,) or flags.dtype.kind not in "ui":
                raise InputError(f"{where}: flags must be {n} integers, not {flags.dtype} of shape {flags.shape}.")
        series = {name: np.asarray(values, dtype=np.float64) for name, values in scalars.items()}
        for name, values in series.items():
            if values.shape != (n,) or "/" in name or not name:
                raise InputError(f"{where}: scalar {name!r} must have shape ({n},) and no slash in its name.")
        chunk = np.asarray(-1 if chunk_idx is None else chunk_idx)
        if chunk.shape not in ((), (n,)) or chunk.dtype.kind not in "ui":
            raise InputError(f"{where}: chunk_idx must be one integer or {n}, not {chunk.dtype} of {chunk.shape}.")
        chunk = np.broadcast_to(chunk, (n,)).astype(np.int32)
        return FrameBlock(positions, times, None if flags is None else flags.astype(np.uint16), chunk, series)


class TrajectoryReader(ABC):
    """Reads one file. `flags` and `chunk_idx` are None, `record` is empty, where the file does not say.

    `times_known` is False where the format or the file holds no times: `time_ps` then only counts frames. `run_id` is
    the number of the run that wrote the file, and `checksums` are those of its frames `(n_frames,)`, where it has them.
    `notes`: sentences on what was assumed or left out, for people. `grid_nm`: what coordinates are rounded to as the
    file states it, None where it does not say.
    """

    path: Path
    scene: Scene | None
    record: dict[str, Any]
    n_frames: int
    n_atoms: int
    time_ps: Float64Array
    flags: npt.NDArray[np.uint16] | None
    chunk_idx: npt.NDArray[np.int32] | None
    scalars: dict[str, Float64Array]
    times_known: bool = True
    notes: tuple[str, ...] = ()
    run_id: str = ""
    checksums: Mapping[str, Checksums] = MappingProxyType({})
    grid_nm: float | None = None

    def read(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Float32Array:
        """Return positions `(n, n_atoms, 3)` float32 nm of frames `start:stop:stride` (negative counts from the end).

        Raises InputError for a stride below 1, TrajectoryError when the frames cannot be read.
        """
        first, last, step = self._span(start, stop, stride)
        if first >= last:
            return np.empty((0, self.n_atoms, 3), dtype=np.float32)
        return self._read(first, last, step)

    def verify(self, n_frames: int) -> None:
        """Read all that is kept of the first frames. Raises TrajectoryError when it is not what was written."""
        for start in range(0, n_frames, _VERIFIED_AT_ONCE):
            stop = min(start + _VERIFIED_AT_ONCE, n_frames)
            for read in (self.read, self.read_velocities, self.read_forces, self.read_cells):
                read(start, stop)

    def digest(self, n_frames: int) -> str:
        """Return the hash that the writer of the first frames had of them (`TrajectoryWriter.digest`)."""
        return frames_digest({name: values[:n_frames] for name, values in self.checksums.items()}).hexdigest()

    def read_velocities(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Float32Array | None:
        """Return velocities `(n, n_atoms, 3)` nm/ps, None when the file holds none. Frames and errors as in `read`."""
        return self._read_extra("velocities", *self._span(start, stop, stride))

    def read_forces(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Float32Array | None:
        """Return forces `(n, n_atoms, 3)` kJ/mol/nm, None when the file holds none. Frames and errors as in `read`."""
        return self._read_extra("forces", *self._span(start, stop, stride))

    def read_cells(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Float64Array | None:
        """Return box vectors `(n, 3, 3)` nm, None when the file is not periodic. Frames and errors as in `read`."""
        return self._read_cells(*self._span(start, stop, stride))

    def _span(self, start: int, stop: int | None, stride: int) -> tuple[int, int, int]:
        if stride < 1:
            raise InputError(f"{self.path}: stride must be at least 1, not {stride}.")
        first, last, step = slice(start, stop, stride).indices(self.n_frames)
        return first, max(first, last), step

    @abstractmethod
    def _read(self, start: int, stop: int, stride: int) -> Float32Array: ...

    def _read_extra(self, name: str, start: int, stop: int, stride: int) -> Float32Array | None:
        return None

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        return None

    def iter_blocks(self, n_frames_per_block: int = 4096) -> Iterator[Float32Array]:
        """Yield positions in consecutive blocks of at most `n_frames_per_block` frames."""
        if n_frames_per_block < 1:
            raise InputError(f"{self.path}: a block must hold at least one frame, not {n_frames_per_block}.")
        for start in range(0, self.n_frames, n_frames_per_block):
            yield self.read(start, start + n_frames_per_block)

    @abstractmethod
    def close(self) -> None:
        """Close the file; twice does no harm."""

    def __enter__(self) -> TrajectoryReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        self.close()


def unused_top_note(top: Path) -> str:
    """Return the line on a topology that was given and is not needed."""
    return f"{top} is not used: the file holds its own topology."


def check_same_topology(path: Path, stored: Scene, scene: Scene) -> None:
    """Raise TrajectoryError unless both scenes have the same ordered topology."""
    if stored.topology_hash != scene.topology_hash:
        raise TrajectoryError(
            f"{path} holds {stored.name!r} ({stored.n_atoms} atoms, topology {stored.topology_hash}), which is not "
            f"{scene.name!r} ({scene.n_atoms} atoms, topology {scene.topology_hash}); choose another file."
        )
