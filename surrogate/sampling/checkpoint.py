"""Where a rollout stands: written beside its first file after each flush, read by `--resume`."""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.sampling.account import Tally
from systems.errors import InputError
from systems.whole_file import create_whole

Float32Array = npt.NDArray[np.float32]

_FORMAT = 2
# What zipfile and NumPy raise on files that are damaged, or made to harm; nothing in them is ever run.
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, RuntimeError, MemoryError,
               OverflowError, struct.error, zlib.error, zipfile.BadZipFile)  # fmt: skip


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


def checkpoint_path(out: Path) -> Path:
    """Return where the checkpoint of a rollout stands whose first file is `out`."""
    return out.with_name(out.name + ".checkpoint")


def write_checkpoint(path: Path, progress: Progress, settings: dict[str, Any]) -> None:
    """Write a checkpoint whole or not at all. Raises StorageError."""
    arrays: dict[str, Any] = {k: v for k, v in vars(progress).items() if isinstance(v, np.ndarray)}
    plain = {k: v for k, v in asdict(progress).items() if k not in arrays}
    buffer = io.BytesIO()
    header = {"format": _FORMAT, "settings": settings, "progress": plain}
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)
    create_whole(path, lambda temporary: _write_bytes(temporary, buffer.getvalue()))


def _write_bytes(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def precision_of(path: Path) -> str:
    """Return the precision, 'fp32' or 'bf16', of the rollout that a checkpoint is of; 'auto' where it cannot be read.

    A rollout that goes on keeps it, whatever another processor would choose.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            return "bf16" if json.loads(str(stored["header"]))["settings"]["bf16"] else "fp32"
    except UNREADABLE:
        return "auto"


def read_checkpoint(path: Path, settings: dict[str, Any] | None) -> Progress:
    """Return where a rollout of these settings stood, or of any (None).

    Raises InputError when the file cannot be read, or the rollout was started with other settings.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            arrays = {key: stored[key] for key in stored.files if key != "header"}
        known, plain = header["settings"], header.get("progress", {})
        of_this_version = header.get("format") == _FORMAT
        tallies = [Tally(**tally) for tally in plain.pop("tallies", [])]
        progress = Progress(**arrays, **plain, tallies=tallies) if of_this_version else None
    except UNREADABLE as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"checkpoint {path} cannot be read ({reason}); start again with --overwrite.") from error
    if progress is None:
        raise InputError(f"checkpoint {path} is of another version of surromd; start again with --overwrite.")
    wanted = known if settings is None else settings
    for key in {**known, **wanted}:
        was, now = known.get(key), wanted.get(key)
        if was != now:
            raise InputError(f"{path}: this rollout was started with {key} = {was!r}, not {now!r}.")
    return progress
