from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from surrogate.comparison import markov
from surrogate.comparison.markov import Equilibrium, equilibrium, reversible, with_images
from systems.errors import InputError

# Three states in a row, of populations .6, .3 and .1; a jump in some 200 frames.
POPULATIONS = np.array([0.6, 0.3, 0.1])


def chain(populations: np.ndarray = POPULATIONS, rate: float = 0.01) -> np.ndarray:
    """A reversible matrix of neighbours, by Metropolis."""
    n = len(populations)
    matrix = np.zeros((n, n))
    for i in range(n - 1):
        matrix[i, i + 1] = rate * min(1.0, populations[i + 1] / populations[i])
        matrix[i + 1, i] = rate * min(1.0, populations[i] / populations[i + 1])
    return matrix + np.diag(1.0 - matrix.sum(1))


def run(matrix: np.ndarray, starts: list[int], n_frames: int, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    state = np.array(starts)
    cumulative = matrix.cumsum(1)
    out = np.empty((len(starts), n_frames), dtype=np.int64)
    for t in range(n_frames):
        out[:, t] = state
        state = (rng.random(len(starts))[:, None] > cumulative[state]).sum(1)
    return list(out)


def averages(micro: list[np.ndarray], n: int = 3) -> np.ndarray:
    return np.bincount(np.concatenate(micro), minlength=n) / sum(map(len, micro))


@pytest.mark.parametrize("starts", [[0] * 32, [2] * 32, [0, 1, 2, 2] * 8])
def test_short_replicas_tell_equilibrium_wherever_they_begin(starts: list[int]) -> None:
    micro = run(chain(), starts, 300)
    found = equilibrium(micro, seed=1)
    error = found.draws.std(0)
    assert found.method == "Markov model" and found.flat and found.ck_holds
    assert (np.abs(found.populations - POPULATIONS) < 3.0 * error + 0.01).all()
    assert error.max() < 0.2
    # The negative control: their averages are wrong.
    assert np.abs(averages(micro) - POPULATIONS).max() > 0.05


def test_errors_hold_as_often_as_they_say() -> None:
    inside = []
    for seed in range(30):
        found = equilibrium(run(chain(), [0, 1, 2, 2] * 8, 300, seed), seed=seed)
        inside += (np.abs(found.populations - POPULATIONS) < 2.0 * found.draws.std(0)).tolist()
    assert np.mean(inside) > 0.85


def hardly_crossed(rare: float, seed: int) -> Equilibrium:
    """Of the third state, in which two of sixteen replicas begin, some three ways out and back in all."""
    populations = np.array([0.6, 0.4 - rare, rare])
    matrix = chain(populations, 0.03)
    flux = 3.0 / (16 * 1000)
    for i, j in ((1, 2), (2, 1)):
        matrix[i, i] += matrix[i, j] - flux / populations[i]
        matrix[i, j] = flux / populations[i]
    return equilibrium(run(matrix, [0] * 8 + [1] * 6 + [2] * 2, 1000, seed), seed=seed)


def test_few_crossings_leave_open_what_they_lead_to_and_not_all_else() -> None:
    found = [f for f in (hardly_crossed(0.02, seed) for seed in range(20)) if f.rare and f.rare[0].crossings < 4]
    assert len(found) > 5 and all(f.holds and set(f.rare[0].microstates) == {2} for f in found)
    off = [np.abs(f.populations - np.array([0.6, 0.38, 0.02])) / f.draws.std(0) for f in found]
    assert np.mean(np.array(off) < 2.0, axis=0).min() > 0.85
    assert all(f.draws[:, 2].std() / f.populations[2] > 0.4 for f in found), "known to a factor"
    # The negative control: where they lead to much they leave open all.
    open_ = [f for f in (hardly_crossed(0.3, seed) for seed in range(20)) if 0 < f.crossings < 5]
    assert len(open_) > 5 and not any(f.holds or f.rare for f in open_)


def test_plain_averages_name_nothing_as_hardly_known() -> None:
    """Of a state that is short-lived and rarely entered, by replicas that outlast it many times."""
    matrix = np.array([[0.97, 0.03, 0.0], [0.03, 0.96995, 0.00005], [0.0, 0.01, 0.99]])
    found = [equilibrium(run(matrix, [0, 1] * 8, 3000, seed), seed=seed) for seed in range(6)]
    averaged = [f for f in found if f.method == "plain averages" and f.crossings < 5]
    assert averaged and all(f.holds and not f.rare for f in averaged)


def test_averages_count_where_transitions_are_few_and_only_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replicas that begin in nearly the right proportions and hardly ever change state."""
    starts = np.repeat([0, 1, 2], [18, 10, 4]).tolist()

    def errors(n_frames: int) -> list[float]:
        found = [equilibrium(run(chain(), starts, n_frames, seed), lag=5).populations for seed in range(12)]
        return [float(np.sqrt(np.mean(np.square(p - POPULATIONS)))) for p in found]

    few, many = errors(60), errors(3000)
    monkeypatch.setattr(markov, "_AVERAGES_CROSSINGS", 0.01)
    assert np.mean(few) < 0.75 * np.mean(errors(60))
    assert np.mean(many) == pytest.approx(np.mean(errors(3000)), rel=0.2)
    # What is not connected has no weight, whatever its frames.
    monkeypatch.undo()
    alone = equilibrium([*run(chain(POPULATIONS[:2]), [0, 1] * 8, 400), *run(np.eye(3), [2] * 4, 400)])
    assert alone.populations[2] == 0.0 and alone.unconnected[0].fate == "only begun in"


def test_weights_give_the_populations_and_have_mean_one() -> None:
    micro = run(chain(), [2] * 32, 300)
    found = equilibrium(micro)
    weights, labels = np.concatenate(found.weights), np.concatenate(micro)
    assert weights.mean() == pytest.approx(1.0)
    assert np.bincount(labels, weights) / weights.sum() == pytest.approx(found.populations)
    share, draws = found.shares(micro, micro, 3)
    assert share == pytest.approx(found.populations) and draws.shape == (50, 3)


def test_timescales_are_those_of_the_chain() -> None:
    matrix = chain()
    exact = -1.0 / np.log(np.sort(np.linalg.eigvals(matrix).real)[-2])
    found = equilibrium(run(matrix, [0, 1, 2, 2] * 8, 500))
    assert abs(found.timescales[0] - exact) < 3.0 * found.timescale_errors[0]


def test_blurred_states_take_a_lag_at_which_their_process_is_as_slow_as_it_is() -> None:
    """Frames near a barrier are put on either side, which looks like jumps at short lags. Few transitions make wide
    errors, and yet lags do not agree: chance at one of them is chance at all."""
    rng, slowest, inside = np.random.default_rng(3), [], []
    slow = np.array([[0.9995, 0.0005], [0.0005, 0.9995]])  # takes 1000 frames
    for seed in range(6):
        hidden = run(slow, [0] * 10 + [1] * 6, 1000, seed)
        blurred = [np.where(rng.random(len(m)) < 0.002, 1 - m, m) for m in hidden]
        found, short = equilibrium(blurred, seed=seed), equilibrium(blurred, lag=5)
        slowest.append((found.timescales[0], short.timescales[0]))
        inside.append(abs(found.populations[0] - 0.5) < 2.0 * found.draws[:, 0].std())
    long, control = np.median(slowest, axis=0)
    assert 600.0 < long < 1700.0 and control < 450.0
    assert np.mean(inside) >= 0.5


def test_replicas_that_outlast_the_slowest_process_are_averaged() -> None:
    micro = run(chain(rate=0.2), [2] * 16, 4000)
    found = equilibrium(micro)
    assert found.method == "plain averages"
    assert np.abs(found.populations - POPULATIONS).max() < 0.02
    assert found.weights[0][0] == 0.0 and found.weights[0][-1] > 0.0  # its beginning is left out


def test_a_state_that_was_only_begun_in_has_no_weight_and_is_named() -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = chain()
    found = equilibrium(run(matrix, [0, 1, 2, 3] * 8, 300))
    (lost,) = found.unconnected
    assert lost.fate == "only begun in" and lost.microstates == (3,) and lost.n_replicas == 8
    assert lost.share == pytest.approx(0.25) and found.populations[3] == 0.0
    assert found.method == "Markov model"


def test_a_state_that_was_invented_is_left_and_has_no_weight() -> None:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = chain()
    matrix[3] = [0.02, 0.0, 0.0, 0.98]
    micro = run(matrix, [3] * 32, 400)
    found = equilibrium(micro)
    (lost,) = found.unconnected
    assert lost.fate == "left and never entered" and found.populations[3] == 0.0
    assert (np.abs(found.populations[:3] - POPULATIONS) < 3.0 * found.draws.std(0)[:3] + 0.01).all()


def test_a_state_that_is_left_slowly_is_not_left_for_good() -> None:
    """Alanine dipeptide's left-handed state in a short run: four replicas begin there, one leaves."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = chain(rate=0.2)
    matrix[3, 3] = 1.0
    micro = run(matrix, [0, 1, 2, 3] * 4, 2000)
    micro[3][700:] = 0
    found = equilibrium(micro)
    (lost,) = found.unconnected
    assert lost.fate == "begun in and not always left" and lost.n_replicas == 4
    assert found.method == "Markov model" and found.populations[3] == 0.0, "plain averages would weigh where it began"
    for m in micro[7::4]:
        m[700:] = 0
    gone = equilibrium(micro)
    assert gone.method == "plain averages" and gone.unconnected[0].fate == "left and never entered", "control"
    assert gone.populations[3] == 0.0 and not any(w[m == 3].any() for w, m in zip(gone.weights, micro, strict=True))


def test_a_state_that_is_entered_and_never_left_is_said() -> None:
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = chain()
    matrix[2, 2] -= 0.002
    matrix[2, 3] = 0.002
    matrix[3, 3] = 1.0
    found = equilibrium(run(matrix, [0, 1, 2, 2] * 8, 400))
    assert {u.fate for u in found.unconnected} == {"entered and never left"}


def test_states_that_are_too_coarse_are_found_out() -> None:
    """Two states in a row of fast and slow ones, seen as two that hide the slow one: no lag in the replicas is flat."""
    populations = np.array([0.25, 0.25, 0.25, 0.25])
    matrix = chain(populations, 0.3)
    matrix[1, 2] = matrix[2, 1] = 0.002
    matrix[1, 1] = matrix[2, 2] = 1.0 - 0.3 - 0.002
    hidden = [np.isin(m, (0, 3)).astype(np.int64) for m in run(matrix, [0, 1] * 16, 200)]
    good = equilibrium(run(matrix, [0, 1, 2, 3] * 8, 400))
    assert good.timescales[0] > 50.0
    assert equilibrium(hidden).timescales[0] < 10.0  # nothing tells of what states hide: why features come from TICA


def test_what_images_are_known_to_balance_need_not_be_seen_often() -> None:
    """Two states of either hand, that turn into each other often and change hands hardly ever."""
    matrix = np.array(
        [[0.95, 0.05, 0.0, 0.0], [0.1, 0.899, 0.001, 0.0], [0.0, 0.001, 0.899, 0.1], [0.0, 0.0, 0.05, 0.95]]
    )
    micro = run(matrix, [0, 1] * 6, 200, 1)
    alone, one = equilibrium(micro), [np.minimum(m, 3 - m) for m in micro]
    both = with_images(equilibrium(one), one, [m > 1 for m in micro])
    assert alone.unconnected and not both.unconnected, "negative control"
    assert both.holds and both.crossings > 50 and both.n_own == len(micro)
    right = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 3])
    assert np.abs(both.populations - 2 * right[:2]).max() < 0.04
    shares, draws = both.shares(one * 2, [*micro, *(3 - m for m in micro)], 4)
    assert np.abs(shares - right).max() < 0.02 and shares[[0, 1]] == pytest.approx(shares[[3, 2]])
    assert draws[:, 0] == pytest.approx(draws[:, 3]) and draws[:, 0].std() > 0.002
    # Frames of MD have these populations by their weights.
    weighted = np.bincount(np.concatenate(micro), np.concatenate(both.weights[: both.n_own]), minlength=4)
    assert weighted / weighted.sum() == pytest.approx(shares, abs=1e-6)


@pytest.mark.parametrize("every", [7, 2, 1])
def test_what_fits_nothing_is_left_out(
    every: int, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    """Lags or resampled replicas of which no matrix is found: by others the answer stands, by none it is a line."""
    calls, fits = itertools.count(1), markov._fits

    def sometimes(counts: Sequence[np.ndarray], settled: float = 0.0) -> list[Any]:
        return [None if next(calls) % every == 0 else found for found in fits(counts)]

    monkeypatch.setattr(markov, "_fits", sometimes)
    micro = run(chain(), [0, 1, 2, 2] * 8, 300)
    if every == 1:
        with pytest.raises(InputError, match="no reversible Markov model fits"):
            equilibrium(micro)
        return
    found = equilibrium(micro)
    assert np.isfinite(found.timescale_errors[0]) and np.abs(found.populations - POPULATIONS).max() < 0.2
    assert not recwarn.list


def test_nothing_to_count_is_one_line() -> None:
    with pytest.raises(InputError, match="longer replicas"):
        equilibrium([np.full(10, -1)])


def test_replicas_that_never_change_their_state_tell_no_timescale() -> None:
    micro = [np.full(80, k % 2, dtype=np.int64) for k in range(16)]
    found = equilibrium(micro)
    assert not len(found.timescales) and [u.fate for u in found.unconnected] == ["only begun in"]


@pytest.mark.parametrize("coupling", [1.0, 1e-3])
def test_the_likeliest_reversible_matrix_is_deeptime_s(coupling: float) -> None:
    """Two groups of states, well and hardly connected; detailed balance, and no likelier matrix nearby."""
    from deeptime.markov.msm import MaximumLikelihoodMSM

    rng = np.random.default_rng(3)
    counts = rng.integers(5, 200, (12, 12)).astype(float)
    counts[:6, 6:] = counts[6:, :6] = 0.0
    counts[2, 7], counts[7, 2] = np.ceil(3.0 * coupling), np.ceil(40.0 * coupling)
    (found,) = reversible(counts[None])
    assert found is not None
    matrix, stationary = found
    right = MaximumLikelihoodMSM(reversible=True, maxiter=1_000_000, maxerr=1e-13).fit(counts).fetch_model()
    np.testing.assert_allclose(stationary, right.stationary_distribution, rtol=1e-5)
    np.testing.assert_allclose(matrix, right.transition_matrix, atol=1e-6)
    flux = stationary[:, None] * matrix
    np.testing.assert_allclose(flux, flux.T, atol=1e-15)
    assert not np.allclose(matrix, counts / counts.sum(1)[:, None], atol=1e-3), "these counts alone are not reversible"
