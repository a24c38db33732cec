"""Blocks of their own for what moves fast, and the states within which it is looked at."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import kinetics
from surrogate.judge.measure.slow_motion import tica_features
from surrogate.judge.measure.statistics import BLOCK_IN_CORRELATION_TIMES, MAX_BLOCKS, make_blocks
from surrogate.judge.rows.rows import Sample, Trio, make_sample

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
# Of (reference, candidate, replicate), `(n,)` per segment.
ThreeSeries = Sequence[Sequence[FloatArray]]

N_STATES = 4
_STREAM = 40
_TICA_LAG_PS = 10.0
_WITHOUT_STRAYS = (0.0005, 0.9995)


def with_own_blocks(trio: Trio, series: ThreeSeries) -> Trio:
    """Return the comparison in blocks that are long enough for `series`, the slowest motion's at most.

    The least length of ten correlation times of the series, doubled until no longer one gives means that vary more than
    its own say (Flyvbjerg and Petersen, J. Chem. Phys. 91, 461, 1989): a weak slow part makes the blocks long again.
    """
    longest = trio.reference.blocks.n_frames_each
    n = min(s.features.n_frames for s in trio.samples)
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
    return in_blocks(trio, each)


def in_blocks(trio: Trio, each: int) -> Trio:
    """Return the comparison in blocks of `each` frames."""
    n = min(s.features.n_frames for s in trio.samples)
    made: list[Sample] = [
        make_sample(s.features, make_blocks(s.features.segment_lengths, each), trio.options, _STREAM + k, n)
        for k, s in enumerate(trio.samples)
    ]
    return replace(trio, reference=made[0], candidate=made[1], replicate=made[2])


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


def slow_states(trio: Trio) -> list[list[IntArray]]:
    """Return the quarter of the truth's slowest motion (TIC 0) that each frame of each sample lies in, `(n,)` per
    segment: quarters hold equally many of its frames. All 0 where nothing turns or frames are too few for TICA, -1 for
    frames that are not finite."""
    features = [tica_features(s.features) for s in trio.samples]
    return _in_quarters(
        trio, features, [*features[0], *features[2]], lambda x: np.quantile(x, np.arange(1, N_STATES) / N_STATES)
    )


def states_apart(trio: Trio) -> list[list[IntArray]]:
    """Return the same of the slowest motion of all three, its quarters equally wide: a state far from all others, which
    one run may visit once for long and another never, is a quarter of its own."""
    features = [tica_features(s.features) for s in trio.samples]

    def edges(values: FloatArray) -> FloatArray:
        low, high = np.quantile(values, _WITHOUT_STRAYS)
        return np.asarray(np.linspace(low, high, N_STATES + 1)[1:-1])

    return _in_quarters(trio, features, [x for own in features for x in own], edges)


def _in_quarters(
    trio: Trio,
    features: Sequence[Sequence[FloatArray]],
    fitted: Sequence[FloatArray],
    edges: Callable[[FloatArray], FloatArray],
) -> list[list[IntArray]]:
    """Fit TICA to `fitted`, and put every frame of `features` between the `edges` of its values there."""
    lag = max(1, round(_TICA_LAG_PS / trio.reference.features.lag_ps))
    model = kinetics.fit_tica(fitted, lag) if max(map(len, fitted)) > 10 * lag else None
    if model is None:
        return [[np.zeros(n, dtype=np.int64) for n in s.features.segment_lengths] for s in trio.samples]
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
