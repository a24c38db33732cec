"""Stage one: a cross-attention encoder into a few latent vectors and a decoder queried by identifier (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide.config import AutoencoderConfig
from surrogate.models.layers import CrossAttentionBlock, fourier_features

MAX_ATOMIC_NUMBER = 54


def draw_identifiers(n_atoms: int, pool: int, batch: int, generator: torch.Generator | None) -> Tensor:
    """Algorithm 1: for each batch row, `n_atoms` different identifiers from the pool: `(batch, n_atoms)` int64."""
    if n_atoms > pool:
        raise ValueError(f"{n_atoms} atoms need an identifier pool of at least that size, not {pool}")
    device = generator.device if generator is not None else None
    return torch.rand(batch, pool, generator=generator, device=device).argsort(dim=1)[:, :n_atoms]


@dataclass(frozen=True)
class Decoded:
    """Positions `(b, n_atoms, 3)` in scaled units and, when asked for, logits `(b, n_atoms, types)` of the elements."""

    positions: Tensor
    type_logits: Tensor | None


class Autoencoder(nn.Module):
    """Encoder [x, m, u] -> Z (Algorithm 2) and decoder Z, u -> x, m (Algorithm 3)."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = c = config
        self.n_latents, self.latent_dim = c.n_latents, c.latent_dim
        self.identifiers = nn.Embedding(c.identifier_pool, c.identifier_dim)
        self.elements = nn.Embedding(MAX_ATOMIC_NUMBER + 1, 16)
        coordinate_dim = 3 * (1 + 2 * c.n_octaves)
        # Identifiers bind to coordinates by a product, so that a sum over atoms can be taken apart again.
        self.embed_coordinates = nn.Linear(coordinate_dim, c.width)
        self.embed_entity = nn.Linear(16 + c.identifier_dim, 2 * c.width)
        self.embed = nn.Sequential(
            nn.Linear(c.width, c.width), nn.GELU(approximate="tanh"), nn.Linear(c.width, c.width)
        )
        self.queries = nn.Parameter(torch.randn(c.n_latents, c.width) * 0.5)
        self.encoder = nn.ModuleList(
            CrossAttentionBlock(c.width, c.width, c.n_heads, c.head_dim) for _ in range(c.n_encoder_layers)
        )
        self.to_latent = nn.Linear(c.width, c.latent_dim)
        self.query = nn.Linear(c.identifier_dim, c.width)
        self.decoder = nn.ModuleList(
            CrossAttentionBlock(c.width, c.latent_dim, c.n_heads, c.head_dim, gated=True)
            for _ in range(c.n_decoder_layers)
        )
        self.to_position = nn.Sequential(nn.LayerNorm(c.width), nn.Linear(c.width, 3))
        self.to_element = nn.Sequential(nn.LayerNorm(c.width), nn.Linear(c.width, MAX_ATOMIC_NUMBER + 1))

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor, mask: Tensor | None = None) -> Tensor:
        """Positions `(b, n, 3)` (scaled), atomic numbers and identifiers `(b, n)` -> latents `(b, n_latents, dim)`."""
        entity = self.embed_entity(torch.cat([self.elements(elements), self.identifiers(identifiers)], dim=-1))
        scale, shift = entity.chunk(2, dim=-1)
        tokens = self.embed_coordinates(fourier_features(x, self.config.n_octaves)) * scale + shift
        tokens = tokens + self.embed(tokens)
        latents = self.queries.expand(x.shape[0], -1, -1)
        for block in self.encoder:
            latents = block(latents, tokens, mask)
        z = self.to_latent(latents).float()
        return F.layer_norm(z, (self.config.latent_dim,))

    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        """Latents `(b, n_latents, dim)`, identifiers `(b, n)` -> positions `(b, n, 3)` (scaled), element logits."""
        context = F.layer_norm(latents, (self.config.latent_dim,))
        # The residual stream and the last layer stay in float32: bf16 would round positions to 0.001 nm.
        h = self.query(self.identifiers(identifiers)).float()
        for block in self.decoder:
            h = block(h, context)
        logits = self.to_element(h).float() if with_types else None
        with torch.autocast(h.device.type, enabled=False):
            return Decoded(self.to_position(h.float()), logits)


def pair_distances(x: Tensor) -> Tensor:
    """Return distances `(..., n, n)` (eq. 15), differentiable on the diagonal."""
    difference = x.unsqueeze(-2) - x.unsqueeze(-3)
    return (difference.square().sum(-1) + 1e-12).sqrt()


def reconstruction_losses(x: Tensor, decoded: Tensor) -> tuple[Tensor, Tensor]:
    """Return the position loss (eq. 13) and the inter-distance loss (eq. 14), in scaled units squared."""
    position = (x - decoded).square().sum(-1).mean()
    distance = (pair_distances(x) - pair_distances(decoded)).square().mean()
    return position, distance
