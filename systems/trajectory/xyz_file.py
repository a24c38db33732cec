"""Files that name the atoms in every frame: XYZ, extended XYZ and ASE's own trajectories (`.traj`, where ase is there).

XYZ: positions in Å; `Lattice`, `pbc` and `Properties` of each frame's second line are read
(https://github.com/libAtoms/extxyz): `Lattice` holds the rows a, b, c; `Properties` the columns as `name:type:number`
(`species:S:1:pos:R:3` where there is none).
"""

from __future__ import annotations

import bz2
import gzip
import itertools
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import element_symbol
from systems.errors import InputError, TrajectoryError, first_line
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import named_scene, scene_from_structure
from systems.trajectory.frame_store import Float32Array, Float64Array

IntArray = npt.NDArray[np.int64]


def open_text(path: Path) -> IO[str]:
    """Open a text file, a compressed one (.gz, .bz2) too."""
    suffix = path.suffix.lower()
    if suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8", errors="replace")
    if suffix == ".bz2":
        return bz2.open(path, "rt", encoding="utf-8", errors="replace")
    return path.open(encoding="utf-8", errors="replace")


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
    k = next(k for k, (one, two) in enumerate(zip(names, first, strict=True)) if one != two)
    here = f"{path}: frame {frame} names other atoms than the first (atom {k + 1} is {names[k]!r}, not {first[k]!r})"
    if Counter(names) != Counter(first):
        raise TrajectoryError(f"{here}; split the file.")
    moved = [name for name, other in zip(first, names, strict=True) if name != other]
    if any(first.count(name) > 1 for name in set(moved)):
        raise TrajectoryError(f"{here}, and names that occur twice do not tell the order; write it again in one order.")
    place: dict[str, list[int]] = {}
    for j, name in enumerate(names):
        place.setdefault(name, []).append(j)
    return np.array([place[name].pop(0) for name in first], dtype=np.int64)


def orders(frames: Iterable[Sequence[str]], path: Path) -> tuple[dict[int, IntArray], int]:
    """Return the order by frame of those that differ from the first, and the number of atoms in a frame.

    `frames`: the atoms' names of each frame. Raises TrajectoryError as `order_of`.
    """
    first: Sequence[str] | None = None
    moved: dict[int, IntArray] = {}
    for frame, names in enumerate(frames):
        first = names if first is None else first
        order = order_of(names, first, path, frame)
        if order is not None:
            moved[frame] = order
    return moved, 0 if first is None else len(first)


def pdb_names(path: Path) -> Iterator[list[str]]:
    """Yield atom name, alternate, residue and element of all atoms of each model of a PDB file."""
    names: list[str] = []
    with open_text(path) as file:
        for line in file:
            if line.startswith(("ATOM", "HETATM")):
                names.append(" ".join(f"{line[12:27]} {line[76:78]}".split()))
            elif line.startswith("END") and names:
                yield names
                names = []
    if names:
        yield names


def arc_names(path: Path) -> Iterator[list[str]]:
    """Yield name and type of all atoms of each frame of a Tinker archive."""
    with open_text(path) as file:
        for title in file:
            words = title.split()
            if not words or not words[0].isdigit():
                return
            names: list[str] = []
            while len(names) < int(words[0]) and (row := file.readline().split()):
                if len(row) > 5 and not row[1].replace(".", "").isdigit():  # else the cell
                    names.append(f"{row[1]} {row[5]}")
            yield names


def gro_frames(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the title, and residue and name of all atoms, of each frame of a GRO file."""
    with open_text(path) as file:
        for title in file:
            count = file.readline().strip()
            if not count.isdigit():
                return
            names = [" ".join(f"{line[:10]} {line[10:15]}".split()) for line in itertools.islice(file, int(count))]
            file.readline()
            yield title, names


def moved_note(moved: dict[int, IntArray]) -> tuple[str, ...]:
    """Return the line on reordered frames, none where none is."""
    if not moved:
        return ()
    first = min(moved)
    return (f"{len(moved)} frames, from {first} on, list their atoms in another order; matched by their names.",)


# ---- XYZ ------------------------------------------------------------------------------------------------------------


_NM = 0.1
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
        self.path = path
        if not path.exists():
            raise TrajectoryError(f"{path} does not exist.")
        self.record, self.flags, self.chunk_idx, self.scalars = {}, None, None, {}
        frames, moved = _frames(path)
        if not frames:
            raise TrajectoryError(f"{path} holds no frame.")
        first, self.n_frames, self.n_atoms = frames[0], len(frames), len(frames[0].names)
        self.time_ps, self.times_known = np.arange(self.n_frames, dtype=np.float64), False
        self.notes = moved
        self._positions: Float32Array | None = np.stack([f.positions_nm for f in frames])
        cells = [f.cell_nm for f in frames if f.cell_nm is not None]
        self._cells = np.stack(cells) if len(cells) == self.n_frames else None
        if top is None:
            self.scene = named_scene(path, first.names, _elements(first.names, path), first.positions_nm, first.cell_nm)
            return
        stated = scene_from_structure(top, name=path.stem)
        if stated.n_atoms != self.n_atoms:
            raise InputError(f"{top} has {stated.n_atoms} atoms, {path} has {self.n_atoms}; give the matching one.")
        self.scene = stated.with_positions(first.positions_nm)

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        if self._positions is None:
            raise InputError(f"{self.path} is closed.")
        return self._positions[start:stop:stride].copy()

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        return None if self._cells is None else self._cells[start:stop:stride].copy()

    def close(self) -> None:
        self._positions = None


def _frames(path: Path) -> tuple[list[_Frame], tuple[str, ...]]:
    frames: list[_Frame] = []
    moved = {}
    try:
        with open_text(path) as file:
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
    return frames, moved_note(moved)


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
