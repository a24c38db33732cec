"""Edges of the observed structure: bonds and second neighbours, both ways, as index arrays."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surrogate.models.interface import Molecule

# Kinds of edges: what a message is told of the pair it runs between.
BOND, SECOND_NEIGHBOUR, NOT_BONDED = 0, 1, 2
N_KINDS = 3


@dataclass(frozen=True, eq=False)
class Graph:
    """Directed edges `receiver`, `sender`, `kind` (n_edges,) of one molecule, sorted by receiver, each pair both ways;
    `degree` (n_atoms,) edges that end in an atom, at least one, so that a mean over none is zero."""

    receiver: Tensor
    sender: Tensor
    kind: Tensor
    degree: Tensor


def molecular_graph(molecule: Molecule, *, all_pairs: bool = False) -> Graph:
    """Return bonds and pairs two bonds apart (the edges of EGNO, Xu 2024), in time linear in the atoms; with
    `all_pairs` every other pair as well, for systems without bonds."""
    n_atoms, device = molecule.n_atoms, molecule.elements.device
    bonds = torch.cat([molecule.bonds, molecule.bonds.flip(1)])
    bonds = bonds[bonds[:, 0].argsort(stable=True)]
    second = bonds.new_zeros((0, 2))
    if len(bonds):
        n_bonds = torch.bincount(bonds[:, 0], minlength=n_atoms)
        first = torch.cumsum(n_bonds, 0) - n_bonds
        # Every bond (i, j) is followed by each bond (j, k).
        reach = n_bonds[bonds[:, 1]]
        start = torch.repeat_interleave(bonds[:, 0], reach)
        step = torch.arange(int(reach.sum()), device=device) - torch.repeat_interleave(reach.cumsum(0) - reach, reach)
        end = bonds[torch.repeat_interleave(first[bonds[:, 1]], reach) + step, 1]
        second = torch.stack([start, end], 1)[start != end]
    pairs = [bonds, second]
    if all_pairs:
        index = torch.arange(n_atoms, device=device)
        full = torch.cartesian_prod(index, index)
        pairs.append(full[full[:, 0] != full[:, 1]])
    kinds = torch.cat([torch.full((len(p),), kind, device=device) for kind, p in enumerate(pairs)])
    keys = torch.cat([p[:, 0] * n_atoms + p[:, 1] for p in pairs])
    # A pair of several kinds counts as the closest: a three-membered ring's bonds are bonds.
    unique, place = torch.unique(keys, return_inverse=True)
    kind = torch.full((len(unique),), N_KINDS, device=device).scatter_reduce(0, place, kinds, "amin")
    receiver, sender = unique // n_atoms, unique % n_atoms
    degree = torch.bincount(receiver, minlength=n_atoms).clamp(min=1)
    return Graph(receiver, sender, kind, degree)
