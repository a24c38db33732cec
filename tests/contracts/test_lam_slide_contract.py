"""The contract of surrogate.models.propagator, held against LaM-SLidE with weights that do something."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from surrogate.models.conformance import PropagatorContract, branched_chain, random_state
from surrogate.models.lam_slide.model import ApproximatorConfig, AutoencoderConfig, LamSlide, LamSlideConfig
from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import Weights, load_weights, save_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory


def small_model(
    n_latents: int = 1, *, precondition: bool = True, n_conditioning: int = 1, clean: bool = False
) -> LamSlide:
    """A model whose zero-initialised layers are filled, so that every path carries signal."""
    torch.manual_seed(3)
    config = LamSlideConfig(
        autoencoder=AutoencoderConfig(n_latents=n_latents, latent_dim=16, width=32, head_dim=8, identifier_pool=512),
        approximator=ApproximatorConfig(
            chunk_frames=6,
            latents_per_token=1,
            width=32,
            n_layers=2,
            n_heads=2,
            precondition=precondition,
            n_conditioning=n_conditioning,
            clean_conditioning=clean,
        ),
    )
    model = LamSlide(config)
    with torch.no_grad():
        for name, p in model.named_parameters():
            if p.abs().max() == 0 or "modulation" in name or "offset" in name:
                p.normal_(std=0.3)
    return model.eval().requires_grad_(False)


class TestLamSlide(PropagatorContract):
    def make(self, n_atoms: int) -> Propagator:
        return small_model(3)


class TestLamSlideOneLatent(PropagatorContract):
    def make(self, n_atoms: int) -> Propagator:
        return small_model(1, precondition=False)


class TestLamSlideCleanConditioning(PropagatorContract):
    def make(self, n_atoms: int) -> Propagator:
        return small_model(3, n_conditioning=3, clean=True)


class TestLamSlideAdaptive(PropagatorContract):
    """With dopri5: rows do not depend on each other's steps."""

    # Steps are chosen anew in bf16: held to the error of the whole chain, not of one evaluation.
    bf16_error = 0.1
    sizes = (1, 2)

    def make(self, n_atoms: int) -> Propagator:
        return small_model(3)

    def call(self, model: Propagator, frames: Tensor, molecule: Molecule, noise: Tensor, velocities: Tensor) -> Chunk:
        with torch.no_grad():
            return model.next_chunk(frames, molecule, noise, solver_steps=1, solver="dopri5")


def test_adaptive_evaluations_are_counted() -> None:
    model = small_model(3)
    frames, molecule = random_state(5, 2, 1)[0], branched_chain(5)
    noise = torch.randn(2, *model.noise_shape(5), generator=torch.Generator().manual_seed(0))
    counts = [model.next_chunk(frames, molecule, noise, solver=s, solver_steps=9).evaluations for s in model.solvers]
    assert counts[:-1] == [9.0] * (len(model.solvers) - 1)
    assert (counts[-1] or 0.0) > 9.0


def test_older_weights_name_their_interpolant() -> None:
    record = small_model(3).config.to_dict()
    again = LamSlideConfig.from_dict(record | {"approximator": record["approximator"] | {"interpolant": "linear"}})
    assert again == LamSlideConfig.from_dict(record)
    with pytest.raises(InputError, match="interpolant"):
        LamSlideConfig.from_dict(record | {"approximator": record["approximator"] | {"interpolant": "gvp"}})


def test_permuting_atoms_with_their_identifiers_permutes_the_frames() -> None:
    model = small_model(3)
    order = torch.tensor([3, 0, 4, 1, 2])
    elements = torch.tensor([6, 1, 7, 1, 8])
    x = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(2))
    ids = torch.tensor([4, 9, 0, 31, 7]).expand(2, 5)
    ae = model.autoencoder
    z = ae.encode(x, elements.expand(2, 5), ids)
    z_permuted = ae.encode(x[:, order], elements[order].expand(2, 5), ids[:, order])
    torch.testing.assert_close(z, z_permuted, rtol=0, atol=2e-6)
    decoded, permuted = ae.decode(z, ids).positions, ae.decode(z, ids[:, order]).positions
    torch.testing.assert_close(decoded[:, order], permuted, rtol=0, atol=2e-6)
    # Negative control: atoms permuted without their identifiers are another system.
    assert (ae.encode(x[:, order], elements[order].expand(2, 5), ids) - z).abs().max() > 1e-2


def test_weights_survive_a_round_trip(tmp_path: Path, small_weights: Weights) -> None:
    copy = tmp_path / "copy.safetensors"
    save_weights(copy, small_weights.model, small_weights.domain, small_weights.provenance)
    loaded = load_weights(copy)
    assert loaded.domain.scene.topology_hash == small_weights.domain.scene.topology_hash
    for name, tensor in small_weights.model.state_dict().items():
        assert torch.equal(loaded.model.state_dict()[name], tensor), name


def frames_of(scene: Scene, weights: Weights, out: Path, seed: int = 0) -> np.ndarray:
    rollout(
        scene, weights, [out], RolloutConfig(time_ps=20.0, seed=seed, precision="fp32", solver_steps=3, guard="off")
    )
    with open_trajectory(out) as reader:
        return reader.read().astype(np.float64)


def test_rollout_is_equivariant_to_rotation_translation_and_atom_order(
    tmp_path: Path, small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    """Exact in real numbers; in float32 the first chunk agrees to 2e-5 nm, later ones drift apart by chaos alone."""
    base = frames_of(alanine_dipeptide, small_weights, tmp_path / "base.h5")
    rng = np.random.default_rng(0)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    rotation = q * np.sign(np.diag(r))
    rotation *= np.sign(np.linalg.det(rotation))
    shift = np.array([1.0, -2.0, 0.5])
    turned = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm @ rotation.T + shift)
    moved = frames_of(turned, small_weights, tmp_path / "moved.h5")
    n = small_weights.model.n_new
    np.testing.assert_allclose(moved[:n], base[:n] @ rotation.T + shift, rtol=0, atol=2e-5)
    # Negative controls: not moved at all, and another seed.
    assert np.abs(moved[:n] - base[:n]).max() > 0.1
    assert np.abs(frames_of(alanine_dipeptide, small_weights, tmp_path / "seed.h5", seed=1) - base).max() > 2e-4
