"""Trajectories and topologies of the formats that MDAnalysis alone reads: H5MD, XYZ, LAMMPS, TNG, GSD, DL_POLY, ..."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.distance_bonds import with_bonds_by_distance
from systems.chemistry.element_data import atomic_weight_da, element_symbol
from systems.errors import InputError, TrajectoryError, first_line
from systems.scene import Scene
from systems.trajectory.base import Float32Array, Float64Array, TrajectoryReader
from systems.trajectory.from_mdtraj import scene_from_structure

# What stands in a file name where MDAnalysis would not know the format by itself.
_FORMATS = {".h5": "H5MD", ".hdf5": "H5MD", ".h5md": "H5MD", ".extxyz": "XYZ", ".dump": "LAMMPSDUMP"}
_WITH_TOPOLOGY = (".xyz", ".extxyz", ".gsd", ".txyz", ".pqr", ".dump", ".lammpsdump", ".history", ".config")
_NM = 0.1


def scene_from_universe(top: Path, *, name: str) -> Scene:
    """Return the Scene of a topology that MDAnalysis reads (TPR, GSD, XYZ, LAMMPS data, ...).

    Bonds are the file's, or by covalent radii where it holds none; positions are zero where it holds none. Raises
    InputError when it cannot be read, or an element is not known.
    """
    import MDAnalysis

    format_ = _FORMATS.get(top.suffix.lower())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            universe = MDAnalysis.Universe(str(top), **({} if format_ is None else {"topology_format": format_}))
    except Exception as error:  # each of its parsers raises its own kinds
        raise InputError(f"{top} cannot be read as a topology: {first_line(error)}.") from error
    atoms = universe.atoms
    has_positions = hasattr(universe, "trajectory") and universe.trajectory.n_frames > 0
    positions = np.asarray(atoms.positions, dtype=np.float64) * _NM if has_positions else np.zeros((len(atoms), 3))
    names = [str(x) for x in _values(atoms, "names", _values(atoms, "types", ["X"] * len(atoms)))]
    residues = [str(x) for x in _values(atoms.residues, "resnames", ["UNK"] * len(atoms.residues))]
    of_atom = np.asarray(atoms.resindices, dtype=np.int64)
    of_atom = np.unique(of_atom, return_inverse=True)[1].astype(np.int64)
    written = [str(x) for x in _values(atoms, "elements", [""] * len(atoms))]
    elements = []
    for i, (atom, element) in enumerate(zip(names, written, strict=True)):
        # XYZ files hold symbols or PDB names: CA in capitals is an alpha carbon, which MDAnalysis takes for calcium.
        guessed = "xyz" in top.suffix.lower() and len(element) == 2 and atom.isupper() and atom not in ("CL", "BR")
        symbol = element_symbol(atom, residues[of_atom[i]], "" if guessed else element)
        if symbol is None:
            raise InputError(f"{top}: the element of atom {i} ({atom}) is not known; give a PDB file with --top.")
        elements.append(symbol)
    bonds = np.empty((0, 2), dtype=np.int64)
    if hasattr(atoms, "bonds"):
        bonds = np.unique(np.sort(np.asarray(atoms.bonds.to_indices()).reshape(-1, 2), axis=1), axis=0).astype(np.int64)
    scene = Scene(
        name=name,
        atom_names=tuple(names),
        elements=tuple(elements),
        residue_of_atom=of_atom,
        residue_names=tuple(residues),
        residue_ids=tuple(str(x) for x in _values(atoms.residues, "resids", range(1, len(residues) + 1))),
        chain_of_residue=("A",) * len(residues),
        bonds=bonds,
        bond_orders=np.zeros(len(bonds)),
        formal_charges=np.zeros(len(elements), dtype=np.int64),
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=positions,
        provenance={"source": top.name},
    )
    return _with_orders(with_bonds_by_distance(scene))


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
        format_ = _FORMATS.get(suffix)
        stated = None
        if top is not None:
            stated = scene_from_structure(top, name=path.stem)
        elif suffix in _WITH_TOPOLOGY:
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
            hint = "; an ASE file is converted by `ase convert x.traj x.xyz`" if suffix == ".traj" else ""
            raise TrajectoryError(
                f"{path} cannot be read by MDTraj or MDAnalysis {MDAnalysis.__version__}: {first_line(error)}{hint}."
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


def _with_orders(scene: Scene) -> Scene:
    try:
        orders, charges = perceive(list(scene.elements), scene.bonds)
    except ValenceError:
        return scene
    return replace(scene, bond_orders=orders, formal_charges=charges)


def _values(group: Any, name: str, otherwise: Any) -> Any:
    try:
        return getattr(group, name)
    except Exception:  # MDAnalysis' NoDataError: the topology does not say
        return otherwise
