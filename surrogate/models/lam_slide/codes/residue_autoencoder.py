"""Stage one with residues as entities (appendix E.3, Table 12): one identifier and one token for each residue."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from surrogate.models.lam_slide.codes.autoencoder import Autoencoder
from surrogate.models.lam_slide.codes.base import Decoded
from surrogate.models.lam_slide.codes.residue_code import (
    FRAME_CLAMP_NM,
    N_SLOTS,
    RESIDUE_TYPES,
    ResidueAtoms,
    ResidueLayout,
    frame_errors,
    torsion_errors,
)
from surrogate.models.lam_slide.config import AutoencoderConfig


class ResidueAutoencoder(Autoencoder):
    """An autoencoder of heavy atoms that packs them into residues first and takes them out again last.

    It stands where one of atoms would: atoms go in and come out; types and element logits are those of residues.
    """

    def __init__(self, config: AutoencoderConfig, layout: ResidueLayout, position_scale_nm: float) -> None:
        super().__init__(config)
        self.residues = ResidueAtoms(layout)
        self.frame_clamp = FRAME_CLAMP_NM / position_scale_nm
        n_numbers = 3 * N_SLOTS
        self.elements = nn.Embedding(len(RESIDUE_TYPES), self.elements.embedding_dim)
        self.embed_coordinates = nn.Linear(n_numbers * (1 + 2 * config.n_octaves), config.width)
        self.to_position = nn.Sequential(nn.LayerNorm(config.width), nn.Linear(config.width, n_numbers))
        self.to_element = nn.Sequential(nn.LayerNorm(config.width), nn.Linear(config.width, len(RESIDUE_TYPES)))

    def n_entities(self, n_atoms: int) -> int:
        """Return how many identifiers the atoms take: one for each residue."""
        return len(self.residues.types)

    def types(self, elements: Tensor) -> Tensor:
        """Return the residue types `(b, n_residues)` that stand for elements `(b, n_atoms)`."""
        return self.residues.types.expand(len(elements), -1)

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor, mask: Tensor | None = None) -> Tensor:
        """Atoms `(b, n_atoms, 3)` (scaled), identifiers `(b, n_residues)` -> latents `(b, n_latents, dim)`."""
        return super().encode(self.residues.to_residues(x), self.types(elements), identifiers, mask)

    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        """Latents, identifiers `(b, n_residues)` -> atoms `(b, n_atoms, 3)` (scaled), type logits `(b, n_residues,
        types)`."""
        decoded = super().decode(latents, identifiers, with_types=with_types)
        return Decoded(self.residues.to_atoms(decoded.positions), decoded.type_logits)

    def stage_one_terms(self, x: Tensor, decoded: Tensor) -> dict[str, tuple[float, Tensor]]:
        """Return the frame loss and the torsion loss of atoms `(b, n_atoms, 3)` with their weights (Table 12)."""
        return {
            "frame": (self.config.frame_weight, self.frame_loss(x, decoded)),
            "torsion": (self.config.torsion_weight, self.torsion_loss(x, decoded)),
        }

    def frame_loss(self, x: Tensor, decoded: Tensor, weight: Tensor | float = 1.0) -> Tensor:
        """Return the frame loss of atoms `(..., n_atoms, 3)`: the mean error over frames and atoms, scaled units;
        `weight` (..., 1, 1) of each row."""
        with torch.autocast(x.device.type, enabled=False):
            errors = frame_errors(x.float(), decoded.float(), self.residues.frames, self.frame_clamp)
            return _mean(errors * weight)

    def torsion_loss(self, x: Tensor, decoded: Tensor) -> Tensor:
        """Return the torsion loss of atoms `(..., n_atoms, 3)`, a mean over torsions; zero where there is none."""
        with torch.autocast(x.device.type, enabled=False):
            errors = torsion_errors(x.float(), decoded.float(), self.residues.torsions)
            return _mean(errors)


def _mean(errors: Tensor) -> Tensor:
    """The mean; zero of nothing, where there is no frame or torsion."""
    return errors.mean() if errors.numel() else errors.sum()
