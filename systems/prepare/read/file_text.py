"""Text of a file, gzipped or not, and its suffix."""

from __future__ import annotations

from pathlib import Path

from systems.errors import InputError
from systems.files.outside import content


def suffix_of(path: Path) -> str:
    """Return the suffix in lower case, that of the packed file where it ends in .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def read_text(path: Path, wanted: str) -> str:
    """Return the text of a file. Raises InputError, which asks for what is `wanted`, where it holds none."""
    if path.is_dir():
        raise InputError(f"{path} is a directory; give the file of {wanted}.")
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path, or name a library system (`surromd systems`).")
    try:
        data = content(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); check the file and its permissions.") from error
    if not data.strip():
        raise InputError(f"{path} is empty; give {wanted}.")
    if b"\0" in data:
        raise InputError(f"{path} is a binary file, no text; give {wanted}.")
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n")
