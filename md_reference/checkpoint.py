"""Checkpoint files: one line of JSON about the run, then OpenMM's own binary state, found whole or refused."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from systems.errors import InputError, StorageError


def checkpoint_path(out: Path) -> Path:
    """Where the checkpoint of a trajectory lies: beside it, until the run is complete."""
    return out.with_name(out.name + ".checkpoint")


def write_checkpoint(path: Path, header: dict[str, Any], blob: bytes, *, sync: bool) -> None:
    """Replace the checkpoint as a whole. A process may be killed at any moment.

    With `sync` it is on the medium when this returns; without, in the system's hands, which a kill does not touch, at a
    hundredth of the cost. Raises StorageError; the checkpoint before then stays.
    """
    temporary = path.with_name(path.name + ".new")
    bare = {key: value for key, value in header.items() if key != "sha256"}
    header = {**bare, "sha256": _digest(json.dumps(bare).encode(), blob)}
    try:
        with open(temporary, "wb") as handle:
            handle.write(json.dumps(header).encode() + b"\n" + blob)
            if sync:
                handle.flush()
                os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise StorageError(f"cannot write checkpoint {path}: {error.strerror}; free space and --resume.") from error


def read_checkpoint(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the header and OpenMM's state. Raises InputError when they are damaged."""
    try:
        line, _, blob = path.read_bytes().partition(b"\n")
        header = json.loads(line)
        bare = {key: value for key, value in header.items() if key != "sha256"}
        # OpenMM loads a truncated checkpoint without a word. Earlier versions left the header out of the checksum.
        if header["sha256"] not in (_digest(json.dumps(bare).encode(), blob), _digest(blob)):
            raise ValueError("its checksum is wrong")
        return header, blob
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"checkpoint {path} is damaged ({error}); start again with --overwrite.") from error


def _digest(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()
