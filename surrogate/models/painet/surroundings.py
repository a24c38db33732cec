"""Types of atoms derived from their bonded surroundings, in rounds of message passing."""

from __future__ import annotations

import torch
from torch import Tensor, nn


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
