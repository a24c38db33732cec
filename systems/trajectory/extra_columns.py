"""HDF5 columns beside positions: velocities, forces and the cell of each frame, for MDTraj and H5MD at once.

MDTraj: `/velocities` nm/ps, `/cell_lengths` nm, `/cell_angles` degrees. H5MD: `velocity` and `force` beside `position`,
as hard links, and `box/edges`. MDTraj has no place for forces; they lie in `/forces`, kJ/mol/nm.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.chemistry.cell_shape import lengths_and_angles
from systems.chemistry.cell_shape import read_cells as cells_of
from systems.errors import InputError
from systems.trajectory.frame_block import FrameBlock
from systems.trajectory.frame_store import EDGES, add_column

PER_ATOM = ("velocities", "forces")
# Dataset: H5MD's name, MDTraj's units, H5MD's unit.
_LAYOUT = {
    "velocities": ("velocity", b"nanometers/picosecond", "nm ps-1"),
    "forces": ("force", b"kilojoules_per_mole/nanometer", "kJ mol-1 nm-1"),
}
_POSITION = "particles/trajectory/position"


def check_wanted(wanted: Sequence[str], path: Path) -> None:
    """Raise InputError for a column that a file cannot have."""
    for name in wanted:
        if name not in PER_ATOM:
            raise InputError(f"{path}: no column {name!r} can be stored; known: {', '.join(PER_ATOM)}.")


def lay_out_extras(file: h5py.File, wanted: Sequence[str], *, periodic: bool) -> None:
    """Add empty columns for what is `wanted`, and for the cell; positions must be there already."""
    particles, position, coordinates = file["particles/trajectory"], file[_POSITION], file["coordinates"]
    for name in (n for n in PER_ATOM if n in wanted):
        h5md_name, units, unit = _LAYOUT[name]
        column = add_column(file, name, 0, "<f4", tail=coordinates.shape[1:], chunk=coordinates.chunks[0])
        column.attrs["units"], column.attrs["unit"] = np.bytes_(units), unit
        group = particles.create_group(h5md_name)
        group["value"], group["time"], group["step"] = column, position["time"], position["step"]
    box = particles["box"]
    box.attrs["boundary"] = np.array([b"periodic" if periodic else b"none"] * 3, dtype="S8")
    if not periodic:
        return
    for name, units, unit in (("cell_lengths", b"nanometers", "nm"), ("cell_angles", b"degrees", "deg")):
        column = add_column(file, name, 0, "<f4", tail=(3,))
        column.attrs["units"], column.attrs["unit"] = np.bytes_(units), unit
    edges = add_column(file, EDGES, 0, "<f8", tail=(3, 3))
    edges.attrs["unit"] = "nm"
    box["edges/time"], box["edges/step"] = position["time"], position["step"]


def extra_values(
    file: h5py.File, block: FrameBlock, cell_nm: npt.ArrayLike | None, where: str
) -> dict[str, npt.NDArray[Any]]:
    """Return the values of a block by dataset name.

    `cell_nm` (3, 3): the cell of frames that come without one. Raises InputError when velocities or forces are
    given for some frames of a file and not for others.
    """
    values: dict[str, npt.NDArray[Any]] = {}
    for name, given in (("velocities", block.velocities_nm_ps), ("forces", block.forces_kj_mol_nm)):
        if (given is not None) != (name in file):
            state = "holds" if name in file else "was started without"
            raise InputError(f"{where}: this file {state} {name}; give them with every frame or with none.")
        if given is not None:
            values[name] = given
    if EDGES in file:
        cell = block.cell_nm
        if cell is None:
            cell = np.broadcast_to(np.asarray(cell_nm, dtype=np.float64), (len(block), 3, 3))
        values["cell_lengths"], values["cell_angles"] = lengths_and_angles(cell)
        values[EDGES] = np.asarray(cell)
    elif block.cell_nm is not None:
        raise InputError(f"{where}: this file has no periodic cell, but frames came with one.")
    return values


def read_cells(file: h5py.File, start: int, stop: int, stride: int) -> npt.NDArray[np.float64] | None:
    """Return the box vectors `(n, 3, 3)` nm of frames, None in a file that is not periodic. MDTraj's files too."""
    frames = slice(start, stop, stride)
    if EDGES in file:
        cells: npt.NDArray[np.float64] = np.asarray(file[EDGES][frames], dtype=np.float64)
        return cells
    if "cell_lengths" in file and "cell_angles" in file:
        return cells_of(file["cell_lengths"][frames], file["cell_angles"][frames])
    return None
