"""Base classes of all trajectory writers and readers."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, SurromdError, TrajectoryError
from systems.files.whole_file import (
    Checksums,
    Closing,
    OutputLock,
    checksum_rows,
    create_whole,
    frame_checksums,
    refuse_existing,
)
from systems.scene import Scene
from systems.trajectory.companion_writer import refuse_other_companions, topology_bytes, topology_path
from systems.trajectory.store import (
    CHECKSUMS,
    FRAMES,
    PER_ATOM,
    WEIGHTS,
    Float32Array,
    Float64Array,
    FrameBlock,
    FrameStore,
    checked_with_frames,
    consistent_length,
    create_store,
    get_json,
    read_record,
    read_run_id,
)

_VERIFIED_AT_ONCE = 4096


def uneven_by_ps(time_ps: Float64Array, step_ps: float) -> float:
    """Return by how much a step between even frames may differ from the others: times that passed through float32 are
    exact only to its spacing."""
    return 1e-3 * step_ps + 2.0 * float(np.spacing(np.float32(np.abs(time_ps).max(initial=0.0))))


class TrajectoryWriter(FrameStore):
    """Appends frames to one file. Each `append` is whole on disk, or not there at all, when it returns or raises."""

    lock: OutputLock | None = None

    def __init__(
        self,
        path: Path,
        scene: Scene,
        record: dict[str, Any],
        *,
        append: bool,
        overwrite: bool,
        columns: Sequence[str] = (),
        run_id: str = "",
    ) -> None:
        store, pdb = self._store_of(path), topology_path(path)
        topology = b"" if append and pdb.exists() else topology_bytes(scene)
        if append and not store.exists():
            raise TrajectoryError(f"{path} has no {store.name} beside it and cannot be continued.")
        made = [] if append else [file for file in {store, pdb, path} if not file.exists()]
        try:
            if not append:
                refuse_existing(path, overwrite)
                refuse_other_companions(path, topology)
                create_store(store, scene, record, self._lay_out, columns, overwrite=overwrite, run_id=run_id)
                if topology:
                    create_whole(pdb, topology)
                self._begin(path, scene)
        except SurromdError:
            for file in made:
                with suppress(OSError):
                    file.unlink(missing_ok=True)
            raise
        super().__init__(store)
        try:
            self.path = path
            check_same_topology(path, self.scene, scene)
            self.scene = scene
            self._adopt()
            if append:
                if topology:
                    create_whole(pdb, topology)
                if new := {key: value for key, value in record.items() if key not in self.record}:
                    self.update_record(new)
        except BaseException:
            self.close()
            raise

    @staticmethod
    def _store_of(path: Path) -> Path:
        """Return the HDF5 file that holds the columns of a trajectory."""
        return path

    def _lay_out(self, file: h5py.File, scene: Scene, columns: Sequence[str]) -> None:
        """Add the format's own groups and columns, and `columns` of velocities and forces, to a new store."""

    def _begin(self, path: Path, scene: Scene) -> None:
        """Make the file of positions, where it is not the store itself. Raises StorageError."""

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
        series = {name: np.asarray(values, dtype=np.float64) for name, values in (scalars or {}).items()}
        for name, values in series.items():
            if values.shape != (n,) or "/" in name or not name:
                raise InputError(f"{where}: scalar {name!r} must have shape ({n},) and no slash in its name.")
        chunk = np.asarray(-1 if chunk_idx is None else chunk_idx)
        if chunk.shape not in ((), (n,)) or chunk.dtype.kind not in "ui":
            raise InputError(f"{where}: chunk_idx must be one integer or {n}, not {chunk.dtype} of {chunk.shape}.")
        given = {"velocities": velocities_nm_ps, "forces": forces_kj_mol_nm}
        per_atom = {k: np.ascontiguousarray(v, dtype=np.float32) for k, v in given.items() if v is not None}
        for name, array in per_atom.items():
            if array.shape != positions.shape:
                raise InputError(f"{where}: {name} have shape {array.shape}, positions {positions.shape}.")
        cells = self._checked_cells(cell_nm, n)
        if not n:
            return
        self._check_columns(flags is not None, set(per_atom))
        self._append(
            FrameBlock(positions, times, None if flags is None else flags.astype(np.uint16),
                       np.broadcast_to(chunk, (n,)).astype(np.int32), series, per_atom, cells)
        )  # fmt: skip

    def _checked_cells(self, cell_nm: npt.ArrayLike | None, n: int) -> Float64Array | None:
        """Return the box vectors `(n, 3, 3)` nm of n frames, the scene's own where none are given."""
        if cell_nm is None and self.scene.cell_nm is not None:
            return np.broadcast_to(np.asarray(self.scene.cell_nm, dtype=np.float64), (n, 3, 3))
        if cell_nm is None:
            return None
        if self.scene.cell_nm is None:
            raise InputError(f"{self.path}: {self.scene.name!r} has no periodic cell, but frames came with one.")
        cells = np.asarray(cell_nm, dtype=np.float64)
        if cells.shape != (n, 3, 3) or not np.isfinite(cells).all() or (np.linalg.det(cells) <= 0).any():
            raise InputError(f"{self.path}: cells must be box vectors ({n}, 3, 3) with a volume, not {cells.shape}.")
        return cells

    def _check_columns(self, flagged: bool, per_atom: set[str]) -> None:
        """Raise InputError where frames come with a column that earlier ones have not, or the reverse."""
        if self.n_frames and ("surromd/flags" in self._columns) != flagged:
            state = "without" if flagged else "with"
            raise InputError(f"{self.path}: earlier frames were written {state} flags; flag all frames or none.")
        for name in PER_ATOM:
            if (name in per_atom) != (name in self._columns):
                state = "holds" if name in self._columns else "was started without"
                raise InputError(f"{self.path} {state} {name}; give them with every frame or with none.")

    def _steps(self, time_ps: Float64Array, kind: type[np.signedinteger[Any]]) -> npt.NDArray[Any]:
        """Return the steps `(n,)` that go with times: of the integrator where the record states it, else frames."""
        timestep_ps = self.record.get("timestep_ps")
        if isinstance(timestep_ps, int | float) and timestep_ps > 0 and time_ps[-1] / timestep_ps < np.iinfo(kind).max:
            return np.rint(time_ps / timestep_ps).astype(kind)
        return np.arange(self.n_frames, self.n_frames + len(time_ps), dtype=kind)

    @abstractmethod
    def _append(self, block: FrameBlock) -> None:
        """Append a block of at least one frame. Raises InputError, StorageError."""

    def close(self) -> None:
        super().close()
        if self.lock is not None:
            self.lock.close()


class TrajectoryReader(Closing):
    """Reads one file. `flags`, `chunk_idx` and `weights` are None, `record` is empty, where the file does not say.

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
    weights: Float64Array | None = None
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
        self.weights = None if WEIGHTS not in file else file[WEIGHTS][:].astype(np.float64)
        self.run_id, self.record = read_run_id(file), read_record(file)
        self.scene = Scene.from_dict(get_json(file, "surromd/scene"))

    def _scene_of(self, top: Path | None) -> Scene | None:
        """Return the scene of `top`, where there is one. Raises InputError where it cannot be read."""
        if top is None:
            return None
        from systems.trajectory.foreign_scenes import scene_from_structure

        return scene_from_structure(top, name=self.path.stem)

    def _take_scene(self, scene: Scene | None, top: Path | None) -> None:
        """Take a scene, at the positions of the first frame. Raises InputError, which names `top`, where it has another
        number of atoms."""
        if scene is None:
            return
        if scene.n_atoms != self.n_atoms:
            self.close()
            raise InputError(f"{top} has {scene.n_atoms} atoms, {self.path} has {self.n_atoms}; give the matching one.")
        self.scene = self._at_first_frame(scene)

    def _at_first_frame(self, scene: Scene) -> Scene:
        """Return the scene at the positions of the first frame, where there is one."""
        return scene.with_positions(self._read(0, 1, 1)[0]) if self.n_frames else scene

    def _check_read(self, name: str, stored: npt.NDArray[Any], frames: slice) -> None:
        """Raise TrajectoryError unless what was read of `frames`, as it is on disk, is what was written. With positions
        (FRAMES) go what the reader holds of the same frames: times, chunks, flags, scalars."""
        if name not in self.checksums or not len(stored):
            return
        columns = {name: stored}
        if name == FRAMES and self.chunk_idx is not None:
            flags = None if self.flags is None else self.flags[frames]
            scalars = {key: values[frames] for key, values in self.scalars.items()}
            columns = checked_with_frames(stored, self.time_ps[frames], self.chunk_idx[frames], flags, scalars)
        found = frame_checksums(columns)
        written = self.checksums[name][frames]
        if not np.array_equal(written, found):
            bad = frames.start + frames.step * int(np.argmax(written != found))
            raise TrajectoryError(
                f"{self.path} is damaged at frame {bad}: it is not what was written (checksum); restore it from a copy."
            )

    def read(self, start: int = 0, stop: int | None = None, stride: int = 1) -> Float32Array:
        """Return positions `(n, n_atoms, 3)` float32 nm of frames `start:stop:stride` (negative counts from the end).
        Raises InputError for a stride below 1, TrajectoryError when the frames cannot be read."""
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
        rows = checksum_rows({name: values[:n_frames] for name, values in self.checksums.items()})
        return hashlib.sha256(rows).hexdigest()

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
        for start in range(0, self.n_frames, n_frames_per_block):
            yield self.read(start, start + n_frames_per_block)

    def close(self) -> None:
        """Close the file; twice does no harm."""
        self._closed = True


def check_same_topology(path: Path, stored: Scene, scene: Scene) -> None:
    """Raise TrajectoryError unless both scenes have the same ordered topology."""
    if stored.topology_hash != scene.topology_hash:
        raise TrajectoryError(
            f"{path} holds {stored.name!r} ({stored.n_atoms} atoms, topology {stored.topology_hash}), which is not "
            f"{scene.name!r} ({scene.n_atoms} atoms, topology {scene.topology_hash}); choose another file."
        )
