"""Errors of one rollout against held-out reference, with error bars, its equivalent MD time, and effective samples.

Effective samples are simulated time over 2 max(τ_model, τ_MD), τ the relaxation time of the slowest torsion of which
the MD at hand holds at least 50: a model that forgets too fast earns nothing by it, and one that forgets too slowly
pays for it. What they say nothing about is whether the samples are right; that is the distance beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.stress_page import HALF_ANGSTROM_RULE, Frames, measure_bonds
from surrogate.bench.timing import SIMD
from surrogate.comparison.equivalent_time import (
    EquivalentTime,
    distance_to_reference,
    equivalent_time_by,
    errors_by_length,
    joint_measure,
)
from surrogate.comparison.measure.distributions import block_occupancy
from surrogate.comparison.measure.slow_motion import longest_correlation
from surrogate.comparison.measure.statistics import block_length, estimate, make_blocks
from surrogate.comparison.measure.structure import Baseline, Features, backbone
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.kinetics_rows import relaxation_of, turning
from surrogate.comparison.rows.rows import Options, Sample, make_sample
from systems.chemistry.validity import BOND_20_PERCENT, INVALID, NOT_FINITE
from systems.errors import InputError
from systems.scene import Scene

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

CHECKS = {
    "valid_half_angstrom_%": HALF_ANGSTROM_RULE,
    "bonds_20_percent_%": NOT_FINITE | BOND_20_PERCENT,
    "valid_all_%": INVALID,
}
# Below so many effective samples of MD, nobody knows its relaxation time.
LEAST_SAMPLES = 50.0


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out reference and its replicate, measured once. `length_ps`: of each, as far as they are compared."""

    scene: Scene
    baseline: Baseline
    reference: Features
    replicate: Features

    @property
    def length_ps(self) -> float:
        return min(self.reference.total_ps, self.replicate.total_ps)


def read_reference(
    scene: Scene, reference: Sequence[Path], replicate: Sequence[Path], lag_ps: float | None = None
) -> HeldOut:
    """Measure two held-out runs of `scene`, atoms in its order, frames `lag_ps` apart or all. Raises InputError for a
    scene without φ and ψ."""
    if not backbone(scene).residues:
        raise InputError(f"{scene.name} has no residue with φ and ψ, by whose map errors are measured here.")
    first, second = (load_ensemble(paths, template=scene) for paths in (reference, replicate))
    if lag_ps is not None:
        first, second = (run.strided(max(1, round(lag_ps / run.lag_ps))) for run in (first, second))
    baseline = Baseline.of(first, probing=False)
    return HeldOut(scene, baseline, baseline.measure(first), baseline.measure(second))


def compare_frames(
    frames: Frames, ref: HeldOut, *, seed: int = 0, slowest: int | None = None
) -> tuple[dict[str, Any], EquivalentTime]:
    """Return what replicas `(rows, n_frames, n_atoms, 3)` nm get wrong, JSON-able, and their equivalent MD time by the
    φ/ψ map.

    `jsd`: Jensen-Shannon distance of the joint φ/ψ histograms (50 x 50, overflow bins), the root mean square of those
    to the two held-out runs; `curve`: the same of parts of the rollout, (ps, distance); shares of valid frames; the
    autocorrelation of cos ψ after one frame and its relaxation time; bonds (`measure_bonds`). Numbers with intervals
    are dictionaries of `comparison.statistics.Estimate`. `slow_relaxation_ps`: of the torsion `slowest`, where one is
    named (`slowest_torsion`). Raises InputError where frames are too few.
    """
    rolled = Ensemble("rollout", [x.astype(np.float32) for x in frames], ref.reference.lag_ps, ref.scene)
    features = ref.baseline.measure(rolled)
    found = joint_measure(ref.reference, features, ref.replicate, ref.baseline.torsions)
    equivalent_time = None if found is None else equivalent_time_by(*found, seed)
    if found is None or equivalent_time is None:
        raise InputError("too few frames to tell an error; give longer references, or a longer `time_ps`.")
    sample = _sample(features, ref, seed)
    correlation, relaxation = relaxation_of(sample)
    out: dict[str, Any] = {
        "jsd": distance_to_reference(found[0], seed).to_dict(),
        "curve": np.stack(errors_by_length(found[0], features.total_ps), axis=1).tolist(),
        "correlation": correlation.to_dict(),
        "relaxation_ps": relaxation.to_dict(),
        **measure_bonds(np.concatenate(list(frames)), ref.baseline.geometry),
    }
    if slowest is not None:
        out["slow_relaxation_ps"] = relaxation_of(sample, slowest)[1].to_dict()
    for key, mask in CHECKS.items():
        inside, total = block_occupancy([(f & mask) == 0 for f in features.flags], sample.blocks)
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        out[key] = estimate(100.0 * float(inside.sum() / total.sum()), draws, sample.blocks.n_blocks).to_dict()
    return out, equivalent_time


def compare_reference(ref: HeldOut, *, seed: int = 0) -> dict[str, Any]:
    """Return what rollouts are compared with: the errors of MD of each length, the replicate baseline (the two runs
    against each other), and the reference's own autocorrelation and relaxation time."""
    found = joint_measure(ref.reference, ref.replicate, ref.replicate, ref.baseline.torsions)
    equivalent_time = None if found is None else equivalent_time_by(*found, seed)
    if equivalent_time is None:
        raise InputError("the references are too short to tell the error of MD; give longer ones.")
    samples = [_sample(features, ref, seed) for features in (ref.reference, ref.replicate)]
    kinetic = [[e.to_dict() for e in relaxation_of(sample)] for sample in samples]
    return {
        "length_ps": ref.length_ps,
        "lengths_ps": list(equivalent_time.lengths_ps),
        "errors": list(equivalent_time.errors),
        "errors_low": list(equivalent_time.errors_low),
        "errors_high": list(equivalent_time.errors_high),
        "replicate_baseline": equivalent_time.errors[-1],
        "correlation": [pair[0] for pair in kinetic],
        "relaxation_ps": [pair[1] for pair in kinetic],
        "slowest": slowest_torsion(samples),
    }


def equivalent_time_row(equivalent_time: EquivalentTime, spent_s: float, md_s_per_ns: float) -> dict[str, Any]:
    """Return how much MD a rollout is worth; what so much MD takes, over `spent_s` (`times_faster`, with the ends of
    its interval); and the error of as many seconds of MD. Nothing is claimed beyond the longest MD at hand."""
    found = asdict(equivalent_time)
    ends = {"": "equivalent_ps", "_low": "low_ps", "_high": "high_ps"}
    share = 1e3 * spent_s / md_s_per_ns / equivalent_time.lengths_ps[-1]
    is_known = share >= equivalent_time.lengths_ps[0] / equivalent_time.lengths_ps[-1]
    return {
        "equivalent_time": {key: found[key] for key in (*ends.values(), "bound")}
        | {"words": equivalent_time.in_words()},
        **{
            f"times_faster{end}": None if found[key] is None else 1e-3 * found[key] * md_s_per_ns / spent_s
            for end, key in ends.items()
        },
        "md_of_same_seconds": equivalent_time.error_at(share) if is_known else None,
    }


def _sample(features: Features, ref: HeldOut, seed: int) -> Sample:
    each = block_length(features.n_frames, longest_correlation(ref.reference))
    return make_sample(features, make_blocks(features.segment_lengths, each), Options(seed=seed), 1)


# ---- effective samples ----------------------------------------------------------------------------------------------


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


def fastest_openmm(md: dict[str, Any]) -> float:
    """Return the processor seconds of a ns of OpenMM at its fastest."""
    return min(float(cost["cpu_s_per_ns"]["mean"]) for cost in md["cost"] if cost["way"] != SIMD)


def effective_row(row: dict[str, Any], tau_ps: float | None, md: dict[str, Any]) -> dict[str, Any]:
    """Return what a measured setting earns: its effective samples a second, and these over those of OpenMM at its
    fastest."""
    slow = md.get("slowest")
    if slow is None:
        return {}
    rate = samples_per_second(row["cpu_s_per_ns"]["mean"], tau_ps, slow["tau_ps"])
    best = 1e3 / fastest_openmm(md) / (2.0 * slow["tau_ps"])
    over_md = None if rate is None else rate / best
    return {"slow_tau_ps": tau_ps, "effective_per_s": rate, "effective_over_md": over_md}


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
