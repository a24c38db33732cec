"""Windows of frames that stand one, two, ... up to a thousand spacings apart, for a model that takes the lag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from systems.errors import InputError

_PER_DECADE = 8


def strides_up_to(longest: int) -> tuple[int, ...]:
    """Return strides from 1 to `longest`, evenly spaced in their logarithm, about eight a decade."""
    n = max(2, round(_PER_DECADE * np.log10(longest)) + 1)
    return tuple(sorted({round(float(x)) for x in np.geomspace(1, longest, n)})) if longest > 1 else (1,)


@dataclass(frozen=True, eq=False)
class StrideSampler:
    """Draws windows of any of `strides`, each as likely; `starts[k]` (n_k,) are the first frames of those of stride
    k."""

    strides: tuple[int, ...]
    starts: tuple[Tensor, ...]

    @staticmethod
    def of(frames: TrainingFrames, length: int, strides: Sequence[int], *, validation: bool = False) -> StrideSampler:
        """Return the sampler of windows of `length` frames. Raises InputError where one of the longest does not fit
        into a training stretch; validation takes those that fit."""
        found: list[tuple[int, Tensor]] = []
        for stride in strides:
            span = (length - 1) * stride + 1
            try:
                found.append((stride, torch.from_numpy(frames.window_starts(span, validation=validation))))
            except InputError as error:
                if validation and found:
                    break
                raise InputError(
                    f"{frames.scene.name}: no window of {length} frames {stride * frames.lag_ps:g} ps apart fits; give "
                    "longer trajectories, a shorter `longest_lag_ps` or shorter chunks."
                ) from error
        return StrideSampler(tuple(s for s, _ in found), tuple(starts for _, starts in found))

    def draw(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return first frames `(n,)` and strides `(n,)`."""
        which = torch.randint(len(self.strides), (n,), generator=generator)
        place = torch.rand(n, generator=generator, dtype=torch.float64)
        sizes = torch.tensor([len(starts) for starts in self.starts])
        first = torch.empty(n, dtype=torch.int64)
        for k, starts in enumerate(self.starts):
            rows = which == k
            first[rows] = starts[(place[rows] * sizes[k]).long()]
        return first, torch.tensor(self.strides)[which]
