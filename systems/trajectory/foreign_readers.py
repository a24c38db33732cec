"""Trajectories of other programs: through the readers of MDTraj, MDAnalysis and ASE, with what these leave out (units
of NetCDF, TRR frames without positions, odd paths, atoms in another order); H5MD and extended XYZ, read here.

Which one reads a format, and what it would make up, stands in `foreign_scenes`. What both read MDTraj reads, block by
block. XYZ: positions in Å; `Lattice`, `pbc` and `Properties` of each frame's second line are read
(https://github.com/libAtoms/extxyz): `Lattice` holds the rows a, b, c; `Properties` the columns as `name:type:number`
(`species:S:1:pos:R:3` where there is none).
"""

from __future__ import annotations

import bz2
import contextlib
import gzip
import importlib
import itertools
import re
import tempfile
import warnings
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import read_cells
from systems.chemistry.element_data import element_symbol
from systems.errors import InputError, TrajectoryError, first_line
from systems.files.outside import UNREADABLE
from systems.scene import IntArray
from systems.trajectory.base import Float32Array, Float64Array, TrajectoryReader, damage_reported, open_hdf5
from systems.trajectory.foreign_scenes import (
    NONE,
    SOME,
    Format,
    bonds_completed,
    format_of,
    named_scene,
    nm_per,
    ps_per,
    scene_from_mdtraj_topology,
    scene_from_structure,
    scene_from_universe,
)

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


def counted_note(time_ps: Float64Array) -> tuple[str, ...]:
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


# ---- atoms that move from frame to frame ----------------------------------------------------------------------------


def _open_text(path: Path) -> IO[str]:
    """Open a text file, a compressed one (.gz, .bz2) too."""
    opened: Any = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix.lower(), open)
    file: IO[str] = opened(path, "rt", encoding="utf-8", errors="replace")
    return file


def order_of(names: Sequence[str], first: Sequence[str], path: Path, frame: int) -> IntArray | None:
    """Return where each atom of the first frame stands in a later one `(n_atoms,)`, None where nothing moved.

    Raises TrajectoryError where the frames hold different atoms, or moved ones that share a name.
    """
    if names == first:
        return None
    if len(names) != len(first):
        raise TrajectoryError(
            f"{path}: frame {frame} has {len(names)} atoms, not as many as the first ({len(first)}); split the file."
        )
    moved = [k for k, (one, two) in enumerate(zip(names, first, strict=True)) if one != two]
    k, count = moved[0], Counter(first)
    here = f"{path}: frame {frame} names other atoms than the first (atom {k + 1} is {names[k]!r}, not {first[k]!r})"
    if Counter(names) != count:
        raise TrajectoryError(f"{here}; split the file.")
    if any(count[first[k]] > 1 for k in moved):
        raise TrajectoryError(f"{here}, and names that occur twice do not tell the order; write it again in one order.")
    order = np.arange(len(first))
    place = {names[k]: k for k in moved}
    order[moved] = [place[first[k]] for k in moved]
    return order


def _pdb_names(path: Path) -> Iterator[list[str]]:
    """Yield atom name, alternate, residue and element of all atoms of each model of a PDB file."""
    names: list[str] = []
    with _open_text(path) as file:
        for line in file:
            if line.startswith(("ATOM", "HETATM")):
                names.append(" ".join(f"{line[12:27]} {line[76:78]}".split()))
            elif line.startswith("END") and names:
                yield names
                names = []
    if names:
        yield names


def _arc_names(path: Path) -> Iterator[list[str]]:
    """Yield name and type of all atoms of each frame of a Tinker archive."""
    with _open_text(path) as file:
        for title in file:
            words = title.split()
            if not words or not words[0].isdigit():
                return
            names: list[str] = []
            while len(names) < int(words[0]) and (row := file.readline().split()):
                if len(row) > 5 and not row[1].replace(".", "").isdigit():  # else the cell
                    names.append(f"{row[1]} {row[5]}")
            yield names


def _gro_frames(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the title, and residue and name of all atoms, of each frame of a GRO file."""
    with _open_text(path) as file:
        for title in file:
            count = file.readline().strip()
            if not count.isdigit():
                return
            names = [" ".join(f"{line[:10]} {line[10:15]}".split()) for line in itertools.islice(file, int(count))]
            file.readline()
            yield title, names


def _moved_note(moved: dict[int, IntArray]) -> tuple[str, ...]:
    """Return the line on reordered frames, none where none is."""
    if not moved:
        return ()
    return (f"{len(moved)} frames, from {min(moved)} on, list their atoms in another order; matched by their names.",)


# ---- MDTraj and MDAnalysis ------------------------------------------------------------------------------------------


_PASS_FRAMES = 4096
_NM = 0.1
_GRO_TIME = re.compile(r"t= *\d+\.\d+")  # as MDTraj looks for it


class MdtrajReader(TrajectoryReader):
    """A format that MDTraj reads. XTC, TRR and NetCDF are read block by block, others whole into memory.

    Raises TrajectoryError for what MDTraj cannot read, InputError when `top` is needed or does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        self._format = format_of(path)
        self.notes = unit_note(self._format)
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
        if stated is not None:
            self.scene = self._at_first_frame(stated)
        elif not streamed and self.n_frames:
            first = self._read(0, 1, 1)[0]
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
            titled = list(_gro_frames(path))
            self._put_in_order(frames, [names for _, names in titled])
            # Where one title states no time MDTraj counts frames.
            self.times_known = all(_GRO_TIME.search(title) for title, _ in titled)
        elif suffix.endswith((".pdb", ".pdb.gz")):
            self._put_in_order(frames, _pdb_names(path))
        elif suffix.endswith(".arc"):
            self._put_in_order(frames, _arc_names(path))
        return frames

    def _put_in_order(self, frames: Any, names: Iterable[Sequence[str]]) -> None:
        """Put the atoms of each frame into the first one's order: MDTraj goes by their place."""
        first: Sequence[str] = ()
        moved: dict[int, IntArray] = {}
        for frame, here in enumerate(names):
            first = here if frame == 0 else first
            order = order_of(here, first, self.path, frame)
            if order is not None:
                moved[frame] = order
        if moved and (len(first) != self.n_atoms or max(moved) >= self.n_frames):
            raise TrajectoryError(
                f"{self.path}: later frames list their atoms in another order, and MDTraj leaves some out; write it "
                "again in one order, without alternates."
            )
        for frame, order in moved.items():
            frames.xyz[frame] = frames.xyz[frame][order]
        self.notes += _moved_note(moved)

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
        super().close()
        if self._file is not None:
            self._file.close()
        self._file = None
        self._ascii.close()


class MdanalysisReader(TrajectoryReader):
    """A format of MDAnalysis, read frame by frame. Raises TrajectoryError; InputError for a `top` that does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        import MDAnalysis
        from MDAnalysis.coordinates.core import get_reader_for

        super().__init__(path)
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
        self.scene = None if stated is None else self._at_first_frame(stated)

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
        return (self._reader[k if self._kept is None else int(self._kept[k])] for k in range(start, stop, stride))

    def close(self) -> None:
        super().close()
        if self._reader is not None:
            self._reader.close()
        self._reader = None


# ---- H5MD of other programs -----------------------------------------------------------------------------------------


class H5mdReader(TrajectoryReader):
    """Reads the positions of an H5MD file's particles. Times without a unit are not known.

    Raises TrajectoryError for a file that is damaged or states no unit of length, InputError for several groups of
    particles or a `top` that does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        self._file = open_hdf5(path)
        try:
            with damage_reported(path):
                self._read_headers()
            stated = self._scene_of(top)
            self.scene = None if stated is None else self._at_first_frame(stated)
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
            raise TrajectoryError(
                f"{self.path} is damaged in frames {start} to {stop} ({first_line(error)})."
            ) from error
        return rows

    def close(self) -> None:
        super().close()
        self._file.close()


# ---- XYZ ------------------------------------------------------------------------------------------------------------


_FIELD = re.compile(r'(\w+)\s*=\s*(?:"([^"]*)"|\'([^\']*)\'|(\S+))')
_SYMBOL_COLUMNS = ("species", "element", "symbols", "atom_types")


class _Frame(NamedTuple):
    names: list[str]
    positions_nm: Float32Array
    cell_nm: Float64Array | None


class XyzReader(TrajectoryReader):
    """Reads an XYZ file whole into memory; names or elements are the file's, bonds found by distance.

    Frames whose atoms stand in another order are put into the first one's where names tell it. Raises TrajectoryError
    for a damaged file or one of changing atoms, InputError for a `top` that does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        frames, moved = _frames(path)
        if not frames:
            raise TrajectoryError(f"{path} holds no frame.")
        first, self.n_frames, self.n_atoms = frames[0], len(frames), len(frames[0].names)
        self.time_ps, self.times_known = np.arange(self.n_frames, dtype=np.float64), False
        self.notes = moved
        self._positions = np.stack([f.positions_nm for f in frames])
        cells = [f.cell_nm for f in frames if f.cell_nm is not None]
        self._cells = np.stack(cells) if len(cells) == self.n_frames else None
        stated = self._scene_of(top)
        if stated is None:
            self.scene = named_scene(path, first.names, _elements(first.names, path), first.positions_nm, first.cell_nm)
        else:
            self.scene = self._at_first_frame(stated)

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        return self._positions[start:stop:stride].copy()

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        return None if self._cells is None else self._cells[start:stop:stride].copy()


def _frames(path: Path) -> tuple[list[_Frame], tuple[str, ...]]:
    frames: list[_Frame] = []
    moved = {}
    try:
        with _open_text(path) as file:
            for count in file:
                if not count.strip():
                    continue
                n, comment = int(count), file.readline()
                rows = [line.split() for line in itertools.islice(file, n)]
                frame = _frame(rows, comment, n)
                order = order_of(frame.names, frames[0].names, path, len(frames)) if frames else None
                if order is not None:
                    moved[len(frames)] = order
                    frame = _Frame(frames[0].names, frame.positions_nm[order], frame.cell_nm)
                frames.append(frame)
    except (ValueError, IndexError, OSError, EOFError, zlib.error) as error:
        raise TrajectoryError(f"{path} is damaged or cut short in frame {len(frames)} ({error}).") from error
    return frames, _moved_note(moved)


def _frame(rows: list[list[str]], comment: str, n_atoms: int) -> _Frame:
    if len(rows) != n_atoms or not n_atoms:
        raise ValueError(f"{len(rows)} of {n_atoms} atoms")
    fields = {key: quoted or single or bare for key, quoted, single, bare in _FIELD.findall(comment)}
    name_at, x_at = 0, 1
    if "Properties" in fields:
        parts, column, at = fields["Properties"].split(":"), 0, {}
        for key, size in zip(parts[::3], parts[2::3], strict=True):
            at[key.lower()] = column
            column += int(size)
        name_at = next((at[key] for key in _SYMBOL_COLUMNS if key in at), -1)
        x_at = at.get("pos", -1)
        if min(name_at, x_at) < 0:
            raise ValueError("its Properties name no species or no pos")
    positions = np.array([row[x_at : x_at + 3] for row in rows], dtype=np.float64) * _NM
    if positions.shape != (n_atoms, 3):
        raise ValueError("three coordinates are needed for each atom")
    return _Frame([row[name_at] for row in rows], positions.astype(np.float32), _cell(fields))


def _cell(fields: dict[str, str]) -> Float64Array | None:
    """Return the box vectors `(3, 3)` nm, None where there is none or not all three directions are periodic."""
    if "Lattice" not in fields or any(x.upper()[:1] != "T" for x in fields.get("pbc", "T T T").split()):
        return None
    cell = np.array(fields["Lattice"].split(), dtype=np.float64).reshape(3, 3) * _NM
    return cell if abs(np.linalg.det(cell)) > 0.0 else None


def _elements(names: list[str], path: Path) -> list[str]:
    """Return elements of symbols or PDB names: CA in capitals is an alpha carbon, Ca calcium."""
    out = []
    for i, name in enumerate(names):
        symbol = name.isalpha() and (len(name) == 1 or name[1:].islower() or name in ("CL", "BR"))
        element = element_symbol(name, "UNK", name.capitalize() if symbol else "")
        if element is None:
            raise InputError(f"{path}: the element of atom {i} ({name}) is not known; give a PDB file with `top`.")
        out.append(element)
    return out


# ---- ASE ------------------------------------------------------------------------------------------------------------


class AseReader(TrajectoryReader):
    """A file of ASE's `Trajectory`, read frame by frame; elements are the file's, bonds found by distance.

    Raises TrajectoryError where ase is not installed or cannot read it, InputError for a `top` that does not fit.
    """

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
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
        try:
            stated = self._scene_of(top)
        except InputError:
            self.close()
            raise
        if stated is None:
            cell = first.cell.array * _NM if first.pbc.all() else None
            names = [f"{e}{k + 1}" for k, e in enumerate(self._elements)]
            stated = named_scene(path, names, self._elements, first.positions * _NM, cell)
        self.scene = self._at_first_frame(stated)

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
        try:
            return [self._frames[k] for k in range(start, stop, stride)]
        except Exception as error:  # ase raises whatever its parts do
            raise TrajectoryError(
                f"{self.path} is damaged in frames {start} to {stop} ({first_line(error)})."
            ) from error

    def close(self) -> None:
        super().close()
        self._frames.close()
