"""Rows and charts of size, shape and stiffness: Rg, RMSD, RMSF, end-to-end distance, angles, ring puckers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import distributions
from surrogate.judge.measure.distributions import Bins
from surrogate.judge.measure.equal_atoms import MOST_HISTOGRAMS, equal_rows, evenly, group_labels
from surrogate.judge.rows.block_means import (
    Means,
    block_means,
    bounds,
    column,
    family_of,
    mean_row,
    over_equal,
    shift_row,
)
from surrogate.judge.rows.charts import BarChart, Chart
from surrogate.judge.rows.curves import histogram
from surrogate.judge.rows.rows import Group, Metric, Row, Trio, distance_row, observable_row

FloatArray = npt.NDArray[np.float64]
Skipped = tuple[str, str]
Series = Sequence[Sequence[npt.NDArray[Any]]]

_ANGLE_BINS = 50
_ANGLE_TOLERANCE_DEG = 1.0
_ANGLE_RESOLUTION_DEG = 0.05
_MAX_DRAWN = 60
_RG, _RMSD, _ENDS = 0, 1, 2


def shape_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows and charts of radius of gyration, RMSD, RMSF, end-to-end distance, angles and ring puckers."""
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = [*probes.left_out]
    rows += _length_rows(trio, _RG, "rg", "Radius of gyration", 0.02, charts)
    rows += _length_rows(trio, _RMSD, "rmsd", "RMSD from the reference's mean structure", None, charts)
    if probes.ends is not None:
        names = " to ".join(probes.scene.atom_names[i] for i in probes.ends)
        rows += _length_rows(trio, _ENDS, "end_to_end", f"End-to-end distance ({names})", 0.03, charts)
    else:
        skipped.append(("End-to-end distance", "no two heavy atoms are four bonds apart"))
    fluctuation, chart = _fluctuation(trio)
    rows.append(fluctuation)
    charts.append(chart)
    if len(probes.angles):
        rows += _angle_rows(trio)
    else:
        skipped.append(("Bond angles", "no atom has two neighbours"))
    rows += _pucker_rows(trio, charts)
    if not probes.rings:
        skipped.append(("Ring puckers", "the scene has no ring that can pucker"))
    return rows, charts, skipped


def _in_angstrom(trio: Trio, k: int) -> Series:
    return [[10.0 * x for x in column(family_of(s, "shape"), k)] for s in trio.samples]


def _length_rows(trio: Trio, k: int, key: str, name: str, tolerance: float | None, charts: list[Chart]) -> list[Row]:
    """The distribution of a length, and its mean where there is a relative `tolerance` to hold it to."""
    series = _in_angstrom(trio, k)
    bins = distributions.reference_bins(series[0])
    rows = [series_distance(trio, series, bins, f"{key}_jsd", name, "structure")]
    charts.append(histogram(trio, series, bins, name, "Å"))
    if tolerance is None:
        return rows
    limits = bounds([x[:, None] for x in series[0]])
    means = [block_means(s, [x[:, None] for x in v], limits) for s, v in zip(trio.samples, series, strict=True)]
    low = name[0].lower() + name[1:]
    mean = mean_row(
        trio,
        Metric(
            f"{key}_mean",
            "structure",
            f"{name}, mean",
            "Å",
            tolerance * float(means[0].values[0]),
            tolerance_text=f"± {100 * tolerance:g} %",
        ),
        means,
        0,
        lambda c, r: f"the {low} is {c:.3g} Å on average instead of {r:.3g} Å",
    )
    return [mean, *rows]


def series_distance(trio: Trio, series: Series, bins: Bins, key: str, name: str, group: Group) -> Row:
    """Return the Jensen-Shannon distance row of one series `(n,)` per segment and sample."""
    counts = [distributions.block_counts(v, bins, s.blocks) for s, v in zip(trio.samples, series, strict=True)]
    low = name if name[1:2].isupper() else name[0].lower() + name[1:]
    return distance_row(
        trio,
        counts,
        key=key,
        group=group,
        metric=f"{name}, distance",
        statement=lambda ratio: f"the distribution of {low} is {ratio:.2g} times as far off as a replicate's",
    )


def mean_distance(
    trio: Trio,
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
        for s, v in zip(trio.samples, segments, strict=True)
    ]
    what = f"{name}, distance" if len(bins) == 1 else f"{name}, mean distance of {len(bins)}"
    low = name[0].lower() + name[1:]
    return distance_row(
        trio,
        counts,
        key=key,
        group=group,
        metric=what,
        statement=lambda ratio: f"{low}: distributions {ratio:.2g} times as far off as a replicate's",
    )


def _fluctuation(trio: Trio) -> tuple[Row, Chart]:
    """RMSF about the reference's mean structure after superposition: its root mean square, and one bar per atom, or for
    all of a kind that the molecule's symmetry makes equal.

    Every trajectory is laid over the same mean structure, so that a shifted mean shows as well as another spread.
    """
    probes = trio.reference.features.probes
    assert probes is not None
    deviation = [family_of(s, "deviation") for s in trio.samples]
    limits = bounds(deviation[0])
    means = [block_means(s, v, limits) for s, v in zip(trio.samples, deviation, strict=True)]

    def rms(squared: FloatArray) -> FloatArray:
        return 10.0 * np.sqrt(squared.mean(axis=-1))

    row = observable_row(
        trio,
        Metric("rmsf", "structure", "RMSF over all fitted atoms", "Å", 0.1, relative=True),
        [float(rms(m.values)) for m in means],
        [rms(m.draws) for m in means],
        lambda c, r: f"atoms fluctuate by {c:.3g} Å instead of {r:.3g} Å (RMSF)",
    )
    groups = equal_rows(probes.fit_idx[:, None], probes.classes)
    means = [over_equal(m, groups) for m in means]
    labels = group_labels(probes.labels("deviation"), groups)
    shown = np.unique(np.linspace(0, len(groups) - 1, _MAX_DRAWN).astype(int))
    bands = [[10.0 * np.sqrt(np.maximum(np.nanquantile(m.draws[:, shown], q, axis=0), 0.0)) for q in (0.025, 0.975)]
             for m in means]  # fmt: skip
    values = [10.0 * np.sqrt(m.values[shown]) for m in means]
    chart = BarChart(
        section="structure",
        title="RMSF",
        caption="Root mean square distance of each atom from the reference's mean structure, frames superposed on it.",
        y_label="RMSF / Å",
        names=tuple(labels[k] for k in shown),
        reference=values[0],
        candidate=values[1],
        replicate=values[2],
        reference_low=bands[0][0],
        reference_high=bands[0][1],
        candidate_low=bands[1][0],
        candidate_high=bands[1][1],
    )
    return row, chart


def _angle_rows(trio: Trio) -> list[Row]:
    probes = trio.reference.features.probes
    assert probes is not None
    angles = [family_of(s, "angles") for s in trio.samples]
    limits = bounds(angles[0])
    means = [block_means(s, v, limits) for s, v in zip(trio.samples, angles, strict=True)]
    groups = equal_rows(probes.angles, probes.classes)
    drawn = evenly(groups, MOST_HISTOGRAMS)
    pooled = [over_equal(m, groups) for m in means]
    in_degrees = [Means(np.degrees(m.values), np.degrees(m.draws), m.n_blocks) for m in pooled]
    shift = shift_row(
        trio,
        Metric(
            "angle_shift",
            "structure",
            "Largest shift of a mean bond angle",
            "°",
            _ANGLE_TOLERANCE_DEG,
            resolution=_ANGLE_RESOLUTION_DEG,
        ),
        in_degrees,
        group_labels(probes.labels("angles"), groups),
        lambda label, c, r: f"the angle {label} is {abs(c - r):.1f}° too {'wide' if c > r else 'narrow'}",
    )
    bins = [distributions.normal_bins([x[:, g] for x in angles[0]], _ANGLE_BINS) for g in drawn]
    return [shift, mean_distance(trio, angles, bins, "angle_jsd", "Bond angles", "structure", drawn)]


def _pucker_rows(trio: Trio, charts: list[Chart]) -> list[Row]:
    probes = trio.reference.features.probes
    assert probes is not None
    labels = probes.labels("puckers")
    rows = []
    for k, label in enumerate(labels):
        series = [column(family_of(s, "puckers"), k) for s in trio.samples]
        is_angle = k % 2 == 1
        if not is_angle:
            series = [[10.0 * x for x in v] for v in series]
        bins = distributions.TORSION_BINS if is_angle else distributions.reference_bins(series[0])
        rows.append(series_distance(trio, series, bins, f"pucker_jsd:{label}", f"Pucker {label}", "distributions"))
        charts.append(histogram(trio, series, bins, f"pucker {label}", "rad" if is_angle else "Å"))
    return rows
