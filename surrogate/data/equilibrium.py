"""Weights that turn frames of short runs from chosen starts into equilibrium, by a reversible Markov model.

Runs seeded in rare states show these states too often. Forward windows need no weights, whatever they start from: a
propagator is conditional. A window read backwards does: it starts where a run ended up, so that exits from a rare state
become entries, and there would be as many of these as seeds. Weighted by how likely equilibrium is to be where the run
came from, there are as many as detailed balance asks for (Wu et al., Proc. Natl. Acad. Sci. 113, E3221 (2016)).
"""

from __future__ import annotations

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
_SEED = 1


def equilibrium_weights(
    runs: Sequence[FloatArray], lag_frames: int, *, states: IntArray | None = None, shares: FloatArray | None = None
) -> FloatArray | None:
    """Return a weight for each frame, of mean 1, in the order of the runs.

    `runs`: features `(n, k)` that tell slow states apart (cosines and sines of torsions), one array for each run.
    Frames outside the largest set of cells that runs both enter and leave weigh nothing. None when no such set can be
    found: runs too short for the lag, or no two cells.

    Where runs leave a rare state and none enters it, they do not tell how rare it is. What is known otherwise (from
    metadynamics) is given by `states` (n_frames,), the state of each frame, and `shares` (n_states,), their
    populations, which need no norm: within each state the Markov model weighs frames, between them the shares do.

    TICA, k-means and the reversible maximum-likelihood model of transition counts (Trendelkamp-Schroer et al., J. Chem.
    Phys. 143, 174101 (2015)) are deeptime's.
    """
    cells = _cells(runs, lag_frames)
    if cells is None:
        return None
    frames = np.concatenate(cells)
    sets = _connected(cells, lag_frames)
    if states is None or shares is None:
        weights = sets[0][frames] if sets and (sets[0] > 0).sum() > 1 else np.zeros(0)
    else:
        # Sets count by their frames; what is right between them within one state is not known.
        within = sum((one[frames] for one in sets), np.zeros(len(frames)))
        total = np.bincount(states, weights=within, minlength=len(shares))
        weights = within * (shares / np.maximum(total, 1e-12))[states]
    if not weights.any():
        return None
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


def _connected(cells: Sequence[npt.NDArray[np.int32]], lag_frames: int) -> list[FloatArray]:
    """Return of each set of cells that runs go between, the largest first, what a frame of each cell weighs; zero for
    cells of other sets. Frames of one set weigh 1 on average."""
    from deeptime.markov import TransitionCountEstimator
    from deeptime.markov.msm import MaximumLikelihoodMSM

    counts = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding").fit(list(cells)).fetch_model()
    n_frames = np.bincount(np.concatenate(cells), minlength=counts.n_states).astype(np.float64)
    found = []
    for members in counts.connected_sets(connectivity_threshold=0):
        population = n_frames[members] / n_frames[members].sum()
        if len(members) > 1:
            try:
                model = MaximumLikelihoodMSM(reversible=True).fit(counts.submodel(members)).fetch_model()
                population = np.asarray(model.stationary_distribution)
            except (RuntimeError, ValueError, AssertionError, np.linalg.LinAlgError):  # too few counts for a model
                continue
        weights = np.zeros(len(n_frames))
        weights[members] = population * n_frames[members].sum() / np.maximum(n_frames[members], 1)
        found.append(weights)
    return found
