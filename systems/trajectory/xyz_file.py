"""XYZ files, and extended ones: `Lattice`, `pbc` and `Properties` of each frame's second line are read.

Positions in Å. https://github.com/libAtoms/extxyz: `Lattice` holds the rows a, b, c; `Properties` the columns as
`name:type:number` (`species:S:1:pos:R:3` where there is none).
"""

from __future__ import annotations

import itertools
import re
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from systems.chemistry.element_data import element_symbol
from systems.errors import InputError, TrajectoryError
from systems.trajectory.base import TrajectoryReader
from systems.trajectory.foreign_scenes import named_scene, scene_from_structure
from systems.trajectory.frame_block import Float32Array, Float64Array
from systems.trajectory.frame_orders import moved_note, open_text, order_of

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
