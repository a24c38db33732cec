"""Output files: their names, and a lock on each, so that one process writes it at a time."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import storage_error

_ASK_EVERY_S = 0.5
_MOST_REPLICAS = 10_000


def replica_paths(out: Path, n_replicas: int) -> list[Path]:
    """Return `out` itself for one replica, else NAME_r0.h5, NAME_r1.h5, ... Raises InputError for too many."""
    if n_replicas == 1:
        return [out]
    if n_replicas > _MOST_REPLICAS:
        raise InputError(f"{n_replicas:.4g} replicas are too many, {_MOST_REPLICAS} at most; use a campaign for more.")
    return [out.with_name(f"{out.stem}_r{k}{out.suffix}") for k in range(n_replicas)]


class Claim:
    """A lock on `.NAME.lock` beside an output, which the system gives back when this process ends, however it ends.

    It holds against other threads of this process, too. Raises TrajectoryError when another one has the output, and has
    not let go of it after `patience_s`; KeyboardInterrupt when `stopped()` while waiting; StorageError.
    """

    def __init__(self, path: Path, *, patience_s: float = 0.0, stopped: Callable[[], bool] = lambda: False) -> None:
        self._path = path.resolve()
        self._lock = self._path.with_name(f".{self._path.name}.lock")
        self._fd = -1
        deadline = time.monotonic() + patience_s
        while not self._taken():
            if stopped():
                raise KeyboardInterrupt
            if time.monotonic() >= deadline:
                raise TrajectoryError(f"{path} is being written by another process; wait, or take another name.")
            time.sleep(_ASK_EVERY_S)

    def _taken(self) -> bool:
        try:
            import fcntl
        except ImportError:  # not a POSIX system: two writers are the user's to avoid
            return True
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            descriptor = os.open(self._lock, flags, 0o666)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # Who held it before may have removed its name meanwhile: then this is a lock on nothing.
                if os.path.samestat(os.fstat(descriptor), os.stat(self._lock)):
                    self._fd, descriptor = descriptor, -1
            finally:
                if descriptor >= 0:
                    os.close(descriptor)
        except (BlockingIOError, FileNotFoundError) as error:
            if isinstance(error, FileNotFoundError) and not self._lock.parent.is_dir():
                raise storage_error(self._path, error, "nothing was changed") from error
        except OSError as error:
            # Some file systems of clusters know no locks.
            if error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP):
                raise storage_error(self._path, error, "nothing was changed") from error
            return True
        return self._fd >= 0

    def close(self) -> None:
        """Let go; twice does no harm."""
        if self._fd >= 0:
            with suppress(OSError):
                self._lock.unlink(missing_ok=True)
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        self.close()
