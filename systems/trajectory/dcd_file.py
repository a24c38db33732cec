"""DCD trajectories (CHARMM's layout) with a PDB and a record beside them, and plain DCD files of other programs.

`NAME.dcd` holds positions in Å, `NAME.pdb` the topology, `NAME.meta.h5` our record, exact times, flags and scalars.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import write_whole
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, unused_top_note
from systems.trajectory.companion_writer import CompanionWriter, companions
from systems.trajectory.dcd_layout import (
    DcdLayout,
    cell_blocks,
    cells_of_blocks,
    header_bytes,
    step_fields,
    title_bytes,
)
from systems.trajectory.frame_block import Float32Array, Float64Array, FrameBlock
from systems.trajectory.frame_store import (
    CELLS,
    ENDS,
    FRAMES,
    add_column,
    consistent_length,
    damage_reported,
    get_json,
    open_hdf5,
    read_record,
    read_run_id,
)
from systems.trajectory.hdf5_file import check_read, read_checksums, read_columns
from systems.trajectory.topology_file import is_our_topology


class DcdWriter(CompanionWriter):
    """Writes a DCD and its companions; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    _layout: DcdLayout
    _first_times: Float64Array

    def _lay_out(self, file: h5py.File) -> None:
        add_column(file, "time", 0, "<f8")

    def _head(self) -> bytes:
        header = header_bytes(0, 0, 1, 0.0, has_cell=self.scene.cell_nm is not None)
        return header + title_bytes(self.scene.n_atoms)

    def _adopt(self) -> None:
        layout = DcdLayout.read(self.path)
        ours = DcdLayout.ours(self.scene.n_atoms, layout.first_frame_at, has_cell=self.scene.cell_nm is not None)
        if layout != ours or ENDS in self._store.file:
            raise TrajectoryError(f"{self.path} was not written by surromd and cannot be continued; take another name.")
        _check_against_meta(self.path, layout, self._store.n_frames, completed=False)
        self._layout, self._first_times = layout, self._store.first_times_ps()

    def _offset(self, n_frames: int) -> int:
        return self._layout.offset(n_frames)

    def _encoded(self, block: FrameBlock) -> tuple[bytes, dict[str, npt.NDArray[Any]], dict[str, npt.NDArray[Any]]]:
        frames = np.empty(len(block), dtype=self._layout.frame_dtype)
        angstrom = block.positions_nm * np.float32(10.0)
        stored: dict[str, npt.NDArray[Any]] = {FRAMES: angstrom}
        for axis in range(3):
            frames[f"before{axis}"] = frames[f"after{axis}"] = 4 * self.scene.n_atoms
            frames[f"x{axis}"] = angstrom[:, :, axis]
        if self._layout.has_cell:
            own = np.broadcast_to(np.asarray(self.scene.cell_nm, dtype=np.float64), (len(block), 3, 3))
            stored[CELLS] = frames["cell"] = cell_blocks(own if block.cell_nm is None else block.cell_nm)
        return frames.tobytes(), {}, stored

    def _restate(self, n_frames: int) -> None:
        first, nsavc, timestep_ps = 0, 1, 0.0
        if len(self._first_times):
            first, nsavc, timestep_ps = step_fields(self._first_times, self._store.record)
        write_whole(self._fd, header_bytes(n_frames, first, nsavc, timestep_ps, has_cell=self._layout.has_cell), 0)

    def _written(self, block: FrameBlock, columns: dict[str, npt.NDArray[Any]]) -> None:
        self._first_times = np.concatenate([self._first_times, block.time_ps])[:2]

    def _forgotten(self, n_frames: int) -> None:
        self._first_times = self._first_times[:n_frames]


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
        if meta.exists() and not _is_of_xtc(meta):
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


def _is_of_xtc(meta: Path) -> bool:
    with open_hdf5(meta) as file:
        return ENDS in file


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
