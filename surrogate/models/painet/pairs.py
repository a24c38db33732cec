"""Pairs of atoms by how many bonds lie between them, each pair once: what a decoder's pair forces run along."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogate.models.interface import Molecule

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
