"""HDF5 trajectories that follow MDTraj's and H5MD's conventions at once, written and read by h5py alone.

MDTraj: `/coordinates` (n, n_atoms, 3) float32 nm, `/time` ps, `/topology` JSON (mdtraj.org, HDF5 format, version 1.1).
H5MD 1.1 (de Buyl, Colberg and Höfling, Comput. Phys. Commun. 185, 1546 (2014)): `/particles/trajectory/position` with
`value` and `time` as hard links onto the same datasets, so that the second convention takes no space.

What else frames may have. MDTraj: `/velocities` nm/ps, `/cell_lengths` nm, `/cell_angles` degrees. H5MD: `velocity` and
`force` beside `position`, as hard links, and `box/edges`. MDTraj has no place for forces; they lie in `/forces`,
kJ/mol/nm.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from systems.chemistry.distance_bonds import lengths_and_angles, read_cells
from systems.errors import InputError, TrajectoryError
from systems.scene import ATOMIC_NUMBERS, Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter
from systems.trajectory.foreign_readers import counted_note
from systems.trajectory.foreign_scenes import (
    bonds_completed,
    nm_per,
    ps_per,
    scene_from_structure,
    scene_of_mdtraj_hdf5,
)
from systems.trajectory.store import (
    CELLS,
    EDGES,
    FRAMES,
    Columns,
    Float32Array,
    Float64Array,
    FrameBlock,
    add_column,
    damage_reported,
    open_hdf5,
    program_version,
    read_rows,
)

# Of each column its units by MDTraj, its unit by H5MD, and H5MD's name beside `position`.
_UNITS = {
    "coordinates": (b"nanometers", "nm", ""),
    "time": (b"picoseconds", "ps", ""),
    "velocities": (b"nanometers/picosecond", "nm ps-1", "velocity"),
    "forces": (b"kilojoules_per_mole/nanometer", "kJ mol-1 nm-1", "force"),
    "cell_lengths": (b"nanometers", "nm", ""),
    "cell_angles": (b"degrees", "deg", ""),
}
_POSITION = "particles/trajectory/position"
_CHUNK_BYTES = 131_072
_BOND_TYPES = {1.0: "Single", 1.5: "Aromatic", 2.0: "Double", 3.0: "Triple"}


class Hdf5Writer(TrajectoryWriter):
    """Writes one HDF5 trajectory; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    def _lay_out(self, file: h5py.File, scene: Scene, columns: Sequence[str]) -> None:
        # MDTraj's and H5MD's groups, empty columns and units.
        version = program_version()
        about = {"conventions": "Pande", "conventionVersion": "1.1", "program": "surromd", "title": scene.name,
                 "programVersion": version, "application": "surromd"}  # fmt: skip
        for key, value in about.items():
            file.attrs[key] = np.bytes_(value.encode("ascii", "replace"))
        frame_bytes = 12 * max(scene.n_atoms, 1)
        chunk = min(max(_CHUNK_BYTES // frame_bytes, 1), 1024)
        periodic = scene.cell_nm is not None
        for name in ("coordinates", *columns):
            add_column(file, name, 0, "<f4", tail=(scene.n_atoms, 3), chunk=chunk)
        for name in ("cell_lengths", "cell_angles") if periodic else ():
            add_column(file, name, 0, "<f4", tail=(3,))
        for name, (units, unit, _) in _UNITS.items():
            if name in file:
                file[name].attrs["units"], file[name].attrs["unit"] = np.bytes_(units), unit
        file.create_dataset("topology", data=np.array([_topology_json(scene).encode("ascii")]))

        h5md = file.create_group("h5md")
        h5md.attrs["version"] = np.array([1, 1], dtype=np.int32)
        h5md.create_group("author").attrs["name"] = "surromd"
        creator = h5md.create_group("creator")
        creator.attrs["name"], creator.attrs["version"] = "surromd", version
        particles = file.create_group("particles/trajectory")
        box = particles.create_group("box")
        box.attrs["dimension"] = np.int32(3)
        box.attrs["boundary"] = np.array([b"periodic" if periodic else b"none"] * 3, dtype="S8")
        add_column(file, f"{_POSITION}/step", 0, "<i8")
        position = particles["position"]
        position["value"], position["time"] = file["coordinates"], file["time"]
        for name in columns:
            group = particles.create_group(_UNITS[name][2])
            group["value"], group["time"], group["step"] = file[name], file["time"], position["step"]
        if periodic:
            add_column(file, EDGES, 0, "<f8", tail=(3, 3)).attrs["unit"] = "nm"
            box["edges/time"], box["edges/step"] = file["time"], position["step"]
        particles["species"] = np.array([ATOMIC_NUMBERS.get(e, 0) for e in scene.elements], dtype=np.int32)
        particles["mass"] = scene.masses_da
        particles["mass"].attrs["unit"] = "u"

    def _adopt(self) -> None:
        if "coordinates" not in self.file:
            raise TrajectoryError(f"{self.path} holds no coordinates; it is the companion of a DCD file.")

    def _append(self, block: FrameBlock) -> None:
        columns: Columns = {"coordinates": block.positions_nm, **block.per_atom}
        columns[f"{_POSITION}/step"] = self._steps(block.time_ps, np.int64)
        stored: Columns = {FRAMES: block.positions_nm, **block.per_atom}
        if block.cell_nm is not None:
            columns["cell_lengths"], columns["cell_angles"] = lengths_and_angles(block.cell_nm)
            columns[EDGES] = stored[CELLS] = block.cell_nm
        self._store(block, columns, stored)


class Hdf5Reader(TrajectoryReader):
    """Reads our own HDF5 trajectories and MDTraj's. `top` gives the bonds to a topology of MDTraj's without any. Raises
    TrajectoryError when the file is damaged or incomplete, InputError when `top` does not fit."""

    # Of its unit of length.
    _nm = 1.0

    def __init__(self, path: Path, top: Path | None = None, file: h5py.File | None = None) -> None:
        super().__init__(path)
        self._file = open_hdf5(path) if file is None else file
        try:
            with damage_reported(path):
                self._read_headers(top)
        except BaseException:
            self._file.close()
            raise

    def _read_headers(self, top: Path | None) -> None:
        if "coordinates" not in self._file:
            raise TrajectoryError(f"{self.path} holds no /coordinates: it is not an MDTraj or surromd trajectory.")
        self._read_stored(self._file, self.path)
        self._take_coordinates(self._file["coordinates"])
        self._is_ours = "surromd" in self._file
        self.times_known = self._is_ours or "time" in self._file
        unused = () if top is None else (f"{top} is not used: the file holds its own topology.",)
        if self._is_ours:
            self.notes = unused
        else:
            self._check_units()
            self.notes = counted_note(self.time_ps) if self.times_known else ()
            self._take_foreign_scene(top, unused)
        if self.scene is not None and self.scene.n_atoms != self.n_atoms:
            raise TrajectoryError(f"{self.path}: {self.n_atoms} atoms a frame, but {self.scene.n_atoms} in its scene.")

    def _take_coordinates(self, column: h5py.Dataset) -> None:
        if column.ndim != 3 or column.shape[2] != 3:
            raise TrajectoryError(f"{self.path}: {column.name} of shape {column.shape}, not (n, n_atoms, 3).")
        self._coordinates, self.n_atoms = column, int(column.shape[1])

    def _check_units(self) -> None:
        """Raise TrajectoryError unless a file of others is in MDTraj's units, where it states any."""
        for name, per in (("coordinates", nm_per), ("time", ps_per), ("cell_lengths", nm_per)):
            units = self._file[name].attrs.get("units") if name in self._file else None
            if units is not None and per(units) != 1.0:
                shown = units.decode(errors="replace") if isinstance(units, bytes) else units
                raise TrajectoryError(f"{self.path}: {name} are in {shown!r}; write them in nm and ps.")

    def _take_foreign_scene(self, top: Path | None, unused: tuple[str, ...]) -> None:
        own = None
        if "topology" in self._file and self.n_frames:
            own = scene_of_mdtraj_hdf5(self.path, self._read(0, 1, 1)[0])
        if top is not None and (own is None or not len(own.bonds)):
            stated = scene_from_structure(top, name=self.path.stem)
            if stated.n_atoms != self.n_atoms or (own is not None and stated.elements != own.elements):
                raise InputError(f"{top} holds other atoms than {self.path} ({self.n_atoms}); give the matching one.")
            self.scene = self._at_first_frame(stated)
        elif own is not None:
            self.notes += unused
            self.scene = bonds_completed(own, self._read_cells(0, 1, 1))
            if added := len(self.scene.bonds) - len(own.bonds):
                self.notes += (f"{added} bonds that its topology lacks were found by distance.",)

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        frames = read_rows(self._coordinates, start, stop, stride, self.path)
        self._check_read(FRAMES, frames, slice(start, stop, stride))
        return frames if self._nm == 1.0 else frames * np.float32(self._nm)

    def _read_extra(self, name: str, start: int, stop: int, stride: int) -> Float32Array | None:
        if name not in self._file:
            return None
        values = read_rows(self._file[name], start, stop, stride, self.path)
        self._check_read(name, values, slice(start, stop, stride))
        return values

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        frames = slice(start, stop, stride)
        with damage_reported(self.path):
            if EDGES in self._file:
                cells: Float64Array = np.asarray(self._file[EDGES][frames], dtype=np.float64)
                self._check_read(CELLS, cells, frames)
                return cells
            if "cell_lengths" not in self._file or "cell_angles" not in self._file:
                return None
            return read_cells(self._file["cell_lengths"][frames], self._file["cell_angles"][frames])

    def close(self) -> None:
        super().close()
        self._file.close()


class H5mdReader(Hdf5Reader):
    """Reads the positions of another program's H5MD file. Times that are fixed steps are not used. Raises
    TrajectoryError for a file that is damaged or lacks units, InputError for several groups of particles or a `top`
    that does not fit."""

    def _read_headers(self, top: Path | None) -> None:
        groups = [g for g in self._file.get("particles", {}).values() if "position/value" in g]
        if len(groups) != 1:
            raise InputError(f"{self.path} holds positions of {len(groups)} groups of particles; write one alone.")
        self._edges, position = groups[0].get("box/edges"), groups[0]["position"]
        self._take_coordinates(position["value"])
        self.n_frames, self._nm = len(self._coordinates), self._per_unit(self._coordinates, nm_per)
        time = position.get("time")
        self.times_known = time is not None and time.ndim == 1
        self.time_ps = np.arange(self.n_frames, dtype=np.float64)
        if self.times_known:
            self.time_ps = self._per_unit(time, ps_per) * np.asarray(time[:], dtype=np.float64)
        if len(self.time_ps) != self.n_frames:
            raise TrajectoryError(f"{self.path} is damaged: {self.n_frames} frames, {len(self.time_ps)} times.")
        self._take_scene(self._scene_of(top), top)

    def _per_unit(self, column: h5py.Dataset, per: Callable[[Any], float | None]) -> float:
        """Return what one of a dataset's unit is in nm or ps."""
        factor = per(column.attrs.get("unit", ""))
        if factor is None:
            raise TrajectoryError(
                f"{self.path}: {column.name} states no known unit; set its `unit` to 'nm' or 'ps', say."
            )
        return factor

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if self._edges is None:
            return None
        with damage_reported(self.path):
            is_fixed = isinstance(self._edges, h5py.Dataset)
            column = self._edges if is_fixed else self._edges["value"]
            values = np.asarray(column[()] if is_fixed else column[start:stop:stride], dtype=np.float64)
            if is_fixed:
                values = np.broadcast_to(values, (len(range(start, stop, stride)), *values.shape))
            if values.ndim == 2:  # the edges of a cuboid
                values = values[..., None] * np.eye(3)
            nm = self._per_unit(column, nm_per) if "unit" in column.attrs else self._nm
            return nm * values if values.any() else None


def open_by_layout(path: Path, top: Path | None = None) -> Hdf5Reader:
    """Open another program's H5MD, without MDTraj's names beside it, or else ours and MDTraj's. Raises what they do."""
    file = open_hdf5(path)
    try:
        with damage_reported(path):
            is_h5md = "h5md" in file and "coordinates" not in file and "surromd" not in file
    except BaseException:
        file.close()
        raise
    return (H5mdReader if is_h5md else Hdf5Reader)(path, top, file)


def _topology_json(scene: Scene) -> str:
    """Return MDTraj's topology JSON. Runs of atoms become residues, so that the atom order survives any scene."""
    residue_of = scene.residue_of_atom.tolist()
    chains: list[dict[str, Any]] = []
    index = itertools.count()
    for chain, atoms in itertools.groupby(range(scene.n_atoms), lambda atom: scene.chain_of_residue[residue_of[atom]]):
        residues = []
        for residue, members in itertools.groupby(atoms, residue_of.__getitem__):
            digits = re.sub(r"[^0-9-]", "", scene.residue_ids[residue])
            number = int(digits) if re.fullmatch(r"-?\d+", digits) else residue + 1
            held = [
                {"index": atom, "name": scene.atom_names[atom], "element": scene.elements[atom],
                 "formal_charge": int(scene.formal_charges[atom])}
                for atom in members
            ]  # fmt: skip
            residues.append({"index": next(index), "name": scene.residue_names[residue], "resSeq": number,
                             "segmentID": "", "atoms": held})  # fmt: skip
        chains.append({"index": len(chains), "chain_id": chain or None, "residues": residues})
    orders = scene.bond_orders.tolist()
    metadata = [{"order": order or None, "type": _BOND_TYPES.get(order)} for order in orders]
    return json.dumps({"chains": chains, "bonds": scene.bonds.tolist(), "bond_metadata": metadata})
