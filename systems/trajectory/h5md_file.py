"""H5MD of other programs (de Buyl, Colberg and Höfling, Comput. Phys. Commun. 185, 1546 (2014)), read by h5py.

Steps and times are datasets, or one number each (fixed steps: the interval, with an `offset`); the cell is a dataset of
each frame, or one for all.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError, first_line
from systems.files.outside import UNREADABLE
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import scene_from_structure
from systems.trajectory.frame_block import Float32Array, Float64Array
from systems.trajectory.frame_store import damage_reported, open_hdf5
from systems.trajectory.stated_units import nm_per, ps_per


class H5mdReader(TrajectoryReader):
    """Reads the positions of an H5MD file's particles. Times without a unit are not known.

    Raises TrajectoryError for a file that is damaged or states no unit of length, InputError for several groups of
    particles or a `top` that does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path = path
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        self._file = open_hdf5(path)
        try:
            with damage_reported(path):
                self._read_headers()
            self.scene = None if top is None else scene_from_structure(top, name=path.stem)
            if self.scene is not None:
                if self.scene.n_atoms != self.n_atoms:
                    raise InputError(
                        f"{top} has {self.scene.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one."
                    )
                if self.n_frames:
                    self.scene = self.scene.with_positions(self._read(0, 1, 1)[0])
        except BaseException:
            self._file.close()
            raise

    def _read_headers(self) -> None:
        groups = [g for g in self._file.get("particles", {}).values() if "position/value" in g]
        if not groups:
            raise InputError(f"{self.path} holds no positions of particles.")
        if len(groups) > 1:
            names = ", ".join(g.name.rpartition("/")[2] for g in groups)
            raise InputError(f"{self.path} holds several groups of particles ({names}); write one of them alone.")
        self._box, position = groups[0].get("box"), groups[0]["position"]
        self._value = position["value"]
        if self._value.ndim != 3 or self._value.shape[2] != 3:
            raise TrajectoryError(f"{self.path}: positions of shape {self._value.shape}, not (n, n_atoms, 3).")
        self.n_frames, self.n_atoms = self._value.shape[:2]
        nm = nm_per(self._value.attrs.get("unit", ""))
        if nm is None:
            raise TrajectoryError(
                f"{self.path}: its positions state no unit of length that is known; set the attribute `unit` of "
                f"{self._value.name} to 'nm' or 'Angstrom'."
            )
        self._nm = nm
        self.time_ps, self.times_known = np.arange(self.n_frames, dtype=np.float64), False
        time = position.get("time")
        ps = None if time is None else ps_per(time.attrs.get("unit", ""))
        if time is not None and ps is None:
            self.notes = ("its times state no unit that is known and are not used.",)
        elif time is not None and ps is not None:
            steps: Any = time[()]
            if np.ndim(steps) == 0:
                steps = float(time.attrs.get("offset", 0.0)) + steps * np.arange(self.n_frames)
            self.time_ps, self.times_known = ps * np.asarray(steps[: self.n_frames], dtype=np.float64), True
            if len(self.time_ps) != self.n_frames:
                raise TrajectoryError(f"{self.path} is damaged: {self.n_frames} frames, {len(self.time_ps)} times.")

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        return self._rows(self._value, start, stop, stride).astype(np.float32) * np.float32(self._nm)

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if not self._file:
            raise InputError(f"{self.path} is closed.")
        with damage_reported(self.path):
            edges = None if self._box is None else self._box.get("edges", self._box.attrs.get("edges"))
            if edges is None:
                return None
            column = edges.get("value") if isinstance(edges, h5py.Group) else None
            if column is not None:
                values, unit = self._rows(column, start, stop, stride), column.attrs.get("unit")
            else:
                one: npt.NDArray[Any] = np.asarray(edges[()])
                values = np.broadcast_to(one, (len(range(start, stop, stride)), *one.shape))
                unit = edges.attrs.get("unit") if isinstance(edges, h5py.Dataset) else None
            nm = self._nm if unit is None else nm_per(unit)
            if nm is None:
                raise TrajectoryError(
                    f"{self.path}: its cell is in {unit!r}, a unit that is not known; write it in nm."
                )
            cells = values[..., None] * np.eye(3) if values.ndim == 2 else values
            return None if not np.any(cells) else np.asarray(cells, dtype=np.float64) * nm

    def _rows(self, column: h5py.Dataset, start: int, stop: int, stride: int) -> npt.NDArray[Any]:
        try:
            rows: npt.NDArray[Any] = np.asarray(column[start:stop])[::stride]
        except UNREADABLE as error:
            if not self._file:
                raise InputError(f"{self.path} is closed.") from error
            raise TrajectoryError(
                f"{self.path} is damaged in frames {start} to {stop} ({first_line(error)})."
            ) from error
        return rows

    def close(self) -> None:
        self._file.close()
