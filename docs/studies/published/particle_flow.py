"""LaM-SLidE's second stage with particles as their own latents: nothing is coded, so nothing of a frame is lost.

What a particle will do is one token (or a few, each of some frames); tokens of a system see each other by attention
and, beyond the paper, by messages along pairs. Particles permuted give forecasts permuted.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from particle_models import N_PAIR_KINDS
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.layers import ParallelBlock, TimeEmbedding, rotary_angles
from systems.errors import InputError

# Widths about which a pair's inverse distances are softened, in the unit of the positions.
_SOFT = 0.1
# Numbers of a pair: difference of positions and of velocities, functions of the distance; and of each kind: whether it
# is of it, and its field.
_N_PAIR_NUMBERS, _N_KIND_NUMBERS = 10, 4


@dataclass(frozen=True)
class ParticleFlowConfig:
    """`n_features` of a particle's given frames, of which the first three are its last position and the next three its
    last step. `frames_per_token`: predicted frames of a particle joined in one token, 1 as in the paper; fewer tokens
    cost less. `pair_messages`: beyond the paper, layers that pass messages along pairs."""

    n_features: int
    n_types: int = 3
    n_pair_kinds: int = N_PAIR_KINDS
    n_new: int = 20
    frames_per_token: int = 20
    width: int = 128
    n_layers: int = 4
    n_heads: int = 4
    pair_messages: bool = True

    def __post_init__(self) -> None:
        if self.n_new % self.frames_per_token:
            raise InputError(f"frames_per_token = {self.frames_per_token} does not divide {self.n_new} frames.")


@dataclass(frozen=True, eq=False)
class Given:
    """What is known of systems of n particles: `features` (b, n, n_features) of their given frames, `types` (b, n) and
    `pairs` (b, n, n), the kinds of particles and of pairs."""

    features: Tensor
    types: Tensor
    pairs: Tensor

    def to(self, device: torch.device) -> Given:
        return Given(self.features.to(device), self.types.to(device), self.pairs.to(device))

    def rows(self, which: slice) -> Given:
        return Given(self.features[which], self.types[which], self.pairs[which])


class PairMessages(nn.Module):
    """h_i += W mean_j silu(A h_i + B h_j + C e_ij): messages along all pairs, whose last map starts at zero."""

    def __init__(self, width: int, pair_width: int) -> None:
        super().__init__()
        self.width = width
        self.of_ends = nn.Linear(width, 2 * width)
        self.of_pair = nn.Linear(pair_width, width)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, h: Tensor, pairs: Tensor) -> Tensor:
        """`h` (b, P, n, width), `pairs` (b, n, n, pair_width)."""
        receiver, sender = self.of_ends(F.layer_norm(h, (self.width,))).chunk(2, dim=-1)
        message = F.silu(receiver.unsqueeze(-2) + sender.unsqueeze(-3) + self.of_pair(pairs)[:, None])
        return h + self.out(message.mean(-2))


class ParticleLayer(nn.Module):
    """Algorithm 5: attention among the particles, then, where each has several tokens, along time."""

    def __init__(self, config: ParticleFlowConfig, pair_width: int) -> None:
        super().__init__()
        c = config
        self.spatial = ParallelBlock(c.width, c.n_heads)
        self.messages = PairMessages(c.width, pair_width) if c.pair_messages else None
        self.temporal = ParallelBlock(c.width, c.n_heads) if c.frames_per_token < c.n_new else None

    def forward(self, h: Tensor, modulation: Tensor, pairs: Tensor | None, rope: tuple[Tensor, Tensor]) -> Tensor:
        """`h` (b, P, n, width) of P tokens a particle, `modulation` (b, 6, width)."""
        h = self.spatial(h, modulation[:, :3], None)[0]
        if self.messages is not None and pairs is not None:
            h = self.messages(h, pairs)
        if self.temporal is not None:
            h = self.temporal(h.transpose(1, 2), modulation[:, 3:], rope)[0].transpose(1, 2)
        return h


class ParticleFlow(nn.Module):
    """Data prediction network (eq. 9): noisy frames to come, flow time, what is known -> these frames."""

    cos_time: Tensor
    sin_time: Tensor

    def __init__(self, config: ParticleFlowConfig) -> None:
        super().__init__()
        self.config = c = config
        self.n_tokens, n_out, pair_width = c.n_new // c.frames_per_token, 3 * c.frames_per_token, c.width // 2
        self.embed_given = nn.Linear(c.n_features, c.width)
        self.embed_type = nn.Embedding(c.n_types, c.width)
        self.embed_noisy = nn.Linear(n_out, c.width)
        self.embed_place = nn.Parameter(torch.randn(self.n_tokens, 1, c.width) * 0.02)
        self.embed_time = TimeEmbedding(c.width)
        self.embed_pairs: nn.Sequential | None = None
        if c.pair_messages:
            self.embed_pairs = nn.Sequential(
                nn.Linear(_N_PAIR_NUMBERS + _N_KIND_NUMBERS * c.n_pair_kinds, pair_width),
                nn.SiLU(),
                nn.Linear(pair_width, pair_width),
            )
        self.layers = nn.ModuleList(ParticleLayer(c, pair_width) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = nn.Linear(c.width, n_out)
        for module in (self.modulation, self.final_modulation, self.final):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
        angles = rotary_angles(self.n_tokens, c.width // c.n_heads)
        self.register_buffer("cos_time", angles.cos(), persistent=False)
        self.register_buffer("sin_time", angles.sin(), persistent=False)

    def forward(self, noisy: Tensor, tau: Tensor, given: Given) -> Tensor:
        """`noisy` (b, n, n_new, 3), flow times `tau` (b,) or (1,) -> frames `(b, n, n_new, 3)`."""
        b, n = noisy.shape[:2]
        # Given frames stay in float32: bf16 would round away the changes of velocity that tell forces.
        with torch.autocast(noisy.device.type, enabled=False):
            known = self.embed_given(given.features) + self.embed_type(given.types)
            pairs = (
                None if self.embed_pairs is None else self.embed_pairs(pair_numbers(given, self.config.n_pair_kinds))
            )
        tokens = noisy.reshape(b, n, self.n_tokens, -1).transpose(1, 2)
        h = self.embed_noisy(tokens) + known[:, None] + self.embed_place
        time = F.silu(self.embed_time(tau))
        modulation = self.modulation(time).unflatten(-1, (6, -1))
        for layer in self.layers:
            h = layer(h, modulation, pairs, (self.cos_time, self.sin_time))
        shift, scale = self.final_modulation(time)[:, None, None].chunk(2, dim=-1)
        h = F.layer_norm(h, h.shape[-1:]) * (1.0 + scale) + shift
        return self.final(h).float().transpose(1, 2).reshape(noisy.shape)


def pair_numbers(given: Given, n_kinds: int) -> Tensor:
    """Return what a pair's message is made of, `(b, n, n, n_numbers)`: differences of last positions and steps,
    its kind, an inverse square field of each kind, and functions of the distance."""
    x, step = given.features[..., :3], given.features[..., 3:6]
    apart, passing = x[:, :, None] - x[:, None], step[:, :, None] - step[:, None]
    r = (apart.square().sum(-1, keepdim=True) + 1e-4).sqrt()
    kind = F.one_hot(given.pairs, n_kinds).to(x.dtype)
    toward = apart / r
    field = toward / (r.square() + 0.5 * _SOFT)
    fields = (kind[..., None] * field[..., None, :]).flatten(-2)
    near = 1.0 / (r + _SOFT)
    closing = (passing * toward).sum(-1, keepdim=True)
    return torch.cat([apart, passing, kind, fields, r, near, near.square(), closing], dim=-1)
