"""A loss and its gradients as one CUDA graph: thousands of small kernels are started at once, not one by one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn


class Recorded:
    """`loss_of(module, *inputs)` for inputs of fixed shapes, computed by a copy of the module that shares its tensors,
    so that nothing else that uses the module is part of the graph. All tensors are on the GPU and no number is read
    from them inside; the module's tensors may change in place. Modules of the kinds `compiled` go through torch's
    compiler first."""

    def __init__(
        self, module: nn.Module, loss_of: Callable[..., Tensor], inputs: Sequence[Tensor],
        compiled: tuple[type[nn.Module], ...] = (),
    ) -> None:  # fmt: skip
        self.inputs = [t.clone() for t in inputs]
        self.parameters = [p for p in module.parameters() if p.requires_grad]
        twin = copy.deepcopy(module)
        for own, others in ((twin.parameters(), module.parameters()), (twin.buffers(), module.buffers())):
            for tensor, other in zip(own, others, strict=True):
                tensor.data = other.data
        for part in twin.modules():
            if isinstance(part, compiled):
                part.compile(dynamic=False)
        learned = [p for p in twin.parameters() if p.requires_grad]

        def compute() -> tuple[Tensor, Sequence[Tensor | None]]:
            loss = loss_of(twin, *self.inputs)
            return loss.detach(), torch.autograd.grad(loss.sum(), learned, allow_unused=True)

        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(2):
                compute()
        torch.cuda.current_stream().wait_stream(aside)
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph):
            self.loss, self.gradients = compute()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Return the loss, or losses, the gradients of whose sum are the recorded ones."""
        for own, given in zip(self.inputs, inputs, strict=True):
            own.copy_(given)
        self.graph.replay()
        return _Replayed.apply(self.loss, self.gradients, *self.parameters)


class _Replayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, loss: Tensor, gradients: Sequence[Tensor | None], *parameters: Tensor) -> Tensor:
        ctx.gradients = gradients
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, of_loss: Tensor) -> Any:
        return None, None, *(None if g is None else of_loss.mean() * g for g in ctx.gradients)
