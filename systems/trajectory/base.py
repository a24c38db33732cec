"""What all trajectory formats share: base classes of writers and readers, and the store of per-frame columns, a record
and a scene in one HDF5 file, which HDF5 trajectories and the companions of DCD and XTC files are.

Layout: `/time` (n,) float64 ps, `/surromd/chunk_idx` (n,) int32, `/surromd/flags` (n,) uint16 where frames were
checked, `/surromd/scalars/NAME` (n,) float64, `/surromd/checksums/NAME` (n,) uint32 (`frame_checksums`),
`/surromd/record` and `/surromd/scene` JSON text with a seal; more columns as the format asks.
"""

from __future__ import annotations

import io
import json
import uuid
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NotRequired, Self, TypedDict

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, StorageError, TrajectoryError, first_line
from systems.files.outside import UNREADABLE, open_checked
from systems.files.schema import fitted, parsed
from systems.files.whole_file import (
    AtomicFile,
    Checksums,
    OutputLock,
    check_frames_read,
    checksum_rows,
    create_whole,
    frame_checksums,
    frames_digest,
    journal_path,
    refuse_existing,
    sealed,
    storage_error,
    unsealed,
)
from systems.scene import Scene

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]

_VERIFIED_AT_ONCE = 4096

Count = Annotated[int, range(2**63)]
# Also of a run that came to nothing.
Number = Annotated[float, ...]


class _Value(TypedDict):
    mean: Number
    standard_error: NotRequired[Number | None]
    target: NotRequired[Number | None]


class _Drift(TypedDict):
    kj_mol_ns_dof: Number | None
    standard_error: Number | None


class _Summary(TypedDict, total=False):
    temperature_k: _Value
    potential_kj_mol: _Value
    density_g_ml: _Value
    drift: _Drift


class _Cost(TypedDict, total=False):
    wall_s: Number


class _Deviation(TypedDict):
    what: str
    reason: str


class _Interventions(TypedDict):
    guard: str
    chunks: Count
    chunks_caught: Count
    frames: dict[str, int]
    bias: list[str]
    reasons: NotRequired[dict[str, int]]
    seconds: NotRequired[dict[str, Number]]


class Record(TypedDict, total=False):
    """The record of a trajectory as JSON has it."""

    kind: str
    completed: bool
    seed: int
    program: dict[str, str]
    platform: str
    force_field: str | None
    solvent: str | None
    temperature_k: Number | None
    hydrogen_mass_da: Number | None
    constrain_hydrogens: bool
    cost: _Cost
    summary: _Summary
    interventions: _Interventions
    precision: str
    precision_reason: str | None
    out_of_domain: list[_Deviation]


@dataclass(frozen=True, eq=False)
class FrameBlock:
    """Frames that belong together, checked: positions `(n, n_atoms, 3)` float32 nm, series `(n,)`.

    Where they are kept: velocities and forces `(n, n_atoms, 3)` float32, box vectors `(n, 3, 3)`.
    """

    positions_nm: Float32Array
    time_ps: Float64Array
    flags: npt.NDArray[np.uint16] | None
    chunk_idx: npt.NDArray[np.int32]
    scalars: dict[str, Float64Array]
    velocities_nm_ps: Float32Array | None = None
    forces_kj_mol_nm: Float32Array | None = None
    cell_nm: Float64Array | None = None

    def __len__(self) -> int:
        return len(self.time_ps)


# ---- the store ------------------------------------------------------------------------------------------------------


FORMAT_VERSION = 1
_COLUMN_CHUNK = 2048
_RECORD_BYTES = 4096
# Box vectors of each frame, where H5MD wants them.
EDGES = "particles/trajectory/box/edges/value"
CHECKSUMS = "surromd/checksums"
# Where each frame ends in an XTC file, bytes.
ENDS = "surromd/frame_ends"
# The checksum of a frame's positions, time, chunk, flags and scalars; what else there is has one of its own.
FRAMES, CELLS = "frames", "cells"
_EXTRA = ("velocities", "forces", "cell_lengths", "cell_angles", EDGES)

WEIGHTS = "surromd/weights"


def program_version() -> str:
    """Return the installed version of surromd, or `0` when it runs from a source tree."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("surromd")
    except PackageNotFoundError:
        return "0"


def json_text(value: Any, what: str) -> str:
    """Return JSON (ASCII), NumPy numbers and arrays included. Raises InputError for what JSON cannot hold."""

    def plain(item: Any) -> Any:
        if isinstance(item, np.ndarray | np.generic):
            return item.tolist()
        if isinstance(item, Path):
            return str(item)
        raise TypeError(f"{type(item).__name__} has no JSON form")

    try:
        return json.dumps(value, default=plain)
    except (TypeError, ValueError) as error:
        raise InputError(f"The {what} cannot be written as JSON: {error}.") from error


def add_column(
    file: h5py.File, name: str, n_frames: int, dtype: str, *, tail: tuple[int, ...] = (), chunk: int = _COLUMN_CHUNK
) -> h5py.Dataset:
    """Create an extendable dataset `(n_frames, *tail)`. Floats start as NaN, so that what was never written shows."""
    # No compression: measured on alanine dipeptide, gzip 1 with shuffle saves 27 % of the size and makes appends
    # 15 times and reads 4 times slower; and a chunk that keeps its place survives a crash while it is rewritten.
    return file.create_dataset(
        name, shape=(n_frames, *tail), maxshape=(None, *tail), chunks=(chunk, *tail), dtype=dtype,
        fillvalue=np.nan if dtype.startswith(("f", "<f")) else 0,
    )  # fmt: skip


def set_text(group: h5py.Group, name: str, text: str, capacity: int = 0) -> None:
    """Write ASCII text as one fixed-length string, in place where it fits: a single small write, which is atomic."""
    data = text.encode("ascii")
    if name in group and group[name].dtype.itemsize < len(data):
        del group[name]
        capacity = max(2 * len(data), capacity)
    if name not in group:
        group.create_dataset(name, shape=(), dtype=f"S{max(len(data), capacity, 1)}")
    group[name][()] = np.bytes_(data)


@contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Turn whatever HDF5 and NumPy raise on a damaged file into a TrajectoryError of one line."""
    try:
        yield
    except UNREADABLE as error:
        raise TrajectoryError(f"{path} is damaged ({first_line(error)}); restore it from a whole copy.") from error


def get_json(file: h5py.File, name: str) -> Any:
    """Return the JSON value of a text dataset. Raises KeyError or ValueError when it is missing or damaged."""
    text = file[name][()].decode("ascii")
    return parsed(unsealed(text) if CHECKSUMS in file else text)


def read_record(file: h5py.File) -> dict[str, Any]:
    """Return the record of a trajectory. Raises KeyError or ValueError when it is missing, damaged or none."""
    record: dict[str, Any] = fitted(get_json(file, "surromd/record"), Record, "record")
    return record


def create_store(
    path: Path,
    scene: Scene,
    record: dict[str, Any],
    lay_out: Callable[[h5py.File], None],
    *,
    overwrite: bool,
    run_id: str = "",
    checksums: Sequence[str] = (FRAMES,),
) -> None:
    """Create the file with all headers and no frames; it appears under its name only when it is whole.

    `lay_out` adds the format's own groups and columns, `checksums` names what each frame has one of, `run_id` says
    whose file it is. Raises TrajectoryError when it exists, InputError for a record that is not JSON, StorageError.
    """
    refuse_existing(path, overwrite)
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        group = file.create_group("surromd")
        group.attrs["format_version"] = np.int64(FORMAT_VERSION)
        # Kept as raw data, at a place that stays: by it a journal knows its file.
        group["run_id"] = np.bytes_((run_id or uuid.uuid4().hex).encode("ascii"))
        group.create_group("scalars")
        set_text(group, "record", sealed(json_text(record, "record")), _RECORD_BYTES)
        set_text(group, "scene", sealed(json_text(scene.to_dict(), "scene")))
        add_column(file, "surromd/chunk_idx", 0, "<i4")
        for name in checksums:
            add_column(file, f"{CHECKSUMS}/{name}", 0, "<u4")
        lay_out(file)
    if path.exists() and journal_path(path).exists():  # of the file that is replaced, perhaps by one of the same run
        AtomicFile(path, writable=True).close()
    create_whole(path, image.getvalue())


def open_hdf5(path: Path, source: AtomicFile | None = None) -> h5py.File:
    """Open an HDF5 file: to read, as it was before a transaction that did not end, or through `source`, to write.

    Raises TrajectoryError, in one line, when it is absent, cut short or no HDF5 file.
    """
    if not path.exists():
        raise TrajectoryError(f"{path} does not exist.")
    seen: Any = source or path
    if source is None and journal_path(path).exists():
        before = AtomicFile(path, writable=False)
        seen = before if before.is_unfinished else path
    try:
        return open_checked(path, "r" if source is None else "r+", seen)
    except (*UNREADABLE, TrajectoryError) as error:
        if source is not None and source.failure is not None:
            raise storage_error(path, source.failure, "nothing was changed") from error
        if isinstance(error, TrajectoryError):
            raise
        text = str(error)
        if "truncated" in text:
            reason = "it is cut short; restore it from a whole copy"
        elif "signature" in text:
            reason = "it is not an HDF5 file"
        else:
            reason = text.replace("\n", " ")
        raise TrajectoryError(f"{path} cannot be read: {reason}.") from error


def column_names(file: h5py.File) -> list[str]:
    """Return the names of all per-frame columns present in the file."""
    fixed = ("coordinates", "time", "particles/trajectory/position/step", "surromd/flags", "surromd/chunk_idx",
             ENDS)  # fmt: skip
    names = [name for name in fixed if name in file]
    if "surromd" in file:
        names += [name for name in _EXTRA if name in file]
    for group in ("surromd/scalars", CHECKSUMS):
        names += [f"{group}/{name}" for name in file.get(group, ())]
    return names


def consistent_length(file: h5py.File, path: Path) -> int:
    """Return the number of frames that every column holds.

    Raises TrajectoryError where they differ, and for blocks of data that are missing.
    """
    columns = {name: file[name] for name in column_names(file)}
    lengths = {name: int(column.shape[0]) for name, column in columns.items()}
    n_frames = min(lengths.values())
    if max(lengths.values()) > n_frames:
        listed = ", ".join(f"/{name} {n}" for name, n in lengths.items())
        raise TrajectoryError(f"{path} is damaged: its columns differ in length ({listed} frames).")
    for name, column in columns.items():
        if column.chunks and "surromd" in file and column.id.get_num_chunks() < -(-n_frames // column.chunks[0]):
            raise TrajectoryError(f"{path} is damaged: blocks of /{name} are missing.")
    return n_frames


def _columns_with_frames(
    time_ps: Float64Array,
    chunk_idx: npt.NDArray[np.int32],
    flags: npt.NDArray[np.uint16] | None,
    scalars: Mapping[str, Float64Array],
) -> dict[str, npt.NDArray[Any]]:
    """Return the columns `(n,)` that have one checksum with the positions."""
    given: dict[str, npt.NDArray[Any]] = {"time": time_ps, "chunk_idx": chunk_idx}
    given |= {f"scalars/{name}": values for name, values in scalars.items()}
    return given if flags is None else given | {"flags": flags}


def read_run_id(file: h5py.File) -> str:
    """Return the number of the run that wrote a file; nothing of other programs and earlier versions."""
    return file["surromd/run_id"][()].decode("ascii") if "surromd/run_id" in file else ""


class FrameStore:
    """Appends to a file made by `create_store`, one transaction per append.

    Raises TrajectoryError when the file is damaged or not ours (this version's), StorageError.
    """

    def __init__(self, path: Path) -> None:
        self.path = self._file_path = path
        open_hdf5(path).close()
        self._atomic = AtomicFile(path, writable=True)
        self._columns: dict[str, h5py.Dataset] = {}
        try:
            self.file = open_hdf5(path, self._atomic)
        except BaseException:
            self._atomic.close()
            raise
        # At exit too: HDF5 must not call into a file object that the interpreter has already taken apart.
        self._close = weakref.finalize(self, _close, self.file, self._atomic)
        try:
            with damage_reported(path):
                self._read_headers()
        except BaseException as error:
            self._close()
            if self._atomic.failure is not None:
                raise storage_error(path, self._atomic.failure, "nothing was changed") from error
            raise

    def _read_headers(self) -> None:
        if not (self.file.get("surromd") and read_run_id(self.file)):
            raise TrajectoryError(f"{self.path} was not written by surromd and cannot be continued; take another name.")
        self.run_id, run_id = read_run_id(self.file), self.file["surromd/run_id"]
        self._atomic.key = (run_id.id.get_offset(), run_id.dtype.itemsize)
        self.scene = Scene.from_dict(get_json(self.file, "surromd/scene"))
        self.record = read_record(self.file)
        self.n_frames = consistent_length(self.file, self.path)
        self._columns.update({name: self.file[name] for name in column_names(self.file)})
        if not {"time", "surromd/chunk_idx"} <= set(self._columns):
            raise TrajectoryError(f"{self.path} is damaged: it lacks columns.")
        self._look_again()

    def _look_again(self) -> None:
        self._digest = frames_digest({name: c[:] for name, c in self._columns.items() if name.startswith(CHECKSUMS)})
        self.last_time_ps = float(self._columns["time"][self.n_frames - 1]) if self.n_frames else None

    def digest(self) -> str:
        """Return the hash of all frames written so far, as `frames_digest` makes it of their checksums."""
        return self._digest.hexdigest()

    @contextmanager
    def _open(self) -> Iterator[None]:
        """Close the store where the file cannot be read, whatever HDF5 makes of it. Raises InputError, StorageError."""
        if not self.file:
            raise InputError(f"{self.path} is closed; open it again with append=True.")
        try:
            yield
        except BaseException as error:
            if self._atomic.failure is not None and not isinstance(error, StorageError):
                raise self.failed(self._atomic.failure) from error
            raise
        if self._atomic.failure is not None:
            raise self.failed(self._atomic.failure)

    def first_times_ps(self) -> Float64Array:
        """Return the times of the first two frames (fewer when there are fewer)."""
        times: Float64Array = self._columns["time"][: min(self.n_frames, 2)]
        return times

    def series(self) -> tuple[Float64Array, dict[str, Float64Array]]:
        """Return the times `(n_frames,)` ps and the scalars by name of all frames written so far."""
        with self._open():
            scalars = {name.rpartition("/")[2]: c[:] for name, c in self._columns.items() if "/scalars/" in name}
            return self._columns["time"][:], scalars

    def _store(
        self, block: FrameBlock, columns: dict[str, npt.NDArray[Any]], stored: Mapping[str, npt.NDArray[Any]]
    ) -> None:
        """Append a block and the format's own `columns` (by dataset name). Raises InputError, StorageError.

        `stored`: what has a checksum, as it is on disk: positions `(n, n_atoms, 3)` as FRAMES, and more by name.
        """
        with self._open():
            n, start = len(block), self.n_frames
            self._check_flags(block)
            self._need_columns(block)
            values: dict[str, Any] = {"time": block.time_ps, "surromd/chunk_idx": block.chunk_idx, **columns}
            if block.flags is not None:
                values["surromd/flags"] = block.flags
            for name, array in stored.items():
                more = _columns_with_frames(block.time_ps, block.chunk_idx, block.flags, block.scalars)
                values[f"{CHECKSUMS}/{name}"] = frame_checksums({name: array} | (more if name == FRAMES else {}))
            for name, column in self._columns.items():
                column.resize(start + n, axis=0)
                if name in values:
                    column[start:] = values[name]
                else:  # a scalar that this append does not give stays NaN
                    column[start:] = block.scalars.get(name.rpartition("/")[2], np.full(n, np.nan))
            self._commit()
            self.n_frames, self.last_time_ps = start + n, float(block.time_ps[-1])
            self._digest.update(checksum_rows({name: values[name] for name in values if name.startswith(CHECKSUMS)}))

    def _need_columns(self, block: FrameBlock) -> None:
        """Make the columns that a block brings."""
        if not self.n_frames and block.flags is None and self._columns.pop("surromd/flags", None) is not None:
            del self.file["surromd/flags"]
        wanted = {f"surromd/scalars/{name}": "<f8" for name in block.scalars}
        if block.flags is not None:
            wanted["surromd/flags"] = "<u2"
        for name in wanted.keys() - self._columns.keys():
            self._columns[name] = add_column(self.file, name, self.n_frames, wanted[name])

    def _check_flags(self, block: FrameBlock) -> None:
        """Raise InputError when this block has flags and the frames before have none, or the reverse."""
        have = "surromd/flags" in self._columns
        if self.n_frames and have != (block.flags is not None):
            state = "with" if have else "without"
            raise InputError(f"{self.path}: earlier frames were written {state} flags; flag all frames or none.")

    def truncate(self, n_frames: int) -> None:
        """Cut the file to its first `n_frames` frames, to resume from there. Raises InputError, StorageError."""
        with self._open():
            if not 0 <= n_frames <= self.n_frames:
                raise InputError(f"{self.path} holds {self.n_frames} frames and cannot be cut to {n_frames}.")
            if n_frames == self.n_frames:
                return
            for column in self._columns.values():
                column.resize(n_frames, axis=0)
            if n_frames == 0 and self._columns.pop("surromd/flags", None) is not None:
                del self.file["surromd/flags"]
            self._commit()
            self.n_frames = n_frames
            self._look_again()

    def update_record(self, entries: dict[str, Any]) -> None:
        """Merge JSON-able `entries` into the record (top-level keys are replaced). Raises InputError, StorageError."""
        with self._open():
            merged = {**self.record, **entries}
            set_text(self.file["surromd"], "record", sealed(json_text(merged, "record")))
            self._commit()
            self.record = merged

    def write_weights(self, weights: Float64Array) -> None:
        """Write, or replace, a weight for every frame. Raises InputError for another number of them, StorageError."""
        if weights.shape != (self.n_frames,):
            raise InputError(f"{self.path} holds {self.n_frames} frames; weights of shape {weights.shape} do not fit.")
        with self._open():
            if WEIGHTS in self.file:
                del self.file[WEIGHTS]
            self.file.create_dataset(WEIGHTS, data=weights, dtype="<f8")
            self._commit()

    def _commit(self) -> None:
        self.file.flush()
        try:
            self._atomic.commit()
        except OSError as error:
            raise self.failed(error) from error

    def failed(self, error: OSError) -> StorageError:
        """Close the store after a failed write and return the error to raise."""
        self._close()
        kept = f"the {self.n_frames} frames written before are complete and readable"
        return storage_error(self._file_path, error, kept)

    def close(self) -> None:
        """Close the file; twice does no harm. What is not committed is dropped."""
        self._close()


def _close(file: h5py.File, atomic: AtomicFile) -> None:
    atomic.abandon()
    file.close()
    atomic.close()


# ---- writers and readers --------------------------------------------------------------------------------------------


class TrajectoryWriter(FrameStore, ABC):
    """Appends frames to one file. Each `append` is whole on disk, or not there at all, when it returns or raises."""

    lock: OutputLock | None = None

    def __init__(self, path: Path, store: Path, scene: Scene, record: dict[str, Any], *, append: bool) -> None:
        super().__init__(store)
        try:
            self.path = path
            check_same_topology(path, self.scene, scene)
            self.scene = scene
            self._adopt()
            new = {key: value for key, value in record.items() if key not in self.record}
            if append and new:
                self.update_record(new)
        except BaseException:
            self.close()
            raise

    @abstractmethod
    def _adopt(self) -> None:
        """Learn how the file is laid out. Raises TrajectoryError where it is not ours, or lacks recorded frames."""

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
        `chunk_idx` is the surrogate's chunk they came from, one number or `(n,)` (-1: none); `scalars` are further
        `(n,)` series by name, NaN where not given. Velocities nm/ps and forces kJ/mol/nm, shaped as the positions, come
        with every frame of a file that was opened for them; `cell_nm` `(n, 3, 3)`: box vectors (the scene's own where
        not given). Raises InputError for frames that do not fit the scene, the times or what was appended before;
        StorageError when the disk is full: what was complete stays readable, the writer is closed.
        """
        block = self._checked(positions_nm, time_ps, flags, chunk_idx, scalars or {})
        n, shape = len(block), block.positions_nm.shape
        frames: dict[str, Any] = {"velocities_nm_ps": velocities_nm_ps, "forces_kj_mol_nm": forces_kj_mol_nm}
        for name, values in frames.items():
            frames[name] = None if values is None else np.ascontiguousarray(values, dtype=np.float32)
            if values is not None and frames[name].shape != shape:
                what = name.partition("_")[0]
                raise InputError(f"{self.path}: {what} have shape {frames[name].shape}, positions {shape}.")
        cells = None if cell_nm is None else np.asarray(cell_nm, dtype=np.float64)
        if cells is not None and (
            cells.shape != (n, 3, 3) or not np.isfinite(cells).all() or (np.linalg.det(cells) <= 0).any()
        ):
            raise InputError(f"{self.path}: cells must be box vectors ({n}, 3, 3) with a volume, not {cells.shape}.")
        if n:
            self._append(replace(block, **frames, cell_nm=cells))

    @abstractmethod
    def _append(self, block: FrameBlock) -> None: ...

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

    def close(self) -> None:
        super().close()
        if self.lock is not None:
            self.lock.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class TrajectoryReader(ABC):
    """Reads one file. `flags` and `chunk_idx` are None, `record` is empty, where the file does not say.

    `times_known` is False where the file holds no times: `time_ps` then only counts frames. `run_id`: of the run that
    wrote the file; `checksums`: of its frames `(n_frames,)`. `notes`: what was assumed or left out, for people.
    `grid_nm`: what coordinates are rounded to, where the file states it.
    """

    path: Path
    n_frames: int
    n_atoms: int
    time_ps: Float64Array
    scene: Scene | None = None
    record: dict[str, Any]
    flags: npt.NDArray[np.uint16] | None = None
    chunk_idx: npt.NDArray[np.int32] | None = None
    scalars: dict[str, Float64Array]
    times_known: bool = True
    notes: tuple[str, ...] = ()
    run_id: str = ""
    checksums: Mapping[str, Checksums] = MappingProxyType({})
    grid_nm: float | None = None
    _closed: bool = False

    def __init__(self, path: Path) -> None:
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.path, self.record, self.scalars = path, {}, {}

    def _read_stored(self, file: h5py.File, path: Path) -> None:
        """Take all that a file of `FrameStore` at `path` says of the trajectory. Raises TrajectoryError."""
        self.n_frames = consistent_length(file, path)
        if "surromd" in file or "time" in file:
            self.time_ps = file["time"][: self.n_frames].astype(np.float64)
            if not np.isfinite(self.time_ps).all():
                raise TrajectoryError(f"{path} is damaged: some frames have no time.")
        else:
            self.time_ps = np.arange(self.n_frames, dtype=np.float64)
        if "surromd" not in file:
            return
        own = file["surromd"]
        self.flags = own["flags"][: self.n_frames] if "flags" in own else None
        self.chunk_idx = own["chunk_idx"][: self.n_frames] if "chunk_idx" in own else None
        self.scalars = {name: own["scalars"][name][: self.n_frames] for name in own.get("scalars", ())}
        self.checksums = {name: column[: self.n_frames] for name, column in file.get(CHECKSUMS, {}).items()}
        self.run_id, self.record = read_run_id(file), read_record(file)
        self.scene = Scene.from_dict(get_json(file, "surromd/scene"))

    def _scene_of(self, top: Path | None) -> Scene | None:
        """Return the scene of `top`, where there is one. Raises InputError where it does not fit the file."""
        if top is None:
            return None
        from systems.trajectory.foreign_scenes import scene_from_structure

        scene = scene_from_structure(top, name=self.path.stem)
        if scene.n_atoms != self.n_atoms:
            raise InputError(f"{top} has {scene.n_atoms} atoms, {self.path} has {self.n_atoms}; give the matching one.")
        return scene

    def _at_first_frame(self, scene: Scene) -> Scene:
        """Return the scene at the positions of the first frame, where there is one."""
        return scene.with_positions(self._read(0, 1, 1)[0]) if self.n_frames else scene

    def _check_read(self, name: str, stored: npt.NDArray[Any], frames: slice) -> None:
        """Raise TrajectoryError unless what was read of `frames`, as it is on disk, is what was written.

        With positions (FRAMES) go what the reader holds of the same frames: times, chunks, flags, scalars.
        """
        if name not in self.checksums or not len(stored):
            return
        columns = {name: stored}
        if name == FRAMES and self.chunk_idx is not None:
            flags = None if self.flags is None else self.flags[frames]
            scalars = {key: values[frames] for key, values in self.scalars.items()}
            columns |= _columns_with_frames(self.time_ps[frames], self.chunk_idx[frames], flags, scalars)
        found = frame_checksums(columns)
        check_frames_read(self.path, self.checksums[name][frames], found, frames.start, frames.step)

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
        if self._closed:
            raise InputError(f"{self.path} is closed.")
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

    def close(self) -> None:
        """Close the file; twice does no harm."""
        self._closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def unused_top_note(top: Path | None) -> str:
    """Return the line on a topology that was given and is not needed."""
    return f"{top} is not used: the file holds its own topology."


def check_same_topology(path: Path, stored: Scene, scene: Scene) -> None:
    """Raise TrajectoryError unless both scenes have the same ordered topology."""
    if stored.topology_hash != scene.topology_hash:
        raise TrajectoryError(
            f"{path} holds {stored.name!r} ({stored.n_atoms} atoms, topology {stored.topology_hash}), which is not "
            f"{scene.name!r} ({scene.n_atoms} atoms, topology {scene.topology_hash}); choose another file."
        )
