"""A Markov state model fitted on the reference, by which every trajectory is measured. deeptime does the work.

Torsions -> TICA (kinetic map) -> k-means -> transition counts -> PCCA: all of it is fitted on the reference alone, and
the other trajectories are put into its states. What is compared are sums over blocks, so that error bars come cheap.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.kinetics import PairSums, finite_runs, tica_model, timescale
from surrogate.comparison.measure.statistics import Blocks

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

N_MICROSTATES = 50
MAX_DIMENSIONS = 5
MAX_STATES = 4
_CLUSTERED_FRAMES = 10_000
_KMEANS_SEED = 1
# A process is slow, and separates states, when it outlives the lag by this factor.
_SLOW_IN_LAGS = 1.0


@dataclass(frozen=True, eq=False)
class Projection:
    """The slow subspace: features `(n, k)` minus `mean`, times `matrix` `(k, n_dimensions)` (a kinetic map)."""

    mean: FloatArray
    matrix: FloatArray
    lag_frames: int
    timescales: FloatArray

    def project(self, features: FloatArray) -> FloatArray:
        """Return coordinates `(n, n_dimensions)`; NaN where a feature is not finite."""
        with np.errstate(invalid="ignore"):
            return (features - self.mean) @ self.matrix


@dataclass(frozen=True, eq=False)
class Model:
    """Microstates and metastable states of the reference.

    `centres` `(n_micro, n_dimensions)`; `state_of` `(n_micro,)` is the metastable state (0 the most populated) of each
    microstate, -1 for those outside the connected set; `n_states`; `lag_frames`; `timescales` (frames) of the model.
    """

    projection: Projection
    centres: FloatArray
    state_of: IntArray
    n_states: int
    lag_frames: int
    timescales: FloatArray

    def assign(self, coordinates: Sequence[FloatArray]) -> list[IntArray]:
        """Return the microstate of every frame, -1 where a coordinate is not finite."""
        from deeptime.clustering import ClusterModel

        nearest = ClusterModel(self.centres)
        out = []
        for x in coordinates:
            finite = np.isfinite(x).all(axis=1)
            labels = np.full(len(x), -1, dtype=np.int64)
            if finite.any():
                labels[finite] = nearest.transform(np.ascontiguousarray(x[finite]), n_jobs=1)
            out.append(labels)
        return out

    def lump(self, micro: Sequence[IntArray]) -> list[IntArray]:
        """Return the metastable state of every frame, -1 where it has none."""
        table = np.append(self.state_of, -1)
        return [table[m] for m in micro]


def fit_projection(
    segments: Sequence[FloatArray], lag_frames: int, dim: int = MAX_DIMENSIONS, *, least: float = 0.01
) -> Projection | None:
    """Fit TICA with kinetic-map scaling to features `(n, k)`; None when nothing varies or frames are too few.

    At most `dim` coordinates are kept, those whose eigenvalue exceeds `least` and in any case the first.

    Source: Noe and Clementi, J. Chem. Theory Comput. 11, 5002 (2015): coordinates are scaled by their eigenvalues.
    """
    fitted = tica_model(segments, lag_frames, dim)
    if fitted is None:
        return None
    model, _ = fitted
    values = np.real(np.asarray(model.singular_values))[:dim]
    vectors = np.real(np.asarray(model.singular_vectors_left))[:, : len(values)]
    kept = max(int((values > least).sum()), 1)
    matrix = vectors[:, :kept] * np.clip(np.abs(values[:kept]), 1e-6, 1.0)
    return Projection(
        np.asarray(model.mean_0, dtype=np.float64), matrix, lag_frames, timescale(values[:kept], lag_frames)
    )


def fit_model(
    projection: Projection,
    coordinates: Sequence[FloatArray],
    lag_frames: int,
    n_micro: int = N_MICROSTATES,
    n_states: int | None = None,
) -> Model | None:
    """Cluster the projected reference, estimate its reversible MSM at `lag_frames` and lump it into metastable states.

    `n_states`: how many; None for one more than there are processes slower than the lag, from 2 to 4. None is returned
    when the connected set is too small for two states. Sources: k-means++ (Arthur and Vassilvitskii, 2007), PCCA+
    (Roeblitz and Weber, Adv. Data Anal. Classif. 7, 147, 2013), both in deeptime.
    """
    from deeptime.clustering import KMeans
    from deeptime.markov import TransitionCountEstimator
    from deeptime.markov.msm import MaximumLikelihoodMSM

    every = np.concatenate([x[np.isfinite(x).all(axis=1)] for x in coordinates])
    if len(every) < 20 * n_micro:
        n_micro = max(len(every) // 20, 2)
    sample = every[:: max(1, len(every) // _CLUSTERED_FRAMES)]
    fitted = KMeans(n_micro, max_iter=200, tolerance=1e-3, fixed_seed=_KMEANS_SEED, n_jobs=1).fit(sample).fetch_model()
    bare = Model(
        projection, np.asarray(fitted.cluster_centers), np.zeros(n_micro, dtype=np.int64), 1, lag_frames, np.empty(0)
    )
    trajectories = [run[:, 0] for labels in bare.assign(coordinates) for run in finite_runs(_gaps(labels)[:, None])]
    discrete = [run.astype(np.int32) for run in trajectories if len(run) > lag_frames]
    if not discrete:
        return None
    counts = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding").fit(discrete).fetch_model()
    connected = counts.submodel_largest(connectivity_threshold=0)
    if connected.n_states < 3:
        return None
    try:
        markov = MaximumLikelihoodMSM(reversible=True).fit(connected).fetch_model()
    except (RuntimeError, ValueError, np.linalg.LinAlgError):  # counts too few for a reversible estimate
        return None
    times = np.asarray(markov.timescales())
    n_slow = int((times > _SLOW_IN_LAGS * lag_frames).sum())
    wanted = min(max(n_slow + 1, 2), MAX_STATES) if n_states is None else n_states
    wanted = min(wanted, markov.n_states - 1)
    try:
        lumped = markov.pcca(wanted)
    except (RuntimeError, ValueError, np.linalg.LinAlgError):  # no so many sets that hold together
        return None
    populations = np.bincount(lumped.assignments, weights=markov.stationary_distribution, minlength=wanted)
    rank = np.empty(wanted, dtype=np.int64)
    rank[np.argsort(-populations)] = np.arange(wanted)
    state_of = np.full(n_micro, -1, dtype=np.int64)
    state_of[np.asarray(connected.state_symbols)] = rank[np.asarray(lumped.assignments)]
    return Model(projection, bare.centres, state_of, wanted, lag_frames, times)


def _gaps(labels: IntArray) -> FloatArray:
    return np.where(labels >= 0, labels, np.nan).astype(np.float64)


def block_occupancy(labels: Sequence[IntArray], blocks: Blocks, n_states: int) -> FloatArray:
    """Return how many frames of each block are in each state, `(n_blocks, n_states + 1)`; the last is "no state"."""
    out = np.zeros((blocks.n_blocks, n_states + 1))
    for piece in blocks.pieces:
        part = labels[piece.segment][piece.start : piece.stop]
        out[piece.block] += np.bincount(np.where(part >= 0, part, n_states), minlength=n_states + 1)
    return out


def block_transitions(labels: Sequence[IntArray], blocks: Blocks, n_states: int, lag: int) -> FloatArray:
    """Return the transition counts of each block at `lag` frames, `(n_blocks, n_states ** 2)`, row-major (from, to).

    A pair belongs to the block in which it starts; pairs with a frame that has no state do not count.
    """
    out = np.zeros((blocks.n_blocks, n_states * n_states))
    for piece in blocks.pieces:
        series = labels[piece.segment]
        start = series[piece.start : min(piece.stop, max(len(series) - lag, 0))]
        end = series[piece.start + lag : piece.start + lag + len(start)]
        known = (start >= 0) & (end >= 0)
        pair = start[known] * n_states + end[known]
        out[piece.block] += np.bincount(pair, minlength=n_states * n_states)
    return out


def transition_matrix(counts: FloatArray) -> FloatArray:
    """Return row-normalised counts `(..., n, n)`; a state that is never left has a row of NaN."""
    total = counts.sum(-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 0, counts / total, np.nan)


def slow_functions(counts: FloatArray, n_slow: int) -> tuple[FloatArray, FloatArray]:
    """Return the `n_slow` eigenvalues next to 1, descending, and eigenfunctions `(n_slow, n)` of counts `(n, n)`.

    They are those of the transition matrix with every pair counted in both directions, which imposes detailed balance
    and is exact for long equilibrium trajectories. States without counts have the value 0.
    """
    both = counts + counts.T
    weight = both.sum(1)
    scale = np.where(weight > 0, 1.0 / np.sqrt(np.maximum(weight, 1e-300)), 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * both * scale[None, :])
    order = np.argsort(-values)[1 : 1 + n_slow]
    return values[order], (scale[:, None] * vectors[:, order]).T


def function_sums(counts: FloatArray, function: FloatArray) -> PairSums:
    """Return the pair sums of a function `(n,)` of the state, from transition counts per block `(n_blocks, n ** 2)`.

    `kinetics.lagged_eigenvalue` of them is the eigenvalue by which this function decays in that trajectory: of the
    counts it was fitted to, the eigenvalue itself; of any other, that of the same process.
    """
    head, tail = np.repeat(function, len(function)), np.tile(function, len(function))
    parts = (head * tail, head + tail, head**2 + tail**2, np.ones(len(head)))
    return PairSums(*(counts @ part for part in parts))


def chapman_kolmogorov(counts: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return predicted and estimated probabilities to be in the state one started in, `(n_lags, n_states)` each.

    `counts[i]`: transition counts `(n, n)` at `(i + 1)` times the lag. The prediction is the power of the first.
    Source: Prinz et al., J. Chem. Phys. 134, 174105 (2011), eq. 35.
    """
    first = transition_matrix(counts[0])
    predicted = [np.diag(np.linalg.matrix_power(np.nan_to_num(first), i + 1)) for i in range(len(counts))]
    estimated = [np.diag(transition_matrix(c)) for c in counts]
    return np.array(predicted), np.array(estimated)


def circular_mean(angles_rad: npt.NDArray[np.floating]) -> float:
    """Return the mean direction in radians; NaN for none."""
    finite = angles_rad[np.isfinite(angles_rad)]
    return math.nan if not len(finite) else float(np.arctan2(np.sin(finite).mean(), np.cos(finite).mean()))
