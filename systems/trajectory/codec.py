"""The one trajectory codec: HDF5 (the full record), DCD and XTC (what others read), streaming, append, resume.

And what is made of whole trajectories: MDTraj's and MDAnalysis' objects, weights of frames.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.distance_bonds import lengths_and_angles
from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import OutputLock, journal_path
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter, uneven_by_ps
from systems.trajectory.companion_writer import POSITIONS_ALONE, is_our_topology, meta_path, topology_path
from systems.trajectory.store import PER_ATOM, Float32Array, Float64Array, FrameStore
from systems.units import GAS_CONSTANT_KJ_MOL_K

_HDF5 = (".h5", ".hdf5")
# What trajectories are written as.
WRITTEN = (*_HDF5, *POSITIONS_ALONE)


def open_writer(
    path: str | Path,
    scene: Scene,
    record: dict[str, Any],
    *,
    append: bool = False,
    overwrite: bool = False,
    columns: Sequence[str] = (),
    run_id: str = "",
    locked: bool = False,
) -> TrajectoryWriter:
    """Start a trajectory file (`.h5`, `.hdf5`, `.dcd` or `.xtc`), or continue one with `append=True`.

    Beside it lies `NAME.pdb`, its topology (up to 99,999 atoms), beside a DCD or XTC also `NAME.meta.h5` (record, exact
    times, flags). With `append` the file must be ours and hold the same ordered topology; new keys of `record` are
    added, and an append that a crash interrupted is cut off. `columns`: what each frame has beside positions and cell,
    'velocities' and 'forces' (HDF5 only). `run_id`: whose file it is. The writer locks the file, unless its caller has
    (`locked`). Raises InputError for an unknown suffix or column, or a record that is not JSON; TrajectoryError when
    the file exists already, is missing with `append`, damaged, of another topology, or written by another process;
    StorageError when the folder is missing, not writable or full.
    """
    path = Path(path)
    if append and overwrite:
        raise InputError(f"{path}: append and overwrite exclude each other.")
    if append and not path.exists():
        raise TrajectoryError(f"{path} does not exist and cannot be continued.")
    if path.name.endswith(".meta.h5"):
        raise InputError(
            f"{path}: names ending in .meta.h5 are kept for the companions of DCD and XTC files; choose another."
        )
    suffix = path.suffix.lower()
    refuse_columns(path, columns)
    if suffix not in WRITTEN:
        raise InputError(
            f"{path}: trajectories are written as .h5, .dcd or .xtc, not {path.suffix or 'without a suffix'!r}."
        )
    from systems.trajectory.dcd_file import DcdWriter
    from systems.trajectory.hdf5_file import Hdf5Writer
    from systems.trajectory.xtc_file import XtcWriter

    lock = None if locked else OutputLock(path)
    writers: dict[str, type[TrajectoryWriter]] = {".dcd": DcdWriter, ".xtc": XtcWriter}
    try:
        writer = writers.get(suffix, Hdf5Writer)(
            path, scene, record, append=append, overwrite=overwrite, columns=columns, run_id=run_id
        )
    except BaseException:
        if lock is not None:
            lock.close()
        raise
    if lock is not None:
        writer.lock = lock
        weakref.finalize(writer, lock.close)
    return writer


def refuse_columns(path: Path, columns: Sequence[str]) -> None:
    """Raise InputError where a trajectory of this name cannot hold these columns beside positions."""
    if columns and path.suffix.lower() in POSITIONS_ALONE:
        kind = path.suffix[1:].upper()
        raise InputError(f"{path}: {kind} files hold positions only; write an .h5 to keep {' and '.join(columns)}.")
    for name in columns:
        if name not in PER_ATOM:
            raise InputError(f"{path}: no column {name!r} can be stored; known: {', '.join(PER_ATOM)}.")


def companions(path: Path) -> tuple[Path, ...]:
    """Return the paths of what is written beside a trajectory."""
    if path.suffix.lower() not in POSITIONS_ALONE:
        return topology_path(path), journal_path(path)
    return topology_path(path), meta_path(path), journal_path(meta_path(path))


def open_trajectory(path: str | Path, *, top: str | Path | None = None) -> TrajectoryReader:
    """Open a trajectory for reading: ours, MDTraj's HDF5, a DCD, any format that MDTraj or MDAnalysis reads, or an
    ASE trajectory where ase is installed.

    `top` names a structure or topology file for formats without topology; a DCD or XTC of ours finds its companions.
    Warns (UserWarning) of a DCD of another program whose header states another number of frames than it holds. Raises
    TrajectoryError when the file is missing, damaged or incomplete (it is never read as far as it goes); InputError
    when a topology is needed, or does not fit.
    """
    from systems.trajectory import dcd_file, foreign_readers, hdf5_file, xtc_file
    from systems.trajectory.foreign_scenes import XYZ_SUFFIXES, is_mdtraj_format

    path, top = Path(path), None if top is None else Path(top)
    suffix = path.suffix.lower()
    if suffix in _HDF5:
        return hdf5_file.open_by_layout(path, top)
    if suffix == ".h5md":
        return hdf5_file.H5mdReader(path, top)
    if suffix == ".dcd":
        return dcd_file.DcdReader(path, top)
    if suffix == ".xtc":
        if xtc_file.is_of_xtc(path):
            return xtc_file.XtcReader(path, top)
        if top is None and is_our_topology(topology_path(path)):
            top = topology_path(path)
    if suffix in (".xtc", ".trr", ".nc", ".ncdf", ".netcdf"):
        return foreign_readers.StreamReader(path, top)
    if path.name.lower().endswith((*XYZ_SUFFIXES, ".traj")):
        return foreign_readers.AtomsReader(path, top)
    if is_mdtraj_format(path):
        return foreign_readers.MdtrajReader(path, top)
    return foreign_readers.MdanalysisReader(path, top)


# ---- objects of MDTraj and MDAnalysis, through memory ---------------------------------------------------------------


def to_mdtraj(
    source: str | Path | TrajectoryReader, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> Any:
    """Return frames `start:stop:stride` of a trajectory, a path or one that is open, as an `mdtraj.Trajectory`.
    Positions, times, bonds and the cell are taken over. Raises InputError for a file without topology, TrajectoryError
    for a damaged one."""
    import mdtraj

    scene, positions, times, cells = _read(source, start, stop, stride)
    lengths, angles = (None, None) if cells is None else lengths_and_angles(cells)
    return mdtraj.Trajectory(
        positions, scene.to_mdtraj_topology(), time=times, unitcell_lengths=lengths, unitcell_angles=angles
    )


def to_mdanalysis(
    source: str | Path | TrajectoryReader, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> Any:
    """Return frames `start:stop:stride` of a trajectory as an `MDAnalysis.Universe` in memory, in its units (Å, ps).
    Names, elements, masses, charges, residues, chains (segments) and bonds are taken over. Its reader knows one time
    step: frames that are unevenly spaced are refused. Raises InputError, TrajectoryError."""
    import MDAnalysis
    from MDAnalysis.coordinates.memory import MemoryReader

    scene, positions, times, cells = _read(source, start, stop, stride)
    gaps = np.diff(times)
    step = float(gaps.mean()) if len(gaps) else 1.0
    if len(gaps) and np.abs(gaps - step).max() > uneven_by_ps(times, step):
        raise InputError(f"frames between {times[0]:g} and {times[-1]:g} ps are unevenly spaced; take a range that is.")
    dimensions = None
    if cells is not None:
        lengths, angles = lengths_and_angles(cells)
        dimensions = np.concatenate([lengths * 10.0, angles], axis=1).astype(np.float32)
    universe = MDAnalysis.Universe(
        scene.to_openmm_topology(), positions * np.float32(10.0), format=MemoryReader, order="fac",
        dimensions=dimensions, dt=step,
        time_offset=float(times[0]) if len(times) else 0.0,
    )  # fmt: skip
    universe.atoms.masses = scene.masses_da
    universe.add_TopologyAttr("formalcharges", scene.formal_charges)
    return universe


def _read(
    source: str | Path | TrajectoryReader, start: int, stop: int | None, stride: int
) -> tuple[Scene, Float32Array, Float64Array, Float64Array | None]:
    if not isinstance(source, TrajectoryReader):
        with open_trajectory(source) as reader:
            return _read(reader, start, stop, stride)
    if source.scene is None:
        raise InputError(f"{source.path} carries no topology; open it with top= and convert the reader.")
    positions = source.read(start, stop, stride)
    return source.scene, positions, source.time_ps[start:stop:stride], source.read_cells(start, stop, stride)


# ---- weights of frames ----------------------------------------------------------------------------------------------


# Scalar column of a rollout: U_reference - U_model in kJ/mol, NaN where the reference was not computed.
DIFFERENCE_COLUMN = "energy_difference_kj_mol"


def reweighting(differences_kj_mol: npt.ArrayLike, temperature_k: float) -> tuple[Float64Array, float]:
    """Return the weights `(n,)`, summing to one, that turn a potential's frames into those of the reference, and how
    many effective frames they leave (Kish: 1 / sum w^2).

    `differences_kj_mol` (n,): U_reference - U_model at the frames; w is proportional to exp(-difference / kT).
    Independent frames are assumed; correlation in time lessens the number further.
    """
    reduced = -np.asarray(differences_kj_mol, dtype=np.float64) / (GAS_CONSTANT_KJ_MOL_K * temperature_k)
    weights = np.exp(reduced - reduced.max())
    weights /= weights.sum()
    return weights, float(1.0 / np.square(weights).sum())


def frame_factors(differences_kj_mol: Sequence[Float64Array], temperature_k: float) -> list[Float64Array]:
    """Return what each frame of replicas counts at the reference's law (`reweighting`); NaN stays, and infinity counts
    nothing."""
    every = np.concatenate(list(differences_kj_mol))
    factors, asked = np.full(len(every), np.nan), ~np.isnan(every)
    factors[asked] = reweighting(every[asked], temperature_k)[0]
    return np.split(factors, np.cumsum([len(d) for d in differences_kj_mol])[:-1])


def frame_weights(path: str | Path) -> Float64Array:
    """Return the weights `(n_frames,)` of a trajectory's frames at equilibrium; ones where the file has none. All
    replicas of one answer share a scale, mean 1 over all their frames: concatenate them as the frames. Raises
    TrajectoryError for a damaged file, or one that has grown since the weights were written."""
    with open_trajectory(path) as reader:
        weights, n_frames = reader.weights, reader.n_frames
    if weights is None:
        return np.ones(n_frames)
    if len(weights) != n_frames:
        raise TrajectoryError(
            f"{path} holds {n_frames} frames and weights of {len(weights)}: it has grown since they were written; let "
            "the run that made it end."
        )
    return weights


def write_weights(path: Path, weights: Float64Array) -> None:
    """Write weights `(n_frames,)` into a trajectory of ours, or replace them. Raises InputError for another number of
    them, TrajectoryError for a file of others, StorageError."""
    store = meta_path(path) if path.suffix.lower() in POSITIONS_ALONE else path
    with FrameStore(store) as file:
        file.write_weights(np.asarray(weights, dtype=np.float64))
