"""Rows of what moves fast: torsions within the states of slower ones and steps from frame to frame, in own blocks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.distributions import TORSION_BINS
from surrogate.comparison.measure.slow_motion import SLOW_KINDS, tica_features
from surrogate.comparison.measure.statistics import BLOCK_IN_CORRELATION_TIMES, MAX_BLOCKS, make_blocks
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    distance_row,
    make_sample,
    observable_row,
)
from surrogate.comparison.rows.torsion_rows import are_many
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]
Segments = Sequence[npt.NDArray[np.floating]]

_LEAST_SHARE = 0.05
_MOST_TORSIONS = 8
_STEP_TOLERANCE = 0.05
_LEAST_IN_STATE = 0.01
IntArray = npt.NDArray[np.int64]
# Of (reference, candidate, replicate), `(n,)` per segment.
ThreeSeries = Sequence[Sequence[FloatArray]]

N_STATES = 4
_STREAM = 40
_TICA_LAG_PS = 10.0
_WITHOUT_STRAYS = (0.0005, 0.9995)


def within_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of phi given psi's basin of every residue (of other molecules: of every rotatable torsion given the
    slowest motion).

    Within a state, what is left is remembered for a short while: blocks are many, and so is what they can tell.
    """
    skipped: list[Skipped] = []
    rows: list[Row | None] = []
    if are_many(inputs):
        skipped.append(("φ given ψ's basin", f"{len(inputs.torsions.residues)} residues share their rows"))
    elif inputs.torsions.residues:
        rows += [_phi_row(inputs, residue.phi, residue.psi, residue.label) for residue in inputs.torsions.residues]
    elif len(_rotatable(inputs)) > 1:
        rows.append(_given_slowest(inputs, slow_states(inputs)))
    if None in rows:
        skipped.append(("Torsions within the states of slower ones", "the three trajectories share none of them"))
    return Measured([row for row in rows if row is not None], skipped=skipped)


def step_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of the step of all torsions from frame to frame."""
    if not (len(inputs.torsions.phi) or len(inputs.torsions.psi) or _rotatable(inputs)):
        return Measured(skipped=[("Steps of torsions from frame to frame", "the scene has no torsion to turn about")])
    return Measured([_step_row(inputs, slow_states(inputs))])


def _rotatable(inputs: ComparisonInput) -> list[int]:
    probes = inputs.reference.features.probes
    return [] if probes is None else [k for k, t in enumerate(probes.torsions) if t.kind in SLOW_KINDS]


def _phi_row(inputs: ComparisonInput, phi: int, psi: int, label: str) -> Row | None:
    """The two basins of psi with phi < 0, and what else there is: a third state that is slow in itself, left out."""
    angles = [[x[:, phi] for x in s.features.phi] for s in inputs.samples]
    states = [
        [
            np.where(distributions.is_positive(f), -1, distributions.is_alpha(p[:, psi]).astype(np.int64))
            for f, p in zip(own, s.features.psi, strict=True)
        ]
        for own, s in zip(angles, inputs.samples, strict=True)
    ]
    return _conditional_row(
        inputs,
        [angles],
        states,
        key=f"phi_given_psi:{label}",
        metric=f"φ given ψ's basin, distance, {label}",
        what=f"φ of {label} within the basins of ψ is distributed",
    )


def _given_slowest(inputs: ComparisonInput, states: Sequence[Sequence[IntArray]]) -> Row | None:
    columns = _rotatable(inputs)[:_MOST_TORSIONS]
    angles = [[[x[:, k] for x in s.features.series["torsions"]] for s in inputs.samples] for k in columns]
    return _conditional_row(
        inputs,
        angles,
        states,
        key="torsions_given_slowest",
        metric=f"{len(columns)} rotatable torsions given the slowest motion, mean distance",
        what="rotatable torsions within states of the slowest motion are distributed",
    )


def _conditional_row(
    inputs: ComparisonInput,
    angles: Sequence[Sequence[Segments]],
    states: Sequence[Sequence[IntArray]],
    *,
    key: str,
    metric: str,
    what: str,
) -> Row | None:
    """`angles`: for each torsion those of (reference, candidate, replicate); `states`: of each frame, -1 for none. None
    where no state holds one frame in twenty of each of the three, of all of it and of the equal length."""
    n = min(s.features.n_frames for s in inputs.samples)
    flat = [np.concatenate(list(s)) + 1 for s in states]
    shares = [np.bincount(x, minlength=2) / len(x) for whole in flat for x in (whole, whole[:n])]
    n_states = min(map(len, shares)) - 1
    kept = [k for k in range(n_states) if min(share[k + 1] for share in shares) >= _LEAST_SHARE]
    if not kept:
        return None
    slowest, chosen = -1.0, inputs
    for three in angles:
        fine = with_own_blocks(inputs, residuals([[np.cos(x.astype(np.float64)) for x in v] for v in three], states))
        if fine.reference.blocks.n_frames_each > slowest:
            slowest, chosen = fine.reference.blocks.n_frames_each, fine
    counts, strata = [], []
    for which, sample in enumerate(chosen.samples):
        masked = [
            distributions.block_counts(
                [np.where(s == k, x, np.nan) for x, s in zip(three[which], states[which], strict=True)],
                TORSION_BINS,
                sample.blocks,
            )[:, : TORSION_BINS.n]
            for three in angles
            for k in kept
        ]
        counts.append(np.stack(masked, axis=1))
        strata.append(_majority(sample, states[which]))
    return distance_row(
        chosen,
        counts,
        key=key,
        group="distributions",
        metric=metric,
        statement=lambda ratio: f"{what} {ratio:.2g} times as far off as a replicate's",
        strata=strata,
    )


def _majority(sample: Sample, states: Sequence[IntArray]) -> IntArray:
    """Return the state that most frames of each block are in, `(n_blocks,)`."""
    n_states = int(max(int(s.max(initial=0)) for s in states)) + 2
    counts = np.zeros((sample.blocks.n_blocks, n_states))
    for piece in sample.blocks.pieces:
        part = states[piece.segment][piece.start : piece.stop] + 1
        counts[piece.block] += np.bincount(part, minlength=n_states)
    return np.asarray(counts.argmax(axis=1), dtype=np.int64)


def _squared_steps(inputs: ComparisonInput, sample: Sample) -> list[FloatArray]:
    """Return per segment the mean square step in rad² of all torsions from frame to frame, NaN after the last."""
    features = sample.features
    further = features.series.get("torsions")
    columns = _rotatable(inputs)
    out = []
    for k, (phi, psi) in enumerate(zip(features.phi, features.psi, strict=True)):
        angles = [phi, psi] if further is None else [phi, psi, further[k][:, columns]]
        step = np.diff(np.concatenate(angles, axis=1).astype(np.float64), axis=0)
        squared = ((step - 2 * np.pi * np.round(step / (2 * np.pi))) ** 2).mean(axis=1)
        out.append(np.append(squared, np.nan) if len(phi) else squared)
    return out


def _step_row(inputs: ComparisonInput, states: Sequence[Sequence[IntArray]]) -> Row:
    """The root mean square step, as if every trajectory were in the states of the slowest motion as often as the
    reference: a wrong time between frames shows here first.

    Only states that all three hold count: what one run alone has met, and steps in otherwise, is no wrong time.
    """
    squared = [_squared_steps(inputs, s) for s in inputs.samples]
    states = [
        [np.where((x >= 0) & (y >= 0), N_STATES * x + y, -1) for x, y in zip(own, apart, strict=True)]
        for own, apart in zip(states, states_apart(inputs), strict=True)
    ]
    fine = with_own_blocks(inputs, residuals(squared, states))
    flat = [np.concatenate(list(own)) for own in states]
    n_states = max(int(x.max(initial=0)) for x in flat) + 1
    frames = [np.bincount(x[x >= 0], minlength=n_states) for x in flat]
    shared = np.all([n >= _LEAST_IN_STATE * max(int(n.sum()), 1) for n in frames], axis=0)
    share = np.asarray(frames[0] + frames[2], dtype=np.float64)
    if shared.any():
        share[~shared] = 0.0
    values, draws = [], []
    for sample, steps, of in zip(fine.samples, squared, states, strict=True):
        total, count = np.zeros((sample.blocks.n_blocks, n_states)), np.zeros((sample.blocks.n_blocks, n_states))
        for piece in sample.blocks.pieces:
            part, state = (x[piece.segment][piece.start : piece.stop] for x in (steps, of))
            ok = np.isfinite(part) & (state >= 0)
            total[piece.block] += np.bincount(state[ok], weights=part[ok], minlength=n_states)[:n_states]
            count[piece.block] += np.bincount(state[ok], minlength=n_states)[:n_states]
        values.append(float(_standardised(total.sum(0), count.sum(0), share)))
        draws.append(_standardised(sample.weights @ total, sample.weights @ count, share))
    lag = format_time_ps(inputs.reference.features.lag_ps)
    return observable_row(
        fine,
        Quantity(
            "torsion_step",
            "kinetics",
            f"Step of all torsions from frame to frame ({lag}), root mean square",
            "°",
            _STEP_TOLERANCE,
            relative=True,
        ),
        values,
        draws,
        lambda c, r: f"torsions step by {c:.3g}° from frame to frame instead of {r:.3g}°" + _possible_causes(c, r),
    )


def _possible_causes(c: float, r: float) -> str:
    """Return what makes torsions step by `c` where the reference has `r`; the row cannot tell these apart."""
    if not math.isfinite(c) or c == r:
        return ""
    if c > r:
        return (
            "; possible causes: frames further apart in time than said, a higher temperature, less friction, another "
            "force field or solvent, or a model that moves too far in a step"
        )
    return (
        "; possible causes: frames closer in time than said, a lower temperature, more friction, another force field "
        "or solvent, smoothed frames, or a model that moves too little in a step"
    )


def _standardised(total: FloatArray, count: FloatArray, share: FloatArray) -> FloatArray:
    """Return the root in degrees of the means over states `(..., n_states)`, weighted by the reference's
    populations."""
    with np.errstate(invalid="ignore", divide="ignore"):
        means = total / count
        weight = np.where(count > 0, share, 0.0)
        return np.asarray(np.degrees(np.sqrt((np.nan_to_num(means) * weight).sum(-1) / weight.sum(-1))))


def with_own_blocks(inputs: ComparisonInput, series: ThreeSeries) -> ComparisonInput:
    """Return the comparison in blocks that are long enough for `series`, the slowest motion's at most.

    The least length of ten correlation times of the series, doubled until no longer one gives means that vary more than
    its own say (Flyvbjerg and Petersen, J. Chem. Phys. 91, 461, 1989): a weak slow part makes the blocks long again.
    """
    longest = inputs.reference.blocks.n_frames_each
    n = min(s.features.n_frames for s in inputs.samples)
    times = [kinetics.zero_crossing([x - np.nanmean(np.concatenate(s)) for x in s])[1] for s in series]
    slowest = max((t for t in times if math.isfinite(t)), default=1.0)
    each = min(max(math.ceil(BLOCK_IN_CORRELATION_TIMES * slowest), -(-n // MAX_BLOCKS)), longest)
    lengths = [each]
    while 2 * lengths[-1] <= longest:
        lengths.append(2 * lengths[-1])
    spread = [_variance_of_mean(series, length) for length in lengths]
    for k, length in enumerate(lengths):
        beyond = [v for v, _ in spread[k + 1 :]]
        doubt = [1.0 + 2.0 * math.sqrt(2.0 / max(degrees, 1)) for _, degrees in spread[k + 1 :]]
        if all(v <= d * spread[k][0] for v, d in zip(beyond, doubt, strict=True)):
            each = length
            break
    return in_blocks(inputs, each)


def in_blocks(inputs: ComparisonInput, each: int) -> ComparisonInput:
    """Return the comparison in blocks of `each` frames."""
    n = min(s.features.n_frames for s in inputs.samples)
    made: list[Sample] = [
        make_sample(s.features, make_blocks(s.features.segment_lengths, each), inputs.options, _STREAM + k, n)
        for k, s in enumerate(inputs.samples)
    ]
    return replace(inputs, reference=made[0], candidate=made[1], replicate=made[2])


def _variance_of_mean(series: ThreeSeries, length: int) -> tuple[float, int]:
    """Return the variance of means over blocks times their length, of all three, and its degrees of freedom."""
    total, freedom = 0.0, 0
    for segments in series:
        means = []
        for x in segments:
            count = len(x) // length
            if count:
                with np.errstate(invalid="ignore"):
                    means.append(np.nan_to_num(x[: count * length]).reshape(count, length).mean(axis=1))
        every = np.concatenate(means) if means else np.empty(0)
        if len(every) > 1:
            total += float(((every - every.mean()) ** 2).sum())
            freedom += len(every) - 1
    return (length * total / freedom if freedom else 0.0), freedom


def slow_states(inputs: ComparisonInput) -> list[list[IntArray]]:
    """Return the quarter of the reference's slowest motion (TIC 0) that each frame of each sample lies in, `(n,)` per
    segment: quarters hold equally many of its frames. All 0 where nothing turns or frames are too few for TICA, -1 for
    frames that are not finite."""
    features = [tica_features(s.features) for s in inputs.samples]
    return _in_quarters(
        inputs, features, [*features[0], *features[2]], lambda x: np.quantile(x, np.arange(1, N_STATES) / N_STATES)
    )


def states_apart(inputs: ComparisonInput) -> list[list[IntArray]]:
    """Return the same of the slowest motion of all three, its quarters equally wide: a state far from all others, which
    one run may visit once for long and another never, is a quarter of its own."""
    features = [tica_features(s.features) for s in inputs.samples]

    def edges(values: FloatArray) -> FloatArray:
        low, high = np.quantile(values, _WITHOUT_STRAYS)
        return np.asarray(np.linspace(low, high, N_STATES + 1)[1:-1])

    return _in_quarters(inputs, features, [x for own in features for x in own], edges)


def _in_quarters(
    inputs: ComparisonInput,
    features: Sequence[Sequence[FloatArray]],
    fitted: Sequence[FloatArray],
    edges: Callable[[FloatArray], FloatArray],
) -> list[list[IntArray]]:
    """Fit TICA to `fitted`, and put every frame of `features` between the `edges` of its values there."""
    lag = max(1, round(_TICA_LAG_PS / inputs.reference.features.lag_ps))
    model = kinetics.fit_tica(fitted, lag) if max(map(len, fitted)) > 10 * lag else None
    if model is None:
        return [[np.zeros(n, dtype=np.int64) for n in s.features.segment_lengths] for s in inputs.samples]
    values = np.concatenate([model.project(x) for x in fitted])
    between = edges(values[np.isfinite(values)])
    projected = [[model.project(x) for x in own] for own in features]
    return [
        [np.where(np.isfinite(p), np.searchsorted(between, p), -1).astype(np.int64) for p in own] for own in projected
    ]


def residuals(values: ThreeSeries, states: Sequence[Sequence[IntArray]]) -> list[list[FloatArray]]:
    """Return each value less its sample's mean over the frames of the same state; 0 where it is not finite."""
    out = []
    for own, of in zip(values, states, strict=True):
        flat, where = np.concatenate(list(own)), np.concatenate(list(of))
        rest = np.zeros(len(flat))
        for state in np.unique(where):
            inside = (where == state) & np.isfinite(flat)
            if inside.any():
                rest[inside] = flat[inside] - flat[inside].mean()
        out.append(np.split(rest, np.cumsum([len(x) for x in own])[:-1]))
    return out
