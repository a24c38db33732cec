"""The comparison's estimators on processes with exact answers: the reference lies in its 95 % intervals as often as
stated."""

from __future__ import annotations

import math

import numpy as np
import pytest

from known_answers import double_well_density, double_well_left_population
from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.statistics import Estimate, block_length, bootstrap_weights, estimate, make_blocks
from systems.library.named_scenes import double_well

N_RUNS, N_FRAMES, N_DRAWS = 500, 4_000, 200
# 500 intervals at 95 %: a standard error of 1 %, so these bounds are missed by chance once in some 200 times.
COVERED = (0.922, 0.978)
CHAIN = np.array([[0.94, 0.05, 0.01], [0.10, 0.88, 0.02], [0.06, 0.06, 0.88]])


def stationary(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eig(matrix.T)
    found = np.real(vectors[:, np.argmax(values.real)])
    return np.asarray(found / found.sum())


def walks(matrix: np.ndarray, n_runs: int, n_frames: int, seed: int) -> np.ndarray:
    """Equilibrium trajectories of a chain, `(n_runs, n_frames)`."""
    rng = np.random.default_rng(seed)
    cumulative = matrix.cumsum(1)
    cumulative[:, -1] = 1.0
    out = np.empty((n_runs, n_frames), dtype=np.int64)
    out[:, 0] = rng.choice(len(matrix), n_runs, p=stationary(matrix))
    for t in range(1, n_frames):
        out[:, t] = (rng.random(n_runs)[:, None] > cumulative[out[:, t - 1]]).sum(1)
    return out


def double_well_chain(substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Metropolis moves between 41 points in the library's double well at 300 K, `substeps` a frame; and the points."""
    x = np.linspace(-0.62, 0.62, 41)
    density = double_well_density(double_well(), 300.0, x)
    matrix = np.zeros((41, 41))
    for i in range(41):
        for j in (i - 1, i + 1):
            if 0 <= j < 41:
                matrix[i, j] = 0.5 * min(1.0, density[j] / density[i])
        matrix[i, i] = 1.0 - matrix[i].sum()
    return np.linalg.matrix_power(matrix, substeps), x


def measure(
    labels: np.ndarray, inside: np.ndarray, function: np.ndarray, lag: int, each: int, rng: np.random.Generator
) -> tuple[Estimate, Estimate]:
    """The population of the states `inside` and the timescale of `function`, in frames, as the comparison makes
    them."""
    blocks = make_blocks([len(labels)], each)
    weights = bootstrap_weights(blocks.n_blocks, N_DRAWS, rng)
    occupied = kinetics.state_counts([labels], blocks, len(function))
    part, total = occupied[:, :-1][:, inside].sum(1), occupied.sum(1)
    population = estimate(part.sum() / total.sum(), weights @ part / (weights @ total), blocks.n_blocks)
    counts = kinetics.block_transitions([labels], blocks, len(function), lag)
    time = estimate(
        float(kinetics.timescale(kinetics.function_eigenvalue(counts, function), lag)),
        kinetics.timescale(kinetics.function_eigenvalue(counts, function, weights), lag),
        blocks.n_blocks,
        log=True,
    )
    return population, time


@pytest.mark.parametrize("system", ["chain", "double well"])
def test_the_reference_lies_in_the_intervals_as_often_as_stated(system: str) -> None:
    matrix, inside, lag = (CHAIN, np.array([True, False, False]), 2) if system == "chain" else (None, None, 5)
    if matrix is None or inside is None:
        matrix, x = double_well_chain(40)
        inside = x < 0
    exact = stationary(matrix)
    values = np.sort(np.linalg.eigvals(matrix).real)[::-1]
    true_time, true_population = -1.0 / math.log(values[1]), float(exact[inside].sum())
    # The function is the exact one: in a comparison it comes from the reference, and serves every trajectory.
    flux = exact[:, None] * np.linalg.matrix_power(matrix, lag)
    function = kinetics.slow_functions(flux, 1)[1][0]
    rng = np.random.default_rng(1)
    each = block_length(N_FRAMES, true_time)
    found = [measure(run, inside, function, lag, each, rng) for run in walks(matrix, N_RUNS, N_FRAMES, 2)]
    for k, reference in enumerate((true_population, true_time)):
        covered = np.mean([pair[k].low <= reference <= pair[k].high for pair in found])
        assert COVERED[0] <= covered <= COVERED[1], (system, k, covered)
        middle = float(np.mean([pair[k].value for pair in found]))
        assert middle == pytest.approx(reference, rel=0.08), "no bias"
        half = np.median([0.5 * (pair[k].high - pair[k].low) for pair in found])
        assert half < 0.6 * reference, "an interval that holds everything says nothing"


def test_intervals_from_frames_taken_for_independent_do_not_hold_the_reference() -> None:
    """Negative control: blocks of three frames where thirty remember each other."""
    matrix, x = double_well_chain(40)
    exact = stationary(matrix)
    function = kinetics.slow_functions(exact[:, None] * matrix, 1)[1][0]
    rng = np.random.default_rng(3)
    reference = float(exact[x < 0].sum())
    found = [measure(run, x < 0, function, 1, 3, rng)[0] for run in walks(matrix, 60, 1_500, 4)]
    assert np.mean([e.low <= reference <= e.high for e in found]) < 0.7


def test_the_grid_has_the_wells_population() -> None:
    matrix, x = double_well_chain(40)
    density = double_well_density(double_well(), 300.0, x)
    assert stationary(matrix) == pytest.approx(density / density.sum(), abs=1e-9)
    weight = stationary(matrix)
    # The point on the barrier's side of 0 stands for half its interval on either side.
    left = weight[x < -1e-9].sum() + 0.5 * weight[np.abs(x) < 1e-9].sum()
    assert left == pytest.approx(double_well_left_population(double_well(), 300.0), abs=0.005)


def test_chain_with_the_wrong_time_axis_is_outside() -> None:
    """Negative control: every second frame of the chain called a frame has half the timescale."""
    exact = stationary(CHAIN)
    function = kinetics.slow_functions(exact[:, None] * np.linalg.matrix_power(CHAIN, 2), 1)[1][0]
    reference = -1.0 / math.log(np.sort(np.linalg.eigvals(CHAIN).real)[::-1][1])
    rng = np.random.default_rng(5)
    runs = walks(CHAIN, 40, N_FRAMES, 6)[:, ::2]
    found = [measure(run, np.array([True, False, False]), function, 2, 80, rng)[1] for run in runs]
    assert np.mean([e.low <= reference <= e.high for e in found]) < 0.05
    assert np.mean([e.value for e in found]) == pytest.approx(reference / 2, rel=0.1)
