"""Estimators of how fast things move: autocorrelation and its integral, TICA, a Markov state model by deeptime.

TICA and the Markov model (torsions -> TICA -> k-means -> transition counts -> PCCA) are fitted on the reference alone,
and other trajectories are put into its coordinates and states. Nothing pairs frames of two different segments. Frames
that are not finite drop out of every pair they belong to; the rest of the segment keeps its place in time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.distributions import count_in_blocks
from surrogate.comparison.measure.statistics import AnyFloat, Blocks, FloatArray, IntArray

MAX_LAG_FRAMES = 50_000
TICA_LAG_PS = 10.0
# Fewer frames for each feature, and TICA means nothing.
_FRAMES_A_FEATURE = 2
WITHOUT_TICA = "the torsions of the reference do not move, or its frames are too few for so many torsions"
MAX_DIMENSIONS = 5
_N_MICROSTATES = 50
_MAX_STATES = 4
_CLUSTERED_FRAMES = 10_000


class LagSums(NamedTuple):
    """Sums over pairs (t, t + lag) that start in a block, each `(n_blocks, n_lags)`, lag 0 first: products, first and
    second factor alone, how many pairs."""

    xy: FloatArray
    head: FloatArray
    tail: FloatArray
    n: FloatArray


def lag_sums(segments: Sequence[AnyFloat], blocks: Blocks, n_lags: int) -> LagSums:
    """Return the lagged sums of a scalar series by FFT.

    A pair belongs to the block in which it starts and may end in the next one, but never in another segment, so that
    the sum over blocks is exactly the sum over all pairs.
    """
    from scipy.fft import next_fast_len

    out = [np.zeros((blocks.n_blocks, n_lags)) for _ in range(4)]
    for piece in blocks.pieces:
        series = np.asarray(segments[piece.segment], dtype=np.float64)
        tail = series[piece.start : min(piece.stop + n_lags - 1, len(series))]
        n_head = piece.stop - piece.start
        size = next_fast_len(len(tail) + n_head - 1, real=True)
        keep = min(n_lags, len(tail))
        finite = np.isfinite(tail)
        values = np.where(finite, tail, 0.0)
        tail_x, head_x = np.fft.rfft(values, size), np.conj(np.fft.rfft(values[:n_head], size))
        out[0][piece.block, :keep] += np.fft.irfft(head_x * tail_x, size)[:keep]
        if finite.all():  # what is left are sums over the first and the last of the values
            begin = np.arange(keep)
            n = np.minimum(n_head, len(tail) - begin)
            upto = np.concatenate([[0.0], values.cumsum()])
            sums = [upto[n], upto[begin + n] - upto[begin], n]
        else:
            tail_1, head_1 = np.fft.rfft(finite, size), np.conj(np.fft.rfft(finite[:n_head], size))
            products = (head_x * tail_1, head_1 * tail_x, head_1 * tail_1)
            sums = [np.fft.irfft(product, size)[:keep] for product in products]
        for total, found in zip(out[1:], sums, strict=True):
            total[piece.block, :keep] += found
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


def correlation_time(correlation: FloatArray) -> FloatArray:
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
            return (int(below.argmax()) if below.any() else n_lags), float(correlation_time(c))
        n_lags = min(ceiling, n_lags * 8)


def timescale(eigenvalue: npt.ArrayLike, lag: float) -> FloatArray:
    """Return -lag / ln(eigenvalue), in the unit of `lag`; 0 for an eigenvalue of at most 0 (gone within one lag)."""
    value = np.asarray(eigenvalue, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        out = np.where(value > 0, -lag / np.log(np.clip(value, 1e-300, 1 - 1e-12)), 0.0)
    return np.where(np.isfinite(value), out, np.nan)


def noise_timescale(n_parameters: int, lag: float, n_frames: float) -> float:
    """Return the timescale, in the unit of `lag`, that a process found among so many parameters has by chance; infinite
    where every process may be noise. `lag` and `n_frames` in frames. The greatest eigenvalue of noise goes with the
    root of parameters over independent pairs (Marchenko and Pastur); half of it is a choice, made on replicas of rigid
    molecules."""
    eigenvalue = 0.5 * math.sqrt(n_parameters * lag / max(n_frames, 1.0))
    return math.inf if eigenvalue >= 1.0 else float(timescale(eigenvalue, lag))


def circular_features(*torsions_rad: AnyFloat) -> FloatArray:
    """Return cos and sin of torsions `(n_frames, k)`, side by side, `(n_frames, 2 * sum of k)`."""
    parts = [f(np.asarray(t, dtype=np.float64)) for t in torsions_rad for f in (np.cos, np.sin)]
    return np.concatenate(parts, axis=1)


def circular_mean(angles_rad: AnyFloat) -> float:
    """Return the mean direction in radians; NaN for none."""
    finite = angles_rad[np.isfinite(angles_rad)]
    return math.nan if not len(finite) else float(np.arctan2(np.sin(finite).mean(), np.cos(finite).mean()))


class Projection(NamedTuple):
    """Slow coordinates of the reference: features `(n, k)` less `mean`, times `matrix` `(k, n_dimensions)`;
    `eigenvalues` `(n_dimensions,)` at the lag of the fit."""

    mean: FloatArray
    matrix: FloatArray
    eigenvalues: FloatArray

    def project(self, features: AnyFloat) -> FloatArray:
        """Return coordinates `(n, n_dimensions)`; NaN where a feature is not finite."""
        with np.errstate(invalid="ignore"):
            return np.asarray((np.asarray(features, dtype=np.float64) - self.mean) @ self.matrix)


def tica_lag(lag_ps: float) -> int:
    """Return the lag of TICA in frames `lag_ps` apart."""
    return max(1, round(TICA_LAG_PS / lag_ps))


def fit_projection(
    segments: Sequence[FloatArray], lag_frames: int, dim: int = MAX_DIMENSIONS, *, least: float = 0.01
) -> Projection | None:
    """Return deeptime's TICA (reversible, mean removed) of features `(n, k)`, scaled as a kinetic map; None where
    nothing varies, or frames are so few that any noise has a slow combination.

    At most `dim` coordinates are kept, those whose eigenvalue exceeds `least` and in any case the first. The rare side
    of each is positive. Sources: Perez-Hernandez et al., J. Chem. Phys. 139, 015102 (2013); Noe and Clementi, J. Chem.
    Theory Comput. 11, 5002 (2015).
    """
    from deeptime.decomposition import TICA
    from deeptime.numeric import ZeroRankError

    runs = [run for s in segments for run in finite_runs(s) if len(run) > lag_frames and run.shape[1]]
    if not runs or max(float(run.std(0).max()) for run in runs) < 1e-9:
        return None
    if sum(map(len, runs)) < _FRAMES_A_FEATURE * runs[0].shape[1]:
        return None
    covariance = TICA.covariance_estimator(lagtime=lag_frames)
    for run in runs:
        covariance.partial_fit((run[:-lag_frames], run[lag_frames:]))
    try:
        model = TICA(lagtime=lag_frames, dim=dim).fit_from_covariances(covariance).fetch_model()
    except ZeroRankError:  # nothing varies by more than rounding
        return None
    values = np.real(np.asarray(model.singular_values))[:dim]
    kept = max(int((values > least).sum()), 1)
    vectors = np.real(np.asarray(model.singular_vectors_left))[:, :kept]
    matrix = vectors * np.clip(np.abs(values[:kept]), 1e-6, 1.0)
    found = Projection(np.asarray(model.mean_0, dtype=np.float64), matrix, values[:kept])
    projected = np.concatenate([found.project(run) for run in runs])
    skewness = ((projected - projected.mean(axis=0)) ** 3).sum(axis=0)
    return Projection(found.mean, np.where(skewness < 0, -matrix, matrix), found.eigenvalues)


def finite_runs(features: FloatArray) -> list[FloatArray]:
    """Return the stretches of consecutive finite rows."""
    finite = np.isfinite(features).all(axis=1)
    if finite.all():
        return [features]
    edges = np.flatnonzero(np.diff(np.concatenate([[0], finite.view(np.int8), [0]])))
    return [features[a:b] for a, b in zip(edges[::2], edges[1::2], strict=True)]


def k_means(coordinates: FloatArray, n: int, max_iter: int) -> Any:
    """Return deeptime's model of `n` clusters of finite coordinates `(n_frames, n_dimensions)`."""
    from deeptime.clustering import KMeans

    sample = coordinates[:: max(1, len(coordinates) // _CLUSTERED_FRAMES)]
    return KMeans(n, max_iter=max_iter, tolerance=1e-3, fixed_seed=1, n_jobs=1).fit(sample).fetch_model()


def assign(clusters: Any, coordinates: Sequence[FloatArray]) -> list[IntArray]:
    """Return the nearest of deeptime's `clusters` of every frame, -1 where a coordinate is not finite."""
    out = []
    for x in coordinates:
        finite = np.isfinite(x).all(axis=1)
        labels = np.full(len(x), -1, dtype=np.int64)
        if finite.any():
            labels[finite] = clusters.transform(np.ascontiguousarray(x[finite]), n_jobs=1)
        out.append(labels)
    return out


class MarkovModel(NamedTuple):
    """Microstates and metastable states of the reference.

    `centres` `(n_micro, n_dimensions)`; `state_of` `(n_micro,)` is the metastable state (0 the most populated) of each
    microstate, -1 for those outside the connected set; `timescales` (frames) of the model.
    """

    centres: FloatArray
    state_of: IntArray
    n_states: int
    lag_frames: int
    timescales: FloatArray

    def assign(self, coordinates: Sequence[FloatArray]) -> list[IntArray]:
        """Return the microstate of every frame, -1 where a coordinate is not finite."""
        from deeptime.clustering import ClusterModel

        return assign(ClusterModel(self.centres), coordinates)

    def lump(self, micro: Sequence[IntArray]) -> list[IntArray]:
        """Return the metastable state of every frame, -1 where it has none."""
        table = np.append(self.state_of, -1)
        return [table[m] for m in micro]


def fit_model(
    coordinates: Sequence[FloatArray], lag_frames: int, n_micro: int = _N_MICROSTATES, n_states: int | None = None
) -> MarkovModel | None:
    """Cluster the projected reference, estimate its reversible MSM at `lag_frames` and lump it into metastable states.

    `n_states`: how many; None for one more than there are processes slower than the lag, from 2 to 4. None is returned
    when the connected set is too small for two states. Sources: k-means++ (Arthur and Vassilvitskii, 2007), PCCA+
    (Roeblitz and Weber, Adv. Data Anal. Classif. 7, 147, 2013), both in deeptime.
    """
    from deeptime.markov import TransitionCountEstimator
    from deeptime.markov.msm import MaximumLikelihoodMSM

    every = np.concatenate([x[np.isfinite(x).all(axis=1)] for x in coordinates])
    if len(every) < 20 * n_micro:
        n_micro = max(len(every) // 20, 2)
    clusters = k_means(every, n_micro, 200)
    gaps = [np.where(m >= 0, m, np.nan)[:, None] for m in assign(clusters, coordinates)]
    discrete = [run[:, 0].astype(np.int32) for m in gaps for run in finite_runs(m) if len(run) > lag_frames]
    if not discrete:
        return None
    counts = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding").fit(discrete).fetch_model()
    connected = counts.submodel_largest(connectivity_threshold=0)
    if connected.n_states < 3:
        return None
    try:
        markov = MaximumLikelihoodMSM(reversible=True).fit(connected).fetch_model()
        times = np.asarray(markov.timescales())
        # A process is slow, and separates states, when it outlives the lag.
        slow = min(max(int((times > lag_frames).sum()) + 1, 2), _MAX_STATES)
        wanted = min(slow if n_states is None else n_states, markov.n_states - 1)
        lumped = markov.pcca(wanted)
    except (RuntimeError, ValueError, np.linalg.LinAlgError):  # too few counts, or not so many sets that hold together
        return None
    populations = np.bincount(lumped.assignments, weights=markov.stationary_distribution, minlength=wanted)
    rank = np.empty(wanted, dtype=np.int64)
    rank[np.argsort(-populations)] = np.arange(wanted)
    state_of = np.full(n_micro, -1, dtype=np.int64)
    state_of[np.asarray(connected.state_symbols)] = rank[np.asarray(lumped.assignments)]
    return MarkovModel(np.asarray(clusters.cluster_centers), state_of, wanted, lag_frames, times)


def state_counts(labels: Sequence[IntArray], blocks: Blocks, n_states: int) -> FloatArray:
    """Return how many frames of each block are in each state, `(n_blocks, n_states + 1)`; the last is "no state"."""
    return count_in_blocks([np.where(x >= 0, x, n_states) for x in labels], n_states + 1, blocks)


def block_transitions(labels: Sequence[IntArray], blocks: Blocks, n_states: int, lag: int) -> FloatArray:
    """Return the transition counts of each block at `lag` frames, `(n_blocks, n_states ** 2)`, row-major (from, to). A
    pair belongs to the block in which it starts; pairs with a frame that has no state do not count."""
    out = np.zeros((blocks.n_blocks, n_states * n_states))
    for piece in blocks.pieces:
        series = labels[piece.segment]
        start = series[piece.start : min(piece.stop, max(len(series) - lag, 0))]
        end = series[piece.start + lag : piece.start + lag + len(start)]
        known = (start >= 0) & (end >= 0)
        pair = start[known] * n_states + end[known]
        out[piece.block] += np.bincount(pair, minlength=n_states * n_states)
    return out


def slow_functions(counts: FloatArray, n_slow: int) -> tuple[FloatArray, FloatArray]:
    """Return the `n_slow` eigenvalues next to 1, descending, and eigenfunctions `(n_slow, n)` of counts `(n, n)` with
    every pair counted in both directions (detailed balance; exact for long equilibrium trajectories). States without
    counts have the value 0."""
    both = counts + counts.T
    weight = both.sum(1)
    scale = np.where(weight > 0, 1.0 / np.sqrt(np.maximum(weight, 1e-300)), 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * both * scale[None, :])
    order = np.argsort(-values)[1 : 1 + n_slow]
    return values[order], (scale[:, None] * vectors[:, order]).T


def function_eigenvalue(counts: FloatArray, function: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """Return the eigenvalue by which a function `(n,)` of the state decays, from transition counts per block
    `(n_blocks, n ** 2)`: 0-d, or `(n_draws,)` for weights `(n_draws, n_blocks)`.

    Its time-symmetrised autocorrelation, 2 S_xy / (S_xx + S_yy) with the mean of both ends removed: of the counts it
    was fitted to the eigenvalue itself, so that every trajectory is measured with the same rule.
    """
    head, tail = np.repeat(function, len(function)), np.tile(function, len(function))
    w = np.ones((1, len(counts))) if weights is None else weights
    parts = (head * tail, head + tail, head**2 + tail**2, np.ones(len(head)))
    products, ends, squares, n = (w @ (counts @ part) for part in parts)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = ends / (2 * n)
        covariance = products / n - mean**2
        variance = squares / (2 * n) - mean**2
        out = np.where(variance > 1e-12 * (mean**2 + squares / n), covariance / variance, np.nan)
    return np.asarray(out[0] if weights is None else out)
