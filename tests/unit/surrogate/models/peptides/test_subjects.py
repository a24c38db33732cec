"""Frames of peptides weighted as in equilibrium, and windows drawn for what is rare."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch

from surrogate.models.peptides import subjects as equilibrium
from surrogate.models.peptides import subjects as state_windows
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.subjects import PeptideSubject, StateWindows, equilibrium_weights

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


_LENGTH = 400_000


def _subject() -> Any:
    """Two torsions in equilibrium: one is 1 % of the time in its second state, one enters it every 2000 frames."""
    rng = np.random.default_rng(0)
    states = np.zeros((_LENGTH, 2), dtype=np.int64)
    for torsion, (enter, leave) in enumerate(((0.001, 0.099), (0.0005, 0.02))):
        draws, now = rng.random(_LENGTH), 0
        for k in range(_LENGTH):
            now = int(draws[k] < enter) if now == 0 else int(draws[k] >= leave)
            states[k, torsion] = now

    def windows(n: int, _: object, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        first = torch.randint(0, _LENGTH - 4, (n, 1), generator=generator)
        return first + torch.arange(4), torch.arange(1.0, 4.0).expand(n, -1)

    stated = SimpleNamespace(residue=torch.tensor([0, 0]), slot=torch.tensor([0, 1]), n_residues=1)
    conditioning = torch.from_numpy(states)[:, None]
    return SimpleNamespace(windows=windows, states=lambda idx: conditioning[idx], chain=SimpleNamespace(stated=stated))


def test_rare_states_and_changes_come_oftener_and_probabilities_stay_what_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(state_windows, "_POOL", 100_000)
    subject = _subject()
    pool = StateWindows.of(cast(PeptideSubject, subject), PeptideConfig())
    idx, times, share = pool.draw(200_000, torch.Generator().manual_seed(1))
    assert idx.shape == (200_000, 4) and times.shape == (200_000, 3) and share.shape == (200_000, 1, 7)
    assert share[:, 0].mean(0).tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], abs=0.05)
    plain, drawn = subject.states(pool.idx)[:, :, 0], subject.states(idx)[:, :, 0]
    rare = drawn[:, 0, 0] == 1
    assert float((plain[:, 0, 0] == 1).float().mean()) < 0.013
    assert float((share[:, 0, 0] * rare).mean()) > 0.25, "windows start in the rare state"
    for torsion, state in ((0, 0), (0, 1), (1, 0), (1, 1)):
        shares, probabilities = [], []
        for found, counted in ((plain, torch.ones(len(plain))), (drawn, share[:, 0, torsion])):
            starts = (found[:, 0, torsion] == state).float()
            changes = (found[:, 1, torsion] != state) * starts
            probabilities.append(float((counted * changes).sum() / (counted * starts).sum()))
            shares.append(float(changes.sum() / starts.sum()))
        assert probabilities[1] == pytest.approx(probabilities[0], rel=0.12), (torsion, state)
        if state == 0:
            assert shares[1] > 5 * shares[0], "changes come oftener, and would be overrated if all counted alike"


def test_states_that_runs_only_begin_in_weigh_next_to_nothing() -> None:
    """One run goes through many of them, one after the other: products of its odds underflow."""
    rng = np.random.default_rng(0)
    cells = [(12 + (rng.random(600) < 0.5)).astype(np.int32) for _ in range(16)]
    cells[0][:60] = np.repeat(np.arange(12), 5)
    weights = equilibrium._of_cells(cells, 5)
    assert (weights[:12] < 1e-3 * weights[12:].min()).all() and (weights[:2] == 0.0).all()
    np.testing.assert_allclose(weights[12] / weights[13], 1.0, rtol=0.1)
