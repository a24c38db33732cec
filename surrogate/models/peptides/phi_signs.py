"""On which side of its barrier each residue's phi is, drawn before the flow draws the frames that go with it.

Phi > 0 is entered a few times in a microsecond. A flow that draws barrier crossings along with everything else leaks
between the two sides, since between two modes of noise there is always some density. A small network of its own learns
by log-likelihood how likely each residue is to cross from one frame to the next (a Bernoulli draw cannot leak), the
flow is told the outcome, and frames that disobey are drawn again.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Beyond the second barrier phi > 0 is the far end of the strands' basin, which reaches across 180 degrees.
POSITIVE_PHI_DEG = (0.0, 130.0)
# Glycine's phi has no higher barrier, proline's ring holds it.
UNSIGNED = ("GLY", "PRO")
_WIDTH = 64
_WAVES = 8
# Before training, one residue in so many frames crosses (in logits).
_RARELY = -5.0


def is_positive(phi: Tensor) -> Tensor:
    """Return whether angles `(...)`, rad in (-π, π], lie on the left-handed side."""
    low, high = np.radians(POSITIVE_PHI_DEG)
    return (phi > low) & (phi < high)


class PhiCrossings(nn.Module):
    """The odds that residues cross the barrier of phi between a frame and the next.

    They follow from the given frame (of the residue and its two neighbours), the residue's type, the side that it is
    on, how long after the given frame it is and how far apart the two frames are.
    """

    waves: Tensor

    def __init__(self, n_slots: int, n_types: int) -> None:
        super().__init__()
        self.of_residue = nn.ModuleList(nn.Linear(n_slots, _WIDTH, bias=False) for _ in range(3))
        self.of_type = nn.ModuleList(nn.Embedding(n_types, _WIDTH) for _ in range(3))
        self.register_buffer("waves", math.pi * torch.linspace(0.25, 2.0, _WAVES), persistent=False)
        self.of_times = nn.Linear(4 * _WAVES + 2, _WIDTH)
        self.hidden = nn.Linear(_WIDTH, _WIDTH)
        self.logits = nn.Linear(_WIDTH, 2)
        # Of each type, from either side and with the logarithm of the time between the two frames.
        self.of_side = nn.Embedding(n_types, 4)
        nn.init.zeros_(self.logits.weight)
        nn.init.constant_(self.logits.bias, _RARELY)
        nn.init.zeros_(self.of_side.weight)

    def forward(self, known: Tensor, places: Tensor, times_ps: Tensor, apart_ps: Tensor) -> Tensor:
        """`known` (b, r, slots), `places` (r, 3), `times_ps` and `apart_ps` (b, t) of each frame after the given one
        and after the one before it -> logits `(b, t, r, 2)` of crossing from phi < 0 and from phi > 0."""
        with torch.autocast(known.device.type, enabled=False):
            known = known.float()
            none = torch.zeros_like(known[:, :1])
            beside = (known, torch.cat([none, known[:, :-1]], 1), torch.cat([known[:, 1:], none], 1))
            h = sum((of(x) for of, x in zip(self.of_residue, beside, strict=True)), torch.zeros(()))
            h = h + sum((of(places[:, k]) for k, of in enumerate(self.of_type)), torch.zeros(()))
            of_times, logs = self._of_times(times_ps, apart_ps)
            h = F.silu(h[:, None] + of_times[:, :, None])
            logits = self.logits(F.silu(self.hidden(h)))
            level, slope = self.of_side(places[:, 0]).chunk(2, dim=-1)
            found: Tensor = logits + level + slope * logs[:, :, None, None]
            return found

    def _of_times(self, times_ps: Tensor, apart_ps: Tensor) -> tuple[Tensor, Tensor]:
        logs = torch.stack([times_ps, apart_ps], dim=-1).float().clamp(min=1e-3).log10()
        angles = logs[..., None] * self.waves
        waves = torch.cat([angles.sin(), angles.cos()], dim=-1).flatten(-2)
        return self.of_times(torch.cat([waves, logs], dim=-1)), logs[..., 1]


def sides_of(positive: Tensor, signed: Tensor) -> Tensor:
    """Return 1 and -1 for the sides `positive` (b, t, r) of the residues `signed` (n,), and 0 for others."""
    sides = torch.zeros_like(positive, dtype=torch.float32)
    sides[..., signed] = 2.0 * positive[..., signed].float() - 1.0
    return sides


def times_apart(times_ps: Tensor, forgotten_ps: float) -> Tensor:
    """Return the time `(b, t)` between each frame and the one before it; frames of endless times know none before."""
    before = torch.cat([torch.zeros_like(times_ps[:, :1]), times_ps[:, :-1]], dim=1)
    return torch.where(times_ps >= forgotten_ps, times_ps, times_ps - before)


def crossing_loss(logits: Tensor, positive: Tensor, counted: Tensor) -> Tensor:
    """Return the mean negative log-likelihood per frame and residue of what residues did.

    `logits` (b, t, r, 2); `positive` (b, 1 + t, r), the given frame first; `counted` (b, r), those that count.
    """
    before, after = positive[:, :-1], positive[:, 1:]
    of_side = torch.where(before, logits[..., 1], logits[..., 0])
    each = F.binary_cross_entropy_with_logits(of_side, (before != after).float(), reduction="none")
    counts = counted[:, None].expand_as(each)
    return (each * counts).sum() / counts.sum().clamp(min=1)


def draw_sides(logits: Tensor, positive: Tensor, uniform: Tensor) -> Tensor:
    """Return on which side each residue is: `(b, t, r)` from `logits` (b, t, r, 2), the given frame's side `positive`
    (b, r) and numbers `uniform` (b, t, r) in [0, 1)."""
    crosses = uniform[..., None] < logits.sigmoid()
    found = []
    for k in range(logits.shape[1]):
        positive = positive ^ torch.where(positive, crosses[:, k, :, 1], crosses[:, k, :, 0])
        found.append(positive)
    return torch.stack(found, dim=1)
