"""Stage two: the latent flow model, transformer layers alternating over latents and time (Algorithms 4 and 5)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.config import ApproximatorConfig
from surrogate.models.layers import KeysValues, ParallelBlock, TimeEmbedding, rotary_angles
from systems.errors import InputError

Rope = tuple[Tensor, Tensor]
# Keys and values of the conditioning frames, layer by layer.
Memory = list[KeysValues]


class LagEmbedding(nn.Module):
    """How far apart frames are to be: the place of the lag's logarithm in the trained range, in waves long enough that
    between two trained lags nothing but a smooth line can be learned."""

    frequency: Tensor

    def __init__(self, width: int, lag_range_ps: tuple[float, float]) -> None:
        super().__init__()
        self.lag_range_ps = lag_range_ps
        self.register_buffer("frequency", math.pi * torch.tensor([0.5, 1.0, 2.0, 3.0]), persistent=False)
        self.of_lag = nn.Sequential(nn.Linear(9, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, lag_ps: Tensor) -> Tensor:
        """Lags `(b,)` in ps -> `(b, width)`."""
        low, high = (math.log(lag) for lag in self.lag_range_ps)
        place = ((lag_ps.float().log() - low) / max(high - low, 1e-6))[:, None]
        angles = place * self.frequency
        embedded: Tensor = self.of_lag(torch.cat([place, angles.sin(), angles.cos()], dim=-1))
        return embedded


class LatentLayer(nn.Module):
    """Algorithm 5: one parallel block along the latent dimension, one along time. With a single latent vector there is
    nothing to attend to along the first, and its block is left out."""

    def __init__(self, width: int, n_heads: int, n_latents: int) -> None:
        super().__init__()
        self.spatial = ParallelBlock(width, n_heads) if n_latents > 1 else None
        self.temporal = ParallelBlock(width, n_heads)

    def forward(
        self, o: Tensor, modulation: Tensor, rope_latent: Rope, rope_time: Rope, past: KeysValues | None = None
    ) -> tuple[Tensor, KeysValues]:
        """`o` (b, L, T, width), `modulation` (b, 6, width): three for each block; `past` of earlier frames."""
        if self.spatial is not None:
            o = self.spatial(o.transpose(1, 2), modulation[:, :3], rope_latent)[0].transpose(1, 2)
        return self.temporal(o, modulation[:, 3:], rope_time, past)


class Approximator(nn.Module):
    """Data prediction network: noisy latents of a chunk, flow time, conditioning latents -> clean latents."""

    cos_time: Tensor
    sin_time: Tensor
    cos_latent: Tensor
    sin_latent: Tensor

    def __init__(self, config: ApproximatorConfig, n_latents: int, latent_dim: int) -> None:
        super().__init__()
        self.config = c = config
        self.per_token = c.latents_per_token
        if n_latents % self.per_token:
            raise InputError(f"latents_per_token = {self.per_token} does not divide {n_latents} latents.")
        n_latents, latent_dim = n_latents // self.per_token, latent_dim * self.per_token
        self.embed_noisy = nn.Linear(latent_dim, c.width)
        self.embed_conditioning = nn.Linear(latent_dim, c.width)
        self.embed_mask = nn.Embedding(2, c.width)
        self.embed_latent = nn.Parameter(torch.randn(n_latents, c.width) * 0.02)
        self.embed_time = TimeEmbedding(c.width)
        self.layers = nn.ModuleList(LatentLayer(c.width, c.n_heads, n_latents) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = nn.Linear(c.width, latent_dim)
        self.embed_lag = None if c.lag_range_ps is None else LagEmbedding(c.width, c.lag_range_ps)
        if c.n_kinds:
            if c.n_conditioning < 1:
                raise InputError("rare_kinds need a conditioning frame, from which the odds of each kind follow.")
            self.embed_kind = nn.Embedding(c.n_kinds + 1, c.width)
            nn.init.zeros_(self.embed_kind.weight)
            n_in = c.n_conditioning * n_latents * latent_dim
            self.odds = nn.Sequential(nn.Linear(n_in, c.width), nn.SiLU(), nn.Linear(c.width, c.n_kinds + 1))
        for module in (self.modulation, self.final_modulation, self.final):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
        head_dim = c.width // c.n_heads
        for name, length in (("time", c.chunk_frames), ("latent", n_latents)):
            angles = rotary_angles(length, head_dim)
            self.register_buffer(f"cos_{name}", angles.cos(), persistent=False)
            self.register_buffer(f"sin_{name}", angles.sin(), persistent=False)

    @torch.no_grad()
    def set_odds(self, shares: Sequence[float] | npt.NDArray[np.float64]) -> None:
        """Begin with the same odds `shares` (n_kinds + 1,) after every frame."""
        last = self.odds[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        last.bias.copy_(torch.tensor(shares).clamp(min=1e-9).log())

    def kind_logits(self, conditioning: Tensor) -> Tensor:
        """Return the log-odds `(b, n_kinds + 1)` of the kinds of window that may follow; 0 is the ordinary one."""
        with torch.autocast(conditioning.device.type, enabled=False):
            logits: Tensor = self.odds(conditioning.flatten(1).float())
        return logits

    def draw_kinds(self, conditioning: Tensor, noise: Tensor) -> Tensor | None:
        """Return the kind `(b,)` of each window, drawn from its odds by a number of `noise` that nothing else uses.

        The noise `(b, T, L, dim)` of the conditioning frames is replaced by their clean latents. None without kinds.
        """
        if not self.config.n_kinds:
            return None
        uniform = torch.special.ndtr(noise[:, 0, 0, 0].double())
        upper = self.kind_logits(conditioning).double().softmax(-1).cumsum(-1)
        return (uniform[:, None] >= upper).sum(-1).clamp(max=self.config.n_kinds)

    def forward(
        self, o: Tensor, tau: Tensor, conditioning: Tensor, memory: Memory | None = None, kind: Tensor | None = None,
        lag: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """Return the predicted data `(b, T, L, dim)`.

        `o` (b, T, L, dim) noisy latents, `tau` (b,), `conditioning` (b, n_conditioning, L, dim) clean latents of the
        first frames. The first frames of `o` carry no information: they are replaced by the clean ones. With
        `clean_conditioning` they come back as they are, and `memory` is what `remember` said of them, so that the
        evaluations of one chunk compute it once. `kind` (b,) of each window, for a network that knows kinds; `lag`
        (b, width), the embedded lag, for one that takes it.
        """
        c = self.config
        of_kind = None if kind is None else self.embed_kind(kind)[:, None, None, :]
        time = self.embed_time(tau) if lag is None else self.embed_time(tau) + lag
        if c.clean_conditioning:
            known = self.remember(conditioning, lag) if memory is None else memory
            n_known = conditioning.shape[1]
            found = self._denoise(o[:, n_known:], tau, lambda x: self._network_after(x, time, known, n_known, of_kind))
            return torch.cat([conditioning.to(found.dtype), found], dim=1)
        return self._denoise(o, tau, lambda x: self._network(x, time, conditioning, of_kind))

    def remember(self, conditioning: Tensor, lag: Tensor | None = None) -> Memory:
        """Return keys and values of clean frames `(b, n_conditioning, L, dim)`, which see each other alone and no flow
        time but that of the data (tau = 1)."""
        h = self.embed_conditioning(self._tokens(conditioning)) + self.embed_mask.weight[1] + self.embed_latent
        time = self.embed_time(torch.ones(len(h), device=h.device))
        modulation, _ = self._modulations(time if lag is None else time + lag)
        memory: Memory = []
        h = h.transpose(1, 2)
        for layer in self.layers:
            h, kept = layer(h, modulation, *self._ropes(0, conditioning.shape[1]))
            memory.append(kept)
        return memory

    def _denoise(self, o: Tensor, tau: Tensor, network: Callable[[Tensor], Tensor]) -> Tensor:
        c = self.config
        if not c.precondition:
            return network(o)
        skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau, c.interpolant))
        return skip * o + out * network(o * scale_in)

    def _network(self, o: Tensor, time: Tensor, conditioning: Tensor, of_kind: Tensor | None) -> Tensor:
        shape = o.shape
        o, conditioning = self._tokens(o), self._tokens(conditioning)
        n_known, n_frames = conditioning.shape[1], o.shape[1]
        known = torch.zeros(n_frames, dtype=torch.long, device=o.device)
        known[:n_known] = 1
        padded = F.pad(conditioning, (0, 0, 0, 0, 0, n_frames - n_known))
        noisy = torch.where(known[None, :, None, None] == 1, 0.0, o)
        h = self.embed_noisy(noisy) + self.embed_conditioning(padded)
        h = h + self.embed_mask(known)[None, :, None, :] + self.embed_latent
        h = h if of_kind is None else h + of_kind
        return self._transform(h, time, 0, [None] * len(self.layers)).reshape(shape)

    def _network_after(self, o: Tensor, time: Tensor, memory: Memory, n_known: int,
                       of_kind: Tensor | None) -> Tensor:  # fmt: skip
        h = self.embed_noisy(self._tokens(o)) + self.embed_mask.weight[0] + self.embed_latent
        h = h if of_kind is None else h + of_kind
        return self._transform(h, time, n_known, memory).reshape(o.shape)

    def _transform(self, h: Tensor, time: Tensor, first: int, past: Sequence[KeysValues | None]) -> Tensor:
        """Embedded frames `(b, T, L, width)`, of which the first has the place `first`, through all layers."""
        modulation, final_modulation = self._modulations(time)
        ropes = self._ropes(first, h.shape[1])
        h = h.transpose(1, 2)
        for layer, before in zip(self.layers, past, strict=True):
            h, _ = layer(h, modulation, *ropes, before)
        shift, scale = final_modulation[:, None, None, :].chunk(2, dim=-1)
        h = F.layer_norm(h.transpose(1, 2), h.shape[-1:]) * (1.0 + scale) + shift
        return self.final(h).float()

    def _tokens(self, o: Tensor) -> Tensor:
        return o if self.per_token == 1 else o.unflatten(2, (-1, self.per_token)).flatten(-2)

    def _modulations(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """From the embedded flow time `(b, width)`, lag included where the network takes it."""
        time = F.silu(time)
        return self.modulation(time).unflatten(-1, (6, -1)), self.final_modulation(time)

    def _ropes(self, first: int, n_frames: int) -> tuple[Rope, Rope]:
        frames = slice(first, first + n_frames)
        return (self.cos_latent, self.sin_latent), (self.cos_time[frames], self.sin_time[frames])
