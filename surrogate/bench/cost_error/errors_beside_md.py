"""Errors of one rollout against held-out reference, with error bars, and its equivalent MD time in MD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.bench.cost_error.effective_samples import slowest_torsion
from surrogate.bench.rolling import Frames
from surrogate.bench.stress.frame_statistics import HALF_ANGSTROM_RULE, measure_bonds
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
from surrogate.comparison.rows.kinetics_rows import relaxation_of
from surrogate.comparison.rows.rows import Options, Sample, make_sample
from systems.chemistry.validity import BOND_20_PERCENT, INVALID, NOT_FINITE
from systems.errors import InputError
from systems.scene import Scene

CHECKS = {
    "valid_half_angstrom_%": HALF_ANGSTROM_RULE,
    "bonds_20_percent_%": NOT_FINITE | BOND_20_PERCENT,
    "valid_all_%": INVALID,
}


@dataclass(frozen=True, eq=False)
class ReferenceForces:
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
) -> ReferenceForces:
    """Measure two held-out runs of `scene`, atoms in its order, frames `lag_ps` apart or all. Raises InputError for a
    scene without φ and ψ."""
    if not backbone(scene).residues:
        raise InputError(f"{scene.name} has no residue with φ and ψ, by whose map errors are measured here.")
    first, second = (load_ensemble(paths, template=scene) for paths in (reference, replicate))
    if lag_ps is not None:
        first, second = (run.strided(max(1, round(lag_ps / run.lag_ps))) for run in (first, second))
    baseline = Baseline.of(first, probing=False)
    return ReferenceForces(scene, baseline, baseline.measure(first), baseline.measure(second))


def compare_frames(
    frames: Frames, ref: ReferenceForces, *, seed: int = 0, slowest: int | None = None
) -> tuple[dict[str, Any], EquivalentTime]:
    """Return what replicas `(rows, n_frames, n_atoms, 3)` nm get wrong, JSON-able, and their equivalent MD time by the
    φ/ψ map.

    `jsd`: Jensen-Shannon distance of the joint φ/ψ histograms (50 x 50, overflow bins), the root mean square of those
    to the two held-out runs; `curve`: the same of parts of the rollout, (ps, distance); shares of valid frames; the
    autocorrelation of cos ψ after one frame and its relaxation time; bonds (stress_measures.measure_bonds). Numbers
    with intervals are dictionaries of `comparison.statistics.Estimate`. `slow_relaxation_ps`: of the torsion `slowest`,
    where one is named (effective_samples). Raises InputError where frames are too few.
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


def compare_reference(ref: ReferenceForces, *, seed: int = 0) -> dict[str, Any]:
    """Return what stands beside the rollouts: the errors of MD of each length, the replicate baseline (the two runs
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
    ends = {"": equivalent_time.equivalent_ps, "_low": equivalent_time.low_ps, "_high": equivalent_time.high_ps}
    faster = {
        f"times_faster{end}": None if ps is None else 1e-3 * ps * md_s_per_ns / spent_s for end, ps in ends.items()
    }
    share = 1e3 * spent_s / md_s_per_ns / equivalent_time.lengths_ps[-1]
    keys = ("equivalent_ps", "low_ps", "high_ps", "bound")
    return {
        "equivalent_time": {key: value for key, value in asdict(equivalent_time).items() if key in keys}
        | {"words": equivalent_time.in_words()},
        **faster,
        "md_of_same_seconds": equivalent_time.error_at(share)
        if share >= equivalent_time.lengths_ps[0] / equivalent_time.lengths_ps[-1]
        else None,
    }


def _sample(features: Features, ref: ReferenceForces, seed: int) -> Sample:
    each = block_length(features.n_frames, longest_correlation(ref.reference))
    return make_sample(features, make_blocks(features.segment_lengths, each), Options(seed=seed), 1)
