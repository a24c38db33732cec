"""Rows and charts of the Markov state model: populations, transitions, timescales, Chapman-Kolmogorov test."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions, msm
from surrogate.comparison.measure.kinetics import WITHOUT_TICA, lagged_eigenvalue, noise_timescale, timescale
from surrogate.comparison.measure.slow_motion import tica_features
from surrogate.comparison.measure.statistics import estimate
from surrogate.comparison.rows.charts import ROLES, Chart, Landscape, Line, LineChart, Role, bar_chart
from surrogate.comparison.rows.relaxation_rows import speed_words
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    distance_row,
    observable_row,
    too_short,
)
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_CHECKED_LAGS = 5
# A process is of every state that carries this share of its variance in the reference.
_LEAST_SHARE = 0.25
_DRAWN_LAGS = (0.2, 0.5, 1.0, 2.0, 3.0, 5.0)
_LANDSCAPE_BINS = 50
_BAND_DRAWS = 60


@dataclass(frozen=True, eq=False)
class _States:
    """The frames of one sample in the states of the reference, and their sums per block at the model's lag."""

    sample: Sample
    coordinates: list[FloatArray]
    micro: list[IntArray]
    macro: list[IntArray]
    occupancy: FloatArray
    transitions: FloatArray
    micro_counts: FloatArray


def msm_rows(inputs: ComparisonInput) -> Measured:
    """Return the rows and charts of a Markov state model fitted on the reference, and why there are none."""
    lag_ps = inputs.reference.features.lag_ps
    lag = max(1, round(inputs.options.tica_lag_ps / lag_ps))
    name = f"Markov state model at a lag of {format_time_ps(lag * lag_ps)}"
    features = [tica_features(s.features) for s in inputs.samples]
    if not features[0][0].shape[1]:
        return Measured(skipped=[(name, "the scene has no torsion to turn about")])
    if short := too_short([s.features for s in inputs.samples], lag):
        return Measured(skipped=[(name, short)])
    projection = msm.fit_projection(features[0], lag)
    if projection is None:
        return Measured(skipped=[(name, WITHOUT_TICA)])
    coordinates = [[projection.project(x) for x in segments] for segments in features]
    model = msm.fit_model(projection, coordinates[0], lag)
    if model is None:
        return Measured(skipped=[(name, "the reference visits too few states, or none that hold together")])
    noise_ps = lag_ps * noise_timescale(len(model.centres), lag, inputs.reference.features.n_frames)
    if not len(model.timescales) or lag_ps * model.timescales[0] < noise_ps:
        return Measured(skipped=[(name, "its slowest process cannot be told from noise")])
    states = [_states(model, s, x) for s, x in zip(inputs.samples, coordinates, strict=True)]
    names = state_names(inputs, states[0].macro, model.n_states)
    rows = [_population_row(inputs, states)]
    timescales, skipped = _timescale_rows(inputs, model, states, names, noise_ps)
    if all(s.transitions.sum() for s in states):
        rows.append(_transition_row(inputs, states, format_time_ps(lag * lag_ps)))
    else:
        skipped.append(("Transitions between metastable states", "one of the trajectories is in none of them"))
    rows += timescales
    charts: list[Chart] = [*_landscape(inputs, states), _free_energies(inputs, model, states, names)]
    charts += [_check_chart(inputs, model, s, role) for s, role in zip(states[:2], ROLES, strict=False)]
    charts.append(_timescale_chart(inputs, model, states, names))
    return Measured(rows, charts, skipped)


def _states(model: msm.Model, sample: Sample, coordinates: list[FloatArray]) -> _States:
    micro = model.assign(coordinates)
    macro = model.lump(micro)
    return _States(
        sample,
        coordinates,
        micro,
        macro,
        msm.block_occupancy(macro, sample.blocks, model.n_states),
        msm.block_transitions(macro, sample.blocks, model.n_states, model.lag_frames),
        msm.block_transitions(micro, sample.blocks, len(model.centres), model.lag_frames),
    )


def state_names(inputs: ComparisonInput, macro: Sequence[IntArray], n_states: int) -> list[str]:
    """Return a name per state: with few torsions their mean angles in the reference, else a number."""
    columns = inputs.torsions
    few = 1 <= len(columns.phi) + len(columns.psi) <= 2
    names = []
    for k in range(n_states):
        parts = []
        for symbol, series in (("φ", inputs.reference.features.phi), ("ψ", inputs.reference.features.psi)):
            if few and series[0].shape[1]:
                inside = np.concatenate([x[m == k, 0] for x, m in zip(series, macro, strict=True)])
                parts.append(f"{symbol} {np.degrees(msm.circular_mean(inside)):.0f}°")
        names.append(f"state {k + 1}" + (f" ({', '.join(parts)})" if parts else ""))
    return names


def _population_row(inputs: ComparisonInput, states: Sequence[_States]) -> Row:
    n = states[0].occupancy.shape[1] - 1
    return distance_row(
        inputs,
        [s.occupancy for s in states],
        key="msm_jsd",
        group="distributions",
        metric=f"Populations of {n} metastable states, distance",
        statement=lambda ratio: f"the metastable states are {ratio:.2g} times as far off as a replicate's",
    )


def _transition_row(inputs: ComparisonInput, states: Sequence[_States], lag: str) -> Row:
    return distance_row(
        inputs,
        [s.transitions for s in states],
        key="transition_jsd",
        group="kinetics",
        metric=f"Transitions between metastable states within {lag}, distance",
        statement=lambda ratio: f"transitions between states are {ratio:.2g} times as far off as a replicate's",
    )


def _never_held(s: _States) -> npt.NDArray[np.bool_]:
    """Return for each metastable state `(n_states,)` whether a sample is never in it at both ends of a lag.

    A frame that strays across its border now and then is no visit.
    """
    n = s.occupancy.shape[1] - 1
    return np.asarray(np.diag(s.transitions.sum(0).reshape(n, n)) == 0)


def _states_of(model: msm.Model, function: FloatArray, counts: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which metastable states `(n_states,)` a process is of: those that carry much of its variance.

    `function` `(n_micro,)` of mean zero in the reference, whose transition counts are `counts` `(n_micro, n_micro)`.
    """
    weight = (counts.sum(0) + counts.sum(1)) * function**2
    inside = model.state_of >= 0
    share = np.bincount(model.state_of[inside], weights=weight[inside], minlength=model.n_states)
    return np.asarray(share >= _LEAST_SHARE * weight.sum())


def _timescale_rows(
    inputs: ComparisonInput, model: msm.Model, states: Sequence[_States], names: Sequence[str], noise_ps: float
) -> tuple[list[Row], list[Skipped]]:
    """Return a row for each slow process of the reference, and those that the candidate's data say nothing about.

    The process that leads into a state where the candidate never stays cannot be timed there: what its function
    decays by in such a trajectory is motion within the other states.
    """
    lag_ps = inputs.reference.features.lag_ps
    lag = model.lag_frames * lag_ps
    n_slow, n_micro = model.n_states - 1, len(model.centres)
    counts = states[0].micro_counts.sum(0).reshape(n_micro, n_micro)
    _, functions = msm.slow_functions(counts, n_slow)
    rows: list[Row] = []
    skipped: list[Skipped] = []
    for k, function in enumerate(functions):
        metric = f"Implied timescale {k + 1} of the Markov state model"
        of = _states_of(model, function, counts)
        _, missing, missing_in_replicate = (of & _never_held(s) for s in states)
        if missing.any():
            where = " and ".join(names[i] for i in np.flatnonzero(missing).tolist())
            skipped.append((metric, f"the candidate never stays in {where}, into which this process leads"))
            continue
        sums = [msm.function_sums(s.micro_counts, function) for s in states]
        values = [float(timescale(lagged_eigenvalue(own), lag)) for own in sums]
        if values[0] < noise_ps:
            skipped.append((metric, f"{values[0]:.2g} ps: cannot be told from noise at this lag"))
            continue
        draws = [timescale(lagged_eigenvalue(own, s.sample.weights), lag) for own, s in zip(sums, states, strict=True)]
        if missing_in_replicate.any():
            values[2], draws[2] = math.nan, np.full_like(draws[2], np.nan)
        rows.append(
            observable_row(
                inputs,
                Quantity(f"msm_timescale:{k + 1}", "kinetics", metric, "ps", 0.2, relative=True),
                values,
                draws,
                lambda c, r, k=k: speed_words(f"process {k + 1} of the Markov state model decays", c, r),  # type: ignore[misc]
            )
        )
    return rows, skipped


def _landscape(inputs: ComparisonInput, states: Sequence[_States]) -> list[Chart]:
    if states[0].coordinates[0].shape[1] < 2:
        return []
    edges = [
        distributions.reference_bins([c[:, k] for c in states[0].coordinates], _LANDSCAPE_BINS).edges for k in range(2)
    ]

    def counts(s: _States) -> FloatArray:
        x = np.concatenate(s.coordinates)
        x = x[np.isfinite(x).all(axis=1)]
        return np.asarray(np.histogram2d(x[:, 0], x[:, 1], bins=edges)[0])

    ref, cand, rep = map(counts, states)
    return [Landscape("distributions", "TICA landscape", "TIC 0", "TIC 1", edges[0], edges[1], ref, cand, rep)]


def _free_energies(inputs: ComparisonInput, model: msm.Model, states: Sequence[_States], names: Sequence[str]) -> Chart:
    """Free energies of the states above the most populated one, -RT ln(p / p_0), with error bars; not evaluated
    twice."""
    thermal_kj = GAS_CONSTANT_KJ_MOL_K * inputs.temperature_k
    found = []
    for s in states:
        total, drawn = s.occupancy.sum(0), s.sample.weights @ s.occupancy
        with np.errstate(divide="ignore", invalid="ignore"):
            value = -thermal_kj * np.log(total[1:-1] / total[0])
            draws = -thermal_kj * np.log(drawn[:, 1:-1] / drawn[:, :1])
        found.append([estimate(float(v), draws[:, k], s.sample.blocks.n_blocks) for k, v in enumerate(value)])
    title = "Free energies of the metastable states"
    caption = f"Above {names[0]}, at {inputs.temperature_k:g} K: -RT ln of the ratio of populations, 95 % intervals."
    return bar_chart("distributions", title, caption, "ΔG / kJ/mol", names[1:], found)


def _check_chart(inputs: ComparisonInput, model: msm.Model, s: _States, role: Role) -> Chart:
    """Does the model of one lag predict the next four? Circles of the estimate on lines of the prediction."""
    lag_ps = model.lag_frames * inputs.reference.features.lag_ps
    n = model.n_states
    longest = max(s.sample.features.segment_lengths)
    steps = [i for i in range(1, _CHECKED_LAGS + 1) if 2 * i * model.lag_frames < longest]
    counts = [
        msm.block_transitions(s.macro, s.sample.blocks, n, i * model.lag_frames).sum(0).reshape(n, n) for i in steps
    ]
    predicted, estimated = msm.chapman_kolmogorov(counts)
    gap = float(np.nanmax(np.abs(predicted - estimated))) if np.isfinite(estimated).any() else math.nan
    x = np.array(steps) * lag_ps
    lines = [Line(f"state {k + 1}, observed", role, x, estimated[:, k]) for k in range(n)]
    lines += [Line(f"state {k + 1}, predicted", "other", x, predicted[:, k]) for k in range(n)]
    return LineChart(
        section="kinetics",
        title=f"Chapman-Kolmogorov test, {role}",
        caption="Probability to be in the state one started in: observed, and predicted from the shortest lag by a "
        f"Markov chain of the metastable states. Largest difference {gap:.2g}.",
        x_label="lag / ps",
        y_label="probability to be back",
        lines=tuple(lines),
    )


def _square(counts: FloatArray) -> FloatArray:
    n = math.isqrt(len(counts))
    return counts.reshape(n, n)


def _timescale_chart(
    inputs: ComparisonInput, model: msm.Model, states: Sequence[_States], names: Sequence[str]
) -> Chart:
    """Implied timescales against the lag they were estimated at: level where the model is Markovian.

    Of what never stays in one of the states there is one process less.
    """
    lag_ps = inputs.reference.features.lag_ps
    n_micro, n_slow = len(model.centres), model.n_states - 1
    longest = min(max(s.sample.features.segment_lengths) for s in states)
    lags = sorted({max(1, round(f * model.lag_frames)) for f in _DRAWN_LAGS})
    lags = [lag for lag in lags if 10 * lag <= longest]
    lines = []
    caption = "Of the Markov state model against the lag it is estimated at; states are those of the reference; bands "
    caption += "hold 95 % of bootstrap draws."
    for s, role in zip(states, ROLES, strict=True):
        missing = _never_held(s)
        if missing.any():
            where = " and ".join(names[i] for i in np.flatnonzero(missing).tolist())
            caption += f" The {role} never stays in {where}, and has so many processes less."
        times, drawn = [], []
        for lag in lags:
            per_block = msm.block_transitions(s.micro, s.sample.blocks, n_micro, lag)
            times.append(timescale(msm.slow_functions(_square(per_block.sum(0)), n_slow)[0], lag * lag_ps))
            of_draws = [msm.slow_functions(_square(w @ per_block), n_slow)[0] for w in s.sample.weights[:_BAND_DRAWS]]
            drawn.append(np.nanquantile(timescale(np.array(of_draws), lag * lag_ps), [0.025, 0.975], axis=0))
        table, bands = np.array(times), np.array(drawn)
        n_own = n_slow - int(missing.sum())
        lines += [
            Line(f"{role}, process {k + 1}", role, np.array(lags) * lag_ps, table[:, k], bands[:, 0, k], bands[:, 1, k])
            for k in range(n_own)
        ]
    return LineChart(
        section="kinetics",
        title="Implied timescales",
        caption=caption,
        x_label="lag / ps",
        y_label="timescale / ps",
        lines=tuple(lines),
        log_y=True,
    )
