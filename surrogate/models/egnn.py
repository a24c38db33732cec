"""E(n)-equivariant graph network (Satorras 2021) in EGNO's form: PAINET's decoder and, alone, the baseline."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.graphs import N_KINDS, Graph


class EgnnLayer(nn.Module):
    """One round of messages: m_ij = MLP(h_i, h_j, kind_ij, d_ij^2), h_i += MLP(h_i, sum_j m_ij),
    x_i += phi_v(h_i) v_i + mean_j (x_i - x_j) phi_x(m_ij), and the same with own factors for the velocity u_i.

    v is the initial velocity, which stays. `reach` scales what is added to x and to u, so that the factors are of
    order one whatever the horizon; their last layers start small: a fresh layer hardly moves.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        # The message's first layer by parts: what depends on one atom is computed once per atom, not per edge.
        self.receive = nn.Linear(width, width)
        self.send = nn.Linear(width, width, bias=False)
        self.of_distance = nn.Linear(1, width, bias=False)
        self.of_kind = nn.Embedding(N_KINDS, width)
        self.message = nn.Linear(width, width)
        of_pair, of_own = nn.Linear(width, 2, bias=False), nn.Linear(width, 2)
        self.pair_factor = nn.Sequential(nn.Linear(width, width), nn.SiLU(), of_pair)
        self.own_factor = nn.Sequential(nn.Linear(width, width), nn.SiLU(), of_own)
        self.update = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width))
        for factor in (of_pair, of_own):
            nn.init.xavier_uniform_(factor.weight, gain=0.01)
        nn.init.zeros_(of_own.bias)

    def forward(
        self, h: Tensor, x: Tensor, u: Tensor, v: Tensor, graph: Graph, reach: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`h` (b, n, width), positions `x`, velocities `u` and `v` (b, n, 3), `reach` (2,) -> h, x, u."""
        difference = x[:, graph.receiver] - x[:, graph.sender]
        squared = difference.square().sum(-1, keepdim=True)
        pre = self.receive(h)[:, graph.receiver] + self.send(h)[:, graph.sender]
        pre = pre + self.of_distance(squared.to(pre.dtype)) + self.of_kind(graph.kind)
        message = F.silu(self.message(F.silu(pre)))
        own = self.own_factor(h).float()
        pair = self.pair_factor(message).float()
        moved = torch.cat([difference * pair[..., :1], difference * pair[..., 1:]], dim=-1)
        moved = gather_sum(moved, graph.receiver, x.shape[1]) / graph.degree[:, None]
        x_new = x + reach[0] * (own[..., :1] * v + moved[..., :3])
        u_new = u + reach[1] * (own[..., 1:] * v + moved[..., 3:])
        gathered = gather_sum(message, graph.receiver, x.shape[1])
        return h + self.update(torch.cat([h, gathered], dim=-1)), x_new, u_new


class Egnn(nn.Module):
    """A stack of layers; all of it is equivariant to rotations, reflections, translations and atom order."""

    def __init__(self, width: int, n_layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EgnnLayer(width) for _ in range(n_layers))

    def forward(self, h: Tensor, x: Tensor, v: Tensor, graph: Graph, reach: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings `(b, n, width)`, positions and velocities `(b, n, 3)` -> positions, velocities `(b, n, 3)`."""
        u = v
        for layer in self.layers:
            h, x, u = layer(h, x, u, v, graph, reach)
        return x, u


def gather_sum(values: Tensor, receiver: Tensor, n_atoms: int) -> Tensor:
    """Sum edge values `(b, n_edges, d)` over the edges that end in each atom: `(b, n_atoms, d)`."""
    out = values.new_zeros(values.shape[0], n_atoms, values.shape[-1])
    return out.index_add(1, receiver, values)
