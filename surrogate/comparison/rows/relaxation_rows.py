"""How fast things move: rows and curves of the autocorrelation of cos psi and of TIC 0."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.slow_motion import SLOW_KINDS, tica_features
from surrogate.comparison.measure.statistics import Estimate, difference_p, estimate, widening
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.rows.charts import Chart, Line, LineChart
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    distance_row,
    histogram,
    observable_row,
    too_short,
)
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]

MAX_DRAWN_LAGS = 240
_LEAST_DRAWN = 50
_MIN_BOUNDARIES = 20
_MOST_RELAXING = 6
_SHARE_OF_WINDOW = 0.85
_NORMAL_KURTOSIS = 3.0


@dataclass(frozen=True, eq=False)
class _Correlated:
    """Autocorrelation `(n_lags,)` of one sample and its integral in frames, with bootstrap draws of the integral
    `(n_draws,)` and of the curve at some lags `(n_draws, n_kept)`."""

    curve: FloatArray
    time: float
    draws_time: FloatArray
    kept: npt.NDArray[np.int_]
    draws: FloatArray

    def band(self) -> tuple[FloatArray, FloatArray]:
        """Return the 95 % band at the kept lags."""
        if not np.isfinite(self.draws).any():
            nothing = np.full(len(self.kept), np.nan)
            return nothing, nothing
        low, high = np.nanquantile(self.draws, [0.025, 0.975], axis=0) - np.nanmean(self.draws, axis=0)
        return self.curve[self.kept] + low, self.curve[self.kept] + high


def turning(features: Features) -> list[tuple[str, str, list[FloatArray]]]:
    """Return what relaxation is told by: symbol, label and cosine `(n,)` per segment of every psi, or, where there is
    none, of every rotatable torsion, folded as it is."""
    if features.psi[0].shape[1] or features.probes is None:
        n = features.psi[0].shape[1]
        names = [("ψ", "") for _ in range(n)]
        columns = [[x[:, k] for x in features.psi] for k in range(n)]
    else:
        slow = [k for k, t in enumerate(features.probes.torsions) if t.kind in SLOW_KINDS]
        names = [("", features.probes.torsions[k].label) for k in slow]
        columns = [[x[:, k] for x in features.series["torsions"]] for k in slow]
    return [(s, label, [np.cos(x.astype(np.float64)) for x in c]) for (s, label), c in zip(names, columns, strict=True)]


def correlation_rows(inputs: ComparisonInput) -> Measured:
    """Return, for each psi or rotatable torsion, the row of its relaxation time and the chart of C(lag). Of more than
    `_MOST_RELAXING` torsions the slowest in the reference."""
    rows: list[Row] = []
    drawn: list[Chart] = []
    skipped: list[Skipped] = []
    moving = [turning(s.features) for s in inputs.samples]
    labels = [
        (f"cos {symbol}", inputs.torsions.psi_labels[k]) if symbol else ("cos", label)
        for k, (symbol, label, _) in enumerate(moving[0])
    ]
    chosen = list(range(len(labels)))
    if len(chosen) > _MOST_RELAXING:
        times = np.nan_to_num([kinetics.zero_crossing(series)[1] for _, _, series in moving[0]])
        chosen = sorted(np.argsort(-times)[:_MOST_RELAXING].tolist())
        skipped.append((f"Relaxation of {len(labels)} torsions", f"the {len(chosen)} slowest have rows"))
    lag_ps = inputs.reference.features.lag_ps
    for k in chosen:
        what, label = labels[k]
        series = [m[k][2] for m in moving]
        crossings = [kinetics.zero_crossing(s)[0] for s in series]
        longest = min(max(s.features.segment_lengths) for s in inputs.samples)
        n_lags = min(max(3 * max(crossings), _LEAST_DRAWN) + 1, longest, kinetics.MAX_LAG_FRAMES)
        # The picture shows the decay of the reference and the replicate; a stuck candidate must not stretch it.
        last_drawn = min(n_lags - 1, max(int(1.3 * max(crossings[0], crossings[2])), _LEAST_DRAWN))
        kept = np.unique(np.linspace(0, last_drawn, MAX_DRAWN_LAGS).astype(int))
        results = [_correlate(s, sample, n_lags, kept) for s, sample in zip(series, inputs.samples, strict=True)]
        rows.append(_time_row(inputs, results, what, label))
        x = kept * lag_ps
        zero = Line("", "other", x[[0, -1]], np.zeros(2))
        reference, candidate, replicate = (r.curve[kept] for r in results)
        lines = (
            Line("reference", "reference", x, reference, *results[0].band()),
            Line("replicate", "replicate", x, replicate),
            Line("candidate", "candidate", x, candidate, *results[1].band()),
        )
        title, caption = f"Autocorrelation of {what} {label}", "Bands are 95 % intervals."
        drawn.append(LineChart("kinetics", title, caption, "lag / ps", "C(lag)", (zero, *lines)))
    return Measured(rows, drawn, skipped)


def _correlate(series: Sequence[FloatArray], sample: Sample, n_lags: int, kept: npt.NDArray[np.int_]) -> _Correlated:
    sums = kinetics.lag_sums(series, sample.blocks, n_lags)
    curve = kinetics.autocorrelation(sums)
    times, values = [], []
    batch = max(1, int(2e6 // n_lags))
    for start in range(0, len(sample.weights), batch):
        drawn = kinetics.autocorrelation(sums, sample.weights[start : start + batch])
        times.append(kinetics.correlation_time(drawn))
        values.append(drawn[:, kept])
    time = float(kinetics.correlation_time(curve))
    below = np.flatnonzero(~(curve > 0))
    crossing = int(below[0]) if len(below) else n_lags
    draws = _widened(np.concatenate(times), sample.blocks.n_blocks, crossing, series)
    return _Correlated(curve, time, draws, kept, np.concatenate(values))


def _widened(draws: FloatArray, n_blocks: int, crossing: int, series: Sequence[FloatArray]) -> FloatArray:
    """Return bootstrap draws of an integrated autocorrelation time, spread as the sum over so many lags is at least.

    Blocks cut off what is remembered beyond them, so that their draws know too little of the tail: the relative
    variance of a sum to lag W over n frames is (k - 1) (2 W + 1) / n, with k = 3, the kurtosis of a normal series, in
    Madras and Sokal (J. Stat. Phys. 50, 109, 1988); what is seldom visited has a greater one, and few visits to tell
    its time by. `_SHARE_OF_WINDOW` is left where the window ends at the first zero (measured on series of known time).
    """
    known = np.isfinite(draws) & (draws > 0)
    if known.sum() < 2 or n_blocks < 2:
        return draws
    logs = np.log(draws[known])
    spread = float(logs.std()) * widening(n_blocks)
    values = np.concatenate(series)
    values = values[np.isfinite(values)] - np.nanmean(values)
    kurtosis = max(float((values**4).mean() / max(float((values**2).mean()) ** 2, 1e-300)), _NORMAL_KURTOSIS)
    least = _SHARE_OF_WINDOW * math.sqrt((kurtosis - 1.0) * (2.0 * crossing + 1.0) / len(values))
    if not 0.0 < spread < least:
        return draws
    out = draws.copy()
    out[known] = np.exp(logs.mean() + (logs - logs.mean()) * least / spread)
    return out


def relaxation_of(sample: Sample, k: int = 0) -> tuple[Estimate, Estimate]:
    """Return the autocorrelation of torsion `k` of `turning` after one frame, and its relaxation time in ps."""
    series = turning(sample.features)[k][2]
    longest = min(max(sample.features.segment_lengths), kinetics.MAX_LAG_FRAMES)
    n_lags = min(3 * kinetics.zero_crossing(series)[0] + 2, longest)
    found = _correlate(series, sample, n_lags, np.array([min(1, n_lags - 1)]))
    lag_ps, n_blocks = sample.features.lag_ps, sample.blocks.n_blocks
    return (
        estimate(float(found.curve[found.kept[0]]), found.draws[:, 0], n_blocks),
        estimate(found.time * lag_ps, found.draws_time * lag_ps, n_blocks, log=True),
    )


def _time_row(inputs: ComparisonInput, results: Sequence[_Correlated], what: str, label: str) -> Row:
    lag_ps = inputs.reference.features.lag_ps
    return observable_row(
        inputs,
        Quantity(
            f"correlation_time:{label}", "kinetics", f"Relaxation time of {what}, {label}", "ps", 0.2, relative=True
        ),
        [r.time * lag_ps for r in results],
        [r.draws_time * lag_ps for r in results],
        lambda c, r: speed_words(f"{what} of {label} relaxes", c, r),
    )


def speed_words(what: str, candidate: float, reference: float) -> str:
    if not math.isfinite(candidate):
        return f"{what} not at all: it does not move"
    if candidate <= 0:
        return f"{what} within one frame (reference {reference:.3g} ps)"
    if reference <= 0:
        return f"{what} in {candidate:.3g} ps, the reference within one frame"
    ratio = reference / candidate
    words = f"{ratio:.2g} times too fast" if ratio >= 1 else f"{1 / ratio:.2g} times too slowly"
    return f"{what} {words} ({candidate:.3g} ps instead of {reference:.3g} ps)"


def tica_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of TIC 0, fitted on the reference alone (distance, timescale); its histogram; what was skipped."""
    lag_ps = inputs.reference.features.lag_ps
    lag = max(1, round(inputs.options.tica_lag_ps / lag_ps))
    name = f"TICA at a lag of {format_time_ps(lag * lag_ps)}"
    features = [tica_features(s.features) for s in inputs.samples]
    if not features[0][0].shape[1]:
        return Measured(skipped=[(name, "the scene has no torsion to turn about")])
    if short := too_short([s.features for s in inputs.samples], lag):
        return Measured(skipped=[(name, short)])
    model = kinetics.fit_tica(features[0], lag)
    if model is None:
        return Measured(skipped=[(name, kinetics.WITHOUT_TICA)])
    projected = [[model.project(x) for x in segments] for segments in features]
    values, draws = [], []
    for sample, series in zip(inputs.samples, projected, strict=True):
        sums = kinetics.pair_sums(series, sample.blocks, lag)
        values.append(float(kinetics.timescale(kinetics.lagged_eigenvalue(sums), lag * lag_ps)))
        draws.append(kinetics.timescale(kinetics.lagged_eigenvalue(sums, sample.weights), lag * lag_ps))
    skipped: list[Skipped] = []
    bins = distributions.reference_bins(projected[0])
    counts = [
        distributions.block_counts(series, bins, sample.blocks)
        for sample, series in zip(inputs.samples, projected, strict=True)
    ]
    rows = [
        distance_row(
            inputs,
            counts,
            key="tic0_jsd",
            group="distributions",
            metric="TIC 0 distance",
            statement=lambda ratio: f"TIC 0 is {ratio:.2g} times as far from the reference as a replicate's",
        ),
        observable_row(
            inputs,
            Quantity(
                "tic0_timescale",
                "kinetics",
                f"Timescale of TIC 0 at a lag of {format_time_ps(lag * lag_ps)}",
                "ps",
                0.2,
                relative=True,
            ),
            values,
            draws,
            lambda c, r: speed_words("the slowest motion (TIC 0) decays", c, r),
        ),
    ]
    noise = kinetics.noise_timescale(features[0][0].shape[1], lag, inputs.reference.features.n_frames)
    if values[0] < lag_ps * noise:
        rows.pop()
        skipped.append((f"Timescale of {name}", "it cannot be told from noise"))
    return Measured(rows, [histogram(inputs, projected, bins, "TIC 0", "")], skipped)


def boundary_row(inputs: ComparisonInput) -> Measured:
    """Return the row that shows seams: the step of all torsions where a chunk begins, over that inside chunks."""
    name = "Steps across chunk boundaries"
    sample = inputs.candidate
    if sample.features.chunk_idx is None or not any((c >= 0).any() for c in sample.features.chunk_idx):
        return Measured(skipped=[(name, "the candidate's file marks no chunks")])
    if not (len(inputs.torsions.phi) or len(inputs.torsions.psi)):
        return Measured(skipped=[(name, "the scene has no φ or ψ torsion")])
    sums = np.zeros((4, sample.blocks.n_blocks))
    for piece in sample.blocks.pieces:
        window = slice(piece.start, piece.stop)
        angles = np.concatenate(
            [sample.features.phi[piece.segment][window], sample.features.psi[piece.segment][window]], axis=1
        )
        chunk = sample.features.chunk_idx[piece.segment][window]
        step = np.diff(angles.astype(np.float64), axis=0)
        squared = ((step - 2 * np.pi * np.round(step / (2 * np.pi))) ** 2).mean(1)
        at_seam = (chunk[1:] != chunk[:-1]) & np.isfinite(squared)
        within = (chunk[1:] == chunk[:-1]) & np.isfinite(squared)
        sums[:, piece.block] += (squared[at_seam].sum(), at_seam.sum(), squared[within].sum(), within.sum())
    total = sums.sum(1)
    if total[1] < _MIN_BOUNDARIES or not total[3]:
        why = f"fewer than {_MIN_BOUNDARIES} boundaries, or no two frames in one chunk"
        return Measured(skipped=[(name, why)])

    def ratio(s: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt((s[0] / s[1]) / (s[2] / s[3])))

    n = sample.blocks.n_blocks
    found = estimate(float(ratio(total)), ratio((sample.weights @ sums.T).T), n, log=True)
    seamless = Estimate(1.0, 1.0, 1.0, 0.0, 0.0, n)
    return Measured(
        [
            Row(
                key="chunk_step",
                group="kinetics",
                metric="φ/ψ step at chunk boundaries over the step inside chunks",
                unit="",
                form="observable",
                reference=seamless,
                candidate=found,
                replicate=None,
                ratio=found,
                p_value=difference_p(found, seamless, log=True),
                p_replicate=math.nan,
                tolerance=0.2,
                tolerance_text="± 20 %",
                statement=f"torsions jump {found.value:.2g} times as far where one chunk meets the next",
            )
        ]
    )
