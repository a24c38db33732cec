"""Attention blocks, positional encodings and Fourier features shared by the surrogates."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# Keys and values of a block, each (rows, heads, length, head_dim).
KeysValues = tuple[Tensor, Tensor]
# Keys up to which `attend` writes the products out.
_SHORT = 128


def fourier_features(x: Tensor, n_octaves: int) -> Tensor:
    """Return x with sin and cos of 2^k pi x, k = 0..n_octaves-1: `(..., d)` -> `(..., d * (1 + 2 * n_octaves))`.

    Always float32: in bf16 the fifth octave is already noise.
    """
    with torch.autocast(x.device.type, enabled=False):
        x = x.float()
        scale = math.pi * 2.0 ** torch.arange(n_octaves, device=x.device, dtype=torch.float32)
        angles = (x.unsqueeze(-1) * scale).flatten(-2)
        return torch.cat([x, angles.sin(), angles.cos()], dim=-1)


def rotary_angles(length: int, head_dim: int, *, base: float = 10_000.0) -> Tensor:
    """Return RoPE rotation angles `(length, head_dim / 2)` (Su 2021)."""
    frequency = base ** (-torch.arange(0, head_dim, 2, dtype=torch.float32) / head_dim)
    return torch.arange(length, dtype=torch.float32)[:, None] * frequency[None, :]


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Apply RoPE to `(..., head_dim)` with cos and sin `(..., head_dim / 2)`: halves a, b turn by the angle."""
    cos = torch.cat([cos, cos], dim=-1)
    sin = torch.cat([-sin, sin], dim=-1)
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)


def gelu(x: Tensor) -> Tensor:
    """GELU: by tanh in float32; exactly in bf16, where the two forms differ by less than the rounding (5e-4 against
    2e-3) and the exact one takes a fifth of the time on a CPU, given contiguous numbers."""
    return F.gelu(x.contiguous()) if x.dtype == torch.bfloat16 else F.gelu(x, approximate="tanh")


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """Softmax attention: queries `(..., n, head_dim)`, keys and values `(..., m, head_dim)`; `mask` True where allowed,
    or numbers that are added to the scores.

    On a CPU the plain products are preferred for short sequences, as in a chunk of 32 frames: torch's fused kernel was
    the largest item in a profile of training.
    """
    if q.device.type != "cpu" or k.shape[-2] > _SHORT:
        return F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    q, k, v = q.contiguous(), k.contiguous(), v.contiguous()
    scores = (q @ k.transpose(-1, -2)) * q.shape[-1] ** -0.5
    if mask is not None:
        scores = scores.masked_fill(~mask, -math.inf) if mask.dtype == torch.bool else scores + mask
    # Rows that are no multiple of 32 take five times as long in bf16.
    return torch.softmax(scores, -1, dtype=torch.float32).to(v.dtype) @ v


class TimeEmbedding(nn.Module):
    """Sinusoidal embedding of the flow time in [0, 1] followed by a two-layer MLP: `(batch,)` -> `(batch, width)`."""

    frequency: Tensor

    def __init__(self, width: int, n_frequencies: int = 64) -> None:
        super().__init__()
        self.register_buffer("frequency", torch.exp(torch.linspace(0.0, math.log(1000.0), n_frequencies)))
        self.net = nn.Sequential(nn.Linear(2 * n_frequencies, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, tau: Tensor) -> Tensor:
        angles = tau.float()[:, None] * self.frequency
        return self.net(torch.cat([angles.sin(), angles.cos()], dim=-1))


class ParallelBlock(nn.Module):
    """Attention and MLP in parallel from one adaLN-modulated input (Dehghani 2023; LaM-SLidE, Figure 6).

    One fused input projection gives queries, keys, values and the MLP's hidden layer. QK-normalisation and RoPE. The
    modulation is shared by all layers but for a learned offset (adaLN-single, Chen 2023), which keeps shipped weights
    small; the gate's offset starts at zero, so a fresh block is the identity.
    """

    def __init__(self, width: int, n_heads: int, mlp_ratio: int = 4) -> None:
        super().__init__()
        if width % n_heads or (width // n_heads) % 2:
            raise ValueError(f"width {width} does not split into {n_heads} heads of even size")
        self.n_heads, self.width, self.hidden = n_heads, width, mlp_ratio * width
        self.proj_in = nn.Linear(width, 3 * width + self.hidden)
        self.attention_out = nn.Linear(width, width, bias=False)
        self.mlp_out = nn.Linear(self.hidden, width)
        self.offset = nn.Parameter(torch.zeros(3, width))

    def forward(
        self, x: Tensor, modulation: Tensor, rope: tuple[Tensor, Tensor] | None, past: KeysValues | None = None,
        bias: Tensor | None = None,
    ) -> tuple[Tensor, KeysValues]:  # fmt: skip
        """`x` (batch, groups, length, width), attention over length; `modulation` (batch, 3, width).

        `past`: keys and values that stand before those of `x`, as an earlier call returned them. `bias` (n_heads,
        length, length) is added to the scores.
        """
        shift, scale, gate = (modulation + self.offset)[:, None, None].unbind(-2)
        h = torch.addcmul(shift, F.layer_norm(x, (self.width,)).to(shift.dtype), 1.0 + scale)
        qk, v, hidden = self.proj_in(h).split([2 * self.width, self.width, self.hidden], dim=-1)
        batch, groups, length, _ = x.shape
        # Element by element float32 is faster on a CPU than bf16, and queries and keys go through it together.
        qk = normalise(qk.float().reshape(batch * groups, length, 2 * self.n_heads, -1))
        if rope is not None:
            qk = rotate(qk, *(angles[:, None] for angles in rope))
        q, k = qk.to(v.dtype).transpose(1, 2).chunk(2, dim=1)
        v = v.reshape(batch * groups, length, self.n_heads, -1).transpose(1, 2)
        if past is not None:
            k, v = (torch.cat([old, new], dim=2) for old, new in zip(past, (k, v), strict=True))
        attended = attend(q, k, v, None if bias is None else bias.to(v.dtype))
        attended = attended.transpose(1, 2).reshape(batch, groups, length, self.width)
        update = self.attention_out(attended) + self.mlp_out(gelu(hidden))
        return x + gate * update, (k, v)


def normalise(x: Tensor) -> Tensor:
    """RMS-normalise the last dimension."""
    return x * (x.square().mean(-1, keepdim=True) + 1e-6).rsqrt()


class CrossAttentionBlock(nn.Module):
    """Pre-norm cross-attention and feed-forward: queries `(b, n, width)` read from a context `(b, m, context)`.

    With `gated`, what a query reads is multiplied by a gate computed from the query. Softmax attention selects among
    context vectors; when there are few of them, only a gate lets each query read its own components of one vector.
    """

    def __init__(
        self, width: int, context: int, n_heads: int, head_dim: int, mlp_ratio: int = 4, *, gated: bool = False
    ) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.gate = nn.Linear(width, n_heads * head_dim) if gated else None
        self.norm = nn.LayerNorm(width)
        self.q = nn.Linear(width, n_heads * head_dim)
        self.kv = nn.Linear(context, 2 * n_heads * head_dim)
        self.out = nn.Linear(n_heads * head_dim, width)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, mlp_ratio * width),
            nn.GELU(approximate="tanh"),
            nn.Linear(mlp_ratio * width, width),
        )

    def forward(self, x: Tensor, context: Tensor, key_mask: Tensor | None = None) -> Tensor:
        """`key_mask` (b, m) is True where the context holds a real entity."""
        normed = self.norm(x)
        k, v = self.kv(context).chunk(2, dim=-1)
        if context.shape[-2] == 1 and key_mask is None:
            attended = v  # attention over a single key returns its value
        else:
            split = lambda t: t.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)  # noqa: E731
            mask = None if key_mask is None else key_mask[:, None, None, :]
            attended = attend(split(self.q(normed)), split(k), split(v), mask)
            attended = attended.transpose(1, 2).flatten(-2)
        if self.gate is not None:
            attended = attended * self.gate(normed)
        x = x + self.out(attended)
        return x + self.mlp(x)
