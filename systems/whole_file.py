"""A file that appears whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from systems.atomic_file import storage_error


def create_whole(path: Path, fill: Callable[[Path], None]) -> None:
    """Call `fill(temporary)` on a new file beside `path` and rename it to `path` when it is on disk.

    An existing `path` is replaced only then. It has the rights of any new file, whatever `fill` gave it.
    Raises StorageError when the disk is full or not writable.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        fill(temporary)
        temporary.chmod(0o666 & ~_umask())
        with open(temporary, "rb") as handle:
            os.fsync(handle.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    # There is no way to ask without setting it.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
