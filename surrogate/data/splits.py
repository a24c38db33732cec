"""Splits of frames into training and validation, and the proof that no stretch of motion is in both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError
from systems.files.schema import built

# Successive frames that must agree for a leak: one may coincide by chance in a system of one particle, a run does not.
RUN = 4
_BLOCK = 8192
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Split:
    """By time: the last `share` of each trajectory is held out. By trajectory: those of the numbers `held` are, whole,
    and `share` plays no part."""

    share: float = 0.05
    held: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.share < 1.0:
            raise InputError(f"the held-out share must lie between 0 and 1, not {self.share:g}.")

    def ranges(self, starts: npt.NDArray[Any], *, validation: bool) -> list[tuple[int, int]]:
        """Return first and last-plus-one frames of the training or validation stretches.

        `starts`: first frame of each trajectory and, last, the number of frames.
        """
        found = []
        for k, (begin, end) in enumerate(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)):
            cut = int(end - round((end - begin) * self.share))
            if self.held:
                cut = begin if k in self.held else end
            found.append((cut, end) if validation else (begin, cut))
        return [(low, high) for low, high in found if high > low]

    def to_dict(self) -> dict[str, Any]:
        return {"share": self.share, "held": list(self.held)}

    @staticmethod
    def from_dict(record: dict[str, Any]) -> Split:
        """Rebuild a split. Raises ValueError for what is none."""
        return built(Split, record)


def refuse_leaks(coordinates: npt.NDArray[Any], starts: npt.NDArray[Any], split: Split,
                 name: Callable[[int], str]) -> None:  # fmt: skip
    """Raise InputError when a run of RUN held-out frames is also trained on, as when a trajectory is given twice, or
    once whole and once in part.

    `coordinates` (n_frames, n_atoms, 3) int16, in one pose, so that the same frame has the same numbers; read in
    blocks. `name(k)`: what trajectory k is called.
    """
    known = np.unique(np.concatenate([runs for _, runs in _runs(coordinates, split.ranges(starts, validation=False))]
                                     or [np.zeros(0, np.uint64)]))  # fmt: skip
    for first, runs in _runs(coordinates, split.ranges(starts, validation=True)):
        place = np.searchsorted(known, runs).clip(max=max(len(known) - 1, 0))
        seen = np.flatnonzero(known[place] == runs) if len(known) else np.zeros(0, np.int64)
        moving = [k for k in seen.tolist() if (coordinates[first + k] != coordinates[first + k + RUN - 1]).any()]
        if moving:
            frame = first + moving[0]
            which = int(np.searchsorted(starts, frame, side="right")) - 1
            raise InputError(
                f"{name(which)}: frame {frame - int(starts[which])} and {len(moving) - 1} later stretches are held out "
                "for validation and trained on as well, under the same or another name; give each trajectory once."
            )


def _runs(coordinates: npt.NDArray[Any], ranges: list[tuple[int, int]]) -> Iterator[tuple[int, npt.NDArray[np.uint64]]]:
    """First frame and fingerprints of all runs of RUN frames, in blocks that end with a range."""
    rng = np.random.default_rng(0)
    factors = rng.integers(0, 2**64, size=coordinates[0].size, dtype=np.uint64) | np.uint64(1)
    for low, high in ranges:
        for start in range(low, high - RUN + 1, _BLOCK):
            block = coordinates[start : min(start + _BLOCK + RUN - 1, high)]
            # Products and sums wrap: a fingerprint modulo 2^64.
            marks = block.reshape(len(block), -1).astype(np.int64).view(np.uint64) @ factors
            n = len(marks) - RUN + 1
            runs = np.zeros(n, dtype=np.uint64)
            for k in range(RUN):
                runs = runs * np.uint64(0x9E3779B97F4A7C15) + marks[k : k + n]
            yield start, runs
