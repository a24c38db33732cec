"""A real file system in a file, whose power can be cut: what its device holds is copied, the rest is lost."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def _did(*command: str | Path) -> bool:
    return subprocess.run(list(map(str, command)), capture_output=True).returncode == 0


@contextmanager
def mounted(image: Path) -> Iterator[Path | None]:
    """Mount an image, its journal replayed, at a folder beside it; None where that is not allowed here."""
    place = image.with_suffix(".mounted")
    place.mkdir()
    if not _did("mount", "-o", "loop", image, place):
        place.rmdir()
        yield None
        return
    try:
        yield place
    finally:
        _did("umount", place)
        place.rmdir()


def new_image(path: Path, megabytes: int) -> bool:
    """Make an empty ext4 file system; False where there is none to be had."""
    with path.open("wb") as file:
        file.truncate(megabytes * 1_000_000)
    return shutil.which("mkfs.ext4") is not None and _did("mkfs.ext4", "-q", path)


def cut(image: Path, copy: Path) -> None:
    """Copy what the device holds now: whole, as two copies in a row are equal."""
    last = b""
    while (found := image.read_bytes()) != last:
        last = found
    copy.write_bytes(last)
