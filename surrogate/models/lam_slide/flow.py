"""The linear stochastic interpolant with data prediction, and the solvers that integrate it (section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

# Constant of the solver `fitted`: its steps are fitted to widths of 1 - FITTED_BELOW / n_steps times noise over
# signal. Exact predictions of Gaussian data want about 0.6, 0.75, 0.85 and 0.95 of it at 2, 3, 4 and 6 steps; a
# trained network, which leaves narrow directions too narrow, a little less.
FITTED_BELOW = 0.8
# Where adaptive steps end.
ADAPTIVE_END = 0.999
# (o_tau (b, ...), tau (b,), or (1,) of all rows) -> prediction of the data o_1 (b, ...)
DataPrediction = Callable[[Tensor, Tensor], Tensor]


def mixed(data: Tensor, noise: Tensor, tau: Tensor) -> Tensor:
    """Return o_tau `(b, ...)` at flow times `tau` (b,): the linear interpolant tau data + (1 - tau) noise (eq. 7)."""
    return expand(tau, data) * data + expand(1.0 - tau, data) * noise


def velocity(o: Tensor, prediction: Tensor, tau: Tensor) -> Tensor:
    """Velocity from a data prediction (eq. 10 and 11, simplified).

    Eliminating the score gives an expression without the division by tau that is singular at tau = 0.
    """
    tau = expand(tau, o)
    return prediction - (o - tau * prediction) / (1.0 - tau)


def preconditioning(tau: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return c_skip, c_out and c_in for data of unit variance: o1 = c_skip o + c_out F(c_in o, tau).

    With alpha = tau and sigma = 1 - tau, c_skip is the best linear denoiser alpha / (alpha^2 + sigma^2), c_out its
    error's standard deviation, so that F has unit variance at every flow time (Karras 2022, Table 1, for this path).
    """
    sigma = 1.0 - tau
    power = tau.square() + sigma.square()
    return tau / power, sigma / power.sqrt(), power.rsqrt()


def expand(value: Tensor, like: Tensor) -> Tensor:
    """Reshape `(b,)` so that it broadcasts over `(b, ...)`."""
    return value.reshape(-1, *([1] * (like.ndim - 1)))


def euler(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """Integrate from noise (tau = 0) to data (tau = 1) in `n_steps` evaluations; the last step lands on o_hat."""
    o = noise
    grid = torch.linspace(0.0, 1.0, n_steps + 1).tolist()
    for start, end in pairwise(grid):
        tau = torch.full((1,), start, device=o.device, dtype=torch.float32)
        prediction = predict(o, tau)
        if end == 1.0:
            return prediction
        o = o + (end - start) * velocity(o, prediction, tau)
    raise ValueError(f"n_steps must be at least 1, not {n_steps}")


def multistep(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """Integrate from noise to data with the prediction extrapolated in the flow time.

    Second order at one evaluation a step: between two grid points the prediction is the line through the last two, for
    which dx/dtau = (o1 - x) / (1 - tau) is integrated exactly (the idea of DPM-Solver++ 2M, Lu 2022, in tau). The grid
    1 - tau = cos^2(pi k / 2 n) is fine at both ends: near the noise it is decided which state a chunk goes to, near the
    data how wide narrow directions are (bonds).
    """
    o = noise
    grid = [1.0 - level for level in _noise_levels(n_steps)]
    before: tuple[float, Tensor] | None = None
    for start, end in pairwise(grid):
        prediction = predict(o, torch.full((1,), start, device=o.device, dtype=torch.float32))
        left, right = 1.0 - start, 1.0 - end
        step = prediction + (right / left) * (o - prediction)
        if before is not None:
            slope = (prediction - before[1]) / (start - before[0])
            log_term = right * math.log(left / right) if right > 0.0 else 0.0
            step = step + (left - right - log_term) * slope
        o, before = step, (start, prediction)
    return o


def fitted(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """Integrate in very few steps: 2 to 10 evaluations, one a step.

    Between two grid points of `multistep` the prediction is a constant, that of the step's start and `fitted_share` of
    its change since the grid point before: so much that the step is exact for Gaussian data (exponential fitting:
    Lyche, Numer. Math. 19, 65, 1972) of a width a little below the ratio of noise to signal there. Second order; from
    about 10 steps on `multistep` is the better.
    """
    below = 1.0 - FITTED_BELOW / n_steps
    return _exponential(predict, noise, n_steps, lambda left: below * left / (1.0 - left))


def gaussian(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """`fitted` to one width, that of numbers of unit variance: exact where these are Gaussian at any number of steps,
    as innovations of peptides nearly are."""
    return _exponential(predict, noise, n_steps, lambda left: 1.0)


def angular(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """Integrate in even steps of the angle whose tangent is signal over noise: second order, one evaluation a step.

    Over its width for data of unit variance, o moves with the angle by F: by how much the prediction differs from the
    best linear one, in units of that one's error (`preconditioning`; TrigFlow, Lu and Song 2024, arXiv:2410.11081). It
    is zero for Gaussian numbers of unit variance, and else extrapolated from the step before (Adams and Bashforth).
    """
    step = 0.5 * math.pi / n_steps
    u, before = noise, None
    for k in range(n_steps):
        signal, left = math.sin(k * step), math.cos(k * step)
        tau = torch.full((1,), signal / (signal + left), device=u.device, dtype=torch.float32)
        size = 1.0 / (signal + left)
        # c_skip o = signal u, c_out = left.
        moves = (predict(size * u, tau) - signal * u) / left
        u = u + step * (moves if before is None else 1.5 * moves - 0.5 * before)
        before = moves
    return u


def _exponential(predict: DataPrediction, noise: Tensor, n_steps: int, width_at: Callable[[float], float]) -> Tensor:
    o = noise
    levels = _noise_levels(n_steps)
    before: Tensor | None = None
    for k, (left, right) in enumerate(pairwise(levels)):
        ahead = prediction = predict(o, torch.full((1,), 1.0 - left, device=o.device, dtype=torch.float32))
        if before is not None:
            ahead = prediction + fitted_share(levels[k - 1], left, right, width_at(left)) * (prediction - before)
        o, before = ahead + (right / left) * (o - ahead), prediction
    return o


def _noise_levels(n_steps: int) -> list[float]:
    """Return 1 - tau = cos^2(pi k / 2 n) for k = 0..n, from exactly 1 to exactly 0."""
    return [math.cos(0.5 * math.pi * k / n_steps) ** 2 for k in range(n_steps)] + [0.0]


def fitted_share(before: float, left: float, right: float, width: float) -> float:
    """Return by how much of the prediction's last change, from noise level 1 - tau = `before` to `left`, the step from
    `left` to `right` has to look ahead to be exact for Gaussian data of this width.

    For data of width w and unit noise, x(s) = sqrt((1 - s)^2 w^2 + s^2) from x(1) = 1, and the data prediction along it
    is (1 - s) w^2 / x(s).
    """

    def path(level: float) -> float:
        return math.hypot((1.0 - level) * width, level)

    def prediction(level: float) -> float:
        return (1.0 - level) * width**2 / path(level)

    wanted = (path(right) - right / left * path(left)) / (1.0 - right / left)
    return (wanted - prediction(left)) / (prediction(left) - prediction(before))


def dopri5(predict: DataPrediction, noise: Tensor, n_steps: int) -> Tensor:
    """Integrate from noise to data with adaptive steps (Dormand-Prince 5(4) of torchdiffeq; Table 12).

    `n_steps` sets the tolerance instead of a number: 0.002 / n_steps for numbers of order one. Steps suit the whole
    batch, so a row must come alone where it may not depend on those beside it. The last thousandth of the flow time,
    where the velocity divides by zero, is one step onto the prediction.
    """
    from torchdiffeq import odeint

    def slope(tau: Tensor, o: Tensor) -> Tensor:
        times = tau.reshape(1).expand(len(o)).float()
        return velocity(o, predict(o, times), times.to(o.dtype))

    span = torch.tensor([0.0, ADAPTIVE_END], device=noise.device, dtype=noise.dtype)
    tolerance = 0.002 / n_steps
    end = odeint(slope, noise, span, rtol=tolerance, atol=tolerance, method="dopri5")[-1]
    return predict(end, span[1:].expand(len(end)).float())


SOLVERS: dict[str, Callable[[DataPrediction, Tensor, int], Tensor]] = {
    "gaussian": gaussian,
    "angular": angular,
    "multistep": multistep,
    "fitted": fitted,
    "euler": euler,
    "dopri5": dopri5,
}
# Solvers whose steps the numbers decide: a chunk's rows go through them one by one.
ADAPTIVE = ("dopri5",)
