"""The code of a frame: what LaM-SLidE's stages and rollouts ask of whatever turns frames into latents and back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn


@dataclass(frozen=True)
class Decoded:
    """Positions `(b, n_atoms, 3)` in scaled units and, when asked for, type logits `(b, n_entities, types)`."""

    positions: Tensor
    type_logits: Tensor | None


class Code(nn.Module, ABC):
    """Turns frames into latents `(b, n_latents, latent_dim)` and back, with losses of its own beside those of positions
    and distances. Entities (atoms or residues) are told apart by identifiers `(b, n_entities)` int64, or by tags
    `(b, n_entities, dim)` that the covalent graph gives."""

    n_latents: int
    latent_dim: int

    @abstractmethod
    def n_entities(self, n_atoms: int) -> int:
        """Return how many identifiers so many atoms take."""

    @abstractmethod
    def types(self, elements: Tensor) -> Tensor:
        """Return what the type logits are to name `(b, n_entities)`, given elements `(b, n_atoms)`."""

    @abstractmethod
    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor, mask: Tensor | None = None) -> Tensor:
        """Positions `(b, n_atoms, 3)` in scaled units and elements `(b, n_atoms)` -> latents."""

    @abstractmethod
    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        """Latents -> positions and, `with_types`, logits."""

    def stage_one_terms(self, x: Tensor, decoded: Tensor) -> dict[str, tuple[float, Tensor]]:
        """Return the code's own terms of the first stage's loss, each with its weight, for atoms `(b, n_atoms, 3)`."""
        return {}

    def frame_loss(self, x: Tensor, decoded: Tensor, weight: Tensor | float = 1.0) -> Tensor | None:
        """Return the code's own term of the second stage's loss, for atoms `(..., n_atoms, 3)` and a `weight`
        (..., 1, 1) of each row; None of a code that has none."""
        return None
