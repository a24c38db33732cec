"""Muon: momentum of matrices, made orthogonal before it is a step (Jordan et al., kellerjordan.github.io/posts/muon).

Potentials learn more by it in the same time (docs/studies/quantum/optimisers.py). torch has one of its own from 2.9 on,
matrix by matrix; this one takes matrices of one shape together, since those of a small network cost little but calls.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

MOMENTUM = 0.95
# Of the quintic iteration that brings singular values near one.
_A, _B, _C = 3.4445, -4.7750, 2.0315
_ITERATIONS = 5


def orthogonalised(matrices: Tensor) -> Tensor:
    """Matrices `(k, n, m)` -> of each about U V^T of its singular value decomposition U S V^T: singular values come out
    near one, the smallest of them below."""
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-12)
    tall = x.shape[1] > x.shape[2]
    if tall:
        x = x.mT
    for _ in range(_ITERATIONS):
        a = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(a, a, a, beta=_B, alpha=_C), x, beta=_A)
    return x.mT if tall else x


class Muon(torch.optim.Optimizer):
    """Steps of `lr` times the orthogonalised momentum of each matrix, times the root of rows over columns where there
    are more rows; `weight_decay` as AdamW's."""

    def __init__(self, params: Iterable[nn.Parameter], lr: float, weight_decay: float = 0.0) -> None:
        super().__init__(params, {"lr": lr, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """Take a step; there is no closure."""
        assert closure is None
        for group in self.param_groups:
            alike: dict[Any, list[nn.Parameter]] = defaultdict(list)
            for p in group["params"]:
                if p.grad is not None:
                    alike[p.shape].append(p)
            for shape, matrices in alike.items():
                grads = [p.grad for p in matrices if p.grad is not None]
                momenta = [self._momentum(p) for p in matrices]
                torch._foreach_lerp_(momenta, grads, 1.0 - MOMENTUM)
                way = orthogonalised(torch.stack(torch._foreach_lerp(grads, momenta, MOMENTUM)))
                weights: list[Tensor] = list(matrices)
                torch._foreach_mul_(weights, 1.0 - group["lr"] * group["weight_decay"])
                longer = max(1.0, shape[0] / shape[1]) ** 0.5
                torch._foreach_add_(weights, list(way.unbind()), alpha=-group["lr"] * longer)

    def _momentum(self, p: nn.Parameter) -> Tensor:
        state = self.state[p]
        if not state:
            state["momentum"] = torch.zeros_like(p)
        momentum: Tensor = state["momentum"]
        return momentum
