"""A scalar energy and its exact gradient: as torch computes them, or as one graph that torch compiles."""

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


class CompiledGradient:
    """The same compiled for arrays as the first that it is given; others go the plain way.

    Energy and gradient are traced as one graph: compiled apart, what the gradient needs of the energy would be written
    to memory and read back. The sums are the same but for their order.
    """

    def __init__(self, energy: EnergyFn) -> None:
        self._plain = gradient_of(energy)
        self._kind: tuple[torch.Size, torch.dtype] | None = None
        self._fast: GradientFn = self._plain

    def __call__(self, positions_nm: Tensor) -> tuple[Tensor, Tensor]:
        kind = positions_nm.shape, positions_nm.dtype
        if self._kind is None:
            from torch.fx.experimental.proxy_tensor import make_fx

            self._kind = kind
            self._fast = torch.compile(make_fx(self._plain)(positions_nm), dynamic=False)
        if kind != self._kind:
            return self._plain(positions_nm)
        with torch.inference_mode(False), torch.no_grad():
            members, gradient = self._fast(positions_nm)
        return members, gradient
