"""Trajectories of other programs, through the readers of MDTraj and of MDAnalysis, and what both leave out: units of
NetCDF, TRR frames without positions, odd paths.

Which one reads a format, and what it would make up, stands in `foreign_scenes`. What both read MDTraj reads, block by
block.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import tempfile
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import read_cells
from systems.errors import InputError, TrajectoryError, first_line
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import (
    NONE,
    SOME,
    Format,
    bonds_completed,
    format_of,
    nm_per,
    ps_per,
    scene_from_mdtraj_topology,
    scene_from_structure,
    scene_from_universe,
)
from systems.trajectory.frame_store import Float32Array, Float64Array
from systems.trajectory.xyz_file import IntArray, arc_names, gro_frames, moved_note, orders, pdb_names

_TRR_MAGIC = 1993
# Of the header's ten sizes: box, virial, pressure, (topology), positions, velocities and forces have bytes behind it.
_TRR_X = 7
# Magic, atoms, step, time, nine numbers of the cell, atoms again; then the precision, a float32.
_XTC_PRECISION = 56
_TRR_FLOATS = (2, 3, 4, 7, 8, 9)


def unit_note(format_: Format) -> tuple[str, ...]:
    """Return the line on a unit of length that a format does not state, none where it states one."""
    if not format_.unit_taken:
        return ()
    return (f"a {format_.name} file states no unit of length; {format_.unit_taken} is taken.",)


def counted_note(time_ps: npt.NDArray[np.float64]) -> tuple[str, ...]:
    """Return the line on times `(n_frames,)` that are what MDTraj writes where nobody stated any."""
    if len(time_ps) < 3 or not np.array_equal(time_ps, np.arange(len(time_ps))):
        return ()
    return ("its times are 0, 1, 2, ... ps, which MDTraj also writes where it was told none; if so, state `dt_ps`.",)


def netcdf_units(handle: Any, path: Path) -> tuple[float, float, float]:
    """Return what one stands for, by `units` and `scale_factor`, in positions (nm), times (ps) and cell lengths (nm).

    `handle`: SciPy's or netCDF4's open file, which MDTraj reads raw numbers from. Where no unit is stated Amber's
    convention counts: Å and ps. Raises TrajectoryError for a unit that is not known.
    """
    if hasattr(handle, "set_auto_maskandscale"):
        handle.set_auto_maskandscale(False)
    factors: list[float] = []
    for name, per, usual in (("coordinates", nm_per, "angstrom"), ("time", ps_per, "picosecond"),
                             ("cell_lengths", nm_per, "angstrom")):  # fmt: skip
        variable = handle.variables.get(name)
        unit, factor = getattr(variable, "units", usual), per(getattr(variable, "units", usual))
        if factor is None:
            text = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            raise TrajectoryError(f"{path}: {name} are in {text!r}, a unit that is not known; write it in Å and ps.")
        factors.append(factor * float(np.squeeze(getattr(variable, "scale_factor", 1.0))))
    return factors[0], factors[1], factors[2]


def trr_positions(path: Path) -> npt.NDArray[np.bool_]:
    """Return which frames of a TRR file hold positions `(n_frames,)`, by their headers: MDTraj gives memory that
    nobody set for the others. Raises TrajectoryError for a damaged header."""
    found: list[bool] = []
    with path.open("rb") as file:
        size = path.stat().st_size
        while file.tell() + 84 <= size:
            magic, _, length = np.frombuffer(file.read(12), ">i4").tolist()
            file.seek(-(-length // 4) * 4, 1)
            sizes = np.frombuffer(file.read(52), ">i4").tolist()
            if magic != _TRR_MAGIC or len(sizes) != 13 or min(sizes[:11]) < 0:
                raise TrajectoryError(f"{path} is damaged after frame {len(found)}.")
            of_atoms = next((sizes[k] for k in (7, 8, 9) if sizes[k]), 0)
            double = sizes[2] == 72 if sizes[2] else of_atoms == 24 * sizes[10]
            file.seek((16 if double else 8) + sum(sizes[k] for k in _TRR_FLOATS), 1)
            found.append(sizes[_TRR_X] > 0)
    return np.array(found, dtype=bool)


def trr_has_cell(path: Path) -> bool:
    """Return whether the first frame of a TRR file states a cell: MDTraj gives memory that nobody set where not."""
    with path.open("rb") as file:
        length = int.from_bytes(file.read(12)[8:], "big")
        file.seek(-(-length // 4) * 4 + 8, 1)
        return int.from_bytes(file.read(4), "big") > 0


def xtc_grid_nm(path: Path) -> float | None:
    """Return what an XTC file rounds coordinates to, nm, by the precision in its first frame's header (1000: 0.001 nm);
    None where it states none, as of nine atoms or fewer, which are not rounded."""
    with path.open("rb") as file:
        header = file.read(_XTC_PRECISION + 8)
    if len(header) < _XTC_PRECISION + 8 or int.from_bytes(header[4:8], "big") <= 9:
        return None
    # Files of 2^31 bytes in a frame (magic 2023) differ behind the precision.
    precision = float(np.frombuffer(header, ">f4", 1, _XTC_PRECISION)[0])
    return 1.0 / precision if np.isfinite(precision) and precision > 0 else None


class AsciiPath:
    """A file's path for libraries in C that take ASCII alone: `path` is itself, or a link in a folder of its own."""

    def __init__(self, path: Path) -> None:
        self.path, self._folder = path, None
        if str(path).isascii():
            return
        with contextlib.suppress(OSError):  # without links the library says what it cannot read
            self._folder = tempfile.TemporaryDirectory(prefix="surromd-")
            link = Path(self._folder.name) / f"frames{''.join(path.suffixes[-2:])}"
            link.symlink_to(path.resolve(), target_is_directory=path.is_dir())
            self.path = link

    def close(self) -> None:
        """Remove the link."""
        if self._folder is not None:
            self._folder.cleanup()
        self._folder = None


# ---- readers --------------------------------------------------------------------------------------------------------


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
