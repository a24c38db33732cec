"""One line of the comparison's table, what all lines of one comparison are computed from, and how each kind is made:
of a distance between histograms, of a number that each trajectory has by itself, of the column that is furthest off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.distributions import Bins
from surrogate.comparison.measure.statistics import (
    Blocks,
    Estimate,
    FloatArray,
    IntArray,
    Segments,
    bootstrap_weights,
    difference_p,
    estimate,
    mean_estimate,
    permutation_p,
    pooled,
)
from surrogate.comparison.measure.structure import Backbone, Family, Features, Groups, Probes, over_groups
from surrogate.comparison.rows.charts import Chart, Histogram
from systems.chemistry.validity import Geometry
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps

# Of (reference, candidate, replicate).
Three = Sequence[Segments]
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
# The share that a population changes by at 1 kJ/mol and 300 K.
ONE_KJ_SHARE = 1.0 - 1.0 / math.exp(1.0 / (GAS_CONSTANT_KJ_MOL_K * 300.0))
# Histograms drawn at a time, as numbers: a hundred MB or so.
_DRAWN_VALUES = 4e6

GROUPS: tuple[Group, ...] = ("validity", "structure", "populations", "distributions", "kinetics")


@dataclass(frozen=True)
class Options:
    """Settings of a comparison. `peptide_recipe`: whether the published recipe is followed too (it takes most of the
    time of a short comparison, and no verdict rests on it)."""

    n_bootstrap: int = 400
    n_permutations: int = 1000
    seed: int = 0
    peptide_recipe: bool = True


@dataclass(frozen=True)
class Quantity:
    """What one row is about: its key and group, its name and unit for people, and the deviation that is tolerated.

    `tolerance` is in `unit`; of a positive, skewed number, such as a time or a width (`relative`), it is a share of the
    reference's value, and logarithms are compared. `tolerance_text` says it where that takes other words. A difference
    below `resolution`, in `unit`, is not a physical one (rounding of files, tolerance of constraint solvers) and never
    significant. Numbers in % are shares: their intervals end at 0 and 100. `hint` ends the words for a deviation.
    """

    key: str
    group: Group
    name: str
    unit: str
    tolerance: float
    tolerance_text: str = ""
    relative: bool = False
    resolution: float = 0.0
    hint: str = ""

    def tolerance_words(self) -> str:
        """Return such as '0.4 Hz', or '20 %' of a relative one."""
        return f"{100 * self.tolerance:g} %" if self.relative else f"{self.tolerance:g} {self.unit}".rstrip()

    def deviation(self, candidate: float, reference: float, where: str = "") -> str:
        """Return such as 'radius of gyration, mean: 3.1 Å instead of 3.4 Å'."""
        name = lower_first(self.name) + (f", {where}" if where else "")
        if not math.isfinite(candidate):
            return f"{name}: {'it does not move' if self.unit == 'ps' else 'not defined'}"
        digits = 3 if f"{candidate:.3g}" != f"{reference:.3g}" else 5
        shown = (f"{x:.{digits}g}{'' if self.unit == '°' else ' '}{self.unit}".rstrip() for x in (candidate, reference))
        return f"{name}: {' instead of '.join(shown)}{self.hint}"


Skipped = tuple[str, str]


class Measured(NamedTuple):
    """What one metric finds: rows of the table, charts, and what it left out, each with the reason."""

    rows: Sequence[Row] = ()
    charts: Sequence[Chart] = ()
    skipped: Sequence[Skipped] = ()


def left_out(name: str, why: str) -> Measured:
    """Return a metric that finds nothing, and why."""
    return Measured(skipped=[(name, why)])


@dataclass(frozen=True, kw_only=True)
class Row:
    """One metric of one candidate, between the reference and its replicate.

    `form`: a "distance" to the reference is compared with the replicate's, and `ratio` is to that; an "observable" is
    compared with the reference's own value, and `ratio` is to that; a "share" is the part of frames that pass a check.
    `statement` puts the deviation in words. `p_value` tests the candidate against reference and replicate together,
    `p_replicate` the replicate against the reference; `p_corrected` is Holm's over all rows. `kind` and `time_scale`
    are those of the `Metric` that measured it.
    """

    key: str
    group: Group
    metric: str
    unit: str = ""
    form: Form
    reference: Estimate | None = None
    candidate: Estimate
    replicate: Estimate | None = None
    ratio: Estimate | None = None
    p_value: float
    p_replicate: float = math.nan
    tolerance: float
    tolerance_text: str
    statement: str
    divergence: tuple[float, float] | None = None
    p_corrected: float = math.nan
    verdict: Word = "undecided"
    kind: Kind = "distribution"
    time_scale: TimeScale = "slow"


class Sample(NamedTuple):
    """One ensemble as it enters the statistics: features, their blocks, bootstrap weights `(n_draws, n_blocks)`. Tests
    use all blocks; what depends on the length itself (a histogram's distance, the replicate baseline) the first
    `n_equal` alone, which are as long as those of the other trajectories."""

    features: Features
    blocks: Blocks
    weights: FloatArray
    n_equal: int
    equal_weights: FloatArray

    def family(self, family: Family) -> Segments:
        """Return the columns `(n, k)` of one family per segment, none where nothing was measured."""
        f = self.features
        return f.series.get(family) or [np.empty((n, 0), dtype=np.float32) for n in f.segment_lengths]


@dataclass(frozen=True, eq=False)
class ComparisonInput:
    """Reference, candidate and replicate at equal lag and equal frame count, and what they are measured with.
    `recipes`: what the published recipe fitted on the reference, by the number of its frames; the candidates share
    it."""

    scene: Scene
    torsions: Backbone
    geometry: Geometry
    reference: Sample
    candidate: Sample
    replicate: Sample
    options: Options
    temperature_k: float = 300.0
    recipes: dict[int, Any] = field(default_factory=dict)

    @property
    def probes(self) -> Probes:
        """What is measured beside phi, psi, bonds and validity."""
        assert self.reference.features.probes is not None
        return self.reference.features.probes

    @property
    def lag_ps(self) -> float:
        """The time between frames, ps."""
        return self.reference.features.lag_ps

    @property
    def compared_ps(self) -> float:
        """The equal length, ps."""
        return min(s.features.total_ps for s in self.samples)

    @property
    def samples(self) -> tuple[Sample, Sample, Sample]:
        """Reference, candidate, replicate."""
        return self.reference, self.candidate, self.replicate

    def column(self, family: Family | Literal["phi", "psi"], k: int) -> list[Segments]:
        """Return one column `(n,)` per segment of phi, of psi or of a family, of each sample."""
        return [s.features.column(family, k) for s in self.samples]

    def families(self, family: Family, *columns: int) -> list[Segments]:
        """Return the columns `(n, k)` of one family of each sample: those named, or all."""
        every = [s.family(family) for s in self.samples]
        return [[x[:, columns] for x in v] for v in every] if columns else every

    def too_short(self, lag_frames: float, trajectories: Sequence[Features] | None = None) -> str:
        """Return why nothing is estimated at this lag, in words: a trajectory (of the three by default) has no unbroken
        stretch of `LEAST_LAGS` lags. Empty where all have one."""
        longest = min(max(f.segment_lengths) for f in trajectories or [s.features for s in self.samples])
        if longest >= LEAST_LAGS * lag_frames:
            return ""
        needed, held = (format_time_ps(n * self.lag_ps, 3) for n in (LEAST_LAGS * lag_frames, longest))
        return f"it takes {needed} without a break, {LEAST_LAGS} lags, and one of the trajectories holds {held}"


def make_sample(
    features: Features, blocks: Blocks, options: Options, stream: int, n_equal_frames: int | None = None
) -> Sample:
    """Return a sample with its own stream of bootstrap draws, so that adding a candidate changes no other number.
    `n_equal_frames`: the length that all trajectories of the comparison have; None for the whole."""
    rng = np.random.default_rng([options.seed, stream])
    n = blocks.n_blocks
    if n_equal_frames is not None and n_equal_frames < features.n_frames:
        n = max(min(round(n * n_equal_frames / features.n_frames), n), 1)
    weights = bootstrap_weights(blocks.n_blocks, options.n_bootstrap, rng)
    equal = weights if n == blocks.n_blocks else bootstrap_weights(n, options.n_bootstrap, rng)
    return Sample(features, blocks, weights, n, equal)


def by_group(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with those of one group together, in the order of `GROUPS`; within a group as they came."""
    return sorted(rows, key=lambda row: GROUPS.index(row.group))


def lower_first(name: str) -> str:
    """Return a name as it stands within a sentence."""
    return name if name[1:2].isupper() else name[0].lower() + name[1:]


def distance_row(
    inputs: ComparisonInput,
    counts: Sequence[FloatArray],
    key: str,
    group: Group,
    metric: str,
    strata: Sequence[IntArray] | None = None,
) -> Row:
    """Return the row of a Jensen-Shannon distance from histograms per block of (reference, candidate, replicate): three
    arrays `(n_blocks, n_bins)`, or `(n_blocks, n_series, n_bins)` whose distances are averaged.

    Distances are those of equal lengths; the p-values are block permutation tests of everything there is, against the
    reference alone where the replicate differs from it. `strata`: the kind of each block; only blocks of one kind are
    exchanged.
    """
    ref, cand, rep = (c.reshape(len(c), -1, c.shape[-1]) for c in counts)
    # Bins that nobody visits add nothing to any distance.
    visited = sum(c.sum((0, 1)) for c in (ref, cand, rep)) > 0
    n_series, n_bins = ref.shape[1], int(visited.sum())
    flat = [c[..., visited].reshape(len(c), -1) for c in (ref, cand, rep)]

    def mean_distance(p: FloatArray, q: FloatArray) -> FloatArray:
        shape = (len(p), n_series, n_bins)
        return np.asarray(distributions.distance(p.reshape(shape), q.reshape(shape)).mean(-1))

    # Of what is equally long: both distances, and their bootstrap draws.
    equal = [c[: s.n_equal] for s, c in zip(inputs.samples, flat, strict=True)]
    sums = [c.sum(0)[None] for c in equal]
    to_candidate, to_replicate = (float(mean_distance(sums[0], x)[0]) for x in sums[1:])
    batch = max(1, int(_DRAWN_VALUES // max(n_series * n_bins, 1)))
    drawn = []
    for start in range(0, inputs.options.n_bootstrap, batch):
        own, theirs, others = (
            s.equal_weights[start : start + batch] @ x for s, x in zip(inputs.samples, equal, strict=True)
        )
        drawn.append((mean_distance(own, theirs), mean_distance(own, others)))
    draws_candidate, draws_replicate = map(np.concatenate, zip(*drawn, strict=True))
    n_blocks = min(len(c) for c in equal)
    ratio = Estimate(math.nan)
    if to_replicate > 0:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate(to_candidate / to_replicate, draws_candidate / draws_replicate, n_blocks, log=True)
    rng = np.random.default_rng([inputs.options.seed, 99])
    strata = strata or [np.zeros(len(c), dtype=np.int64) for c in flat]

    def p_of(other: int, *sources: int) -> float:
        of_block = np.concatenate([strata[k] for k in (*sources, other)])
        pool = np.concatenate([flat[k] for k in sources])
        return permutation_p(pool, flat[other], mean_distance, rng, inputs.options.n_permutations, of_block)

    p_replicate = p_of(2, 0)
    p = p_of(1, 0) if p_replicate < UNLIKE_BELOW else p_of(1, 0, 2)
    words = f"{ratio.value:.2g} times a replicate's" if math.isfinite(ratio.value) else "not as in the reference"
    return Row(
        key=key,
        group=group,
        metric=metric,
        form="distance",
        candidate=distance_estimate(to_candidate, draws_candidate, n_blocks),
        replicate=distance_estimate(to_replicate, draws_replicate, n_blocks),
        ratio=ratio,
        p_value=p if math.isfinite(to_candidate) else math.nan,
        p_replicate=p_replicate,
        tolerance=2.0,
        tolerance_text="≤ 2 × replicate",
        statement=f"{lower_first(metric)}: {words}",
        divergence=(to_candidate**2, to_replicate**2) if n_series == 1 else None,
    )


def series_counts(inputs: ComparisonInput, series: Three, bins: Bins) -> list[FloatArray]:
    """Return histograms per block `(n_blocks, n_bins)` of one series `(n,)` per segment and sample."""
    return [distributions.block_counts(v, bins, s.blocks) for s, v in zip(inputs.samples, series, strict=True)]


def mean_distance(
    inputs: ComparisonInput,
    segments: Three,
    bins: Sequence[Bins],
    key: str,
    name: str,
    group: Group,
    groups: Groups | None = None,
) -> Row:
    """Return the row of the mean Jensen-Shannon distance over the columns `(n, k)`, one `Bins` each; with `groups` of
    equal columns, one histogram and one `Bins` a group."""
    chosen = [[k] for k in range(len(bins))] if groups is None else [g.tolist() for g in groups]

    def counts(sample: Sample, values: Segments) -> FloatArray:
        each = [[distributions.block_counts([x[:, k] for x in values], own, sample.blocks) for k in g]
                for g, own in zip(chosen, bins, strict=True)]  # fmt: skip
        return np.stack([np.sum(x, axis=0) for x in each], axis=1)

    three = [counts(s, v) for s, v in zip(inputs.samples, segments, strict=True)]
    metric = f"{name}, distance" if len(bins) == 1 else f"{name}, mean distance over {len(bins)}"
    return distance_row(inputs, three, key, group, metric)


def histogram(inputs: ComparisonInput, series: Three, bins: Bins, label: str, unit: str) -> Histogram:
    """Return the densities of one series `(n,)` per segment and sample, normalised over all frames, in range or not."""
    counts = [c.sum(0) for c in series_counts(inputs, series, bins)]
    width = (bins.high - bins.low) / bins.n
    ref, cand, rep = (c[: bins.n] / max(c.sum(), 1) / width for c in counts)
    outside = [float(c[bins.n :].sum() / max(c.sum(), 1)) for c in counts]
    return Histogram(label, unit, bins.edges, ref, cand, rep, (outside[0], outside[1], outside[2]))


def reference_of(reference: Estimate, replicate: Estimate, *, log: bool = False) -> Estimate:
    """Return what a candidate is tested against: reference and replicate together, or the reference alone where the
    replicate is not known or differs from it."""
    if not math.isfinite(replicate.value) or difference_p(replicate, reference, log=log) < UNLIKE_BELOW:
        return reference
    return pooled(reference, replicate, log=log)


def distance_estimate(value: float, draws: FloatArray, n_blocks: int) -> Estimate:
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
) -> Row:
    """Return the row of a number that each trajectory has by itself: `values` and bootstrap `draws` `(n_draws,)` of
    (reference, candidate, replicate), in the metric's unit."""
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
        statement=metric.deviation(cand.value, ref.value),
    )


class Means(NamedTuple):
    """The mean of every column `(k,)` and its bootstrap draws `(n_draws, k)`, from `n_blocks` blocks."""

    values: FloatArray
    draws: FloatArray
    n_blocks: int

    def estimates(self, columns: Sequence[int] | None = None) -> list[Estimate]:
        """Return each mean with its interval, of all columns or of some."""
        chosen = range(len(self.values)) if columns is None else columns
        return [estimate(float(self.values[k]), self.draws[:, k], self.n_blocks) for k in chosen]

    def times(self, factor: float) -> Means:
        """Return the means in another unit."""
        return Means(factor * self.values, factor * self.draws, self.n_blocks)

    def over(self, groups: Groups) -> Means:
        """Return the mean over each group of equal columns."""
        return Means(over_groups(self.values, groups), over_groups(self.draws, groups), self.n_blocks)


Limits = tuple[FloatArray, FloatArray]


def bounds(segments: Segments) -> Limits:
    """Return the least and greatest finite value of every column `(k,)`, each a whole range further out. Values beyond
    count as these: an exploded frame is the validity checks' to report, and must not drown the others."""
    with np.errstate(invalid="ignore"):
        finite = [np.where(np.isfinite(s), s, np.nan) for s in segments]
        low = np.min([np.nanmin(s, axis=0, initial=np.inf) for s in finite], axis=0)
        high = np.max([np.nanmax(s, axis=0, initial=-np.inf) for s in finite], axis=0)
        width = np.nan_to_num(high - low, nan=0.0, posinf=0.0, neginf=0.0)
        return low - width, high + width


def block_means(sample: Sample, segments: Segments, limits: Limits | None = None) -> Means:
    """Return the mean of every column of `segments` `(n, k)`, values kept within `limits`; those that are not finite
    are left out."""
    n_columns = segments[0].shape[1]
    total, count = np.zeros((2, sample.blocks.n_blocks, n_columns))
    for piece in sample.blocks.pieces:
        part = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = np.isfinite(part)
        if limits is not None:
            with np.errstate(invalid="ignore"):
                part = np.clip(part, *limits)
        total[piece.block] += np.where(finite, part, 0.0).sum(axis=0)
        count[piece.block] += finite.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        values, draws = total.sum(axis=0) / count.sum(axis=0), (sample.weights @ total) / (sample.weights @ count)
        return Means(values, draws, sample.blocks.n_blocks)


def three_means(inputs: ComparisonInput, series: Three, *, limited: bool = False) -> list[Means]:
    """Return the means of the columns of each sample, values kept within the reference's `bounds` where `limited`."""
    limits = bounds(series[0]) if limited else None
    return [block_means(s, v, limits) for s, v in zip(inputs.samples, series, strict=True)]


def mean_row(inputs: ComparisonInput, metric: Quantity, means: Sequence[Means], k: int = 0) -> Row:
    """Return the row of the mean of column `k`, from `means` of (reference, candidate, replicate)."""
    return observable_row(inputs, metric, [float(m.values[k]) for m in means], [m.draws[:, k] for m in means])


def shift_row(metric: Quantity, means: Sequence[Means], labels: Sequence[str]) -> Row:
    """Return the row of the column whose mean is furthest off, from `means` of (reference, candidate, replicate);
    `labels` name the columns. The p-value is the least over all columns times their number (Bonferroni)."""
    ref, cand, rep = means
    shift, replicate_baseline = np.abs(cand.values - ref.values), np.abs(rep.values - ref.values)
    worst = int(np.nanargmax(shift)) if np.isfinite(shift).any() else 0
    at = int(np.nanargmax(replicate_baseline)) if np.isfinite(replicate_baseline).any() else 0
    sign = np.sign(cand.values[worst] - ref.values[worst])
    n_blocks = min(m.n_blocks for m in means)
    found = estimate(float(shift[worst]), sign * (cand.draws[:, worst] - ref.draws[:, worst]), n_blocks)
    least = [1.0, 1.0]
    for k in range(len(shift)):
        r, c, other = (mean_estimate(float(m.values[k]), m.draws[:, k], m.n_blocks) for m in means)
        for side, (x, y) in enumerate(((c, reference_of(r, other)), (other, r))):
            if abs(x.value - y.value) > metric.resolution:
                least[side] = min(least[side], difference_p(x, y) * len(shift))
    return Row(
        key=metric.key,
        group=metric.group,
        metric=f"{metric.name}: {labels[worst]}",
        unit=metric.unit,
        form="distance",
        candidate=replace(found, low=max(found.low, 0.0)),
        replicate=Estimate(float(replicate_baseline[at]), error=float((rep.draws - ref.draws)[:, at].std())),
        p_value=least[0] if math.isfinite(float(shift[worst])) else math.nan,
        p_replicate=least[1],
        tolerance=metric.tolerance,
        tolerance_text=metric.tolerance_text or f"≤ {metric.tolerance_words()}",
        statement=metric.deviation(float(cand.values[worst]), float(ref.values[worst]), labels[worst]),
    )
