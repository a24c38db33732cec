"""Ordered pairs of atoms within reach of each other, and the smooth functions of their distance that a potential sees.

Pairs up to three bonds apart count always, others inside a cutoff, at which all they add has come down to zero with its
first two derivatives. So the number of pairs grows with the atoms and not with their square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surrogate.models.interface import Molecule
from surrogate.models.painet.pairs import N_SHELLS, molecular_pairs

# Distances in nm over which a shell's radial functions are laid, evenly in the logarithm; the last shell ends at the
# cutoff.
SHELL_RANGES_NM = ((0.07, 0.23), (0.12, 0.35), (0.16, 0.5))
LAST_SHELL_FROM_NM = 0.12
# Half the width of a radial function in units of their spacing.
HALF_WIDTH = 2.5
# Up to so many atoms all pairs are listed once and for all: those beyond the cutoff add exactly nothing.
FEW_ATOMS = 64
_SOFTENING_NM2 = 1e-8
_FAR_NM2 = 1e6
_ROOT_TWO = 2.0**0.5


@dataclass(frozen=True, eq=False)
class Edges:
    """`receiver`, `sender`, `shell` (n_edges,): each pair from either end, sorted by the receiver. `dense`: every atom
    is paired with every one in turn, itself included, so that sums and differences need no lists."""

    receiver: Tensor
    sender: Tensor
    shell: Tensor
    n_atoms: int
    dense: bool

    def sent(self, values: Tensor) -> Tensor:
        """`values` of atoms (n_atoms, ...) -> of each edge's sender (n_edges, ...)."""
        return self._square(values[None]) if self.dense else values[self.sender]

    def apart_nm(self, positions_nm: Tensor) -> Tensor:
        """Positions `(n_atoms, rows, 3)` nm -> the way from sender to receiver `(n_edges, rows, 3)`."""
        if self.dense:
            return (positions_nm[:, None] - positions_nm[None]).flatten(0, 1)
        return positions_nm[self.receiver] - positions_nm[self.sender]

    def sum(self, values: Tensor) -> Tensor:
        """`values` (n_edges, ...) summed by receiver: (n_atoms, ...)."""
        if self.dense:
            return values.unflatten(0, (self.n_atoms, self.n_atoms)).sum(1)
        return values.new_zeros(self.n_atoms, *values.shape[1:]).index_add(0, self.receiver, values)

    def by_atom(self, shapes: Tensor) -> Tensor:
        """`shapes` (n_edges, rows, k), laid out as `sum_of_products` takes them."""
        if not self.dense:
            return shapes
        return shapes.unflatten(0, (self.n_atoms, self.n_atoms)).permute(0, 2, 3, 1).contiguous()

    def sum_of_products(self, laid: Tensor, values: Tensor) -> Tensor:
        """Shapes laid `by_atom` times `values` (n_edges, rows, c), summed by receiver: (n_atoms, rows, k, c)."""
        if not self.dense:
            return self.sum(laid[..., None] * values[..., None, :])
        return laid @ values.unflatten(0, (self.n_atoms, self.n_atoms)).transpose(1, 2)

    def _square(self, values: Tensor) -> Tensor:
        return values.expand(self.n_atoms, self.n_atoms, *values.shape[2:]).flatten(0, 1)


@dataclass(frozen=True, eq=False)
class EdgeGeometry:
    """`distance_nm` (n_edges, rows) and `radial` (n_edges, rows, n_radial); `shapes`: the direction from sender to
    receiver and its products (`products`), laid out by `Edges.by_atom`."""

    distance_nm: Tensor
    radial: Tensor
    shapes: Tensor


def bonded_shells(molecule: Molecule) -> dict[tuple[int, int], int]:
    """Return how many bonds less one lie between atoms (i, j), i < j, up to three."""
    pairs = molecular_pairs(molecule, all_pairs=False)
    ends = zip(pairs.first.tolist(), pairs.second.tolist(), pairs.shell.tolist(), strict=True)
    return {(min(i, j), max(i, j)): shell for i, j, shell in ends}


def find_edges(
    shells: dict[tuple[int, int], int], positions_nm: Tensor, cutoff_nm: float, *, few: int = FEW_ATOMS
) -> Edges:
    """Return the edges of frames `(rows, n_atoms, 3)` nm of a molecule: those that any of the frames needs."""
    n_atoms = positions_nm.shape[1]
    if n_atoms <= few:
        pairs = {(i, j): N_SHELLS - 1 for i in range(n_atoms) for j in range(i + 1, n_atoms)}
    else:
        from scipy.spatial import cKDTree

        pairs = {}
        for frame in positions_nm.detach().cpu().double().numpy():
            near: np.ndarray = cKDTree(frame).query_pairs(cutoff_nm, output_type="ndarray")
            pairs |= {(int(i), int(j)): N_SHELLS - 1 for i, j in near}
    pairs |= shells
    dense = n_atoms <= few
    own = [(i, i, N_SHELLS - 1) for i in range(n_atoms)] if dense else []
    both = sorted([(i, j, s) for (i, j), s in pairs.items()] + [(j, i, s) for (i, j), s in pairs.items()] + own)
    receiver, sender, shell = torch.tensor(both, dtype=torch.int64, device=positions_nm.device).reshape(-1, 3).T
    return Edges(receiver, sender, shell, n_atoms, dense)


def measure_edges(
    positions_nm: Tensor, edges: Edges, n_radial: int, cutoff_nm: float, dtype: torch.dtype
) -> EdgeGeometry:
    """Return distances, directions and radial functions of frames `(n_atoms, rows, 3)` nm, in `dtype`.

    Radial functions are bumps (1 - (u - k)^2 / HALF_WIDTH^2)^3, zero outside, with u = log d in units of their spacing;
    without exponentials, whose tails would be denormal numbers. Distances are softened by 0.1 pm: finite at zero.
    """
    apart = edges.apart_nm(positions_nm).to(dtype)
    # An atom is to itself as one far beyond the cutoff.
    alone = torch.where(edges.receiver == edges.sender, _FAR_NM2, _SOFTENING_NM2).to(dtype)
    distance = (apart.square().sum(-1) + alone[:, None]).sqrt()
    begin, spacing = radial_grid(n_radial, cutoff_nm, apart)
    u = ((distance.log() - begin[edges.shell, None]) / spacing[edges.shell, None])[..., None]
    u = (u - torch.arange(n_radial, dtype=dtype, device=apart.device)) / HALF_WIDTH
    bump = torch.relu(1.0 - u * u)
    far = (edges.shell == N_SHELLS - 1)[:, None]
    inside = torch.where(far, torch.relu(1.0 - (distance / cutoff_nm).square()), 1.0)
    direction = apart / distance[..., None]
    shapes = edges.by_atom(torch.cat([direction, products(direction)], dim=-1))
    return EdgeGeometry(distance, bump * bump * bump * (inside * inside * inside)[..., None], shapes)


def radial_grid(n_radial: int, cutoff_nm: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return, by shell, the logarithm of the distance at which radial functions begin, and their spacing."""
    ranges = like.new_tensor([*SHELL_RANGES_NM, (LAST_SHELL_FROM_NM, cutoff_nm)]).log()
    return ranges[:, 0], (ranges[:, 1] - ranges[:, 0]) / (n_radial - 1)


def products(v: Tensor) -> Tensor:
    """`v` (..., 3) -> (..., 6), so that sums of products of two results are squares of the vectors' product."""
    x, y, z = v.unbind(-1)
    return torch.stack([x * x, y * y, z * z, _ROOT_TWO * x * y, _ROOT_TWO * y * z, _ROOT_TWO * x * z], dim=-1)
