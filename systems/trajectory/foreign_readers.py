"""Trajectories of other programs, through the readers of MDTraj and of MDAnalysis.

Which one reads a format, and what it would make up, stands in `format_table`. What both read MDTraj reads, block by
block.
"""

from __future__ import annotations

import importlib
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.cell_shape import read_cells
from systems.errors import InputError, TrajectoryError, first_line
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_details import (
    AsciiPath,
    counted_note,
    netcdf_units,
    trr_has_cell,
    trr_positions,
    unit_note,
    xtc_grid_nm,
)
from systems.trajectory.foreign_scenes import (
    bonds_completed,
    scene_from_mdtraj_topology,
    scene_from_structure,
    scene_from_universe,
)
from systems.trajectory.format_table import NONE, SOME, format_of
from systems.trajectory.frame_block import Float32Array, Float64Array
from systems.trajectory.frame_orders import IntArray, arc_names, gro_frames, moved_note, orders, pdb_names

_PASS_FRAMES = 4096
_NM = 0.1
_GRO_TIME = re.compile(r"t= *\d+\.\d+")  # as MDTraj looks for it


class MdtrajReader(TrajectoryReader):
    """A format that MDTraj reads. XTC, TRR and NetCDF are read block by block, others whole into memory.

    Raises TrajectoryError for what MDTraj cannot read, InputError when `top` is needed or does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        self.path, self._format = path, format_of(path)
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        self.notes = unit_note(self._format)
        self.scene = None
        self._whole: Any = None
        self._file: Any = None
        self._kept: IntArray | None = None
        self._ascii = AsciiPath(path)
        streamed, named = self._format.streamed, self._format.names_atoms
        try:
            if streamed:
                self._open(self._ascii.path)
        except InputError:
            self.close()
            raise
        except Exception as error:  # each MDTraj reader raises its own kinds
            self.close()
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}.") from error
        stated = None if top is None else scene_from_structure(top, name=path.stem)
        if not streamed:
            self._whole = self._load(path, None if stated is None or named else stated.to_mdtraj_topology())
        if stated is not None and stated.n_atoms != self.n_atoms:
            self.close()
            raise InputError(f"{top} has {stated.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one.")
        if not self.n_frames:
            return
        first = self._read(0, 1, 1)[0]
        if stated is not None:
            self.scene = stated.with_positions(first)
        elif not streamed:
            made = scene_from_mdtraj_topology(self._whole.topology, first, name=path.stem, source=path.name)
            self.scene = bonds_completed(made, self._read_cells(0, 1, 1))

    def _load(self, path: Path, topology: Any) -> Any:
        import mdtraj

        is_mol2 = path.name.lower().endswith(".mol2") and path.is_file()
        n_molecules = path.read_bytes().count(b"@<TRIPOS>MOLECULE") if is_mol2 else 1
        if n_molecules > 1:
            raise InputError(f"{path} holds {n_molecules} molecules, of which MDTraj reads the first; write PDB.")
        try:
            if is_mol2:
                importlib.import_module("pandas")
            frames = mdtraj.load(str(self._ascii.path), **({} if topology is None else {"top": topology}))
        except ImportError as error:
            lacking = error.name or "a package"
            raise TrajectoryError(f"{path} cannot be read: MDTraj needs {lacking}, which is not installed.") from error
        except Exception as error:
            needs = topology is None and not self._format.names_atoms
            hint = " (a format without topology: give one with `top`)" if needs else ""
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}{hint}.") from error
        self.n_frames, self.n_atoms = frames.n_frames, frames.n_atoms
        self.time_ps, self.times_known = np.asarray(frames.time, dtype=np.float64), self._format.times != NONE
        suffix = path.name.lower()
        if suffix.endswith(".gro"):
            titles = []
            self._put_in_order(frames, (titles.append(title) or names for title, names in gro_frames(path)))  # type: ignore[func-returns-value]
            # Where one title states no time MDTraj counts frames.
            self.times_known = all(_GRO_TIME.search(title) for title in titles)
        elif suffix.endswith((".pdb", ".pdb.gz")):
            self._put_in_order(frames, pdb_names(path))
        elif suffix.endswith(".arc"):
            self._put_in_order(frames, arc_names(path))
        return frames

    def _put_in_order(self, frames: Any, names: Iterable[Sequence[str]]) -> None:
        """Put the atoms of each frame into the first one's order: MDTraj goes by their place."""
        moved, n_atoms = orders(names, self.path)
        if moved and (n_atoms != self.n_atoms or max(moved) >= self.n_frames):
            raise TrajectoryError(
                f"{self.path}: later frames list their atoms in another order, and MDTraj leaves some out; write it "
                "again in one order, without alternates."
            )
        for frame, order in moved.items():
            frames.xyz[frame] = frames.xyz[frame][order]
        self.notes += moved_note(moved)

    def _open(self, path: Path) -> None:
        import mdtraj

        self._file = mdtraj.open(str(path))
        self._nm, ps, self._cell_nm = (0.1, 1.0, 0.1) if self._file.distance_unit == "angstroms" else (1.0, 1.0, 1.0)
        if self._format.name.startswith("NetCDF"):
            self._nm, ps, self._cell_nm = netcdf_units(self._file._handle, self.path)
        if self._format.name == "XTC":
            self.grid_nm = xtc_grid_nm(self.path)
        positions, *_ = self._file.read(n_frames=1)
        self.n_atoms = int(positions.shape[1])
        self._file.seek(0)
        times: list[Float64Array] = []
        while True:
            _, time, *_ = self._file.read(n_frames=_PASS_FRAMES, atom_indices=np.array([0]))
            if time is None or not len(time):
                break
            times.append(np.asarray(time, dtype=np.float64) * ps)
        self.times_known = bool(times)
        self.notes += counted_note(np.concatenate(times)) if times else ()
        self.time_ps = np.concatenate(times) if times else np.arange(len(self._file), dtype=np.float64)
        if self._format.positions == SOME:
            has = trr_positions(self.path)
            if len(has) == len(self.time_ps) and not has.all():
                self._kept = np.flatnonzero(has)
                self.time_ps = self.time_ps[has]
                self.notes += (f"{(~has).sum()} frames hold no positions and are left out.",)
        self.n_frames = len(self.time_ps)
        if not self.n_frames:
            raise InputError(f"{self.path} holds no positions.")

    def _stored(self, start: int, stop: int) -> list[Any]:
        """Return what MDTraj reads of frames `start:stop`, positions first; frames without positions do not count."""
        if self._file is None:
            raise InputError(f"{self.path} is closed.")
        kept = None if self._kept is None else self._kept[start:stop]
        first, last = (start, stop) if kept is None else (int(kept[0]), int(kept[-1]) + 1)
        try:
            self._file.seek(first)
            stored = self._file.read(n_frames=last - first)
        except Exception as error:
            reason = first_line(error)
            raise TrajectoryError(f"{self.path} is damaged in frames {start} to {stop} ({reason}).") from error
        return [x if kept is None or x is None else np.asarray(x)[kept - first] for x in stored]

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
        if self._format.name.startswith("NetCDF"):  # lengths and angles
            if stored[2] is None:
                return None
            return read_cells(np.asarray(stored[2])[::stride] * self._cell_nm, np.asarray(stored[3])[::stride])
        if self._format.name == "TRR" and not trr_has_cell(self.path):
            return None
        cells = None if stored[3] is None else np.asarray(stored[3], dtype=np.float64)
        return cells[::stride] if cells is not None and cells.ndim == 3 and cells.any() else None

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None
        self._ascii.close()


class MdanalysisReader(TrajectoryReader):
    """A format of MDAnalysis, read frame by frame. Raises TrajectoryError; InputError for a `top` that does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        import MDAnalysis
        from MDAnalysis.coordinates.core import get_reader_for

        self.path = path
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        self._format = format_of(path)
        self.notes = unit_note(self._format)
        self._kept: IntArray | None = None
        stated = None
        if top is not None:
            stated = scene_from_structure(top, name=path.stem)
        elif self._format.names_atoms:
            stated = scene_from_universe(path, name=path.stem)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                kind = get_reader_for(str(path), format=self._format.mda)
                size = {} if stated is None else {"n_atoms": stated.n_atoms}
                self._reader: Any = kind(str(path), convert_units=True, **size)
                self.n_frames, self.n_atoms = int(self._reader.n_frames), int(self._reader.n_atoms)
                self.time_ps, self.times_known = self._times()
        except InputError:
            raise
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
        """Return times `(n_frames,)` ps and whether the file states them; frames without positions are left out.

        MDAnalysis' own time step of 1 ps is none: only formats that state times are asked for them.
        """
        known = self._format.times != NONE
        times, has = np.arange(self.n_frames, dtype=np.float64), np.ones(self.n_frames, dtype=bool)
        for k, frame in enumerate(self._reader):
            known = known and "time" in frame.data
            times[k] = frame.time if known else float(k)
            has[k] = frame.has_positions
        if not has.any():
            raise InputError(f"{self.path} holds no positions.")
        if not has.all():
            self._kept = np.flatnonzero(has)
            self.notes += (f"{(~has).sum()} frames hold no positions and are left out.",)
            self.n_frames, times = int(has.sum()), times[has]
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
        return (self._reader[k if self._kept is None else int(self._kept[k])] for k in range(start, stop, stride))

    def close(self) -> None:
        if self._reader is not None:
            self._reader.close()
        self._reader = None
