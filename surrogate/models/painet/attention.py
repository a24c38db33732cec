"""Energy-descent all-pair attention with type matrices, dense and factored; the energy that it descends.

With rho_ij(s) = a_ij s - b_ij s^2 and embeddings of unit length, rho'(|h_i - h_j|^2) = phi_ij + psi_ij h_i.h_j, where
phi = a - 4 b and psi = 4 b (papers/PAINET, "Particle-type Adaptive Mapping"). The attention's mean over all particles
with these weights is a descent step of `pair_energy`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.propagator import Molecule

# Types of atoms derived from their bonded surroundings, in rounds of message passing.


class Surroundings(nn.ModuleList):
    """Embeddings of elements -> embeddings of elements in their surroundings, as far as there are rounds."""

    def __init__(self, width: int, n_rounds: int = 3) -> None:
        super().__init__(
            nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width)) for _ in range(n_rounds)
        )

    def forward(self, of_element: Tensor, bonds: Tensor) -> Tensor:
        """`of_element` (n_atoms, width), `bonds` (2, n_bonds) both ways -> (n_atoms, width)."""
        z = of_element
        for round_ in self:
            z = z + round_(torch.cat([z, torch.zeros_like(z).index_add(0, bonds[0], z[bonds[1]])], dim=-1))
        return z


# Pairs of atoms by how many bonds lie between them, each pair once: what a decoder's pair forces run along.

# Shells: one, two and three bonds apart, and all that lie further.
N_SHELLS = 4
# Sums over pairs are products with a dense matrix up to this many numbers in it, scattered additions above.
DENSE_NUMBERS = 2_000_000


@dataclass(frozen=True, eq=False)
class Pairs:
    """`first`, `second`, `shell` (n_pairs,): the pairs of one molecule, `shell` 0 to 3 and ascending; of the first
    `n_near` at most three bonds lie between. `signed` (n_atoms, n_pairs) holds +1 for a pair's first atom and -1 for
    its second, `ends` (n_atoms, 2 n_near) a 1 where a near pair, seen from either end, belongs to an atom; both None of
    large molecules."""

    first: Tensor
    second: Tensor
    shell: Tensor
    n_near: int
    signed: Tensor | None
    ends: Tensor | None

    def differences(self, x: Tensor) -> Tensor:
        """`x` (n_atoms, rows, d) -> x of the first minus x of the second atom, (n_pairs, rows, d)."""
        if self.signed is None:
            return x[self.first] - x[self.second]
        return (self.signed.to(x.dtype).T @ x.flatten(1)).unflatten(1, x.shape[1:])

    def opposed_sums(self, values: Tensor, n_atoms: int) -> Tensor:
        """`values` (n_pairs, rows, d), added to a pair's first atom and taken from its second: (n_atoms, rows, d)."""
        if self.signed is None:
            out = values.new_zeros(n_atoms, *values.shape[1:])
            return out.index_add(0, self.first, values).index_add(0, self.second, -values)
        return (self.signed.to(values.dtype) @ values.flatten(1)).unflatten(1, values.shape[1:])

    def end_sums(self, of_first: Tensor, of_second: Tensor, n_atoms: int) -> Tensor:
        """Two of (n_near, rows, d), summed over the pairs of each atom by the end it is: (n_atoms, rows, d)."""
        if self.ends is None:
            out = of_first.new_zeros(n_atoms, *of_first.shape[1:])
            near = slice(self.n_near)
            return out.index_add(0, self.first[near], of_first).index_add(0, self.second[near], of_second)
        joined = torch.cat([of_first, of_second])
        return (self.ends.to(joined.dtype) @ joined.flatten(1)).unflatten(1, joined.shape[1:])


def molecular_pairs(molecule: Molecule, *, all_pairs: bool) -> Pairs:
    """Return the pairs at most three bonds apart and, with `all_pairs`, every other one as well."""
    n_atoms, device = molecule.n_atoms, molecule.elements.device
    neighbours: list[list[int]] = [[] for _ in range(n_atoms)]
    for i, j in molecule.bonds.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)
    shell_of: dict[tuple[int, int], int] = {}
    for start in range(n_atoms):
        seen, front = {start}, [start]
        for shell in range(N_SHELLS - 1):
            front = sorted({k for j in front for k in neighbours[j]} - seen)
            seen.update(front)
            shell_of |= {(start, k): shell for k in front if k > start}
    near = sorted(shell_of, key=lambda pair: (shell_of[pair], pair))
    pairs = torch.tensor(near, dtype=torch.int64).reshape(-1, 2)
    shells = torch.tensor([shell_of[pair] for pair in near], dtype=torch.int64)
    if all_pairs:
        far = torch.ones(n_atoms, n_atoms, dtype=torch.bool).triu(1)
        far[pairs[:, 0], pairs[:, 1]] = False
        others = torch.nonzero(far)
        pairs = torch.cat([pairs, others])
        shells = torch.cat([shells, torch.full((len(others),), N_SHELLS - 1)])
    n_near = len(near)
    signed = ends = None
    if n_atoms * len(pairs) <= DENSE_NUMBERS:
        number = torch.arange(len(pairs))
        signed = torch.zeros(n_atoms, len(pairs))
        signed[pairs[:, 0], number], signed[pairs[:, 1], number] = 1.0, -1.0
        ends = torch.zeros(n_atoms, 2 * n_near)
        ends[pairs[:n_near, 0], number[:n_near]] = 1.0
        ends[pairs[:n_near, 1], n_near + number[:n_near]] = 1.0
        signed, ends = signed.to(device), ends.to(device)
    return Pairs(pairs[:, 0].to(device), pairs[:, 1].to(device), shells.to(device), n_near, signed, ends)


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
