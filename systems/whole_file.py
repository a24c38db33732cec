"""A file that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from systems.atomic_file import storage_error


def create_whole(path: Path, fill: Callable[[Path], None]) -> None:
    """Call `fill(temporary)` on a new file beside `path` and rename it to `path` when it is on disk.

    An existing `path` is replaced only then. Raises StorageError when the disk is full or not writable.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        fill(temporary)
        with open(temporary, "rb") as handle:
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    finally:
        temporary.unlink(missing_ok=True)
