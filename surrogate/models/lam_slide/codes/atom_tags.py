"""Atoms known by their bonds: message passing over the covalent graph gives each a tag that identifiers are not needed
for, so that one model serves many molecules, and ones that it never saw."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.atom_features import N_ATOM_NUMBERS, N_BOND_NUMBERS
from surrogate.models.egnn import gather_sum
from surrogate.models.layers import fourier_features
from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.models.atom_features import AtomFeatures
    from surrogate.models.interface import Molecule
    from surrogate.models.lam_slide.config import GraphConfig

_MAX_ATOMIC_NUMBER = 54
# Atoms further apart along bonds are alike far.
MAX_HOPS = 5


@dataclass(frozen=True, eq=False)
class Atoms:
    """What encoder and decoder are told of atoms: `tags` (b, n_atoms, dim), `template` (b, n_atoms, 3), where each is
    at rest, in scaled units, and `hops` (n_atoms, n_atoms), bonds between two, at most MAX_HOPS; b is the number of
    molecules' poses, or 1 for all rows alike."""

    tags: Tensor
    template: Tensor
    hops: Tensor

    def spread(self, lead: torch.Size) -> Atoms:
        """Return one row for each of the leading dimensions `lead`, of which the first is b (or anything where b is
        1)."""

        def rows(x: Tensor) -> Tensor:
            wide = x.reshape(x.shape[0], *([1] * (len(lead) - 1)), *x.shape[1:])
            return wide.expand(*lead, *x.shape[1:]).reshape(-1, *x.shape[1:])

        return Atoms(rows(self.tags), rows(self.template), self.hops)


@dataclass(frozen=True, eq=False)
class Told:
    """What the latent flow is told beside the frames: `whole` (b, width) of molecule and lag, and, where latents are
    atoms, `tags` (b, n_atoms, dim) and `hops` (n_atoms, n_atoms) of these."""

    whole: Tensor
    tags: Tensor | None = None
    hops: Tensor | None = None

    def rows(self, which: Tensor) -> Told:
        """Return what is told of the rows `which`."""
        return Told(self.whole[which], None if self.tags is None else self.tags[which], self.hops)


def bonds_between(bonds: Tensor, n_atoms: int) -> Tensor:
    """Return how many bonds of `(n_bonds, 2)` lie between two atoms, `(n_atoms, n_atoms)` int64, at most MAX_HOPS."""
    near = torch.eye(n_atoms, device=bonds.device)
    step = near.clone()
    step[bonds[:, 0], bonds[:, 1]] = step[bonds[:, 1], bonds[:, 0]] = 1.0
    hops = torch.full((n_atoms, n_atoms), MAX_HOPS, dtype=torch.int64, device=bonds.device)
    for n in range(MAX_HOPS):
        hops[(near > 0) & (hops == MAX_HOPS)] = n
        near = near @ step
    return hops


def hold_hydrogens(frames_nm: Tensor, molecule: Molecule) -> Tensor:
    """Return frames `(..., n_atoms, 3)` nm with each hydrogen of a single bond moved along it to the template's length.

    Where it lies on its neighbour, so that there is no direction, it stays.
    """
    assert molecule.atoms is not None
    ends = torch.cat([molecule.bonds, molecule.bonds.flip(1)])
    single = torch.bincount(ends[:, 0], minlength=molecule.n_atoms) == 1
    ends = ends[single[ends[:, 0]] & (molecule.elements[ends[:, 0]] == 1)]
    hydrogen, parent = ends.T
    template = molecule.atoms.template_nm
    length = (template[hydrogen] - template[parent]).norm(dim=-1, keepdim=True)
    bond = frames_nm[..., hydrogen, :] - frames_nm[..., parent, :]
    held = torch.where(bond == 0.0, bond, F.normalize(bond, dim=-1) * length)
    return frames_nm.index_copy(-2, hydrogen, frames_nm[..., parent, :] + held)


class MessageRound(nn.Module):
    """One round along bonds: h_i += MLP(h_i, sum_j MLP(h_j, bond_ij))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.send = nn.Linear(width, width)
        self.of_bond = nn.Linear(N_BOND_NUMBERS, width)
        self.update = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, h: Tensor, receiver: Tensor, sender: Tensor, of_bonds: Tensor) -> Tensor:
        """`h` (n_atoms, width), directed bonds (n_edges,), `of_bonds` (n_edges, N_BOND_NUMBERS)."""
        message = F.silu(self.send(h)[sender] + self.of_bond(of_bonds))
        gathered = gather_sum(message[None], receiver, len(h))[0]
        return h + self.update(F.layer_norm(torch.cat([h, gathered], dim=-1), (2 * h.shape[-1],)))


class AtomEncoder(nn.Module):
    """Elements and the covalent graph, and the template's coordinates, which tell equivalent atoms apart -> tags.

    Atoms permuted give tags permuted: neither their order nor names play a part.
    """

    def __init__(self, config: GraphConfig, tag_dim: int) -> None:
        super().__init__()
        self.n_octaves, w = config.n_octaves, config.width
        self.elements = nn.Embedding(_MAX_ATOMIC_NUMBER + 1, w)
        self.of_atoms = nn.Linear(N_ATOM_NUMBERS, w)
        self.rounds = nn.ModuleList(MessageRound(w) for _ in range(config.n_rounds))
        self.of_template = nn.Linear(3 * (1 + 2 * config.n_octaves), w)
        self.to_tag = nn.Sequential(nn.Linear(2 * w, w), nn.SiLU(), nn.Linear(w, tag_dim))

    def forward(self, molecule: Molecule, features: AtomFeatures, template: Tensor) -> Tensor:
        """A molecule, its features, its template in b poses `(b, n_atoms, 3)` (scaled) -> tags `(b, n_atoms, dim)`."""
        h = self.elements(molecule.elements) + self.of_atoms(features.of_atoms)
        receiver, sender = torch.cat([molecule.bonds, molecule.bonds.flip(1)]).T
        of_bonds = features.of_bonds.repeat(2, 1)
        for one in self.rounds:
            h = one(h, receiver, sender, of_bonds)
        placed = self.of_template(fourier_features(template, self.n_octaves))
        return self.to_tag(torch.cat([h.expand(*placed.shape[:-1], -1).to(placed.dtype), placed], dim=-1))


class Conditioning(nn.Module):
    """What the latent flow is told beside the frames: which molecule, and how far apart its frames are to be.

    The molecule is the mean over its atoms' tags and the logarithm of their number, the lag the place of its logarithm
    in the trained range, in waves long enough that between two trained lags nothing but a smooth line can be learned.
    """

    frequency: Tensor

    def __init__(self, width: int, tag_dim: int, lag_range_ps: tuple[float, float] | None) -> None:
        super().__init__()
        self.lag_range_ps = lag_range_ps
        self.of_tag = nn.Linear(tag_dim, width) if tag_dim else None
        self.of_molecule = nn.Sequential(nn.Linear(width + 1, width), nn.SiLU(), nn.Linear(width, width))
        if not tag_dim:
            del self.of_molecule
        if lag_range_ps is not None:
            self.register_buffer("frequency", math.pi * torch.tensor([0.5, 1.0, 2.0, 3.0]), persistent=False)
            self.of_lag = nn.Sequential(nn.Linear(9, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, atoms: Atoms | None, lag_ps: Tensor | None) -> Tensor:
        """Tags `(b, n_atoms, dim)` and lags `(b,)`, each where the model knows it -> `(b, width)`."""
        found: list[Tensor] = []
        if self.of_tag is not None:
            if atoms is None:
                raise InputError("this model needs to be told of the molecule.")
            mean = F.silu(self.of_tag(atoms.tags)).mean(dim=1)
            size = torch.full_like(mean[:, :1], math.log(atoms.tags.shape[1]) / 3.0)
            found.append(self.of_molecule(torch.cat([mean, size], dim=-1)))
        if self.lag_range_ps is not None:
            if lag_ps is None:
                raise InputError("this model needs to be told the lag.")
            low, high = (math.log(lag) for lag in self.lag_range_ps)
            place = ((lag_ps.float().log() - low) / max(high - low, 1e-6))[:, None]
            angles = place * self.frequency
            found.append(self.of_lag(torch.cat([place, angles.sin(), angles.cos()], dim=-1)))
        return sum(found[1:], found[0])
