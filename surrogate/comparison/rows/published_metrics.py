"""Numbers of published papers, so that their tables can be put beside ours: no verdict rests on them.

The peptide papers' recipe: MDGen (Jing et al., 2024), used by JAMUN and LaM-SLidE too. Jensen-Shannon distances,
natural logarithm; torsions in 100 bins on [-pi, pi]; TICA of cos and sin of all torsions at a lag of 100 ps, kinetic
map, fitted on the reference; TIC 0 in 100 bins and TIC 0, 1 in 50 x 50 over the union of both ranges; k-means with 100
clusters, a Markov state model at 100 ps, PCCA to 10 states, and the occupancies of these. It differs from our own
metrics in its ranges: no overflow bins, frames that are not finite are left out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.slow_motion import tica_features
from surrogate.comparison.measure.statistics import Estimate, FloatArray, Segments
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.rows.charts import bar_chart
from surrogate.comparison.rows.rows import ComparisonInput, Measured, left_out
from systems.units import format_time_ps

LAG_PS = 100.0
N_CLUSTERS = 100
N_STATES = 10
N_BINS, N_BINS_JOINT = 100, 50
# The columns of the published table.
TABLE = ("backbone torsions", "side-chain torsions", "all torsions", "TICA 0", "TICA 0,1", "MSM states")


class Fit(NamedTuple):
    """What the recipe fits on the reference: the TICA projection, and the states or None where there are too few."""

    projection: kinetics.Projection
    model: kinetics.MarkovModel | None
    coordinates: list[FloatArray]


def torsion_columns(features: Features) -> tuple[list[Segments], list[Segments]]:
    """Return the backbone torsions (phi, psi) and the side-chain ones (chi), each a list of segments `(n,)` in rad."""
    backbone: list[Segments] = [features.column("phi", k) for k in range(features.phi[0].shape[1])]
    backbone += [features.column("psi", k) for k in range(features.psi[0].shape[1])]
    # Folded torsions turn m times as fast; the recipe knows of no symmetry, but neither can what was measured.
    torsions = enumerate(features.probes.torsions if features.probes else ())
    return backbone, [features.column("torsions", k) for k, t in torsions if t.kind == "χ"]


def histogram_distance(p: Segments, q: Segments, low: float, high: float) -> float:
    """Return the Jensen-Shannon distance of two histograms of scalars on [low, high]; values outside do not count."""
    values = [np.concatenate([np.asarray(s, dtype=np.float64) for s in x]) for x in (p, q)]
    counts = [np.histogram(v[np.isfinite(v)], bins=N_BINS, range=(low, high))[0].astype(float) for v in values]
    return float(distributions.distance(counts[0], counts[1]))


def fit_recipe(reference: Features, *, n_clusters: int = N_CLUSTERS, n_states: int = N_STATES) -> Fit | None:
    """Fit TICA and the Markov state model of the recipe on the reference; None where nothing moves."""
    lag = max(1, round(LAG_PS / reference.lag_ps))
    features = tica_features(reference)
    projection = kinetics.fit_projection(features, lag, dim=features[0].shape[1], least=-1.0)
    if projection is None:
        return None
    coordinates = [projection.project(x) for x in features]
    return Fit(projection, kinetics.fit_model(coordinates, lag, n_clusters, n_states), coordinates)


def peptide_table(fit: Fit, reference: Features, other: Features) -> FloatArray:
    """Return the recipe's distances `(6,)`, those of `TABLE`, between the reference, on which `fit` was made, and
    another trajectory; NaN where there is nothing to average over."""
    backbone, side = (
        [histogram_distance(p, q, -math.pi, math.pi) for p, q in zip(ours, theirs, strict=True)]
        for ours, theirs in zip(torsion_columns(reference), torsion_columns(other), strict=True)
    )
    theirs = [fit.projection.project(x) for x in tica_features(other)]
    whole = [np.concatenate(x) for x in (fit.coordinates, theirs)]
    p, q = (x[np.isfinite(x).all(axis=1)] for x in whole)
    low, high = np.minimum(p.min(0), q.min(0)), np.maximum(p.max(0), q.max(0))
    tica_0 = histogram_distance([p[:, 0]], [q[:, 0]], float(low[0]), float(high[0]))
    tica_01 = states = math.nan
    if p.shape[1] > 1:
        box = [(low[0], high[0]), (low[1], high[1])]
        counts = [np.histogram2d(x[:, 0], x[:, 1], bins=N_BINS_JOINT, range=box)[0].ravel() for x in (p, q)]
        tica_01 = float(distributions.distance(counts[0], counts[1]))
    if fit.model is not None:
        labels = [np.concatenate(fit.model.lump(fit.model.assign(x))) for x in (fit.coordinates, theirs)]
        counts = [np.bincount(x[x >= 0], minlength=fit.model.n_states).astype(float) for x in labels]
        states = float(distributions.distance(counts[0], counts[1]))
    means = [float(np.mean(x)) if x else math.nan for x in (backbone, side, backbone + side)]
    return np.array([*means, tica_0, tica_01, states])


def peptide_charts(inputs: ComparisonInput) -> Measured:
    """Return the recipe's table as a bar chart, or why it was skipped."""
    name = f"The peptide papers' recipe (lag {format_time_ps(LAG_PS)}, {N_CLUSTERS} clusters, {N_STATES} states)"
    n = min(s.features.n_frames for s in inputs.samples)
    lag = LAG_PS / inputs.lag_ps
    if not inputs.options.peptide_recipe:
        return left_out(name, "not asked for")
    if not (len(inputs.torsions.phi) or len(inputs.torsions.psi)):
        return left_out(name, "the scene has no φ or ψ torsion")
    if abs(lag - round(lag)) > 1e-6 or lag < 1:
        return left_out(name, f"frames every {format_time_ps(inputs.lag_ps)} do not divide the lag")
    equal = [s.features.frames(0, n) for s in inputs.samples]
    if short := inputs.too_short(lag, equal):
        return left_out(name, short)
    reference, *others = equal
    if not all(np.isfinite(x).any() for f in others for x in (*f.phi, *f.psi)):
        return left_out(name, "a segment holds no finite frame")
    if n not in inputs.recipes:
        inputs.recipes[n] = fit_recipe(reference)
    fit: Fit | None = inputs.recipes[n]
    if fit is None:
        return left_out(name, kinetics.WITHOUT_TICA)
    candidate, replicate = (peptide_table(fit, reference, other) for other in others)
    known = np.isfinite(replicate)
    states = "no Markov state model"
    if fit.model is not None:
        n_clusters, n_states = len(fit.model.centres), fit.model.n_states
        states = f"a Markov state model of {n_clusters} clusters and {n_states} metastable states"
    caption = (
        "Jensen-Shannon distances to the reference (natural logarithm), as MDGen, JAMUN and LaM-SLidE print them: 100 "
        f"and 50 × 50 bins, TICA at 100 ps, {states}. Not evaluated."
    )
    names = tuple(n for n, k in zip(TABLE, known, strict=True) if k)
    numbers = [np.zeros(len(names)), candidate[known], replicate[known]]
    made = [[Estimate(x) for x in own.tolist()] for own in numbers]
    title, y_label = "By the peptide papers' recipe", "distance to the reference"
    return Measured(charts=[bar_chart("distributions", title, caption, y_label, names, made)])
