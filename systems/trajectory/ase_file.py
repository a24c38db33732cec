"""ASE's own trajectories (`.traj`) through ase, where it is installed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from systems.errors import InputError, TrajectoryError, first_line
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import named_scene, scene_from_structure
from systems.trajectory.frame_block import Float32Array, Float64Array
from systems.trajectory.frame_orders import order_of



class AseReader(TrajectoryReader):
    """A file of ASE's `Trajectory`, read frame by frame; elements are the file's, bonds found by distance.

    Raises TrajectoryError where ase is not installed or cannot read it, InputError for a `top` that does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path = path
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        try:
            from ase.io.trajectory import Trajectory
        except ImportError as error:
            raise TrajectoryError(
                f"{path} is read by ase: `pip install ase`, or convert it elsewhere by `ase convert {path.name} "
                f"{path.stem}.xyz`."
            ) from error
        try:
            self._frames: Any = Trajectory(str(path))
            self.n_frames = len(self._frames)
            first = self._frames[0]
        except Exception as error:  # ase raises whatever its parts do
            raise TrajectoryError(f"{path} cannot be read by ase: {first_line(error)}.") from error
        self.n_atoms = len(first)
        self.time_ps, self.times_known = np.arange(self.n_frames, dtype=np.float64), False
        self._elements = [str(x) for x in first.get_chemical_symbols()]
        if top is None:
            cell = first.cell.array * _NM if first.pbc.all() else None
            names = [f"{e}{k + 1}" for k, e in enumerate(self._elements)]
            stated = named_scene(path, names, self._elements, first.positions * _NM, cell)
        else:
            stated = scene_from_structure(top, name=path.stem)
        if stated.n_atoms != self.n_atoms:
            self.close()
            raise InputError(f"{top} has {stated.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one.")
        self.scene = stated.with_positions(self._read(0, 1, 1)[0])

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        out = np.empty((len(range(start, stop, stride)), self.n_atoms, 3), dtype=np.float32)
        for k, frame in enumerate(self._stored(start, stop, stride)):
            order_of(list(frame.get_chemical_symbols()), self._elements, self.path, start + k * stride)
            out[k] = frame.positions * _NM
        return out

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        frames = self._stored(start, stop, stride)
        if not all(frame.pbc.all() for frame in frames):
            return None
        return np.array([frame.cell.array * _NM for frame in frames], dtype=np.float64).reshape(-1, 3, 3)

    def _stored(self, start: int, stop: int, stride: int) -> list[Any]:
        if self._frames is None:
            raise InputError(f"{self.path} is closed.")
        try:
            return [self._frames[k] for k in range(start, stop, stride)]
        except Exception as error:  # ase raises whatever its parts do
            raise TrajectoryError(
                f"{self.path} is damaged in frames {start} to {stop} ({first_line(error)})."
            ) from error

    def close(self) -> None:
        if self._frames is not None:
            self._frames.close()
        self._frames = None
