"""Blocks, bootstrap coverage, permutation tests, Holm's correction; bins and Jensen-Shannon distances against analytic
values and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.signal import lfilter
from scipy.spatial.distance import jensenshannon
from scipy.stats import norm

from surrogate.comparison.measure import distributions, statistics
from surrogate.comparison.measure.distributions import Bins, block_counts, block_counts_joint, distance, divergence
from surrogate.comparison.measure.statistics import Blocks, Estimate, make_blocks


def ar1_batch(a: float, shape: tuple[int, int], rng: np.random.Generator) -> np.ndarray:
    kicks = rng.standard_normal(shape) * math.sqrt(1 - a * a)
    kicks[:, 0] = rng.standard_normal(shape[0])
    return np.asarray(lfilter([1.0], [1.0, -a], kicks, axis=1))


@given(st.lists(st.integers(0, 500), min_size=1, max_size=12), st.integers(1, 300))
def test_blocks_cover_every_frame_once_and_cross_no_segment(lengths: list[int], target: int) -> None:
    blocks = statistics.make_blocks(lengths, target)
    seen = [np.zeros(n, dtype=int) for n in lengths]
    for piece in blocks.pieces:
        seen[piece.segment][piece.start : piece.stop] += 1
    assert all((s == 1).all() for s in seen)
    assert sorted({p.block for p in blocks.pieces}) == list(range(blocks.n_blocks))


def test_block_length_follows_the_correlation_time_between_its_limits() -> None:
    assert statistics.block_length(10_000, 20.0) == 200
    assert statistics.block_length(10_000, 0.5) == 100
    assert statistics.block_length(10_000, 5_000.0) == 2_500
    assert statistics.block_length(10_000, math.inf) == 2_500


def coverage(a: float, n_each: int, seed: int, n_experiments: int = 300) -> float:
    """Share of experiments whose interval for the mean holds the true one, with blocks of `n_each` frames."""
    rng = np.random.default_rng(seed)
    n_frames = 6_000
    blocks = statistics.make_blocks([n_frames], n_each)
    hits = 0
    for series in ar1_batch(a, (n_experiments, n_frames), rng):
        sums = np.array([series[p.start : p.stop].sum() for p in blocks.pieces])
        sizes = np.array([p.stop - p.start for p in blocks.pieces])
        weights = statistics.bootstrap_weights(blocks.n_blocks, 400, rng)
        found = statistics.estimate(series.mean(), weights @ sums / (weights @ sizes), blocks.n_blocks)
        hits += found.low <= 0.0 <= found.high
    return hits / n_experiments


def test_intervals_hold_the_reference_as_often_as_they_say() -> None:
    tau = (1 + 0.9) / (2 * (1 - 0.9))
    # 300 experiments: 95 % with a standard error of 1.3 %.
    assert 0.91 <= coverage(0.9, statistics.block_length(6_000, tau), 0) <= 0.985


def test_intervals_from_few_blocks_still_cover() -> None:
    assert 0.91 <= coverage(0.9, 600, 1) <= 0.985


def test_blocks_shorter_than_the_correlation_time_do_not_cover() -> None:
    """Negative control: two frames of twenty correlated ones taken for independent make intervals far too narrow."""
    assert coverage(0.9, 3, 2, n_experiments=40) < 0.75


def test_log_interval_stays_positive_and_is_as_wide_to_either_side_as_to_the_wider() -> None:
    rng = np.random.default_rng(3)
    found = statistics.estimate(1.0, np.exp(rng.normal(0.2, 0.8, 2000)), 20, log=True)
    assert 0 < found.low < 1 < found.high and found.low * found.high == pytest.approx(1.0)
    assert found.log_error == pytest.approx(0.8, rel=0.1)
    skewed = np.exp(-rng.exponential(0.8, 2000))
    for draws in (skewed, 1 / skewed):
        wide = statistics.estimate(1.0, draws, 20, log=True)
        assert wide.high == pytest.approx(found.high, rel=0.8) and wide.high > found.high, "the long side decides"


def test_an_estimate_of_nothing_has_no_interval() -> None:
    assert math.isnan(statistics.estimate(math.nan, np.ones(10), 10).low)
    assert statistics.estimate(1.0, [], 10).to_dict()["low"] is None


def test_difference_of_equal_and_of_distant_numbers() -> None:
    a, b = Estimate(1.0, error=0.1, n_blocks=50), Estimate(1.05, error=0.1, n_blocks=50)
    far = Estimate(2.0, error=0.1, n_blocks=50)
    assert statistics.difference_p(a, b) > 0.5
    assert statistics.difference_p(a, far) < 1e-6
    still = Estimate(1.0, error=0.0, n_blocks=50)
    assert statistics.difference_p(still, still) == 1.0
    assert statistics.difference_p(still, Estimate(1.1, error=0.0)) == 0.0
    assert math.isnan(statistics.difference_p(a, Estimate(math.nan)))


def test_few_blocks_with_a_small_spread_by_chance_are_no_alarm() -> None:
    """Means of 4 and of 80 blocks of one distribution: p < 0.001 once in a thousand times, not several times as often,
    as with Welch's error alone (negative control); a shift of three spreads of a block is mostly seen."""
    rng, n_trials, level = np.random.default_rng(11), 4000, 1e-3
    few, many = rng.standard_normal((n_trials, 4)), rng.standard_normal((n_trials, 80))

    def made(blocks: np.ndarray) -> list[Estimate]:
        errors = blocks.std(axis=1, ddof=1) / math.sqrt(blocks.shape[1])
        return [Estimate(m, error=e, n_blocks=blocks.shape[1]) for m, e in zip(blocks.mean(1), errors, strict=True)]

    fair = [statistics.difference_p(a, b) for a, b in zip(made(few), made(many), strict=True)]
    shifted = [statistics.difference_p(a, b) for a, b in zip(made(few + 3.0), made(many), strict=True)]
    welch = scipy.stats.ttest_ind(few, many, axis=1, equal_var=False).pvalue
    assert np.mean(np.array(fair) < level) <= 2 * level
    assert np.mean(welch < level) > 2 * level, "negative control"
    assert np.mean(np.array(shifted) < level) > 0.5


def test_permutation_p_is_uniform_under_the_null_and_small_off_it() -> None:
    rng = np.random.default_rng(4)
    bins = distributions.Bins(-4, 4, 20)

    def blocks_of(shift: float) -> np.ndarray:
        return np.stack([np.bincount(bins.index(rng.normal(shift, 1, 50)), minlength=bins.n_total) for _ in range(20)])

    ps = [
        statistics.permutation_p(blocks_of(0) * 1.0, blocks_of(0) * 1.0, distributions.distance, rng, 200)
        for _ in range(200)
    ]
    assert np.mean(ps) == pytest.approx(0.5, abs=0.08)
    assert 0.01 <= np.mean(np.array(ps) < 0.05) <= 0.10
    off = statistics.permutation_p(blocks_of(0) * 1.0, blocks_of(0.5) * 1.0, distributions.distance, rng, 500)
    assert off < 0.01


def test_holm_against_a_worked_example() -> None:
    # Sorted 0.01, 0.02, 0.03, 0.04 times 4, 3, 2, 1, made monotone; NaN does not count.
    assert statistics.holm([0.04, math.nan, 0.01, 0.03, 0.02])[2] == pytest.approx(0.04)
    found = statistics.holm([0.01, 0.02, 0.03, 0.04])
    assert found == pytest.approx([0.04, 0.06, 0.06, 0.06])
    assert math.isnan(statistics.holm([math.nan, 0.5])[0])


def test_effective_samples() -> None:
    assert statistics.effective_samples(1000, 5.0) == 100.0
    assert statistics.effective_samples(1000, 0.1) == 1000.0
    assert math.isnan(statistics.effective_samples(1000, math.nan))


WIDE = Bins(-8.0, 9.0, 400)


def counts_of(values: np.ndarray, bins: Bins) -> np.ndarray:
    return block_counts([values], bins, Blocks.whole([len(values)])).sum(0)


def gaussian_divergence(shift: float) -> float:
    """Exact Jensen-Shannon divergence of N(0, 1) and N(shift, 1), by quadrature."""

    def integrand(x: float) -> float:
        p, q = norm.pdf(x), norm.pdf(x - shift)
        m = 0.5 * (p + q)
        return 0.5 * (p * math.log(p / m) + q * math.log(q / m))

    return float(quad(integrand, -12, 12 + shift)[0])


def test_identical_is_zero_and_disjoint_is_root_of_ln_two() -> None:
    p = np.array([3.0, 5.0, 0.0, 0.0])
    assert distance(p, 7 * p) == 0.0
    assert distance(p, p[::-1]) == pytest.approx(math.sqrt(math.log(2.0)), abs=1e-12)


@pytest.mark.parametrize("shift", [0.2, 1.0, 3.0])
def test_gaussians_have_the_analytic_divergence(shift: float) -> None:
    edges = WIDE.edges
    p, q = np.diff(norm.cdf(edges)), np.diff(norm.cdf(edges - shift))
    assert divergence(p, q) == pytest.approx(gaussian_divergence(shift), rel=2e-3)
    rng = np.random.default_rng(0)
    sampled = divergence(counts_of(rng.normal(0, 1, 200_000), WIDE), counts_of(rng.normal(shift, 1, 200_000), WIDE))
    assert sampled == pytest.approx(gaussian_divergence(shift), rel=0.05, abs=5e-4)


@given(st.lists(st.integers(0, 50), min_size=6, max_size=6), st.lists(st.integers(0, 50), min_size=6, max_size=6))
def test_distance_equals_scipy_and_is_symmetric(p: list[int], q: list[int]) -> None:
    a, b = np.array(p, float), np.array(q, float)
    if not a.sum() or not b.sum():
        assert math.isnan(distance(a, b))
        return
    assert distance(a, b) == pytest.approx(jensenshannon(a, b), abs=1e-7)
    assert distance(a, b) == pytest.approx(distance(b, a), abs=1e-12)


def test_batched_distance_equals_one_by_one() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 9, (4, 3, 20)).astype(float), rng.integers(0, 9, (4, 3, 20)).astype(float)
    assert np.allclose(distance(a, b), [[distance(x, y) for x, y in zip(p, q)] for p, q in zip(a, b)])


def test_whatever_leaves_the_range_stays_in_the_histogram() -> None:
    bins = Bins(0.0, 1.0, 10)
    values = np.array([0.0, 1.0, 0.55, -3.0, 7.0, np.nan, np.inf, -np.inf, 1e300])
    counts = counts_of(values, bins)
    assert counts.sum() == len(values)
    assert counts[10] == 1 and counts[11] == 2 and counts[12] == 3
    assert counts[0] == 1 and counts[9] == 1 and counts[5] == 1


def test_frames_that_break_cannot_improve_a_score() -> None:
    """Negative control: the part of a wrong candidate that lies where the reference never is turns into NaN."""
    rng = np.random.default_rng(2)
    bins = Bins(-4.0, 4.0, 50)
    reference = counts_of(np.clip(rng.normal(-1, 0.5, 20_000), -4, 0.9), bins)
    wrong = np.concatenate([rng.normal(-1, 0.5, 16_000), np.full(4_000, 2.0)])
    hidden = np.where(wrong > 1.0, np.nan, wrong)
    honest = distance(reference, counts_of(wrong, bins))
    assert distance(reference, counts_of(hidden, bins)) >= honest - 1e-9
    dropped = distance(reference, counts_of(hidden[np.isfinite(hidden)], bins))
    assert dropped < 0.5 * honest, "the control itself: leaving frames out would have looked better"


def test_joint_counts_agree_with_numpy() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-np.pi, np.pi, (2, 5000))
    bins = distributions.RAMACHANDRAN_BINS
    blocks = make_blocks([5000], 700)
    counts = block_counts_joint([x], [y], bins, blocks)
    n = bins.n_total
    assert counts.shape == (blocks.n_blocks, n * n)
    expected = np.histogram2d(x, y, bins=bins.n, range=[(-np.pi, np.pi)] * 2)[0]
    assert np.array_equal(counts.sum(0).reshape(n, n)[: bins.n, : bins.n], expected)


def test_basins_part_the_circle_and_nan_is_in_none() -> None:
    psi = np.radians(np.array([-179.0, -121.0, -119.0, 0.0, 79.0, 81.0, 179.0, np.nan]))
    assert distributions.is_alpha(psi).tolist() == [False, False, True, True, True, False, False, False]
    assert distributions.is_beta(psi).tolist() == [True, True, False, False, False, True, True, False]


def test_free_energy_of_a_known_ratio() -> None:
    energy = distributions.free_energy_kj(np.array([100.0, 10.0, 0.0]), 300.0)
    assert energy[0] == 0.0
    assert energy[1] == pytest.approx(8.314462618e-3 * 300 * math.log(10))
    assert math.isnan(energy[2])
