"""A network that is told which rare state a window visits: drawn as often as it should be, whatever training showed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from surrogate.data.frames import TrainingFrames, canonicalise, quantise
from surrogate.data.rarity import rare_kinds
from surrogate.data.weights import Weights, load_weights
from surrogate.models.interface import Molecule
from surrogate.models.lam_slide.config import ApproximatorConfig, LamSlideConfig
from surrogate.models.lam_slide.kinds import Kind, kinds_of_windows
from surrogate.models.lam_slide.losses import FlowWindows, flow_loss
from surrogate.models.lam_slide.model import MAX_REDRAWS, LamSlide
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.models.lam_slide.transformer import Approximator
from systems.elements import ATOMIC_NUMBERS
from systems.errors import InputError
from systems.library.named_scenes import load

LENGTH = 8
# phi > 0, where no frame is but the mirror image.
PHI, POSITIVE = (4, 6, 8, 14), (6, 7, 8, 9, 10, 11)
KINDS = (*(Kind(PHI, POSITIVE, k) for k in POSITIVE), Kind(PHI, POSITIVE))
# Every 3200th frame begins eight in the mirror image, whose phi and psi no other frame has.
EVERY, VISIT = 3200, 8


@pytest.fixture(scope="module")
def frames() -> TrainingFrames:
    scene = load("alanine-dipeptide")
    x = np.repeat(scene.positions_nm[None], 16_000, axis=0)
    x += np.random.default_rng(0).normal(0.0, 0.002, x.shape)
    x[np.arange(16_000) % EVERY < VISIT] *= np.array([-1.0, 1.0, 1.0])
    return TrainingFrames(scene, quantise(canonicalise(x, scene)), np.array([0, 16_000]), 1.0, True, {}, ())


def test_kinds_are_drawn_with_their_odds() -> None:
    network = Approximator(ApproximatorConfig(width=16, n_layers=1, n_heads=2, rare_kinds=KINDS[:2]), 4, 6)
    odds = torch.tensor([0.9, 0.02, 0.08])
    network.set_odds(odds.tolist())
    n = 20_000
    noise = torch.randn(n, 32, 4, 6, generator=torch.Generator().manual_seed(0))
    known = torch.randn(n, 1, 4, 6, generator=torch.Generator().manual_seed(1))
    kinds = network.draw_kinds(known, noise)
    assert kinds is not None
    shares = torch.bincount(kinds, minlength=3) / n
    assert torch.allclose(shares, odds, atol=4 * 0.5 / n**0.5 * 0.6)
    assert torch.allclose(shares[1:], odds[1:], rtol=0.2)
    # Of the noise it takes one number of the first frame, which the network never sees.
    other = torch.randn(noise.shape, generator=torch.Generator().manual_seed(2))
    other[:, 0, 0, 0] = noise[:, 0, 0, 0]
    assert torch.equal(kinds, network.draw_kinds(known, other))
    other[:, 0] = 0.0
    assert not torch.equal(kinds, network.draw_kinds(known, other))


def test_importance_counts_in_the_odds_alone(small_model_config: LamSlideConfig) -> None:
    torch.manual_seed(0)
    told = replace(small_model_config, approximator=replace(small_model_config.approximator, rare_kinds=KINDS))
    model = LamSlide(told).eval()
    latents = torch.randn(6, LENGTH, 4, 12)
    tau, kind = torch.linspace(0.1, 0.9, 6), torch.tensor([0, 1, 2, 0, 1, 0])
    importance = torch.tensor([1.4, 0.01, 0.2, 1.4, 0.01, 1.4])

    def terms(**options: torch.Tensor) -> dict[str, torch.Tensor]:
        return flow_loss(model, FlowWindows(latents, 22, **options), tau, torch.Generator().manual_seed(1))[1]

    weighted, plain = terms(importance=importance, kind=kind), terms(kind=kind)
    assert weighted["flow"] == plain["flow"] and weighted["position"] == plain["position"]
    each = F.cross_entropy(model.approximator.kind_logits(latents[:, :1]), kind, reduction="none")
    torch.testing.assert_close(weighted["kind"], (each * importance).mean())
    torch.testing.assert_close(plain["kind"], each.mean())
    # Without kinds it is the flow that importance weighs.
    assert terms(importance=importance)["flow"] != terms()["flow"]


@pytest.mark.slow
def test_odds_are_those_of_the_reference_though_draws_are_not(
    tmp_path: Path, frames: TrainingFrames, small_model_config: LamSlideConfig
) -> None:
    batches = {"stage_one_batch": 32, "stage_two_batch": 16}
    config = TrainingConfig(stage_one_steps=60, stage_two_steps=3000, bf16=False, rare_draws=0.5, rare_kinds=True,
                            **batches)  # fmt: skip
    weights = load_weights(train_lam_slide(frames, tmp_path / "k.safetensors", small_model_config, config))
    model = weights.model
    assert isinstance(model, LamSlide)
    assert model.config.approximator.rare_kinds == rare_kinds(frames, LENGTH)
    assert weights.provenance["rare_kinds"] is True
    place = np.arange(0, 15_000) % EVERY
    elements = torch.tensor([ATOMIC_NUMBERS[e] for e in frames.scene.elements])

    def chance(of: np.ndarray) -> float:
        known = model.encode(torch.from_numpy(frames.positions_nm(np.flatnonzero(of)))[:, None], elements)
        with torch.no_grad():
            return float(1.0 - model.approximator.kind_logits(known).softmax(-1)[:, 0].mean())

    # From an ordinary frame 7 of 3192 windows reach the rare state; training drew half of its windows there.
    assert chance(place >= VISIT) == pytest.approx((LENGTH - 1) / (EVERY - VISIT), rel=0.4)
    assert chance(place < VISIT) > 0.8


def test_chunks_are_of_the_kind_that_was_drawn(
    frames: TrainingFrames, small_model_config: LamSlideConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.manual_seed(0)
    told = replace(small_model_config, approximator=replace(small_model_config.approximator, rare_kinds=KINDS))
    network = LamSlide(told).eval()
    scene, molecule = frames.scene, Molecule.of(frames.scene)
    ordinary = torch.from_numpy(scene.positions_nm.astype(np.float32))
    mirror = ordinary * torch.tensor([-1.0, 1.0, 1.0])
    visits = int(kinds_of_windows(torch.stack([ordinary, mirror])[None].numpy(), KINDS)[0])
    assert 1 <= visits < len(KINDS), "the mirror image must lie in the rare bins for this test to mean anything"
    network.approximator.set_odds([0.5 if k in (0, visits) else 0.0 for k in range(len(KINDS) + 1)])
    calls: list[int] = []

    def decode(latents: torch.Tensor, n_atoms: int, atoms: None = None) -> torch.Tensor:
        """Half of all rows, by a number of theirs, visit the mirror image in their middle."""
        calls.append(len(latents))
        rare = latents[:, 0, 0, 0] > 0
        chunk = ordinary.repeat(len(latents), LENGTH - 1, 1, 1)
        chunk[rare, 3] = mirror
        return chunk

    monkeypatch.setattr(network, "decode", decode)
    monkeypatch.setattr(network.approximator, "forward", lambda o, *rest: o)
    last = ordinary.repeat(64, 1, 1, 1)
    noise = torch.randn(64, *network.noise_shape(scene.n_atoms), generator=torch.Generator().manual_seed(3))
    known = network.encode(last, molecule.elements)
    kind = network.approximator.draw_kinds(known, noise)
    assert kind is not None and 16 < int((kind > 0).sum()) < 48
    drawn = network.next_chunk(last, molecule, noise).frames_nm
    windows = torch.cat([last, drawn], dim=1).numpy()
    assert (kinds_of_windows(windows, KINDS) == kind.numpy()).all()
    assert 3 < len(calls) < MAX_REDRAWS and calls[0] == 64 and calls[1] < 48
    # A row does not depend on those beside it, and the first try alone (the control) is often of another kind.
    alone = network.next_chunk(last[5:6], molecule, noise[5:6]).frames_nm
    assert torch.equal(alone[0], drawn[5])
    monkeypatch.setattr("surrogate.models.lam_slide.model.MAX_REDRAWS", 0)
    once = torch.cat([last, network.next_chunk(last, molecule, noise).frames_nm], dim=1).numpy()
    assert (kinds_of_windows(once, KINDS) != kind.numpy()).sum() > 16


def test_weights_without_kinds_learn_them_and_others_keep_theirs(
    tmp_path: Path, frames: TrainingFrames, small_weights: Weights, small_model_config: LamSlideConfig
) -> None:
    quick = TrainingConfig(stage_one_steps=0, stage_two_steps=4, stage_two_batch=8, bf16=False, rare_kinds=True)
    weights = load_weights(
        train_lam_slide(frames, tmp_path / "m.safetensors", small_model_config, quick, start=small_weights)
    )
    known = small_weights.model.state_dict()
    new = set(weights.model.state_dict()) - set(known)
    assert new and all(name.startswith(("approximator.embed_kind", "approximator.odds")) for name in new)
    with pytest.raises(InputError, match="another configuration"):
        train_lam_slide(frames, tmp_path / "n.safetensors", small_model_config, replace(quick, rare_kinds=False),
                        start=weights)  # fmt: skip
