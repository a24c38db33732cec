"""Trajectories of other programs, through the readers of MDTraj and of MDAnalysis.

Each reads formats that the other does not: LH5, HOOMD XML, Desmond and PDBx the first; H5MD, XYZ, LAMMPS, TNG, GSD and
DL_POLY the second. What both read MDTraj reads, block by block.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.cell_shape import read_cells
from systems.chemistry.distance_bonds import with_bonds_by_distance
from systems.errors import InputError, TrajectoryError, first_line
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import (
    MDANALYSIS_FORMATS,
    scene_from_mdtraj_topology,
    scene_from_structure,
    scene_from_universe,
)
from systems.trajectory.frame_block import Float32Array, Float64Array

_STREAMED = (".xtc", ".trr", ".nc", ".ncdf", ".netcdf")
_WITH_TOPOLOGY = (".pdb", ".gz", ".pdbx", ".cif", ".mmcif", ".gro", ".mol2", ".arc", ".lh5", ".hoomdxml")
_WITH_TIMES = (".gro", ".lh5", ".dtr", ".stk", ".ncrst")
_PASS_FRAMES = 4096
# Of MDAnalysis' formats those that name their atoms.
_XYZ_LIKE = (".xyz", ".extxyz", ".gsd", ".txyz", ".pqr", ".dump", ".lammpsdump", ".history", ".config")
_NM = 0.1


class MdtrajReader(TrajectoryReader):
    """A format that MDTraj reads. XTC, TRR and NetCDF are read block by block, others whole into memory.

    Raises TrajectoryError for what MDTraj cannot read, InputError when `top` is needed or does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path = path
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        self.scene = None
        self._whole: Any = None
        self._file: Any = None
        suffix = path.suffix.lower()
        try:
            if suffix in _STREAMED:
                self._open(path)
        except Exception as error:  # each MDTraj reader raises its own kinds
            self.close()
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}.") from error
        stated = None if top is None else scene_from_structure(top, name=path.stem)
        if suffix not in _STREAMED:
            self._whole = self._load(
                path, None if stated is None or suffix in _WITH_TOPOLOGY else stated.to_mdtraj_topology()
            )
        if stated is not None and stated.n_atoms != self.n_atoms:
            self.close()
            raise InputError(f"{top} has {stated.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one.")
        if not self.n_frames:
            return
        first = self._read(0, 1, 1)[0]
        if stated is not None:
            self.scene = stated.with_positions(first)
        elif suffix not in _STREAMED:
            made = scene_from_mdtraj_topology(self._whole.topology, first, name=path.stem, source=path.name)
            self.scene = with_bonds_by_distance(made)

    def _load(self, path: Path, topology: Any) -> Any:
        import mdtraj

        try:
            frames = mdtraj.load(str(path), **({} if topology is None else {"top": topology}))
        except Exception as error:
            needs = topology is None and path.suffix.lower() not in _WITH_TOPOLOGY
            hint = " (a format without topology: give one with `top`)" if needs else ""
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}{hint}.") from error
        self.n_frames, self.n_atoms = frames.n_frames, frames.n_atoms
        self.time_ps, self.times_known = np.asarray(frames.time, dtype=np.float64), path.suffix.lower() in _WITH_TIMES
        return frames

    def _open(self, path: Path) -> None:
        import mdtraj

        self._file = mdtraj.open(str(path))
        positions, *_ = self._file.read(n_frames=1)
        self.n_atoms = int(positions.shape[1])
        self._file.seek(0)
        times: list[Float64Array] = []
        while True:
            _, time, *_ = self._file.read(n_frames=_PASS_FRAMES, atom_indices=np.array([0]))
            if time is None or not len(time):
                break
            times.append(np.asarray(time, dtype=np.float64))
        self.times_known = bool(times)
        self.time_ps = np.concatenate(times) if times else np.arange(len(self._file), dtype=np.float64)
        self.n_frames = len(self.time_ps)
        self._nm = 0.1 if self._file.distance_unit == "angstroms" else 1.0

    def _stored(self, start: int, stop: int) -> tuple[Any, ...]:
        if self._file is None:
            raise InputError(f"{self.path} is closed.")
        try:
            self._file.seek(start)
            return tuple(self._file.read(n_frames=stop - start))
        except Exception as error:
            reason = first_line(error)
            raise TrajectoryError(f"{self.path} is damaged in frames {start} to {stop} ({reason}).") from error

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        if self._whole is not None:
            return np.asarray(self._whole.xyz[start:stop:stride], dtype=np.float32).copy()
        parts = []
        block = max(_PASS_FRAMES // stride, 1) * stride
        for first in range(start, stop, block):
            positions = self._stored(first, min(first + block, stop))[0][::stride]
            parts.append(np.asarray(positions, dtype=np.float32) * np.float32(self._nm))
        return np.concatenate(parts)

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if self._whole is not None:
            cells = self._whole.unitcell_vectors
            return None if cells is None else np.asarray(cells[start:stop:stride], dtype=np.float64)
        if start >= stop:
            return np.empty((0, 3, 3))
        stored = self._stored(start, stop)
        if self._nm != 1.0:  # NetCDF: lengths in Å and angles
            if stored[2] is None:
                return None
            return read_cells(np.asarray(stored[2])[::stride] * self._nm, np.asarray(stored[3])[::stride])
        cells = None if stored[3] is None else np.asarray(stored[3], dtype=np.float64)
        return cells[::stride] if cells is not None and cells.ndim == 3 and cells.any() else None

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None


class MdanalysisReader(TrajectoryReader):
    """A format of MDAnalysis, read frame by frame. Raises TrajectoryError; InputError for a `top` that does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        import MDAnalysis
        from MDAnalysis.coordinates.core import get_reader_for

        self.path = path
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        suffix = path.suffix.lower()
        format_ = MDANALYSIS_FORMATS.get(suffix)
        stated = None
        if top is not None:
            stated = scene_from_structure(top, name=path.stem)
        elif suffix in _XYZ_LIKE:
            stated = scene_from_universe(path, name=path.stem)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind = get_reader_for(str(path), format=format_)
                size = {} if stated is None else {"n_atoms": stated.n_atoms}
                self._reader: Any = kind(str(path), convert_units=True, **size)
                self.n_frames, self.n_atoms = int(self._reader.n_frames), int(self._reader.n_atoms)
                self.time_ps, self.times_known = self._times()
        except (ValueError, TypeError) as error:
            # Of a format that it does not know it lists all others in the lines that follow.
            why = first_line(error).partition(". The FORMATs")[0]
            raise TrajectoryError(
                f"{path} cannot be read by MDTraj or MDAnalysis {MDAnalysis.__version__}: {why}."
            ) from error
        except Exception as error:  # each of its readers raises its own kinds
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}.") from error
        if stated is not None and stated.n_atoms != self.n_atoms:
            self.close()
            raise InputError(f"{top} has {stated.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one.")
        self.scene = stated if stated is None or not self.n_frames else stated.with_positions(self._read(0, 1, 1)[0])

    def _times(self) -> tuple[Float64Array, bool]:
        known = True
        times = np.empty(self.n_frames)
        for k, frame in enumerate(self._reader):
            known = known and ("time" in frame.data or "dt" in frame.data)
            times[k] = frame.time if known else float(k)
        return times, known

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        out = np.empty((len(range(start, stop, stride)), self.n_atoms, 3), dtype=np.float32)
        for k, frame in enumerate(self._frames(start, stop, stride)):
            out[k] = frame.positions * np.float32(_NM)
        return out

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        cells = [frame.triclinic_dimensions for frame in self._frames(start, stop, stride)]
        if any(c is None or not np.any(c) for c in cells):
            return None
        return np.asarray(cells, dtype=np.float64).reshape(-1, 3, 3) * _NM

    def _frames(self, start: int, stop: int, stride: int) -> Any:
        if self._reader is None:
            raise InputError(f"{self.path} is closed.")
        return (self._reader[k] for k in range(start, stop, stride))

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        self._reader = None
