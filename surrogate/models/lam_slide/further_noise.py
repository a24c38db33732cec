"""More random numbers than a chunk's noise holds, from numbers in it that nothing else uses.

The conditioning frames' place in the noise (b, T, L, dim) is taken by their clean latents, so numbers of its first
frame are free: pairs of them seed generators, a row's from its own, so that no row depends on those beside it.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Where the pair of numbers stands that seeds each use.
REDRAWS, STATES = 1, 5


def generators(noise: Tensor, place: int, attempt: int = 0) -> list[torch.Generator]:
    """Return one generator a row of `noise`, seeded by its two numbers from `place` on and by `attempt`."""
    found = []
    for row in noise:
        low, high = row[0].flatten()[place : place + 2].float().cpu().view(torch.int32).tolist()
        seed = ((low & 0xFFFFFFFF) << 31) ^ ((high & 0xFFFFFFFF) << 8) ^ attempt
        found.append(torch.Generator().manual_seed(seed))
    return found
