"""Output files: locked against a second writer, written whole or not at all, with checksums that show damage.

- `OutputLock`: a lock on each output, so that one process writes it at a time;
- `create_whole`: a file that appears whole or not at all, and stays when the power fails;
- `AtomicFile`: a file that HDF5 writes through, and that changes by whole transactions;
- checksums of frames and of JSON text: what the disk or a copy has changed is noticed when it is read.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
import re
import tempfile
import time
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, StorageError, TrajectoryError
from systems.files.schema import parsed


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
    """Write a file under a name that nobody can guess and rename it to `path` when it is on the medium. `content`:
    bytes, text, or a function that fills the file whose path it is given. An existing `path` is replaced only at the
    end. It has the rights of any new file. Raises StorageError when the disk is full or not writable."""
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
        mask = os.umask(0o077)  # there is no way to ask without setting it
        os.umask(mask)
        temporary.chmod(0o666 & ~mask)
        force_out(temporary)
        os.replace(temporary, path)
        force_out(path.parent)
    except OSError as error:
        raise storage_error(path, error, "nothing was changed") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


class Closing(ABC):
    """What a `with` block closes at its end."""

    @abstractmethod
    def close(self) -> None:
        """Close it; twice does no harm."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# ---- one writer at a time -------------------------------------------------------------------------------------------


_ASK_EVERY_S = 0.5
_MOST_REPLICAS = 10_000


def replica_paths(out: Path, n_replicas: int) -> list[Path]:
    """Return `out` itself for one replica, else NAME_r0.h5, NAME_r1.h5, ... Raises InputError for too many."""
    if n_replicas == 1:
        return [out]
    if n_replicas > _MOST_REPLICAS:
        raise InputError(f"{n_replicas:.4g} replicas are too many, {_MOST_REPLICAS} at most; use a campaign for more.")
    return [out.with_name(f"{out.stem}_r{k}{out.suffix}") for k in range(n_replicas)]


class OutputLock(Closing):
    """A lock on `.NAME.lock` beside an output, which the system gives back when this process ends, however it ends. It
    holds against other threads of this process, too. Raises TrajectoryError when another one has the output, and has
    not let go of it after `patience_s`; KeyboardInterrupt when `stopped()` while waiting; StorageError."""

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


# ---- checksums ------------------------------------------------------------------------------------------------------


Checksums = npt.NDArray[np.uint32]
_Words = npt.NDArray[np.uint64]
_BLOCK_BYTES = 4_194_304
_SEAL = re.compile(r'(?:, )?"_seal": "([0-9a-f]{16})"\}\Z')


def frame_checksums(columns: Mapping[str, npt.NDArray[Any]]) -> Checksums:
    """Return a number `(n,)` for n frames of columns `(n, ...)` of 32- and 64-bit numbers, by name.

    Multilinear hashing: the sum of a frame's 32-bit words, each times a 64-bit number that belongs to its column and
    place, modulo 2^64, of which the upper half counts; a change goes unnoticed once in 2^32 (Lemire and Kaser,
    Comput. J. 57, 1624 (2014)). Numbers that are NaN in `(n,)` columns of floats count as not there, so that a column
    may begin later than the file.
    """
    parts = []
    for name, values in columns.items():
        part = _column_sums(name, np.asarray(values))
        if values.ndim == 1 and values.dtype.kind == "f":
            part = np.where(np.isnan(values), np.uint64(0), part + _factors(f"{name}, there", 1))
        parts.append(part)
    total = np.sum(parts, axis=0, dtype=np.uint64)
    upper: Checksums = (np.atleast_1d(total) >> np.uint64(32)).astype(np.uint32)
    return upper


def checksum_rows(checksums: Mapping[str, Checksums]) -> bytes:
    """Return the checksums `(n,)` of frames by name as bytes, frame by frame; none of a file of an early version."""
    if not checksums:
        return b""
    return np.stack([checksums[name] for name in sorted(checksums)], axis=1).astype("<u4").tobytes()


def sealed(text: str) -> str:
    """Return the JSON text of an object with a last entry `_seal`, the hash of the text without it."""
    joint = ", " if text != "{}" else ""
    return f'{text[:-1]}{joint}"_seal": "{_digest(text)}"}}'


def unsealed(text: str) -> str:
    """Return sealed JSON text without its seal. Raises ValueError when there is none, or it does not fit."""
    found = _SEAL.search(text)
    bare = text[: found.start()] + "}" if found else text
    if found is None or _digest(bare) != found.group(1):
        raise ValueError("its text is not what was written (checksum)")
    return bare


def packed(header: dict[str, Any], blob: bytes) -> bytes:
    """Return a line of JSON and the bytes that follow it, in a form that `unpacked` takes back whole or not at all."""
    text = json.dumps(header)
    digest = hashlib.sha256(text.encode() + blob).hexdigest()
    return f"{digest} {len(blob)} {text}\n".encode() + blob


def unpacked(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return header and bytes of what `packed` made, whatever follows them. Raises ValueError when it is damaged."""
    line, _, rest = data.partition(b"\n")
    digest, size, text = [*line.split(b" ", 2), b"", b"", b""][:3]
    blob = rest[: int(size)] if size.isdigit() else b""
    if hashlib.sha256(text + blob).hexdigest().encode() != digest:
        raise ValueError("its checksum is wrong")
    header = parsed(text)
    if not isinstance(header, dict):
        raise ValueError("its header is no table")
    return header, blob


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _column_sums(name: str, values: npt.NDArray[Any]) -> _Words:
    """Return each frame's weighted sum `(n,)` of 32-bit words, modulo 2^64."""
    n = len(values)
    kind = values.dtype.newbyteorder("<") if values.dtype.itemsize >= 4 else np.dtype("<u4")
    flat = np.ascontiguousarray(values.reshape(n, int(np.prod(values.shape[1:], dtype=int))), dtype=kind)
    words = flat.view("<u4")
    factors = _factors(name, words.shape[1])
    out = np.empty(n, dtype=np.uint64)
    step = max(_BLOCK_BYTES // max(8 * words.shape[1], 1), 1)
    for start in range(0, n, step):
        out[start : start + step] = words[start : start + step].astype(np.uint64) @ factors
    return out


@cache
def _factors(name: str, n: int) -> _Words:
    """Return `n` odd 64-bit numbers that look random: SplitMix64 (Steele, Lea and Flood, OOPSLA 2014)."""
    first = zlib.crc32(name.encode()) << 24
    with np.errstate(over="ignore"):
        z = np.arange(first + 1, first + n + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    odd: _Words = (z ^ (z >> np.uint64(31))) | np.uint64(1)
    return odd


# ---- transactions ---------------------------------------------------------------------------------------------------


_MAGIC = b"surromd journal 1\n"
_Writes = list[tuple[int, bytes]]


def journal_path(path: Path) -> Path:
    """Where the journal of a file lies while it is written."""
    return path.with_name(path.name + ".journal")


class AtomicFile(io.RawIOBase):
    """A seekable binary file whose writes wait in memory until `commit`, which makes all of them or none.

    HDF5 has no transactions: a kill, a full disk or a power failure between two of its writes can leave metadata that
    name data which never arrived, and then the whole file is lost. Given to h5py as its file object, this class
    collects the writes of one append. What they overwrite goes to a journal beside the file first, on the medium, then
    the writes to the file; when these are on the medium, too, the journal is void. One that is not void is from a
    transaction that did not end: who opens the file to write puts the old bytes back, who opens it to read sees them in
    their place.

    `key`: where in the file bytes lie that no other file has, and that no transaction changes; by them a journal knows
    its file. One writer at a time is for the caller to see to. `failure`: why the file could not be read. Raises
    StorageError when it cannot be opened, InputError where another file lies in the journal's place.
    """

    key: tuple[int, int] = (0, 0)
    failure: OSError | None = None
    _fd = _journal_fd = -1

    def __init__(self, path: Path, *, writable: bool) -> None:
        self.path = path
        self._journal = journal_path(path)
        self._pending: _Writes = []
        self._position = 0
        self._dead = not writable
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
            header, old = unpacked(data[len(_MAGIC) :])
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

    def readinto(self, buffer: Any) -> int:
        start = self._position
        length = max(min(len(buffer), self._size - start), 0)
        try:
            data = bytearray(os.pread(self._fd, length, start))
        except OSError as error:
            # HDF5 takes no exceptions from here. What it makes of nothing is never committed.
            self.failure, self._dead, data = error, True, bytearray()
        data.extend(bytes(length - len(data)))
        for offset, block in self._pending:
            low, high = max(offset, start), min(offset + len(block), start + length)
            if low < high:
                data[low - start : high - start] = block[low - offset : high - offset]
        self._position = start + length
        buffer[:length] = data
        return length

    def write(self, data: Any) -> int:
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
        old: _Writes = []
        try:
            inside = [(offset, min(len(block), end - offset)) for offset, block in self._pending if offset < end]
            old = [(offset, os.pread(self._fd, length, offset)) for offset, length in inside]
            self._keep(end, old)
            for offset, block in self._pending:
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
        os.ftruncate(self._journal_fd, 0)
        os.fsync(self._journal_fd)  # what is complete must not be taken back: a checkpoint may count on it
        if self._size < end:  # what is cut off stands in no journal
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
                    self._journal.unlink(missing_ok=True)
            os.close(self._journal_fd)
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = self._journal_fd = -1
        super().close()
