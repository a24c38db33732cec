"""One file as a comparison needs it: opened, matched to the reference's atoms, made whole, its time understood."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.judge.read.common_atoms import Match, match_scenes, solute_atoms
from surrogate.judge.read.stored_frames import StoredFrames, bond_tree
from systems.errors import InputError, OutOfDomainError, TrajectoryError
from systems.scene import Scene, part_of
from systems.trajectory.base import TrajectoryReader
from systems.units import format_time_ps

IntArray = npt.NDArray[np.int64]

_WIDEST_BOND_NM = 0.3
# No MD saves frames this close; and a DCD header of one AKMA unit of time is a default, not a time.
_LEAST_LAG_PS = 1e-4
_AKMA_PS = 0.04888821
_SETTINGS = ("force_field", "solvent", "temperature_k", "friction_per_ps", "model", "weights_hash")


class Opened(NamedTuple):
    """An open file: its frames in the template's order, and which of the template's atoms they are."""

    reader: TrajectoryReader
    frames: StoredFrames
    template: Scene
    kept: IntArray


def open_matched(path: Path, template: Scene | None, top: Path | None, notes: list[str]) -> Opened:
    """Open a file and match its atoms to `template` (its own solute where None); what was done goes to `notes`.

    Raises InputError, OutOfDomainError (another molecule), TrajectoryError.
    """
    from systems.trajectory.codec import open_trajectory

    reader = open_trajectory(path, top=top)
    if reader.n_frames == 0:
        reader.close()
        raise InputError(f"{path}: no frames.")
    notes.extend(f"{path}: {note}" for note in reader.notes)
    scene = reader.scene
    order: IntArray | None = None
    if scene is None and template is None:
        raise InputError(f"{path} holds no topology; give one with `top='FILE.pdb'`.")
    if template is None:
        assert scene is not None
        order = solute_atoms(scene)
        if len(order) < scene.n_atoms:
            notes.append(f"{path}: water and single ions are left out ({scene.n_atoms - len(order)} atoms).")
            template = part_of(scene, order)
        else:
            order, template = None, scene
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
            notes.append(_matched_note(path, match, template, moved))
        order = order if moved else None
    tree = None
    cells = reader.read_cells(0, 1)
    if cells is not None and len(cells) and float(np.linalg.norm(cells[0], axis=1).min()) > 2 * _WIDEST_BOND_NM:
        tree = bond_tree(scene or template)
        notes.append(f"{path}: periodic; molecules are made whole.")
    return Opened(reader, StoredFrames(reader, order=order, tree=tree), template, kept)


def _matched_note(path: Path, match: Match, template: Scene, moved: bool) -> str:
    how = "reordered" if moved else "in the same order"
    if len(match.kept) < template.n_atoms:
        how = f"{len(match.kept)} of {template.n_atoms} atoms"
    return f"{path}: atoms matched by {match.how} ({how})."


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
    # Times that passed through float32 are exact only to its spacing.
    tolerance = 1e-3 * measured + 2.0 * float(np.spacing(np.float32(np.abs(time_ps).max())))
    odd = np.abs(steps - measured) > tolerance
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
    costs = [c for c in (r.get("cost") for r in records) if isinstance(c, dict)]
    merged.pop("cost", None)
    if len(costs) == len(records):
        shared = set.intersection(*(set(c) for c in costs))
        numbers = sorted(k for k in shared if all(isinstance(c[k], (int, float)) for c in costs))
        merged["cost"] = {k: sum(c[k] for c in costs) for k in numbers}
    return merged
