"""Rows of what moves fast, looked at within the states of what moves slowly, in blocks of its own."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import distributions
from surrogate.judge.measure.distributions import TORSION_BINS
from surrogate.judge.measure.slow_motion import SLOW_KINDS
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.metrics import are_many
from surrogate.judge.rows.own_blocks import N_STATES, IntArray, residuals, slow_states, states_apart, with_own_blocks
from surrogate.judge.rows.rows import Metric, Row, Sample, Trio, distance_row, observable_row
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]
Skipped = tuple[str, str]
Segments = Sequence[npt.NDArray[np.floating]]

_LEAST_SHARE = 0.05
_MOST_TORSIONS = 8
_STEP_TOLERANCE = 0.05
_LEAST_IN_STATE = 0.01


def within_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows of phi given psi's basin of every residue (of other molecules: of every rotatable torsion given the
    slowest motion), and of the step of all torsions from frame to frame.

    Within a state, what is left is remembered for a short while: blocks are many, and so is what they can tell.
    """
    if not (len(trio.torsions.phi) or len(trio.torsions.psi) or _rotatable(trio)):
        return [], [], [("Steps of torsions from frame to frame", "the scene has no torsion to turn about")]
    skipped: list[Skipped] = []
    rows: list[Row | None] = []
    states = slow_states(trio)
    if are_many(trio):
        skipped.append(("φ given ψ's basin", f"{len(trio.torsions.residues)} residues share their rows"))
    elif trio.torsions.residues:
        rows += [_phi_row(trio, residue.phi, residue.psi, residue.label) for residue in trio.torsions.residues]
    elif len(_rotatable(trio)) > 1:
        rows.append(_given_slowest(trio, states))
    if None in rows:
        skipped.append(("Torsions within the states of slower ones", "the three trajectories share none of them"))
    step = _step_row(trio, states)
    return [*(row for row in rows if row is not None), step], [], skipped


def _rotatable(trio: Trio) -> list[int]:
    probes = trio.reference.features.probes
    return [] if probes is None else [k for k, t in enumerate(probes.torsions) if t.kind in SLOW_KINDS]


def _phi_row(trio: Trio, phi: int, psi: int, label: str) -> Row | None:
    """The two basins of psi with phi < 0, and what else there is: a third state that is slow in itself, left out."""
    angles = [[x[:, phi] for x in s.features.phi] for s in trio.samples]
    states = [
        [
            np.where(distributions.is_positive(f), -1, distributions.is_alpha(p[:, psi]).astype(np.int64))
            for f, p in zip(own, s.features.psi, strict=True)
        ]
        for own, s in zip(angles, trio.samples, strict=True)
    ]
    return _conditional_row(
        trio,
        [angles],
        states,
        key=f"phi_given_psi:{label}",
        metric=f"φ given ψ's basin, distance, {label}",
        what=f"φ of {label} within the basins of ψ is distributed",
    )


def _given_slowest(trio: Trio, states: Sequence[Sequence[IntArray]]) -> Row | None:
    columns = _rotatable(trio)[:_MOST_TORSIONS]
    angles = [[[x[:, k] for x in s.features.series["torsions"]] for s in trio.samples] for k in columns]
    return _conditional_row(
        trio,
        angles,
        states,
        key="torsions_given_slowest",
        metric=f"{len(columns)} rotatable torsions given the slowest motion, mean distance",
        what="rotatable torsions within states of the slowest motion are distributed",
    )


def _conditional_row(
    trio: Trio,
    angles: Sequence[Sequence[Segments]],
    states: Sequence[Sequence[IntArray]],
    *,
    key: str,
    metric: str,
    what: str,
) -> Row | None:
    """`angles`: for each torsion those of (reference, candidate, replicate); `states`: of each frame, -1 for none. None
    where no state holds one frame in twenty of each of the three, of all of it and of the equal length."""
    n = min(s.features.n_frames for s in trio.samples)
    flat = [np.concatenate(list(s)) + 1 for s in states]
    shares = [np.bincount(x, minlength=2) / len(x) for whole in flat for x in (whole, whole[:n])]
    n_states = min(map(len, shares)) - 1
    kept = [k for k in range(n_states) if min(share[k + 1] for share in shares) >= _LEAST_SHARE]
    if not kept:
        return None
    slowest, chosen = -1.0, trio
    for three in angles:
        fine = with_own_blocks(trio, residuals([[np.cos(x.astype(np.float64)) for x in v] for v in three], states))
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


def _squared_steps(trio: Trio, sample: Sample) -> list[FloatArray]:
    """Return per segment the mean square step in rad² of all torsions from frame to frame, NaN after the last."""
    features = sample.features
    further = features.series.get("torsions")
    columns = _rotatable(trio)
    out = []
    for k, (phi, psi) in enumerate(zip(features.phi, features.psi, strict=True)):
        angles = [phi, psi] if further is None else [phi, psi, further[k][:, columns]]
        step = np.diff(np.concatenate(angles, axis=1).astype(np.float64), axis=0)
        squared = ((step - 2 * np.pi * np.round(step / (2 * np.pi))) ** 2).mean(axis=1)
        out.append(np.append(squared, np.nan) if len(phi) else squared)
    return out


def _step_row(trio: Trio, states: Sequence[Sequence[IntArray]]) -> Row:
    """The root mean square step, as if every trajectory were in the states of the slowest motion as often as the truth:
    a wrong time between frames shows here first.

    Only states that all three hold count: what one run alone has met, and steps in otherwise, is no wrong time.
    """
    squared = [_squared_steps(trio, s) for s in trio.samples]
    states = [
        [np.where((x >= 0) & (y >= 0), N_STATES * x + y, -1) for x, y in zip(own, apart, strict=True)]
        for own, apart in zip(states, states_apart(trio), strict=True)
    ]
    fine = with_own_blocks(trio, residuals(squared, states))
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
    lag = format_time_ps(trio.reference.features.lag_ps)
    return observable_row(
        fine,
        Metric(
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
    """Return the root in degrees of the means over states `(..., n_states)`, weighted by the truth's populations."""
    with np.errstate(invalid="ignore", divide="ignore"):
        means = total / count
        weight = np.where(count > 0, share, 0.0)
        return np.asarray(np.degrees(np.sqrt((np.nan_to_num(means) * weight).sum(-1) / weight.sum(-1))))
