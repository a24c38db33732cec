"""Features of atoms from the covalent graph and from the molecule's template, independent of atom order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
# Degrees that are told apart, the last stands for all above.
_DEGREES = 6
_ORDERS = (0.0, 1.0, 1.5, 2.0, 3.0)
# Steps after which a random walk's return is looked at: enough to tell rings of up to eight atoms.
_WALKS = tuple(range(2, 9))
N_ATOM_NUMBERS = _DEGREES + 3 + len(_WALKS)
N_BOND_NUMBERS = len(_ORDERS) + 1


@dataclass(frozen=True, eq=False)
class AtomFeatures:
    """`of_atoms` (n_atoms, N_ATOM_NUMBERS): degree (one-hot), ring membership, formal charge, handedness (-1, 0, 1) and
    the probabilities that a random walk along bonds is back after 2 to 8 steps (Dwivedi 2022, LSPE). `of_bonds`
    (n_bonds, N_BOND_NUMBERS): order (one-hot; unknown first) and ring membership. `template_nm` (n_atoms, 3): where the
    scene has the atom in the pose that frames are laid on. All float32."""

    of_atoms: Tensor
    of_bonds: Tensor
    template_nm: Tensor

    def to(self, device: torch.device) -> AtomFeatures:
        return AtomFeatures(self.of_atoms.to(device), self.of_bonds.to(device), self.template_nm.to(device))

    def permuted(self, order: Tensor) -> AtomFeatures:
        """Return the features of atoms `order`; bonds keep their places."""
        return AtomFeatures(self.of_atoms[order], self.of_bonds, self.template_nm[order])


def features_of_graph(n_atoms: int, bonds: IntArray, orders: npt.ArrayLike, ring_bonds: IntArray,
                      charges: npt.ArrayLike, handedness: npt.ArrayLike,
                      template_nm: npt.ArrayLike) -> AtomFeatures:  # fmt: skip
    """Return features from arrays: `bonds` (n_bonds, 2), their `orders`, those of them in a ring `(k, 2)`."""
    adjacency = np.zeros((n_atoms, n_atoms))
    adjacency[bonds[:, 0], bonds[:, 1]] = adjacency[bonds[:, 1], bonds[:, 0]] = 1.0
    degree = adjacency.sum(axis=1)
    in_ring = np.zeros(n_atoms)
    in_ring[ring_bonds.ravel()] = 1.0
    step = adjacency / np.maximum(degree, 1.0)[:, None]
    walk, returns = step, []
    for _ in _WALKS:
        walk = walk @ step
        returns.append(np.diagonal(walk))
    of_atoms = np.column_stack([
        np.eye(_DEGREES)[np.minimum(degree.astype(int), _DEGREES - 1)], in_ring, np.asarray(charges, dtype=float),
        np.asarray(handedness, dtype=float), *returns,
    ])  # fmt: skip
    rings = {(min(i, j), max(i, j)) for i, j in ring_bonds.tolist()}
    closed = np.array([(min(i, j), max(i, j)) in rings for i, j in bonds.tolist()], dtype=float)
    place = [_ORDERS.index(order) if order in _ORDERS else 0 for order in np.asarray(orders, dtype=float).tolist()]
    of_bonds = np.column_stack([np.eye(len(_ORDERS))[np.array(place, dtype=int)], closed.reshape(-1)])
    as_float = lambda x: torch.tensor(np.asarray(x).tolist(), dtype=torch.float32)  # noqa: E731
    return AtomFeatures(
        as_float(of_atoms).reshape(n_atoms, N_ATOM_NUMBERS),
        as_float(of_bonds).reshape(-1, N_BOND_NUMBERS),
        as_float(template_nm).reshape(n_atoms, 3),
    )
