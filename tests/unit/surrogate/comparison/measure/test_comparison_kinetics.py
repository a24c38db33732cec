"""Autocorrelation, its integral and TICA against brute force and processes whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.statistics import Blocks, make_blocks


def ar1(a: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """A stationary AR(1) process of unit variance: correlation a^t."""
    kicks = rng.standard_normal(n) * math.sqrt(1 - a * a)
    kicks[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], kicks))


def brute_force(segments: list[np.ndarray], lag: int) -> float:
    every = np.concatenate(segments)
    mean = np.nanmean(every)
    pairs = [(x - mean) * (y - mean) for s in segments for x, y in zip(s[: len(s) - lag], s[lag:])]
    return float(np.nanmean(pairs) / np.nanmean((every - mean) ** 2))


def test_fft_equals_brute_force_over_segments_of_unequal_length() -> None:
    rng = np.random.default_rng(0)
    segments = [ar1(0.8, n, rng) + shift for n, shift in ((300, 0.0), (77, 1.0), (150, -1.0))]
    blocks = make_blocks([len(s) for s in segments], 40)
    found = kinetics.autocorrelation(kinetics.lag_sums(segments, blocks, 60))
    assert found == pytest.approx([brute_force(segments, lag) for lag in range(60)], abs=1e-9)


def test_frames_that_are_not_finite_drop_out_of_their_pairs_alone() -> None:
    rng = np.random.default_rng(1)
    x = ar1(0.9, 400, rng)
    x[[3, 77, 200]] = np.nan
    found = kinetics.autocorrelation(kinetics.lag_sums([x], make_blocks([400], 50), 30))
    assert found == pytest.approx([brute_force([x], lag) for lag in range(30)], abs=1e-9)


def test_no_pair_crosses_a_segment() -> None:
    """Negative control: two constant segments; joined they would decorrelate, apart they never change."""
    segments = [np.full(50, -1.0), np.full(50, 1.0)]
    sums = kinetics.lag_sums(segments, make_blocks([50, 50], 10), 30)
    assert sums.n.sum(0).tolist() == [2 * (50 - lag) for lag in range(30)]
    assert kinetics.autocorrelation(sums) == pytest.approx(np.ones(30))
    joined = kinetics.autocorrelation(kinetics.lag_sums([np.concatenate(segments)], make_blocks([100], 10), 30))
    assert joined[-1] < 0.7


def test_block_weights_of_one_give_the_whole() -> None:
    x = ar1(0.7, 1000, np.random.default_rng(2))
    sums = kinetics.lag_sums([x], make_blocks([1000], 100), 20)
    whole = kinetics.autocorrelation(sums)
    assert kinetics.autocorrelation(sums, np.ones((2, 10))) == pytest.approx(np.stack([whole, whole]))


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9, 0.98])
def test_integral_of_the_exact_ar1_curve(a: float) -> None:
    curve = a ** np.arange(4000.0)
    assert kinetics.correlation_time(curve) == pytest.approx((1 + a) / (2 * (1 - a)), rel=1e-6)


def test_integral_stops_at_the_interpolated_zero() -> None:
    # Trapezoid 1 -> 0.5, then the triangle from 0.5 to its zero half a frame on; the later bump must not count.
    curve = np.array([1.0, 0.5, -0.5, 0.9, 0.9])
    assert kinetics.correlation_time(curve) == pytest.approx(0.75 + 0.125)
    assert kinetics.correlation_time(np.stack([curve, curve])) == pytest.approx([0.875, 0.875])


def test_integral_of_a_dead_series_is_not_a_number() -> None:
    lag, time = kinetics.zero_crossing([np.full(100, 0.3)])
    assert math.isnan(time) and lag >= 1


@pytest.mark.parametrize("a", [0.5, 0.95])
def test_time_of_a_sampled_ar1_process(a: float) -> None:
    rng = np.random.default_rng(3)
    exact = (1 + a) / (2 * (1 - a))
    times = [kinetics.zero_crossing([ar1(a, 40_000, rng), ar1(a, 40_000, rng)])[1] for _ in range(5)]
    assert np.mean(times) == pytest.approx(exact, rel=0.1)


def test_shuffled_frames_have_no_memory() -> None:
    """Negative control."""
    rng = np.random.default_rng(4)
    x = ar1(0.95, 20_000, rng)
    rng.shuffle(x)
    assert kinetics.zero_crossing([x])[1] < 1.0


def mixed_features(rng: np.random.Generator, n: int) -> np.ndarray:
    """A slow and a fast AR(1) process, rotated into each other, and a constant."""
    slow, fast = ar1(0.98, n, rng), 3.0 * ar1(0.3, n, rng)
    return np.stack([slow + fast, slow - fast, np.zeros(n)], axis=1)


def test_tica_finds_the_slow_process_and_its_timescale() -> None:
    rng = np.random.default_rng(5)
    segments = [mixed_features(rng, 30_000) for _ in range(3)]
    model = kinetics.fit_tica(segments, 5)
    assert model is not None
    assert float(kinetics.timescale(model.eigenvalues[0], 5.0)) == pytest.approx(-1 / math.log(0.98), rel=0.1)
    projected = model.project(segments[0])
    slow = segments[0][:, 0] + segments[0][:, 1]
    assert abs(np.corrcoef(projected, slow)[0, 1]) > 0.99


def test_our_eigenvalue_on_the_reference_is_deeptimes() -> None:
    rng = np.random.default_rng(6)
    segments = [mixed_features(rng, n) for n in (4000, 2500)]
    model = kinetics.fit_tica(segments, 7)
    assert model is not None
    projected = [model.project(s) for s in segments]
    sums = kinetics.pair_sums(projected, make_blocks([4000, 2500], 300), 7)
    assert float(kinetics.lagged_eigenvalue(sums)) == pytest.approx(model.eigenvalues[0], abs=1e-9)


def test_tica_skips_what_is_not_finite_and_refuses_what_does_not_move() -> None:
    rng = np.random.default_rng(7)
    features = mixed_features(rng, 6000)
    broken = features.copy()
    broken[3000] = np.nan
    with_gap, without = kinetics.fit_tica([broken], 5), kinetics.fit_tica([features[:3000], features[3001:]], 5)
    assert with_gap is not None and without is not None
    assert with_gap.eigenvalues[0] == pytest.approx(without.eigenvalues[0], abs=1e-12)
    assert np.isnan(with_gap.project(broken)[3000])
    assert kinetics.fit_tica([np.ones((500, 4))], 5) is None


def test_timescale_of_limits() -> None:
    found = kinetics.timescale([-0.2, 0.0, math.exp(-0.5), np.nan], 10.0)
    assert found[:3].tolist() == pytest.approx([0.0, 0.0, 20.0])
    assert math.isnan(found[3])


def test_whole_blocks_are_segments() -> None:
    assert [p.block for p in Blocks.whole([3, 4]).pieces] == [0, 1]
