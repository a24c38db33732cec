"""One line of the judge's table, and what all lines of one comparison are computed from."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from surrogate.judge import distributions
from surrogate.judge.statistics import (
    Blocks,
    Estimate,
    bootstrap_weights,
    difference_p,
    estimate,
    permutation_p,
    pooled,
)
from surrogate.judge.structure import Backbone, Features
from systems.scene import Scene
from systems.validity import Geometry

FloatArray = npt.NDArray[np.float64]
Group = Literal["validity", "structure", "populations", "distributions", "kinetics"]
Kind = Literal["share", "distance", "observable"]
Word = Literal["agrees", "close", "differs", "fails", "undecided", "imposed"]

GROUPS: tuple[Group, ...] = ("validity", "structure", "populations", "distributions", "kinetics")


@dataclass(frozen=True)
class Options:
    """Settings of a comparison. `tica_lag_ps` and `lags_ps` are rounded to whole frames, which the rows then name.

    `peptide_recipe`: whether the published recipe is followed too (its 10 states take most of the time of a short
    comparison, and no verdict rests on it).
    """

    tica_lag_ps: float = 10.0
    lags_ps: tuple[float, ...] = (1.0, 10.0, 50.0)
    n_bootstrap: int = 400
    n_permutations: int = 1000
    seed: int = 0
    significance: float = 0.05
    peptide_recipe: bool = True


@dataclass(frozen=True)
class Row:
    """One metric of one candidate, between the reference and its replicate.

    `kind` says how it is judged: a "distance" to the reference stands beside the replicate's, and `ratio` is to that
    floor; an "observable" is compared with the reference's own value, and `ratio` is to that; a "share" is the part of
    frames that pass a check. `statement` puts the deviation in words. `p_value` tests the candidate against reference
    and replicate together, `p_replicate` the replicate against the reference; `p_corrected` is Holm's over all rows.
    """

    key: str
    group: Group
    metric: str
    unit: str
    kind: Kind
    reference: Estimate | None
    candidate: Estimate
    replicate: Estimate | None
    ratio: Estimate | None
    p_value: float
    p_replicate: float
    tolerance: float
    tolerance_text: str
    statement: str
    divergence: tuple[float, float] | None = None
    p_corrected: float = math.nan
    verdict: Word = "undecided"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values; what is not finite becomes None."""
        out: dict[str, Any] = {}
        for key, value in vars(self).items():
            if isinstance(value, Estimate):
                out[key] = value.to_dict()
            elif isinstance(value, float):
                out[key] = value if math.isfinite(value) else None
            elif isinstance(value, tuple):
                out[key] = [x if math.isfinite(x) else None for x in value]
            else:
                out[key] = value
        return out


@dataclass(frozen=True, eq=False)
class Sample:
    """One ensemble as it enters the statistics: features, their blocks, bootstrap weights `(n_draws, n_blocks)`."""

    features: Features
    blocks: Blocks
    weights: FloatArray


@dataclass(frozen=True, eq=False)
class Trio:
    """Reference, candidate and replicate at equal lag and equal frame count, and what they are measured with."""

    scene: Scene
    torsions: Backbone
    geometry: Geometry
    reference: Sample
    candidate: Sample
    replicate: Sample
    options: Options
    temperature_k: float = 300.0

    @property
    def samples(self) -> tuple[Sample, Sample, Sample]:
        """Reference, candidate, replicate."""
        return self.reference, self.candidate, self.replicate


def make_sample(features: Features, blocks: Blocks, options: Options, stream: int) -> Sample:
    """Return a sample with its own stream of bootstrap draws, so that adding a candidate changes no other number."""
    rng = np.random.default_rng([options.seed, stream])
    return Sample(features, blocks, bootstrap_weights(blocks.n_blocks, options.n_bootstrap, rng))


def by_group(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those of one group together, in the order of `GROUPS`; within a group as they came."""
    return sorted(rows, key=lambda row: GROUPS.index(row.group))


def distance_row(
    trio: Trio,
    counts: Sequence[FloatArray],
    *,
    key: str,
    group: Group,
    metric: str,
    statement: Callable[[float], str],
) -> Row:
    """Return the row of a Jensen-Shannon distance from histograms per block of (reference, candidate, replicate).

    `counts`: three arrays `(n_blocks, n_bins)`, or `(n_blocks, n_series, n_bins)` whose distances are averaged.
    `statement(ratio)` words the deviation. The p-values are block permutation tests.
    """
    ref, cand, rep = (c.reshape(len(c), -1, c.shape[-1]) for c in counts)
    # Bins that nobody visits add nothing to any distance.
    visited = sum(c.sum((0, 1)) for c in (ref, cand, rep)) > 0
    ref, cand, rep = ref[..., visited], cand[..., visited], rep[..., visited]
    n_series, n_bins = ref.shape[1:]

    def mean_distance(p: FloatArray, q: FloatArray) -> FloatArray:
        shape = (len(p), n_series, n_bins)
        return np.asarray(distributions.distance(p.reshape(shape), q.reshape(shape)).mean(-1))

    flat = [c.reshape(len(c), -1) for c in (ref, cand, rep)]
    sums = [c.sum(0)[None] for c in flat]
    drawn = [s.weights @ c for s, c in zip(trio.samples, flat, strict=True)]
    to_candidate, to_replicate = float(mean_distance(sums[0], sums[1])[0]), float(mean_distance(sums[0], sums[2])[0])
    draws_candidate, draws_replicate = mean_distance(drawn[0], drawn[1]), mean_distance(drawn[0], drawn[2])
    n_blocks = min(len(c) for c in flat)
    ratio = Estimate(math.nan)
    if to_replicate > 0:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate(to_candidate / to_replicate, draws_candidate / draws_replicate, n_blocks, log=True)
    rng = np.random.default_rng([trio.options.seed, 99])
    n_permutations = trio.options.n_permutations
    p = permutation_p(np.concatenate([flat[0], flat[2]]), flat[1], mean_distance, rng, n_permutations)
    return Row(
        key=key,
        group=group,
        metric=metric,
        unit="",
        kind="distance",
        reference=None,
        candidate=_distance_estimate(to_candidate, draws_candidate, n_blocks),
        replicate=_distance_estimate(to_replicate, draws_replicate, n_blocks),
        ratio=ratio,
        p_value=p if math.isfinite(to_candidate) else math.nan,
        p_replicate=permutation_p(flat[0], flat[2], mean_distance, rng, n_permutations),
        tolerance=2.0,
        tolerance_text="≤ 2 × replicate",
        statement=statement(ratio.value),
        divergence=(to_candidate**2, to_replicate**2) if n_series == 1 else None,
    )


def _distance_estimate(value: float, draws: FloatArray, n_blocks: int) -> Estimate:
    """Intervals are made for the squared distance (a divergence adds up its noise) and then rooted, at least 0."""
    squared = estimate(value**2, draws**2, n_blocks)
    low, high = (math.sqrt(max(x, 0.0)) if math.isfinite(x) else math.nan for x in (squared.low, squared.high))
    error = (high - low) / (2 * 1.96)
    return Estimate(value, low, high, error, error / value if value > 0 else math.nan, n_blocks)


def observable_row(
    trio: Trio,
    values: Sequence[float],
    draws: Sequence[FloatArray],
    *,
    key: str,
    group: Group,
    metric: str,
    unit: str,
    tolerance: float,
    tolerance_text: str,
    statement: Callable[[float, float], str],
    log: bool = False,
    resolution: float = 0.0,
) -> Row:
    """Return the row of a number that each trajectory has by itself.

    `values` and bootstrap `draws` are of (reference, candidate, replicate). With `log` it is a positive, skewed number
    and `tolerance` is relative; else absolute. A difference below `resolution` is not a physical one (rounding of
    files, tolerance of constraint solvers) and never significant. `statement(candidate, reference)` words the
    deviation.
    """
    made = [estimate(v, d, s.blocks.n_blocks, log=log) for v, d, s in zip(values, draws, trio.samples, strict=True)]
    ref, cand, rep = made
    both = pooled(ref, rep, log=log) if math.isfinite(rep.value) else ref
    ratio = Estimate(math.nan)
    if ref.value > 2.0 * ref.error:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate(cand.value / ref.value, draws[1] / draws[0], min(ref.n_blocks, cand.n_blocks), log=log)
    return Row(
        key=key,
        group=group,
        metric=metric,
        unit=unit,
        kind="observable",
        reference=ref,
        candidate=cand,
        replicate=rep,
        ratio=ratio,
        p_value=1.0 if abs(cand.value - ref.value) < resolution else difference_p(cand, both, log=log),
        p_replicate=1.0 if abs(rep.value - ref.value) < resolution else difference_p(rep, ref, log=log),
        tolerance=tolerance * ref.value if log else tolerance,
        tolerance_text=tolerance_text,
        statement=statement(cand.value, ref.value),
    )
