"""How fast things move: relaxation of torsions, TIC 0, the Markov state model, steps across chunk boundaries."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.kinetics import MarkovModel, function_eigenvalue, noise_timescale, timescale
from surrogate.comparison.measure.slow_motion import slow_torsions, tica_features
from surrogate.comparison.measure.statistics import (
    BoolArray,
    Estimate,
    FloatArray,
    IntArray,
    difference_p,
    estimate,
    widening,
)
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.rows.charts import ROLES, Chart, Line, LineChart, Role
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    distance_row,
    histogram,
    left_out,
    observable_row,
    series_counts,
)
from surrogate.comparison.rows.torsion_rows import squared_turn
from systems.units import format_time_ps

MAX_DRAWN_LAGS = 240
_LEAST_DRAWN = 50
_MIN_BOUNDARIES = 20
_MOST_RELAXING = 6
_SHARE_OF_WINDOW = 0.85
_NORMAL_KURTOSIS = 3.0
# A process is of every state that carries this share of its variance in the reference.
_LEAST_SHARE = 0.25
_DRAWN_LAGS = (0.2, 0.5, 1.0, 2.0, 3.0, 5.0)


class _Correlated(NamedTuple):
    """Autocorrelation of one sample at some lags `(n_kept,)` and its integral in frames, with bootstrap draws of both
    `(n_draws, n_kept)`, `(n_draws,)`."""

    curve: FloatArray
    draws: FloatArray
    time: float
    draws_time: FloatArray

    def band(self) -> tuple[FloatArray, FloatArray]:
        """Return the 95 % band of the curve; NaN where nothing varies."""
        if not np.isfinite(self.draws).any():
            return np.full_like(self.curve, np.nan), np.full_like(self.curve, np.nan)
        low, high = np.nanquantile(self.draws, [0.025, 0.975], axis=0) - np.nanmean(self.draws, axis=0)
        return self.curve + low, self.curve + high


def turning(features: Features) -> list[tuple[str, str, list[FloatArray]]]:
    """Return what relaxation is measured by: symbol, label and cosine `(n,)` per segment of every psi, or, where there
    is none, of every rotatable torsion, folded as it is."""
    if features.psi[0].shape[1] or features.probes is None:
        found = [("ψ", "", features.column("psi", k)) for k in range(features.psi[0].shape[1])]
    else:
        torsions = features.probes.torsions
        found = [("", torsions[k].label, features.column("torsions", k)) for k in slow_torsions(features)]
    return [(symbol, label, [np.cos(x.astype(np.float64)) for x in column]) for symbol, label, column in found]


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
    longest = min(max(s.features.segment_lengths) for s in inputs.samples)
    for k in chosen:
        what, label = labels[k]
        series = [m[k][2] for m in moving]
        crossings = [kinetics.zero_crossing(s)[0] for s in series]
        n_lags = min(max(3 * max(crossings), _LEAST_DRAWN) + 1, longest, kinetics.MAX_LAG_FRAMES)
        # The picture shows the decay of the reference and the replicate; a stuck candidate must not stretch it.
        last_drawn = min(n_lags - 1, max(int(1.3 * max(crossings[0], crossings[2])), _LEAST_DRAWN))
        kept = np.unique(np.linspace(0, last_drawn, MAX_DRAWN_LAGS).astype(int))
        results = [_correlate(s, sample, n_lags, kept) for s, sample in zip(series, inputs.samples, strict=True)]
        values, draws = [r.time * inputs.lag_ps for r in results], [r.draws_time * inputs.lag_ps for r in results]
        name = f"Relaxation time of {what}, {label}"
        metric = Quantity(f"correlation_time:{label}", "kinetics", name, "ps", 0.2, relative=True)
        rows.append(observable_row(inputs, metric, values, draws))
        x = kept * inputs.lag_ps
        reference, candidate, replicate = (r.curve for r in results)
        lines = (
            Line("", "other", x[[0, -1]], np.zeros(2)),
            Line("reference", "reference", x, reference, *results[0].band()),
            Line("replicate", "replicate", x, replicate),
            Line("candidate", "candidate", x, candidate, *results[1].band()),
        )
        title, caption = f"Autocorrelation of {what} {label}", "Bands are 95 % intervals."
        drawn.append(LineChart("kinetics", title, caption, "lag / ps", "C(lag)", lines))
    return Measured(rows, drawn, skipped)


def _correlate(series: Sequence[FloatArray], sample: Sample, n_lags: int, kept: IntArray) -> _Correlated:
    sums = kinetics.lag_sums(series, sample.blocks, n_lags)
    curve = kinetics.autocorrelation(sums)
    times, values = [], []
    batch = max(1, int(2e6 // n_lags))
    for start in range(0, len(sample.weights), batch):
        drawn = kinetics.autocorrelation(sums, sample.weights[start : start + batch])
        times.append(kinetics.correlation_time(drawn))
        values.append(drawn[:, kept])
    below = np.flatnonzero(~(curve > 0))
    crossing = int(below[0]) if len(below) else n_lags
    draws = _widened(np.concatenate(times), sample.blocks.n_blocks, crossing, series)
    return _Correlated(curve[kept], np.concatenate(values), float(kinetics.correlation_time(curve)), draws)


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
        estimate(float(found.curve[0]), found.draws[:, 0], n_blocks),
        estimate(found.time * lag_ps, found.draws_time * lag_ps, n_blocks, log=True),
    )


def slow_rows(inputs: ComparisonInput) -> Measured:
    """Return rows and charts of TIC 0 and of a Markov state model, both fitted on the reference alone, and what was
    left out."""
    lag = kinetics.tica_lag(inputs.lag_ps)
    name = f"TICA at a lag of {format_time_ps(lag * inputs.lag_ps)}"
    features = [tica_features(s.features) for s in inputs.samples]
    if not features[0][0].shape[1]:
        return left_out(name, "no rotatable torsion")
    if short := inputs.too_short(lag):
        return left_out(name, short)
    projection = kinetics.fit_projection(features[0], lag)
    if projection is None:
        return left_out(name, kinetics.WITHOUT_TICA)
    coordinates = [[projection.project(x) for x in segments] for segments in features]
    tic_0 = [[x[:, 0] for x in segments] for segments in coordinates]
    bins = distributions.reference_bins(tic_0[0])
    row = distance_row(inputs, series_counts(inputs, tic_0, bins), "tic0_jsd", "distributions", "TIC 0 distance")
    rows, charts, skipped = _markov_model(inputs, coordinates, lag)
    return Measured([row, *rows], [histogram(inputs, tic_0, bins, "TIC 0", ""), *charts], skipped)


def boundary_row(inputs: ComparisonInput) -> Measured:
    """Return the row that shows seams: the step of phi and psi where a chunk begins, over that inside chunks."""
    name = "Steps across chunk boundaries"
    sample, features = inputs.candidate, inputs.candidate.features
    if features.chunk_idx is None or not (len(inputs.torsions.phi) or len(inputs.torsions.psi)):
        return left_out(name, "the candidate's file marks no chunks, or the scene has no φ or ψ torsion")
    # Squared steps and how many, at seams and within chunks.
    sums = np.zeros((4, sample.blocks.n_blocks))
    for piece in sample.blocks.pieces:
        series = (features.phi, features.psi, features.chunk_idx)
        phi, psi, chunk = (x[piece.segment][piece.start : piece.stop] for x in series)
        squared = squared_turn(np.concatenate([phi, psi], axis=1))
        seam, known = chunk[1:] != chunk[:-1], np.isfinite(squared)
        for k, of in enumerate((seam & known, ~seam & known)):
            sums[2 * k : 2 * k + 2, piece.block] += squared[of].sum(), of.sum()
    total = sums.sum(1)
    if total[1] < _MIN_BOUNDARIES or not total[3]:
        return left_out(name, f"fewer than {_MIN_BOUNDARIES} boundaries, or no two frames in one chunk")

    def ratio(s: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt((s[0] / s[1]) / (s[2] / s[3])))

    n = sample.blocks.n_blocks
    found = estimate(float(ratio(total)), ratio((sample.weights @ sums.T).T), n, log=True)
    seamless = Estimate(1.0, 1.0, 1.0, 0.0, 0.0, n)
    row = Row(
        key="chunk_step",
        group="kinetics",
        metric="φ/ψ step at chunk boundaries over the step inside chunks",
        form="observable",
        reference=seamless,
        candidate=found,
        ratio=found,
        p_value=difference_p(found, seamless, log=True),
        tolerance=0.2,
        tolerance_text="± 20 %",
        statement=f"torsions jump {found.value:.2g} times as far where one chunk meets the next",
    )
    return Measured([row])


class _States(NamedTuple):
    """The frames of one sample in the states of the reference, and their sums per block at the model's lag; `role`:
    whose it is."""

    sample: Sample
    role: Role
    micro: list[IntArray]
    macro: list[IntArray]
    occupancy: FloatArray
    transitions: FloatArray
    micro_counts: FloatArray

    def never_held(self) -> BoolArray:
        """Return for each metastable state `(n_states,)` whether the sample is never in it at both ends of a lag. A
        frame that strays across its border now and then is no visit."""
        return np.asarray(np.diag(_square(self.transitions.sum(0))) == 0)


def _square(counts: FloatArray) -> FloatArray:
    n = math.isqrt(len(counts))
    return counts.reshape(n, n)


def _markov_model(inputs: ComparisonInput, coordinates: Sequence[list[FloatArray]], lag: int) -> Measured:
    """Return the rows and charts of a Markov state model fitted on the reference, and why there are none."""
    lag_ps = lag * inputs.lag_ps
    name = f"Markov state model at a lag of {format_time_ps(lag_ps)}"
    model = kinetics.fit_model(coordinates[0], lag)
    if model is None:
        return left_out(name, "the reference visits too few states, or none that hold together")
    noise_ps = inputs.lag_ps * noise_timescale(len(model.centres), lag, inputs.reference.features.n_frames)
    if not len(model.timescales) or inputs.lag_ps * model.timescales[0] < noise_ps:
        return left_out(name, "its slowest process may be noise")
    states = [_states(model, s, r, x) for s, r, x in zip(inputs.samples, ROLES, coordinates, strict=True)]
    names = state_names(inputs, states[0].macro, model.n_states)
    metric = f"Populations of {model.n_states} metastable states, distance"
    rows = [distance_row(inputs, [s.occupancy for s in states], "msm_jsd", "distributions", metric)]
    timescales, skipped = _timescale_rows(inputs, model, states, names, noise_ps)
    if all(s.transitions.sum() for s in states):
        metric = f"Transitions between metastable states within {format_time_ps(lag_ps)}, distance"
        rows.append(distance_row(inputs, [s.transitions for s in states], "transition_jsd", "kinetics", metric))
    else:
        skipped.append(("Transitions between metastable states", "one of the trajectories is in none of them"))
    return Measured([*rows, *timescales], [_timescale_chart(inputs, model, states, names)], skipped)


def _states(model: MarkovModel, sample: Sample, role: Role, coordinates: list[FloatArray]) -> _States:
    micro = model.assign(coordinates)
    macro = model.lump(micro)
    transitions, micro_counts = (
        kinetics.block_transitions(labels, sample.blocks, n, model.lag_frames)
        for labels, n in ((macro, model.n_states), (micro, len(model.centres)))
    )
    occupancy = kinetics.state_counts(macro, sample.blocks, model.n_states)
    return _States(sample, role, micro, macro, occupancy, transitions, micro_counts)


def state_names(inputs: ComparisonInput, macro: Sequence[IntArray], n_states: int) -> list[str]:
    """Return a name per state: with few torsions their mean angles in the reference, else a number."""
    features = inputs.reference.features
    few = 1 <= len(inputs.torsions.phi) + len(inputs.torsions.psi) <= 2
    names = []
    for k in range(n_states):
        parts = []
        for symbol, series in (("φ", features.phi), ("ψ", features.psi)):
            if few and series[0].shape[1]:
                inside = np.concatenate([x[m == k, 0] for x, m in zip(series, macro, strict=True)])
                parts.append(f"{symbol} {np.degrees(kinetics.circular_mean(inside)):.0f}°")
        names.append(f"state {k + 1}" + (f" ({', '.join(parts)})" if parts else ""))
    return names


def _named(names: Sequence[str], chosen: BoolArray) -> str:
    return " and ".join(names[i] for i in np.flatnonzero(chosen).tolist())


def _timescale_rows(
    inputs: ComparisonInput, model: MarkovModel, states: Sequence[_States], names: Sequence[str], noise_ps: float
) -> tuple[list[Row], list[Skipped]]:
    """Return a row for each slow process of the reference, and those that the candidate's data say nothing about.

    The process that leads into a state where the candidate never stays cannot be timed there: what its function
    decays by in such a trajectory is motion within the other states.
    """
    lag = model.lag_frames * inputs.lag_ps
    counts = _square(states[0].micro_counts.sum(0))
    _, functions = kinetics.slow_functions(counts, model.n_states - 1)
    rows: list[Row] = []
    skipped: list[Skipped] = []
    for k, function in enumerate(functions, 1):
        name = f"Implied timescale {k} of the Markov state model"
        # The states that carry much of the process's variance.
        weight = (counts.sum(0) + counts.sum(1)) * function**2
        inside = model.state_of >= 0
        share = np.bincount(model.state_of[inside], weights=weight[inside], minlength=model.n_states)
        of = share >= _LEAST_SHARE * weight.sum()
        missing, missing_in_replicate = (of & s.never_held() for s in states[1:])
        if missing.any():
            where = _named(names, missing)
            skipped.append((name, f"the candidate never stays in {where}, into which this process leads"))
            continue
        values = [float(timescale(function_eigenvalue(s.micro_counts, function), lag)) for s in states]
        if values[0] < noise_ps:
            skipped.append((name, f"{values[0]:.2g} ps: may be noise at this lag"))
            continue
        draws = [timescale(function_eigenvalue(s.micro_counts, function, s.sample.weights), lag) for s in states]
        if missing_in_replicate.any():
            values[2], draws[2] = math.nan, np.full_like(draws[2], np.nan)
        metric = Quantity(f"msm_timescale:{k}", "kinetics", name, "ps", 0.2, relative=True)
        rows.append(observable_row(inputs, metric, values, draws))
    return rows, skipped


def _timescale_chart(
    inputs: ComparisonInput, model: MarkovModel, states: Sequence[_States], names: Sequence[str]
) -> Chart:
    """Implied timescales against the lag they were estimated at: level where the model is Markovian. Of what never
    stays in one of the states there is one process less."""
    n_micro, n_slow = len(model.centres), model.n_states - 1
    longest = min(max(s.sample.features.segment_lengths) for s in states)
    lags = sorted({max(1, round(f * model.lag_frames)) for f in _DRAWN_LAGS})
    lags = [lag for lag in lags if 10 * lag <= longest]
    lines = []
    caption = "Of the Markov state model against the lag it is estimated at; states are those of the reference."
    for s in states:
        missing = s.never_held()
        if missing.any():
            caption += f" The {s.role} never stays in {_named(names, missing)}, and has so many processes less."
        counts = [kinetics.block_transitions(s.micro, s.sample.blocks, n_micro, lag).sum(0) for lag in lags]
        values = [kinetics.slow_functions(_square(c), n_slow)[0] for c in counts]
        times = np.array([timescale(v, lag * inputs.lag_ps) for v, lag in zip(values, lags, strict=True)])
        lines += [
            Line(f"{s.role}, process {k + 1}", s.role, np.array(lags) * inputs.lag_ps, times[:, k])
            for k in range(n_slow - int(missing.sum()))
        ]
    title, y_label = "Implied timescales", "timescale / ps"
    return LineChart("kinetics", title, caption, "lag / ps", y_label, tuple(lines), log_y=True)
