"""Several replicas in one file, one after another; its record says where each begins and what it says of itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from systems.errors import InputError, TrajectoryError
from systems.trajectory.base import TrajectoryReader, check_same_topology
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import POSITIONS_ALONE
from systems.trajectory.store import PER_ATOM

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
        interval_ps = intervals[0] if intervals else float(first.record.get("save_every_ps", 1.0))
        if not np.allclose(intervals, interval_ps, rtol=1e-6):
            raise InputError(f"{out}: its replicas differ in the time between frames; join those of one interval.")
        columns = [] if out.suffix.lower() in POSITIONS_ALONE else list(PER_ATOM)
        columns = [c for c in columns if all(getattr(r, f"read_{c}")(0, 1) is not None for r in readers)]
        starts = np.cumsum([0, *(r.n_frames for r in readers)]).tolist()
        replicas = [
            {"file": r.path.name, "first_frame": begin, "n_frames": r.n_frames, "record": r.record}
            for r, begin in zip(readers, starts, strict=False)
        ]
        complete = all(r.record.get("completed") is not False for r in readers)
        common = {key: value for key, value in first.record.items() if all(r.record.get(key) == value for r in readers)}
        record = common | summed_cost([r.record for r in readers]) | {KEY: {"replicas": replicas}, "completed": False}
        next_ps = None
        with open_writer(out, scene, record, overwrite=overwrite, columns=columns) as writer:
            for reader in (r for r in readers if r.n_frames):
                shift_ps = 0.0 if next_ps is None else next_ps - float(reader.time_ps[0])
                for start in range(0, reader.n_frames, _AT_ONCE):
                    _copy(reader, slice(start, min(start + _AT_ONCE, reader.n_frames)), writer, shift_ps, columns)
                next_ps = float(reader.time_ps[-1]) + shift_ps + interval_ps
            writer.update_record({"completed": complete})
    return out


def summed_cost(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return the `cost` of replicas as an entry of a record, each number summed; nothing where one says none."""
    costs = [c for c in (r.get("cost") for r in records) if isinstance(c, Mapping)]
    if len(costs) < len(records):
        return {}
    numbers = sorted(k for k in costs[0] if all(isinstance(c.get(k), (int, float)) for c in costs))
    return {"cost": {k: sum(c[k] for c in costs) for k in numbers}}


def replicas_of(record: Mapping[str, Any], n_frames: int) -> list[tuple[slice, dict[str, Any]]]:
    """Return the frames of each replica in a file and what it says of itself: of one that is not joined, all. Raises
    TrajectoryError where the record does not fit the file."""
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
