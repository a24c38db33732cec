"""Training frames of several molecules: trajectories grouped by topology, split by system, laid in standard poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.data.frames import TrainingFrames, collect_frames, is_windows, load_frames
from surrogate.data.poses import in_standard_pose, standard_turn
from surrogate.data.splits import Split
from systems.chemistry.graph import molecule_key
from systems.errors import InputError


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
    unseen = [_hold_out(_read(files, [], spool)) for files in also.values()]
    sets = FrameSets(tuple(map(_pose, trained)), tuple(map(_pose, unseen)))
    refuse_mixtures(sets)
    return sets


def refuse_mixtures(sets: FrameSets) -> None:
    """Raise InputError for sets that one model cannot learn from, and for a system both trained on and held out."""
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


def _by_topology(paths: list[Path]) -> dict[str, list[Path]]:
    from systems.trajectory.codec import open_trajectory

    found: dict[str, list[Path]] = {}
    for path in paths:
        if is_windows(path):
            found[f"windows {path}"] = [path]
            continue
        with open_trajectory(path) as reader:
            if reader.scene is None:
                raise InputError(f"{path} carries no topology; give an HDF5 file written by surromd or MDTraj.")
            found.setdefault(reader.scene.topology_hash, []).append(path)
    return found


def _read(paths: list[Path], held: list[Path], spool: Path | None) -> TrainingFrames:
    if is_windows(paths[0]):
        frames = load_frames(paths[0])
        if not frames.canonical:
            raise InputError(f"{paths[0]} holds frames in their own pose; make it without `velocities=True`.")
        return frames
    return collect_frames(paths, held=held, spool=spool)


def _hold_out(frames: TrainingFrames) -> TrainingFrames:
    return replace(frames, split=Split(held=tuple(range(len(frames.starts) - 1))))


def _pose(frames: TrainingFrames) -> TrainingFrames:
    """Return the frames with their template along its own axes; they are turned as they are read."""
    return replace(frames, scene=in_standard_pose(frames.scene), turn=standard_turn(frames.scene))
