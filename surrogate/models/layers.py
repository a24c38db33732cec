"""Attention blocks, positional encodings and Fourier features shared by the surrogates, and the blocks as rollouts
evaluate them."""

from __future__ import annotations

import copy
import math
from typing import TypeVar, cast

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


def rotary_angles(length: int, head_dim: int) -> Tensor:
    """Return RoPE rotation angles `(length, head_dim / 2)` (Su 2021)."""
    frequency = 10_000.0 ** (-torch.arange(0, head_dim, 2, dtype=torch.float32) / head_dim)
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


def attend(q: Tensor, k: Tensor, v: Tensor, bias: Tensor | None = None) -> Tensor:
    """Softmax attention: queries `(..., n, head_dim)`, keys and values `(..., m, head_dim)`; `bias` is added to the
    scores.

    On a CPU the plain products are preferred for short sequences, as in a chunk of 32 frames: torch's fused kernel was
    the largest item in a profile of training.
    """
    if q.device.type != "cpu" or k.shape[-2] > _SHORT:
        return F.scaled_dot_product_attention(q, k, v, attn_mask=bias)
    q, k, v = q.contiguous(), k.contiguous(), v.contiguous()
    scores = (q @ k.transpose(-1, -2)) * q.shape[-1] ** -0.5
    if bias is not None:
        scores = scores + bias
    # Rows that are no multiple of 32 take five times as long in bf16.
    return torch.softmax(scores, -1, dtype=torch.float32).to(v.dtype) @ v


class TimeEmbedding(nn.Module):
    """Sinusoidal embedding of the flow time in [0, 1] followed by a two-layer MLP: `(batch,)` -> `(batch, width)`."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.frequency = nn.Buffer(torch.exp(torch.linspace(0.0, math.log(1000.0), 64)))
        self.net = nn.Sequential(nn.Linear(2 * 64, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, tau: Tensor) -> Tensor:
        angles = tau.float()[:, None] * self.frequency
        return self.net(torch.cat([angles.sin(), angles.cos()], dim=-1))


class ParallelBlock(nn.Module):
    """Attention and MLP in parallel from one adaLN-modulated input (Dehghani 2023; LaM-SLidE, Figure 6).

    One fused input projection gives queries, keys, values and the MLP's hidden layer. QK-normalisation and RoPE. The
    modulation is shared by all layers but for a learned offset (adaLN-single, Chen 2023), which keeps shipped weights
    small; the gate's offset starts at zero, so a fresh block is the identity.
    """

    def __init__(self, width: int, n_heads: int) -> None:
        super().__init__()
        if width % n_heads or (width // n_heads) % 2:
            raise ValueError(f"width {width} does not split into {n_heads} heads of even size")
        self.n_heads, self.width, self.hidden = n_heads, width, 4 * width
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

    def __init__(self, width: int, context: int, n_heads: int, head_dim: int, *, gated: bool = False) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.gate = nn.Linear(width, n_heads * head_dim) if gated else None
        self.norm = nn.LayerNorm(width)
        self.q = nn.Linear(width, n_heads * head_dim)
        self.kv = nn.Linear(context, 2 * n_heads * head_dim)
        self.out = nn.Linear(n_heads * head_dim, width)
        wide = (nn.Linear(width, 4 * width), nn.GELU(approximate="tanh"), nn.Linear(4 * width, width))
        self.mlp = nn.Sequential(nn.LayerNorm(width), *wide)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        normed = self.norm(x)
        k, v = self.kv(context).chunk(2, dim=-1)
        if context.shape[-2] == 1:
            attended = v  # attention over a single key returns its value
        else:
            split = lambda t: t.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)  # noqa: E731
            attended = attend(split(self.q(normed)), split(k), split(v)).transpose(1, 2).flatten(-2)
        if self.gate is not None:
            attended = attended * self.gate(normed)
        x = x + self.out(attended)
        return x + self.mlp(x)


# The blocks as rollouts evaluate them: the same functions and weights, laid out for speed on a CPU. In a profile of a
# rollout more than half of the time went into what stands between the products. Here weights are packed once as the
# processor multiplies them, halves of queries and keys are paired as complex numbers, which turn by one
# multiplication, and a modulation that all rows share is the affine part of the LayerNorm. Results differ from the
# plain networks' by rounding alone.

_Model = TypeVar("_Model", bound=nn.Module)
# Rows that packed weights are laid out for: those of a single replica, where the layout matters most.
_ROWS = 32


def with_lean_parts(model: _Model) -> _Model:
    """Return a copy for inference on a CPU whose transformer blocks, and layers in bf16, are the lean ones; the model
    itself where it has neither."""
    if not any(isinstance(m, ParallelBlock) or _is_bf16(m) for m in model.modules()):
        return model
    copied = copy.deepcopy(model)
    for parent in list(copied.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, ParallelBlock):
                setattr(parent, name, LeanBlock(child))
            elif isinstance(child, nn.GELU):
                setattr(parent, name, _Gelu())
            elif isinstance(child, nn.Linear) and _is_bf16(child):
                setattr(parent, name, PackedLinear(child.weight, child.bias))
    return copied


def _is_bf16(module: nn.Module) -> bool:
    return isinstance(module, nn.Linear) and module.weight.dtype == torch.bfloat16


def _can_pack() -> bool:
    """True where packed weights in bf16 are multiplied: not by builds of torch for ARM and some others, nor by
    processors without AVX-512."""
    mkldnn = torch.ops.mkldnn
    can = torch.backends.mkldnn.is_available() and hasattr(mkldnn, "_reorder_linear_weight")
    return can and bool(mkldnn._is_mkldnn_bf16_supported())


class PackedLinear(nn.Module):
    """`torch.nn.Linear`, its weight packed where it is bf16 and that is multiplied; elsewhere plain."""

    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.dtype = weight.dtype
        self.packed = weight.dtype == torch.bfloat16 and _can_pack()
        weight = weight.detach().contiguous()
        packed = torch.ops.mkldnn._reorder_linear_weight(weight, _ROWS) if self.packed else weight
        self.weight = nn.Buffer(packed, persistent=False)
        self.register_buffer("bias", None if bias is None else bias.detach().contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """`(..., n_in)` of any precision -> `(..., n_out)` in the weight's."""
        if not self.packed:
            return F.linear(x.to(self.dtype), self.weight, self.bias)
        multiply = torch.ops.mkldnn._linear_pointwise.default
        return cast(Tensor, multiply(x.to(self.dtype), self.weight, self.bias, "none", [], ""))


class LeanBlock(nn.Module):
    """`ParallelBlock` as it is evaluated; keys that it returns are in its own order of numbers, for itself."""

    def __init__(self, block: ParallelBlock) -> None:
        super().__init__()
        self.n_heads, self.width, self.hidden = block.n_heads, block.width, block.hidden
        w, head_dim = block.width, block.width // block.n_heads
        # Halves a, b of each head's queries and keys as pairs (a_k, b_k).
        pairs = torch.arange(2 * w).reshape(-1, 2, head_dim // 2).transpose(1, 2).flatten()
        weight, bias = block.proj_in.weight, block.proj_in.bias
        self.dtype = weight.dtype
        order = torch.cat([pairs, torch.arange(2 * w, len(weight))])
        self.proj_in = PackedLinear(weight[order], bias[order])
        self.attention_out = PackedLinear(block.attention_out.weight, None)
        self.mlp_out = PackedLinear(block.mlp_out.weight, block.mlp_out.bias)
        self.offset = nn.Buffer(block.offset.detach().clone(), persistent=False)

    def forward(
        self, x: Tensor, modulation: Tensor, rope: tuple[Tensor, Tensor] | None, past: KeysValues | None = None,
        bias: Tensor | None = None,
    ) -> tuple[Tensor, KeysValues]:  # fmt: skip
        """See `ParallelBlock.forward`; a `modulation` (1, 3, width) holds for all rows."""
        batch, groups, length, width = x.shape
        shift, scale, gate = (modulation.float() + self.offset).unbind(-2)
        if len(modulation) == 1:
            h = F.layer_norm(x, (width,), 1.0 + scale[0], shift[0]).to(self.dtype)
        else:
            normed = F.layer_norm(x, (width,))
            h = torch.addcmul(shift[:, None, None], normed, 1.0 + scale[:, None, None]).to(self.dtype)
        qk, v, hidden = self.proj_in(h).split([2 * width, width, self.hidden], dim=-1)
        q, k = self._turned(qk.float().view(batch * groups, length, 2 * self.n_heads, -1), rope)
        v = v.reshape(batch * groups, length, self.n_heads, -1).transpose(1, 2).contiguous()
        if past is not None:
            k, v = (torch.cat([old, new], dim=2) for old, new in zip(past, (k, v), strict=True))
        attended = attend(q, k, v, None if bias is None else bias.to(v.dtype))
        attended = attended.transpose(1, 2).reshape(x.shape)
        update = self.mlp_out(gelu(hidden)).add_(self.attention_out(attended))
        return torch.addcmul(x, gate[:, None, None], update), (k, v)

    def _turned(self, qk: Tensor, rope: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """Queries and keys `(rows, length, 2 heads, head_dim)` -> both `(rows, heads, length, head_dim)`, of unit
        size and turned."""
        rows, length, _, head_dim = qk.shape
        size = (torch.linalg.vector_norm(qk, dim=-1, keepdim=True).square_() / head_dim + 1e-6).rsqrt_()
        if rope is not None:
            pairs = torch.view_as_complex(qk.view(rows, length, 2 * self.n_heads, -1, 2))
            qk = torch.view_as_real(pairs * torch.complex(*rope)[:, None])
        qk = qk.view(rows, length, 2, self.n_heads, head_dim) * size.view(rows, length, 2, self.n_heads, 1)
        out = torch.empty(2, rows, self.n_heads, length, head_dim, dtype=self.dtype, device=qk.device)
        out.copy_(qk.permute(2, 0, 3, 1, 4))
        return cast(tuple[Tensor, Tensor], out.unbind(0))


class _Gelu(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return gelu(x)
