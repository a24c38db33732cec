"""Held-out reference: cut from the end of a trajectory, or refused where weights were trained on it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from systems.errors import InputError
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.weights import Weights


def refuse_trained_on(
    weights: Weights, reference: Sequence[Path], replicate: Sequence[Path], *, lag_ps: float | None = None
) -> list[str]:
    """Raise InputError unless weights never saw these trajectories; return the fingerprints of their frames.

    Refused are: frames that stand in the provenance of the weights, of those they began from and so on; a run of the
    same conditions and seed as one of these (a part of it, or saved otherwise); conditions other than those of
    training; an interval between the frames that are compared (`lag_ps`, or all) that the weights do not step to; and
    motion that reference and replicate have in common (`data.frames.refuse_leaks`).
    """
    from surrogate.data import collect_frames

    domain, name = weights.domain, weights.path.name
    canonical = getattr(weights.model.config, "canonical", True)
    frames = collect_frames(list(reference), canonical=canonical, held=list(replicate))
    try:
        frames.refuse_leaks()
    except InputError as error:
        raise InputError(f"reference and replicate must be runs of their own, and share motion: {error}") from error
    known = {key: domain.conditions.get(key) for key in frames.conditions}
    other_key = next((key for key, value in frames.conditions.items() if value != known[key]), None)
    if other_key is not None:
        raise InputError(
            f"{reference[0]} has {other_key} {frames.conditions[other_key]}, {name} was trained for "
            f"{known[other_key]}: no reference to compare it with."
        )
    compared_ps = lag_ps or frames.lag_ps
    for step_ps, what in ((frames.lag_ps, f"frames of {reference[0]}"), (domain.lag_ps, f"steps of {name}")):
        if round(compared_ps / step_ps) < 1 or abs(compared_ps / step_ps - round(compared_ps / step_ps)) > 1e-6:
            raise InputError(
                f"frames {format_time_ps(compared_ps)} apart cannot be compared: {what} are "
                f"{format_time_ps(step_ps)} apart; give `lag_ps` as a multiple of both, or other references."
            )
    trained = list(_sources(weights.provenance))
    for path, source in zip([*reference, *replicate], frames.sources, strict=True):
        for other in trained:
            same_frames = other.get("sha256") == source["sha256"]
            same_run = not domain.further and source["seed"] is not None and other.get("seed") == source["seed"]
            if same_frames or same_run:
                raise InputError(
                    f"{path}: {name} was trained on this run (seed {other.get('seed')}, then called "
                    f"{other.get('file')}); give runs that training never saw."
                )
    return [str(source["sha256"]) for source in frames.sources]


def _sources(provenance: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All trajectories of a training and of those that it began from."""
    yield from provenance.get("sources", ())
    if isinstance(provenance.get("from"), dict):
        yield from _sources(provenance["from"])
