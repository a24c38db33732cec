"""A file that HDF5 writes through, and that changes by whole transactions: a journal takes an unfinished one back."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from systems.errors import InputError
from systems.files.checksums import packed, unpacked
from systems.files.whole_file import force_out, storage_error, write_whole

_MAGIC = b"surromd journal 1\n"
_Writes = list[tuple[int, bytes]]
_BTREE, _SYMBOLS = b"TREE", b"SNOD"


def journal_path(path: Path) -> Path:
    """Where the journal of a file lies while it is written."""
    return path.with_name(path.name + ".journal")


class AtomicFile:
    """A seekable binary file whose writes wait in memory until `commit`, which makes all of them or none.

    HDF5 has no transactions: a process killed, a disk filled or the power lost between two of its writes can leave
    metadata that name data which never arrived, and then the whole file is lost. Given to h5py as its file object, this
    class collects the writes of one append. What they overwrite goes to a journal beside the file first, on the medium,
    then the writes to the file; when these are on the medium, too, the journal is void. A journal that is not void is
    from a transaction that did not end: who opens the file to write puts the old bytes back, who opens it to read sees
    them in their place. Other programs read such a file as well after a kill: in-place writes are made in an order in
    which every prefix is readable (superblock, index nodes from the root down, data and object headers, names last).

    `key`: where in the file bytes lie that no other file has, and that no transaction changes; by them a journal knows
    its file. One writer at a time is for the caller to see to. `failure`: why the file could not be read. Raises
    StorageError when it cannot be opened, InputError where another file lies in the journal's place.
    """

    key: tuple[int, int] = (0, 0)
    failure: OSError | None = None

    def __init__(self, path: Path, *, writable: bool) -> None:
        self.path = path
        self._journal = journal_path(path)
        self._pending: _Writes = []
        self._position = 0
        self._dead = not writable
        self._fd = self._journal_fd = -1
        try:
            self._fd = os.open(path, (os.O_RDWR if writable else os.O_RDONLY) | getattr(os, "O_CLOEXEC", 0))
            self._committed_size = self._size = os.fstat(self._fd).st_size
            unfinished = self._unfinished()
            if unfinished is not None and writable:
                self._put_back(*unfinished)
            elif unfinished is not None:
                self._size, self._pending = unfinished
            if writable:
                # O_EXCL: never through a link, never another's file.
                self._journal.unlink(missing_ok=True)
                flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0)
                self._journal_fd = os.open(self._journal, flags, 0o666)
                force_out(path.parent)
        except OSError as error:
            self.close()
            raise storage_error(path, error, "nothing was changed") from error

    @property
    def is_unfinished(self) -> bool:
        """Whether a reader sees old bytes from a journal."""
        return bool(self._pending)

    def _unfinished(self) -> tuple[int, _Writes] | None:
        """Return the size and the bytes that a journal has kept of this file, None where there is nothing to undo."""
        try:
            data = self._journal.read_bytes()
            if data[: len(_MAGIC)].strip(b"\0") not in (b"", _MAGIC):
                raise InputError(f"{self._journal} lies where a journal goes and is none; move it away.")
            header, old, _ = unpacked(data[len(_MAGIC) :])
            if os.pread(self._fd, header["key"][1], header["key"][0]).hex() != header["bytes"]:
                return None
            writes, at = [], 0
            for offset, length in header["blocks"]:
                writes.append((offset, old[at : at + length]))
                at += length
            return header["size"], writes
        except (FileNotFoundError, ValueError, LookupError, TypeError, RecursionError):
            return None  # void, or never finished itself: then the file has not been touched

    def _put_back(self, size: int, writes: _Writes) -> None:
        for offset, block in writes:
            write_whole(self._fd, block, offset)
        os.ftruncate(self._fd, size)
        os.fsync(self._fd)
        self._committed_size = self._size = size

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
        try:
            data = bytearray(os.pread(self._fd, length, start))
        except OSError as error:
            # HDF5 takes no exceptions from here. What it makes of nothing is never committed.
            self.failure, self._dead, data = error, True, bytearray()
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
        """Do nothing: a transaction ends with `commit`, not when HDF5 flushes."""

    # ---- transactions ----------------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Put the collected writes on the medium. On failure raise OSError with the file as it was before."""
        if self._dead:
            raise self.failure or OSError(errno.EIO, "an earlier write failed")
        end = self._committed_size
        writes = _latest(self._pending)
        beyond = [(max(offset, end), block[max(end - offset, 0) :]) for offset, block in writes]
        inside = sorted(
            [(offset, block[: max(end - offset, 0)]) for offset, block in writes if offset < end], key=_rank
        )
        old: _Writes = []
        try:
            old = [(offset, os.pread(self._fd, len(block), offset)) for offset, block in inside]
            self._keep(end, old)
            for offset, block in beyond + inside:
                write_whole(self._fd, block, offset)
            if self._size > end:
                os.ftruncate(self._fd, self._size)
            os.fsync(self._fd)
        except OSError:
            self.abandon()
            with suppress(OSError):  # if this fails, too, the journal stands, and whoever opens the file goes by it
                self._put_back(end, old)
                os.ftruncate(self._journal_fd, 0)
            raise
        # Should the power fail before this is on the medium, one transaction more is taken back: checkpoints allow it.
        os.ftruncate(self._journal_fd, 0)
        if self._size < end:  # what is cut off stands in no journal
            os.fsync(self._journal_fd)
            os.ftruncate(self._fd, self._size)
        self._pending.clear()
        self._committed_size = self._size

    def _keep(self, size: int, old: _Writes) -> None:
        """Write the journal: the size of the file and the bytes that are about to be overwritten."""
        offset, length = self.key
        header = {"key": self.key, "bytes": os.pread(self._fd, length, offset).hex(), "size": size,
                  "blocks": [(offset, len(block)) for offset, block in old]}  # fmt: skip
        write_whole(self._journal_fd, _MAGIC + packed(header, b"".join(block for _, block in old)), 0)
        os.fsync(self._journal_fd)

    def abandon(self) -> None:
        """Drop the collected writes and all later ones: HDF5's own state is now ahead of the disk."""
        self._dead = True
        self._pending.clear()

    def close(self) -> None:
        """Close the file; what was not committed is dropped. Twice does no harm."""
        if self._journal_fd >= 0:
            with suppress(OSError):
                if not os.fstat(self._journal_fd).st_size:
                    os.fsync(self._journal_fd)  # what is complete must not be taken back later
                    self._journal.unlink(missing_ok=True)
            os.close(self._journal_fd)
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = self._journal_fd = -1

    def __del__(self) -> None:
        # A reader's is h5py's alone, which does not close what it is given.
        self.close()

    def __enter__(self) -> AtomicFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:  # fmt: skip
        self.close()


def _latest(writes: _Writes) -> _Writes:
    """Return disjoint writes with the same effect: where two overlap, the later one stands."""
    kept: _Writes = []
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
