"""Errors of one rollout against held-out reference, with error bars, its equivalent MD time, and effective samples.

Effective samples are simulated time over 2 max(τ_model, τ_MD), τ the relaxation time of the slowest torsion of which
the MD at hand holds at least 50: a model that forgets too fast gains nothing by it, and one that forgets too slowly
loses. They say nothing of whether the samples are right; that is the distance beside them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.bench.timing import SIMD, Frames
from surrogate.comparison.equivalent_time import (
    EquivalentTime,
    distance_to_reference,
    equivalent_time_by,
    joint_measure,
)
from surrogate.comparison.measure.distributions import block_occupancy
from surrogate.comparison.measure.slow_motion import longest_correlation
from surrogate.comparison.measure.statistics import block_length, estimate, make_blocks
from surrogate.comparison.measure.structure import Baseline, Features, backbone
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.kinetics_rows import relaxation_of, turning
from surrogate.comparison.rows.rows import Options, Sample, make_sample
from systems.chemistry.validity import BOND_20_PERCENT, BOND_HALF_ANGSTROM, NOT_FINITE
from systems.errors import InputError
from systems.scene import Scene
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

CHECKS = {
    "valid_half_angstrom_%": NOT_FINITE | BOND_HALF_ANGSTROM,
    "bonds_20_percent_%": NOT_FINITE | BOND_20_PERCENT,
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
    to the two held-out runs; shares of valid frames; the autocorrelation of cos ψ after one frame and its relaxation
    time. Numbers with intervals are dictionaries of `comparison.statistics.Estimate`. `slow_relaxation_ps`: of the
    torsion `slowest`, where one is named (`slowest_torsion`). Raises InputError where frames are too few.
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
        "correlation": correlation.to_dict(),
        "relaxation_ps": relaxation.to_dict(),
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
    """Return the equivalent MD time of a rollout; what so much MD takes, over `spent_s` (`times_faster`, with the ends
    of its interval); and the error of as many seconds of MD, None where that is shorter than any MD at hand."""
    row: dict[str, Any] = {"equivalent_time": {"words": equivalent_time.in_words(), "bound": equivalent_time.bound}}
    for end, name in (("", "equivalent_ps"), ("_low", "low_ps"), ("_high", "high_ps")):
        time_ps = getattr(equivalent_time, name)
        row["equivalent_time"][name] = time_ps
        row[f"times_faster{end}"] = None if time_ps is None else 1e-3 * time_ps * md_s_per_ns / spent_s
    md_ps = 1e3 * spent_s / md_s_per_ns
    is_at_hand = md_ps >= equivalent_time.lengths_ps[0]
    row["md_of_same_seconds"] = equivalent_time.error_at(md_ps / equivalent_time.lengths_ps[-1]) if is_at_hand else None
    return row


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
    enough = [one for one in found if one["samples"] >= LEAST_SAMPLES]
    return max(enough, key=lambda one: float(one["tau_ps"])) if enough else None


def samples_per_second(cpu_s_per_ns: float, tau_ps: float | None, md_tau_ps: float) -> float | None:
    """Return effective samples a processor second; None where the model's own relaxation time is not known."""
    if tau_ps is None or not math.isfinite(tau_ps):
        return None
    return 1e3 / cpu_s_per_ns / (2.0 * max(tau_ps, md_tau_ps))


def effective_row(row: dict[str, Any], md: dict[str, Any]) -> dict[str, Any]:
    """Return the effective samples a second of a setting that was rolled (`row`), and these over those of OpenMM."""
    slow = md.get("slowest")
    if slow is None or "slow_relaxation_ps" not in row:
        return {}
    rate = samples_per_second(row["cpu_s_per_ns"]["mean"], row["slow_relaxation_ps"]["value"], slow["tau_ps"])
    md_s_per_ns = next(cost["cpu_s_per_ns"]["mean"] for cost in md["cost"] if cost["way"] != SIMD)
    over_md = None if rate is None else rate * md_s_per_ns * 2e-3 * slow["tau_ps"]
    return {"effective_per_s": rate, "effective_over_md": over_md}


# ---- held-out reference ---------------------------------------------------------------------------------------------


def refuse_trained_on(
    weights: Weights, reference: Sequence[Path], replicate: Sequence[Path], *, lag_ps: float | None = None
) -> list[str]:
    """Raise InputError unless weights never saw these trajectories; return the fingerprints of their frames.

    Refused are: frames named in the provenance of the weights, of those they began from and so on; a run of the
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
    for key, value in frames.conditions.items():
        if value != domain.conditions.get(key):
            raise InputError(
                f"{reference[0]} has {key} {value}, {name} was trained for {domain.conditions.get(key)}: no reference "
                "to compare it with."
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
