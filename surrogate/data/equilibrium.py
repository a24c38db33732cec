"""Weights that turn frames of short runs from chosen starts into equilibrium, by a reversible Markov model.

Runs seeded in rare states show these states too often. Forward windows need no weights, whatever they start from: a
propagator is conditional. A window read backwards does: it starts where a run ended up, so that exits from a rare state
become entries, and there would be as many of these as seeds. Weighted by how likely equilibrium is to be where the run
came from, there are as many as detailed balance asks for (Wu et al., Proc. Natl. Acad. Sci. 113, E3221 (2016)).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_CELLS = 150
_FRAMES_A_CELL = 30
_CLUSTERED_FRAMES = 20_000
_DIMENSIONS = 6
# No frame counts more than so many average ones: a cell hardly visited would otherwise be drawn over and over.
_LARGEST = 20.0
# How many jumps between any two frames each run stands for, its beginning and its end; a frame's odds to take part grow
# with this power of its place in its run.
_JUMPS_A_RUN, _LATE = 2.0, 2
_CONVERGED, _MOST_ITERATIONS = 1e-6, 20_000
_SEED = 1


def equilibrium_weights(
    runs: Sequence[FloatArray], lag_frames: int, *, states: IntArray | None = None, shares: FloatArray | None = None
) -> FloatArray | None:
    """Return a weight for each frame, of mean 1, in the order of the runs. None for runs too short for the lag.

    `runs`: features `(n, k)` that tell slow states apart (cosines and sines of torsions), one array for each run.

    Where hardly any run goes between two states, a Markov model would put all weight into one that by chance was
    entered and not left. So each run is taken to begin and to end with a jump between any two frames, late frames
    (relaxed ones) more likely: what transitions do not tell is left as the runs show it.

    Where runs leave a rare state and none enters it, they do not tell how rare it is. What is known otherwise (from
    metadynamics) is given by `states` (n_frames,), the state of each frame, and `shares` (n_states,), their
    populations, which need no norm: within each state the Markov model weighs frames, between them the shares do.

    TICA, k-means and the reversible maximum-likelihood model of transition counts (Trendelkamp-Schroer et al., J. Chem.
    Phys. 143, 174101 (2015)) are deeptime's.
    """
    cells = _cells(runs, lag_frames)
    if cells is None:
        return None
    weights = _of_cells(cells, lag_frames)[np.concatenate(cells)]
    if states is not None and shares is not None:
        total = np.bincount(states, weights=weights, minlength=len(shares))
        weights = weights * (shares / np.maximum(total, 1e-12))[states]
    weights = np.minimum(weights / weights.mean(), _LARGEST)
    return np.asarray(weights / weights.mean(), dtype=np.float64)


def _cells(runs: Sequence[FloatArray], lag_frames: int) -> list[npt.NDArray[np.int32]] | None:
    """Return the cell of each frame of each run, by k-means in the slow subspace; None for too few frames."""
    from deeptime.clustering import KMeans
    from deeptime.decomposition import TICA

    long_enough = [x for x in runs if len(x) > lag_frames]
    if sum(len(x) - lag_frames for x in long_enough) < 2 * _FRAMES_A_CELL:
        return None
    covariance = TICA.covariance_estimator(lagtime=lag_frames)
    for x in long_enough:
        covariance.partial_fit((x[:-lag_frames], x[lag_frames:]))
    slow = TICA(lagtime=lag_frames, dim=_DIMENSIONS, scaling="kinetic_map").fit_from_covariances(covariance)
    projected = [np.ascontiguousarray(slow.fetch_model().transform(x)) for x in runs]
    every = np.concatenate(projected)
    n_cells = max(2, min(_CELLS, len(every) // _FRAMES_A_CELL))
    sample = every[:: max(1, len(every) // _CLUSTERED_FRAMES)]
    cells = KMeans(n_cells, max_iter=100, fixed_seed=_SEED, n_jobs=1).fit(sample).fetch_model()
    return [cells.transform(x, n_jobs=1).astype(np.int32) for x in projected]


def _of_cells(cells: Sequence[npt.NDArray[np.int32]], lag_frames: int) -> FloatArray:
    """Return what a frame of each cell weighs `(n_cells,)`."""
    from deeptime.markov import TransitionCountEstimator, TransitionCountModel
    from deeptime.markov.msm import MaximumLikelihoodMSM
    from deeptime.util.exceptions import NotConvergedWarning

    counted = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding", sparse=False).fit(list(cells))
    counts = np.asarray(counted.fetch_model().count_matrix, dtype=np.float64)
    lateness = np.concatenate([(np.arange(1, len(x) + 1) / len(x)) ** _LATE for x in cells])
    late = np.asarray(np.bincount(np.concatenate(cells), weights=lateness, minlength=len(counts)), dtype=np.float64)
    # Transitions are counted once at each frame of the lag, and so are the jumps.
    counts += _JUMPS_A_RUN * len(cells) * lag_frames * np.outer(late, late) / late.sum() ** 2
    visited = np.flatnonzero(late > 0)
    with warnings.catch_warnings():
        # What is left to converge after so many iterations is nothing beside the scatter of counts.
        warnings.simplefilter("ignore", NotConvergedWarning)
        model = MaximumLikelihoodMSM(reversible=True, maxerr=_CONVERGED, maxiter=_MOST_ITERATIONS).fit(
            TransitionCountModel(counts[np.ix_(visited, visited)])
        )
    n_frames = np.bincount(np.concatenate(cells), minlength=len(counts))
    weights = np.zeros(len(counts))
    weights[visited] = model.fetch_model().stationary_distribution / n_frames[visited]
    return weights
