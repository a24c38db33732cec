"""The temperature that bonds and angles vibrate at: their variances over the reference's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.equal_atoms import evenly
from surrogate.judge.measure.structure import CONSTRAINED_BELOW_NM
from surrogate.judge.read.rounding import angle_variance, length_error_nm
from surrogate.judge.rows.block_means import bounds, family_of
from surrogate.judge.rows.charts import Chart
from surrogate.judge.rows.rows import Metric, Row, Sample, Trio, observable_row

FloatArray = npt.NDArray[np.float64]

_NAME = "Temperature of vibrations"
_MOST_COLUMNS = 256
_TOLERANCE = 0.03
_LEAST_COLUMNS = 3


def temperature_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return the row of the reference's temperature times the median ratio of variances of bonds and angles to its own.

    A stiff coordinate's variance goes with the temperature (equipartition); bonds that are held by constraints are left
    out, and so are those that the rounding of the files makes vary more than the temperature does; of the others its
    part of the variance is taken off. A model that vibrates too much or too little reads as too hot or too cold.
    """
    columns = [_vibrations(s) for s in trio.samples]
    limits = bounds(columns[0])
    spread = np.concatenate(columns[0]).std(axis=0)
    rounding = _rounding_variance(trio, np.nanmean(np.concatenate(columns[0]), axis=0))
    loose = spread > 10 * CONSTRAINED_BELOW_NM
    moving = np.flatnonzero(loose & (spread**2 > 2.0 * rounding))
    if len(moving) < _LEAST_COLUMNS:
        hidden = loose.sum() >= _LEAST_COLUMNS
        why = "the rounding of the files hides how" if hidden else "fewer than three"
        return [], [], [(_NAME, f"{why} bonds and angles vibrate")]
    chosen = np.array(evenly(moving.tolist(), _MOST_COLUMNS))
    found = [_variances(s, [x[:, chosen] for x in c], (limits[0][chosen], limits[1][chosen]), rounding[chosen])
             for s, c in zip(trio.samples, columns, strict=True)]  # fmt: skip
    own = found[0][0]
    values = [trio.temperature_k * float(np.median(v / own)) for v, _ in found]
    draws = [trio.temperature_k * np.median(d / own, axis=1) for _, d in found]
    row = observable_row(
        trio,
        Metric(
            "temperature",
            "structure",
            f"{_NAME}: {len(chosen)} bonds and angles, by the reference's widths",
            "K",
            _TOLERANCE * trio.temperature_k,
            tolerance_text=f"± {100 * _TOLERANCE:g} %",
        ),
        values,
        draws,
        lambda c, r: f"bonds and angles vibrate as at {c:.0f} K instead of {r:.0f} K",
    )
    return [row], [], []


def _rounding_variance(trio: Trio, means: FloatArray) -> FloatArray:
    """Return what rounding adds to the variance of every column `(k,)`: bond lengths (nm²), then angles (rad²)."""
    grid_nm, probes, bonds = trio.reference.features.grid_nm, trio.reference.features.probes, trio.geometry.bond_idx
    out = np.full(len(means), length_error_nm(grid_nm) ** 2)
    if probes is not None and grid_nm > 0:
        length = {frozenset(pair): r for pair, r in zip(bonds.tolist(), means.tolist(), strict=False)}
        arms = np.array([[length[frozenset((b, x))] for x in (a, c)] for a, b, c in probes.angles.tolist()])
        arms = arms.reshape(-1, 2)
        out[len(bonds) :] = angle_variance(arms[:, 0], arms[:, 1], means[len(bonds) :], grid_nm)
    return out


def _vibrations(sample: Sample) -> list[npt.NDArray[np.floating]]:
    """Return bond lengths (nm) and angles (rad) side by side, `(n, k)` per segment."""
    return [
        np.concatenate([bonds, angles], axis=1)
        for bonds, angles in zip(sample.features.bonds_nm, family_of(sample, "angles"), strict=True)
    ]


def _variances(
    sample: Sample,
    segments: Sequence[npt.NDArray[np.floating]],
    limits: tuple[FloatArray, FloatArray],
    rounding: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the variance of every column `(k,)` and its bootstrap draws `(n_draws, k)`, values kept within limits,
    less what `rounding` `(k,)` adds to it."""
    n, first, second = (np.zeros((sample.blocks.n_blocks, segments[0].shape[1])) for _ in range(3))
    centre = 0.5 * (limits[0] + limits[1])
    for piece in sample.blocks.pieces:
        part = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = ~np.isnan(part)
        kept = np.where(finite, np.clip(part, *limits) - centre, 0.0)
        n[piece.block] += finite.sum(axis=0)
        first[piece.block] += kept.sum(axis=0)
        second[piece.block] += (kept**2).sum(axis=0)

    def variance(w: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            whole = (w @ second) / (w @ n) - ((w @ first) / (w @ n)) ** 2
            return np.asarray(np.where(rounding > 0, np.maximum(whole - rounding, 0.0), whole))

    return variance(np.ones((1, len(n))))[0], variance(sample.weights)
