"""What weights say of themselves: what they were trained for, and how they were made."""

from __future__ import annotations

import platform
from datetime import UTC, datetime
from typing import Any

import numpy as np
import torch

from surrogate.data.frames import TrainingFrames
from surrogate.data.weights import TrainingDomain, Weights
from systems.limits import limits_from_frames
from systems.validity import geometry_from_frames


def training_domain(frames: TrainingFrames, *, stride: int = 1, n_geometry_frames: int = 20_000) -> TrainingDomain:
    """Return the domain of weights trained on every `stride`-th of `frames`; its checks are measured on evenly spaced
    training frames."""
    starts = frames.window_starts(stride + 1, validation=False)
    picked = starts[np.linspace(0, len(starts) - 1, min(n_geometry_frames, len(starts))).astype(int)]
    positions = frames.positions_nm(picked)
    geometry = geometry_from_frames(frames.scene, positions)
    limits = limits_from_frames(frames.scene, positions, frames.positions_nm(picked + stride))
    return TrainingDomain(frames.scene, frames.lag_ps * stride, frames.conditions, geometry.to_dict(), limits.to_dict())


def provenance_of(frames: TrainingFrames, settings: dict[str, Any], start: Weights | None = None) -> dict[str, Any]:
    """Return when, where and from what weights were made, with the training's `settings`; `start` is what it began
    with."""
    earlier = {} if start is None else {"from": {"hash": start.hash, **start.provenance}}
    return {
        **earlier,
        "trained": datetime.now(UTC).isoformat(timespec="seconds"),
        "torch": torch.__version__,
        "machine": platform.machine(),
        "reference_ns": frames.total_ps * 1e-3,
        "sources": list(frames.sources),
        **settings,
    }
