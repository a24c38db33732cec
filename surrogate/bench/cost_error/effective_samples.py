"""Effective samples a second, of a surrogate at each setting and of MD, and when a training has paid for itself.

Effective samples are simulated time over 2 max(τ_model, τ_MD), τ the relaxation time of the slowest torsion of which
the MD at hand holds at least 50: a model that forgets too fast earns nothing by it, and one that forgets too slowly
pays for it. What they say nothing about is whether the samples are right; that is the distance beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from surrogate.bench.cost_error.sweep_settings import SIMD
from surrogate.comparison.rows.kinetics_rows import relaxation_of, turning

if TYPE_CHECKING:
    from surrogate.comparison.rows.rows import Sample
    from surrogate.models.weights import Weights

# Below so many effective samples of MD, nobody knows its relaxation time.
LEAST_SAMPLES = 50.0


def slowest_torsion(samples: Sequence[Sample]) -> dict[str, Any] | None:
    """Return the torsion that effective samples are counted by, JSON-able: its place in `relaxation_rows.turning`, its
    name, its relaxation time in ps over all of MD `samples`, how many of them these hold. None where none relaxes often
    enough."""
    found: list[dict[str, Any]] = []
    total_ps = sum(sample.features.total_ps for sample in samples)
    for k, (symbol, label, _) in enumerate(turning(samples[0].features)):
        times = [relaxation_of(sample, k)[1].value for sample in samples]
        if all(math.isfinite(time) and time > 0 for time in times):
            tau_ps = sum(times) / len(times)
            name = f"cos {symbol or label}".strip()
            found.append({"torsion": k, "name": name, "tau_ps": tau_ps, "samples": total_ps / (2.0 * tau_ps)})
    known = [one for one in found if one["samples"] >= LEAST_SAMPLES]
    return max(known, key=lambda one: float(one["tau_ps"])) if known else None


def samples_per_second(cpu_s_per_ns: float, tau_ps: float | None, md_tau_ps: float) -> float | None:
    """Return effective samples a processor second; None where the model's own relaxation time is not known."""
    if tau_ps is None or not math.isfinite(tau_ps):
        return None
    return 1e3 / cpu_s_per_ns / (2.0 * max(tau_ps, md_tau_ps))


def effective_row(row: dict[str, Any], tau_ps: float | None, md: dict[str, Any]) -> dict[str, Any]:
    """Return what a measured setting earns: its effective samples a second, and these over those of OpenMM at its
    fastest."""
    slow = md.get("slowest")
    if slow is None:
        return {}
    rate = samples_per_second(row["cpu_s_per_ns"]["mean"], tau_ps, slow["tau_ps"])
    fastest = min(cost["cpu_s_per_ns"]["mean"] for cost in md["cost"] if cost["way"] != SIMD)
    best = 1e3 / fastest / (2.0 * slow["tau_ps"])
    return {
        "slow_tau_ps": tau_ps,
        "effective_per_s": rate,
        "effective_over_md": None if rate is None else rate / best,
    }


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the places of points (effective samples a second, distance) that no other point beats in both, the fastest
    first."""
    order = sorted(range(len(points)), key=lambda k: (-points[k][0], points[k][1]))
    front: list[int] = []
    for k in order:
        if not front or points[k][1] < points[front[-1]][1]:
            front.append(k)
    return front


def training_cost(weights: Weights, md_s_per_ns: float) -> dict[str, float | None]:
    """Return what weights took before their first frame, JSON-able: `training_s` of all trainings that they come from,
    as their provenance has them, and `reference_s`, what MD here takes for the frames that these saw."""
    seconds, known, frames = 0.0, False, dict[str, int]()
    record: Any = weights.provenance
    while isinstance(record, dict):
        for key in ("stage_one_s", "stage_two_s", "spent_s", "training_s"):
            if isinstance(record.get(key), int | float):
                seconds, known = seconds + float(record[key]), True
        for source in record.get("sources", ()):
            frames[str(source.get("sha256"))] = int(source.get("n_frames", 0))
        record = record.get("from")
    simulated_ns = 1e-3 * sum(frames.values()) * weights.domain.lag_ps
    return {
        "training_s": seconds if known else None,
        "reference_ns": simulated_ns,
        "reference_s": simulated_ns * md_s_per_ns,
    }


def break_even(spent_s: float, rate: float | None, md_rate: float) -> float | None:
    """Return after how many effective samples a surrogate that took `spent_s` before its first has cost as much as MD;
    None where it never does."""
    if rate is None or rate <= md_rate:
        return None
    return spent_s / (1.0 / md_rate - 1.0 / rate)
