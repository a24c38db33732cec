"""Training frames of some atoms only: a view, nothing is copied."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.data.frames import TrainingFrames
from systems.selection import part_of


@dataclass(frozen=True, eq=False)
class PartOfFrames(TrainingFrames):
    """Frames whose `scene` holds the atoms `atoms_idx` alone; `coordinates` still hold all of them."""

    atoms_idx: npt.NDArray[np.int64] = field(default_factory=lambda: np.arange(0))

    def positions_nm(self, idx: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return frames `(*idx.shape, len(atoms_idx), 3)` nm."""
        return super().positions_nm(idx)[..., self.atoms_idx, :]


def part_of_frames(frames: TrainingFrames, atoms_idx: npt.ArrayLike) -> PartOfFrames:
    """Return frames of the atoms `atoms_idx`, ascending, in the pose that they have."""
    atoms = np.asarray(atoms_idx, dtype=np.int64)
    given: dict[str, Any] = {f.name: getattr(frames, f.name) for f in fields(TrainingFrames)}
    return PartOfFrames(**{**given, "scene": part_of(frames.scene, atoms), "velocities": None}, atoms_idx=atoms)
