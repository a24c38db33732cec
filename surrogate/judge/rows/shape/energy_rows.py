"""Potential energies of every k-th frame, by a function that is handed in: the judge knows no force field."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.movie import pick_frames
from surrogate.judge.read.ensemble import Ensemble
from surrogate.judge.rows.block_means import block_means, bounds, mean_row
from surrogate.judge.rows.charts import Chart, Histogram
from surrogate.judge.rows.rows import Metric, Row, Trio
from systems.units import GAS_CONSTANT_KJ_MOL_K

FloatArray = npt.NDArray[np.float64]
# Positions `(n_atoms, 3)` nm of one frame to kJ/mol; not finite where the frame has none.
EnergyFn = Callable[[FloatArray], float]

_NAME = "Potential energy"
N_ENERGIES = 400
_HIGH_QUANTILE = 0.99
_BINS = 40


def measure_energies(ensemble: Ensemble, energy_fn: EnergyFn, n: int = N_ENERGIES) -> list[FloatArray]:
    """Return the energies of every k-th frame of each segment `(n_frames,)` kJ/mol, NaN for those between.

    k is chosen so that about `n` are computed. A frame whose energy is not finite, or higher than can be told from
    that, has infinity.
    """
    stride = max(1, ensemble.n_frames // n)
    out = [np.full(length, np.nan) for length in ensemble.segment_lengths]
    starts = np.concatenate([[0], np.cumsum(ensemble.segment_lengths)])
    for segment, values in enumerate(out):
        idx = np.arange(0, len(values), stride, dtype=np.int64)
        if not len(idx):
            continue
        frames = pick_frames(ensemble.segments, idx + starts[segment]).astype(np.float64)
        found = np.array([energy_fn(x) if np.isfinite(x).all() else np.inf for x in frames])
        values[idx] = np.where(np.isfinite(found), found, np.inf)
    return out


def energy_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return rows of the mean energy and of the share of frames above the reference's 99 % quantile; a histogram."""
    measured = [s.features.energy_kj for s in trio.samples]
    if any(m is None for m in measured):
        return [], [], [(_NAME, "no energy function was given")]
    series: list[Sequence[FloatArray]] = [m for m in measured if m is not None]
    known = [np.concatenate([x[~np.isnan(x)] for x in m]) for m in series]
    finite = known[0][np.isfinite(known[0])]
    if len(finite) < 20:
        return [], [], [(_NAME, "fewer than 20 energies of the reference are finite")]
    columns = [[x[:, None] for x in m] for m in series]
    low, high = bounds([c[np.isfinite(c[:, 0])] for c in columns[0]])
    # An exploded frame counts as the edge of these limits; only what was not computed is left out.
    cut = [[np.where(np.isposinf(c), high, c) for c in m] for m in columns]
    means = [block_means(s, c, (low, high)) for s, c in zip(trio.samples, cut, strict=True)]
    limit = float(np.quantile(finite, _HIGH_QUANTILE))
    above = [[np.where(np.isnan(c), np.nan, 100.0 * (c > limit)) for c in m] for m in columns]
    shares = [block_means(s, a) for s, a in zip(trio.samples, above, strict=True)]
    thermal_kj = GAS_CONSTANT_KJ_MOL_K * trio.temperature_k
    rows = [
        mean_row(
            trio,
            Metric(
                "energy_mean",
                "structure",
                f"{_NAME}, mean over {len(known[1])} frames",
                "kJ/mol",
                thermal_kj,
                tolerance_text="± RT",
            ),
            means,
            0,
            lambda c, r: f"the potential energy is {abs(c - r):.3g} kJ/mol too {'high' if c > r else 'low'}",
        ),
        mean_row(
            trio,
            Metric(
                "energy_high", "structure", f"Frames above {limit:.5g} kJ/mol, the reference's 99 % quantile", "%", 2.0
            ),
            shares,
            0,
            lambda c, r: f"{c:.2g} % of frames have an energy that {r:.2g} % of the reference reaches",
        ),
    ]
    return rows, [_histogram(known)], []


def _histogram(known: Sequence[FloatArray]) -> Histogram:
    """Densities from the reference's least energy to twice its range: where a poor candidate lies can be seen."""
    finite = known[0][np.isfinite(known[0])]
    low, span = float(finite.min()), max(float(np.ptp(finite)), 1e-6)
    edges = np.linspace(low - 0.2 * span, low + 2.0 * span, _BINS + 1)
    densities, outside = [], []
    for values in known:
        counts = np.histogram(values[np.isfinite(values)], bins=edges)[0]
        densities.append(counts / max(len(values), 1) / (edges[1] - edges[0]))
        outside.append(1.0 - float(counts.sum()) / max(len(values), 1))
    ref, cand, rep = densities
    return Histogram(_NAME, "kJ/mol", edges, ref, cand, rep, (outside[0], outside[1], outside[2]), section="validity")
