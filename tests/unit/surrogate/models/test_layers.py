"""Blocks of the networks against torch's own functions, and as rollouts evaluate them."""

from __future__ import annotations

import copy
import platform
import sys

import pytest
import torch
from plain_network import plain_network
from torch import nn
from torch.nn import functional as F

from surrogate.models.architecture import weights_path
from surrogate.models.lam_slide.model import Approximator, ApproximatorConfig
from surrogate.models.layers import (
    LeanBlock,
    PackedLinear,
    ParallelBlock,
    attend,
    gelu,
    rotary_angles,
    rotate,
    with_lean_parts,
)
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler, with_bf16_weights
from surrogate.training.devices import keep_freed_memory


@pytest.mark.parametrize("biased", [False, True])
def test_attention_equals_torchs(biased: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    q, k, v = (torch.randn(3, 2, n, 8, generator=generator) for n in (5, 7, 7))
    bias = torch.randn(3, 1, 1, 7, generator=generator) if biased else None
    expected = F.scaled_dot_product_attention(q, k, v, attn_mask=bias)
    torch.testing.assert_close(attend(q, k, v, bias), expected, rtol=0, atol=1e-6)
    # Negative controls: keys matter, and so does the bias.
    assert (attend(q, k.flip(-1), v, bias) - expected).abs().max() > 1e-2
    if biased:
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


WIDTH, HEADS, LENGTH = 32, 2, 5


def block(seed: int = 0) -> ParallelBlock:
    torch.manual_seed(seed)
    found = ParallelBlock(WIDTH, HEADS)
    for parameter in found.parameters():
        nn.init.normal_(parameter, std=0.3)
    return found.eval()


def rope() -> tuple[torch.Tensor, torch.Tensor]:
    angles = rotary_angles(LENGTH, WIDTH // HEADS)
    return angles.cos(), angles.sin()


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("places", ["turned", "biased", "after others"])
@torch.inference_mode()
def test_a_lean_block_is_the_block(shared: bool, places: str) -> None:
    plain = block()
    lean = LeanBlock(plain)
    x, modulation = torch.randn(3, 2, LENGTH, WIDTH), torch.randn(1 if shared else 3, 3, WIDTH)
    if places == "biased":
        bias = torch.randn(HEADS, LENGTH, LENGTH)
        wanted, found = (one(x, modulation, None, bias=bias)[0] for one in (plain, lean))
    elif places == "turned":
        wanted, found = (one(x, modulation, rope())[0] for one in (plain, lean))
    else:
        wanted, found = (one(x, modulation, rope(), one(x.flip(0), modulation, rope())[1])[0] for one in (plain, lean))
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)
    # Halves of the heads that do not stand beside each other: another network.
    lean.proj_in.weight.copy_(plain.proj_in.weight)
    assert places == "biased" or not torch.allclose(lean(x, modulation, rope())[0], plain(x, modulation, rope())[0])


@torch.inference_mode()
def test_bf16_layers_are_packed_and_float32_ones_left() -> None:
    model = nn.ModuleDict({"rounded": nn.Linear(24, 40), "exact": nn.Linear(24, 40)})
    model["rounded"].bfloat16()
    lean = with_lean_parts(model)
    assert isinstance(lean["rounded"], PackedLinear)
    assert type(lean["exact"]) is nn.Linear
    x = torch.randn(7, 2, 24)
    wanted = nn.functional.linear(x.bfloat16(), model["rounded"].weight, model["rounded"].bias)
    torch.testing.assert_close(lean["rounded"](x), wanted, rtol=1e-2, atol=1e-2)
    assert with_lean_parts(nn.Sequential(nn.Linear(2, 2))).__class__ is nn.Sequential


def test_a_model_without_such_parts_is_taken_as_it_is() -> None:
    model = nn.Sequential(nn.Linear(4, 4))
    assert with_lean_parts(model) is model


@pytest.mark.parametrize(("precision", "tolerance_nm"), [("fp32", 2e-5), ("bf16", 4e-3)])
def test_rollouts_draw_the_chunks_of_the_plain_networks(precision: str, tolerance_nm: float) -> None:
    weights = load_weights(weights_path("alanine-dipeptide"))
    sampler = ChunkSampler(weights, precision=precision, solver="fitted", solver_steps=4)
    plain = copy.copy(sampler)
    plain._model = with_bf16_weights(weights.model) if precision == "bf16" else weights.model
    start = weights.domain.scene.positions_nm[None, None].repeat(2, axis=0)
    found, wanted, other = (
        one.draw(start, seeds).frames_nm for one, seeds in ((sampler, [1, 2]), (plain, [1, 2]), (sampler, [1, 3]))
    )
    errors = [abs(one - wanted).mean(axis=(1, 2, 3)) for one in (found, other)]
    assert errors[0].max() < tolerance_nm
    assert errors[1][1] > 5 * tolerance_nm, "another seed draws another chunk"


def test_memory_is_kept_where_it_can_be() -> None:
    assert keep_freed_memory() is (sys.platform.startswith("linux") and "glibc" in platform.libc_ver())
