"""Limits of a reference's frames beyond `validity`, for guards: angles, flat centres, jumps, stillness and drift.

Every limit is measured on the reference: the farthest that its frames go from their mean, and half as far again; the
least that they change from one to the next, and a third of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.frame_columns import column_blocks, cross, signed_volume, squared_distance
from systems.chemistry.validity import ANGLE, DRIFT, JUMP, PLANARITY, STILL
from systems.errors import InputError
from systems.files.schema import Recorded
from systems.scene import Scene


# How much farther than in the reference counts as too far: a sample's extremes lie inside those of a longer one. For
# Gaussian motion and 20,000 frames the limit stands at six standard deviations.
WIDENING = 1.5
# A model that does not simulate moves least of all: random weights of PAINET leave distances as they are to a hundredth
# of what the quietest of 20,000 frames of MD changes.
_STILLER = 3.0
# A centre with three neighbours is flat where the reference keeps it, root mean square, this near to their plane: sp2
# centres stay within 0.01 nm, pyramidal ones stand 0.03 nm or more above it.
_FLAT_NM = 0.02
_MOST_PAIRS = 2_000


@dataclass(frozen=True, eq=False)
class Limits(Recorded):
    """How far frames of the reference go. Made by `limits_from_frames`.

    Angles: `angle_idx (k, 3)` rows (end, middle, end) within `angle_min_rad` and `angle_max_rad (k,)`. Flat centres:
    `flat_idx (k, 4)` rows (centre, a, b, c) no farther than `flat_max_nm (k,)` from the plane of a, b, c. Jumps:
    `jump_idx (k, 2)` pairs of atoms, whose distances change from one frame to the next, `lag_ps` later, by no more than
    `jump_max_nm`, root mean square, and no less than `jump_min_nm` (0 in files of older versions). The middle of those
    atoms moves no farther than `jump_max_nm` either: frames stand in one pose, so what it does beyond is drift; or no
    farther than `drift_max_nm`, if that is more, where frames turn about a centre of mass that is elsewhere.
    """

    angle_idx: Annotated[IntArray, (-1, 3)]
    angle_min_rad: FloatArray
    angle_max_rad: FloatArray
    flat_idx: Annotated[IntArray, (-1, 4)]
    flat_max_nm: FloatArray
    jump_idx: Annotated[IntArray, (-1, 2)]
    jump_max_nm: float
    jump_min_nm: float = 0.0
    drift_max_nm: float = 0.0

    @cached_property
    def angle_cosines(self) -> tuple[FloatArray, FloatArray]:
        """The least and the greatest cosine of each angle, `(k,)` each."""
        least = np.where(self.angle_max_rad < np.pi, np.cos(self.angle_max_rad), -2.0)
        greatest = np.where(self.angle_min_rad > 0.0, np.cos(self.angle_min_rad), 2.0)
        return least, greatest


def limits_from_frames(scene: Scene, positions_nm: npt.ArrayLike, next_nm: npt.ArrayLike) -> Limits:
    """Return the limits that reference frames `(n_frames, n_atoms, 3)` nm set; frame k is followed by `next_nm[k]`.

    Frames that are not finite are not used. Raises InputError when the frames do not fit the scene or each other, or
    none is finite.
    """
    first, second = np.asarray(positions_nm), np.asarray(next_nm)
    if first.ndim != 3 or first.shape[1:] != (scene.n_atoms, 3) or second.shape != first.shape:
        raise InputError(f"Frames {first.shape} and {second.shape} do not fit each other and {scene.n_atoms} atoms.")
    finite = np.isfinite(first).all(axis=(1, 2)) & np.isfinite(second).all(axis=(1, 2))
    if not finite.any():
        raise InputError("None of the reference frames is finite.")
    first, second = first[finite], second[finite]
    near = scene.neighbours()
    angle_idx = _rows([(a, b, c) for b, around in enumerate(near) for a in around for c in around if a < c], 3)
    centres = _rows([(i, *around) for i, around in enumerate(near) if len(around) == 3], 4)
    angles = np.arccos(np.clip(_gather(first, angle_idx, _angle_cosine), -1.0, 1.0))
    heights = np.abs(_gather(first, centres, _height))
    flat = np.sqrt((heights**2).mean(axis=1)) < _FLAT_NM
    mean = angles.mean(axis=1)
    pairs = _jump_pairs(scene)
    jumps = np.concatenate([_jump(a, b, pairs) for _, a, b in _both(first, second, len(pairs))])
    return Limits(
        angle_idx=angle_idx,
        angle_min_rad=mean - WIDENING * (mean - angles.min(axis=1)),
        angle_max_rad=mean + WIDENING * (angles.max(axis=1) - mean),
        flat_idx=centres[flat],
        flat_max_nm=WIDENING * heights[flat].max(axis=1, initial=0.0),
        jump_idx=pairs,
        jump_max_nm=WIDENING * float(jumps.max()) if len(pairs) else float("inf"),
        jump_min_nm=float(jumps.min()) / _STILLER if len(pairs) else 0.0,
    )


def check_limits(positions_nm: npt.ArrayLike, limits: Limits, previous_nm: npt.ArrayLike) -> npt.NDArray[np.uint16]:
    """Return bits of `systems.chemistry.validity` `(n_frames,)` for frames `(n_frames, n_atoms, 3)` nm; 0 is within the
    limits.

    ANGLE and PLANARITY: an angle, or a centre's height above the plane of its neighbours, beyond the limits. JUMP and
    DRIFT: too far from the frame before, `previous_nm (n_frames, n_atoms, 3)`; STILL: too near to it, but not equal; a
    frame without one before is its own. A frame that is not finite is beyond every limit, and so is the step away.
    """
    positions, previous = np.asarray(positions_nm), np.asarray(previous_nm)
    flags = np.zeros(len(positions), dtype=np.uint16)
    least, greatest = (bound[:, None] for bound in limits.angle_cosines)
    atoms = np.unique(limits.jump_idx)
    widest = max(len(limits.angle_idx), len(limits.flat_idx), len(limits.jump_idx))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        for start, before, columns in _both(previous, positions, widest):
            part = flags[start : start + columns.shape[2]]
            cosine = _angle_cosine(columns, limits.angle_idx)
            part |= np.uint16(ANGLE) * ~((cosine >= least) & (cosine <= greatest)).all(axis=0)
            height = np.abs(_height(columns, limits.flat_idx))
            part |= np.uint16(PLANARITY) * ~(height <= limits.flat_max_nm[:, None]).all(axis=0)
            if len(atoms):
                jump = _jump(before, columns, limits.jump_idx)
                part |= np.uint16(JUMP) * ~(jump <= limits.jump_max_nm)
                part |= np.uint16(STILL) * ((jump < limits.jump_min_nm) & (jump > 0.0))
                moved = columns[:, atoms].mean(axis=1) - before[:, atoms].mean(axis=1)
                far = max(limits.jump_max_nm, limits.drift_max_nm)
                part |= np.uint16(DRIFT) * ~(np.sqrt((moved * moved).sum(axis=0)) <= far)
    return flags


def _rows(rows: list[tuple[int, ...]], width: int) -> IntArray:
    return np.array(rows, dtype=np.int64).reshape(-1, width)


def _jump_pairs(scene: Scene) -> IntArray:
    """Pairs of heavy atoms (of all atoms where there are fewer than three heavy ones), evenly thinned to 2,000."""
    atoms = scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)
    rows, columns = np.triu_indices(len(atoms), k=1)
    pairs = np.stack([atoms[rows], atoms[columns]], axis=1)
    return pairs[:: max(-(-len(pairs) // _MOST_PAIRS), 1)]


def _gather(frames: FloatArray, rows: IntArray, measure: Any) -> FloatArray:
    """Return `measure(columns, rows)` of all frames, `(len(rows), n_frames)` float64."""
    parts = [measure(columns, rows) for _, columns in column_blocks(frames, len(rows))]
    return np.concatenate(parts, axis=1).astype(np.float64)


def _both(first: FloatArray, second: FloatArray, widest: int) -> Iterator[tuple[int, FloatArray, FloatArray]]:
    blocks = zip(column_blocks(first, widest), column_blocks(second, widest), strict=True)
    yield from ((start, a, b) for (start, a), (_, b) in blocks)


def _angle_cosine(columns: FloatArray, triples: IntArray) -> FloatArray:
    left = columns[:, triples[:, 0]] - columns[:, triples[:, 1]]
    right = columns[:, triples[:, 2]] - columns[:, triples[:, 1]]
    scale = np.sqrt((left * left).sum(axis=0) * (right * right).sum(axis=0))
    cosine: FloatArray = (left * right).sum(axis=0) / np.maximum(scale, np.finfo(columns.dtype).tiny)
    return cosine


def _height(columns: FloatArray, quads: IntArray) -> FloatArray:
    """Signed distance `(k, n)` nm of a centre from the plane of its three neighbours."""
    a, b, c = (columns[:, quads[:, k]] for k in (1, 2, 3))
    normal = cross(b - a, c - a)
    area = np.sqrt((normal * normal).sum(axis=0))
    height: FloatArray = signed_volume(columns, quads) / np.maximum(area, np.finfo(columns.dtype).tiny)
    return height


def _jump(first: FloatArray, second: FloatArray, pairs: IntArray) -> FloatArray:
    """Root mean square change `(n,)` nm of the distances of pairs from `first` to `second (3, n_atoms, n)`."""
    change = np.sqrt(squared_distance(second, pairs)) - np.sqrt(squared_distance(first, pairs))
    jump: FloatArray = np.sqrt((change * change).mean(axis=0))
    return jump
