"""A file that HDF5 writes through, and that reaches the disk one whole transaction at a time."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import TracebackType

from systems.errors import StorageError, TrajectoryError

_BTREE, _SYMBOLS = b"TREE", b"SNOD"


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


class AtomicFile:
    """A seekable binary file whose writes wait in memory until `commit`.

    HDF5 has no transactions: a process killed, or a disk filled, between two of its writes can leave metadata that name
    data which never arrived, and then the whole file is lost. Given to h5py as its file object, this class collects the
    writes of one append and puts them out in an order in which every prefix is a readable file: first what lies beyond
    the old end of the file (nothing refers to it yet; if the disk fills here, the file is cut back and is byte for byte
    what it was), then the superblock (end of file), then index nodes from the root down, then data inside old chunks
    and the object headers, which hold the lengths, and names last. No space is needed after the first step. A
    transaction that shortens the file (`shrinks`) goes the other way: lengths first.

    One writer at a time: an advisory POSIX lock, which leaves HDF5 readers of the running file alone.
    Raises TrajectoryError when another process writes the file, StorageError when it cannot be opened for writing.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._pending: list[tuple[int, bytes]] = []
        self._position = 0
        self._dead = False
        try:
            self._fd = os.open(self.path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
        except OSError as error:
            raise storage_error(self.path, error, "nothing was changed") from error
        try:
            _lock(self._fd, self.path)
        except TrajectoryError:
            os.close(self._fd)
            raise
        self._committed_size = self._size = os.fstat(self._fd).st_size

    # ---- the file object that h5py calls ---------------------------------------------------------------------------

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}[whence]
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        return self._position

    def read(self, size: int = -1) -> bytes:
        start = self._position
        stop = self._size if size < 0 else min(start + size, self._size)
        length = max(stop - start, 0)
        data = bytearray(os.pread(self._fd, length, start))
        data.extend(bytes(length - len(data)))
        for offset, block in self._pending:
            low, high = max(offset, start), min(offset + len(block), stop)
            if low < high:
                data[low - start : high - start] = block[low - offset : high - offset]
        self._position = start + length
        return bytes(data)

    def readinto(self, buffer: bytearray | memoryview) -> int:
        data = self.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def write(self, data: bytes | bytearray | memoryview) -> int:
        block = bytes(data)
        if not self._dead:
            self._pending.append((self._position, block))
        self._position += len(block)
        self._size = max(self._size, self._position)
        return len(block)

    def truncate(self, size: int | None = None) -> int:
        # Only the logical end moves; `commit` cuts the file after everything else is on disk.
        self._size = self._position if size is None else size
        return self._size

    def flush(self) -> None:
        """Nothing: a transaction ends with `commit`, not when HDF5 flushes."""

    # ---- transactions ----------------------------------------------------------------------------------------------

    def plan(self, *, shrinks: bool = False) -> list[tuple[int, bytes]]:
        """Return the pending writes as `(offset, bytes)` in the order in which `commit` makes them."""
        old_end = self._committed_size
        beyond: list[tuple[int, bytes]] = []
        inside: list[tuple[int, bytes]] = []
        for offset, block in self._pending:
            split = max(old_end - offset, 0)
            if split:
                inside.append((offset, block[:split]))
            if split < len(block):
                beyond.append((offset + split, block[split:]))
        return beyond + sorted(_latest(inside), key=_rank, reverse=shrinks)

    def commit(self, *, shrinks: bool = False) -> None:
        """Put the collected writes on disk. On failure raise OSError with the file as it was before the transaction."""
        if self._dead:
            raise OSError(errno.EIO, "an earlier write failed")
        try:
            for offset, block in self.plan(shrinks=shrinks):
                write_whole(self._fd, block, offset)
            if os.fstat(self._fd).st_size != self._size:
                os.ftruncate(self._fd, self._size)
        except OSError:
            self.abandon()
            os.ftruncate(self._fd, self._committed_size)
            raise
        self._pending.clear()
        self._committed_size = self._size

    def abandon(self) -> None:
        """Drop the collected writes and all later ones: HDF5's own state is now ahead of the disk."""
        self._dead = True
        self._pending.clear()

    def close(self) -> None:
        """Close the descriptor; what was not committed is dropped."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> AtomicFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        self.close()


def _latest(writes: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return disjoint writes with the same effect: where two overlap, the later one stands."""
    kept: list[tuple[int, bytes]] = []
    for offset, block in reversed(writes):
        pieces = [(offset, block)]
        for other, cover in kept:
            end = other + len(cover)
            trimmed = []
            for start, data in pieces:
                if start + len(data) <= other or start >= end:
                    trimmed.append((start, data))
                    continue
                if start < other:
                    trimmed.append((start, data[: other - start]))
                if start + len(data) > end:
                    trimmed.append((end, data[end - start :]))
            pieces = trimmed
            if not pieces:
                break
        kept.extend(pieces)
    return kept


def _rank(item: tuple[int, bytes]) -> tuple[int, int]:
    """Order of in-place writes: superblock, index nodes from the root down, from the end of the file back, names."""
    offset, block = item
    if offset == 0:
        return (0, 0)
    if block[:4] == _BTREE and len(block) > 5:
        return (1, -block[5])
    return (3 if block[:4] == _SYMBOLS else 2, -offset)


def _lock(descriptor: int, path: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not a POSIX system: no advisory lock, two writers are the user's to avoid
        return
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            raise TrajectoryError(f"{path} is being written by another process; wait, or take another name.") from error
