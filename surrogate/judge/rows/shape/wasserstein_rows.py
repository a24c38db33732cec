"""Rows of Wasserstein distances of bond lengths and bond angles: how far, in Å or degrees, the values have to move."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.equal_atoms import MOST_HISTOGRAMS, equal_rows, evenly
from surrogate.judge.measure.statistics import Blocks, Estimate, estimate
from surrogate.judge.rows.block_means import family_of
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.rows import Metric, Row, Trio, drawn_distances, permutation_pair

FloatArray = npt.NDArray[np.float64]
Segments = Sequence[npt.NDArray[Any]]

_BINS = 100
_LENGTHS = Metric("bond_wasserstein", "structure", "Bond lengths", "Å", 0.01, resolution=0.001)
_ANGLES = Metric("angle_wasserstein", "structure", "Bond angles", "°", 1.0, resolution=0.05)


def wasserstein_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return the rows of bond lengths (Å) and bond angles (degrees): means over all of them, equal ones pooled."""
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    rows = []
    pairs = np.asarray(trio.geometry.bond_idx, dtype=np.int64).reshape(-1, 2)
    if len(pairs):
        lengths = [s.features.bonds_nm for s in trio.samples]
        groups = evenly(equal_rows(pairs, probes.classes), MOST_HISTOGRAMS)
        rows.append(_row(trio, _LENGTHS, lengths, groups, scale=10.0, furthest=0.5))
    if len(probes.angles):
        angles = [family_of(s, "angles") for s in trio.samples]
        groups = evenly(equal_rows(probes.angles, probes.classes), MOST_HISTOGRAMS)
        rows.append(_row(trio, _ANGLES, angles, groups, scale=180.0 / math.pi, furthest=30.0))
    return rows, [], []


def _row(
    trio: Trio,
    metric: Metric,
    measured: Sequence[Segments],
    groups: Sequence[npt.NDArray[np.intp]],
    *,
    scale: float,
    furthest: float,
) -> Row:
    """Return the row of the mean distance over `groups` of the columns of `measured`, of all three trajectories.

    `scale`: from the unit measured in to the metric's. Values further than `furthest`, in the metric's unit, from the
    reference's mean count as that far.
    """
    edges = np.stack([_edges([x[:, g] for x in measured[0]], measured, g, furthest / scale) for g in groups])
    widths = scale * np.diff(edges, axis=1)[:, 0]
    counts = [binned(v, groups, edges, s.blocks) for v, s in zip(measured, trio.samples, strict=True)]
    # Added up along the bins once: what is drawn and dealt are sums over blocks, which can be taken before or after.
    flat = [c.cumsum(axis=-1).reshape(len(c), -1) for c in counts]

    def distance(p: FloatArray, q: FloatArray) -> FloatArray:
        shape = (len(p), len(groups), _BINS)
        return _between(p.reshape(shape), q.reshape(shape), widths).mean(axis=-1)

    equal = [c[: s.n_equal] for s, c in zip(trio.samples, flat, strict=True)]
    total = [c.sum(0)[None] for c in equal]
    drawn = drawn_distances(trio, equal, distance)
    n_blocks = min(map(len, equal))
    made: list[Estimate] = []
    for k in (1, 2):
        found = estimate(float(distance(total[0], total[k])[0]), drawn[k - 1], n_blocks)
        made.append(replace(found, low=max(found.low, 0.0)))
    candidate, replicate = made
    tested = permutation_pair(trio, flat, distance, 98)
    p_values = [p if of.value > metric.resolution else 1.0 for p, of in zip(tested, made, strict=True)]
    low = metric.name[0].lower() + metric.name[1:]
    return Row(
        key=metric.key,
        group=metric.group,
        metric=f"{metric.name}, mean Wasserstein distance",
        unit=metric.unit,
        kind="distance",
        reference=None,
        candidate=candidate,
        replicate=replicate,
        ratio=None,
        p_value=p_values[0] if math.isfinite(candidate.value) else math.nan,
        p_replicate=p_values[1],
        tolerance=metric.tolerance,
        tolerance_text=f"≤ {metric.tolerance_words()}",
        statement=f"{low} are {candidate.value:.2g} {metric.unit} off on average (Wasserstein)",
    )


def _edges(own: Segments, measured: Sequence[Segments], group: npt.NDArray[np.intp], furthest: float) -> FloatArray:
    """Bin edges from the least to the greatest value of all three, at most `furthest` from the reference's mean."""
    values = [x[np.isfinite(x)] for v in measured for x in (np.concatenate([s[:, group].ravel() for s in v]),)]
    own_values = np.concatenate([x[np.isfinite(x)] for x in own])
    centre = float(own_values.mean()) if len(own_values) else 0.0
    low = max(min((float(x.min()) for x in values if len(x)), default=0.0), centre - furthest)
    high = min(max((float(x.max()) for x in values if len(x)), default=0.0), centre + furthest)
    return np.linspace(low, max(high, low + 1e-6), _BINS + 1)


def binned(segments: Segments, groups: Sequence[npt.NDArray[np.intp]], edges: FloatArray, blocks: Blocks) -> FloatArray:
    """Return histograms per block `(n_blocks, n_groups, n_bins)`; what lies outside is counted in the end bins."""
    n_bins = edges.shape[1] - 1
    out = np.zeros((blocks.n_blocks, len(groups), n_bins))
    for k, group in enumerate(groups):
        low, width = edges[k, 0], (edges[k, -1] - edges[k, 0]) / n_bins
        for piece in blocks.pieces:
            part = segments[piece.segment][piece.start : piece.stop][:, group].ravel()
            part = part[~np.isnan(part)]
            index = np.clip((part - low) / width, 0, n_bins - 1).astype(np.int64)
            out[piece.block, k] += np.bincount(index, minlength=n_bins)
    return out


def wasserstein(counts_p: FloatArray, counts_q: FloatArray, widths: FloatArray) -> FloatArray:
    """Return the first Wasserstein distance along the last axis of histograms `(..., n_groups, n_bins)` of one grid.

    The area between the two cumulative distributions, in the unit of `widths` `(n_groups,)`; NaN where one is empty.
    Source: Vallender, Theory Probab. Appl. 18, 784 (1974).
    """
    return _between(counts_p.cumsum(axis=-1), counts_q.cumsum(axis=-1), widths)


def _between(summed_p: FloatArray, summed_q: FloatArray, widths: FloatArray) -> FloatArray:
    """Return the same of histograms whose bins are added up from the left."""
    with np.errstate(invalid="ignore", divide="ignore"):
        apart = summed_p / summed_p[..., -1:]
        apart -= summed_q / summed_q[..., -1:]
        return np.asarray(np.abs(apart, out=apart).sum(axis=-1) * widths)
