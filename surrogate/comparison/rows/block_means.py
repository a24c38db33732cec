"""Means of many columns at once, with bootstrap draws; and the row of the column that is furthest off."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.probes import Family, over_groups
from surrogate.comparison.measure.statistics import Estimate, difference_p, estimate, mean_estimate
from surrogate.comparison.rows.rows import ComparisonInput, Quantity, Row, Sample, observable_row, reference_of

FloatArray = npt.NDArray[np.float64]
Segments = Sequence[npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Means:
    """The mean of every column `(k,)` and its bootstrap draws `(n_draws, k)`, from `n_blocks` blocks."""

    values: FloatArray
    draws: FloatArray
    n_blocks: int

    def estimates(self, columns: Sequence[int] | None = None) -> list[Estimate]:
        """Return each mean with its interval, of all columns or of some."""
        chosen = range(len(self.values)) if columns is None else columns
        return [estimate(float(self.values[k]), self.draws[:, k], self.n_blocks) for k in chosen]


def family_of(sample: Sample, family: Family) -> Segments:
    """Return the columns `(n, k)` of one family per segment, none where it was not measured."""
    found = sample.features.series.get(family)
    return [np.empty((n, 0), dtype=np.float32) for n in sample.features.segment_lengths] if found is None else found


def column(segments: Segments, k: int) -> list[npt.NDArray[Any]]:
    """Return one column `(n,)` per segment."""
    return [s[:, k] for s in segments]


def bounds(segments: Segments) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest finite value of every column `(k,)`, each a whole range further out.

    Values beyond count as these: an exploded frame is the validity checks' to report, and must not drown the others.
    """
    with np.errstate(invalid="ignore"):
        low = np.min([np.nanmin(np.where(np.isfinite(s), s, np.nan), axis=0, initial=np.inf) for s in segments], axis=0)
        high = np.max(
            [np.nanmax(np.where(np.isfinite(s), s, np.nan), axis=0, initial=-np.inf) for s in segments], axis=0
        )
        width = np.nan_to_num(high - low, nan=0.0, posinf=0.0, neginf=0.0)
        return low - width, high + width


def block_means(
    sample: Sample,
    segments: Segments,
    limits: tuple[FloatArray, FloatArray] | None = None,
    transform: Callable[[npt.NDArray[Any]], npt.NDArray[Any]] | None = None,
) -> Means:
    """Return the mean of every column of `segments` `(n, k)`, values kept within `limits`, then transformed.

    Values that are not finite are left out.
    """
    n_columns = segments[0].shape[1]
    total, count = np.zeros((sample.blocks.n_blocks, n_columns)), np.zeros((sample.blocks.n_blocks, n_columns))
    for piece in sample.blocks.pieces:
        part = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = np.isfinite(part)
        if limits is not None:
            with np.errstate(invalid="ignore"):
                part = np.clip(part, *limits)
        if transform is not None:
            part = transform(part)
        total[piece.block] += np.where(finite, part, 0.0).sum(axis=0)
        count[piece.block] += finite.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return Means(
            total.sum(axis=0) / count.sum(axis=0),
            (sample.weights @ total) / (sample.weights @ count),
            sample.blocks.n_blocks,
        )


def over_equal(means: Means, groups: Sequence[npt.NDArray[np.intp]]) -> Means:
    """Return the mean over each group of equal columns."""
    return Means(over_groups(means.values, groups), over_groups(means.draws, groups), means.n_blocks)


def mean_row(
    inputs: ComparisonInput, metric: Quantity, means: Sequence[Means], k: int, statement: Callable[[float, float], str]
) -> Row:
    """Return the row of the mean of column `k`, from `means` of (reference, candidate, replicate); see
    `observable_row`."""
    return observable_row(
        inputs, metric, [float(m.values[k]) for m in means], [m.draws[:, k] for m in means], statement
    )


def shift_row(
    inputs: ComparisonInput,
    metric: Quantity,
    means: Sequence[Means],
    labels: Sequence[str],
    statement: Callable[[str, float, float], str],
) -> Row:
    """Return the row of the column whose mean is furthest off, from `means` of (reference, candidate, replicate).

    `labels` name the columns, and the worst one's stands in the row's name. The p-value is the least over all columns
    times their number (Bonferroni). `statement(label, candidate, reference)` words the deviation.
    """
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
        both = reference_of(r, other)
        for side, (x, y) in enumerate(((c, both), (other, r))):
            if abs(x.value - y.value) > metric.resolution:
                least[side] = min(least[side], difference_p(x, y) * len(shift))
    return Row(
        key=metric.key,
        group=metric.group,
        metric=f"{metric.name}: {labels[worst]}",
        unit=metric.unit,
        form="distance",
        reference=None,
        candidate=replace(found, low=max(found.low, 0.0)),
        replicate=Estimate(float(replicate_baseline[at]), error=float((rep.draws - ref.draws)[:, at].std())),
        ratio=None,
        p_value=least[0] if math.isfinite(float(shift[worst])) else math.nan,
        p_replicate=least[1],
        tolerance=metric.tolerance,
        tolerance_text=metric.tolerance_text or f"≤ {metric.tolerance_words()}",
        statement=statement(labels[worst], float(cand.values[worst]), float(ref.values[worst])),
    )
