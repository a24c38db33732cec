"""A scalar energy and its exact gradient, as torch computes them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Frames (rows, n_atoms, 3) nm -> the members' energies (rows, n_members)
EnergyFn = Callable[[Tensor], Tensor]
# The same -> these energies, and the gradient (rows, n_atoms, 3) of their mean
GradientFn = Callable[[Tensor], tuple[Tensor, Tensor]]


def gradient_of(energy: EnergyFn) -> GradientFn:
    """Return the function that computes energies and the gradient of the members' mean, detached."""

    def compute(positions_nm: Tensor) -> tuple[Tensor, Tensor]:
        # In bf16 energies would be steps, and their gradient heat.
        with torch.inference_mode(False), torch.enable_grad(), torch.autocast(positions_nm.device.type, enabled=False):
            x = positions_nm.detach().clone().requires_grad_(True)
            members = energy(x)
            (gradient,) = torch.autograd.grad(members.mean(-1).sum(), x)
        return members.detach(), gradient.detach()

    return compute
