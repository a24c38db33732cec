"""Interpolant and solvers against cases with known answers."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from surrogate.models.lam_slide import flow

MEAN, STD = 1.5, 0.4


def gaussian_posterior(std: float = STD, mean: float = MEAN):
    """E[o1 | o_tau] for data N(mean, std^2): the exact data prediction."""

    def predict(o: Tensor, tau: Tensor) -> Tensor:
        alpha = flow.expand(tau, o)
        sigma = 1.0 - alpha
        gain = alpha * std**2 / (alpha**2 * std**2 + sigma**2)
        return mean + gain * (o - alpha * mean)

    return predict


def test_paths_start_at_noise_and_end_at_data() -> None:
    data, noise = torch.randn(2, 3, 4, generator=torch.Generator().manual_seed(0))
    assert torch.equal(flow.mixed(data, noise, torch.zeros(3)), noise)
    assert torch.equal(flow.mixed(data, noise, torch.ones(3)), data)
    torch.testing.assert_close(flow.mixed(data, noise, torch.full((3,), 0.25)), 0.25 * data + 0.75 * noise)


def test_velocity_equals_equations_10_and_11() -> None:
    generator = torch.Generator().manual_seed(0)
    o, data = torch.randn(2, 5, 4, generator=generator, dtype=torch.float64)
    tau = torch.linspace(0.1, 0.9, 5, dtype=torch.float64)
    alpha = flow.expand(tau, o)
    sigma, d_alpha, d_sigma = 1.0 - alpha, 1.0, -1.0
    score = -(sigma**-2) * (o - alpha * data)
    paper = score * (d_alpha * sigma**2 / alpha - sigma * d_sigma) + d_alpha / alpha * o
    torch.testing.assert_close(flow.velocity(o, data, tau), paper)


def test_euler_carries_noise_to_the_data_distribution_and_converges() -> None:
    noise = torch.randn(20_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    errors = []
    for n_steps in (8, 16, 32, 64, 128):
        sample = flow.euler(gaussian_posterior(), noise, n_steps)
        errors.append(abs(float(sample.std()) / float(noise.std()) - STD))
    assert errors[-1] < 0.01
    assert abs(float(sample.mean()) - MEAN - STD * float(noise.mean())) < 0.01
    # First order or better: the error shrinks by a factor near two, at least, whenever the step is halved.
    assert all(fine < 0.7 * coarse for coarse, fine in pairwise(errors)), errors


def test_preconditioning_is_the_best_linear_denoiser_of_unit_data() -> None:
    generator = torch.Generator().manual_seed(1)
    data, noise = torch.randn(2, 200_000, generator=generator)
    for value in (0.1, 0.5, 0.9):
        tau = torch.tensor([value])
        skip, out, scale_in = flow.preconditioning(tau)
        noisy = flow.mixed(data, noise, tau.expand(len(data)))
        assert float((noisy * scale_in).std()) == pytest.approx(1.0, abs=0.01)
        residual = data - skip * noisy
        assert float(residual.std() / out) == pytest.approx(1.0, abs=0.01)
        # Orthogonal to the input: no other multiple of it would leave less.
        assert abs(float((residual * noisy).mean())) < 0.01


def test_no_steps_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        flow.euler(gaussian_posterior(), torch.zeros(1, 1), 0)


def test_rotations_are_uniform_over_so3() -> None:
    """The wrong density (uniform Euler angles) fails the second moment of a matrix element and the angle's law."""
    from surrogate.models.lam_slide.trainer import random_rotations

    r = random_rotations(40_000, torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(r @ r.mT, torch.eye(3, dtype=torch.float64).expand_as(r), atol=1e-5, rtol=0)
    assert torch.det(r).min() > 0.999
    # Haar: every element has mean 0 and mean square 1/3; the rotation angle has mean cosine -1/2 + 1/... = E[tr] = 0.
    assert r.mean(0).abs().max() < 0.015
    assert (r.square().mean(0) - 1 / 3).abs().max() < 0.01
    angle = torch.arccos(((r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1))
    expected = math.pi / 2 + 2 / math.pi  # density (1 - cos angle) / pi on [0, pi]
    assert float(angle.mean()) == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("width", [1.0, 0.4, 0.1, 0.05])
def test_multistep_keeps_narrow_directions_wide(width: float) -> None:
    """Linear in the noise, so the ratio of the widths is exact: how much too narrow a direction comes out."""
    noise = torch.randn(100, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def error(sample: Tensor) -> float:
        return abs(float(sample.std() / noise.std()) / width - 1.0)

    predict = gaussian_posterior(width)
    errors = [error(flow.multistep(predict, noise, n)) for n in (10, 20, 40, 80)]
    assert errors[0] < 0.14 and errors[1] < 0.016
    # Second order once the steps are fine enough.
    assert errors[3] < 0.35 * errors[2], errors
    # Negative control: Euler's even steps.
    assert error(flow.euler(predict, noise, 20)) > 4 * errors[1]
    sample = flow.multistep(predict, noise, 40)
    assert abs(float(sample.mean()) - MEAN - width * float(noise.mean())) < 0.002


@pytest.mark.parametrize("solver", ["multistep", "fitted"])
def test_one_step_lands_on_the_prediction_as_eulers_does(solver: str) -> None:
    noise = torch.randn(7, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    predict = gaussian_posterior()
    torch.testing.assert_close(flow.SOLVERS[solver](predict, noise, 1), flow.euler(predict, noise, 1))


def relative_width(solver: str, width: float, n_steps: int) -> float:
    """Return how wide Gaussian data of this width come out, over that: linear in the noise, so exact."""
    noise = torch.randn(50, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sample = flow.SOLVERS[solver](gaussian_posterior(width), noise, n_steps)
    assert abs(float(sample.mean()) - MEAN - float(sample.std() / noise.std()) * float(noise.mean())) < 1e-6
    return float(sample.std() / noise.std()) / width


def test_fitted_steps_are_exact_for_the_width_they_are_fitted_to() -> None:
    """A step from exact states, and for data of no other width."""

    def step_error(width: float, before: float, left: float, right: float, fitted_to: float) -> float:
        def x(level: float) -> float:
            return math.sqrt(((1 - level) * width) ** 2 + level**2)

        def predicted(level: float) -> float:
            return (1 - level) * width**2 / x(level)

        share = flow.fitted_share(before, left, right, fitted_to)
        ahead = predicted(left) + share * (predicted(left) - predicted(before))
        return abs(ahead + right / left * (x(left) - ahead) - x(right)) / x(right)

    for before, left, right, width in ((1.0, 0.75, 0.25, 2.4), (0.75, 0.25, 0.0, 0.27), (0.6, 0.2, 0.05, 0.2)):
        assert step_error(width, before, left, right, width) < 1e-12
        assert step_error(2 * width, before, left, right, width) > 1e-3
        assert step_error(width / 2, before, left, right, width) > 1e-3


@pytest.mark.parametrize(("n_steps", "within"), [(2, 0.23), (3, 0.05), (4, 0.1)])
def test_few_fitted_steps_keep_wide_directions(n_steps: int, within: float) -> None:
    """Directions as wide as the data or wider, in which states differ; multistep and euler lose many times as much."""
    errors = {
        solver: max(abs(relative_width(solver, width, n_steps) - 1) for width in (0.7, 1.0, 1.5, 2.0))
        for solver in ("fitted", "multistep", "euler")
    }
    assert errors["fitted"] < within, errors
    # Negative controls. Two multistep steps on the same grid are as good as two fitted ones.
    assert errors["euler"] > 2.5 * errors["fitted"], errors
    assert n_steps == 2 or errors["multistep"] > 2.5 * errors["fitted"], errors


@pytest.mark.parametrize("n_steps", [3, 6, 10])
def test_gaussian_steps_keep_unit_variance_and_multistep_does_not(n_steps: int) -> None:
    """The first step knows no earlier prediction, which costs a little where steps are few."""
    errors = {solver: abs(relative_width(solver, 1.0, n_steps) - 1) for solver in ("gaussian", "multistep", "euler")}
    assert errors["gaussian"] < (0.06 if n_steps == 3 else 0.01), errors
    assert min(errors["multistep"], errors["euler"]) > 2.5 * errors["gaussian"], errors
    assert abs(relative_width("gaussian", 0.3, 40) - 1) < 0.01, "of other widths it is of second order, too"


@pytest.mark.parametrize("n_steps", [1, 2, 3, 10])
def test_angular_steps_are_exact_for_unit_variance_and_of_second_order_for_others(n_steps: int) -> None:
    def width_of(solver: str, width: float, n_steps: int) -> float:
        noise = torch.linspace(-2.0, 2.0, 9, dtype=torch.float64)[:, None]
        sample = flow.SOLVERS[solver](gaussian_posterior(width, mean=0.0), noise, n_steps)
        return float(sample.std() / noise.std())

    assert width_of("angular", 1.0, n_steps) == pytest.approx(1.0, abs=1e-6)
    assert abs(width_of("gaussian", 1.0, n_steps) - 1.0) > 1e-4, "negative control"
    for width in (0.5, 1.5):
        errors = [abs(width_of("angular", width, n) - width) for n in (20, 40, 80)]
        assert all(0.15 < fine / coarse < 0.35 for coarse, fine in pairwise(errors)), errors
        assert errors[-1] < 0.002


@pytest.mark.parametrize("width", [2.0, 0.4, 0.2])
def test_fitted_is_of_second_order(width: float) -> None:
    errors = [abs(relative_width("fitted", width, n) - 1) for n in (40, 80, 160)]
    assert all(0.15 < fine / coarse < 0.42 for coarse, fine in pairwise(errors)), errors
    assert errors[-1] < 0.01


def test_adaptive_steps_carry_noise_to_the_data_distribution() -> None:
    """Linear in the noise: the ratio of the widths is exact but for the tolerance."""
    noise = torch.randn(100, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    exact = gaussian_posterior(0.2)
    calls = 0

    def predict(o: Tensor, tau: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return exact(o, tau)

    def error(sample: Tensor) -> float:
        return abs(float(sample.std() / noise.std()) / 0.2 - 1.0)

    errors, counts = [], []
    for n_steps in (20, 2000):
        calls = 0
        errors.append(error(flow.dopri5(predict, noise, n_steps)))
        counts.append(calls)
    assert errors[0] < 0.01 and errors[1] < 1e-4, errors
    assert 10 < counts[0] < counts[1] < 300, counts
    # Negative control: as many even Euler steps as the finer took are further off.
    assert error(flow.euler(exact, noise, counts[1])) > 10 * errors[1]
