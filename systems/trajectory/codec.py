"""The one trajectory codec: HDF5 (the full record), DCD and XTC (what others read), streaming, append, resume."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from systems.errors import InputError, TrajectoryError
from systems.files.atomic_file import journal_path
from systems.scene import Scene
from systems.trajectory.base import TrajectoryReader, TrajectoryWriter
from systems.trajectory.claim import Claim
from systems.trajectory.frame_block import FrameBlock

__all__ = ["FrameBlock", "TrajectoryReader", "TrajectoryWriter", "companions", "open_trajectory", "open_writer"]

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
    claimed: bool = False,
) -> TrajectoryWriter:
    """Start a trajectory file (`.h5`, `.hdf5`, `.dcd` or `.xtc`), or continue one with `append=True`.

    Beside it stands `NAME.pdb`, its topology in its atom order (up to 99,999 atoms), beside a DCD or XTC also
    `NAME.meta.h5` (record, exact times, flags). With `append` the file must be ours and hold the same ordered topology;
    what it records stays, new keys of `record` are added, and an append that a crash interrupted is cut off. `record`
    must be JSON-able. `columns`: what each frame has beside positions, 'velocities' and 'forces' (HDF5 only); the cell
    of a periodic scene is kept in any case. `run_id`: whose file it is. The writer holds the file's claim
    (systems.trajectory.claim), unless its caller does (`claimed`).
    Raises InputError for an unknown suffix, column or record; TrajectoryError when the file exists (and neither
    `append` nor `overwrite` is set), is missing with `append`, damaged, of another topology, or written by another
    process; StorageError when the folder is missing, not writable or full.
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

    claim = None if claimed else Claim(path)
    how: dict[str, Any] = {"append": append, "overwrite": overwrite, "run_id": run_id}
    try:
        writer: TrajectoryWriter
        if suffix in _WITH_COMPANIONS:
            writer = (DcdWriter if suffix == ".dcd" else XtcWriter)(path, scene, record, **how)
        else:
            writer = Hdf5Writer(path, scene, record, columns=columns, **how)
    except BaseException:
        if claim is not None:
            claim.close()
        raise
    if claim is not None:
        writer.claim = claim
        weakref.finalize(writer, claim.close)
    return writer


def refuse_columns(path: Path, columns: Sequence[str]) -> None:
    """Raise InputError where a trajectory of this name cannot hold these columns beside positions."""
    if columns and path.suffix.lower() in _WITH_COMPANIONS:
        kind = path.suffix[1:].upper()
        raise InputError(f"{path}: {kind} files hold positions only; write an .h5 to keep {' and '.join(columns)}.")


def companions(path: Path) -> tuple[Path, ...]:
    """Return the paths of what is written beside a trajectory."""
    from systems.trajectory import companion_writer
    from systems.trajectory.topology_file import topology_path

    if path.suffix.lower() not in _WITH_COMPANIONS:
        return topology_path(path), journal_path(path)

    pdb, meta = companion_writer.companions(path)
    return pdb, meta, journal_path(meta)


def open_trajectory(path: str | Path, *, top: str | Path | None = None) -> TrajectoryReader:
    """Open a trajectory for reading: ours, MDTraj's HDF5, a DCD, any format that MDTraj or MDAnalysis reads, or an
    ASE trajectory where ase is installed.

    `top` names a structure or topology file for formats without topology; a DCD or XTC of ours finds its companions.
    A file without our record has `record == {}` and `flags is None`; one without times has `times_known` False.
    Warns (UserWarning) of a DCD of another program whose header states another number of frames than it holds.
    Raises TrajectoryError when the file is missing, damaged or incomplete (it is never read as far as it goes);
    InputError when a topology is needed, or does not fit.
    """
    path = Path(path)
    top = None if top is None else Path(top)
    is_hdf5 = path.suffix.lower() in _HDF5
    if is_hdf5:
        from systems.trajectory.hdf5_file import Hdf5Reader, is_plain_h5md

        if not is_plain_h5md(path):
            return Hdf5Reader(path, top)
    if is_hdf5 or path.suffix.lower() == ".h5md":
        from systems.trajectory.h5md_file import H5mdReader

        return H5mdReader(path, top)
    if path.suffix.lower() == ".dcd":
        from systems.trajectory.dcd_file import DcdReader

        return DcdReader(path, top)
    if path.suffix.lower() == ".xtc":
        from systems.trajectory.topology_file import is_our_topology, topology_path
        from systems.trajectory.xtc_file import XtcReader, is_ours

        if is_ours(path):
            return XtcReader(path, top)
        top = topology_path(path) if top is None and is_our_topology(topology_path(path)) else top
    if path.suffix.lower() == ".traj":
        from systems.trajectory.ase_file import AseReader

        return AseReader(path, top)
    from systems.trajectory.format_table import XYZ_SUFFIXES

    if path.name.lower().endswith(XYZ_SUFFIXES):
        from systems.trajectory.xyz_file import XyzReader

        return XyzReader(path, top)
    from systems.trajectory.foreign_scenes import is_mdtraj_format

    if is_mdtraj_format(path):
        from systems.trajectory.foreign_readers import MdtrajReader

        return MdtrajReader(path, top)
    from systems.trajectory.foreign_readers import MdanalysisReader

    return MdanalysisReader(path, top)
