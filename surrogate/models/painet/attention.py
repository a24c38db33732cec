"""Energy-descent all-pair attention with type matrices, dense and factored; the energy that it descends.

With rho_ij(s) = a_ij s - b_ij s^2 and embeddings of unit length, rho'(|h_i - h_j|^2) = phi_ij + psi_ij h_i.h_j, where
phi = a - 4 b and psi = 4 b (papers/PAINET, "Particle-type Adaptive Mapping"). The attention's mean over all particles
with these weights is a descent step of `pair_energy`.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Index lists of each type's atoms: what the factored form sums over.
TypeGroups = list[Tensor]


def dense_mean(q: Tensor, k: Tensor, v: Tensor, phi: Tensor, psi: Tensor) -> Tensor:
    """Return sum_j w_ij v_j / sum_j w_ij with w_ij = phi_ij + psi_ij q_i.k_j.

    `q`, `k` (..., n, d), `v` (..., n, d_v); `phi`, `psi` (..., n, n) by pair of particles.
    """
    weights = phi + psi * (q @ k.transpose(-1, -2))
    return (weights @ v) / weights.sum(-1, keepdim=True)


def linear_mean(q: Tensor, k: Tensor, v: Tensor, phi: Tensor, psi: Tensor, groups: TypeGroups) -> Tensor:
    """The same mean in time linear in n: weights depend on a pair through its types and one product of vectors, so
    out_i = (sum_b phi_ab s_b + q_i sum_b psi_ab S_b) / (the same with ones), s_b = sum of v, S_b = sum of k v^T over b.

    `phi`, `psi` (..., n_types, n_types) by type; `groups[b]` the atoms of type b, every atom in one of them.
    """
    v = torch.cat([v, torch.ones_like(v[..., :1])], dim=-1)
    sums = torch.stack([v[..., group, :].sum(-2) for group in groups], dim=-2)
    products = torch.stack([k[..., group, :].transpose(-1, -2) @ v[..., group, :] for group in groups], dim=-3)
    plain = phi @ sums
    turned = torch.einsum("...ab,...bde->...ade", psi, products)
    out = v.new_empty(v.shape)
    for a, group in enumerate(groups):
        out[..., group, :] = plain[..., a, None, :] + q[..., group, :] @ turned[..., a, :, :]
    return out[..., :-1] / out[..., -1:]


class AttentionSettings(Protocol):
    """What a model's configuration says of its attention. `step`: eta of the descent; `psi_limit`: largest Psi / Phi;
    `attention`: 'dense', or in the factored form."""

    @property
    def width(self) -> int: ...
    @property
    def n_heads(self) -> int: ...
    @property
    def head_dim(self) -> int: ...
    @property
    def step(self) -> float: ...
    @property
    def psi_limit(self) -> float: ...
    @property
    def attention(self) -> str: ...


class EnergyAttention(nn.Module):
    """One latent step: h <- (1 - eta) h + eta W concat_heads(mean of values), with learned Q, K, V.

    Queries and keys have unit length. Phi = sigmoid(E_phi) and Psi = psi_limit * Phi * sigmoid(E_psi), symmetric, by
    type and head: Phi >= Psi keeps every weight positive. (A common factor of Phi and Psi, s_1 in the paper, cancels.)
    """

    def __init__(self, config: AttentionSettings, n_types: int) -> None:
        super().__init__()
        self.n_heads, self.step, self.psi_limit = config.n_heads, config.step, config.psi_limit
        self.dense = config.attention == "dense"
        self.qkv = nn.Linear(config.width, 3 * config.n_heads * config.head_dim)
        self.out = nn.Linear(config.n_heads * config.head_dim, config.width)
        self.e_phi = nn.Parameter(torch.zeros(config.n_heads, n_types, n_types))
        self.e_psi = nn.Parameter(torch.zeros(config.n_heads, n_types, n_types))

    def type_matrices(self) -> tuple[Tensor, Tensor]:
        """Return Phi and Psi `(n_heads, n_types, n_types)`."""
        phi, psi = (torch.sigmoid(0.5 * _wide(e + e.transpose(-1, -2))) for e in (self.e_phi, self.e_psi))
        return phi, self.psi_limit * phi * psi

    def forward(self, h: Tensor, types: Tensor, groups: TypeGroups) -> Tensor:
        """Embeddings `(b, n, width)`, types `(n,)` among those present, their atoms `groups` -> embeddings."""
        return self.carry(h, h[..., :0], types, groups, dense=self.dense)[0]

    def carry(
        self, h: Tensor, carried: Tensor, types: Tensor, groups: TypeGroups, *, dense: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same with more values that the attention averages: `carried` (b, n, c) -> embeddings, the means
        `(b, n_heads, n, c)` of what is carried, and the queries `(b, n_heads, n, head_dim)`, of unit length."""
        q, k, v = _wide(self.qkv(h)).unflatten(-1, (3, self.n_heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = F.normalize(q, dim=-1), F.normalize(k, dim=-1)
        n_own = v.shape[-1]
        v = torch.cat([v, carried[:, None].expand(-1, self.n_heads, -1, -1)], dim=-1)
        phi, psi = self.type_matrices()
        # Sums over all atoms stay in float32: in bf16 the two forms would differ by more than rounding.
        with torch.autocast(h.device.type, enabled=False):
            if dense:
                mean = dense_mean(q, k, v, phi[:, types][:, :, types], psi[:, types][:, :, types])
            else:
                present = torch.stack([types[group[0]] for group in groups])
                phi, psi = (m[:, present][:, :, present] for m in (phi, psi))
                mean = linear_mean(q, k, v, phi, psi, groups)
        own, means = mean.split((n_own, carried.shape[-1]), dim=-1)
        return (1.0 - self.step) * h + self.step * self.out(own.transpose(1, 2).flatten(-2)), means, q


def _wide(s: Tensor) -> Tensor:
    """`s` in float32, or as it is where that is float64."""
    return s.to(torch.promote_types(s.dtype, torch.float32))
