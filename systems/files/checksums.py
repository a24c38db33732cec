"""Checksums of frames and of JSON text: what the disk or a copy has changed is noticed when it is read."""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import TrajectoryError
from systems.files.schema import parsed

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


def frames_digest(checksums: Mapping[str, Checksums]) -> Any:
    """Return the SHA-256 object of frames' checksums `(n,)` by name; frames that come later are added to it."""
    return hashlib.sha256(checksum_rows(checksums))


def checksum_rows(checksums: Mapping[str, Checksums]) -> bytes:
    """Return the checksums of frames as bytes, frame by frame; none of a file of an early version, which has none."""
    if not checksums:
        return b""
    return np.stack([checksums[name] for name in sorted(checksums)], axis=1).astype("<u4").tobytes()


def check_frames_read(path: Any, stored: Checksums, found: Checksums, start: int, stride: int) -> None:
    """Raise TrajectoryError when frames `start`, `start + stride`, ... are not those that were written."""
    if not np.array_equal(stored, found):
        bad = start + stride * int(np.argmax(stored != found))
        raise TrajectoryError(
            f"{path} is damaged at frame {bad}: it is not what was written (checksum); restore it from a whole copy."
        )


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


def unpacked(data: bytes) -> tuple[dict[str, Any], bytes, bytes]:
    """Return header and bytes of what `packed` made, and what follows them. Raises ValueError when it is damaged."""
    line, _, rest = data.partition(b"\n")
    digest, size, text = [*line.split(b" ", 2), b"", b"", b""][:3]
    blob = rest[: int(size)] if size.isdigit() else b""
    if hashlib.sha256(text + blob).hexdigest().encode() != digest:
        raise ValueError("its checksum is wrong")
    header = parsed(text)
    if not isinstance(header, dict):
        raise ValueError("its header is no table")
    return header, blob, rest[len(blob) :]


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
