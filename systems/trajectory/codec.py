"""The one trajectory codec: HDF5 (the full record), DCD and XTC (what others read), streaming, append, resume.

And what is made of whole trajectories: one file of several replicas, MDTraj's and MDAnalysis' objects, weights of
frames.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import OutputLock, journal_path
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter, check_same_topology
from systems.trajectory.store import PER_ATOM, WEIGHTS, Float32Array, Float64Array, FrameStore, open_hdf5
from systems.units import GAS_CONSTANT_KJ_MOL_K

_HDF5 = (".h5", ".hdf5")
_WITH_COMPANIONS = (".dcd", ".xtc")
# What trajectories are written as.
WRITTEN = (*_HDF5, *_WITH_COMPANIONS)


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
    from systems.trajectory.companion_writer import XtcWriter
    from systems.trajectory.dcd_file import DcdWriter
    from systems.trajectory.hdf5_file import Hdf5Writer

    lock = None if locked else OutputLock(path)
    how: dict[str, Any] = {"append": append, "overwrite": overwrite, "run_id": run_id}
    try:
        writer: TrajectoryWriter
        if suffix in _WITH_COMPANIONS:
            writer = (DcdWriter if suffix == ".dcd" else XtcWriter)(path, scene, record, **how)
        else:
            writer = Hdf5Writer(path, scene, record, columns=columns, **how)
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
    if columns and path.suffix.lower() in _WITH_COMPANIONS:
        kind = path.suffix[1:].upper()
        raise InputError(f"{path}: {kind} files hold positions only; write an .h5 to keep {' and '.join(columns)}.")
    for name in columns:
        if name not in PER_ATOM:
            raise InputError(f"{path}: no column {name!r} can be stored; known: {', '.join(PER_ATOM)}.")


def companions(path: Path) -> tuple[Path, ...]:
    """Return the paths of what is written beside a trajectory."""
    from systems.trajectory import companion_writer

    pdb, meta = companion_writer.companions(path)
    if path.suffix.lower() not in _WITH_COMPANIONS:
        return pdb, journal_path(path)
    return pdb, meta, journal_path(meta)


def open_trajectory(path: str | Path, *, top: str | Path | None = None) -> TrajectoryReader:
    """Open a trajectory for reading: ours, MDTraj's HDF5, a DCD, any format that MDTraj or MDAnalysis reads, or an
    ASE trajectory where ase is installed.

    `top` names a structure or topology file for formats without topology; a DCD or XTC of ours finds its companions.
    Warns (UserWarning) of a DCD of another program whose header states another number of frames than it holds. Raises
    TrajectoryError when the file is missing, damaged or incomplete (it is never read as far as it goes); InputError
    when a topology is needed, or does not fit.
    """
    from systems.trajectory import companion_writer, dcd_file, foreign_readers, hdf5_file
    from systems.trajectory.foreign_scenes import XYZ_SUFFIXES, is_mdtraj_format

    path, top = Path(path), None if top is None else Path(top)
    suffix = path.suffix.lower()
    if suffix in _HDF5 and not hdf5_file.is_plain_h5md(path):
        return hdf5_file.Hdf5Reader(path, top)
    if suffix in (*_HDF5, ".h5md"):
        return foreign_readers.H5mdReader(path, top)
    if suffix == ".dcd":
        return dcd_file.DcdReader(path, top)
    if suffix == ".xtc":
        if companion_writer.is_of_xtc(path):
            return companion_writer.XtcReader(path, top)
        pdb = companion_writer.topology_path(path)
        top = pdb if top is None and companion_writer.is_our_topology(pdb) else top
        return foreign_readers.StreamReader(path, top)
    if suffix in (".nc", ".ncdf", ".netcdf"):
        return foreign_readers.StreamReader(path, top)
    if suffix == ".traj":
        return foreign_readers.AseReader(path, top)
    if path.name.lower().endswith(XYZ_SUFFIXES):
        return foreign_readers.XyzReader(path, top)
    if is_mdtraj_format(path):
        return foreign_readers.MdtrajReader(path, top)
    return foreign_readers.MdanalysisReader(path, top)


# ---- several replicas in one file -----------------------------------------------------------------------------------


KEY = "joined"
_AT_ONCE = 2048


def join(paths: Sequence[Path], out: Path, *, overwrite: bool = False) -> Path:
    """Write the frames of replicas into one file, in the order of `paths`, and return its path.

    Kept are positions, cells, flags, chunks and scalars, and velocities and forces where all replicas and the format
    hold them. Times are each replica's own, moved behind those before it. Raises InputError where the replicas differ
    in atoms or save interval, TrajectoryError, StorageError.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(open_trajectory(path)) for path in paths]
        first, scene = readers[0], readers[0].scene
        for reader in readers:
            if reader.scene is None or scene is None:
                raise InputError(f"{reader.path} holds no topology; it cannot be joined.")
            check_same_topology(reader.path, reader.scene, scene)
        assert scene is not None
        intervals = [float(np.median(np.diff(r.time_ps))) for r in readers if r.n_frames > 1]
        stated = first.record.get("save_every_ps")
        interval_ps = intervals[0] if intervals else float(stated) if isinstance(stated, int | float) else 1.0
        if any(abs(other - interval_ps) > 1e-6 * interval_ps for other in intervals):
            raise InputError(f"{out}: its replicas differ in the time between frames; join those of one interval.")
        columns = [] if out.suffix.lower() in _WITH_COMPANIONS else list(PER_ATOM)
        columns = [c for c in columns if all(getattr(r, f"read_{c}")(0, 1) is not None for r in readers)]
        starts = np.cumsum([0, *(r.n_frames for r in readers)]).tolist()
        replicas = [
            {"file": r.path.name, "first_frame": begin, "n_frames": r.n_frames, "record": r.record}
            for r, begin in zip(readers, starts, strict=False)
        ]
        complete = all(r.record.get("completed") is not False for r in readers)
        common = {key: value for key, value in first.record.items() if all(r.record.get(key) == value for r in readers)}
        record = common | {KEY: {"replicas": replicas}, "completed": False}
        end_ps = 0.0
        with open_writer(out, scene, record, overwrite=overwrite, columns=columns) as writer:
            for reader in readers:
                if not reader.n_frames:
                    continue
                shift_ps = 0.0 if writer.last_time_ps is None else end_ps + interval_ps - float(reader.time_ps[0])
                for start in range(0, reader.n_frames, _AT_ONCE):
                    _copy(reader, slice(start, min(start + _AT_ONCE, reader.n_frames)), writer, shift_ps, columns)
                end_ps = float(reader.time_ps[-1]) + shift_ps
            writer.update_record({"completed": complete})
    return out


def replicas_of(record: Mapping[str, Any], n_frames: int) -> list[tuple[slice, dict[str, Any]]]:
    """Return the frames of each replica in a file and what it says of itself: of one that is not joined, all.

    Raises TrajectoryError where the record does not fit the file.
    """
    if KEY not in record:
        return [(slice(0, n_frames), dict(record))]
    found, at = [], 0
    for replica in record[KEY]["replicas"]:
        begin, n = int(replica["first_frame"]), int(replica["n_frames"])
        if begin != at or begin + n > n_frames:
            raise TrajectoryError(
                f"the record of a joined file names {begin + n} frames or more, it holds {n_frames}; join again."
            )
        at = begin + n
        if n:
            found.append((slice(begin, at), dict(replica["record"])))
    return found


def refuse_joined(reader: TrajectoryReader) -> None:
    """Raise InputError for a joined file, where time must be unbroken."""
    if KEY in reader.record:
        names = [str(replica["file"]) for replica in reader.record[KEY]["replicas"]]
        raise InputError(f"{reader.path} joins {len(names)} replicas; give them as files ({names[0]}, ...).")


def _copy(reader: TrajectoryReader, part: slice, writer: Any, shift_ps: float, columns: Sequence[str]) -> None:
    frames = (part.start, part.stop)
    writer.append(
        reader.read(*frames),
        reader.time_ps[part] + shift_ps,
        flags=None if reader.flags is None else reader.flags[part],
        chunk_idx=None if reader.chunk_idx is None else reader.chunk_idx[part],
        scalars={name: values[part] for name, values in reader.scalars.items()},
        velocities_nm_ps=reader.read_velocities(*frames) if "velocities" in columns else None,
        forces_kj_mol_nm=reader.read_forces(*frames) if "forces" in columns else None,
        cell_nm=reader.read_cells(*frames),
    )


# ---- objects of MDTraj and MDAnalysis, through memory ---------------------------------------------------------------


def to_mdtraj(
    source: str | Path | TrajectoryReader, *, start: int = 0, stop: int | None = None, stride: int = 1
) -> Any:
    """Return frames `start:stop:stride` of a trajectory, a path or one that is open, as an `mdtraj.Trajectory`.

    Positions, times, bonds and the cell are taken over. Raises InputError for a file without topology,
    TrajectoryError for a damaged one.
    """
    import mdtraj

    from systems.chemistry.distance_bonds import lengths_and_angles

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
    step: frames that are unevenly spaced are refused. Raises InputError, TrajectoryError.
    """
    import MDAnalysis
    from MDAnalysis.coordinates.memory import MemoryReader

    from systems.chemistry.distance_bonds import lengths_and_angles

    scene, positions, times, cells = _read(source, start, stop, stride)
    gaps = np.diff(times)
    if len(gaps) and not np.allclose(gaps, gaps[0], rtol=1e-6):
        raise InputError(f"frames between {times[0]:g} and {times[-1]:g} ps are unevenly spaced; take a range that is.")
    dimensions = None
    if cells is not None:
        lengths, angles = lengths_and_angles(cells)
        dimensions = np.concatenate([lengths * 10.0, angles], axis=1).astype(np.float32)
    universe = MDAnalysis.Universe(
        scene.to_openmm_topology(), positions * np.float32(10.0), format=MemoryReader, order="fac",
        dimensions=dimensions, dt=float(gaps[0]) if len(gaps) else 1.0,
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


def frame_weights(path: str | Path) -> Float64Array:
    """Return the weights `(n_frames,)` of a trajectory's frames at equilibrium; ones where the file has none.

    All replicas of one answer share a scale, mean 1 over all their frames: concatenate them as the frames. Raises
    TrajectoryError for a damaged file, or one that has grown since the weights were written.
    """
    path = Path(path)
    with closing(open_trajectory(path)) as reader:
        n_frames = reader.n_frames
    store = _store(path)
    if store.suffix in (".h5", ".hdf5") and store.is_file():
        with closing(open_hdf5(store)) as file:
            if WEIGHTS in file:
                weights = np.asarray(file[WEIGHTS][:], dtype=np.float64)
                if len(weights) != n_frames:
                    raise TrajectoryError(
                        f"{path} holds {n_frames} frames and weights of {len(weights)}: it has grown since they were "
                        "written; let the run that made it end."
                    )
                return weights
    return np.ones(n_frames)


def write_weights(path: Path, weights: Float64Array) -> None:
    """Write weights `(n_frames,)` into a trajectory of ours, or replace them. Raises InputError for another number of
    them, TrajectoryError for a file of others, StorageError."""
    with closing(FrameStore(_store(path))) as store:
        store.write_weights(np.asarray(weights, dtype=np.float64))


def _store(path: Path) -> Path:
    """Return the HDF5 file that holds a trajectory's columns: itself, or what lies beside a DCD."""
    return next((p for p in companions(path) if p.name.endswith(".meta.h5")), path)
