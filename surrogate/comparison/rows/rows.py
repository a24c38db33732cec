"""One line of the comparison's table, and what all lines of one comparison are computed from."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.distributions import Bins
from surrogate.comparison.measure.statistics import (
    Blocks,
    Estimate,
    bootstrap_weights,
    difference_p,
    estimate,
    permutation_p,
    pooled,
)
from surrogate.comparison.measure.structure import Backbone, Features
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import Chart, Histogram, jsonable
from systems.chemistry.validity import Geometry
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps

FloatArray = npt.NDArray[np.float64]
Series = Sequence[Sequence[npt.NDArray[Any]]]
Group = Literal["validity", "structure", "populations", "distributions", "kinetics"]
Form = Literal["share", "distance", "observable"]
Kind = Literal["validity", "distribution", "kinetics", "information"]
# The slowest motion that a row depends on: vibrations and faults of frames; a step from frame to frame; what moves
# within a state of the slow motion; the slow motion itself.
TimeScale = Literal["fast", "step", "within states", "slow"]
Word = Literal["agrees", "close", "differs", "fails", "undecided"]

# A replicate this unlikely to be of one simulation with the reference does not speak for it.
UNLIKE_BELOW = 1e-3
# Of a lag, to tell anything at it.
LEAST_LAGS = 10
# A population within this factor is 1 kJ/mol away at 300 K.
ONE_KJ_FACTOR = math.exp(1.0 / (GAS_CONSTANT_KJ_MOL_K * 300.0))
# Histograms drawn at a time, as numbers: a hundred MB or so.
_DRAWN_VALUES = 4e6

GROUPS: tuple[Group, ...] = ("validity", "structure", "populations", "distributions", "kinetics")


@dataclass(frozen=True)
class Options:
    """Settings of a comparison. `tica_lag_ps` is rounded to whole frames, which the rows then name.

    `peptide_recipe`: whether the published recipe is followed too (its 10 states take most of the time of a short
    comparison, and no verdict rests on it).
    """

    tica_lag_ps: float = 10.0
    n_bootstrap: int = 400
    n_permutations: int = 1000
    seed: int = 0
    significance: float = 0.05
    peptide_recipe: bool = True


@dataclass(frozen=True)
class Quantity:
    """What one row is about: its key and group, its name and unit for people, and the deviation that is tolerated.

    `tolerance` is in `unit`; of a positive, skewed number, such as a time or a width (`relative`), it is a share of the
    reference's value, and logarithms are compared. `tolerance_text` says it where that takes other words. A difference
    below `resolution`, in `unit`, is not a physical one (rounding of files, tolerance of constraint solvers) and never
    significant. Numbers in % are shares: their intervals end at 0 and 100.
    """

    key: str
    group: Group
    name: str
    unit: str
    tolerance: float
    tolerance_text: str = ""
    relative: bool = False
    resolution: float = 0.0

    def tolerance_words(self) -> str:
        """Return such as '0.4 Hz', or '20 %' of a relative one."""
        return f"{100 * self.tolerance:g} %" if self.relative else f"{self.tolerance:g} {self.unit}".rstrip()


Skipped = tuple[str, str]


class Measured(NamedTuple):
    """What one metric finds: rows of the table, charts, and what it left out, each with the reason."""

    rows: Sequence[Row] = ()
    charts: Sequence[Chart] = ()
    skipped: Sequence[Skipped] = ()


@dataclass(frozen=True)
class Row:
    """One metric of one candidate, between the reference and its replicate.

    `form` says how it is evaluated: a "distance" to the reference stands beside the replicate's, and `ratio` is to that
    replicate baseline; an "observable" is compared with the reference's own value, and `ratio` is to that; a "share" is
    the part of frames that pass a check. `statement` puts the deviation in words. `p_value` tests the candidate against
    reference and replicate together, `p_replicate` the replicate against the reference; `p_corrected` is Holm's over
    all rows.
    `kind` and `time_scale` are those of the `Metric` that measured it.
    """

    key: str
    group: Group
    metric: str
    unit: str
    form: Form
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
    kind: Kind = "distribution"
    time_scale: TimeScale = "slow"

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values; what is not finite becomes None."""
        return {name: jsonable(value) for name, value in vars(self).items()}


@dataclass(frozen=True, eq=False)
class Sample:
    """One ensemble as it enters the statistics: features, their blocks, bootstrap weights `(n_draws, n_blocks)`.

    Tests use all blocks. What depends on the length itself (a histogram's distance, the replicate baseline) uses the
    first `n_equal` blocks alone, which are as long as those of the other trajectories.
    """

    features: Features
    blocks: Blocks
    weights: FloatArray
    n_equal: int
    equal_weights: FloatArray


@dataclass(frozen=True, eq=False)
class ComparisonInput:
    """Reference, candidate and replicate at equal lag and equal frame count, and what they are measured with.

    `recipes`: what the published recipe fitted on the reference, by the number of its frames; the candidates of one
    comparison share it. `trajectories`: reference, candidate and replicate (None where there is none) whole, as they
    were read.
    """

    scene: Scene
    torsions: Backbone
    geometry: Geometry
    reference: Sample
    candidate: Sample
    replicate: Sample
    options: Options
    temperature_k: float = 300.0
    recipes: dict[int, Any] = field(default_factory=dict)
    trajectories: tuple[Ensemble, Ensemble, Ensemble | None] | None = None

    @property
    def compared_ps(self) -> float:
        """The equal length, ps."""
        return min(s.features.total_ps for s in self.samples)

    @property
    def samples(self) -> tuple[Sample, Sample, Sample]:
        """Reference, candidate, replicate."""
        return self.reference, self.candidate, self.replicate


def make_sample(
    features: Features, blocks: Blocks, options: Options, stream: int, n_equal_frames: int | None = None
) -> Sample:
    """Return a sample with its own stream of bootstrap draws, so that adding a candidate changes no other number.

    `n_equal_frames`: the length that all trajectories of the comparison have; None for the whole.
    """
    rng = np.random.default_rng([options.seed, stream])
    n = blocks.n_blocks
    if n_equal_frames is not None and n_equal_frames < features.n_frames:
        n = max(min(round(n * n_equal_frames / features.n_frames), n), 1)
    weights = bootstrap_weights(blocks.n_blocks, options.n_bootstrap, rng)
    equal = weights if n == blocks.n_blocks else bootstrap_weights(n, options.n_bootstrap, rng)
    return Sample(features, blocks, weights, n, equal)


def too_short(trajectories: Sequence[Features], lag_frames: float) -> str:
    """Return why nothing is estimated at this lag, in words: a trajectory has no unbroken stretch of `LEAST_LAGS` lags.
    Empty where all have one."""
    longest = min(max(f.segment_lengths) for f in trajectories)
    if longest >= LEAST_LAGS * lag_frames:
        return ""
    lag_ps = trajectories[0].lag_ps
    needed, held = (format_time_ps(n * lag_ps, 3) for n in (LEAST_LAGS * lag_frames, longest))
    return f"it takes {needed} without a break, {LEAST_LAGS} lags, and one of the trajectories holds {held}"


def by_group(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those of one group together, in the order of `GROUPS`; within a group as they came."""
    return sorted(rows, key=lambda row: GROUPS.index(row.group))


def distance_row(
    inputs: ComparisonInput,
    counts: Sequence[FloatArray],
    *,
    key: str,
    group: Group,
    metric: str,
    statement: Callable[[float], str],
    strata: Sequence[npt.NDArray[np.int64]] | None = None,
) -> Row:
    """Return the row of a Jensen-Shannon distance from histograms per block of (reference, candidate, replicate).

    `counts`: three arrays `(n_blocks, n_bins)`, or `(n_blocks, n_series, n_bins)` whose distances are averaged.
    `statement(ratio)` words the deviation. Distances are those of equal lengths; the p-values are block permutation
    tests of everything there is. A replicate that differs from the reference does not speak for it: the candidate is
    then tested against the reference alone. `strata`: the kind of each block of the three; only blocks of one kind are
    exchanged.
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
    equal = [c[: s.n_equal] for s, c in zip(inputs.samples, flat, strict=True)]
    sums = [c.sum(0)[None] for c in equal]
    to_candidate, to_replicate = float(mean_distance(sums[0], sums[1])[0]), float(mean_distance(sums[0], sums[2])[0])
    draws_candidate, draws_replicate = drawn_distances(inputs, equal, mean_distance)
    n_blocks = min(len(c) for c in equal)
    ratio = Estimate(math.nan)
    if to_replicate > 0:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate(to_candidate / to_replicate, draws_candidate / draws_replicate, n_blocks, log=True)
    p, p_replicate = permutation_pair(inputs, flat, mean_distance, 99, strata)
    return Row(
        key=key,
        group=group,
        metric=metric,
        unit="",
        form="distance",
        reference=None,
        candidate=_distance_estimate(to_candidate, draws_candidate, n_blocks),
        replicate=_distance_estimate(to_replicate, draws_replicate, n_blocks),
        ratio=ratio,
        p_value=p if math.isfinite(to_candidate) else math.nan,
        p_replicate=p_replicate,
        tolerance=2.0,
        tolerance_text="≤ 2 × replicate",
        statement=statement(ratio.value) if math.isfinite(ratio.value) else f"{metric}: not as in the reference",
        divergence=(to_candidate**2, to_replicate**2) if n_series == 1 else None,
    )


def series_distance(inputs: ComparisonInput, series: Series, bins: Bins, key: str, name: str, group: Group) -> Row:
    """Return the Jensen-Shannon distance row of one series `(n,)` per segment and sample."""
    counts = [distributions.block_counts(v, bins, s.blocks) for s, v in zip(inputs.samples, series, strict=True)]
    low = name if name[1:2].isupper() else name[0].lower() + name[1:]
    return distance_row(
        inputs,
        counts,
        key=key,
        group=group,
        metric=f"{name}, distance",
        statement=lambda ratio: f"the distribution of {low} is {ratio:.2g} times as far off as a replicate's",
    )


def mean_distance(
    inputs: ComparisonInput,
    segments: Sequence[Sequence[npt.NDArray[Any]]],
    bins: Sequence[Bins],
    key: str,
    name: str,
    group: Group,
    groups: Sequence[npt.NDArray[np.intp]] | None = None,
) -> Row:
    """Return the row of the mean Jensen-Shannon distance over the columns `(n, k)`, one `Bins` each.

    With `groups` of equal columns, one histogram and one `Bins` a group.
    """
    chosen = [np.array([k]) for k in range(len(bins))] if groups is None else groups
    counts = [
        np.stack([distributions.grouped_counts(v, g, own, s.blocks) for g, own in zip(chosen, bins, strict=True)], 1)
        for s, v in zip(inputs.samples, segments, strict=True)
    ]
    what = f"{name}, distance" if len(bins) == 1 else f"{name}, mean distance of {len(bins)}"
    low = name[0].lower() + name[1:]
    return distance_row(
        inputs,
        counts,
        key=key,
        group=group,
        metric=what,
        statement=lambda ratio: f"{low}: distributions {ratio:.2g} times as far off as a replicate's",
    )


def histogram(inputs: ComparisonInput, series: Series, bins: Bins, label: str, unit: str) -> Histogram:
    """Return the densities of (reference, candidate, replicate), normalised over all frames, in range or not."""
    width = (bins.high - bins.low) / bins.n
    densities, outside = [], []
    for sample, segments in zip(inputs.samples, series, strict=True):
        counts = distributions.block_counts(segments, bins, sample.blocks).sum(0)
        densities.append(counts[: bins.n] / counts.sum() / width)
        outside.append(float(counts[bins.n :].sum() / counts.sum()))
    ref, cand, rep = densities
    return Histogram(label, unit, bins.edges, ref, cand, rep, (outside[0], outside[1], outside[2]))


Distance = Callable[[FloatArray, FloatArray], FloatArray]


def drawn_distances(
    inputs: ComparisonInput, equal: Sequence[FloatArray], distance: Distance
) -> tuple[FloatArray, FloatArray]:
    """Return bootstrap draws `(n_draws,)` of the distances of candidate and replicate to the reference.

    `equal`: sums over the equally long parts of (reference, candidate, replicate), `(n_blocks, n_sums)`.
    """
    found: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    n_draws = inputs.options.n_bootstrap
    batch = max(1, int(_DRAWN_VALUES // max(equal[0].shape[1], 1)))
    for start in range(0, n_draws, batch):
        ref, cand, rep = (
            s.equal_weights[start : start + batch] @ c for s, c in zip(inputs.samples, equal, strict=True)
        )
        found[0].append(distance(ref, cand))
        found[1].append(distance(ref, rep))
    return np.concatenate(found[0]), np.concatenate(found[1])


def permutation_pair(
    inputs: ComparisonInput,
    flat: Sequence[FloatArray],
    distance: Distance,
    stream: int,
    strata: Sequence[npt.NDArray[np.int64]] | None = None,
) -> tuple[float, float]:
    """Return the p-values of the candidate and of the replicate by block permutation; see `distance_row`.

    `flat`: sums over all blocks of (reference, candidate, replicate), `(n_blocks, n_sums)`.
    """
    ref, cand, rep = flat
    n = inputs.options.n_permutations
    rng = np.random.default_rng([inputs.options.seed, stream])
    kinds = [np.zeros(len(c), dtype=np.int64) for c in flat] if strata is None else strata
    of_replicate = permutation_p(ref, rep, distance, rng, n, np.concatenate([kinds[0], kinds[2]]))
    source = [0] if of_replicate < UNLIKE_BELOW else [0, 2]
    p = permutation_p(
        np.concatenate([flat[k] for k in source]),
        cand,
        distance,
        rng,
        n,
        np.concatenate([*(kinds[k] for k in source), kinds[1]]),
    )
    return p, of_replicate


def reference_of(reference: Estimate, replicate: Estimate, *, log: bool = False) -> Estimate:
    """Return what a candidate is tested against: reference and replicate together, or the reference alone where the
    replicate is not known or differs from it."""
    if not math.isfinite(replicate.value) or difference_p(replicate, reference, log=log) < UNLIKE_BELOW:
        return reference
    return pooled(reference, replicate, log=log)


def _distance_estimate(value: float, draws: FloatArray, n_blocks: int) -> Estimate:
    """Intervals are made for the squared distance (a divergence adds up its noise) and then rooted, at least 0."""
    squared = estimate(value**2, draws**2, n_blocks)
    low, high = (math.sqrt(max(x, 0.0)) if math.isfinite(x) else math.nan for x in (squared.low, squared.high))
    error = (high - low) / (2 * 1.96)
    return Estimate(value, low, high, error, error / value if value > 0 else math.nan, n_blocks)


def observable_row(
    inputs: ComparisonInput,
    metric: Quantity,
    values: Sequence[float],
    draws: Sequence[FloatArray],
    statement: Callable[[float, float], str],
) -> Row:
    """Return the row of a number that each trajectory has by itself.

    `values` and bootstrap `draws` `(n_draws,)` are of (reference, candidate, replicate), in the metric's unit.
    `statement(candidate, reference)` words the deviation.
    """
    log = metric.relative
    made = [estimate(v, d, s.blocks.n_blocks, log=log) for v, d, s in zip(values, draws, inputs.samples, strict=True)]
    if metric.unit == "%":
        made = [replace(e, low=max(e.low, 0.0), high=min(e.high, 100.0)) for e in made]
    ref, cand, rep = made
    both = reference_of(ref, rep, log=log)
    ratio = Estimate(math.nan)
    if ref.value > 2.0 * ref.error:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate(cand.value / ref.value, draws[1] / draws[0], min(ref.n_blocks, cand.n_blocks), log=log)
    near, near_replicate = (abs(e.value - ref.value) < metric.resolution for e in (cand, rep))
    return Row(
        key=metric.key,
        group=metric.group,
        metric=metric.name,
        unit=metric.unit,
        form="observable",
        reference=ref,
        candidate=cand,
        replicate=rep,
        ratio=ratio,
        p_value=1.0 if near else difference_p(cand, both, log=log),
        p_replicate=1.0 if near_replicate else difference_p(rep, ref, log=log),
        tolerance=metric.tolerance * ref.value if log else metric.tolerance,
        tolerance_text=metric.tolerance_text or f"± {metric.tolerance_words()}",
        statement=statement(cand.value, ref.value) if math.isfinite(cand.value) else f"{metric.name}: it does not move",
    )
