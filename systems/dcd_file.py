"""DCD trajectories (CHARMM's layout) with a PDB and a record beside them, and plain DCD files of other programs.

`NAME.dcd` holds positions in Å, `NAME.pdb` the topology, `NAME.meta.h5` our record, exact times, flags and scalars.
Layout: blocks of bytes between 32-bit lengths; a header of 4 + 80 bytes (`CORD`, number of frames, first step, steps
between frames, ..., time step in AKMA units as float32), a title, the number of atoms; then x, y and z of each frame.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.atomic_file import storage_error, write_whole
from systems.errors import InputError, SurromdError, TrajectoryError
from systems.frame_store import (
    FrameStore,
    add_column,
    consistent_length,
    create_store,
    damage_reported,
    get_json,
    open_hdf5,
    refuse_existing,
    write_new,
)
from systems.hdf5_file import read_columns
from systems.pdb_text import pdb_text
from systems.scene import Scene
from systems.trajectory_types import Float32Array, FrameBlock, TrajectoryReader, TrajectoryWriter, check_same_topology

AKMA_PS = 4.888821e-2  # the value MDAnalysis and OpenMM use for CHARMM's unit of time
_HEADER_BYTES = 92
_OUR_PDB = b"REMARK   1 surromd scene"


def companions(path: Path) -> tuple[Path, Path]:
    """Return the paths of `NAME.pdb` and `NAME.meta.h5` that stand beside `NAME.dcd`."""
    return path.with_suffix(".pdb"), path.with_suffix(".meta.h5")


class DcdWriter(TrajectoryWriter):
    """Writes a DCD and its companions; see `systems.trajectory.open_writer` for the arguments and errors."""

    def __init__(self, path: Path, scene: Scene, record: dict[str, Any], *, append: bool, overwrite: bool) -> None:
        self.path, self.scene, self._fd = path, scene, -1
        self._pdb, self._meta = companions(path)
        if not append:
            self._create(record, overwrite)
        if not self._meta.exists():
            raise TrajectoryError(f"{path} has no {self._meta.name} beside it and cannot be continued.")
        self._store = FrameStore(self._meta)
        try:
            check_same_topology(path, self._store.scene, scene)
            layout = DcdLayout.read(path)
            if layout != DcdLayout.ours(scene.n_atoms, layout.first_frame_at):
                raise TrajectoryError(f"{path} was not written by surromd and cannot be continued; take another name.")
            _check_against_meta(path, layout, self._store.n_frames, self._store.largest_append)
            self._layout, self.n_frames = layout, self._store.n_frames
            self.last_time_ps, self._first_times = self._store.last_time_ps, self._store.first_times_ps()
            new = {key: value for key, value in record.items() if key not in self._store.record}
            if append and new:
                self._store.update_record(new)
            try:
                self._fd = os.open(path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
                self._set_length(self.n_frames)
            except OSError as error:
                raise storage_error(path, error, "nothing was changed") from error
        except BaseException:
            self.close()
            raise

    def _create(self, record: dict[str, Any], overwrite: bool) -> None:
        for file in (self.path, self._meta, self._pdb):
            refuse_existing(file, overwrite)
        if self._pdb.exists() and not self._pdb.read_bytes().startswith(_OUR_PDB):
            raise TrajectoryError(f"{self._pdb} is not ours and would be replaced; choose another name for the DCD.")
        topology = pdb_text(self.scene).encode("ascii", "replace")
        made: list[Path] = []
        try:
            create_store(
                self._meta, self.scene, record, lambda file: add_column(file, "time", 0, "<f8"), overwrite=overwrite
            )
            made.append(self._meta)
            write_new(self._pdb, topology)
            made.append(self._pdb)
            write_new(self.path, _header(0, 0, 1, 0.0) + _title(self.scene.n_atoms))
        except SurromdError:
            for file in made:
                file.unlink(missing_ok=True)
            raise

    def _append(self, block: FrameBlock) -> None:
        self._refuse_closed()
        self._store.check_flags(block)
        self._store.announce(len(block))
        frames = np.empty(len(block), dtype=self._layout.frame_dtype)
        for axis in range(3):
            frames[f"before{axis}"] = frames[f"after{axis}"] = 4 * self.scene.n_atoms
            frames[f"x{axis}"] = block.positions_nm[:, :, axis] * np.float32(10.0)
        first_times = self._first_times
        try:
            write_whole(self._fd, frames.tobytes(), self._layout.offset(self.n_frames))
            self._first_times = np.concatenate([first_times, block.time_ps])[:2]
            self._set_length(self.n_frames + len(block))
            self._store.append(block, {})
        except BaseException as error:
            # Taking space back needs none, so this also succeeds on a full disk.
            self._first_times = first_times
            self._set_length(self.n_frames)
            failed = self._store.failed(error) if isinstance(error, OSError) else error
            self.close()
            raise failed from error

    def _set_length(self, n_frames: int) -> None:
        """Make header and file size say `n_frames`. The header is one small write, which is atomic."""
        first, nsavc, timestep_ps = 0, 1, 0.0
        if len(self._first_times):
            first, nsavc, timestep_ps = _step_fields(self._first_times, self._store.record)
        write_whole(self._fd, _header(n_frames, first, nsavc, timestep_ps), 0)
        os.ftruncate(self._fd, self._layout.offset(n_frames))

    def truncate(self, n_frames: int) -> None:
        self._refuse_closed()
        self._store.truncate(n_frames)
        self._first_times = self._store.first_times_ps()
        try:
            self._set_length(n_frames)
        except OSError as error:
            raise self._store.failed(error) from error
        self.n_frames, self.last_time_ps = n_frames, self._store.last_time_ps

    def update_record(self, entries: dict[str, Any]) -> None:
        self._refuse_closed()
        self._store.update_record(entries)

    def _refuse_closed(self) -> None:
        if self._fd < 0:
            raise InputError(f"{self.path} is closed; open it again with append=True.")

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self._store.close()


class DcdReader(TrajectoryReader):
    """Reads our DCD files with their companions, and plain ones (32-bit, no fixed atoms) of other programs.

    Without companions times come from the header (1 ps a frame where it states no time step) and `scene` from `top`.
    Raises TrajectoryError when the file is cut short or damaged, InputError when `top` does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path = path
        self._layout = layout = DcdLayout.read(path)
        self.n_atoms = layout.n_atoms
        pdb, meta = companions(path)
        if meta.exists():
            with open_hdf5(meta) as file, damage_reported(meta):
                if "surromd" not in file:
                    raise TrajectoryError(f"{meta} is not the record of {path.name}; move it to read the DCD alone.")
                self.n_frames = consistent_length(file, meta)
                self.time_ps, self.flags, self.chunk_idx, self.scalars = read_columns(file, meta, self.n_frames)
                self.record = get_json(file, "surromd/record")
                self.scene = Scene.from_dict(get_json(file, "surromd/scene"))
                in_flight = int(file["surromd"].attrs["largest_append"])
            _check_against_meta(path, layout, self.n_frames, in_flight)
            if top is not None:
                _scene_from_top(top, path, self.n_atoms)
        else:
            self.n_frames = layout.whole_frames()
            self.time_ps = layout.times_ps(self.n_frames)
            self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
            self.scene = None
            if top is not None or _is_ours(pdb):
                self.scene = _scene_from_top(top or pdb, path, self.n_atoms)
        if self.scene is not None and self.scene.n_atoms != self.n_atoms:
            raise TrajectoryError(f"{path} holds {self.n_atoms} atoms a frame, its record {self.scene.n_atoms}.")
        self._frames: npt.NDArray[Any] | None = np.empty(0, dtype=layout.frame_dtype)
        if self.n_frames:
            self._frames = np.memmap(path, layout.frame_dtype, "r", layout.first_frame_at, (self.n_frames,))

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        if self._frames is None:
            raise InputError(f"{self.path} is closed.")
        frames = self._frames[start:stop:stride]
        out = np.empty((len(frames), self.n_atoms, 3), dtype=np.float32)
        for axis in range(3):
            lengths = (frames[f"before{axis}"] == 4 * self.n_atoms) & (frames[f"after{axis}"] == 4 * self.n_atoms)
            if not lengths.all():
                bad = start + stride * int(np.argmin(lengths))
                raise TrajectoryError(f"{self.path} is damaged at frame {bad}; restore it from a whole copy.")
            np.multiply(frames[f"x{axis}"], np.float32(0.1), out=out[:, :, axis])
        return out

    def close(self) -> None:
        self._frames = None


@dataclass(frozen=True)
class DcdLayout:
    """Where the frames of a DCD lie, and what its header says. Sizes in bytes."""

    n_atoms: int
    first_frame_at: int
    byte_order: str = "<"
    has_cell: bool = False
    n_frames_in_header: int = 0
    first_time_ps: float = 0.0
    interval_ps: float = 0.0
    file_bytes: int = 0
    path: Path = Path()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DcdLayout):
            return NotImplemented
        mine = (self.n_atoms, self.first_frame_at, self.byte_order, self.has_cell)
        return mine == (other.n_atoms, other.first_frame_at, other.byte_order, other.has_cell)

    @staticmethod
    def ours(n_atoms: int, first_frame_at: int) -> DcdLayout:
        """Return the layout we write."""
        return DcdLayout(n_atoms, first_frame_at)

    @staticmethod
    def read(path: Path) -> DcdLayout:
        """Read the header. Raises TrajectoryError when it is damaged or of a kind that is not supported."""
        try:
            with path.open("rb") as file:
                head = file.read(_HEADER_BYTES)
                size = os.fstat(file.fileno()).st_size
                order = next((o for o in "<>" if np.frombuffer(head[:4], f"{o}i4")[:1] == 84), "")
                if len(head) < _HEADER_BYTES or not order or head[4:8] != b"CORD":
                    what = "is empty" if size == 0 else "is not a DCD file of the 32-bit kind"
                    raise TrajectoryError(f"{path} {what}.")
                fields = np.frombuffer(head[8:88], f"{order}i4")
                charmm = fields[19] != 0
                delta = np.frombuffer(head[44:52], f"{order}f4" if charmm else f"{order}f8")[0]
                if fields[8] != 0 or (charmm and fields[11] != 0):
                    raise TrajectoryError(f"{path} has fixed atoms or a fourth dimension; convert it first.")
                title = int(np.frombuffer(file.read(4), f"{order}i4")[0])
                file.seek(title + 4, os.SEEK_CUR)
                _, n_atoms, _ = np.frombuffer(file.read(12), f"{order}i4").tolist()
                first_frame_at = file.tell()
        except OSError as error:
            reason = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read: {error.strerror}"
            raise TrajectoryError(f"{path} {reason}.") from error
        except (ValueError, IndexError) as error:
            raise TrajectoryError(f"{path} is cut short inside its header.") from error
        if n_atoms < 1:
            raise TrajectoryError(f"{path} is damaged: its header states {n_atoms} atoms.")
        # The time step is float32: digits beyond its seventh are noise.
        interval_ps = float(f"{float(delta) * AKMA_PS * max(int(fields[2]), 1):.6g}")
        if not (np.isfinite(interval_ps) and interval_ps > 0):
            interval_ps = 1.0
        first_time_ps = interval_ps * int(fields[1]) / max(int(fields[2]), 1)
        return DcdLayout(n_atoms, first_frame_at, order, bool(charmm and fields[10]), int(fields[0]),
                         first_time_ps, interval_ps, size, path)  # fmt: skip

    @property
    def frame_dtype(self) -> np.dtype[Any]:
        """The NumPy record of one frame, block lengths included."""
        o = self.byte_order
        cell = [("cell", f"{o}i4", (14,))] if self.has_cell else []
        axes = [
            entry
            for k in range(3)
            for entry in ((f"before{k}", f"{o}i4"), (f"x{k}", f"{o}f4", (self.n_atoms,)), (f"after{k}", f"{o}i4"))
        ]
        return np.dtype(cell + axes)

    def offset(self, frame: int) -> int:
        return self.first_frame_at + frame * int(self.frame_dtype.itemsize)

    def times_ps(self, n_frames: int) -> npt.NDArray[np.float64]:
        return self.first_time_ps + self.interval_ps * np.arange(n_frames, dtype=np.float64)

    def whole_frames(self) -> int:
        """Return the number of frames in the file. Raises TrajectoryError when it ends inside one or lacks some."""
        n, rest = divmod(self.file_bytes - self.first_frame_at, int(self.frame_dtype.itemsize))
        # Some programs never update the count, which then stays 0.
        if rest or (self.n_frames_in_header not in (0, n)):
            raise TrajectoryError(
                f"{self.path} is cut short or damaged: its header states {self.n_frames_in_header} frames, "
                f"{n} are whole; restore it from a whole copy."
            )
        return n


def _check_against_meta(path: Path, layout: DcdLayout, n_frames: int, in_flight: int) -> None:
    """Raise TrajectoryError unless the DCD holds the recorded frames and at most one append in flight more."""
    extra = layout.file_bytes - layout.offset(n_frames)
    if extra < 0 or extra > in_flight * layout.frame_dtype.itemsize:
        whole = (layout.file_bytes - layout.first_frame_at) // layout.frame_dtype.itemsize
        raise TrajectoryError(
            f"{path} holds {whole} whole frames where {companions(path)[1].name} records {n_frames}: one of them is "
            "cut short or replaced; restore both from one copy."
        )


def _is_ours(pdb: Path) -> bool:
    try:
        with pdb.open("rb") as file:
            return file.read(len(_OUR_PDB)) == _OUR_PDB
    except OSError:
        return False


def _scene_from_top(top: Path, path: Path, n_atoms: int) -> Scene:
    from systems.from_mdtraj import load_topology, scene_from_mdtraj_topology

    topology, positions_nm = load_topology(top)
    if topology.n_atoms != n_atoms:
        raise InputError(f"{top} has {topology.n_atoms} atoms, {path} has {n_atoms}; give the matching structure.")
    return scene_from_mdtraj_topology(topology, positions_nm, name=path.stem, source=top.name)


def _step_fields(times_ps: npt.NDArray[np.float64], record: dict[str, Any]) -> tuple[int, int, float]:
    """Return `(first step, steps between frames, time step in ps)` for the header.

    In units of the integration step where the record states one that divides the times, else of the interval.
    """
    stated = record.get("save_every_ps")
    if len(times_ps) > 1:
        interval = float(times_ps[1] - times_ps[0])
    else:
        interval = float(stated) if isinstance(stated, int | float) and stated > 0 else 1.0
    timestep = record.get("timestep_ps")
    for unit in (timestep, interval):
        if not isinstance(unit, int | float) or unit <= 0:
            continue
        nsavc, first = round(interval / unit), round(float(times_ps[0]) / unit)
        fits = abs(nsavc * unit - interval) < 1e-6 * interval and abs(first * unit - times_ps[0]) < 1e-3 * interval
        if fits and nsavc >= 1 and 0 <= first < 2**31:
            return first, nsavc, float(unit)
    return 0, 1, interval


def _header(n_frames: int, first_step: int, nsavc: int, timestep_ps: float) -> bytes:
    fields = np.zeros(20, dtype="<i4")
    fields[:3] = n_frames, first_step, nsavc
    fields[3] = min(n_frames * nsavc, 2**31 - 1)
    fields[9:10] = np.array([timestep_ps / AKMA_PS], dtype="<f4").view("<i4")
    fields[19] = 24  # CHARMM's version: float32 time step, no unit cell (field 10), three dimensions (field 11)
    mark = np.array([84], dtype="<i4").tobytes()
    return mark + b"CORD" + fields.tobytes() + mark


def _title(n_atoms: int) -> bytes:
    line = b"Written by surromd; record and exact times in NAME.meta.h5".ljust(80)
    mark = np.array([84], dtype="<i4").tobytes()
    title = mark + np.array([1], dtype="<i4").tobytes() + line + mark
    return title + np.array([4, n_atoms, 4], dtype="<i4").tobytes()
