"""Early warnings: a training that is about to diverge says so before its loss is no number any more."""

from __future__ import annotations

import math
import statistics
from collections import deque

from torch import Tensor, nn

# A gradient this many times the usual one, so often in a row, is a warning.
FACTOR, IN_A_ROW = 10.0, 3
_USUAL = 200


class Watch:
    """Compares each step's gradient norm (before clipping) with the median of the last 200 ordinary ones."""

    def __init__(self) -> None:
        self._norms: deque[float] = deque(maxlen=_USUAL)
        self._high = 0
        self.n_warnings = 0

    def see(self, step: int, norm: float) -> str | None:
        """Return a warning, one for each time that the norm stays high, or None."""
        usual = statistics.median(self._norms) if len(self._norms) >= 20 else math.inf
        if norm <= FACTOR * usual:
            self._norms.append(norm)
            self._high = 0
            return None
        self._high += 1
        if self._high != IN_A_ROW:
            return None
        self.n_warnings += 1
        return (
            f"at step {step} the gradient is {norm / usual:.0f} times its median for {IN_A_ROW} steps in a row; if "
            "this goes on the training will diverge: lower the learning rate."
        )


def first_not_finite(module: nn.Module) -> str:
    """Name the first parameter whose gradient, or else value, holds something that is no number; '' if none does."""

    def broken(tensor: Tensor | None) -> bool:
        return tensor is not None and not bool(tensor.isfinite().all())

    named = list(module.named_parameters())
    for found in ([n for n, p in named if broken(p)], [n for n, p in named if broken(p.grad)]):
        if found:
            return found[0]
    return ""
