"""Residues as entities (appendix E.3): each codes its heavy atoms in one vector of fourteen places, some of them empty;
and the losses of peptides (appendix E.4): backbone frames and torsions.

The paper writes the last two by reference to AlphaFold 2 (Jumper, Nature 596, 583, 2021; algorithms 21, 27 and 28 of
its supplement). Atoms are taken from their places before any loss is formed, so that empty ones never count.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

N_SLOTS = 14
# Places in the embedding of types and in their logits; new ones go last.
RESIDUE_TYPES = (
    "ALA", "ARG", "ASN", "ASP", "CYS", "GLN", "GLU", "GLY", "HIS", "ILE", "LEU", "LYS", "MET", "PHE", "PRO", "SER",
    "THR", "TRP", "TYR", "VAL", "ACE", "NME", "NH2",
)  # fmt: skip
# AlphaFold's 10 Å, beyond which a frame's error counts no further.
FRAME_CLAMP_NM = 1.0


@dataclass(frozen=True)
class ResidueLayout:
    """Where the `n_atoms` atoms that a model works on stand in their residues.

    `types` of the residues, by number in RESIDUE_TYPES; `slots`, for each residue, the atom in each of N_SLOTS places
    or -1; `frames` rows (a, origin, b) of atoms, (N, CA, C) of an amino acid; `torsions` rows of four: φ, ψ, ω and χ.
    """

    n_atoms: int
    types: tuple[int, ...]
    slots: tuple[tuple[int, ...], ...]
    frames: tuple[tuple[int, ...], ...]
    torsions: tuple[tuple[int, ...], ...]


class ResidueAtoms(nn.Module):
    """Atoms into residues and back."""

    types: Tensor
    slots: Tensor
    filled: Tensor
    places: Tensor
    frames: Tensor
    torsions: Tensor

    def __init__(self, layout: ResidueLayout) -> None:
        super().__init__()
        slots = torch.tensor(layout.slots)
        filled = slots >= 0
        places = torch.empty(layout.n_atoms, dtype=torch.long)
        places[slots[filled]] = torch.arange(slots.numel()).reshape(slots.shape)[filled]
        fixed = {
            "types": torch.tensor(layout.types),
            "slots": slots.clamp(min=0),
            "filled": filled,
            "places": places,
            "frames": torch.tensor(layout.frames, dtype=torch.long).reshape(-1, 3),
            "torsions": torch.tensor(layout.torsions, dtype=torch.long).reshape(-1, 4),
        }
        for name, tensor in fixed.items():
            self.register_buffer(name, tensor, persistent=False)

    def to_residues(self, x: Tensor) -> Tensor:
        """Atoms `(b, n_atoms, 3)` -> residues `(b, n_residues, 42)`, zero in empty places."""
        return torch.where(self.filled[..., None], x[:, self.slots], 0.0).flatten(-2)

    def to_atoms(self, y: Tensor) -> Tensor:
        """Residues `(b, n_residues, 42)` -> atoms `(b, n_atoms, 3)`; what stands in empty places is dropped."""
        return y.unflatten(-1, (N_SLOTS, 3)).flatten(1, 2)[:, self.places]


def local_coordinates(x: Tensor, frames: Tensor) -> Tensor:
    """Return atoms `(..., n_atoms, 3)` as each frame sees them, `(..., n_frames, n_atoms, 3)`: origin in the middle
    atom of a row (a, origin, b), the first axis towards b, the second in the plane of a (AlphaFold 2, algorithm 21)."""
    a, origin, b = (x[..., frames[:, k], :] for k in range(3))
    first = _unit(b - origin)
    side = a - origin
    second = _unit(side - (side * first).sum(-1, keepdim=True) * first)
    axes = torch.stack([first, second, torch.linalg.cross(first, second)], dim=-2)
    return torch.einsum("...fij,...fnj->...fni", axes, x.unsqueeze(-3) - origin.unsqueeze(-2))


def frame_errors(x: Tensor, decoded: Tensor, frames: Tensor, clamp: float) -> Tensor:
    """Return how far each atom is off as each frame sees it, `(..., n_frames, n_atoms)`, at most `clamp`, in the units
    of `x`: the terms of the frame-aligned point error (algorithm 28)."""
    off = local_coordinates(x, frames) - local_coordinates(decoded, frames)
    return (off.square().sum(-1) + 1e-10).sqrt().clamp(max=clamp)


def torsion_vectors(x: Tensor, torsions: Tensor) -> Tensor:
    """Return cosine and sine `(..., n_torsions, 2)` of torsions, of unit norm; signs by the IUPAC convention."""
    a, b, c, d = (x[..., torsions[:, k], :] for k in range(4))
    middle = c - b
    first, second = torch.linalg.cross(b - a, middle), torch.linalg.cross(middle, d - c)
    sine = ((b - a) * second).sum(-1) * (middle.square().sum(-1) + 1e-12).sqrt()
    vectors = torch.stack([(first * second).sum(-1), sine], dim=-1)
    return vectors / (vectors.square().sum(-1, keepdim=True) + 1e-12).sqrt()


def torsion_errors(x: Tensor, decoded: Tensor, torsions: Tensor) -> Tensor:
    """Return the squared distance `(..., n_torsions)` of the torsions' unit vectors, 2 - 2 cos of the angle between
    them (algorithm 27; MD keeps the names of equivalent atoms apart, so no second truth is asked for)."""
    return (torsion_vectors(x, torsions) - torsion_vectors(decoded, torsions)).square().sum(-1)


def _unit(x: Tensor) -> Tensor:
    return x / (x.square().sum(-1, keepdim=True) + 1e-12).sqrt()
