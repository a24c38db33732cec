"""An ensemble: all frames of one candidate, as segments of unbroken time, in the atom order of one scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, OutOfDomainError, TrajectoryError
from systems.scene import Scene
from systems.units import format_time_ps

Frames = npt.NDArray[np.float32]
Flags = npt.NDArray[np.uint16]
IntArray = npt.NDArray[np.int64]

_READ_FRAMES = 8192
_SETTINGS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "model", "weights_hash")


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Frames of one candidate: one or several segments (replicas, or stretches of unbroken time).

    `segments`: each `(n, n_atoms, 3)` float32 nm, atoms in the order of `scene`; `lag_ps`: time between frames;
    `flags` `(n,)` uint16 and `chunk_idx` `(n,)` int32 per segment, or None where the file does not say; `record`: what
    the writer said of itself (costs summed over files); `sources`: the files; `top`, `stated_lag_ps`: what the user
    said of them; `notes`: what was done on reading.
    Raises InputError for shapes that do not fit, no frame at all, or a lag that is not positive.
    """

    label: str
    segments: Sequence[Frames]
    lag_ps: float
    scene: Scene
    flags: Sequence[Flags] | None = None
    chunk_idx: Sequence[npt.NDArray[np.int32]] | None = None
    record: dict[str, Any] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    top: str | None = None
    stated_lag_ps: float | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lag_ps) and self.lag_ps > 0):
            raise InputError(f"{self.label}: the time between frames is {self.lag_ps} ps; state it with --lag 1ps.")
        for i, segment in enumerate(self.segments):
            if segment.ndim != 3 or segment.shape[1:] != (self.scene.n_atoms, 3):
                raise InputError(
                    f"{self.label}: segment {i} has shape {segment.shape}, expected (n, {self.scene.n_atoms}, 3)."
                )
        if self.n_frames == 0:
            raise InputError(f"{self.label}: no frames.")
        for name, series in (("flags", self.flags), ("chunk_idx", self.chunk_idx)):
            if series is not None and [len(s) for s in series] != self.segment_lengths:
                raise InputError(f"{self.label}: {name} do not match the segments in length.")

    @property
    def segment_lengths(self) -> list[int]:
        """Frames in each segment."""
        return [len(s) for s in self.segments]

    @property
    def n_frames(self) -> int:
        return sum(self.segment_lengths)

    @property
    def total_ps(self) -> float:
        """Simulated time of all segments together (frames times lag)."""
        return self.n_frames * self.lag_ps

    def strided(self, stride: int) -> Ensemble:
        """Return every `stride`-th frame of each segment, with the lag that follows."""
        if stride == 1:
            return self
        return replace(
            self,
            segments=[s[::stride] for s in self.segments],
            flags=None if self.flags is None else [f[::stride] for f in self.flags],
            chunk_idx=None if self.chunk_idx is None else [c[::stride] for c in self.chunk_idx],
            lag_ps=self.lag_ps * stride,
            notes=(*self.notes, f"{self.label}: every {stride}th frame used, for equal save intervals."),
        )


def load_ensemble(
    paths: Sequence[str | Path],
    *,
    label: str | None = None,
    template: Scene | None = None,
    top: str | Path | None = None,
    lag_ps: float | None = None,
) -> Ensemble:
    """Read one or several trajectory files as the replicas of one candidate.

    Atoms are put in the order of `template` (matched by the bond graph where order or names differ); without one the
    first file's scene is the template. A file whose time jumps is cut there into segments. `lag_ps` overrides the
    times in the files. `top` is the topology for formats that hold none.
    Raises InputError (no files, nothing known of the topology, replicas with different lags or uneven time without
    `lag_ps`), OutOfDomainError (another molecule) and TrajectoryError (a damaged file).
    """
    from systems.trajectory import open_trajectory

    if not paths:
        raise InputError("No trajectory file was given.")
    name = label or Path(paths[0]).name + (f" + {len(paths) - 1} more" if len(paths) > 1 else "")
    segments: list[Frames] = []
    flags: list[Flags] = []
    chunks: list[npt.NDArray[np.int32]] = []
    records: list[dict[str, Any]] = []
    lags: list[float] = []
    notes: list[str] = []
    for path in paths:
        with open_trajectory(Path(path), top=None if top is None else Path(top)) as reader:
            if reader.n_frames == 0:
                raise InputError(f"{path}: no frames.")
            order, template, note = _atom_order(str(path), reader.scene, reader.n_atoms, template)
            notes += note
            lag, cuts, note = _time_axis(str(path), reader.time_ps, lag_ps)
            notes += note
            lags.append(lag)
            frames = np.empty((reader.n_frames, template.n_atoms, 3), dtype=np.float32)
            for start in range(0, reader.n_frames, _READ_FRAMES):
                stop = min(start + _READ_FRAMES, reader.n_frames)
                block = reader.read(start, stop)
                frames[start:stop] = block if order is None else block[:, order]
            segments += np.split(frames, cuts)
            if reader.flags is not None:
                flags += np.split(np.asarray(reader.flags, dtype=np.uint16), cuts)
            if reader.chunk_idx is not None:
                chunks += np.split(np.asarray(reader.chunk_idx, dtype=np.int32), cuts)
            records.append(dict(reader.record))
            if records[-1].get("completed") is False:
                notes.append(f"{path}: its writer was stopped before the end ({reader.n_frames} frames).")
    assert template is not None
    lag = _common([x for x in lags if math.isfinite(x)], paths, lag_ps)
    return Ensemble(
        label=name,
        segments=segments,
        lag_ps=lag,
        scene=template,
        flags=flags if len(flags) == len(segments) else None,
        chunk_idx=chunks if len(chunks) == len(segments) else None,
        record=_merged_record(records, name, notes),
        sources=tuple(str(p) for p in paths),
        top=None if top is None else str(top),
        stated_lag_ps=lag_ps,
        notes=tuple(notes),
    )


def equal_lags(ensembles: Sequence[Ensemble]) -> list[Ensemble]:
    """Return the ensembles at their least common save interval, thinned by whole strides.

    Raises InputError when no common interval leaves 10 frames of each.
    """
    lags = [Fraction(float(f"{e.lag_ps:.6g}")).limit_denominator(1_000_000) for e in ensembles]
    common = lags[0]
    for lag in lags[1:]:
        common = Fraction(math.lcm(common.numerator, lag.numerator), math.gcd(common.denominator, lag.denominator))
    out = []
    for ensemble, lag in zip(ensembles, lags, strict=True):
        stride = int(common / lag)
        if ensemble.n_frames // stride < 10:
            intervals = ", ".join(f"{e.label}: {format_time_ps(e.lag_ps)}" for e in ensembles)
            raise InputError(
                f"Save intervals have no common multiple short enough to compare at ({intervals}); "
                "save again at a multiple of one another, or state the interval with --lag."
            )
        out.append(ensemble.strided(stride))
    return out


def _atom_order(
    path: str, scene: Scene | None, n_atoms: int, template: Scene | None
) -> tuple[IntArray | None, Scene, list[str]]:
    """Return the index that brings the file's atoms into the template's order (None: as they are), and the template."""
    if template is None:
        if scene is None:
            raise InputError(f"{path} holds no topology; give one with --top FILE.pdb.")
        return None, scene, []
    if scene is None:
        if n_atoms != template.n_atoms:
            raise OutOfDomainError(
                f"{path} has {n_atoms} atoms, {template.name!r} has {template.n_atoms}; give its topology with --top."
            )
        return None, template, [f"{path}: no topology; its atoms are taken to be in the order of {template.name!r}."]
    if scene.topology_hash == template.topology_hash:
        return None, template, []
    from systems.chemistry import match_atoms

    try:
        order = np.asarray(match_atoms(scene, template), dtype=np.int64)
    except OutOfDomainError as error:
        raise OutOfDomainError(f"{path} does not hold the molecule of the reference: {error}") from error
    moved = bool((order != np.arange(len(order))).any())
    how = "reordered" if moved else "in the same order"
    return (order if moved else None), template, [f"{path}: atoms matched by the bond graph ({how})."]


def _time_axis(path: str, time_ps: npt.NDArray[np.float64], stated: float | None) -> tuple[float, list[int], list[str]]:
    """Return the lag (NaN when one frame leaves it open), the frames at which a new segment starts, and notes."""
    steps = np.diff(time_ps)
    measured = float(f"{np.median(steps):.6g}") if len(steps) else math.nan
    if stated is not None:
        note = []
        if math.isfinite(measured) and abs(measured - stated) > 1e-3 * stated:
            note = [f"{path}: {format_time_ps(stated)} per frame as stated; the file itself says {measured:g} ps."]
        return stated, [], note
    if not len(steps):
        return math.nan, [], []
    if not (np.isfinite(time_ps).all() and measured > 0):
        raise InputError(f"{path}: the file holds no usable times; state the time between frames with --lag 1ps.")
    # Times that passed through float32 are exact only to its spacing.
    tolerance = 1e-3 * measured + 2.0 * float(np.spacing(np.float32(np.abs(time_ps).max())))
    odd = np.abs(steps - measured) > tolerance
    jump = odd & ((steps <= 0) | (steps >= 1.5 * measured))
    if (odd & ~jump).any() or jump.sum() > 0.02 * len(steps):
        first = int(np.flatnonzero(odd)[0])
        raise TrajectoryError(
            f"{path}: time is uneven (frame {first} to {first + 1}: {steps[first]:g} ps, most steps {measured:g} ps); "
            "state the time between frames with --lag if you know it to be even."
        )
    cuts = (np.flatnonzero(jump) + 1).tolist()
    notes = [f"{path}: time jumps {len(cuts)} times; the stretches between are treated as segments."] if cuts else []
    return measured, cuts, notes


def _common(lags: Sequence[float], paths: Sequence[str | Path], stated: float | None) -> float:
    if stated is not None:
        return stated
    if not lags:
        raise InputError(f"{paths[0]}: one frame only, so the time between frames is unknown; state it with --lag 1ps.")
    if max(lags) - min(lags) > 1e-3 * min(lags):
        listed = ", ".join(f"{p}: {x:g} ps" for p, x in zip(paths, lags, strict=False))
        raise InputError(f"Replicas of one candidate must share one save interval ({listed}); thin them or use --lag.")
    return lags[0]


def _merged_record(records: Sequence[dict[str, Any]], label: str, notes: list[str]) -> dict[str, Any]:
    """Return the first record with costs summed over all, noting settings in which the files differ."""
    merged = dict(records[0])
    for key in _SETTINGS:
        values = {str(r.get(key)) for r in records}
        if len(values) > 1:
            notes.append(f"{label}: its files differ in {key} ({', '.join(sorted(values))}).")
    costs = [c for c in (r.get("cost") for r in records) if isinstance(c, dict)]
    merged.pop("cost", None)
    if len(costs) == len(records):
        shared = set.intersection(*(set(c) for c in costs))
        numbers = sorted(k for k in shared if all(isinstance(c[k], (int, float)) for c in costs))
        merged["cost"] = {k: sum(c[k] for c in costs) for k in numbers}
    return merged
