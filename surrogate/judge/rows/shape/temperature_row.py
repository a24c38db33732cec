"""The temperature that bonds and angles vibrate at: their variances over the reference's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.equal_atoms import evenly
from surrogate.judge.measure.structure import CONSTRAINED_BELOW_NM
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
    out. A model that vibrates too much or too little reads as too hot or too cold.
    """
    columns = [_vibrations(s) for s in trio.samples]
    limits = bounds(columns[0])
    moving = np.flatnonzero(np.concatenate(columns[0]).std(axis=0) > 10 * CONSTRAINED_BELOW_NM)
    if len(moving) < _LEAST_COLUMNS:
        return [], [], [(_NAME, "fewer than three bonds and angles vibrate")]
    chosen = np.array(evenly(moving.tolist(), _MOST_COLUMNS))
    found = [_variances(s, [x[:, chosen] for x in c], (limits[0][chosen], limits[1][chosen]))
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


def _vibrations(sample: Sample) -> list[npt.NDArray[np.floating]]:
    """Return bond lengths (nm) and angles (rad) side by side, `(n, k)` per segment."""
    return [
        np.concatenate([bonds, angles], axis=1)
        for bonds, angles in zip(sample.features.bonds_nm, family_of(sample, "angles"), strict=True)
    ]


def _variances(
    sample: Sample, segments: Sequence[npt.NDArray[np.floating]], limits: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the variance of every column `(k,)` and its bootstrap draws `(n_draws, k)`, values kept within limits."""
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
            return np.asarray((w @ second) / (w @ n) - ((w @ first) / (w @ n)) ** 2)

    return variance(np.ones((1, len(n))))[0], variance(sample.weights)
