"""Atoms as their own latents: nothing to train, and nothing of an unseen molecule is lost."""

from __future__ import annotations

from torch import Tensor

from surrogate.models.lam_slide.codes.base import Code, Decoded


class AtomCode(Code):
    """A frame's latents are its atoms' displacements from the template, and come back as they are."""

    n_latents = 1
    latent_dim = 3

    def n_entities(self, n_atoms: int) -> int:
        """See `Code.n_entities`."""
        return n_atoms

    def types(self, elements: Tensor) -> Tensor:
        """See `Code.types`."""
        return elements

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor, mask: Tensor | None = None) -> Tensor:
        """See `Code.encode`."""
        return x

    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        """See `Code.decode`."""
        return Decoded(latents, None)
