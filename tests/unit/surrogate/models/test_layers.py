"""Layers and the latent flow network: what is written for speed equals the plain form."""

from __future__ import annotations

import pytest
import torch
from plain_network import plain_network
from torch.nn import functional as F

from surrogate.models.lam_slide.model import Approximator, ApproximatorConfig
from surrogate.models.layers import attend, gelu, rotary_angles, rotate


@pytest.mark.parametrize("masked", [False, True])
def test_attention_equals_torchs(masked: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    q, k, v = (torch.randn(3, 2, n, 8, generator=generator) for n in (5, 7, 7))
    mask = torch.rand(3, 1, 1, 7, generator=generator) < 0.6 if masked else None
    if mask is not None:
        mask[..., 0] = True
    expected = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    torch.testing.assert_close(attend(q, k, v, mask), expected, rtol=0, atol=1e-6)
    # Negative controls: keys matter, and so does the mask.
    assert (attend(q, k.flip(-1), v, mask) - expected).abs().max() > 1e-2
    if masked:
        assert (attend(q, k, v) - expected).abs().max() > 1e-2


def test_rotation_is_that_of_complex_numbers() -> None:
    x = torch.randn(4, 6, generator=torch.Generator().manual_seed(1))
    angles = rotary_angles(4, 6)
    turned = torch.complex(x[:, :3], x[:, 3:]) * torch.polar(torch.ones_like(angles), angles)
    expected = torch.cat([turned.real, turned.imag], dim=-1)
    torch.testing.assert_close(rotate(x, angles.cos(), angles.sin()), expected, rtol=0, atol=1e-6)
    assert (rotate(x, angles.cos(), -angles.sin()) - expected).abs().max() > 0.1


def test_gelu_in_bf16_differs_by_rounding_alone() -> None:
    x = torch.linspace(-6, 6, 2001)
    rounded = x.bfloat16()
    tanh = F.gelu(rounded.float(), approximate="tanh")
    assert torch.equal(gelu(x), F.gelu(x, approximate="tanh"))
    assert (gelu(rounded).float() - tanh).abs().max() <= 5e-4 + 2**-8 * tanh.abs().max()
    assert (F.relu(rounded).float() - tanh).abs().max() > 0.1


def network(*, clean: bool) -> tuple[Approximator, torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    config = ApproximatorConfig(chunk_frames=7, n_conditioning=3, latents_per_token=1, width=32, n_layers=3, n_heads=2,
                                clean_conditioning=clean)  # fmt: skip
    model = Approximator(config, n_latents=4, latent_dim=8).eval().requires_grad_(False)
    for p in model.parameters():
        if not p.abs().max() > 0:
            p.normal_(std=0.2)
    o = torch.randn(2, 7, 4, 8)
    return model, o, torch.tensor([0.2, 0.7]), torch.randn(2, 3, 4, 8)


def test_the_network_equals_the_plain_program() -> None:
    model, o, tau, known = network(clean=False)
    expected = plain_network(model, o, tau, known)
    torch.testing.assert_close(model(o, tau, known), expected, rtol=0, atol=2e-6)
    # Negative controls: every input matters.
    for changed in ((o.flip(0), tau, known), (o, tau.flip(0), known), (o, tau, known.flip(1))):
        assert (model(*changed) - expected).abs().max() > 1e-2


def test_clean_conditioning_is_computed_once() -> None:
    model, o, tau, known = network(clean=True)
    fresh = model(o, tau, known)
    memory = model.remember(known)
    assert torch.equal(model(o, tau, known, memory), fresh)
    assert torch.equal(fresh[:, :3], known)
    # The memory says the same at every flow time, and is what the new frames see of the known ones.
    torch.testing.assert_close(model(o, tau.flip(0), known, memory), model(o, tau.flip(0), known), rtol=0, atol=0)
    assert (model(o, tau, known, model.remember(known.flip(1)))[:, 3:] - fresh[:, 3:]).abs().max() > 1e-3
    # What stands in the known frames' places of the noisy chunk is not looked at.
    blind = o.clone()
    blind[:, :3] = 100.0
    assert torch.equal(model(blind, tau, known), fresh)
    assert not torch.equal(network(clean=False)[0](o, tau, known)[:, 3:], fresh[:, 3:])
