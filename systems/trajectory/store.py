"""Per-frame columns, a record and a scene in one HDF5 file: what HDF5 trajectories and the companions of DCD and XTC
files are.

Layout: `/time` (n,) float64 ps, `/surromd/chunk_idx` (n,) int32, `/surromd/flags` (n,) uint16 where frames were
checked, `/surromd/scalars/NAME` (n,) float64, `/surromd/checksums/NAME` (n,) uint32 (`frame_checksums`),
`/surromd/record` and `/surromd/scene` JSON text with a seal; more columns as the format asks.
"""

from __future__ import annotations

import hashlib
import io
import json
import uuid
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, StorageError, TrajectoryError, first_line
from systems.files.outside import UNREADABLE, open_checked
from systems.files.schema import fitted, parsed
from systems.files.whole_file import (
    AtomicFile,
    Closing,
    checksum_rows,
    create_whole,
    frame_checksums,
    journal_path,
    refuse_existing,
    sealed,
    storage_error,
    unsealed,
)
from systems.scene import Scene

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
Columns = dict[str, npt.NDArray[Any]]

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
    """Frames that belong together, checked: positions `(n, n_atoms, 3)` nm, series `(n,)`. Where they are kept:
    `per_atom` velocities and forces `(n, n_atoms, 3)` by name, box vectors `(n, 3, 3)` nm."""

    positions_nm: Float32Array
    time_ps: Float64Array
    flags: npt.NDArray[np.uint16] | None
    chunk_idx: npt.NDArray[np.int32]
    scalars: dict[str, Float64Array]
    per_atom: dict[str, Float32Array]
    cell_nm: Float64Array | None

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
PER_ATOM = ("velocities", "forces")
WEIGHTS = "surromd/weights"
_STRIDED_READ_FRAMES = 8192


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
    lay_out: Callable[[h5py.File, Scene, Sequence[str]], None],
    columns: Sequence[str],
    *,
    overwrite: bool,
    run_id: str = "",
) -> None:
    """Create the file with all headers and no frames; it appears under its name only when it is whole. `lay_out` adds
    the format's own groups and columns, `columns` names velocities and forces where frames have them, `run_id` says
    whose file it is. Raises TrajectoryError when it exists, InputError for a record that is not JSON, StorageError."""
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
        add_column(file, "time", 0, "<f8")
        add_column(file, "surromd/chunk_idx", 0, "<i4")
        for name in (FRAMES, *columns, *([] if scene.cell_nm is None else [CELLS])):
            add_column(file, f"{CHECKSUMS}/{name}", 0, "<u4")
        lay_out(file, scene, columns)
    if path.exists() and journal_path(path).exists():  # of the file that is replaced, perhaps by one of the same run
        AtomicFile(path, writable=True).close()
    create_whole(path, image.getvalue())


def open_hdf5(path: Path, source: AtomicFile | None = None) -> h5py.File:
    """Open an HDF5 file: to read, as it was before a transaction that did not end, or through `source`, to write.
    Raises TrajectoryError, in one line, when it is absent, cut short or no HDF5 file."""
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
        raise TrajectoryError(f"{path} cannot be read as HDF5: {first_line(error)}; restore it from a copy.") from error


def column_names(file: h5py.File) -> list[str]:
    """Return the names of all per-frame columns present in the file."""
    fixed = ["coordinates", "time", "particles/trajectory/position/step", "surromd/flags", "surromd/chunk_idx", ENDS]
    if "surromd" in file:
        fixed += [*PER_ATOM, "cell_lengths", "cell_angles", EDGES]
    names = [name for name in fixed if name in file]
    for group in ("surromd/scalars", CHECKSUMS):
        names += [f"{group}/{name}" for name in file.get(group, ())]
    return names


def consistent_length(file: h5py.File, path: Path) -> int:
    """Return the number of frames that every column holds. Raises TrajectoryError where they differ, and for blocks of
    data that are missing."""
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


def read_rows(column: h5py.Dataset, start: int, stop: int, stride: int, path: Path) -> Float32Array:
    """Return rows `start:stop:stride` of a column as float32. Raises TrajectoryError where they cannot be read."""
    if start >= stop:
        return np.empty((0, *column.shape[1:]), dtype=np.float32)
    try:
        if stride == 1:
            return np.asarray(column[start:stop], dtype=np.float32)
        # HDF5 gathers strided rows one by one; whole blocks, thinned here, are many times faster.
        block = max(_STRIDED_READ_FRAMES // stride, 1) * stride
        parts = [column[s : min(s + block, stop)][::stride] for s in range(start, stop, block)]
        return np.concatenate(parts).astype(np.float32, copy=False)
    except UNREADABLE as error:
        raise TrajectoryError(f"{path} is damaged in frames {start} to {stop} ({first_line(error)}).") from error


def checked_with_frames(
    positions: npt.NDArray[Any],
    time_ps: Float64Array,
    chunk_idx: npt.NDArray[np.int32],
    flags: npt.NDArray[np.uint16] | None,
    scalars: Mapping[str, Float64Array],
) -> Columns:
    """Return the columns that have one checksum: positions `(n, n_atoms, 3)` as on disk, and series `(n,)`."""
    columns: Columns = {FRAMES: positions, "time": time_ps, "chunk_idx": chunk_idx}
    columns |= {f"scalars/{name}": values for name, values in scalars.items()}
    return columns if flags is None else columns | {"flags": flags}


def read_run_id(file: h5py.File) -> str:
    """Return the number of the run that wrote a file; nothing of other programs and earlier versions."""
    return file["surromd/run_id"][()].decode("ascii") if "surromd/run_id" in file else ""


class FrameStore(Closing):
    """Appends to a file made by `create_store`, one transaction per append. Raises TrajectoryError when the file is
    damaged or not ours (this version's), StorageError."""

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
        checksums = {name: column[:] for name, column in self._columns.items() if name.startswith(CHECKSUMS)}
        self._digest = hashlib.sha256(checksum_rows(checksums))
        self.last_time_ps = float(self._columns["time"][self.n_frames - 1]) if self.n_frames else None

    def digest(self) -> str:
        """Return the hash of the checksums of all frames written so far (`TrajectoryReader.digest`)."""
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

    def series(self) -> tuple[Float64Array, dict[str, Float64Array], npt.NDArray[np.uint16]]:
        """Return the times `(n_frames,)` ps, the scalars by name and the flags of all frames written so far."""
        with self._open():
            scalars = {name.rpartition("/")[2]: c[:] for name, c in self._columns.items() if "/scalars/" in name}
            flags = self._columns.get("surromd/flags")
            time_ps = self._columns["time"][:]
            return time_ps, scalars, np.zeros(len(time_ps), np.uint16) if flags is None else flags[:]

    def _store(self, block: FrameBlock, columns: Columns, stored: Columns) -> None:
        """Append a block and the format's own `columns` (by dataset name). Raises InputError, StorageError. `stored`:
        what has a checksum, as it is on disk: positions `(n, n_atoms, 3)` as FRAMES, and more by name."""
        with self._open():
            n, start = len(block), self.n_frames
            values: dict[str, Any] = {"time": block.time_ps, "surromd/chunk_idx": block.chunk_idx, **columns}
            wanted = {f"surromd/scalars/{name}": "<f8" for name in block.scalars}
            if block.flags is not None:
                values["surromd/flags"] = block.flags
                wanted["surromd/flags"] = "<u2"
            for name in wanted.keys() - self._columns.keys():
                self._columns[name] = add_column(self.file, name, start, wanted[name])
            for name, array in stored.items():
                checked = {name: array}
                if name == FRAMES:
                    checked = checked_with_frames(array, block.time_ps, block.chunk_idx, block.flags, block.scalars)
                values[f"{CHECKSUMS}/{name}"] = frame_checksums(checked)
            for name, column in self._columns.items():
                column.resize(start + n, axis=0)
                if name in values:
                    column[start:] = values[name]
                else:  # a scalar that this append does not give stays NaN
                    column[start:] = block.scalars.get(name.rpartition("/")[2], np.full(n, np.nan))
            self._commit()
            self.n_frames, self.last_time_ps = start + n, float(block.time_ps[-1])
            self._digest.update(checksum_rows({name: values[name] for name in values if name.startswith(CHECKSUMS)}))

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
