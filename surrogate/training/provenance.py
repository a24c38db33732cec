"""Training domain and provenance of weights: what they cover, when, where and from what they were made."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

import torch

from surrogate.data.frames import TrainingFrames
from surrogate.data.weights import TrainingDomain, Weights
from systems.chemistry.validity import geometry_from_frames, limits_from_frames


def training_domain(
    frames: TrainingFrames, *, stride: int = 1, strides: Sequence[int] = (), n_geometry_frames: int = 20_000
) -> TrainingDomain:
    """Return the domain of weights trained on every `stride`-th of `frames`; its checks are measured on evenly spaced
    training frames. `strides`: those of a model that takes the lag, from 1 on, for each of which jumps are measured."""
    picked = frames.spread_starts(n_geometry_frames, stride + 1)
    positions = frames.positions_nm(picked)
    geometry = geometry_from_frames(frames.scene, positions)
    limits = limits_from_frames(frames.scene, positions, frames.positions_nm(picked + stride))
    jumps = []
    for wide in strides:
        picked = frames.spread_starts(n_geometry_frames, wide + 1)
        found = limits_from_frames(frames.scene, frames.positions_nm(picked), frames.positions_nm(picked + wide))
        jumps.append((frames.lag_ps * wide, found.jump_min_nm, found.jump_max_nm))
    return TrainingDomain(frames.scene, frames.lag_ps * stride, frames.conditions, geometry.to_dict(), limits.to_dict(),
                          tuple(jumps))  # fmt: skip


def provenance_of(origin: dict[str, Any], settings: dict[str, Any], start: Weights | None = None) -> dict[str, Any]:
    """Return when, where and from what weights were made. `origin`: of the frames trained on (`TrainingFrames.origin`);
    `settings`: of the training; `start`: the weights that it began with, of whose trajectories those are told that are
    not among `origin`'s."""
    earlier = {}
    if start is not None:
        known = {source["sha256"] for source in origin.get("sources", ()) if "sha256" in source}
        earlier = {"from": {"hash": start.hash, **_beside(start.provenance, known)}}
    return {
        **earlier,
        "trained": datetime.now(UTC).isoformat(timespec="seconds"),
        "torch": torch.__version__,
        "machine": platform.machine(),
        **origin,
        **settings,
    }


def _beside(record: dict[str, Any], known: set[str]) -> dict[str, Any]:
    """Return what earlier weights say of themselves, and those that they began with, of trajectories those that are not
    `known`."""
    left = [source for source in record.get("sources", ()) if source.get("sha256") not in known]
    found = {**record, "sources": left} if "sources" in record else dict(record)
    if isinstance(record.get("from"), dict):
        found["from"] = _beside(record["from"], known | {source["sha256"] for source in left if "sha256" in source})
    return found
