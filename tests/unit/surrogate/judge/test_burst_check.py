"""Bursts from a candidate's frames: one that moves as the truth passes, one that is too fast or too slow is seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from surrogate.judge.burst_check import Burst, States, judge_bursts
from surrogate.judge.read.ensemble import Ensemble
from systems.errors import InputError
from systems.scene import Scene

TRUE = np.array([[0.9, 0.1, 0.0], [0.2, 0.7, 0.1], [0.0, 0.3, 0.7]])
POPULATIONS = np.array([6, 3, 1]) / 10


def chain(matrix: np.ndarray, n: int, rng: np.random.Generator) -> np.ndarray:
    """A chain of states drawn from transition probabilities."""
    edges, out = matrix.cumsum(axis=1), np.zeros(n, dtype=np.int64)
    draws = rng.random(n)
    for k in range(1, n):
        out[k] = np.searchsorted(edges[out[k - 1]], draws[k])
    return out


def check(candidate: np.ndarray, n_bursts: int = 600, seed: int = 0) -> Any:
    """Judge a candidate that jumps by `candidate`, one step a lag, by bursts of TRUE."""
    rng = np.random.default_rng(seed)
    labels = chain(candidate, 20_000, rng)
    states = cast(States, SimpleNamespace(n_states=3, lag=1, lag_ps=10.0, of_candidate=[labels]))
    starts = States.starts(states, n_bursts, rng)
    assert all(isinstance(s, Burst) and labels[s.frame] == s.state and labels[s.frame + 1] == s.later for s in starts)
    ends = np.array([np.searchsorted(TRUE.cumsum(axis=1)[s.state], rng.random()) for s in starts])
    return judge_bursts(states, starts, ends, seed)


def test_the_stationary_distribution_of_the_chain_is_the_one_stated() -> None:
    assert pytest.approx(POPULATIONS) == POPULATIONS @ TRUE


def test_a_candidate_with_the_truths_transitions_passes_as_often_as_stated() -> None:
    p_values = [check(TRUE, 300, seed).p_value for seed in range(20)]
    assert sum(p < 0.05 for p in p_values) <= 4
    found = check(TRUE)
    assert "as the truth does" in found.verdict
    off = np.abs(found.reweighted - POPULATIONS) / found.reweighted_error
    assert off.max() < 4 and found.reweighted_error.max() < 0.1


def test_a_candidate_that_leaves_a_state_too_fast_is_caught_and_its_populations_are_put_right() -> None:
    wrong = TRUE.copy()
    wrong[0] = [0.7, 0.3, 0.0]
    found = check(wrong)
    assert found.p_value < 0.01
    assert "of state 0" in found.verdict and "otherwise" in found.verdict
    assert found.populations[0] < 0.45
    assert found.reweighted[0] == pytest.approx(0.6, abs=4 * found.reweighted_error[0])


def test_states_that_bursts_do_not_connect_have_no_reweighted_population() -> None:
    states = cast(States, SimpleNamespace(n_states=2, lag=1, lag_ps=10.0, of_candidate=[np.array([0, 0, 1, 1, 0, 0])]))
    starts = [Burst(0, 0, 0, 0), Burst(0, 2, 1, 1)] * 10
    found = judge_bursts(states, starts, np.array([0, 1] * 10))
    assert np.isnan(found.reweighted).all() and found.p_value > 0.5


def test_states_are_found_in_torsions_and_for_new_frames(simulate: Callable[..., Ensemble]) -> None:
    candidate = simulate(1)
    states = States(candidate, 10.0)
    assert states.n_states >= 2
    frames = np.asarray(candidate.segments[0][:500])
    assert (states.of(frames) == states.of_candidate[0][:500]).mean() > 0.99
    starts = states.starts(60, np.random.default_rng(0))
    count = np.bincount([s.state for s in starts], minlength=states.n_states)
    assert (count >= 60 // states.n_states).all()


def test_a_molecule_that_stands_still_has_no_states(
    alanine_dipeptide: Scene, simulate: Callable[..., Ensemble]
) -> None:
    still = np.repeat(alanine_dipeptide.positions_nm[None].astype(np.float32), 500, axis=0)
    with pytest.raises(InputError, match="two states"):
        States(dataclasses.replace(simulate(1), segments=[still], flags=None, chunk_idx=None, changed=None), 10.0)
