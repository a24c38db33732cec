"""Trajectories of other programs: through MDTraj, MDAnalysis and ASE; extended XYZ, read here.

Which one reads a format, and what it would make up, stands in `foreign_scenes`. XYZ: positions in Å; `Lattice`, `pbc`
and `Properties` of each frame's second line are read (https://github.com/libAtoms/extxyz): `Lattice` holds the rows
a, b, c; `Properties` the columns as `name:type:number` (`species:S:1:pos:R:3` where there is none).
"""

from __future__ import annotations

import bz2
import contextlib
import gzip
import itertools
import re
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import read_cells
from systems.chemistry.element_data import element_symbol
from systems.errors import InputError, TrajectoryError, first_line
from systems.scene import IntArray
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import (
    NONE,
    bonds_completed,
    format_of,
    named_scene,
    scene_from_mdtraj_topology,
    scene_from_universe,
)
from systems.trajectory.store import Float32Array, Float64Array

_NM = 0.1
# Magic, atoms, step, time, nine numbers of the cell, atoms again; then the precision, a float32.
_XTC_PRECISION = 56


def counted_note(time_ps: Float64Array) -> tuple[str, ...]:
    """Return the line on times `(n_frames,)` that are what MDTraj writes where nobody stated any."""
    if len(time_ps) < 3 or not np.array_equal(time_ps, np.arange(len(time_ps))):
        return ()
    return ("its times are 0, 1, 2, ... ps, which MDTraj also writes where none were given; if so, state `dt_ps`.",)


def check_same_atoms(names: Sequence[str], first: Sequence[str], path: Path, frame: int) -> None:
    """Raise TrajectoryError where a frame does not list the atoms of the first frame, in its order."""
    if list(names) != list(first):
        raise TrajectoryError(
            f"{path}: frame {frame} lists other atoms than the first, or in another order; write it again in one order."
        )


@contextlib.contextmanager
def _ascii_path(path: Path) -> Iterator[Path]:
    """Make a link to a file in a folder of its own: MDTraj's libraries in C take paths of ASCII alone."""
    if str(path).isascii():
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="surromd-") as folder:
        link = Path(folder) / f"frames{''.join(path.suffixes[-2:])}"
        link.symlink_to(path.resolve(), target_is_directory=path.is_dir())
        yield link


def _open_text(path: Path) -> IO[str]:
    """Open a text file, a compressed one (.gz, .bz2) too."""
    opened: Any = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix.lower(), open)
    file: IO[str] = opened(path, "rt", encoding="utf-8", errors="replace")
    return file


# ---- MDTraj and MDAnalysis ------------------------------------------------------------------------------------------


_PASS_FRAMES = 4096
_GRO_TIME = re.compile(r"t= *\d+\.\d+")  # as MDTraj looks for it


class _InMemory(TrajectoryReader):
    """Holds all positions `(n, n_atoms, 3)` nm and box vectors `(n, 3, 3)` nm."""

    _positions: Float32Array
    _cells: Float64Array | None

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        return self._positions[start:stop:stride].copy()

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        return None if self._cells is None else self._cells[start:stop:stride].copy()


class MdtrajReader(_InMemory):
    """A format that MDTraj reads, whole into memory. Raises TrajectoryError for what MDTraj cannot read, InputError
    when `top` is needed or does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        self._format = format_of(path)
        self.notes = self._format.notes
        stated = self._scene_of(top)
        whole = self._load(None if stated is None or self._format.names_atoms else stated.to_mdtraj_topology())
        self._positions = np.asarray(whole.xyz, dtype=np.float32)
        cells = whole.unitcell_vectors
        self._cells = None if cells is None or not cells.any() else np.asarray(cells, dtype=np.float64)
        self.n_frames, self.n_atoms = whole.n_frames, whole.n_atoms
        self.time_ps = np.asarray(whole.time, dtype=np.float64)
        self.times_known = self._format.times != NONE
        if self._format.name in ("PDB", "GRO"):
            self._check_text()
        if stated is None and self.n_frames:
            made = scene_from_mdtraj_topology(whole.topology, self._positions[0], name=path.stem, source=path.name)
            stated = bonds_completed(made, self._cells)
        self._take_scene(stated, top)

    def _load(self, topology: Any) -> Any:
        import mdtraj

        path = self.path
        is_mol2 = path.name.lower().endswith(".mol2") and path.is_file()
        n_molecules = path.read_bytes().count(b"@<TRIPOS>MOLECULE") if is_mol2 else 1
        if n_molecules > 1:
            raise InputError(f"{path} holds {n_molecules} molecules, of which MDTraj reads the first; write PDB.")
        try:
            with _ascii_path(path) as seen:
                return mdtraj.load(str(seen), **({} if topology is None else {"top": topology}))
        except Exception as error:  # each MDTraj reader raises errors of its own
            needs = topology is None and not self._format.names_atoms
            hint = " (a format without topology: give one with `top`)" if needs else ""
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}{hint}.") from error

    def _check_text(self) -> None:
        """Compare the atoms of all frames, which MDTraj takes by their place, and look for the times of GRO titles."""
        with _open_text(self.path) as file:
            lines = file.read().splitlines()
        if self._format.name == "GRO":
            each = self.n_atoms + 3
            rows = [line[:15] for k, line in enumerate(lines[: each * self.n_frames]) if 2 <= k % each < each - 1]
            # Where one title states no time MDTraj counts frames.
            self.times_known = all(_GRO_TIME.search(line) for line in lines[: self.n_frames * each : each])
        else:
            rows = [line[12:27] + line[76:78] for line in lines if line.startswith(("ATOM", "HETATM"))]
        n = len(rows) // max(self.n_frames, 1)
        for k in range(1, self.n_frames):
            check_same_atoms(rows[k * n : (k + 1) * n], rows[:n], self.path, k)


class StreamReader(TrajectoryReader):
    """An XTC or TRR file of another program, or a NetCDF file of Amber's convention, read by MDTraj block by block. TRR
    frames without positions are left out. Raises TrajectoryError for what it cannot read, InputError when `top` does
    not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        import mdtraj

        super().__init__(path)
        self._links = contextlib.ExitStack()
        self._format = format_of(path)
        self._nm = _NM if self._format.name == "NetCDF (Amber)" else 1.0
        self._kept: IntArray | None = None
        self._has_cell, times = True, []
        try:
            seen = self._links.enter_context(_ascii_path(path))
            self._file = mdtraj.open(str(seen))
            self.n_atoms = int(self._file.read(n_frames=1)[0].shape[1])
            self._file.seek(0)
            while True:
                time = self._file.read(n_frames=_PASS_FRAMES, atom_indices=np.array([0]))[1]
                if time is None or not len(time):
                    break
                times.append(np.asarray(time, dtype=np.float64))
            self.times_known = bool(times)
            self.time_ps = np.concatenate(times) if times else np.arange(len(self._file), dtype=np.float64)
            if self._format.name == "TRR":
                has, self._has_cell = _trr_frames(seen)
                self._kept, self.time_ps = np.flatnonzero(has), self.time_ps[has]
                if not has.all():
                    self.notes = (f"frames without positions, left out: {(~has).sum()}.",)
        except Exception as error:  # MDTraj raises errors of many classes
            self._links.close()
            raise TrajectoryError(f"{path} cannot be read: {first_line(error)}.") from error
        if self._format.name == "XTC":
            self.grid_nm = _xtc_grid_nm(path)
        if self._format.name == "NetCDF (Amber)":
            self._check_units(self._file._handle.variables)
        self.n_frames = len(self.time_ps)
        if not self.n_frames:
            raise InputError(f"{path} holds no positions.")
        self.notes += counted_note(self.time_ps) if self.times_known else ()
        self._take_scene(self._scene_of(top), top)

    def _check_units(self, variables: Any) -> None:
        """Raise TrajectoryError unless a NetCDF file is in Å and ps: MDTraj takes the numbers as they are."""
        for name, usual in (("coordinates", "angstrom"), ("time", "picosecond"), ("cell_lengths", "angstrom")):
            variable = variables.get(name)
            unit = getattr(variable, "units", usual)
            unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
            if unit != usual or float(np.squeeze(getattr(variable, "scale_factor", 1.0))) != 1.0:
                raise TrajectoryError(f"{self.path}: its {name!r} is scaled or in {unit!r}; rewrite it in {usual!r}.")

    def _stored(self, start: int, stop: int) -> list[Any]:
        """Return what MDTraj reads of frames: positions and times, then steps and boxes, or lengths and angles."""
        kept = np.arange(start, stop) if self._kept is None else self._kept[start:stop]
        try:
            self._file.seek(int(kept[0]))
            stored = self._file.read(n_frames=int(kept[-1] - kept[0]) + 1)
        except Exception as error:  # MDTraj raises errors of many classes
            reason = first_line(error)
            raise TrajectoryError(f"{self.path} is damaged in frames {start} to {stop} ({reason}).") from error
        return [x if x is None or self._kept is None else np.asarray(x)[kept - kept[0]] for x in stored]

    def _blocks(self, start: int, stop: int, stride: int) -> Iterator[list[Any]]:
        """What MDTraj reads of each `stride`-th frame, as `_stored` returns it, a block at a time."""
        block = max(_PASS_FRAMES // stride, 1) * stride
        for k in range(start, stop, block):
            yield [x if x is None else np.asarray(x)[::stride] for x in self._stored(k, min(k + block, stop))]

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        parts = [stored[0] for stored in self._blocks(start, stop, stride)]
        return np.concatenate(parts).astype(np.float32, copy=False) * np.float32(self._nm)

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if start >= stop:
            return np.empty((0, 3, 3))
        parts = [stored[2:4] for stored in self._blocks(start, stop, stride)]
        if parts[0][1] is None or not self._has_cell:
            return None
        cells = np.concatenate([part[1] for part in parts]).astype(np.float64)
        if self._format.name == "NetCDF (Amber)":
            return read_cells(np.concatenate([part[0] for part in parts]) * _NM, cells)
        return cells if cells.any() else None

    def close(self) -> None:
        super().close()
        self._file.close()
        self._links.close()


def _xtc_grid_nm(path: Path) -> float | None:
    """Return what an XTC file rounds coordinates to, nm, by the precision in its first frame's header (1000: 0.001 nm);
    None where it states none, as of nine atoms or fewer, which are not rounded."""
    with path.open("rb") as file:
        header = file.read(_XTC_PRECISION + 8)
    if len(header) < _XTC_PRECISION + 8 or int.from_bytes(header[4:8], "big") <= 9:
        return None
    # Files of 2^31 bytes in a frame (magic 2023) differ behind the precision.
    precision = float(np.frombuffer(header, ">f4", 1, _XTC_PRECISION)[0])
    return 1.0 / precision if np.isfinite(precision) and precision > 0 else None


def _trr_frames(path: Path) -> tuple[npt.NDArray[np.bool_], bool]:
    """Return which frames of a TRR file hold positions `(n_frames,)`, and whether the first states a cell: MDTraj gives
    memory that nobody set for the others. Raises OSError."""
    from MDAnalysis.lib.formats.libmdaxdr import TRRFile

    with TRRFile(str(path)) as frames:
        has = np.array([frame.hasx for frame in frames], dtype=bool)
    with path.open("rb") as file:
        length = int.from_bytes(file.read(12)[8:], "big")
        file.seek(-(-length // 4) * 4 + 8, 1)
        return has, int.from_bytes(file.read(4), "big") > 0


class MdanalysisReader(TrajectoryReader):
    """A format of MDAnalysis, read frame by frame. Raises TrajectoryError; InputError for a `top` that does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        import MDAnalysis
        from MDAnalysis.coordinates.core import get_reader_for

        super().__init__(path)
        self._format = format_of(path)
        self.notes = self._format.notes
        self._kept: IntArray | None = None
        stated = self._scene_of(top)
        if stated is None and self._format.names_atoms:
            stated = scene_from_universe(path, name=path.stem)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                size = {} if stated is None else {"n_atoms": stated.n_atoms}
                kind = get_reader_for(str(path), format=self._format.mda)
                self._reader: Any = kind(str(path), convert_units=True, **size)
                self.n_frames, self.n_atoms = int(self._reader.n_frames), int(self._reader.n_atoms)
                self.time_ps, self.times_known = self._times()
        except InputError:
            raise
        except Exception as error:  # each of its readers raises errors of its own
            # Of a format that it does not know it lists all others in the lines that follow.
            why = first_line(error).partition(". The FORMATs")[0]
            raise TrajectoryError(
                f"{path} cannot be read by MDTraj or MDAnalysis {MDAnalysis.__version__}: {why}."
            ) from error
        self._take_scene(stated, top)

    def _times(self) -> tuple[Float64Array, bool]:
        """Return times `(n_frames,)` ps and whether the file states them; frames without positions are left out.
        MDAnalysis' own time step of 1 ps is none: only formats that state times are asked for them."""
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
            self.notes += (f"frames without positions, left out: {(~has).sum()}.",)
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
        self._reader.close()


# ---- XYZ and ASE ----------------------------------------------------------------------------------------------------


_FIELD = re.compile(r'(\w+)\s*=\s*(?:"([^"]*)"|\'([^\']*)\'|(\S+))')
_SYMBOL_COLUMNS = ("species", "element", "symbols", "atom_types")


class _Frame(NamedTuple):
    names: list[str]
    positions_nm: Float32Array
    cell_nm: Float64Array | None


class AtomsReader(_InMemory):
    """Reads an XYZ file, or one of ASE's `Trajectory`, whole into memory; names or elements are the file's, bonds found
    by distance. Raises TrajectoryError for a damaged file, one of changing atoms, or where ase is not installed;
    InputError for a `top` that does not fit."""

    def __init__(self, path: Path, top: Path | None) -> None:
        super().__init__(path)
        is_ase = path.suffix.lower() == ".traj"
        frames = _ase_frames(path) if is_ase else _xyz_frames(path)
        if not frames:
            raise TrajectoryError(f"{path} holds no frame.")
        first, self.n_frames, self.n_atoms = frames[0], len(frames), len(frames[0].names)
        for k, frame in enumerate(frames):
            check_same_atoms(frame.names, first.names, path, k)
        self.time_ps, self.times_known = np.arange(self.n_frames, dtype=np.float64), False
        self._positions = np.stack([f.positions_nm for f in frames])
        cells = [f.cell_nm for f in frames if f.cell_nm is not None]
        self._cells = np.stack(cells) if len(cells) == self.n_frames else None
        stated = self._scene_of(top)
        if stated is None:
            names = [f"{e}{k + 1}" for k, e in enumerate(first.names)] if is_ase else first.names
            stated = named_scene(path, names, _elements(first.names, path), first.positions_nm, first.cell_nm)
        self._take_scene(stated, top)


def _ase_frames(path: Path) -> list[_Frame]:
    try:
        from ase.io.trajectory import Trajectory
    except ImportError as error:
        raise TrajectoryError(
            f"{path} is read by ase: `pip install ase`, or convert it elsewhere by `ase convert {path.name} "
            f"{path.stem}.xyz`."
        ) from error
    try:
        with Trajectory(str(path)) as file:
            return [
                _Frame(
                    atoms.get_chemical_symbols(),
                    np.asarray(atoms.positions * _NM, dtype=np.float32),
                    atoms.cell.array * _NM if atoms.pbc.all() else None,
                )
                for atoms in file
            ]
    except Exception as error:  # ase raises whatever its parts do
        raise TrajectoryError(f"{path} cannot be read by ase: {first_line(error)}.") from error


def _xyz_frames(path: Path) -> list[_Frame]:
    frames: list[_Frame] = []
    try:
        with _open_text(path) as file:
            for count in file:
                if count.strip():
                    n, comment = int(count), file.readline()
                    frames.append(_frame([line.split() for line in itertools.islice(file, n)], comment, n))
    except (ValueError, IndexError, OSError, EOFError, zlib.error) as error:
        raise TrajectoryError(f"{path} is damaged or cut short in frame {len(frames)} ({error}).") from error
    return frames


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
