"""Sets of trajectories of many small systems of one size, in one HDF5 file that grows block by block."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from systems.errors import InputError, TrajectoryError
from systems.files.outside import open_checked
from systems.files.schema import parsed

SPLITS = ("train", "validation", "test")
_FORMAT = "surromd-particle-sets-1"
_ARRAYS = ("positions_nm", "velocities_nm_ps", "types", "pairs", "seeds")


@dataclass(frozen=True, eq=False)
class ParticleSet:
    """Trajectories of systems of `n_particles` each.

    `positions_nm` and `velocities_nm_ps` `(n, n_frames, n_particles, 3)` float64; `types` `(n, n_particles)` int64, the
    kind of each particle; `pairs` `(n, n_particles, n_particles)` int64, the kind of each pair; `seeds` `(n,)` int64,
    what each system was drawn from; frames are `lag_ps` apart.
    """

    positions_nm: npt.NDArray[np.float64]
    velocities_nm_ps: npt.NDArray[np.float64]
    types: npt.NDArray[np.int64]
    pairs: npt.NDArray[np.int64]
    seeds: npt.NDArray[np.int64]
    lag_ps: float

    def __len__(self) -> int:
        return len(self.seeds)

    @property
    def n_particles(self) -> int:
        return self.positions_nm.shape[2]

    def first(self, n: int) -> ParticleSet:
        """Return the first n systems."""
        return self.rows(slice(n))

    def rows(self, which: slice | npt.NDArray[np.int64]) -> ParticleSet:
        """Return these systems."""
        arrays = {name: getattr(self, name)[which] for name in _ARRAYS}
        return ParticleSet(**arrays, lag_ps=self.lag_ps)


def create_sets(path: Path, record: dict[str, Any]) -> None:
    """Make an empty file that says in `record` how its trajectories are made. An existing one must say the same.

    Raises InputError for a file of another record or one that cannot be read.
    """
    if path.exists():
        found = _read_record(path)
        if found != record:
            changed = sorted(k for k in {*found, *record} if found.get(k) != record.get(k))
            raise InputError(f"{path} holds other data ({', '.join(changed)} differ); choose another folder.")
        return
    with h5py.File(path, "w") as handle:
        handle.attrs["format"] = _FORMAT
        handle.attrs["record"] = json.dumps(record, sort_keys=True)
        for split in SPLITS:
            handle.create_group(split).attrs["complete"] = 0


def n_complete(path: Path, split: str) -> int:
    """Return how many systems of a split are on disk whole."""
    with _open(path) as handle:
        return int(handle[split].attrs["complete"])


def append_systems(path: Path, split: str, block: ParticleSet) -> None:
    """Add systems behind those of the split; one that an interrupted append left half is written over."""
    with _open(path, "r+") as handle:
        group = handle[split]
        start = int(group.attrs["complete"])
        for name in _ARRAYS:
            rows = getattr(block, name)
            if name not in group:
                group.create_dataset(name, data=rows, maxshape=(None, *rows.shape[1:]), chunks=(50, *rows.shape[1:]))
                continue
            group[name].resize(start + len(rows), axis=0)
            group[name][start:] = rows
        # Counted only when the rows are on disk.
        handle.flush()
        group.attrs["complete"] = start + len(block)


def read_set(path: Path, split: str, n: int | None = None) -> ParticleSet:
    """Read the first n systems of a split (all that are complete without n). Raises InputError when there are fewer."""
    with _open(path) as handle:
        complete = int(handle[split].attrs["complete"])
        n = complete if n is None else n
        if n > complete or n < 1:
            raise InputError(f"{path} holds {complete} {split} trajectories, not {n}.")
        arrays = {name: handle[split][name][:n] for name in _ARRAYS}
        lag_ps = float(parsed(handle.attrs["record"])["lag_ps"])
    return ParticleSet(**arrays, lag_ps=lag_ps)


def check_disjoint(sets: Sequence[ParticleSet]) -> None:
    """Raise InputError when two sets share a system: a seed or a first frame."""
    for k, one in enumerate(sets):
        for other in sets[k + 1 :]:
            starts = [{x.tobytes() for x in s.positions_nm[:, 0]} for s in (one, other)]
            if np.intersect1d(one.seeds, other.seeds).size or starts[0] & starts[1]:
                raise InputError("training, validation and test share trajectories; delete the file and make it again.")


def _open(path: Path, mode: str = "r") -> h5py.File:
    try:
        handle = open_checked(path, mode)
    except (OSError, TrajectoryError) as error:
        raise InputError(f"{path} cannot be read ({error}); delete it and run again.") from error
    if handle.attrs.get("format") != _FORMAT:
        handle.close()
        raise InputError(f"{path} is no file of trajectory sets; choose another folder.")
    return handle


def _read_record(path: Path) -> dict[str, Any]:
    with _open(path) as handle:
        record: dict[str, Any] = parsed(handle.attrs["record"])
    return record
