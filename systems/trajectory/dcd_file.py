"""DCD trajectories (CHARMM's layout) with a PDB and a record beside them, and plain DCD files of other programs.

`NAME.dcd` holds positions in Å, `NAME.pdb` the topology, `NAME.meta.h5` our record, exact times, flags and scalars.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, SurromdError, TrajectoryError
from systems.files.whole_file import create_whole, refuse_existing, storage_error, write_whole
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter, check_same_topology, unused_top_note
from systems.trajectory.dcd_layout import (
    DcdLayout,
    cell_blocks,
    cells_of_blocks,
    header_bytes,
    step_fields,
    title_bytes,
)
from systems.trajectory.frame_block import Float32Array, FrameBlock
from systems.trajectory.frame_store import (
    CELLS,
    FRAMES,
    FrameStore,
    add_column,
    consistent_length,
    create_store,
    damage_reported,
    get_json,
    open_hdf5,
    read_record,
    read_run_id,
)
from systems.trajectory.hdf5_file import check_read, read_checksums, read_columns
from systems.trajectory.topology_file import (
    is_our_topology,
    refuse_other_topology,
    topology_bytes,
    topology_path,
    write_topology,
)


def companions(path: Path) -> tuple[Path, Path]:
    """Return the paths of `NAME.pdb` and `NAME.meta.h5` that stand beside `NAME.dcd`."""
    return topology_path(path), path.with_suffix(".meta.h5")


class DcdWriter(TrajectoryWriter):
    """Writes a DCD and its companions; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    def __init__(
        self, path: Path, scene: Scene, record: dict[str, Any], *, append: bool, overwrite: bool, run_id: str = ""
    ) -> None:
        self.path, self.scene, self._fd = path, scene, -1
        self._pdb, self._meta = companions(path)
        if not append:
            self._create(record, overwrite, run_id)
        if not self._meta.exists():
            raise TrajectoryError(f"{path} has no {self._meta.name} beside it and cannot be continued.")
        self._store = FrameStore(self._meta)
        try:
            check_same_topology(path, self._store.scene, scene)
            layout = DcdLayout.read(path)
            if layout != DcdLayout.ours(scene.n_atoms, layout.first_frame_at, has_cell=scene.cell_nm is not None):
                raise TrajectoryError(f"{path} was not written by surromd and cannot be continued; take another name.")
            _check_against_meta(path, layout, self._store.n_frames, completed=False)
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

    def _create(self, record: dict[str, Any], overwrite: bool, run_id: str) -> None:
        for file in (self.path, self._meta):
            refuse_existing(file, overwrite)
        topology = topology_bytes(self.scene)
        refuse_other_topology(self.path, topology, overwrite=overwrite)
        made = [file for file in (self._meta, self._pdb, self.path) if not file.exists()]
        try:
            create_store(
                self._meta,
                self.scene,
                record,
                lambda file: add_column(file, "time", 0, "<f8"),
                overwrite=overwrite,
                run_id=run_id,
                checksums=(FRAMES,) if self.scene.cell_nm is None else (FRAMES, CELLS),
            )
            write_topology(self.path, topology)
            header = header_bytes(0, 0, 1, 0.0, has_cell=self.scene.cell_nm is not None)
            create_whole(self.path, header + title_bytes(self.scene.n_atoms))
        except SurromdError:
            for file in made:
                with suppress(OSError):
                    file.unlink(missing_ok=True)
            raise

    def _append(self, block: FrameBlock) -> None:
        self._refuse_closed()
        self._store.check_flags(block)
        if block.velocities_nm_ps is not None or block.forces_kj_mol_nm is not None:
            raise InputError(f"{self.path}: a DCD holds positions only; write an .h5 to keep velocities or forces.")
        if block.cell_nm is not None and not self._layout.has_cell:
            raise InputError(f"{self.path}: {self.scene.name!r} has no periodic cell, but frames came with one.")
        frames = np.empty(len(block), dtype=self._layout.frame_dtype)
        angstrom = block.positions_nm * np.float32(10.0)
        stored: dict[str, npt.NDArray[Any]] = {FRAMES: angstrom}
        for axis in range(3):
            frames[f"before{axis}"] = frames[f"after{axis}"] = 4 * self.scene.n_atoms
            frames[f"x{axis}"] = angstrom[:, :, axis]
        if self._layout.has_cell:
            own = np.broadcast_to(np.asarray(self.scene.cell_nm, dtype=np.float64), (len(block), 3, 3))
            stored[CELLS] = frames["cell"] = cell_blocks(own if block.cell_nm is None else block.cell_nm)
        first_times = self._first_times
        try:
            write_whole(self._fd, frames.tobytes(), self._layout.offset(self.n_frames))
            self._first_times = np.concatenate([first_times, block.time_ps])[:2]
            self._set_length(self.n_frames + len(block))
            os.fsync(self._fd)
            self._store.append(block, {}, stored)
        except BaseException as error:
            # Taking space back needs none, so this also succeeds on a full disk; and frames too many do no harm.
            self._first_times = first_times
            with suppress(OSError):
                self._set_length(self.n_frames)
            failed = self._store.failed(error) if isinstance(error, OSError) else error
            self.close()
            raise failed from error

    def _set_length(self, n_frames: int) -> None:
        """Make header and file size say `n_frames`. The header is one small write, which is atomic."""
        first, nsavc, timestep_ps = 0, 1, 0.0
        if len(self._first_times):
            first, nsavc, timestep_ps = step_fields(self._first_times, self._store.record)
        write_whole(self._fd, header_bytes(n_frames, first, nsavc, timestep_ps, has_cell=self._layout.has_cell), 0)
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

    def close(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        super().close()


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
                self.checksums, self.run_id = read_checksums(file, self.n_frames), read_run_id(file)
                self.record = read_record(file)
                self.scene = Scene.from_dict(get_json(file, "surromd/scene"))
            _check_against_meta(path, layout, self.n_frames, completed=self.record.get("completed") is True)
            if top is not None:
                _scene_from_top(top, path, self.n_atoms)
                self.notes = (unused_top_note(top),)
        else:
            self.n_frames = layout.whole_frames()
            self.time_ps, self.times_known = layout.times_ps(self.n_frames), layout.states_time
            self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
            self.scene, self.notes = None, layout.notes
            if top is not None or is_our_topology(pdb):
                self.scene = _scene_from_top(top or pdb, path, self.n_atoms)
        if self.scene is not None and self.scene.n_atoms != self.n_atoms:
            raise TrajectoryError(f"{path} holds {self.n_atoms} atoms a frame, its record {self.scene.n_atoms}.")
        self._frames: npt.NDArray[Any] | None = np.empty(0, dtype=layout.frame_dtype)
        if self.n_frames:
            self._frames = np.memmap(path, layout.frame_dtype, "r", layout.first_frame_at, (self.n_frames,))
            if self.scene is not None and not self.scene.positions_nm.any():
                self.scene = self.scene.with_positions(self._read(0, 1, 1)[0])

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
            out[:, :, axis] = frames[f"x{axis}"]
        check_read(self, FRAMES, out, slice(start, stop, stride))
        out *= np.float32(0.1)
        return out

    def _read_cells(self, start: int, stop: int, stride: int) -> npt.NDArray[np.float64] | None:
        if self._frames is None:
            raise InputError(f"{self.path} is closed.")
        if not self._layout.has_cell:
            return None
        blocks = np.asarray(self._frames["cell"][start:stop:stride])
        check_read(self, CELLS, blocks, slice(start, stop, stride))
        try:
            return cells_of_blocks(blocks, self._layout.byte_order, self._layout.charmm_version)
        except ValueError as error:
            raise TrajectoryError(
                f"{self.path}: its unit cell is no cell ({error}); take the cell out of it."
            ) from error

    def close(self) -> None:
        self._frames = None


def _check_against_meta(path: Path, layout: DcdLayout, n_frames: int, *, completed: bool) -> None:
    """Raise TrajectoryError unless the DCD holds the recorded frames; behind them a run may have some in flight."""
    extra = layout.file_bytes - layout.offset(n_frames)
    if extra < 0 or (extra and completed):
        whole = (layout.file_bytes - layout.first_frame_at) // layout.frame_dtype.itemsize
        raise TrajectoryError(
            f"{path} holds {whole} whole frames where {companions(path)[1].name} records {n_frames}: one of them is "
            "cut short or replaced; restore both from one copy."
        )


def _scene_from_top(top: Path, path: Path, n_atoms: int) -> Scene:
    from systems.trajectory.foreign_scenes import scene_from_structure

    scene = scene_from_structure(top, name=path.stem)
    if scene.n_atoms != n_atoms:
        raise InputError(f"{top} has {scene.n_atoms} atoms, {path} has {n_atoms}; give the matching structure.")
    return scene
