"""What the viewer plays: some frames of reference and candidate, superposed and packed into a few hundred kB."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.statistics import FloatArray, IntArray
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble
from systems.chemistry import validity
from systems.chemistry.geometry import superpose

Frames = npt.NDArray[np.float32]
Packed = npt.NDArray[np.int16]

MAX_FRAMES = 240
MAX_NUMBERS = 120_000
HYDROGENS_UP_TO = 300
NOT_FINITE = -32768
_LARGEST = 32767
# Room beyond the first frame's extent before a coordinate is cut off: what flies further has left the picture anyway.
_ROOM = 4.0


class Clip(NamedTuple):
    """Frames of both trajectories at the same times: `time_ps (n,)`, coordinates `(n, n_shown, 3)` int16 in units of
    `Movie.scale_nm`, NOT_FINITE for a frame that cannot be drawn; validity flags `(n,)`; the candidate's chunk `(n,)`,
    None where its file marks none."""

    name: str
    time_ps: FloatArray
    reference: Packed
    candidate: Packed
    reference_flags: npt.NDArray[np.uint16]
    candidate_flags: npt.NDArray[np.uint16]
    chunk_idx: npt.NDArray[np.int32] | None

    def to_dict(self) -> dict[str, Any]:
        """Return what the viewer reads; coordinates as base64 of little-endian int16."""
        packed = [x.astype("<i2").tobytes() for x in (self.reference, self.candidate)]
        return {
            "name": self.name,
            "time": [float(f"{t:.8g}") for t in self.time_ps],
            "reference": base64.b64encode(packed[0]).decode("ascii"),
            "candidate": base64.b64encode(packed[1]).decode("ascii"),
            "referenceFlags": self.reference_flags.tolist(),
            "candidateFlags": self.candidate_flags.tolist(),
            "chunk": None if self.chunk_idx is None else self.chunk_idx.tolist(),
        }


class Movie(NamedTuple):
    """Clips of one candidate beside the reference: the elements shown, the bonds among them `(n_bonds, 2)`, nm per unit
    of the clips' coordinates."""

    elements: tuple[str, ...]
    bonds: IntArray
    scale_nm: float
    clips: tuple[Clip, ...]
    hydrogens_left_out: bool

    def to_dict(self) -> dict[str, Any]:
        """Return what the viewer reads."""
        bits = [1 << k for k in range(16)]
        return {
            "elements": list(self.elements),
            "bonds": self.bonds.ravel().tolist(),
            "scale": self.scale_nm,
            "faults": {str(bit): name for bit in bits for name in validity.flag_names(bit)},
            "clips": [clip.to_dict() for clip in self.clips],
        }


def make_movie(
    reference: Ensemble, candidate: Ensemble, reference_features: Features, candidate_features: Features, n_frames: int
) -> Movie:
    """Return the movie of the first `n_frames` of both: a clip over the whole length, and one of consecutive frames.
    Every frame is laid over the reference's first finite one by its heavy atoms (all where fewer than three are heavy),
    which is turned so that its longest axis lies across the picture. Hydrogens are left out above 300 atoms."""
    scene = reference.scene
    every, heavy = np.arange(scene.n_atoms), scene.heavy_idx
    shown = every if scene.n_atoms <= HYDROGENS_UP_TO else heavy
    fitted = heavy if len(heavy) >= 3 else every
    template = _flat_on(_first_finite(reference, candidate), fitted)
    scale = _ROOM * max(float(np.abs(template).max()), 0.1) / _LARGEST
    n_clip = int(min(MAX_FRAMES, max(2, MAX_NUMBERS // (3 * len(shown))), n_frames))
    spread = np.unique(np.linspace(0, n_frames - 1, n_clip).astype(np.int64))
    wanted = [("whole length", spread)]
    if n_frames > n_clip:
        wanted.append(("frame by frame", np.arange(n_clip, dtype=np.int64)))
    clips = []
    for name, idx in wanted:
        both = [_pack(pick_frames(e.segments, idx), template, fitted, shown, scale) for e in (reference, candidate)]
        chunks = candidate_features.chunk_idx
        flags = [np.concatenate(list(f.flags))[idx] for f in (reference_features, candidate_features)]
        chunk = None if chunks is None else np.concatenate(list(chunks))[idx]
        time_ps = np.asarray((idx + 1) * reference.lag_ps, dtype=np.float64)
        clips.append(Clip(name, time_ps, both[0], both[1], flags[0], flags[1], chunk))
    place = np.full(scene.n_atoms, -1)
    place[shown] = np.arange(len(shown))
    kept = place[np.asarray(scene.bonds, dtype=np.int64).reshape(-1, 2)]
    bonds, elements = kept[(kept >= 0).all(axis=1)], tuple(scene.elements[a] for a in shown)
    return Movie(elements, bonds, scale, tuple(clips), len(shown) < scene.n_atoms)


def pick_frames(segments: Sequence[Any], idx: IntArray) -> Frames:
    """Return frames `idx` (counted through the segments in order) as `(len(idx), n_atoms, 3)` nm; consecutive
    frames are read at once, so that segments may lie in a file."""
    starts = np.concatenate([[0], np.cumsum([len(s) for s in segments])])
    of_segment = np.searchsorted(starts, idx, side="right") - 1
    breaks = np.flatnonzero((np.diff(idx) != 1) | (np.diff(of_segment) != 0)) + 1
    runs = zip(np.split(idx, breaks), np.split(of_segment, breaks), strict=True)
    parts = [segments[s[0]][run[0] - starts[s[0]] : run[-1] + 1 - starts[s[0]]] for run, s in runs]
    return np.asarray(np.concatenate(parts), dtype=np.float32)


def _first_finite(*ensembles: Ensemble) -> Frames:
    for ensemble in ensembles:
        first = pick_frames(ensemble.segments, np.arange(min(100, ensemble.n_frames)))
        finite = np.isfinite(first).all(axis=(1, 2))
        if finite.any():
            return np.asarray(first[int(finite.argmax())], dtype=np.float32)
    return np.asarray(ensembles[0].scene.positions_nm, dtype=np.float32)


def _flat_on(frame: Frames, fitted: IntArray) -> Frames:
    """Return one frame centred on its fitted atoms, with their longest axis along x and the next along y."""
    centred = np.asarray(frame, dtype=np.float64) - frame[fitted].mean(axis=0, dtype=np.float64)
    _, _, axes = np.linalg.svd(centred[fitted], full_matrices=True)
    if np.linalg.det(axes) < 0:
        axes[2] = -axes[2]
    return np.asarray(centred @ axes.T, dtype=np.float32)


def _pack(frames: Frames, template: Frames, fitted: IntArray, shown: IntArray, scale_nm: float) -> Packed:
    # A frame that has exploded may overflow when squared: it cannot be laid over anything either.
    usable = np.isfinite(frames).all(axis=(1, 2)) & (np.abs(np.nan_to_num(frames)).max(axis=(1, 2)) < 1e6)
    packed = np.full((len(frames), len(shown), 3), NOT_FINITE, dtype=np.int16)
    if usable.any():
        laid = superpose(frames[usable], template, idx=fitted)[:, shown]
        packed[usable] = np.clip(np.rint(laid / scale_nm), -_LARGEST, _LARGEST).astype(np.int16)
    return packed
