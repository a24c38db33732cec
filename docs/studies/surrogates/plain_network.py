"""LaM-SLidE's latent flow network (Algorithms 4 and 5, Figure 6) in plain PyTorch: what ours is timed against.

It computes the same function from the same tensors, line by line after the paper: rearranged copies for the two axes,
own projections for queries, keys, values and the MLP, torch's attention, everything in the precision it is given.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.model import Approximator, LatentLayer
from surrogate.models.layers import ParallelBlock


def plain_network(network: Approximator, o: Tensor, tau: Tensor, conditioning: Tensor) -> Tensor:
    """Return what `network(o, tau, conditioning)` does; one latent vector per token."""
    skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau))
    n_known, n_frames = conditioning.shape[1], o.shape[1]
    mask = (torch.arange(n_frames) < n_known).long()
    padded = torch.cat([conditioning, conditioning.new_zeros(o[:, n_known:].shape)], dim=1)
    noisy = torch.cat([torch.zeros_like(conditioning), o[:, n_known:] * scale_in], dim=1)
    h = network.embed_noisy(noisy) + network.embed_conditioning(padded)
    h = h + network.embed_mask(mask)[None, :, None] + network.embed_latent
    time = F.silu(network.embed_time(tau))
    modulation = network.modulation(time).unflatten(-1, (6, -1))
    batch, _, n_latents, width = h.shape
    for layer in network.layers:
        assert isinstance(layer, LatentLayer) and layer.spatial is not None
        h = h.reshape(batch * n_frames, n_latents, width)
        h = plain_block(layer.spatial, h, modulation[:, :3], network.cos_latent, network.sin_latent)
        h = h.reshape(batch, n_frames, n_latents, width).transpose(1, 2).reshape(batch * n_latents, n_frames, width)
        h = plain_block(layer.temporal, h, modulation[:, 3:], network.cos_time[:n_frames], network.sin_time[:n_frames])
        h = h.reshape(batch, n_latents, n_frames, width).transpose(1, 2)
    shift, scale = network.final_modulation(time)[:, None, None].chunk(2, dim=-1)
    found = network.final(F.layer_norm(h, (width,)) * (1.0 + scale) + shift)
    return skip * o + out * found if network.config.precondition else found


def plain_block(block: ParallelBlock, x: Tensor, modulation: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """One ParallelMLP block along the middle axis of `x` (rows, length, width); `modulation` (batch, 3, width)."""
    repeats = x.shape[0] // modulation.shape[0]
    shift, scale, gate = (modulation + block.offset).repeat_interleave(repeats, 0)[:, :, None].unbind(1)
    h = F.layer_norm(x, (block.width,)) * (1.0 + scale) + shift
    w, width = block.proj_in, block.width
    parts = zip(w.weight.split([width] * 3 + [block.hidden]), w.bias.split([width] * 3 + [block.hidden]), strict=True)
    q, k, v, hidden = (F.linear(h, weight, bias) for weight, bias in parts)
    q, k, v = (t.unflatten(-1, (block.n_heads, -1)).transpose(1, 2) for t in (q, k, v))
    q, k = (plain_rotation(plain_norm(t), cos, sin) for t in (q, k))
    attended = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
    return x + gate * (block.attention_out(attended) + block.mlp_out(F.gelu(hidden, approximate="tanh")))


def plain_norm(x: Tensor) -> Tensor:
    return x / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt()


def plain_rotation(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    first, second = x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)
