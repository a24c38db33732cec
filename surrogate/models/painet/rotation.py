"""The rotation of a molecule as a whole, taken out before anything is learned and put back: that of a free rigid body.

Like the centre of mass, which moves on at its velocity: within a chunk the molecule turns on at its angular velocity,
and only the motion in the turning frame is learned.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Added to the moments of inertia, as a share of their sum: a line of atoms has none about itself.
_LEAST_INERTIA = 1e-5


def angular_velocity(x: Tensor, v: Tensor, masses_da: Tensor) -> Tensor:
    """Return omega `(b, 3)` of centred positions and velocities `(b, n, 3)`: that of a rigid body of their angular
    momentum."""
    m = (masses_da / masses_da.sum())[:, None]
    moments = torch.einsum("bni,bnj->bij", m * x, x)
    trace = moments.diagonal(dim1=-1, dim2=-2).sum(-1)[:, None, None]
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    inertia = ((1.0 + _LEAST_INERTIA) * trace + 1e-9) * eye - moments
    solved: Tensor = torch.linalg.solve(inertia, (m * torch.linalg.cross(x, v)).sum(-2))
    return solved


def spun(omega: Tensor, x: Tensor) -> Tensor:
    """Return omega x x for omega `(b, 3)` and x `(b, ..., 3)`."""
    return torch.linalg.cross(omega.view(-1, *[1] * (x.dim() - 2), 3).expand_as(x), x)


def turns(omega: Tensor, times: Tensor) -> Tensor:
    """Return exp([omega] t) transposed, `(b, len(times), 3, 3)`: x @ it is x after turning on for each time."""
    zero = torch.zeros_like(omega[:, 0])
    a, b, c = omega.unbind(-1)
    generator = torch.stack([zero, c, -b, -c, zero, a, b, -a, zero], dim=-1).view(-1, 1, 3, 3)
    turned: Tensor = torch.matrix_exp(generator * times[:, None, None])
    return turned
