"""What each trajectory is, what it cost, and how many of its frames are faulty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from surrogate.judge.measure.structure import first_invalid_ps
from surrogate.judge.read.ensemble import Ensemble
from surrogate.judge.rows import metrics
from surrogate.judge.rows.rows import Sample
from systems.chemistry import validity
from systems.chemistry.validity import Geometry


@dataclass(frozen=True)
class Account:
    """What one trajectory is: where from, how long, how it was made, what it cost.

    `top` and `stated_lag_ps` are what the user said of the files; `total_ps`, `n_frames` are of the whole input;
    `length` says it as what it is ('32 replicas of 3.8 ns'); `ns_per_day` and `wall_s` are None where its record holds
    no cost.
    """

    label: str
    sources: tuple[str, ...]
    top: str | None
    stated_lag_ps: float | None
    n_segments: int
    n_frames: int
    lag_ps: float
    total_ps: float
    settings: dict[str, Any]
    wall_s: float | None
    ns_per_day: float | None
    cost: dict[str, Any]
    length: str = ""


@dataclass(frozen=True)
class Faults:
    """How many of the compared frames carry each validity flag, and when the first invalid one comes."""

    label: str
    n_frames: int
    counts: dict[str, int]
    n_invalid: int
    first_invalid_ps: float | None


def faults_of(sample: Sample, geometry: Geometry) -> Faults:
    """Count the flags of the frames of one sample, of those checks that the geometry has something for."""
    features = sample.features
    flags = np.concatenate(list(features.flags))
    counts = {
        validity.flag_names(c.mask)[0]: int(((flags & c.mask) != 0).sum()) for c in metrics.applicable_checks(geometry)
    }
    return Faults(
        features.label,
        len(flags),
        counts,
        int(((flags & validity.INVALID) != 0).sum()),
        first_invalid_ps(features, validity.INVALID),
    )


def account_of(ensemble: Ensemble) -> Account:
    """Return what `ensemble` says of itself; simulated time and wall seconds are those of the whole input."""
    record = ensemble.record
    cost = record.get("cost") if isinstance(record.get("cost"), dict) else {}
    assert isinstance(cost, dict)
    wall = cost.get("wall_s")
    wall_s = float(wall) if isinstance(wall, (int, float)) and wall > 0 else None
    settings = {k: v for k, v in record.items() if k != "cost" and isinstance(v, (str, int, float, bool))}
    return Account(
        label=ensemble.label,
        sources=ensemble.sources,
        top=ensemble.top,
        stated_lag_ps=ensemble.stated_lag_ps,
        n_segments=len(ensemble.segments),
        n_frames=ensemble.n_frames,
        lag_ps=ensemble.lag_ps,
        total_ps=ensemble.total_ps,
        settings=settings,
        wall_s=wall_s,
        ns_per_day=None if wall_s is None else ensemble.total_ps * 1e-3 * 86_400.0 / wall_s,
        cost=dict(cost),
        length=ensemble.length_words,
    )


def speed_ratio(candidate: Account, reference: Account) -> float | None:
    """Return simulated time per wall second over the reference's; None when one of the two holds no cost."""
    if candidate.ns_per_day is None or reference.ns_per_day is None:
        return None
    return candidate.ns_per_day / reference.ns_per_day


def cost_ratio(worth_ps: float, share: float, candidate: Account, reference: Account) -> float | None:
    """Return the wall time of `worth_ps` of the reference's MD over that of a share of the candidate, or None."""
    if candidate.wall_s is None or reference.wall_s is None:
        return None
    return worth_ps / reference.total_ps * reference.wall_s / (share * candidate.wall_s)
