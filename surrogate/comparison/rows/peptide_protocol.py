"""The peptide papers' own recipe, step by step, so that published tables can be put beside ours.

MDGen (Jing et al., 2024), used by JAMUN and LaM-SLidE too: Jensen-Shannon distances, natural logarithm; torsions in
100 bins on [-pi, pi]; TICA of cos and sin of all torsions at a lag of 100 ps, kinetic map, fitted on the reference;
TIC 0 in 100 bins and TIC 0, 1 in 50 x 50 over the union of both ranges; k-means with 100 clusters, a Markov state model
at 100 ps, PCCA to 10 states, and the occupancies of these. It differs from our own metrics in its ranges (no overflow
bins: frames that are not finite are left out) and in that nothing is tested: these numbers are for comparison with
published ones, not for the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions, kinetics, msm
from surrogate.comparison.measure.slow_motion import tica_features
from surrogate.comparison.measure.statistics import Blocks
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.rows.charts import BarChart, Chart, Line, LineChart
from surrogate.comparison.rows.rows import ComparisonInput, Measured, too_short
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]
Segments = Sequence[npt.NDArray[np.floating]]

LAG_PS = 100.0
N_CLUSTERS = 100
N_STATES = 10
N_BINS, N_BINS_JOINT = 100, 50
_SIDE_KINDS = ("χ",)


@dataclass(frozen=True)
class PeptideTable:
    """The columns of the published table, distances to the reference; NaN where there is nothing to average over."""

    backbone: float
    side_chain: float
    all_torsions: float
    tica_0: float
    tica_01: float
    msm: float

    NAMES = ("backbone torsions", "side-chain torsions", "all torsions", "TICA 0", "TICA 0,1", "MSM states")

    def values(self) -> FloatArray:
        """Return the six numbers in the order of `NAMES`."""
        return np.array([self.backbone, self.side_chain, self.all_torsions, self.tica_0, self.tica_01, self.msm])


@dataclass(frozen=True, eq=False)
class Fit:
    """What the recipe fits on the reference: the TICA projection, and the states or None where there are too few."""

    projection: msm.Projection
    model: msm.Model | None
    coordinates: list[FloatArray]


def torsion_columns(features: Features) -> tuple[list[list[FloatArray]], list[list[FloatArray]]]:
    """Return the backbone torsions (phi, psi) and the side-chain ones (chi), each a list of segments `(n,)` in rad."""
    backbone = [
        [np.asarray(x[:, k], dtype=np.float64) for x in series]
        for series in (features.phi, features.psi)
        for k in range(series[0].shape[1])
    ]
    side: list[list[FloatArray]] = []
    further = features.series.get("torsions")
    if features.probes is not None and further is not None:
        # Folded torsions turn m times as fast; the recipe knows of no symmetry, but neither can what was measured.
        chosen = [k for k, t in enumerate(features.probes.torsions) if t.kind in _SIDE_KINDS]
        side = [[np.asarray(x[:, k], dtype=np.float64) for x in further] for k in chosen]
    return backbone, side


def histogram_distance(p: Segments, q: Segments, low: float, high: float, n_bins: int = N_BINS) -> float:
    """Return the Jensen-Shannon distance of two histograms of scalars on [low, high]; values outside do not count."""
    counts = [np.histogram(_finite(x), bins=n_bins, range=(low, high))[0].astype(float) for x in (p, q)]
    return float(distributions.distance(counts[0], counts[1]))


def fit_recipe(reference: Features, *, n_clusters: int = N_CLUSTERS, n_states: int = N_STATES) -> Fit | None:
    """Fit TICA and the Markov state model of the recipe on the reference; None where nothing moves."""
    lag = max(1, round(LAG_PS / reference.lag_ps))
    features = tica_features(reference)
    projection = msm.fit_projection(features, lag, dim=features[0].shape[1], least=-1.0)
    if projection is None:
        return None
    coordinates = [projection.project(x) for x in features]
    return Fit(projection, msm.fit_model(projection, coordinates, lag, n_clusters, n_states), coordinates)


def peptide_table(fit: Fit, reference: Features, other: Features) -> PeptideTable:
    """Return the recipe's distances between the reference, on which `fit` was made, and another trajectory."""
    (backbone, side), (their_backbone, their_side) = torsion_columns(reference), torsion_columns(other)
    apart = [
        [histogram_distance(p, q, -math.pi, math.pi) for p, q in zip(ours, theirs, strict=True)]
        for ours, theirs in ((backbone, their_backbone), (side, their_side))
    ]
    theirs = [fit.projection.project(x) for x in tica_features(other)]
    p, q = (_rows(x) for x in (fit.coordinates, theirs))
    low, high = np.minimum(p.min(0), q.min(0)), np.maximum(p.max(0), q.max(0))
    tica_01 = math.nan
    if p.shape[1] > 1:
        box = [(low[0], high[0]), (low[1], high[1])]
        counts = [np.histogram2d(x[:, 0], x[:, 1], bins=N_BINS_JOINT, range=box)[0].ravel() for x in (p, q)]
        tica_01 = float(distributions.distance(counts[0], counts[1]))
    return PeptideTable(
        _mean(apart[0]),
        _mean(apart[1]),
        _mean(apart[0] + apart[1]),
        histogram_distance([p[:, 0]], [q[:, 0]], float(low[0]), float(high[0])),
        tica_01,
        math.nan if fit.model is None else _state_distance(fit.model, fit.coordinates, theirs),
    )


def _state_distance(model: msm.Model, ours: Sequence[FloatArray], theirs: Sequence[FloatArray]) -> float:
    counts = []
    for coordinates in (ours, theirs):
        labels = np.concatenate(model.lump(model.assign(coordinates)))
        counts.append(np.bincount(labels[labels >= 0], minlength=model.n_states).astype(float))
    return float(distributions.distance(counts[0], counts[1]))


def decorrelation(segments: Segments, n_lags: int) -> FloatArray:
    """Return the recipe's decorrelation curve of one torsion `(n_lags,)`: 1 at lag 0, 0 where nothing is remembered.

    <sin sin'> + <cos cos'> over pairs at each lag, neither demeaned, less the baseline <sin>^2 + <cos>^2, divided by
    1 - baseline. NaN for a torsion that does not move and at lags longer than every segment.
    """
    lengths = [len(s) for s in segments]
    blocks = Blocks.whole(lengths)
    total, baseline = np.zeros(n_lags), 0.0
    for part in (np.sin, np.cos):
        series = [part(np.asarray(s, dtype=np.float64)) for s in segments]
        sums = kinetics.lag_sums(series, blocks, n_lags)
        n = sums.n.sum(0)
        with np.errstate(invalid="ignore", divide="ignore"):
            total += np.where(n > 0, sums.xy.sum(0) / n, np.nan)
        baseline += float(np.nanmean(np.concatenate(series))) ** 2
    if 1.0 - baseline < 1e-9:
        return np.full(n_lags, np.nan)
    return (total - baseline) / (1.0 - baseline)


def peptide_charts(inputs: ComparisonInput) -> Measured:
    """Return the recipe's table as a bar chart and the decorrelation of each torsion, or why they were skipped."""
    name = f"The peptide papers' recipe (lag {format_time_ps(LAG_PS)}, {N_CLUSTERS} clusters, {N_STATES} states)"
    n = min(s.features.n_frames for s in inputs.samples)
    reference, candidate, replicate = (s.features.frames(0, n) for s in inputs.samples)
    if not inputs.options.peptide_recipe:
        return Measured(skipped=[(name, "not asked for")])
    if not (len(inputs.torsions.phi) or len(inputs.torsions.psi)):
        return Measured(skipped=[(name, "the scene has no φ or ψ torsion")])
    lag = LAG_PS / reference.lag_ps
    if abs(lag - round(lag)) > 1e-6 or lag < 1:
        return Measured(skipped=[(name, f"frames every {format_time_ps(reference.lag_ps)} do not divide the lag")])
    if short := too_short((reference, candidate, replicate), lag):
        return Measured(skipped=[(name, short)])
    if not all(np.isfinite(x).any() for f in (candidate, replicate) for x in (*f.phi, *f.psi)):
        return Measured(skipped=[(name, "a segment holds no finite frame")])
    if n not in inputs.recipes:
        inputs.recipes[n] = fit_recipe(reference)
    fit: Fit | None = inputs.recipes[n]
    if fit is None:
        return Measured(skipped=[(name, kinetics.WITHOUT_TICA)])
    tables = [peptide_table(fit, reference, other).values() for other in (candidate, replicate)]
    known = np.isfinite(tables[1])
    n_states = "none" if fit.model is None else str(fit.model.n_states)
    bars = BarChart(
        section="distributions",
        title="By the peptide papers' recipe",
        caption="Jensen-Shannon distances to the reference (natural logarithm), as MDGen, JAMUN and LaM-SLidE print "
        f"them: 100 and 50 × 50 bins, TICA and MSM at 100 ps, 100 clusters, {n_states} metastable states. Not "
        "evaluated.",
        y_label="distance to the reference",
        names=tuple(n for n, k in zip(PeptideTable.NAMES, known, strict=True) if k),
        reference=np.zeros(int(known.sum())),
        candidate=tables[0][known],
        replicate=tables[1][known],
    )
    return Measured(charts=[bars, _decorrelation_chart(inputs)])


def _decorrelation_chart(inputs: ComparisonInput) -> Chart:
    n_lags = (
        min(int(10 * LAG_PS / inputs.reference.features.lag_ps), max(inputs.reference.features.segment_lengths)) + 1
    )
    lines = []
    for sample, role in zip(inputs.samples, ("reference", "candidate", "replicate"), strict=True):
        backbone, side = torsion_columns(sample.features)
        for kind, group in (("backbone", backbone), ("side chains", side)):
            if group:
                curves = np.array([c for s in group if np.isfinite(c := decorrelation(s, n_lags)).any()])
                if not len(curves):
                    continue
                drawn = np.unique(np.geomspace(1, n_lags - 1, 80).astype(int))
                x = drawn * sample.features.lag_ps
                # At the longest lags no torsion may have a pair of frames left.
                mean = np.ma.masked_invalid(curves[:, drawn]).mean(axis=0).filled(np.nan)
                lines.append(Line(f"{kind}, {role}", role, x, mean))  # type: ignore[arg-type]
    return LineChart(
        section="kinetics",
        title="Decorrelation of torsions, by the peptide papers' recipe",
        caption="Mean over torsions of (<sin sin'> + <cos cos'> - baseline) / (1 - baseline), not demeaned.",
        x_label="lag / ps",
        y_label="decorrelation",
        lines=tuple(lines),
        log_x=True,
    )


def _finite(segments: Segments) -> FloatArray:
    values = np.concatenate([np.asarray(s, dtype=np.float64) for s in segments])
    return values[np.isfinite(values)]


def _rows(segments: Sequence[FloatArray]) -> FloatArray:
    values = np.concatenate(list(segments))
    return values[np.isfinite(values).all(axis=1)]


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
