"""DCD trajectories (CHARMM's layout) with a PDB and a record beside them, and plain DCD files of other programs.

`NAME.dcd` holds positions in Å, `NAME.pdb` the topology, `NAME.meta.h5` our record, exact times, flags and scalars.
Blocks of bytes stand between 32-bit lengths: a header of 4 + 80 bytes (`CORD`, number of frames, first step, steps
between frames, ..., time step in AKMA units as float32), a title, the number of atoms; then x, y and z of each frame,
after the unit cell where there is one.

Other libraries' DCD files are not used: MDTraj and MDAnalysis read a file that is cut short as far as it goes, OpenMM
appends behind half a frame, and none cuts a file to a number of frames.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import lengths_and_angles, read_cells
from systems.errors import TrajectoryError
from systems.files.whole_file import create_whole, write_whole
from systems.scene import Scene
from systems.trajectory.companion_writer import is_our_topology, meta_path, topology_path
from systems.trajectory.store import CELLS, ENDS, FRAMES, Columns, Float32Array, Float64Array, FrameBlock
from systems.trajectory.xtc_file import CompanionReader, CompanionWriter, check_size, is_of_xtc

AKMA_PS = 4.888821e-2  # the value MDAnalysis and OpenMM use for CHARMM's unit of time
_HEADER_BYTES = 92
_MOST_ATOMS = 2**31 // 13  # a frame's bytes are counted in 32 bits
_TITLE = b"Written by surromd"
_LAMMPS_TITLE = b"Written by LAMMPS"
_LAMMPS_NOTE = "written by LAMMPS, whose time step may be in fs, ps or reduced units; it is not used: state `dt_ps`."
_LAST_VERSION_WITH_ANGLES = 24
_LIKELY_DEG = (40.0, 140.0)


class DcdLayout:
    """Where the frames of a DCD lie, and what its header says. Sizes in bytes. `interval_ps` between frames is 1 where
    no time step is stated. Raises TrajectoryError when the header is damaged or of a kind that is not supported."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as file:
                head = file.read(_HEADER_BYTES)
                self.file_bytes = os.fstat(file.fileno()).st_size
                order = next((o for o in "<>" if np.frombuffer(head[:4], f"{o}i4")[:1] == 84), "")
                if len(head) < _HEADER_BYTES or not order or head[4:8] != b"CORD":
                    what = "is not a DCD file of the 32-bit kind" if self.file_bytes else "is empty"
                    raise TrajectoryError(f"{path} {what}.")
                fields = np.frombuffer(head[8:88], f"{order}i4").tolist()
                is_charmm = fields[19] != 0
                delta = float(np.frombuffer(head[44:52], f"{order}f4" if is_charmm else f"{order}f8")[0])
                if fields[8] != 0 or (is_charmm and fields[11] != 0):
                    raise TrajectoryError(f"{path} has fixed atoms or a fourth dimension; convert it first.")
                title = file.read(int(np.frombuffer(file.read(4), f"{order}i4")[0]) + 4)
                _, self.n_atoms, _ = np.frombuffer(file.read(12), f"{order}i4").tolist()
                self.first_frame_at = file.tell()
        except OSError as error:
            raise TrajectoryError(f"{path} cannot be read: {error.strerror}.") from error
        except (ValueError, IndexError) as error:
            raise TrajectoryError(f"{path} is cut short inside its header.") from error
        if not 1 <= self.n_atoms < _MOST_ATOMS:
            raise TrajectoryError(f"{path} is damaged: its header states {self.n_atoms} atoms.")
        self.path, self.byte_order, self.charmm_version = path, order, fields[19]
        self.n_frames_stated, self.has_our_title = fields[0], _TITLE in title
        self.has_cell = is_charmm and fields[10] != 0
        is_lammps = _LAMMPS_TITLE in title
        self.notes = (_LAMMPS_NOTE,) if is_lammps else ()
        every = max(fields[2], 1)
        # The time step is float32: digits beyond its seventh are noise.
        self.interval_ps = float(f"{delta * AKMA_PS * every:.6g}")
        has_step = bool(np.isfinite(self.interval_ps) and self.interval_ps > 0)
        # MDTraj and VMD write a time step of one unit, whatever the times were; LAMMPS one in units of its own.
        self.states_time = has_step and not is_lammps and not (delta == 1.0 and fields[2] == 1)
        self.interval_ps = self.interval_ps if has_step else 1.0
        self.first_time_ps = self.interval_ps * fields[1] / every
        # One frame: x, y and z between block lengths.
        axis = [("before", f"{order}i4"), ("x", f"{order}f4", (self.n_atoms,)), ("after", f"{order}i4")]
        cell = [("cell", f"{order}i4", (14,))] if self.has_cell else []
        self.frame_dtype = np.dtype([*cell, ("axes", axis, (3,))])

    def offset(self, frame: int) -> int:
        return self.first_frame_at + frame * self.frame_dtype.itemsize

    def whole_frames(self) -> int:
        """Return the number of frames in the file. Raises TrajectoryError when it ends inside one or lacks some. Other
        programs write the number they intend (or 0) and never correct it, so theirs is only warned about."""
        n, rest = divmod(self.file_bytes - self.first_frame_at, self.frame_dtype.itemsize)
        stated = self.n_frames_stated
        if rest or (stated not in (0, n) and self.has_our_title):
            raise TrajectoryError(
                f"{self.path} is cut short or damaged: its header states {stated} frames, {n} are whole; "
                "restore it from a whole copy."
            )
        if stated not in (0, n):
            warnings.warn(f"{self.path}: the header states {stated} frames, the file holds {n}.", stacklevel=2)
        return n


def step_fields(times_ps: Float64Array, record: dict[str, Any]) -> tuple[int, int, float]:
    """Return `(first step, steps between frames, time step in ps)` for the header. In units of the integration step
    where the record states one that divides the times, else of the interval."""
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


def cell_blocks(cell_nm: npt.ArrayLike) -> npt.NDArray[np.int32]:
    """Return the unit-cell blocks `(n, 14)` of box vectors `(n, 3, 3)` nm: A, gamma, B, beta, alpha, C (Å, degrees)."""
    lengths, angles = lengths_and_angles(cell_nm)
    (a, b, c), (alpha, beta, gamma) = 10.0 * lengths.T, angles.T
    out = np.full((len(lengths), 14), 48, dtype="<i4")
    out[:, 1:13] = np.ascontiguousarray(np.stack([a, gamma, b, beta, alpha, c], axis=1), dtype="<f8").view("<i4")
    return out


def cells_of_blocks(
    blocks: npt.NDArray[np.int32], byte_order: str, charmm_version: int = _LAST_VERSION_WITH_ANGLES
) -> Float64Array | None:
    """Return box vectors `(n, 3, 3)` nm of unit-cell blocks `(n, 14)`, None of such as hold zeros.

    Between the lengths stand angles in degrees (most programs), their cosines (NAMD), or the elements of CHARMM's
    symmetric shape matrix in Å (version 25 on), whose rows are the box vectors: recognised by numbers that are no
    angles. Raises ValueError where the numbers are none of the three.
    """
    raw = np.ascontiguousarray(blocks[:, 1:13]).view(f"{byte_order}f8").astype(np.float64)
    lengths, angles = raw[:, [0, 2, 5]], raw[:, [4, 3, 1]]
    if not len(raw) or (lengths == 0.0).any():
        return read_cells(0.1 * lengths, angles)
    if (np.abs(angles) <= 1.0).all() and charmm_version <= _LAST_VERSION_WITH_ANGLES:
        angles = np.degrees(np.arccos(angles))
    likely = bool(((angles >= _LIKELY_DEG[0]) & (angles <= _LIKELY_DEG[1])).all())
    if not _are_angles(angles) or (charmm_version > _LAST_VERSION_WITH_ANGLES and not likely):
        shape = raw[:, [0, 1, 3, 1, 2, 4, 3, 4, 5]].reshape(-1, 3, 3)
        if np.isfinite(shape).all() and (np.linalg.eigvalsh(shape) > 0.0).all():
            return 0.1 * shape
    if not _are_angles(angles):
        raise ValueError("neither angles, nor cosines, nor a shape matrix")
    return read_cells(0.1 * lengths, angles)


def _are_angles(angles: Float64Array) -> bool:
    """Whether a cell can have these angles `(n, 3)`, degrees."""
    alpha, beta, gamma = np.cos(np.radians(angles)).T
    volume = 1.0 - alpha**2 - beta**2 - gamma**2 + 2.0 * alpha * beta * gamma
    return bool(((angles > 0.0) & (angles < 180.0)).all() and (volume > 0.0).all())


def header_bytes(n_frames: int, first_step: int, nsavc: int, timestep_ps: float, *, has_cell: bool = False) -> bytes:
    """Return the first block of our header; `nsavc` time steps lie between frames."""
    fields = np.zeros(20, dtype="<i4")
    fields[:3] = n_frames, first_step, nsavc
    fields[3] = min(n_frames * nsavc, 2**31 - 1)
    fields[9:10] = np.array([timestep_ps / AKMA_PS], dtype="<f4").view("<i4")
    fields[10] = int(has_cell)
    fields[19] = 24  # CHARMM's version: float32 time step, three dimensions (field 11)
    mark = np.array([84], dtype="<i4").tobytes()
    return mark + b"CORD" + fields.tobytes() + mark


def title_bytes(n_atoms: int) -> bytes:
    """Return the title and the number of atoms, which complete our header."""
    line = (_TITLE + b"; record and exact times in NAME.meta.h5").ljust(80)
    mark = np.array([84], dtype="<i4").tobytes()
    title = mark + np.array([1], dtype="<i4").tobytes() + line + mark
    return title + np.array([4, n_atoms, 4], dtype="<i4").tobytes()


# ---- writer and reader ----------------------------------------------------------------------------------------------


class DcdWriter(CompanionWriter):
    """Writes a DCD and its companions; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    _layout: DcdLayout

    def _begin(self, path: Path, scene: Scene) -> None:
        head = header_bytes(0, 0, 1, 0.0, has_cell=scene.cell_nm is not None)
        create_whole(path, head + title_bytes(scene.n_atoms))

    def _adopt(self) -> None:
        self._layout = layout = DcdLayout(self.path)
        ours = (self.scene.n_atoms, "<", self.scene.cell_nm is not None)
        if (layout.n_atoms, layout.byte_order, layout.has_cell) != ours or ENDS in self.file:
            raise TrajectoryError(f"{self.path} was not written by surromd and cannot be continued; take another name.")
        check_size(self.path, self.n_frames, layout.offset(self.n_frames), completed=False)

    def _offset(self, n_frames: int, record: h5py.File) -> int:
        return self._layout.offset(n_frames)

    def _encoded(self, block: FrameBlock) -> tuple[bytes, Columns, Columns]:
        frames = np.empty(len(block), dtype=self._layout.frame_dtype)
        angstrom = block.positions_nm * np.float32(10.0)
        stored: Columns = {FRAMES: angstrom}
        axes = frames["axes"]
        axes["before"] = axes["after"] = 4 * self.scene.n_atoms
        axes["x"] = angstrom.transpose(0, 2, 1)
        if block.cell_nm is not None:
            stored[CELLS] = frames["cell"] = cell_blocks(block.cell_nm)
        return frames.tobytes(), {}, stored

    def _restate(self, n_frames: int, first_times_ps: Float64Array) -> None:
        step = step_fields(first_times_ps, self.record) if len(first_times_ps) else (0, 1, 0.0)
        write_whole(self._fd, header_bytes(n_frames, *step, has_cell=self._layout.has_cell), 0)


class DcdReader(CompanionReader):
    """Reads our DCD files with their companions, and plain ones (32-bit, no fixed atoms) of other programs. Without
    companions times come from the header (1 ps a frame where it states no time step) and `scene` from `top`. Raises
    TrajectoryError when the file is cut short or damaged, InputError where `top` is needed and does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        self._layout = layout = DcdLayout(path)
        if meta_path(path).exists() and not is_of_xtc(path):
            self._read_companion(top)
            completed = self.record.get("completed") is True
            check_size(path, self.n_frames, layout.offset(self.n_frames), completed=completed)
            if self.n_atoms != layout.n_atoms:
                raise TrajectoryError(f"{path} holds {layout.n_atoms} atoms a frame, its record {self.n_atoms}.")
        else:
            self.n_atoms, self.n_frames = layout.n_atoms, layout.whole_frames()
            self.time_ps = layout.first_time_ps + layout.interval_ps * np.arange(self.n_frames, dtype=np.float64)
            self.times_known = layout.states_time
            self.notes = layout.notes
            top = top or (topology_path(path) if is_our_topology(topology_path(path)) else None)
        self._frames: npt.NDArray[Any] = np.empty(0, dtype=layout.frame_dtype)
        if self.n_frames:
            self._frames = np.memmap(path, layout.frame_dtype, "r", layout.first_frame_at, (self.n_frames,))
        if self.scene is None and (stated := self._scene_of(top)) is not None:
            self._take_scene(stated, top)
            if stated.positions_nm.any():  # a PSF has none
                self.scene = stated

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        axes, n_bytes = self._frames["axes"][start:stop:stride], 4 * self.n_atoms
        lengths = ((axes["before"] == n_bytes) & (axes["after"] == n_bytes)).all(axis=1)
        if not lengths.all():
            bad = start + stride * int(np.argmin(lengths))
            raise TrajectoryError(f"{self.path} is damaged at frame {bad}; restore it from a whole copy.")
        out = np.empty((len(axes), self.n_atoms, 3), dtype=np.float32)
        for k in range(3):  # sooner done than the three at once
            out[:, :, k] = axes["x"][:, k]
        self._check_read(FRAMES, out, slice(start, stop, stride))
        out *= np.float32(0.1)
        return out

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if not self._layout.has_cell:
            return None
        blocks = np.asarray(self._frames["cell"][start:stop:stride])
        self._check_read(CELLS, blocks, slice(start, stop, stride))
        try:
            return cells_of_blocks(blocks, self._layout.byte_order, self._layout.charmm_version)
        except ValueError as error:
            raise TrajectoryError(
                f"{self.path}: its unit-cell record is invalid ({error}); rewrite the file without it."
            ) from error

    def close(self) -> None:
        super().close()
        self._frames = np.empty(0)  # gives the file's pages back
