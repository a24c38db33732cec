"""The account of what a rollout did about its own failures: what stands in the file, and what it cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.validity import flag_names

# The column `intervention` of a trajectory: what a frame is, if it is not the surrogate's first draw.
DRAWN_AGAIN, REPAIRED, MD_AFTER_FAILURE, MD_BETWEEN = 1, 2, 3, 4
MARKS = {
    DRAWN_AGAIN: "drawn again",
    REPAIRED: "repaired",
    MD_AFTER_FAILURE: "MD after a failure",
    MD_BETWEEN: "MD between chunks",
}
# What frames of each kind may do to the statistics of a trajectory.
BIAS = {
    DRAWN_AGAIN: "states from which the surrogate fails are visited less, and left in other ways than it would leave "
    "them",
    REPAIRED: "repaired frames have relaxed bonds and angles, colder than the ensemble's, and later frames follow from "
    "them",
    MD_AFTER_FAILURE: "MD stands where the surrogate failed: ensemble and kinetics are a mixture, and each stretch of "
    "MD starts from a relaxed frame with new velocities and warms up within about 1 ps",
    MD_BETWEEN: "MD stands between chunks: ensemble and kinetics are a mixture of the two",
}
_LOGGED = 200


@dataclass
class Tally:
    """One replica's account. All numbers are of model frames, whether they are kept in the file or not.

    `chunks` drawn, of which `chunks_caught` held a frame that a guard caught; `frames_caught` and `reasons` count the
    frames of first draws, `frames` those that an intervention left, `draws` the further draws. `md_in_a_row`: chunks
    that MD had to finish since the surrogate last got through one. `invalid_in_a_row`: frames of the chunks since the
    last one that held a valid frame. `log` holds the first 200 interventions.
    """

    chunks: int = 0
    chunks_caught: int = 0
    frames_caught: int = 0
    reasons: dict[str, int] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    draws: int = 0
    md_in_a_row: int = 0
    invalid_in_a_row: int = 0
    log: list[dict[str, Any]] = field(default_factory=list)

    def note_caught(self, flags: npt.NDArray[np.uint16], first_step: int) -> None:
        """Enter the caught frames of a first draw, `flags (k,)` each with its bits; `first_step` is the earliest's."""
        self.chunks_caught += 1
        self.frames_caught += len(flags)
        names = Counter(name for bits in flags.tolist() for name in flag_names(bits))
        for name, count in names.items():
            self.reasons[name] = self.reasons.get(name, 0) + count
        if len(self.log) < _LOGGED:
            self.log.append({"chunk": self.chunks, "step": first_step, "reasons": sorted(names)})

    def note_marks(self, marks: npt.NDArray[np.uint8]) -> None:
        """Enter what the frames of a finished chunk are, `marks (n,)`."""
        for mark, name in MARKS.items():
            count = int((marks == mark).sum())
            if count:
                self.frames[name] = self.frames.get(name, 0) + count

    def to_record(self) -> dict[str, Any]:
        """Return what a trajectory's record keeps of it."""
        kept = {k: v for k, v in asdict(self).items() if not k.endswith("_in_a_row")}
        bias = [why for mark, why in BIAS.items() if self.frames.get(MARKS[mark])]
        return {**kept, "share_of_chunks": self.chunks_caught / max(self.chunks, 1), "bias": bias}


@dataclass
class Clock:
    """Wall seconds of a whole batch by what they went into: `draw`, `check`, `draw again`, `relax`, `md`, `energy`,
    `energy limit`."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, what: str) -> Iterator[None]:
        """Add the time that the block takes."""
        started = perf_counter()
        try:
            yield
        finally:
            self.seconds[what] = self.seconds.get(what, 0.0) + perf_counter() - started
