"""HDF5 trajectories that follow MDTraj's and H5MD's conventions at once, written and read by h5py alone; others' H5MD.

MDTraj: `/coordinates` (n, n_atoms, 3) float32 nm, `/time` ps, `/topology` JSON (mdtraj.org, HDF5 format, version 1.1).
H5MD 1.1 (de Buyl, Colberg and Höfling, Comput. Phys. Commun. 185, 1546 (2014)): `/particles/trajectory/position` with
`value` and `time` as hard links onto the same datasets, so that the second convention takes no space.

What else frames may have. MDTraj: `/velocities` nm/ps, `/cell_lengths` nm, `/cell_angles` degrees. H5MD: `velocity` and
`force` beside `position`, as hard links, and `box/edges`. MDTraj has no place for forces; they lie in `/forces`,
kJ/mol/nm.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import lengths_and_angles
from systems.chemistry.distance_bonds import read_cells as cells_of
from systems.errors import InputError, TrajectoryError, first_line
from systems.files.outside import UNREADABLE
from systems.files.whole_file import Checksums, check_frames_read, frame_checksums, refuse_existing
from systems.scene import ATOMIC_NUMBERS, Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter, check_same_topology, unused_top_note
from systems.trajectory.companion_writer import refuse_other_topology, topology_bytes, topology_path, write_topology
from systems.trajectory.foreign_readers import counted_note
from systems.trajectory.foreign_scenes import nm_per, ps_per, scene_from_structure
from systems.trajectory.frame_store import (
    CELLS,
    CHECKSUMS,
    EDGES,
    FRAMES,
    Float32Array,
    Float64Array,
    FrameBlock,
    FrameStore,
    add_column,
    columns_with_frames,
    consistent_length,
    create_store,
    damage_reported,
    get_json,
    open_hdf5,
    program_version,
    read_record,
    read_run_id,
)

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


# ---- ours and MDTraj's ----------------------------------------------------------------------------------------------


_CHUNK_BYTES = 131_072
_STRIDED_READ_FRAMES = 8192
_BOND_TYPES = {1.0: "Single", 1.5: "Aromatic", 2.0: "Double", 3.0: "Triple"}


class Hdf5Writer(TrajectoryWriter):
    """Writes one HDF5 trajectory; see `systems.trajectory.codec.open_writer` for the arguments and errors."""

    def __init__(
        self,
        path: Path,
        scene: Scene,
        record: dict[str, Any],
        *,
        append: bool,
        overwrite: bool,
        columns: Sequence[str] = (),
        run_id: str = "",
    ) -> None:
        self.path, self.scene = path, scene
        check_wanted(columns, path)
        topology = b"" if append and topology_path(path).exists() else topology_bytes(scene)
        if not append:
            refuse_existing(path, overwrite)
            refuse_other_topology(path, topology, overwrite=overwrite)
            names = (FRAMES, *columns, *([] if scene.cell_nm is None else [CELLS]))
            create_store(
                path,
                scene,
                record,
                lambda file: _lay_out(file, scene, columns),
                overwrite=overwrite,
                run_id=run_id,
                checksums=names,
            )
        self._store = FrameStore(path)
        try:
            check_same_topology(path, self._store.scene, scene)
            if "coordinates" not in self._store.file:
                raise TrajectoryError(f"{path} holds no coordinates; it is the companion of a DCD file.")
            write_topology(path, topology)
            new = {key: value for key, value in record.items() if key not in self._store.record}
            if append and new:
                self._store.update_record(new)
        except BaseException:
            self._store.close()
            raise
        self.n_frames, self.last_time_ps = self._store.n_frames, self._store.last_time_ps

    def _append(self, block: FrameBlock) -> None:
        self._refuse_closed()
        timestep_ps = self._store.record.get("timestep_ps")
        if isinstance(timestep_ps, int | float) and timestep_ps > 0:
            step = np.rint(block.time_ps / timestep_ps).astype(np.int64)
        else:
            step = np.arange(self.n_frames, self.n_frames + len(block), dtype=np.int64)
        extra = extra_values(self._store.file, block, self.scene.cell_nm, f"{self.path}, after frame {self.n_frames}")
        stored = {FRAMES: block.positions_nm, **{name: extra[name] for name in PER_ATOM if name in extra}}
        if EDGES in extra:
            stored[CELLS] = extra[EDGES]
        self._store.append(block, {"coordinates": block.positions_nm, f"{_POSITION}/step": step, **extra}, stored)

    def truncate(self, n_frames: int) -> None:
        self._refuse_closed()
        self._store.truncate(n_frames)
        self.n_frames, self.last_time_ps = n_frames, self._store.last_time_ps


class Hdf5Reader(TrajectoryReader):
    """Reads our own HDF5 trajectories and MDTraj's. `top` gives the bonds to a topology of MDTraj's without any.

    Raises TrajectoryError when the file is damaged or incomplete, InputError when `top` does not fit.
    """

    def __init__(self, path: Path, top: Path | None = None) -> None:
        self.path = path
        self._file = open_hdf5(path)
        try:
            with damage_reported(path):
                self._read_headers(top)
        except BaseException:
            self._file.close()
            raise

    def _read_headers(self, top: Path | None) -> None:
        if "coordinates" not in self._file:
            raise TrajectoryError(f"{self.path} holds no /coordinates: it is not an MDTraj or surromd trajectory.")
        self.n_frames = consistent_length(self._file, self.path)
        self._coordinates = self._file["coordinates"]
        if self._coordinates.ndim != 3 or self._coordinates.shape[2] != 3:
            raise TrajectoryError(f"{self.path}: /coordinates of shape {self._coordinates.shape}, not (n, n_atoms, 3).")
        self._scale = _per_unit(self._file, "coordinates", nm_per, self.path)
        self.n_atoms = int(self._coordinates.shape[1])
        columns = read_columns(self._file, self.path, self.n_frames)
        self.time_ps, self.flags, self.chunk_idx, self.scalars = columns
        self.checksums, self.run_id = read_checksums(self._file, self.n_frames), read_run_id(self._file)
        self.times_known = "surromd" in self._file or "time" in self._file
        self.record = read_record(self._file) if "surromd" in self._file else {}
        if "surromd" not in self._file and "time" in self._file:
            self.time_ps = self.time_ps * _per_unit(self._file, "time", ps_per, self.path)
            self.notes = counted_note(self.time_ps)
        self.scene = self._read_scene(top)
        if self.scene is not None and self.scene.n_atoms != self.n_atoms:
            raise TrajectoryError(f"{self.path}: {self.n_atoms} atoms a frame, but {self.scene.n_atoms} in its scene.")

    def _read_scene(self, top: Path | None) -> Scene | None:
        unused = () if top is None else (unused_top_note(top),)
        if "surromd" in self._file:
            self.notes += unused
            return Scene.from_dict(get_json(self._file, "surromd/scene"))
        from systems.trajectory.foreign_scenes import bonds_completed, scene_from_structure, scene_from_topology_json

        own = None
        if "topology" in self._file and self.n_frames:
            own = scene_from_topology_json(self._file["topology"][0], self._read(0, 1, 1)[0], self.path)
        if top is not None and (own is None or not len(own.bonds)):
            stated = scene_from_structure(top, name=self.path.stem)
            if stated.n_atoms != self.n_atoms or (own is not None and stated.elements != own.elements):
                raise InputError(f"{top} holds other atoms than {self.path} ({self.n_atoms}); give the matching one.")
            return stated.with_positions(self._read(0, 1, 1)[0]) if self.n_frames else stated
        if own is None:
            return None
        self.notes += unused
        scene = bonds_completed(own, self._read_cells(0, 1, 1))
        added = len(scene.bonds) - len(own.bonds)
        if added:
            self.notes += (f"{added} bonds that its topology lacks were found by distance.",)
        return scene

    def _read(self, start: int, stop: int, stride: int) -> Float32Array:
        frames = self._gather(self._coordinates, start, stop, stride)
        check_read(self, FRAMES, frames, slice(start, stop, stride))
        return frames if self._scale == 1.0 else (frames * np.float32(self._scale))

    def _read_extra(self, name: str, start: int, stop: int, stride: int) -> Float32Array | None:
        if not self._file:
            raise InputError(f"{self.path} is closed.")
        if name not in self._file:
            return None
        values = self._gather(self._file[name], start, stop, stride)
        check_read(self, name, values, slice(start, stop, stride))
        return values

    def _read_cells(self, start: int, stop: int, stride: int) -> Float64Array | None:
        if not self._file:
            raise InputError(f"{self.path} is closed.")
        with damage_reported(self.path):
            cells = read_cells(self._file, start, stop, stride)
            if cells is not None and "surromd" not in self._file and "cell_lengths" in self._file:
                cells *= _per_unit(self._file, "cell_lengths", nm_per, self.path)
        if cells is not None:
            check_read(self, CELLS, cells, slice(start, stop, stride))
        return cells

    def _gather(self, column: h5py.Dataset, start: int, stop: int, stride: int) -> Float32Array:
        if start >= stop:
            return np.empty((0, *column.shape[1:]), dtype=np.float32)
        try:
            if stride == 1:
                return np.asarray(column[start:stop], dtype=np.float32)
            # HDF5 gathers strided rows one by one; whole blocks, thinned here, are many times faster.
            block = max(_STRIDED_READ_FRAMES // stride, 1) * stride
            parts = [column[s : min(s + block, stop)][::stride] for s in range(start, stop, block)]
            return np.concatenate(parts).astype(np.float32, copy=False)
        except UNREADABLE as error:
            if not self._file:
                raise InputError(f"{self.path} is closed.") from error
            raise TrajectoryError(
                f"{self.path} is damaged in frames {start} to {stop} ({first_line(error)})."
            ) from error

    def close(self) -> None:
        self._file.close()


def is_plain_h5md(path: Path) -> bool:
    """Whether this is another program's H5MD, without MDTraj's names beside it."""
    try:
        with open_hdf5(path) as file:
            return "h5md" in file and "coordinates" not in file and "surromd" not in file
    except TrajectoryError:  # its own reader says how it is damaged
        return False


def read_columns(file: h5py.File, path: Path, n_frames: int) -> tuple[Any, Any, Any, dict[str, Any]]:
    """Return `(time_ps, flags, chunk_idx, scalars)` of the first `n_frames` frames; None for what is not there."""
    if "surromd" in file or "time" in file:
        time_ps = file["time"][:n_frames].astype(np.float64)
    else:
        time_ps = np.arange(n_frames, dtype=np.float64)
    flags = file["surromd/flags"][:n_frames] if "surromd/flags" in file else None
    chunk_idx = file["surromd/chunk_idx"][:n_frames] if "surromd/chunk_idx" in file else None
    group = file.get("surromd/scalars", {})
    scalars = {name: group[name][:n_frames] for name in group}
    if not np.isfinite(time_ps).all():
        raise TrajectoryError(f"{path} is damaged: some frames have no time.")
    return time_ps, flags, chunk_idx, scalars


def read_checksums(file: h5py.File, n_frames: int) -> dict[str, Checksums]:
    """Return the checksums `(n_frames,)` of the first frames by what they are of; older files have none."""
    return {name: column[:n_frames] for name, column in file.get(CHECKSUMS, {}).items()}


def check_read(reader: TrajectoryReader, name: str, stored: npt.NDArray[Any], frames: slice) -> None:
    """Raise TrajectoryError unless what was read of `frames`, as it is on disk, is what was written.

    With positions (FRAMES) go what the reader holds of the same frames: times, chunks, flags, scalars.
    """
    if name not in reader.checksums or not len(stored):
        return
    columns = {name: stored}
    if name == FRAMES and reader.chunk_idx is not None:
        flags = None if reader.flags is None else reader.flags[frames]
        scalars = {key: values[frames] for key, values in reader.scalars.items()}
        columns |= columns_with_frames(reader.time_ps[frames], reader.chunk_idx[frames], flags, scalars)
    found = frame_checksums(columns)
    check_frames_read(reader.path, reader.checksums[name][frames], found, frames.start, frames.step)


def _per_unit(file: h5py.File, name: str, per: Callable[[Any], float | None], path: Path) -> float:
    """Return what one of a dataset's `units` is in nm or ps, 1 where it states none (MDTraj's convention)."""
    units = file[name].attrs.get("units")
    factor = 1.0 if units is None else per(units)
    if factor is None:
        shown = units.decode(errors="replace") if isinstance(units, bytes) else units
        raise TrajectoryError(f"{path}: {name} are in {shown!r}, a unit that is not known; write it in nm and ps.")
    return factor


def _lay_out(file: h5py.File, scene: Scene, columns: Sequence[str]) -> None:
    """Add MDTraj's and H5MD's groups, empty columns and units."""
    version = program_version()
    for key, value in {"conventions": "Pande", "conventionVersion": "1.1", "program": "surromd", "title": scene.name,
                       "programVersion": version, "application": "surromd"}.items():  # fmt: skip
        file.attrs[key] = np.bytes_(value.encode("ascii", "replace"))
    frame_bytes = 12 * max(scene.n_atoms, 1)
    chunk = min(max(_CHUNK_BYTES // frame_bytes, 1), 1024)
    coordinates = add_column(file, "coordinates", 0, "<f4", tail=(scene.n_atoms, 3), chunk=chunk)
    coordinates.attrs["units"], coordinates.attrs["unit"] = np.bytes_(b"nanometers"), "nm"
    time = add_column(file, "time", 0, "<f8")
    time.attrs["units"], time.attrs["unit"] = np.bytes_(b"picoseconds"), "ps"
    file.create_dataset("topology", data=np.array([_topology_json(scene).encode("ascii")]))

    h5md = file.create_group("h5md")
    h5md.attrs["version"] = np.array([1, 1], dtype=np.int32)
    h5md.create_group("author").attrs["name"] = "surromd"
    creator = h5md.create_group("creator")
    creator.attrs["name"], creator.attrs["version"] = "surromd", version
    particles = file.create_group("particles/trajectory")
    box = particles.create_group("box")
    box.attrs["dimension"] = np.int32(3)
    position = particles.create_group("position")
    position["value"], position["time"] = coordinates, time
    add_column(file, f"{_POSITION}/step", 0, "<i8")
    lay_out_extras(file, columns, periodic=scene.cell_nm is not None)
    particles["species"] = np.array([ATOMIC_NUMBERS.get(e, 0) for e in scene.elements], dtype=np.int32)
    particles["mass"] = scene.masses_da
    particles["mass"].attrs["unit"] = "u"


def _topology_json(scene: Scene) -> str:
    """Return MDTraj's topology JSON. Runs of atoms become residues, so that the atom order survives any scene."""
    chains: list[dict[str, Any]] = []
    n_residues = 0
    last_residue = last_chain = None
    for atom, residue in enumerate(scene.residue_of_atom.tolist()):
        chain = scene.chain_of_residue[residue]
        if chain != last_chain:
            chains.append({"index": len(chains), "chain_id": chain or None, "residues": []})
            last_chain, last_residue = chain, None
        if residue != last_residue:
            digits = "".join(c for c in scene.residue_ids[residue] if c.isdigit() or c == "-")
            try:
                number = int(digits)
            except ValueError:
                number = residue + 1
            name = scene.residue_names[residue]
            chains[-1]["residues"].append(
                {"index": n_residues, "name": name, "resSeq": number, "segmentID": "", "atoms": []}
            )
            n_residues, last_residue = n_residues + 1, residue
        chains[-1]["residues"][-1]["atoms"].append(
            {"index": atom, "name": scene.atom_names[atom], "element": scene.elements[atom],
             "formal_charge": int(scene.formal_charges[atom])}
        )  # fmt: skip
    orders = scene.bond_orders.tolist()
    metadata = [{"order": order or None, "type": _BOND_TYPES.get(order)} for order in orders]
    return json.dumps({"chains": chains, "bonds": scene.bonds.tolist(), "bond_metadata": metadata})


# ---- H5MD of other programs -----------------------------------------------------------------------------------------


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
