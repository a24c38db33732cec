"""A disk as a program sees it, operation by operation: what lies on it after a kill or a power failure at any of them.

Operations of `os` on files below one folder are recorded as they are made. A kill keeps all that were made. A power
failure keeps what was forced out (`fsync` of the file for its bytes, of the folder for its names) and, of the rest, any
sectors and any first part of the changes of names.
"""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

SECTOR = 512
# What a power failure leaves: bytes not forced out, changes of names not forced out.
LOSSES: dict[str, tuple[float, float]] = {"neither": (0.0, 0.0), "names alone": (0.0, 1.0), "bytes alone": (1.0, 0.0),
                                          "some of both": (0.5, 0.5)}  # fmt: skip


@dataclass
class _File:
    """A file's bytes on the medium, and what has been done to them since they were forced out."""

    durable: bytearray = field(default_factory=bytearray)
    since: list[tuple[int, bytes]] = field(default_factory=list)  # (offset, bytes); (size, b"") sets the size

    def content(self, share: float, rng: random.Random) -> bytes:
        """Return the bytes with that share of the sectors written since; sizes are kept by the same chance."""
        out = bytearray(self.durable)
        for offset, data in self.since:
            if not data:
                if rng.random() < share:
                    out[offset:] = bytes(max(offset - len(out), 0))
                continue
            at = 0
            while at < len(data):
                n = min(SECTOR - (offset + at) % SECTOR, len(data) - at)
                if rng.random() < share:
                    out.extend(bytes(max(offset + at - len(out), 0)))
                    out[offset + at : offset + at + n] = data[at : at + n]
                at += n
        return bytes(out)


class Disk:
    """The operations made so far, and the states that they may leave."""

    def __init__(self) -> None:
        self.operations: list[tuple[Any, ...]] = []

    def after(self, n: int, bytes_kept: float = 1.0, names_kept: float = 1.0, seed: int = 0) -> dict[str, bytes]:
        """Return the files by name after the first `n` operations, then a power failure unless both shares are 1."""
        rng = random.Random(seed)
        files: dict[int, _File] = {}
        names: dict[str, int] = {}
        pending: list[tuple[Any, ...]] = []
        for what, *rest in self.operations[:n]:
            if what == "create":
                files[rest[1]] = _File()
                pending.append((what, *rest))
            elif what in ("write", "size"):
                files[rest[0]].since.append((rest[1], rest[2] if what == "write" else b""))
            elif what == "fsync" and rest[0] in files:
                files[rest[0]].durable = bytearray(files[rest[0]].content(1.0, rng))
                files[rest[0]].since.clear()
            elif what == "fsync":
                _rename(names, pending)
                pending.clear()
            else:
                pending.append((what, *rest))
        kept = len(pending) if names_kept == 1.0 else int(names_kept * len(pending) + rng.random() * (names_kept > 0))
        _rename(names, pending[:kept])
        return {name: files[number].content(bytes_kept, rng) for name, number in names.items()}

    def put(self, folder: Path, state: dict[str, bytes]) -> None:
        """Lay the files of a state into an empty folder."""
        folder.mkdir(parents=True)
        for name, data in state.items():
            (folder / name).write_bytes(data)


def _rename(names: dict[str, int], changes: list[tuple[Any, ...]]) -> None:
    for what, *rest in changes:
        if what == "create":
            names[rest[0]] = rest[1]
        elif what == "replace" and rest[0] in names:
            names[rest[1]] = names.pop(rest[0])
        elif what == "unlink":
            names.pop(rest[0], None)


@contextmanager
def watched(
    folder: Path, monkeypatch: pytest.MonkeyPatch, fault: Callable[[int, str], int] = lambda number, what: 0
) -> Iterator[Disk]:
    """Record what is done to files in the folder; `fault(number, what)` returns the errno by which one fails."""
    disk = Disk()
    usual = {name: getattr(os, name) for name in ("open", "close", "pwrite", "write", "ftruncate", "fsync", "replace",
                                                  "unlink", "chmod", "pread", "stat")}  # fmt: skip
    of_descriptor: dict[int, int] = {}
    of_name: dict[str, int] = {}
    calls = numbers = 0

    def here(path: Any) -> str | None:
        if not isinstance(path, str | os.PathLike):
            return None
        path = Path(path)
        return path.name if path.parent == folder else ("" if path == folder else None)

    def check(what: str) -> None:
        nonlocal calls
        calls += 1
        code = fault(calls, what)
        if code:
            raise OSError(code, os.strerror(code))

    def open_(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        nonlocal numbers
        name = here(path)
        if name is None:
            return usual["open"](path, flags, *rest, **more)
        check("open to write" if flags & (os.O_WRONLY | os.O_RDWR) else "open")
        fresh = bool(name) and not os.path.lexists(path)
        descriptor = usual["open"](path, flags, *rest, **more)
        if fresh:
            numbers += 1
            of_name[name] = numbers
            disk.operations.append(("create", name, numbers))
        of_descriptor[descriptor] = of_name[name] if name else 0
        return descriptor

    def close(descriptor: int) -> None:
        of_descriptor.pop(descriptor, None)
        usual["close"](descriptor)

    def pwrite(descriptor: int, data: Any, offset: int) -> int:
        if descriptor in of_descriptor:
            grows = offset + len(data) > os.fstat(descriptor).st_size
            check("write beyond the end" if grows else "write")
            disk.operations.append(("write", of_descriptor[descriptor], offset, bytes(data)))
        return usual["pwrite"](descriptor, data, offset)

    def ftruncate(descriptor: int, size: int) -> None:
        if descriptor in of_descriptor:
            check("set the size")
            disk.operations.append(("size", of_descriptor[descriptor], size))
        usual["ftruncate"](descriptor, size)

    def fsync(descriptor: int) -> None:
        if descriptor in of_descriptor:
            check("force out")
            disk.operations.append(("fsync", of_descriptor[descriptor]))
        # Nothing is gained here by waiting for a real disk.

    def replace(source: Any, target: Any) -> None:
        if here(target) is not None:
            check("rename")
            disk.operations.append(("replace", here(source), here(target)))
            of_name[str(here(target))] = of_name.pop(str(here(source)))
        usual["replace"](source, target)

    def unlink(path: Any, **more: Any) -> None:
        name = here(path)
        if name is not None and os.path.lexists(path):
            check("remove")
            disk.operations.append(("unlink", name))
            of_name.pop(name, None)
        usual["unlink"](path, **more)

    def chmod(path: Any, *rest: Any, **more: Any) -> None:
        if here(path) is not None:
            check("set the rights")
        usual["chmod"](path, *rest, **more)

    def pread(descriptor: int, length: int, offset: int) -> bytes:
        if descriptor in of_descriptor:
            check("read")
        return usual["pread"](descriptor, length, offset)

    with monkeypatch.context() as patch:
        for function in (open_, close, pwrite, ftruncate, fsync, replace, unlink, chmod, pread):
            patch.setattr(os, function.__name__.rstrip("_"), function)
        yield disk


NO_SPACE = (errno.ENOSPC, ("open to write", "write beyond the end"))
