"""Bonds to hydrogen that stay rigid while a molecule is integrated: CCMA (Eastman and Pande, J. Chem. Theory Comput. 6,
434 (2010)), for many replicas at once.

What a correction along one bond does to the others hangs on masses and on the angles between bonds that share an atom,
which hardly change. So one matrix, of the molecule at rest, turns deviations of all bonds into corrections of all; a
few rounds meet the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

# Of a squared length, and of a velocity along a bond in nm^2/ps; rounds until they are met.
TOLERANCE = 1e-9
ROUNDS = 50


@dataclass(frozen=True, eq=False)
class RigidBonds:
    """Bonds between the atoms `first` and `second` (k,), of squared lengths `length2` (k,) nm^2; `per_mass` (k, 2) of
    both ends, 1/Da; `inverse` (k, k) of what corrections do to deviations."""

    first: Tensor
    second: Tensor
    length2: Tensor
    per_mass: Tensor
    inverse: Tensor

    @staticmethod
    def of(rest_nm: Tensor, bonds: Tensor, masses_da: Tensor) -> RigidBonds:
        """Return `bonds` (k, 2) as long as in the molecule at rest `rest_nm` (n_atoms, 3); `masses_da` (n_atoms,)."""
        first, second = bonds[:, 0], bonds[:, 1]
        along = rest_nm[first] - rest_nm[second]
        ends = torch.zeros(len(bonds), len(rest_nm), dtype=rest_nm.dtype)
        row = torch.arange(len(bonds))
        ends[row, first], ends[row, second] = 1.0, -1.0
        shared = (ends / masses_da) @ ends.T
        return RigidBonds(
            first, second, along.square().sum(-1), 1.0 / masses_da[bonds], torch.linalg.inv(shared * (along @ along.T))
        )

    def to(self, device: torch.device) -> RigidBonds:
        return RigidBonds(*(getattr(self, field.name).to(device) for field in fields(self)))

    def place(self, free_nm: Tensor, before_nm: Tensor) -> Tensor:
        """Return positions `(rows, n_atoms, 3)` nearest to `free_nm` at which bonds have their lengths, moved along
        the bonds of `before_nm`. Rows that cannot be mended are returned as far as they came."""
        along, x = self._along(before_nm), free_nm
        for _ in range(ROUNDS):
            off = 0.5 * (self.length2 - self._along(x).square().sum(-1))
            if not bool((off.abs() > TOLERANCE * self.length2).any()):
                break
            x = self._moved(x, along, off)
        return x

    def project(self, v: Tensor, x_nm: Tensor) -> Tensor:
        """Return velocities `(rows, n_atoms, 3)` without those along bonds, at positions `x_nm`."""
        along = self._along(x_nm)
        for _ in range(ROUNDS):
            off = -(along * self._along(v)).sum(-1)
            if not bool((off.abs() > TOLERANCE).any()):
                break
            v = self._moved(v, along, off)
        return v

    def _along(self, x: Tensor) -> Tensor:
        return x[:, self.first] - x[:, self.second]

    def _moved(self, x: Tensor, along: Tensor, off: Tensor) -> Tensor:
        step = (off @ self.inverse)[..., None] * along
        x = x.index_add(1, self.first, step * self.per_mass[:, :1])
        return x.index_add(1, self.second, -step * self.per_mass[:, 1:])
