"""Limits of what comes from outside: how much a small file may stand for, before anything is made of it."""

from __future__ import annotations

import gzip
import math
import os
import shutil
import struct
import zipfile
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from systems.errors import InputError, PreparationError, TrajectoryError

if TYPE_CHECKING:
    import h5py
    import numpy.typing as npt
    from scipy.spatial import cKDTree

_TEXT_BYTES = 512_000_000
# HDF5's columns that are read whole: more than this, and more than so many times the file, is not believed.
_COLUMN_BYTES, _PACKED = 64_000_000, 100
# HDF5 2 would keep 8 MiB of each column in memory, which many replicas multiply.
_CACHE_BYTES = 2**20
# What zipfile, NumPy and h5py raise on files that are damaged, or made to harm.
UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, RuntimeError, SystemError,
              MemoryError, OverflowError, struct.error, zlib.error, zipfile.BadZipFile)  # fmt: skip
# Atoms have some dozen neighbours; this many times as many stand in each other.
_PAIRS_PER_ATOM = 500


def content(path: Path) -> bytes:
    """Return what a file holds, unpacked where it is a gzip file. Raises OSError, ValueError, also for too much."""
    if path.stat().st_size > _TEXT_BYTES:
        raise ValueError(f"it holds more than {_TEXT_BYTES // 1_000_000} MB")
    data = path.read_bytes()
    if data[:2] != b"\x1f\x8b":
        return data
    try:
        with gzip.GzipFile(path) as file:
            data = file.read(_TEXT_BYTES + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"a damaged gzip file, {error}") from error
    if len(data) > _TEXT_BYTES:
        raise ValueError(f"it unpacks to more than {_TEXT_BYTES // 1_000_000} MB")
    return data


def open_checked(path: Path, mode: str = "r", source: Any = None) -> h5py.File:
    """Open an HDF5 file, through the file object `source` where there is one. Raises what h5py raises, and
    TrajectoryError for a file that leads to other files, or declares far more than it holds."""
    import h5py

    file = h5py.File(source or path, mode, rdcc_nbytes=_CACHE_BYTES)
    try:
        _check(file, path)
    except BaseException:
        file.close()
        raise
    return file


def arrays_in(source: str | Path | BinaryIO) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an .npz file, in which nothing is run. Raises much that is no error of ours (`UNREADABLE`),
    also for arrays that declare far more than the file holds."""
    import numpy as np

    with zipfile.ZipFile(source) as file:
        packed, declared = (sum(getattr(i, n) for i in file.infolist()) for n in ("compress_size", "file_size"))
        if declared > max(_COLUMN_BYTES, _PACKED * packed):
            raise ValueError(f"it declares {declared / 1e9:.3g} GB in {packed / 1e6:.3g} MB")
    if not isinstance(source, str | Path):
        source.seek(0)
    with np.load(source, allow_pickle=False) as stored:
        return {key: stored[key] for key in stored.files}


def _check(file: h5py.File, path: Path) -> None:
    import h5py

    size = os.stat(path).st_size
    links: list[tuple[bytes, int]] = []
    # As h5py's visititems_links, which looks each name up three times.
    file.id.links.visit(lambda name, of: links.append((name, of.type)), info=True)
    for link, kind in links:
        name = link.decode(errors="replace")
        if kind == h5py.h5l.TYPE_EXTERNAL:
            other = file.get(link, getlink=True).filename
            raise TrajectoryError(f"{path}: /{name} is a link into another file ({other}); copy the data in.")
        found = file.get(link) if kind == h5py.h5l.TYPE_HARD else None
        if not isinstance(found, h5py.Dataset) or not found.size:
            continue
        if found.external or found.is_virtual:
            raise TrajectoryError(f"{path}: the data of /{name} lie in another file; copy them in.")
        declared = found.size * found.dtype.itemsize
        at_once = math.prod(found.chunks) * found.dtype.itemsize if found.chunks and found.ndim > 1 else declared
        if at_once > max(_COLUMN_BYTES, _PACKED * size):
            raise TrajectoryError(
                f"{path} is damaged: /{name} declares {at_once / 1e9:.3g} GB in a file of {size / 1e6:.3g} MB."
            )
        if not found.id.get_storage_size():
            raise TrajectoryError(f"{path} is damaged: /{name} declares {declared} bytes and holds none.")


def check_disk(out: Path, n_frames: int, n_atoms: int) -> None:
    """Raise InputError for a trajectory that is larger than the whole disk."""
    needed = 12.0 * n_frames * n_atoms
    total = shutil.disk_usage(out.parent).total if out.parent.is_dir() else float("inf")
    if needed > total:
        raise InputError(
            f"{out}: {n_frames:.3g} frames of {n_atoms} atoms take {needed / 1e9:.3g} GB, the disk has "
            f"{total / 1e9:.3g} GB; save more rarely, or simulate for a shorter time."
        )


def check_density(tree: cKDTree, radius: float, what: str) -> None:
    """Raise PreparationError where so many of a tree's points are nearer than `radius` that atoms must coincide."""
    n = int(tree.n)
    if n > 1000 and tree.count_neighbors(tree, radius) > _PAIRS_PER_ATOM * n:
        raise PreparationError(f"{what}: most of its {n} atoms stand in each other; check the coordinates.")


def printable(text: str) -> str:
    """Return text for a terminal: control characters, which could steer it, are written as Python's escapes."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
