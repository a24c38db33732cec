"""Checkpoint of a rollout: written beside its first file after each flush, read by `resume`."""

from __future__ import annotations

import io
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.sampling.rollout_account import Tally
from systems.errors import InputError, first_line
from systems.files.outside import UNREADABLE, arrays_in
from systems.files.schema import built
from systems.trajectory.checkpoint import Checkpoint

Float32Array = npt.NDArray[np.float32]


@dataclass
class Progress:
    """Where a rollout stands between two chunks.

    `last_frames (replicas, n_conditioning, n_atoms, 3)` nm, in the model's atom order and the user's pose, relative to
    where the scene's centre was; `velocities (replicas, n_atoms, 3)` nm/ps of a model that carries them. `steps`: model
    frames done, kept or not. `batch`: replicas computed at once, if memory has run out before. `drawn`: chunks drawn of
    all replicas, further draws included, which took `evaluations` of the network together.
    """

    last_frames: Float32Array
    velocities: Float32Array | None = None
    chunks: int = 0
    steps: int = 0
    wall_s: float = 0.0
    batch: int | None = None
    drawn: int = 0
    evaluations: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    tallies: list[Tally] = field(default_factory=list)


def packed_progress(progress: Progress) -> tuple[dict[str, Any], bytes]:
    """Return what a checkpoint keeps of a rollout: JSON for its header, and arrays."""
    arrays: dict[str, Any] = {k: v for k, v in vars(progress).items() if isinstance(v, np.ndarray)}
    plain = {k: v for k, v in asdict(progress).items() if k not in arrays}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return plain, buffer.getvalue()


def progress_of(path: Path, state: Checkpoint, settings: dict[str, Any] | None) -> Progress:
    """Return where a rollout of these settings stood, or of any (None), by one state in its checkpoint `path`.

    Raises InputError when it cannot be read, or the rollout was started with other settings.
    """
    header, blob = state
    try:
        arrays = arrays_in(io.BytesIO(blob))
        known, progress = dict(header["settings"]), built(Progress, {**header["progress"], **arrays}, "progress.")
    except UNREADABLE as error:
        raise InputError(
            f"checkpoint {path} cannot be read ({first_line(error)}); start again with `overwrite=True`."
        ) from error
    wanted = known if settings is None else settings
    for key in {**known, **wanted}:
        was, now = known.get(key), wanted.get(key)
        if was != now:
            raise InputError(f"{path}: this rollout was started with {key} = {was!r}, not {now!r}.")
    return progress
