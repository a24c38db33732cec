"""References of a training: files of one molecule or several, surveyed first and read when frames are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surrogate.data.frames import (
    Split,
    TrainingFrames,
    collect_frames,
    in_standard_pose,
    is_windows,
    load_frames,
    standard_turn,
)
from systems.chemistry.graph import molecule_key
from systems.errors import InputError
from systems.scene import Scene

# Training frames of several molecules: trajectories grouped by topology, split by system, laid in standard poses.


@dataclass(frozen=True, eq=False)
class FrameSets:
    """Frames of several molecules. Those `trained` on hold their own validation stretches; those of `unseen` are held
    out whole: curves are measured on them, and nothing is learned from them."""

    trained: tuple[TrainingFrames, ...]
    unseen: tuple[TrainingFrames, ...] = ()

    @property
    def names(self) -> str:
        return ", ".join(frames.scene.name for frames in self.trained)

    @property
    def origin(self) -> dict[str, Any]:
        """How much reference is trained on, and of which files, as the record of a training has it."""
        sources = [source for frames in self.trained for source in frames.sources]
        return {"reference_ns": sum(frames.total_ps for frames in self.trained) * 1e-3, "sources": sources}


def collect_sets(paths: list[Path], *, held: list[Path] | None = None, spool: Path | None = None) -> FrameSets:
    """Read reference trajectories, or windows files, of any number of molecules, canonical and in standard poses.

    Trajectories in `held` of a molecule that is trained on are its validation; molecules that appear in `held` alone
    are held out as systems. Raises InputError when save intervals or temperatures differ, when one molecule comes in
    two atom orders, so that it would be trained on under one and held out under the other, and for leaks of frames.
    """
    seen, also = _by_topology(paths), _by_topology(held or [])
    trained = [_read(files, also.pop(key, []), spool) for key, files in seen.items()]
    unseen = [_read(files, [], spool) for files in also.values()]
    unseen = [replace(frames, split=Split(held=tuple(range(len(frames.starts) - 1)))) for frames in unseen]
    sets = FrameSets(tuple(map(_pose, trained)), tuple(map(_pose, unseen)))
    first, keys = sets.trained[0], dict[str, TrainingFrames]()
    for frames in (*sets.trained, *sets.unseen):
        name = frames.scene.name
        if not np.isclose(frames.lag_ps, first.lag_ps, rtol=1e-4):
            raise InputError(
                f"{name} is saved every {frames.lag_ps:g} ps, {first.scene.name} every {first.lag_ps:g} ps; one model "
                "learns one interval (and multiples of it)."
            )
        asked, known = (f.conditions.get("temperature_k") for f in (frames, first))
        if asked != known:
            raise InputError(f"{name} was made at {asked} K, {first.scene.name} at {known} K; this model takes none.")
        other = keys.setdefault(molecule_key(frames.scene), frames)
        if other is not frames:
            both = " and would be both trained on and held out" if frames in sets.unseen else ""
            raise InputError(
                f"{name} and {other.scene.name} are one molecule in two atom orders{both}; give it in one."
            )
        frames.refuse_leaks()
    return sets


def _by_topology(paths: list[Path]) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for path in paths:
        key = f"windows {path}" if is_windows(path) else _summary(path).scene.topology_hash
        found.setdefault(key, []).append(path)
    return found


def _read(paths: list[Path], held: list[Path], spool: Path | None) -> TrainingFrames:
    if is_windows(paths[0]):
        frames = load_frames(paths[0])
        if not frames.canonical:
            raise InputError(f"{paths[0]} holds frames in their own pose; make it without `velocities=True`.")
        return frames
    return collect_frames(paths, held=held, spool=spool)


def _pose(frames: TrainingFrames) -> TrainingFrames:
    """Return the frames with their template along its own axes; they are turned as they are read."""
    return replace(frames, scene=in_standard_pose(frames.scene), turn=standard_turn(frames.scene))


# Windows of frames that stand one, two, ... up to a thousand spacings apart, for a model that takes the lag.

_PER_DECADE = 8


def strides_up_to(longest: int) -> tuple[int, ...]:
    """Return strides from 1 to `longest`, evenly spaced in their logarithm, about eight a decade."""
    n = max(2, round(_PER_DECADE * np.log10(longest)) + 1)
    return tuple(sorted({round(float(x)) for x in np.geomspace(1, longest, n)})) if longest > 1 else (1,)


@dataclass(frozen=True, eq=False)
class StrideSampler:
    """Draws windows of any of `strides`, each as likely; `starts[k]` (n_k,) are the first frames of those of stride
    k."""

    strides: tuple[int, ...]
    starts: tuple[Tensor, ...]

    @staticmethod
    def of(frames: TrainingFrames, length: int, strides: Sequence[int], *, validation: bool = False) -> StrideSampler:
        """Return the sampler of windows of `length` frames. Raises InputError where one of the longest does not fit
        into a training stretch; validation takes those that fit."""
        found: list[tuple[int, Tensor]] = []
        for stride in strides:
            span = (length - 1) * stride + 1
            try:
                found.append((stride, torch.from_numpy(frames.window_starts(span, validation=validation))))
            except InputError as error:
                if validation and found:
                    break
                raise InputError(
                    f"{frames.scene.name}: no window of {length} frames {stride * frames.lag_ps:g} ps apart fits; give "
                    "longer trajectories, a shorter `longest_lag_ps` or shorter chunks."
                ) from error
        return StrideSampler(tuple(s for s, _ in found), tuple(starts for _, starts in found))

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return first frames `(n,)` and strides `(n,)`."""
        which = torch.randint(len(self.strides), (n,), generator=generator)
        place = torch.rand(n, generator=generator, dtype=torch.float64)
        sizes = torch.tensor([len(starts) for starts in self.starts])
        first = torch.empty(n, dtype=torch.int64)
        for k, starts in enumerate(self.starts):
            rows = which == k
            first[rows] = starts[(place[rows] * sizes[k]).long()]
        return first, torch.tensor(self.strides)[which]


# References of a training: trajectories or windows files, surveyed first and read when their frames are needed.


@dataclass(frozen=True, eq=False)
class Survey:
    """A summary of the trajectories to train on, made without reading their frames.

    `scenes`: each molecule trained on once; `unseen`: those that appear in the validation alone. `longest`: frames of
    the longest trajectory of each of `scenes`, `n_frames` all that are trained on. `lag_ps`: time between frames.
    `velocities`: whether all files carry them. `equilibrium`: whether all were simulated at constant temperature.
    """

    scenes: tuple[Scene, ...]
    unseen: tuple[Scene, ...]
    longest: tuple[int, ...]
    n_frames: int
    lag_ps: float
    velocities: bool
    equilibrium: bool

    @property
    def one_molecule(self) -> bool:
        return len(self.scenes) == 1 and not self.unseen


@dataclass(frozen=True)
class References:
    """Files to train on. `held`: trajectories that are held out whole, for validation. `spool`: a folder for frames
    that memory does not hold."""

    paths: tuple[Path, ...]
    held: tuple[Path, ...] = ()
    spool: Path | None = None

    @cached_property
    def survey(self) -> Survey:
        """Return what the files say of themselves. Raises InputError for a file without topology or times."""
        files = [_summary(path) for path in (*self.paths, *self.held)]
        if not self.paths:
            raise InputError("no trajectory given to train on.")
        trained, unseen, longest = dict[str, Scene](), dict[str, Scene](), dict[str, int]()
        for file in files[: len(self.paths)]:
            key = file.scene.topology_hash
            trained.setdefault(key, file.scene)
            longest[key] = max(longest.get(key, 0), file.n_longest)
        for file in files[len(self.paths) :]:
            if (key := file.scene.topology_hash) not in trained:
                unseen.setdefault(key, file.scene)
        return Survey(
            scenes=tuple(trained.values()),
            unseen=tuple(unseen.values()),
            longest=tuple(longest.values()),
            n_frames=sum(file.n_frames for file in files[: len(self.paths)]),
            lag_ps=files[0].lag_ps,
            velocities=all(file.velocities for file in files),
            equilibrium=all(file.equilibrium for file in files),
        )

    def frames(self, *, canonical: bool, velocities: bool = False) -> TrainingFrames:
        """Return the frames of one molecule, from trajectories or from one windows file.

        Raises InputError for files of several molecules, save intervals or conditions; for windows without the
        velocities that are asked for; and where a stretch of motion would be both trained on and validated on.
        """
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
        """Return the frames of any number of molecules (`data.references.collect_sets`)."""
        return collect_sets(list(self.paths), held=list(self.held), spool=self.spool)


@dataclass(frozen=True, eq=False)
class _FileSummary:
    scene: Scene
    n_frames: int
    n_longest: int
    lag_ps: float
    velocities: bool
    equilibrium: bool


def _summary(path: Path) -> _FileSummary:
    from systems.trajectory.codec import open_trajectory

    if is_windows(path):
        frames = load_frames(path)
        longest, moving = int(np.diff(frames.starts).max()), frames.velocities is not None
        constant = frames.conditions.get("temperature_k") is not None
        return _FileSummary(frames.scene, frames.n_frames, longest, frames.lag_ps, moving, constant)
    with open_trajectory(path) as reader:
        if reader.scene is None:
            raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
        times, n_frames = reader.time_ps, reader.n_frames
        lag_ps = float(times[1] - times[0]) if n_frames > 1 else 0.0
        moving = n_frames > 0 and reader.read_velocities(0, 1) is not None
        constant = reader.record.get("kind") == "reference" and reader.record.get("temperature_k") is not None
        return _FileSummary(reader.scene, n_frames, n_frames, lag_ps, moving, constant)
