"""An ensemble: all frames of one candidate, as segments of unbroken time, in the atom order of one scene; and how it is
read from files, with what they say of themselves: settings, costs, what guards did."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.read.stored_frames import (
    StoredFrames,
    bond_tree,
    grid_of,
    length_error_nm,
    match_scenes,
    rounded,
    solute_atoms,
)
from systems.errors import InputError, OutOfDomainError, TrajectoryError, listed
from systems.scene import FloatArray, IntArray, Scene, part_of
from systems.trajectory.base import TrajectoryReader, uneven_by_ps
from systems.trajectory.codec import DIFFERENCE_COLUMN, open_trajectory, reweighting
from systems.trajectory.joined import replicas_of, summed_cost
from systems.units import format_time_ps

Frames = npt.NDArray[np.float32] | StoredFrames
Flags = npt.NDArray[np.uint16]

IN_MEMORY_BYTES = 128 * 2**20
# How a note begins on files of runs that ended early.
STOPPED = "Stopped before the end"
_LEAST_FRAMES = 10
# Of a sample of frames, about as many numbers.
_SAMPLED_VALUES = 20_000_000

# Fewer energies of a reference say nothing of how far its ensemble is the model's.
_LEAST_ENERGIES = 10
# Below this share of effective frames populations of the reference and of the model are two things.
_FEW = 0.5
_WIDEST_BOND_NM = 0.3
# No MD saves frames this close; and a DCD header of one AKMA unit of time is a default, not a time.
_LEAST_LAG_PS = 1e-4
_AKMA_PS = 0.04888821
_SETTINGS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "model", "weights_hash")


def length_words(segment_lengths: Sequence[int], lag_ps: float) -> str:
    """Return how long trajectories are, as what they are: '32 replicas of 3.8 ns', never their sum."""
    if not segment_lengths:
        return "no frames"
    short, long = (format_time_ps(n * lag_ps) for n in (min(segment_lengths), max(segment_lengths)))
    each = long if short == long else f"{short} to {long}"
    return each if len(segment_lengths) == 1 else f"{len(segment_lengths)} replicas of {each}"


class InSegments:
    """Base of what holds one value or more for every frame, `lag_ps` apart, in segments of unbroken time."""

    lag_ps: float

    @property
    def segment_lengths(self) -> list[int]:
        """Frames in each segment."""
        raise NotImplementedError

    @property
    def n_frames(self) -> int:
        return sum(self.segment_lengths)

    @property
    def total_ps(self) -> float:
        """Simulated time of all segments together (frames times lag)."""
        return self.n_frames * self.lag_ps

    @property
    def length_words(self) -> str:
        """Such as '32 replicas of 3.8 ns'."""
        return length_words(self.segment_lengths, self.lag_ps)


@dataclass(frozen=True, eq=False)
class Ensemble(InSegments):
    """Frames of one candidate: one or several segments (replicas, or stretches of unbroken time).

    `segments`: each `(n, n_atoms, 3)` float32 nm, atoms in the order of `scene`, in memory or in their file, to be read
    by slices; `kept`: which atoms of the reference's scene these are, None for all; `lag_ps`: time between frames;
    `flags` `(n,)` uint16 and `chunk_idx` `(n,)` int32 per segment, or None where the file does not say; `record`: what
    the writer said of itself (costs summed over files); `sources`: the files; `top`, `stated_lag_ps`: what the user
    said of them; `notes`: what was done on reading; `grids_nm`: what the coordinates of each segment are rounded to, 0
    for nothing (none given: nothing); `differences_kj_mol`: of MD under an umbrella potential, the energy of each
    frame without it, less that with it.
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
    kept: IntArray | None = None
    grids_nm: tuple[float, ...] = ()
    differences_kj_mol: Sequence[FloatArray] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lag_ps) and self.lag_ps > 0):
            raise InputError(f"{self.label}: the time between frames is {self.lag_ps} ps; state it with `dt_ps='1ps'`.")
        for i, segment in enumerate(self.segments):
            if segment.ndim != 3 or segment.shape[1:] != (self.scene.n_atoms, 3):
                raise InputError(
                    f"{self.label}: segment {i} has shape {segment.shape}, expected (n, {self.scene.n_atoms}, 3)."
                )
        if self.n_frames == 0:
            raise InputError(f"{self.label}: no frames.")
        for name, series in self._columns.items():
            if series is not None and [len(s) for s in series] != self.segment_lengths:
                raise InputError(f"{self.label}: {name} do not match the segments in length.")

    @property
    def _columns(self) -> dict[str, Sequence[npt.NDArray[Any]] | None]:
        return {name: getattr(self, name) for name in ("flags", "chunk_idx", "differences_kj_mol")}

    @property
    def segment_lengths(self) -> list[int]:
        return [len(s) for s in self.segments]

    @property
    def grid_nm(self) -> float:
        """The coarsest rounding of any segment's coordinates, nm, 0 for none."""
        return max(self.grids_nm, default=0.0)

    def sample(self, n_frames: int) -> npt.NDArray[np.float32]:
        """Return about `n_frames` finite frames `(n, n_atoms, 3)` nm, spread evenly (fewer of very large scenes)."""
        wanted = max(min(n_frames, _SAMPLED_VALUES // max(3 * self.scene.n_atoms, 1)), 10)
        stride = max(1, -(-self.n_frames // wanted))
        frames = np.concatenate([s[::stride] for s in self.segments])
        return frames[np.isfinite(frames).all(axis=(1, 2))]

    def strided(self, stride: int) -> Ensemble:
        """Return every `stride`-th frame of each segment, with the lag that follows."""
        if stride == 1:
            return self
        segments = [s.thinned(stride) if isinstance(s, StoredFrames) else s[::stride] for s in self.segments]
        thinned: dict[str, Any] = {k: [x[::stride] for x in series] for k, series in self._columns.items() if series}
        note = f"{self.label}: one frame in {stride} is used, for equal save intervals."
        return replace(self, segments=segments, lag_ps=self.lag_ps * stride, notes=(*self.notes, note), **thinned)

    def on_grid(self, grid_nm: float) -> Ensemble:
        """Return the same frames with coordinates rounded to `grid_nm`, where they are not as coarse already."""
        own = self.grids_nm or (0.0,) * len(self.segments)
        if min(own) >= grid_nm:
            return self
        segments = [
            s if g >= grid_nm else s.on_grid(grid_nm) if isinstance(s, StoredFrames) else rounded(s, grid_nm)
            for s, g in zip(self.segments, own, strict=True)
        ]
        return replace(self, segments=segments, grids_nm=tuple(max(g, grid_nm) for g in own))

    def restricted(self, atoms: IntArray, scene: Scene) -> Ensemble:
        """Return the same frames with `atoms` `(k,)` only, which are those of `scene`."""
        segments = [s.restricted(atoms) if isinstance(s, StoredFrames) else s[:, atoms] for s in self.segments]
        kept = atoms if self.kept is None else self.kept[atoms]
        return replace(self, segments=segments, scene=scene, kept=kept)


def load_ensemble(
    paths: Sequence[str | Path],
    *,
    label: str | None = None,
    template: Scene | None = None,
    top: str | Path | None = None,
    lag_ps: float | None = None,
    in_memory_bytes: int = IN_MEMORY_BYTES,
) -> Ensemble:
    """Read one or several trajectory files, of any format that MDTraj or MDAnalysis reads, as the replicas of one
    candidate.

    Atoms are put in the order of `template` (matched by the bond graph where order or names differ); a file that holds
    only some of them gives an ensemble of those, named in `kept`. Without a template the first file's scene is it, less
    water and single ions. Molecules of a periodic file are made whole; a file whose time jumps is cut there into
    segments. `lag_ps` overrides the times in the files, `top` is the topology for formats that hold none. Files beyond
    the first `in_memory_bytes` of all coordinates together are read block by block. Raises InputError (no files, no
    topology, no times without `lag_ps`, replicas with different lags or atoms), OutOfDomainError (another molecule) and
    TrajectoryError (a damaged file, uneven time).
    """
    if not paths:
        raise InputError("No trajectory file was given.")
    name = label or Path(paths[0]).name + (f" + {len(paths) - 1} more" if len(paths) > 1 else "")
    segments: list[Frames] = []
    columns: dict[str, list[Any]] = {"flags": [], "chunk_idx": [], "differences_kj_mol": []}
    records: list[dict[str, Any]] = []
    scalars: list[Mapping[str, FloatArray]] = []
    lags: list[float] = []
    notes: list[str] = []
    kept: list[IntArray] = []
    grids: list[float] = []
    stopped: list[str] = []
    for path in paths:
        reader, frames, template, own = open_matched(Path(path), template, None if top is None else Path(top), notes)
        kept.append(own)
        lag, cuts, note = time_axis(str(path), reader.time_ps if reader.times_known else None, reader.n_frames, lag_ps)
        replicas = replicas_of(reader.record, reader.n_frames)
        cuts = sorted({*cuts, *(part.start for part, _ in replicas[1:])})
        notes += note
        lags.append(lag)
        grids += [grid_of(reader)] * (len(cuts) + 1)
        size = 12 * len(frames) * reader.n_atoms
        if size <= in_memory_bytes:
            in_memory_bytes -= size
            segments += np.split(frames[:], cuts)
            reader.close()
        else:
            segments += frames.split(cuts)
        for key, values, kind in (("flags", reader.flags, np.uint16), ("chunk_idx", reader.chunk_idx, np.int32),
                                  ("differences_kj_mol", _of_umbrella(reader), np.float64)):  # fmt: skip
            columns[key] += [] if values is None else np.split(np.asarray(values, dtype=kind), cuts)
        if len(replicas) > 1:
            notes.append(f"{path}: {len(replicas)} replicas in one file, which are compared as separate runs.")
        records += [record for _, record in replicas]
        scalars += [{key: values[part] for key, values in reader.scalars.items()} for part, _ in replicas]
        if reader.record.get("completed") is False:
            stopped.append(f"{path} ({reader.n_frames} frames)")
    assert template is not None
    if stopped:
        notes.append(f"{STOPPED}: {listed(stopped, 3)}.")
    if any(len(k) != len(kept[0]) or (k != kept[0]).any() for k in kept[1:]):
        raise InputError(f"{name}: its files hold different atoms of {template.name!r}; give them as candidates apart.")
    if any(r.get("unseen_molecule") for r in records):
        notes.append(f"{name}: its weights ({records[0].get('weights')}) were not trained on this molecule.")
    notes += intervention_notes(name, records) + reweighting_notes(name, records, scalars)
    lag = common_lag([x for x in lags if math.isfinite(x)], paths, lag_ps)
    part = kept[0] if len(kept[0]) < template.n_atoms else None
    known: dict[str, Any] = {key: v if len(v) == len(segments) else None for key, v in columns.items()}
    return Ensemble(
        label=name,
        segments=segments,
        lag_ps=lag,
        scene=template if part is None else part_of(template, part),
        record=merged_record(records, name, notes),
        sources=tuple(str(p) for p in paths),
        top=None if top is None else str(top),
        stated_lag_ps=lag_ps,
        notes=_together(notes, paths),
        kept=part,
        grids_nm=tuple(grids),
        **known,
    )


def _of_umbrella(reader: TrajectoryReader) -> FloatArray | None:
    """Return the energy of frames `(n,)` without their umbrella potential, less that with it; None without one."""
    return reader.scalars.get(DIFFERENCE_COLUMN) if reader.record.get("umbrella") else None


def _together(notes: Sequence[str], paths: Sequence[str | Path]) -> tuple[str, ...]:
    """Return notes, a line for what is said of several files alike."""
    files_of: dict[str, list[str]] = {}
    for note in notes:
        path = next((f"{p}: " for p in paths if note.startswith(f"{p}: ")), "")
        files_of.setdefault(note.removeprefix(path), []).append(path)
    return tuple(
        (f"{files[0][:-2]} and {len(files) - 1} more: " if files[0] and len(files) > 1 else files[0]) + said
        for said, files in files_of.items()
    )


def alike(ensembles: Sequence[Ensemble]) -> tuple[list[Ensemble], IntArray | None]:
    """Return the ensembles on the atoms that all of them hold, thinned by whole strides to their least common save
    interval, rounded to the coarsest grid of any; and which of the first's (the reference's) atoms these are (None:
    all). Raises InputError when fewer than three atoms are left, or when no common interval leaves 10 frames of
    each."""
    reference, out = ensembles[0], list(ensembles)
    every = np.arange(reference.scene.n_atoms)
    parts = [e.kept for e in out[1:] if e.kept is not None]
    common = reduce(np.intersect1d, parts, every) if parts else None
    if common is not None:
        if len(common) < 3:
            raise InputError(
                "The trajectories have fewer than three atoms in common; save more, or compare them apart."
            )
        scene = part_of(reference.scene, common)
        held = [every if e is reference or e.kept is None else e.kept for e in out]
        out = [e.restricted(np.searchsorted(atoms, common), scene) for e, atoms in zip(out, held, strict=True)]
        note = f"Compared on the {len(common)} atoms that all trajectories hold, of {len(every)}."
        out[0] = replace(out[0], notes=(*out[0].notes, note))
    if few := [f"{e.label} holds {e.n_frames}" for e in out if e.n_frames < _LEAST_FRAMES]:
        raise InputError(f"Too few frames to compare: {', '.join(few)}; at least {_LEAST_FRAMES} are needed.")
    strides = _common_strides([e.lag_ps for e in out])
    if any(e.n_frames // stride < _LEAST_FRAMES for e, stride in zip(out, strides, strict=True)):
        intervals = ", ".join(f"{e.label}: {format_time_ps(e.lag_ps)}" for e in out)
        raise InputError(
            f"Save intervals have no common multiple short enough to compare at ({intervals}); "
            "save again at a multiple of one another, or state the interval with `dt_ps`."
        )
    out = [e.strided(stride) for e, stride in zip(out, strides, strict=True)]
    grid = max(e.grid_nm for e in out)
    if grid > 0:
        note = (
            f"{' and '.join(e.label for e in out if e.grid_nm == grid)}: coordinates are rounded to {10 * grid:.3g} Å, "
            f"which alone makes bond lengths vary by {10 * length_error_nm(grid):.2g} Å; all trajectories are compared "
            "rounded alike, and what is narrower is hidden."
        )
        out = [e.on_grid(grid) for e in out]
        out[0] = replace(out[0], notes=(*out[0].notes, note))
    return out, common


def _common_strides(lags_ps: Sequence[float]) -> list[int]:
    """Return by how many of its frames each must step, so that all step by the same time."""
    lags = [Fraction(float(f"{lag:.6g}")).limit_denominator(1_000_000) for lag in lags_ps]
    common = lags[0]
    for lag in lags[1:]:
        common = Fraction(math.lcm(common.numerator, lag.numerator), math.gcd(common.denominator, lag.denominator))
    return [int(common / lag) for lag in lags]


def intervention_notes(label: str, records: Sequence[dict[str, Any]]) -> list[str]:
    """Return what the guards of a rollout did, replicas together, and what it may do to statistics; else nothing."""
    summaries = [r["interventions"] for r in records if isinstance(r.get("interventions"), dict)]
    frames: Counter[str] = Counter()
    bias: dict[str, None] = {}
    for summary in summaries:
        frames.update({str(k): int(v) for k, v in summary.get("frames", {}).items()})
        bias |= dict.fromkeys(str(why) for why in summary.get("bias", []))
    if not frames:
        return []
    chunks, caught = (sum(int(a.get(key, 0)) for a in summaries) for key in ("chunks", "chunks_caught"))
    done = ", ".join(f"{n} {name}" for name, n in frames.items())
    return [
        f"{label}: guard {summaries[0].get('guard')} intervened in {caught} of {chunks} chunks; frames that are not "
        f"the model's first draw: {done}. What that may do: {'; '.join(bias)}."
    ]


def reweighting_notes(
    label: str, records: Sequence[Mapping[str, Any]], scalars: Sequence[Mapping[str, FloatArray]]
) -> list[str]:
    """Return how far a learned potential's frames are those of its reference, where a rollout asked it; else
    nothing."""
    temperature = records[0].get("temperature_k") if records else None
    if any(record.get("umbrella") for record in records):
        return []
    columns = [s[DIFFERENCE_COLUMN] for s in scalars if DIFFERENCE_COLUMN in s]
    if not columns or not isinstance(temperature, int | float):
        return []
    asked = np.concatenate(columns)
    asked = asked[~np.isnan(asked)]
    known = asked[np.isfinite(asked)]
    if len(known) < _LEAST_ENERGIES:
        return []
    _, effective = reweighting(known, float(temperature))
    ref = records[0].get("force_field", "its reference")
    few = "" if effective >= _FEW * len(known) else "; so few say that populations of the two differ: train longer"
    none = f" and has no energy for {len(asked) - len(known)} more" if len(known) < len(asked) else ""
    return [
        f"{label}: {ref} was asked about {len(known)} frames{none}: U({ref}) - U(model) is {known.mean():.3g} "
        f"kJ/mol with a standard deviation of {known.std():.3g}. Reweighted by exp(-difference / kT) at "
        f"{temperature:g} K, {effective:.0f} of {len(known)} frames are effective{few}."
    ]


def open_matched(
    path: Path, template: Scene | None, top: Path | None, notes: list[str]
) -> tuple[TrajectoryReader, StoredFrames, Scene, IntArray]:
    """Open a file and match its atoms to `template` (its own solute where None); what was done goes to `notes`. Return
    the reader, its frames in the template's order, the template, and which of its atoms they are. Raises InputError,
    OutOfDomainError (another molecule), TrajectoryError."""
    reader = open_trajectory(path, top=top)
    if reader.n_frames == 0:
        reader.close()
        raise InputError(f"{path}: no frames.")
    notes.extend(f"{path}: {note}" for note in reader.notes)
    scene = reader.scene
    order: IntArray | None = None
    if template is None:
        if scene is None:
            raise InputError(f"{path} holds no topology; give one with `top='FILE.pdb'`.")
        template, atoms = scene, solute_atoms(scene)
        if len(atoms) < scene.n_atoms:
            notes.append(f"{path}: water and single ions are left out ({scene.n_atoms - len(atoms)} atoms).")
            order, template = atoms, part_of(scene, atoms)
        kept = np.arange(template.n_atoms)
    elif scene is None:
        kept = np.arange(template.n_atoms)
        if reader.n_atoms != template.n_atoms:
            raise OutOfDomainError(
                f"{path} has {reader.n_atoms} atoms, {template.name!r} has {template.n_atoms}; give its topology with "
                "`top`."
            )
        notes.append(f"{path}: no topology; its atoms are taken to be in the order of {template.name!r}.")
    else:
        try:
            match = match_scenes(scene, template)
        except OutOfDomainError as error:
            raise OutOfDomainError(f"{path} does not hold the molecule of the reference: {error}") from error
        order, kept = match.order, match.kept
        moved = len(order) < reader.n_atoms or bool((order != np.arange(len(order))).any())
        if match.how:
            how = "reordered" if moved else "in the same order"
            if len(kept) < template.n_atoms:
                how = f"{len(kept)} of {template.n_atoms} atoms"
            notes.append(f"{path}: atoms matched by {match.how} ({how}).")
        order = order if moved else None
    tree = None
    cells = reader.read_cells(0, 1)
    if cells is not None and len(cells) and float(np.linalg.norm(cells[0], axis=1).min()) > 2 * _WIDEST_BOND_NM:
        tree = bond_tree(scene or template)
        notes.append(f"{path}: periodic; molecules are made whole.")
    return reader, StoredFrames(reader, order=order, tree=tree), template, kept


def time_axis(
    path: str, time_ps: npt.NDArray[np.float64] | None, n_frames: int, stated: float | None
) -> tuple[float, list[int], list[str]]:
    """Return the lag (NaN when one frame leaves it open), the frames at which a new segment starts, and notes."""
    steps = np.empty(0) if time_ps is None else np.diff(time_ps)
    measured = float(f"{np.median(steps):.6g}") if len(steps) else math.nan
    if stated is not None:
        note = []
        if math.isfinite(measured) and abs(measured - stated) > 1e-3 * stated:
            note = [f"{path}: {format_time_ps(stated)} per frame as stated; the file itself says {measured:g} ps."]
        return stated, [], note
    if n_frames < 2:
        return math.nan, [], []
    if time_ps is None or not (np.isfinite(time_ps).all() and measured > 0):
        raise InputError(f"{path}: the file holds no usable times; state the time between frames with `dt_ps='1ps'`.")
    if measured < _LEAST_LAG_PS or abs(measured - _AKMA_PS) < 1e-6:
        raise InputError(
            f"{path}: its header says {1e3 * measured:.3g} fs between frames, which is what a writer that was told "
            "nothing puts there; state the time between frames with `dt_ps='1ps'`."
        )
    odd = np.abs(steps - measured) > uneven_by_ps(time_ps, measured)
    jump = odd & ((steps <= 0) | (steps >= 1.5 * measured))
    if (odd & ~jump).any() or jump.sum() > 0.02 * len(steps):
        first = int(np.flatnonzero(odd)[0])
        raise TrajectoryError(
            f"{path}: time is uneven (frame {first} to {first + 1}: {steps[first]:g} ps, most steps {measured:g} ps); "
            "state the time between frames with `dt_ps` if you know it to be even."
        )
    cuts = (np.flatnonzero(jump) + 1).tolist()
    notes = [f"{path}: time jumps {len(cuts)} times; the stretches between are treated as segments."] if cuts else []
    return measured, cuts, notes


def common_lag(lags: Sequence[float], paths: Sequence[str | Path], stated: float | None) -> float:
    """Return the one save interval of all replicas, ps. Raises InputError when they differ or none is known."""
    if stated is not None:
        return stated
    if not lags:
        raise InputError(
            f"{paths[0]}: one frame only, so the time between frames is unknown; state it with `dt_ps='1ps'`."
        )
    if max(lags) - min(lags) > 1e-3 * min(lags):
        listed = ", ".join(f"{p}: {x:g} ps" for p, x in zip(paths, lags, strict=False))
        raise InputError(
            f"Replicas of one candidate must share one save interval ({listed}); thin them or use `dt_ps`."
        )
    return lags[0]


def merged_record(records: Sequence[dict[str, Any]], label: str, notes: list[str]) -> dict[str, Any]:
    """Return the first record with costs summed over all, noting settings in which the files differ."""
    merged = dict(records[0])
    for key in _SETTINGS:
        values = {str(r.get(key)) for r in records}
        if len(values) > 1:
            notes.append(f"{label}: its files differ in {key} ({', '.join(sorted(values))}).")
    merged.pop("cost", None)
    return merged | summed_cost(records)
