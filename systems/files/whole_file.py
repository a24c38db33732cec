"""A file that appears whole or not at all, and stays when the power fails."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from systems.errors import StorageError, TrajectoryError


def storage_error(path: str | os.PathLike[str], error: OSError, kept: str) -> StorageError:
    """Return the StorageError to raise for a failed write; `kept` says what stays readable."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        reason = "the disk (or its quota) is full"
    elif error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        reason = "the folder or the file is not writable"
    elif error.errno in (errno.ENOENT, errno.ENOTDIR):
        reason = "its folder does not exist"
    else:
        reason = error.strerror or str(error)
    return StorageError(f"Cannot write {os.fspath(path)}: {reason}; {kept}.")


def write_whole(descriptor: int, data: bytes | memoryview, offset: int) -> None:
    """Write all of `data` at `offset`; OSError (ENOSPC, EFBIG) when the disk takes only part of it."""
    view = memoryview(data)
    while len(view):
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def force_out(path: Path) -> None:
    """Wait until a file's contents, or a folder's list of names, are on the medium (fsync). Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise TrajectoryError when `path` exists and must not be replaced."""
    if path.exists() and not overwrite:
        raise TrajectoryError(f"{path} exists already; overwrite it, resume it, or choose another name.")


def create_whole(path: Path, content: bytes | str | Callable[[Path], object]) -> None:
    """Write a file under a name that nobody can guess and rename it to `path` when it is on the medium.

    `content`: bytes, text, or a function that fills the file whose path it is given. An existing `path` is replaced
    only at the end. It has the rights of any new file. Raises StorageError when the disk is full or not writable.
    """
    temporary = None
    try:
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".new")
        temporary = Path(name)
        try:
            if callable(content):
                content(temporary)
            else:
                write_whole(descriptor, content.encode() if isinstance(content, str) else content, 0)
        finally:
            os.close(descriptor)
        temporary.chmod(0o666 & ~_umask())
        force_out(temporary)
        os.replace(temporary, path)
        force_out(path.parent)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def _umask() -> int:
    # There is no way to ask without setting it.
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
