"""Guard of a rollout: checks every frame as it is made, before it is written or conditions the next chunk."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.validity import (
    ANGLE,
    DRIFT,
    ENERGY,
    INVALID,
    JUMP,
    NOT_FINITE,
    PLANARITY,
    STILL,
    UNSURE,
    Geometry,
    Limits,
    check_frames,
    check_limits,
)

if TYPE_CHECKING:
    from surrogate.data.weights import TrainingDomain

FloatArray = npt.NDArray[np.floating[Any]]
Flags = npt.NDArray[np.uint16]

# Any of these bits, and a frame does not pass.
CAUGHT = INVALID | ANGLE | PLANARITY | JUMP | DRIFT | ENERGY | STILL | UNSURE


class Guard:
    """The checks of one training domain, with thresholds that its reference set (`systems.chemistry.validity`,
    `.limits`)."""

    def __init__(self, domain: TrainingDomain) -> None:
        self._geometry = Geometry.from_dict(domain.geometry)
        self._limits = None if domain.limits is None else Limits.from_dict(domain.limits)

    @property
    def unchecked(self) -> tuple[str, ...]:
        """What is not checked, because the reference changes it or the weights are older than the check."""
        missing: tuple[str, ...] = ()
        if self._limits is None:
            missing = ("angles, flat centres, jumps, stillness and drift: the weights carry no limits",)
        elif self._limits.jump_min_nm == 0.0:
            missing = ("stillness: the weights carry no limit of it",)
        return (*self._geometry.excluded, *missing)

    def check(self, frames_nm: FloatArray, before_nm: FloatArray, *, from_start: bool = False) -> Flags:
        """Return the flags `(b, n)` of frames `(b, n, n_atoms, 3)` nm that follow `before_nm (b, n_atoms, 3)`.

        `from_start`: the frames before are the user's structure, which need not be one of the ensemble, so that the
        first step away from it does not count as a jump.
        """
        n_rows, n_frames = frames_nm.shape[:2]
        flat = frames_nm.reshape(-1, *frames_nm.shape[2:])
        flags = check_frames(flat, self._geometry)
        if self._limits is not None:
            previous = np.concatenate([before_nm[:, None], frames_nm[:, :-1]], axis=1).reshape(flat.shape)
            found = check_limits(flat, self._limits, previous).reshape(n_rows, n_frames)
            if from_start:
                found[:, 0] &= ~np.uint16(JUMP | DRIFT)
            flags |= found.reshape(-1)
        return flags.reshape(n_rows, n_frames)


def caught(flags: Flags) -> npt.NDArray[np.bool_]:
    """Return which frames do not pass."""
    found: npt.NDArray[np.bool_] = (flags & np.uint16(CAUGHT)) != 0
    return found


def finite(flags: Flags) -> npt.NDArray[np.bool_]:
    """Return which frames are finite."""
    found: npt.NDArray[np.bool_] = (flags & np.uint16(NOT_FINITE)) == 0
    return found
