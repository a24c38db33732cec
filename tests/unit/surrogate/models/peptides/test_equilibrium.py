"""Weights to equilibrium: short runs seeded evenly over states tell how likely the states are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from surrogate.models.peptides import subjects as equilibrium
from surrogate.models.peptides.subjects import equilibrium_weights

FloatArray = npt.NDArray[np.float64]
# Four states on a circle, the last of them rare: entered hardly ever, left soon. Rows obey detailed balance.
POPULATION = np.array([0.5, 0.3, 0.19, 0.01])


def _matrix() -> FloatArray:
    barrier = np.array([[0, 3, 2, 0.1], [3, 0, 2, 0], [2, 2, 0, 0.2], [0.1, 0, 0.2, 0]]) * 5e-4
    matrix = barrier / POPULATION[:, None]
    matrix[np.diag_indices(4)] = 1 - matrix.sum(1)
    return matrix


def _runs(
    n_runs: int, length: int, seed: int, *, connected: bool = True
) -> tuple[list[FloatArray], npt.NDArray[np.int64]]:
    """Runs started as often in each state, cosine and sine of angles that scatter about the state's own; the states."""
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(_matrix() if connected else np.eye(4), axis=1)
    states = np.empty((n_runs, length), dtype=np.int64)
    states[:, 0] = np.arange(n_runs) % 4
    for k in range(1, length):
        states[:, k] = (rng.random(n_runs)[:, None] > cumulative[states[:, k - 1]]).sum(1)
    angles = states * np.pi / 2 + 0.15 * rng.normal(size=states.shape)
    return list(np.stack([np.cos(angles), np.sin(angles)], axis=-1)), states.ravel()


def test_seeded_runs_are_weighted_to_equilibrium() -> None:
    runs, states = _runs(300, 400, 0)
    weights = equilibrium_weights(runs, 20)
    assert weights is not None and len(weights) == len(states)
    seen = np.bincount(states, minlength=4) / len(states)
    assert seen[3] > 5 * POPULATION[3], "seeds show the rare state too often"
    found = np.bincount(states, weights=weights, minlength=4) / len(states)
    np.testing.assert_allclose(found[:3], POPULATION[:3], rtol=0.15)
    assert 0.6 * POPULATION[3] < found[3] < 1.6 * POPULATION[3]


def test_runs_in_equilibrium_keep_equal_weights() -> None:
    runs, states = _runs(40, 8000, 1)
    later = [x[4000:] for x in runs]
    weights = equilibrium_weights(later, 20)
    assert weights is not None
    frequent = states.reshape(40, 8000)[:, 4000:].ravel() != 3
    assert np.abs(weights[frequent] - 1).mean() < 0.1


def test_states_that_no_run_goes_between_weigh_what_runs_show() -> None:
    runs, states = _runs(40, 200, 2, connected=False)
    weights = equilibrium_weights(runs, 20)
    assert weights is not None
    np.testing.assert_allclose(np.bincount(states, weights=weights) / len(states), 0.25, atol=0.01)


@pytest.mark.parametrize("jumps", [2.0, 1e-4])
def test_a_state_entered_once_and_left_once_by_chance_does_not_take_all_weight(
    monkeypatch: pytest.MonkeyPatch, jumps: float
) -> None:
    """Two states of equal weight, ten runs in either, and one run that enters the second early and never comes back,
    another that leaves it in its last frames: transitions alone would tell the wrong story."""
    monkeypatch.setattr(equilibrium, "_JUMPS_A_RUN", jumps)
    rng = np.random.default_rng(5)
    states = np.repeat(np.arange(20) % 2, 400).reshape(20, 400)
    states[0, 30:], states[2, 40:], states[1, 390:] = 1, 1, 0
    angles = states * np.pi / 2 + 0.15 * rng.normal(size=states.shape)
    weights = equilibrium_weights(list(np.stack([np.cos(angles), np.sin(angles)], axis=-1)), 20)
    assert weights is not None
    share = float(np.average(states.ravel(), weights=weights))
    assert (share < 0.65) == (jumps == 2.0), share


def test_what_is_known_otherwise_weighs_states_that_no_run_goes_between() -> None:
    runs, states = _runs(40, 200, 2, connected=False)
    weights = equilibrium_weights(runs, 20, states=states, shares=7.0 * POPULATION)
    assert weights is not None
    found = np.bincount(states, weights=weights, minlength=4) / len(states)
    np.testing.assert_allclose(found, POPULATION, rtol=1e-6)


def test_runs_shorter_than_the_lag_have_no_weights() -> None:
    runs, _ = _runs(8, 15, 3)
    assert equilibrium_weights(runs, 20) is None
