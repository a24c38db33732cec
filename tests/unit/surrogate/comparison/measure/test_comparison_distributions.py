"""Jensen-Shannon distances and bins against analytic values and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial.distance import jensenshannon
from scipy.stats import norm

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.distributions import Bins, block_counts, block_counts_joint, distance, divergence
from surrogate.comparison.measure.statistics import Blocks, make_blocks

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
