"""The atoms of later frames, in files that name them in every frame: are they in the first frame's order?"""

from __future__ import annotations

import bz2
import gzip
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from systems.errors import TrajectoryError

IntArray = npt.NDArray[np.int64]


def open_text(path: Path) -> IO[str]:
    """Open a text file, a compressed one (.gz, .bz2) too."""
    suffix = path.suffix.lower()
    if suffix == ".gz":
        return gzip.open(path, "rt", encoding="utf-8", errors="replace")
    if suffix == ".bz2":
        return bz2.open(path, "rt", encoding="utf-8", errors="replace")
    return path.open(encoding="utf-8", errors="replace")


def order_of(names: Sequence[str], first: Sequence[str], path: Path, frame: int) -> IntArray | None:
    """Return where each atom of the first frame stands in a later one `(n_atoms,)`, None where nothing moved.

    Raises TrajectoryError where the frames hold different atoms, or moved ones that share a name.
    """
    if names == first:
        return None
    if len(names) != len(first):
        raise TrajectoryError(
            f"{path}: frame {frame} has {len(names)} atoms, not as many as the first ({len(first)}); split the file."
        )
    k = next(k for k, (one, two) in enumerate(zip(names, first, strict=True)) if one != two)
    here = f"{path}: frame {frame} names other atoms than the first (atom {k + 1} is {names[k]!r}, not {first[k]!r})"
    if Counter(names) != Counter(first):
        raise TrajectoryError(f"{here}; split the file.")
    moved = [name for name, other in zip(first, names, strict=True) if name != other]
    if any(first.count(name) > 1 for name in set(moved)):
        raise TrajectoryError(f"{here}, and names that occur twice do not tell the order; write it again in one order.")
    place: dict[str, list[int]] = {}
    for j, name in enumerate(names):
        place.setdefault(name, []).append(j)
    return np.array([place[name].pop(0) for name in first], dtype=np.int64)


def orders(frames: Iterable[Sequence[str]], path: Path) -> tuple[dict[int, IntArray], int]:
    """Return the order by frame of those that differ from the first, and the number of atoms in a frame.

    `frames`: the atoms' names of each frame. Raises TrajectoryError as `order_of`.
    """
    first: Sequence[str] | None = None
    moved: dict[int, IntArray] = {}
    for frame, names in enumerate(frames):
        first = names if first is None else first
        order = order_of(names, first, path, frame)
        if order is not None:
            moved[frame] = order
    return moved, 0 if first is None else len(first)


def pdb_names(path: Path) -> Iterator[list[str]]:
    """Yield atom name, alternate, residue and element of all atoms of each model of a PDB file."""
    names: list[str] = []
    with open_text(path) as file:
        for line in file:
            if line.startswith(("ATOM", "HETATM")):
                names.append(" ".join(f"{line[12:27]} {line[76:78]}".split()))
            elif line.startswith("END") and names:
                yield names
                names = []
    if names:
        yield names


def arc_names(path: Path) -> Iterator[list[str]]:
    """Yield name and type of all atoms of each frame of a Tinker archive."""
    with open_text(path) as file:
        for title in file:
            words = title.split()
            if not words or not words[0].isdigit():
                return
            names: list[str] = []
            while len(names) < int(words[0]) and (row := file.readline().split()):
                if len(row) > 5 and not row[1].replace(".", "").isdigit():  # else the cell
                    names.append(f"{row[1]} {row[5]}")
            yield names


def gro_frames(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the title, and residue and name of all atoms, of each frame of a GRO file."""
    with open_text(path) as file:
        for title in file:
            count = file.readline().strip()
            if not count.isdigit():
                return
            names = [" ".join(f"{line[:10]} {line[10:15]}".split()) for line in itertools.islice(file, int(count))]
            file.readline()
            yield title, names


def moved_note(moved: dict[int, IntArray]) -> tuple[str, ...]:
    """Return the line on reordered frames, none where none is."""
    if not moved:
        return ()
    first = min(moved)
    return (f"{len(moved)} frames, from {first} on, list their atoms in another order; matched by their names.",)
