"""A decoder whose layers are steps of a leapfrog integrator: EGNN's update of velocities, with Newton's third law.

EGNN's layer in its form with velocities (Satorras 2021, eq. 7) is a kick by forces along pairs of atoms and a drift.
Here the kick acts on both atoms of a pair alike and is divided by their masses, and the drift lasts a layer's share of
the time to the frame that is decoded, half of it before the first kick and half after the last. Whatever is learned,
momentum and angular momentum are kept, and before anything is learned atoms fly on at their velocities.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.painet.pairs import Pairs
from surrogate.models.painet.surroundings import Surroundings

# Distances (in the model's unit, 0.1 nm) over which a shell's radial functions are laid, evenly in the logarithm.
SHELL_RANGES = ((0.8, 2.3), (1.3, 3.5), (1.8, 5.0), (1.5, 12.0))
# Half the width of a radial function in units of their spacing.
HALF_WIDTH = 2.5
# Scale of a pair's own force: of order one for bonds where the network's numbers are.
TABLE_SCALE = 5.0
_CLOSEST_SQUARED = 1e-6


class RadialFunctions(torch.autograd.Function):
    """Bumps (1 - (u - k)^2 / HALF_WIDTH^2)^3 for k = 0, 1, ..., zero outside, where u = (log d - start) / spacing.

    Without exponentials, whose tails would be denormal numbers; the derivative is kept, not the way to it.
    """

    @staticmethod
    def forward(ctx: Any, d: Tensor, start: Tensor, spacing: Tensor, n: int) -> Tensor:
        u = ((d.log() - start[:, None]) / spacing[:, None])[..., None] - torch.arange(n, dtype=d.dtype, device=d.device)
        bump = torch.relu(1.0 - u.square() / HALF_WIDTH**2)
        squared = bump.square()
        ctx.save_for_backward(u * squared * (-6.0 / HALF_WIDTH**2) / (d * spacing[:, None])[..., None])
        return squared * bump

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (slope,) = ctx.saved_tensors
        return (grads[0] * slope).sum(-1), None, None, None


@dataclass(frozen=True, eq=False)
class PairFeatures:
    """What does not depend on positions: `first`, `second` (n_pairs, width), a pair seen from either end; `pair`
    (n_pairs, n_new, width) for each frame; where the radial functions of each pair start and how wide they stand."""

    first: Tensor
    second: Tensor
    pair: Tensor
    start: Tensor
    spacing: Tensor


class PairEncoder(nn.Module):
    """Features of pairs from types of atoms, told from their surroundings by rounds along bonds."""

    def __init__(self, width: int, n_radial: int) -> None:
        super().__init__()
        self.rounds = Surroundings(width)
        self.of_shell = nn.Embedding(len(SHELL_RANGES), width)
        self.of_pair = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width))
        ranges = torch.tensor(SHELL_RANGES).log()
        self.register_buffer("start", ranges[:, 0], persistent=False)
        self.register_buffer("spacing", (ranges[:, 1] - ranges[:, 0]) / (n_radial - 1), persistent=False)
        self.start: Tensor
        self.spacing: Tensor

    def forward(self, z: Tensor, of_frame: Tensor, pairs: Pairs) -> PairFeatures:
        """`z` (n_atoms, width), `of_frame` (n_new, width)."""
        shell = self.of_shell(pairs.shell)
        first, second = z[pairs.first], z[pairs.second]
        first, second = (self.of_pair(torch.cat([a + shell, b], dim=-1)) for a, b in ((first, second), (second, first)))
        both = F.silu((first + second)[:, None] + of_frame)
        return PairFeatures(F.silu(first), F.silu(second), both, self.start[pairs.shell], self.spacing[pairs.shell])


class LeapfrogLayer(nn.Module):
    """Forces along pairs, f_ij = table_ij(d_ij) + c_ij.q_i + c_ji.q_j, from positions alone.

    What an atom feels of others, q_i, comes from sums over its near neighbours, m_ij = w_ij(d_ij) (1 + P h_j), and from
    products of sums of directions, V_i = sum_j w'_ij(d_ij) (x_i - x_j) / d_ij, which hold the angles at i. Weights of
    the radial functions belong to the pair: c, w, w' and the table are linear in its features.
    """

    def __init__(self, width: int, n_radial: int, n_scalars: int, n_vectors: int) -> None:
        super().__init__()
        self.n_radial, self.n_scalars, self.n_vectors = n_radial, n_scalars, n_vectors
        self.of_neighbour = nn.Linear(width, n_radial * (n_scalars + n_vectors))
        self.send = nn.Linear(width, n_scalars)
        self.update = nn.Sequential(
            nn.Linear(width + n_scalars + n_vectors**2, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )
        self.to_force, self.to_embedding = nn.Linear(width, 2 * n_scalars), nn.Linear(width, width)
        self.of_end = nn.Linear(width, 2 * n_scalars)
        self.table = nn.Linear(width, n_radial)
        nn.init.zeros_(self.table.weight)
        nn.init.zeros_(self.table.bias)
        nn.init.zeros_(self.to_force.weight)
        nn.init.zeros_(self.to_force.bias)

    def forward(self, h: Tensor, x: Tensor, pairs: Pairs, of: PairFeatures) -> tuple[Tensor, Tensor]:
        """`h` (n, rows, width) and positions (n, rows, 3), rows frame by frame -> h, forces (n, rows, 3)."""
        (n, rows, _), near = x.shape, slice(pairs.n_near)
        n_frames = of.pair.shape[1]
        apart = pairs.differences(x)
        distance = (apart.square().sum(-1) + _CLOSEST_SQUARED).sqrt()
        radial = RadialFunctions.apply(distance, of.start, of.spacing, self.n_radial)
        n_scalars, n_weights = self.n_scalars, self.n_scalars + self.n_vectors
        ends = [self.of_neighbour(f[near]).unflatten(-1, (self.n_radial, n_weights)) for f in (of.first, of.second)]
        weights = torch.bmm(radial[near], torch.cat(ends, dim=-1))
        of_first, of_second = weights[..., :n_weights], weights[..., n_weights:]
        sent = 1.0 + self.send(h)
        felt = pairs.end_sums(
            of_first[..., :n_scalars] * sent[pairs.second[near]],
            of_second[..., :n_scalars] * sent[pairs.first[near]],
            n,
        )
        direction = (apart[near] / distance[near, :, None])[..., None]
        vectors = pairs.end_sums(
            (direction * of_first[..., None, n_scalars:]).flatten(-2),
            (-direction * of_second[..., None, n_scalars:]).flatten(-2),
            n,
        ).unflatten(-1, (3, -1))
        angles = (vectors.transpose(-1, -2) @ vectors).flatten(-2)
        found = self.update(torch.cat([h, felt, angles], dim=-1))
        q = self.to_force(found)
        table = TABLE_SCALE * self.table(of.pair)
        framed = radial.unflatten(1, (n_frames, rows // n_frames)).flatten(0, 1)
        force = torch.bmm(framed, table.flatten(0, 1)[..., None]).view(len(radial), rows)
        from_first, from_second = (self.of_end(f[near])[..., None] for f in (of.first, of.second))
        coupled = torch.bmm(q[pairs.first[near]], from_first) + torch.bmm(q[pairs.second[near]], from_second)
        force = torch.cat([force[near] + coupled[..., 0], force[pairs.n_near :]])
        return h + self.to_embedding(found), pairs.opposed_sums(force[..., None] * apart, n)


class Leapfrog(nn.Module):
    """A stack of layers, each a kick; equivariant to rotations, reflections, translations and atom order."""

    def __init__(self, width: int, n_layers: int, n_radial: int, n_scalars: int, n_vectors: int) -> None:
        super().__init__()
        self.encode = PairEncoder(width, n_radial)
        self.layers = nn.ModuleList(LeapfrogLayer(width, n_radial, n_scalars, n_vectors) for _ in range(n_layers))

    def forward(
        self, h: Tensor, x: Tensor, v: Tensor, times: Tensor, kick: Tensor, pairs: Pairs, of: PairFeatures
    ) -> tuple[Tensor, Tensor]:
        """`h` (n, rows, width), `x`, `v` (n, rows, 3), rows frame by frame; `times` (rows, 1) to each row's frame in
        units in which x changes by v times that, `kick` (n, rows, 1) what a force changes v by in a layer -> x, v."""
        drift = times / len(self.layers)
        x = x + 0.5 * drift * v
        for number, layer in enumerate(self.layers):
            h, force = layer(h, x, pairs, of)
            v = v + kick * force
            x = x + (drift if number + 1 < len(self.layers) else 0.5 * drift) * v
        return x, v
