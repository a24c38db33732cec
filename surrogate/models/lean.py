"""A model's networks as rollouts evaluate them: the same functions and weights, laid out for speed on a CPU.

In a profile of a rollout more than half of the time went into what stands between the products. Here weights are packed
once as the processor multiplies them, halves of queries and keys stand beside each other as complex numbers, which turn
by one multiplication, and a modulation that all rows share is the affine part of the LayerNorm. Results differ from the
plain networks' by rounding alone.
"""

from __future__ import annotations

import copy
import os
import shutil
from typing import TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models.layers import CrossAttentionBlock, KeysValues, ParallelBlock, attend, gelu
from surrogate.models.potential import Potential
from systems.errors import InputError

_Model = TypeVar("_Model", bound=nn.Module)
# Rows that packed weights are laid out for: those of a single replica, where the layout matters most.
_ROWS = 32
# Vectors to read from, up to which products of single heads are too small to be fast.
_FEW = 8


def with_lean_parts(model: _Model) -> _Model:
    """Return a copy for inference on a CPU whose transformer blocks, and layers in bf16, are the lean ones; the model
    itself where it has neither."""
    if not any(map(_has_lean_form, model.modules())):
        return model
    copied = copy.deepcopy(model)
    for parent in list(copied.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, ParallelBlock):
                setattr(parent, name, LeanBlock(child))
            elif isinstance(child, CrossAttentionBlock):
                setattr(parent, name, LeanCrossBlock(child))
            elif isinstance(child, nn.GELU):
                setattr(parent, name, _Gelu())
            elif isinstance(child, nn.Linear) and _has_lean_form(child):
                setattr(parent, name, PackedLinear(child.weight, child.bias))
    return copied


def _has_lean_form(module: nn.Module) -> bool:
    if isinstance(module, nn.Linear):
        return module.weight.dtype == torch.bfloat16
    return isinstance(module, ParallelBlock | CrossAttentionBlock)


class PackedLinear(nn.Module):
    """`torch.nn.Linear`, its weight packed where it is bf16 and torch has oneDNN; elsewhere plain."""

    weight: Tensor
    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.out_features, self.in_features = weight.shape
        self.dtype = weight.dtype
        self.packed = weight.dtype == torch.bfloat16 and _can_pack()
        weight = weight.detach().contiguous()
        packed = torch.ops.mkldnn._reorder_linear_weight(weight, _ROWS) if self.packed else weight
        self.register_buffer("weight", packed, persistent=False)
        self.register_buffer("bias", None if bias is None else bias.detach().contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """`(..., in_features)` of any precision -> `(..., out_features)` in the weight's."""
        if not self.packed:
            return F.linear(x, self.weight, self.bias)
        multiply = torch.ops.mkldnn._linear_pointwise.default
        out: Tensor = multiply(x.to(self.dtype), self.weight, self.bias, "none", [], "")
        return out


class LeanBlock(nn.Module):
    """`layers.ParallelBlock` as it is evaluated; keys that it returns are in its own order of numbers, for itself."""

    offset: Tensor

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
        self.register_buffer("offset", block.offset.detach().clone(), persistent=False)

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


class LeanCrossBlock(nn.Module):
    """`layers.CrossAttentionBlock` as it is evaluated: of few vectors, all heads read in one product."""

    own_head: Tensor

    def __init__(self, block: CrossAttentionBlock) -> None:
        super().__init__()
        self.block = block
        self.register_buffer("own_head", torch.eye(block.n_heads)[None, None, :, :, None], persistent=False)

    def forward(self, x: Tensor, context: Tensor, key_mask: Tensor | None = None) -> Tensor:
        """See `CrossAttentionBlock.forward`; `x` may be one row (1, n, width) for all of the context."""
        block = self.block
        if key_mask is not None or not 1 < context.shape[-2] <= _FEW:
            return cast(Tensor, block(x, context, key_mask))
        normed = block.norm(x)
        k, v = block.kv(context).chunk(2, dim=-1)
        attended = self._read(block.q(normed), k, v)
        if block.gate is not None:
            attended = attended * block.gate(normed)
        x = x + block.out(attended)
        return cast(Tensor, x + block.mlp(x))

    def _read(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        """Queries `(b or 1, n, numbers)`, keys and values `(b, m, numbers)` of all heads -> `(b, n, numbers)`."""
        batch, m, numbers = k.shape
        q = q.expand(batch, -1, -1)
        n_heads = self.block.n_heads
        scores = self._apart(k * (numbers // n_heads) ** -0.5) @ q.transpose(1, 2)
        shares = torch.softmax(scores.view(batch, m, -1), 1, dtype=torch.float32).to(v.dtype)
        return shares.view(batch, m * n_heads, -1).transpose(1, 2) @ self._apart(v)

    def _apart(self, z: Tensor) -> Tensor:
        """`(b, m, numbers)` -> `(b, m heads, numbers)`: a row for each head, all but its own numbers zero."""
        batch, m, numbers = z.shape
        rows = z.view(batch, m, 1, self.block.n_heads, -1) * self.own_head.to(z.dtype)
        return rows.view(batch, -1, numbers)


class _Gelu(nn.Module):
    """`layers.gelu`."""

    def forward(self, x: Tensor) -> Tensor:
        return gelu(x)


def _can_pack() -> bool:
    """Whether this build of torch multiplies packed weights: those for ARM and some others do not."""
    return torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_reorder_linear_weight")


# A model's networks compiled by torch: faster chunks, after a minute of compiling.


def with_compiled_parts(model: _Model) -> _Model:
    """Return a copy whose networks are compiled when they are first called, for arrays of one shape.

    Weights become constants of what is compiled (freezing), which packs them as the processor multiplies them: for a
    single replica an evaluation takes a quarter to a half less time. What torch compiles it keeps on disk for the next
    process. Parts that are not called as a network, such as encoder and decoder, are the lean ones (`models.lean`).
    Raises InputError where there is no C++ compiler.
    """
    if not any(shutil.which(name) for name in (os.environ.get("CXX") or "g++", "clang++")):
        raise InputError("compiling needs a C++ compiler (g++ or clang++), which is not on the PATH; leave it out.")
    copied = copy.deepcopy(model)
    if isinstance(copied, Potential):
        return copied  # what it integrates is compiled as it is
    lists = [child for child in copied.children() if isinstance(child, nn.ModuleList)]
    parents: list[nn.Module] = [copied, *lists]
    for parent in parents:
        for name, child in list(parent.named_children()):
            if type(child).forward is nn.Module.forward and child not in lists:  # it has none
                setattr(parent, name, with_lean_parts(child))
            elif child not in lists:
                setattr(parent, name, torch.compile(child, dynamic=False, options={"freezing": True}))
    return copied
