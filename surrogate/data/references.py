"""References of a training: trajectories or windows files, surveyed first and read when their frames are needed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from surrogate.data.frames import TrainingFrames, collect_frames, is_windows, load_frames
from surrogate.data.molecules import FrameSets, collect_sets
from surrogate.models.architecture import Survey
from systems.errors import InputError
from systems.scene import Scene


@dataclass(frozen=True)
class References:
    """Files to train on. `held`: trajectories that are held out whole, for validation. `spool`: a folder for frames
    that memory does not hold."""

    paths: tuple[Path, ...]
    held: tuple[Path, ...] = ()
    spool: Path | None = None
    _read: dict[tuple[bool, bool], TrainingFrames] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def survey(self) -> Survey:
        """Return what the files say of themselves. Raises InputError for a file without topology or times."""
        told = [_windows(path) if is_windows(path) else _trajectory(path) for path in (*self.paths, *self.held)]
        if not self.paths:
            raise InputError("no trajectory given to train on.")
        trained, unseen, longest = dict[str, Scene](), dict[str, Scene](), dict[str, int]()
        for file in told[: len(self.paths)]:
            key = file.scene.topology_hash
            trained.setdefault(key, file.scene)
            longest[key] = max(longest.get(key, 0), file.n_longest)
        for file in told[len(self.paths) :]:
            if (key := file.scene.topology_hash) not in trained:
                unseen.setdefault(key, file.scene)
        return Survey(
            scenes=tuple(trained.values()),
            unseen=tuple(unseen.values()),
            longest=tuple(longest.values()),
            n_frames=sum(file.n_frames for file in told[: len(self.paths)]),
            lag_ps=told[0].lag_ps,
            velocities=all(file.velocities for file in told),
            equilibrium=all(file.equilibrium for file in told),
        )

    def frames(self, *, canonical: bool, velocities: bool = False) -> TrainingFrames:
        """Return the frames of one molecule, from trajectories or from one windows file.

        Raises InputError for files of several molecules, save intervals or conditions; for windows without the
        velocities that are asked for; and where a stretch of motion would be both trained on and validated on.
        """
        key = (canonical, velocities)
        if key not in self._read:
            self._read[key] = self._frames(canonical=canonical, velocities=velocities)
        return self._read[key]

    def _frames(self, *, canonical: bool, velocities: bool) -> TrainingFrames:
        if not any(is_windows(path) for path in self.paths):
            frames = collect_frames(
                list(self.paths), canonical=canonical, velocities=velocities, held=list(self.held), spool=self.spool
            )
            frames.refuse_leaks()
            return frames
        if self.held:
            raise InputError("`validation` needs trajectories to train on; a windows file keeps its own split.")
        if len(self.paths) > 1:
            raise InputError("give either trajectories or one windows file to train on.")
        frames = load_frames(self.paths[0])
        if velocities and frames.velocities is None:
            raise InputError(
                f"{self.paths[0]} holds no velocities, which this architecture learns from; make it with "
                "`velocities=True` of `windows`."
            )
        frames.refuse_leaks()
        return frames

    def sets(self) -> FrameSets:
        """Return the frames of any number of molecules (`data.molecules.collect_sets`)."""
        return collect_sets(list(self.paths), held=list(self.held), spool=self.spool)


@dataclass(frozen=True, eq=False)
class _Told:
    scene: Scene
    n_frames: int
    n_longest: int
    lag_ps: float
    velocities: bool
    equilibrium: bool


def _windows(path: Path) -> _Told:
    frames = load_frames(path)
    longest = int(np.diff(frames.starts).max())
    constant = frames.conditions.get("temperature_k") is not None
    return _Told(frames.scene, frames.n_frames, longest, frames.lag_ps, frames.velocities is not None, constant)


def _trajectory(path: Path) -> _Told:
    from systems.trajectory.codec import open_trajectory

    with open_trajectory(path) as reader:
        if reader.scene is None:
            raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
        times, n_frames = reader.time_ps, reader.n_frames
        lag_ps = float(times[1] - times[0]) if n_frames > 1 else 0.0
        moving = n_frames > 0 and reader.read_velocities(0, 1) is not None
        constant = reader.record.get("kind") == "reference" and reader.record.get("temperature_k") is not None
        return _Told(reader.scene, n_frames, n_frames, lag_ps, moving, constant)
