"""Stage two: the latent flow model, transformer layers alternating over latents and time (Algorithms 4 and 5)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.config import ApproximatorConfig
from surrogate.models.layers import ParallelBlock, TimeEmbedding, rotary_angles
from systems.errors import InputError

Rope = tuple[Tensor, Tensor]


class LatentLayer(nn.Module):
    """Algorithm 5: one parallel block along the latent dimension, one along time. With a single latent vector there is
    nothing to attend to along the first, and its block is left out."""

    def __init__(self, width: int, n_heads: int, n_latents: int) -> None:
        super().__init__()
        self.spatial = ParallelBlock(width, n_heads) if n_latents > 1 else None
        self.temporal = ParallelBlock(width, n_heads)

    def forward(self, o: Tensor, modulation: Tensor, rope_latent: Rope, rope_time: Rope) -> Tensor:
        """`o` (b, L, T, width), `modulation` (b, 6, width): three for each block."""
        if self.spatial is not None:
            o = self.spatial(o.transpose(1, 2), modulation[:, :3], rope_latent).transpose(1, 2)
        return self.temporal(o, modulation[:, 3:], rope_time)


class Approximator(nn.Module):
    """Data prediction network: noisy latents of a chunk, flow time, conditioning latents -> clean latents."""

    cos_time: Tensor
    sin_time: Tensor
    cos_latent: Tensor
    sin_latent: Tensor

    def __init__(self, config: ApproximatorConfig, n_latents: int, latent_dim: int) -> None:
        super().__init__()
        self.config = c = config
        if n_latents % c.latents_per_token:
            raise InputError(f"latents_per_token = {c.latents_per_token} does not divide {n_latents} latents.")
        n_latents, latent_dim = n_latents // c.latents_per_token, latent_dim * c.latents_per_token
        self.embed_noisy = nn.Linear(latent_dim, c.width)
        self.embed_conditioning = nn.Linear(latent_dim, c.width)
        self.embed_mask = nn.Embedding(2, c.width)
        self.embed_latent = nn.Parameter(torch.randn(n_latents, c.width) * 0.02)
        self.embed_time = TimeEmbedding(c.width)
        self.layers = nn.ModuleList(LatentLayer(c.width, c.n_heads, n_latents) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = nn.Linear(c.width, latent_dim)
        for module in (self.modulation, self.final_modulation, self.final):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
        head_dim = c.width // c.n_heads
        for name, length in (("time", c.chunk_frames), ("latent", n_latents)):
            angles = rotary_angles(length, head_dim)
            self.register_buffer(f"cos_{name}", angles.cos(), persistent=False)
            self.register_buffer(f"sin_{name}", angles.sin(), persistent=False)

    def forward(self, o: Tensor, tau: Tensor, conditioning: Tensor) -> Tensor:
        """Return the predicted data `(b, T, L, dim)`.

        `o` (b, T, L, dim) noisy latents, `tau` (b,), `conditioning` (b, n_conditioning, L, dim) clean latents of the
        first frames. The first frames of `o` carry no information: they are replaced by the clean ones.
        """
        c = self.config
        if c.precondition:
            skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau, c.interpolant))
            residual = self._network(o * scale_in, tau, conditioning)
            return skip * o + out * residual
        return self._network(o, tau, conditioning)

    def _network(self, o: Tensor, tau: Tensor, conditioning: Tensor) -> Tensor:
        shape, per_token = o.shape, self.config.latents_per_token
        if per_token > 1:
            o, conditioning = (t.unflatten(2, (-1, per_token)).flatten(-2) for t in (o, conditioning))
        n_known, n_frames = conditioning.shape[1], o.shape[1]
        known = torch.zeros(n_frames, dtype=torch.long, device=o.device)
        known[:n_known] = 1
        padded = F.pad(conditioning, (0, 0, 0, 0, 0, n_frames - n_known))
        noisy = torch.where(known[None, :, None, None] == 1, 0.0, o)
        h = self.embed_noisy(noisy) + self.embed_conditioning(padded)
        h = h + self.embed_mask(known)[None, :, None, :] + self.embed_latent
        time = F.silu(self.embed_time(tau))
        modulation = self.modulation(time).unflatten(-1, (6, -1))
        rope_time = (self.cos_time[:n_frames], self.sin_time[:n_frames])
        rope_latent = (self.cos_latent, self.sin_latent)
        h = h.transpose(1, 2)
        for layer in self.layers:
            h = layer(h, modulation, rope_latent, rope_time)
        shift, scale = self.final_modulation(time)[:, None, None, :].chunk(2, dim=-1)
        h = F.layer_norm(h.transpose(1, 2), h.shape[-1:]) * (1.0 + scale) + shift
        return self.final(h).float().reshape(shape)
