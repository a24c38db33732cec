"""Time correlation within segments: autocorrelation, its integral, TICA fitted on the reference.

Nothing here pairs frames of two different segments. Frames that are not finite drop out of every pair they belong to
(their number is evaluated elsewhere); the rest of the segment keeps its place in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.statistics import Blocks

FloatArray = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]

MAX_LAG_FRAMES = 50_000
FRAMES_A_FEATURE = 2
WITHOUT_TICA = "the torsions of the reference do not move, or its frames are too few for so many torsions"


@dataclass(frozen=True, eq=False)
class LagSums:
    """Sums over pairs (t, t + lag) that start in a block, each `(n_blocks, n_lags)`, lag 0 first.

    `xy`: products, `head` and `tail`: the first and the second factor alone, `n`: how many pairs.
    """

    xy: FloatArray
    head: FloatArray
    tail: FloatArray
    n: FloatArray


def lag_sums(segments: Sequence[AnyFloat], blocks: Blocks, n_lags: int) -> LagSums:
    """Return the lagged sums of a scalar series by FFT.

    A pair belongs to the block in which it starts and may end in the next one, but never in another segment, so that
    the sum over blocks is exactly the sum over all pairs.
    """
    out = [np.zeros((blocks.n_blocks, n_lags)) for _ in range(4)]
    for piece in blocks.pieces:
        series = np.asarray(segments[piece.segment], dtype=np.float64)
        tail = series[piece.start : min(piece.stop + n_lags - 1, len(series))]
        n_head = piece.stop - piece.start
        size = 1 << (len(tail) + n_head - 1).bit_length()
        finite = np.isfinite(tail)
        values = np.where(finite, tail, 0.0)
        present = finite.astype(np.float64)
        tail_x, tail_1 = np.fft.rfft(values, size), np.fft.rfft(present, size)
        head_x = np.conj(np.fft.rfft(values[:n_head], size))
        head_1 = np.conj(np.fft.rfft(present[:n_head], size))
        keep = min(n_lags, len(tail))
        products = (head_x * tail_x, head_x * tail_1, head_1 * tail_x, head_1 * tail_1)
        for total, product in zip(out, products, strict=True):
            total[piece.block, :keep] += np.fft.irfft(product, size)[:keep]
    return LagSums(out[0], out[1], out[2], np.rint(out[3]))


def autocorrelation(sums: LagSums, weights: FloatArray | None = None) -> FloatArray:
    """Return the normalised autocorrelation `(n_lags,)`; `(n_draws, n_lags)` for block weights `(n_draws, n_blocks)`.

    C(l) = <(x_t - m)(x_{t+l} - m)> / <(x_t - m)^2>, m the mean over all segments, averages over the pairs that exist.
    NaN where there is no pair, and everywhere when the series does not vary.
    """
    w = np.ones((1, len(sums.n))) if weights is None else weights
    n, xy, head, tail = (w @ a for a in (sums.n, sums.xy, sums.head, sums.tail))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (head[:, :1]) / n[:, :1]
        covariance = xy / n - mean * (head + tail) / n + mean**2
        variance = covariance[:, :1]
        scale = np.abs(xy[:, :1] / n[:, :1]) + mean**2
        out = np.where(variance > 1e-12 * scale, covariance / variance, np.nan)
    return out[0] if weights is None else out


def correlation_time(correlation: FloatArray) -> npt.NDArray[np.float64]:
    """Return the integrated autocorrelation time in frames, trapezoid rule, up to the first zero crossing.

    `correlation` is `(..., n_lags)`. The last interval ends at the linearly interpolated zero. A curve that never
    crosses is integrated to its end; NaN in gives NaN. For an AR(1) process with coefficient a the infinite sum is
    (1 + a) / (2 (1 - a)).
    """
    c = np.atleast_2d(correlation)
    n = c.shape[-1]
    below = ~(c > 0)
    first = np.where(below.any(-1), below.argmax(-1), n)
    positive = np.where(np.arange(n) < first[:, None], c, 0.0)
    total = positive.sum(-1) - 0.5 * positive[:, 0]
    rows = np.arange(len(c))
    last = np.clip(first - 1, 0, n - 1)
    at_last, at_first = c[rows, last], c[rows, np.clip(first, 0, n - 1)]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(first < n, at_last / (at_last - at_first), 0.0)
    # The trapezoid up to `last` holds half of its last value; beyond it the triangle down to the crossing.
    total = total - 0.5 * at_last + np.where(first < n, 0.5 * at_last * np.nan_to_num(share), 0.0)
    total = np.where(np.isfinite(c[:, 0]), total, np.nan)
    return np.asarray(total if np.ndim(correlation) > 1 else total[0])


def zero_crossing(segments: Sequence[AnyFloat]) -> tuple[int, float]:
    """Return the first lag (frames) at which the autocorrelation of all segments is not positive, and the time to it.

    The second number is `correlation_time` in frames. Without a crossing the lag is the longest that can be had; NaN
    time when the series does not vary.
    """
    longest = max((len(s) for s in segments), default=0)
    if longest < 2:
        return max(longest, 1), math.nan
    pieces = Blocks.whole([len(s) for s in segments])
    n_lags, ceiling = min(longest, 512), min(longest, MAX_LAG_FRAMES)
    while True:
        c = autocorrelation(lag_sums(segments, pieces, n_lags))
        if not math.isfinite(c[0]):
            return n_lags, math.nan
        below = ~(c > 0)
        if below.any() or n_lags >= ceiling:
            first = int(below.argmax()) if below.any() else n_lags
            return first, float(correlation_time(c))
        n_lags = min(ceiling, n_lags * 8)


@dataclass(frozen=True, eq=False)
class PairSums:
    """Per block `(n_blocks,)`, over pairs at one lag: products, sum and sum of squares of both ends, pairs."""

    products: FloatArray
    ends: FloatArray
    squares: FloatArray
    n: FloatArray


def pair_sums(segments: Sequence[AnyFloat], blocks: Blocks, lag: int) -> PairSums:
    """Return the sums over pairs `lag` frames apart that `lagged_eigenvalue` needs."""
    out = np.zeros((4, blocks.n_blocks))
    for piece in blocks.pieces:
        series = np.asarray(segments[piece.segment], dtype=np.float64)
        x = series[piece.start : min(piece.stop, max(len(series) - lag, 0))]
        y = series[piece.start + lag : piece.start + lag + len(x)]
        ok = np.isfinite(x) & np.isfinite(y)
        x, y = x[ok], y[ok]
        out[:, piece.block] += np.array([x @ y, (x + y).sum(), x @ x + y @ y, len(x)])
    return PairSums(*out)


def lagged_eigenvalue(sums: PairSums, weights: FloatArray | None = None) -> FloatArray:
    """Return the time-symmetrised autocorrelation at one lag, 0-d, or `(n_draws,)` for weights `(n_draws, n_blocks)`.

    2 S_xy / (S_xx + S_yy) with the mean of both ends removed: on the series that TICA was fitted to this is TICA's own
    eigenvalue (reversible estimator), so every trajectory is measured with the same rule.
    """
    w = np.ones((1, len(sums.n))) if weights is None else weights
    n, products, ends, squares = (w @ a for a in (sums.n, sums.products, sums.ends, sums.squares))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = ends / (2 * n)
        covariance = products / n - mean**2
        variance = squares / (2 * n) - mean**2
        out = np.where(variance > 1e-12 * (mean**2 + squares / n), covariance / variance, np.nan)
    return np.asarray(out[0] if weights is None else out)


def timescale(eigenvalue: npt.ArrayLike, lag: float) -> npt.NDArray[np.float64]:
    """Return -lag / ln(eigenvalue), in the unit of `lag`; 0 for an eigenvalue of at most 0 (gone within one lag)."""
    value = np.asarray(eigenvalue, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        out = np.where(value > 0, -lag / np.log(np.clip(value, 1e-300, 1 - 1e-12)), 0.0)
    return np.where(np.isfinite(value), out, np.nan)


def noise_timescale(n_parameters: int, lag: float, n_frames: float) -> float:
    """Return the timescale, in the unit of `lag`, that a process found among so many parameters has by chance.

    `lag` and `n_frames` in frames. The greatest eigenvalue of noise goes with the root of parameters over independent
    pairs (Marchenko and Pastur); half of it is a choice, made on replicas of rigid molecules. Infinite:
    nothing can be told.
    """
    eigenvalue = 0.5 * math.sqrt(n_parameters * lag / max(n_frames, 1.0))
    return math.inf if eigenvalue >= 1.0 else float(timescale(eigenvalue, lag))


@dataclass(frozen=True, eq=False)
class Tica:
    """The slowest linear combination of features, fitted on the reference."""

    mean: FloatArray
    weights: FloatArray
    lag_frames: int
    eigenvalue: float

    def project(self, features: AnyFloat) -> FloatArray:
        """Return TIC 0, `(n_frames,)`, of `(n_frames, n_features)`; NaN where a feature is not finite."""
        with np.errstate(invalid="ignore"):
            return (np.asarray(features, dtype=np.float64) - self.mean) @ self.weights


def circular_features(*torsions_rad: AnyFloat) -> FloatArray:
    """Return cos and sin of torsions `(n_frames, k)`, side by side, `(n_frames, 2 * sum of k)`."""
    parts = [f(np.asarray(t, dtype=np.float64)) for t in torsions_rad for f in (np.cos, np.sin)]
    return np.concatenate(parts, axis=1)


def fit_tica(segments: Sequence[FloatArray], lag_frames: int) -> Tica | None:
    """Fit TICA (reversible, mean removed; deeptime) to features `(n_frames, n_features)`; None when nothing varies, or
    frames are so few that a slow combination would be found in any noise.

    Pairs never cross a segment, nor a frame that is not finite. The sign of TIC 0 is chosen so that its skewness is
    positive: the rare state lies on the right. Source: Perez-Hernandez et al., J. Chem. Phys. 139, 015102 (2013).
    """
    fitted = tica_model(segments, lag_frames, 1)
    if fitted is None:
        return None
    model, runs = fitted
    vector = np.real(np.asarray(model.singular_vectors_left)[:, 0]).astype(np.float64)
    mean = np.asarray(model.mean_0, dtype=np.float64)
    projected = np.concatenate([(run - mean) @ vector for run in runs])
    if float(((projected - projected.mean()) ** 3).sum()) < 0:
        vector = -vector
    return Tica(mean, vector, lag_frames, float(np.real(model.singular_values[0])))


def tica_model(segments: Sequence[FloatArray], lag_frames: int, dim: int) -> tuple[Any, list[FloatArray]] | None:
    """Return deeptime's model of features `(n_frames, n_features)` and the runs of finite frames it was fitted to; None
    where `can_be_fitted` says so."""
    from deeptime.decomposition import TICA

    runs = [run for s in segments for run in finite_runs(s) if len(run) > lag_frames and run.shape[1]]
    if not can_be_fitted(runs):
        return None
    covariance = TICA.covariance_estimator(lagtime=lag_frames)
    for run in runs:
        covariance.partial_fit((run[:-lag_frames], run[lag_frames:]))
    return TICA(lagtime=lag_frames, dim=dim).fit_from_covariances(covariance).fetch_model(), runs


def can_be_fitted(runs: Sequence[FloatArray]) -> bool:
    """Return whether TICA of `runs` `(n_frames, n_features)` means anything: something varies, and there are at least
    `FRAMES_A_FEATURE` frames for each feature."""
    if not runs or max(float(run.std(0).max()) for run in runs) < 1e-9:
        return False
    return sum(map(len, runs)) >= FRAMES_A_FEATURE * runs[0].shape[1]


def finite_runs(features: FloatArray) -> list[FloatArray]:
    """Return the stretches of consecutive finite rows."""
    finite = np.isfinite(features).all(axis=1)
    if finite.all():
        return [features]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], finite.view(np.int8), [0]])))
    return [features[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]
