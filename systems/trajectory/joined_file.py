"""One file of several replicas, one after another: its record says where each begins and what it says of itself.

Times go on from replica to replica at the interval of the frames, as formats want them; that a replica begins is told
by the record alone (`joined`), which `compare` goes by, so that no step across a joint counts as motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError
from systems.trajectory.base import TrajectoryReader, check_same_topology
from systems.trajectory.codec import open_trajectory, open_writer

KEY = "joined"
_AT_ONCE = 2048


def join(paths: Sequence[Path], out: Path, *, overwrite: bool = False) -> Path:
    """Write the frames of replicas into one file, in the order of `paths`, and return its path.

    Kept are positions, cells, flags, chunks and scalars, and velocities and forces where all replicas and the format
    hold them. Times are each replica's own, moved behind those before it.
    Raises InputError where the replicas differ in atoms or save interval, TrajectoryError, StorageError.
    """
    with ExitStack() as stack:
        readers = [stack.enter_context(open_trajectory(path)) for path in paths]
        first = readers[0]
        if first.scene is None:
            raise InputError(f"{first.path} holds no topology; it cannot be joined.")
        for reader in readers[1:]:
            if reader.scene is None:
                raise InputError(f"{reader.path} holds no topology; it cannot be joined.")
            check_same_topology(reader.path, reader.scene, first.scene)
        intervals = [float(np.median(np.diff(r.time_ps))) for r in readers if r.n_frames > 1]
        stated = first.record.get("save_every_ps")
        interval_ps = intervals[0] if intervals else float(stated) if isinstance(stated, int | float) else 1.0
        if any(abs(other - interval_ps) > 1e-6 * interval_ps for other in intervals):
            raise InputError(f"{out}: its replicas differ in the time between frames; join those of one interval.")
        columns = [
            name
            for name, read in (("velocities", "read_velocities"), ("forces", "read_forces"))
            if out.suffix.lower() not in (".dcd", ".xtc") and all(getattr(r, read)(0, 1) is not None for r in readers)
        ]
        starts = np.cumsum([0, *(r.n_frames for r in readers)]).tolist()
        replicas = [
            {"file": r.path.name, "first_frame": begin, "n_frames": r.n_frames, "record": r.record}
            for r, begin in zip(readers, starts, strict=False)
        ]
        complete = all(r.record.get("completed") is not False for r in readers)
        common = {key: value for key, value in first.record.items() if all(r.record.get(key) == value for r in readers)}
        record = common | {KEY: {"replicas": replicas}, "completed": False}
        end_ps = 0.0
        with open_writer(out, first.scene, record, overwrite=overwrite, columns=columns) as writer:
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
    extra: dict[str, npt.NDArray[Any] | None] = {"cell_nm": reader.read_cells(part.start, part.stop)}
    if "velocities" in columns:
        extra["velocities_nm_ps"] = reader.read_velocities(part.start, part.stop)
    if "forces" in columns:
        extra["forces_kj_mol_nm"] = reader.read_forces(part.start, part.stop)
    writer.append(
        reader.read(part.start, part.stop),
        reader.time_ps[part] + shift_ps,
        flags=None if reader.flags is None else reader.flags[part],
        chunk_idx=None if reader.chunk_idx is None else reader.chunk_idx[part],
        scalars={name: values[part] for name, values in reader.scalars.items()},
        **extra,
    )
