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

_MICROSTATES = 150
_FRAMES_A_STATE = 30
_CLUSTERED_FRAMES = 20_000
_DIMENSIONS = 6
# No frame counts more than so many average ones: a state hardly visited would otherwise be drawn over and over.
_LARGEST = 20.0
_SEED = 1


def equilibrium_weights(runs: Sequence[FloatArray], lag_frames: int) -> FloatArray | None:
    """Return a weight for each frame, of mean 1, in the order of the runs.

    `runs`: features `(n, k)` that tell slow states apart (cosines and sines of torsions), one array for each run.
    Frames outside the largest set of states that runs both enter and leave weigh nothing. None when no such set can be
    found: runs too short for the lag, or no two states.

    TICA, k-means and the reversible maximum-likelihood model of transition counts (Trendelkamp-Schroer et al., J. Chem.
    Phys. 143, 174101 (2015)) are deeptime's.
    """
    from deeptime.clustering import KMeans
    from deeptime.decomposition import TICA
    from deeptime.markov import TransitionCountEstimator
    from deeptime.markov.msm import MaximumLikelihoodMSM

    long_enough = [x for x in runs if len(x) > lag_frames]
    if not long_enough or sum(len(x) - lag_frames for x in long_enough) < 2 * _FRAMES_A_STATE:
        return None
    covariance = TICA.covariance_estimator(lagtime=lag_frames)
    for x in long_enough:
        covariance.partial_fit((x[:-lag_frames], x[lag_frames:]))
    slow = TICA(lagtime=lag_frames, dim=_DIMENSIONS, scaling="kinetic_map").fit_from_covariances(covariance)
    projected = [np.ascontiguousarray(slow.fetch_model().transform(x)) for x in runs]
    every = np.concatenate(projected)
    n_states = max(2, min(_MICROSTATES, len(every) // _FRAMES_A_STATE))
    sample = every[:: max(1, len(every) // _CLUSTERED_FRAMES)]
    cells = KMeans(n_states, max_iter=100, fixed_seed=_SEED, n_jobs=1).fit(sample).fetch_model()
    labels = [cells.transform(x, n_jobs=1).astype(np.int32) for x in projected]
    counts = TransitionCountEstimator(lagtime=lag_frames, count_mode="sliding").fit(labels).fetch_model()
    connected = counts.submodel_largest(connectivity_threshold=0)
    if connected.n_states < 2:
        return None
    try:
        model = MaximumLikelihoodMSM(reversible=True).fit(connected).fetch_model()
    except (RuntimeError, ValueError, AssertionError, np.linalg.LinAlgError):  # too few counts for a reversible model
        return None
    population = np.zeros(n_states)
    population[np.asarray(connected.state_symbols)] = model.stationary_distribution
    frames = np.concatenate(labels)
    weights = (population / np.maximum(np.bincount(frames, minlength=n_states), 1))[frames]
    weights = np.minimum(weights / weights.mean(), _LARGEST)
    return np.asarray(weights / weights.mean(), dtype=np.float64)
