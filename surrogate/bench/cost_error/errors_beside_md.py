"""Errors of one rollout against held-out reference, with error bars, and its worth in MD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.bench.cost_error.effective_samples import slowest_torsion
from surrogate.bench.rolling import Frames
from surrogate.bench.stress.frame_statistics import HALF_ANGSTROM_RULE, measure_bonds
from surrogate.judge.measure.distributions import block_occupancy
from surrogate.judge.measure.slow_motion import longest_correlation
from surrogate.judge.measure.statistics import block_length, estimate, make_blocks
from surrogate.judge.measure.structure import Features, Yardstick, backbone
from surrogate.judge.read.ensemble import Ensemble, load_ensemble
from surrogate.judge.rows.relaxation_rows import relaxation_of
from surrogate.judge.rows.rows import Options, Sample, make_sample
from surrogate.judge.worth import Worth, distance_to_truth, errors_by_length, worth_by
from surrogate.judge.worth_measures import joint_measure
from systems.chemistry.validity import BOND_20_PERCENT, INVALID, NOT_FINITE
from systems.errors import InputError
from systems.scene import Scene

CHECKS = {
    "valid_half_angstrom_%": HALF_ANGSTROM_RULE,
    "bonds_20_percent_%": NOT_FINITE | BOND_20_PERCENT,
    "valid_all_%": INVALID,
}


@dataclass(frozen=True, eq=False)
class Truth:
    """Held-out reference and its replicate, measured once. `length_ps`: of each, as far as they are compared."""

    scene: Scene
    yardstick: Yardstick
    reference: Features
    replicate: Features

    @property
    def length_ps(self) -> float:
        return min(self.reference.total_ps, self.replicate.total_ps)


def read_truth(
    scene: Scene, reference: Sequence[Path], replicate: Sequence[Path], lag_ps: float | None = None
) -> Truth:
    """Measure two held-out runs of `scene`, atoms in its order, frames `lag_ps` apart or all. Raises InputError for a
    scene without φ and ψ."""
    if not backbone(scene).residues:
        raise InputError(f"{scene.name} has no residue with φ and ψ, by whose map errors are measured here.")
    first, second = (load_ensemble(paths, template=scene) for paths in (reference, replicate))
    if lag_ps is not None:
        first, second = (run.strided(max(1, round(lag_ps / run.lag_ps))) for run in (first, second))
    yardstick = Yardstick.of(first, probing=False)
    return Truth(scene, yardstick, yardstick.measure(first), yardstick.measure(second))


def judge_frames(
    frames: Frames, truth: Truth, *, seed: int = 0, slowest: int | None = None
) -> tuple[dict[str, Any], Worth]:
    """Return what replicas `(rows, n_frames, n_atoms, 3)` nm get wrong, JSON-able, and their worth by the φ/ψ map.

    `jsd`: Jensen-Shannon distance of the joint φ/ψ histograms (50 x 50, overflow bins), the root mean square of those
    to the two held-out runs; `curve`: the same of parts of the rollout, (ps, distance); shares of valid frames; the
    autocorrelation of cos ψ after one frame and its relaxation time; bonds (stress_measures.measure_bonds). Numbers
    with intervals are dictionaries of `judge.statistics.Estimate`. `slow_relaxation_ps`: of the torsion `slowest`,
    where one is named (effective_samples). Raises InputError where frames are too few.
    """
    rolled = Ensemble("rollout", [x.astype(np.float32) for x in frames], truth.reference.lag_ps, truth.scene)
    features = truth.yardstick.measure(rolled)
    found = joint_measure(truth.reference, features, truth.replicate, truth.yardstick.torsions)
    worth = None if found is None else worth_by(*found, seed)
    if found is None or worth is None:
        raise InputError("too few frames to tell an error; give longer references, or a longer `time_ps`.")
    sample = _sample(features, truth, seed)
    correlation, relaxation = relaxation_of(sample)
    out: dict[str, Any] = {
        "jsd": distance_to_truth(found[0], seed).to_dict(),
        "curve": np.stack(errors_by_length(found[0], features.total_ps), axis=1).tolist(),
        "correlation": correlation.to_dict(),
        "relaxation_ps": relaxation.to_dict(),
        **measure_bonds(np.concatenate(list(frames)), truth.yardstick.geometry),
    }
    if slowest is not None:
        out["slow_relaxation_ps"] = relaxation_of(sample, slowest)[1].to_dict()
    for key, mask in CHECKS.items():
        inside, total = block_occupancy([(f & mask) == 0 for f in features.flags], sample.blocks)
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        out[key] = estimate(100.0 * float(inside.sum() / total.sum()), draws, sample.blocks.n_blocks).to_dict()
    return out, worth


def judge_truth(truth: Truth, *, seed: int = 0) -> dict[str, Any]:
    """Return what stands beside the rollouts: the errors of MD of each length, the floor (the two runs against each
    other), and the reference's own autocorrelation and relaxation time."""
    found = joint_measure(truth.reference, truth.replicate, truth.replicate, truth.yardstick.torsions)
    worth = None if found is None else worth_by(*found, seed)
    if worth is None:
        raise InputError("the references are too short to tell the error of MD; give longer ones.")
    samples = [_sample(features, truth, seed) for features in (truth.reference, truth.replicate)]
    kinetic = [[e.to_dict() for e in relaxation_of(sample)] for sample in samples]
    return {
        "length_ps": truth.length_ps,
        "lengths_ps": list(worth.lengths_ps),
        "errors": list(worth.errors),
        "errors_low": list(worth.errors_low),
        "errors_high": list(worth.errors_high),
        "floor": worth.errors[-1],
        "correlation": [pair[0] for pair in kinetic],
        "relaxation_ps": [pair[1] for pair in kinetic],
        "slowest": slowest_torsion(samples),
    }


def worth_row(worth: Worth, spent_s: float, md_s_per_ns: float) -> dict[str, Any]:
    """Return how much MD a rollout is worth; what so much MD takes, over `spent_s` (`times_faster`, with the ends of
    its interval); and the error of as many seconds of MD. Nothing is claimed beyond the longest MD at hand."""
    ends = {"": worth.worth_ps, "_low": worth.low_ps, "_high": worth.high_ps}
    faster = {
        f"times_faster{end}": None if ps is None else 1e-3 * ps * md_s_per_ns / spent_s for end, ps in ends.items()
    }
    share = 1e3 * spent_s / md_s_per_ns / worth.lengths_ps[-1]
    keys = ("worth_ps", "low_ps", "high_ps", "bound")
    return {
        "worth": {key: value for key, value in asdict(worth).items() if key in keys} | {"words": worth.in_words()},
        **faster,
        "md_of_same_seconds": worth.error_at(share) if share >= worth.lengths_ps[0] / worth.lengths_ps[-1] else None,
    }


def _sample(features: Features, truth: Truth, seed: int) -> Sample:
    each = block_length(features.n_frames, longest_correlation(truth.reference))
    return make_sample(features, make_blocks(features.segment_lengths, each), Options(seed=seed), 1)
