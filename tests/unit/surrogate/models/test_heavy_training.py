"""LaM-SLidE trained on heavy atoms and on residues: losses, weights, rollouts of all atoms, and what is refused."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.data.features.residue_layout import residue_layout
from surrogate.data.frames import TrainingFrames
from surrogate.data.molecules import FrameSets
from surrogate.data.parts import part_of_frames
from surrogate.data.weights import Weights, load_weights
from surrogate.models.lam_slide.codes.residue_autoencoder import ResidueAutoencoder
from surrogate.models.lam_slide.codes.residue_code import RESIDUE_TYPES
from surrogate.models.lam_slide.config import ApproximatorConfig, AutoencoderConfig, LamSlideConfig
from surrogate.models.lam_slide.heavy_atoms import HeavyLamSlide
from surrogate.models.lam_slide.losses import FlowWindows, autoencoder_loss, flow_loss
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.errors import InputError
from systems.library.named_scenes import load
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

QUICK = TrainingConfig(
    stage_one_steps=60, stage_two_steps=30, stage_one_batch=32, stage_two_batch=8, bf16=False, validate_every_s=1e9
)


@pytest.fixture(scope="module")
def placed_config(small_model_config: LamSlideConfig) -> LamSlideConfig:
    return replace(small_model_config, hydrogens="placed")


@pytest.fixture(scope="module")
def residue_config(small_model_config: LamSlideConfig) -> LamSlideConfig:
    return replace(small_model_config, entities="residue")


def trained(out: Path, frames: TrainingFrames, config: LamSlideConfig) -> Weights:
    """Weights of a second's training, which hardly move: guards are told that this is all right."""
    found = load_weights(train_lam_slide(frames, out, config, QUICK))
    return replace(found, domain=replace(found.domain, limits={**(found.domain.limits or {}), "jump_min_nm": 1e-9}))


@pytest.fixture(scope="module")
def placed_weights(
    tmp_path_factory: pytest.TempPathFactory, harmonic_frames: TrainingFrames, placed_config: LamSlideConfig
) -> Weights:
    return trained(tmp_path_factory.mktemp("placed") / "w.safetensors", harmonic_frames, placed_config)


@pytest.fixture(scope="module")
def residue_weights(
    tmp_path_factory: pytest.TempPathFactory, harmonic_frames: TrainingFrames, residue_config: LamSlideConfig
) -> Weights:
    return trained(tmp_path_factory.mktemp("residue") / "w.safetensors", harmonic_frames, residue_config)


def frames_of(scene: Scene, weights: Weights, out: Path, **more: str) -> np.ndarray:
    config = RolloutConfig(time_ps=20.0, precision="fp32", solver_steps=3, guard="flag", **more)
    rollout(scene, weights, [out], config)
    with open_trajectory(out) as reader:
        return reader.read().astype(np.float64)


def residue_model(frames: TrainingFrames) -> tuple[LamSlide, TrainingFrames]:
    """An untrained model of residues, and frames of the heavy atoms it sees."""
    heavy = part_of_frames(frames, frames.scene.heavy_idx)
    autoencoder = AutoencoderConfig(latent_dim=12, width=64, head_dim=16, latent_noise=0.0)
    approximator = ApproximatorConfig(chunk_frames=8, width=64, n_layers=2, n_heads=2, auxiliary_frames=2)
    torch.manual_seed(0)
    model = LamSlide(LamSlideConfig(entities="residue", autoencoder=autoencoder, approximator=approximator,
                                    residues=residue_layout(heavy.scene)))  # fmt: skip
    return model, heavy


def test_the_network_sees_heavy_atoms_alone(placed_weights: Weights, harmonic_frames: TrainingFrames) -> None:
    model, scene = placed_weights.model, harmonic_frames.scene
    assert isinstance(model, HeavyLamSlide)
    assert model.hydrogens.plan.heavy == tuple(scene.heavy_idx.tolist())
    assert model.config.hydrogen_plan == model.hydrogens.plan
    assert placed_weights.domain.scene.topology_hash == scene.topology_hash
    assert len(placed_weights.domain.geometry["bond_idx"]) == len(scene.bonds)
    # Tables and lengths were measured, and came back from the file.
    for group in model.hydrogens.groups:
        assert 0.095 < float(group.lengths_nm.mean()) < 0.115
        assert float(group.swing.abs().max()) > 1e-4


def test_rollouts_have_all_atoms_and_their_lengths(
    tmp_path: Path, placed_weights: Weights, alanine_dipeptide: Scene
) -> None:
    scene = alanine_dipeptide
    base = frames_of(scene, placed_weights, tmp_path / "base.h5")
    assert base.shape == (20, scene.n_atoms, 3)
    geometry = placed_weights.domain.geometry
    bonds, mean = np.array(geometry["bond_idx"]), np.array(geometry["bond_mean_nm"])
    to_hydrogen = np.array([[scene.elements[i] == "H" for i in pair] for pair in bonds]).any(axis=1)
    lengths = np.linalg.norm(base[:, bonds[:, 0]] - base[:, bonds[:, 1]], axis=-1).mean(axis=0)
    assert np.abs(lengths - mean)[to_hydrogen].max() < 0.004
    # What is written is another matter: heavy atoms alone, the same ones, of the same model.
    some = frames_of(scene, placed_weights, tmp_path / "some.h5", atoms="heavy")
    assert np.array_equal(some, base[:, scene.heavy_idx])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([1.0, -2.0, 0.5])
    turned = scene.with_positions(scene.positions_nm @ turn.T + shift)
    moved = frames_of(turned, placed_weights, tmp_path / "turned.h5")
    n = placed_weights.model.n_new
    np.testing.assert_allclose(moved[:n], base[:n] @ turn.T + shift, rtol=0, atol=5e-5)
    assert np.abs(moved[:n] - base[:n]).max() > 0.1


def test_residue_models_roll_end_to_end(tmp_path: Path, residue_weights: Weights, alanine_dipeptide: Scene) -> None:
    model = residue_weights.model
    assert isinstance(model, HeavyLamSlide)
    assert isinstance(model.model.autoencoder, ResidueAutoencoder)
    frames = frames_of(alanine_dipeptide, residue_weights, tmp_path / "r.h5")
    assert frames.shape == (20, alanine_dipeptide.n_atoms, 3)
    assert np.isfinite(frames).all()
    heavy = alanine_dipeptide.heavy_idx
    start = alanine_dipeptide.positions_nm - alanine_dipeptide.positions_nm.mean(axis=0)
    away = frames - frames.mean(axis=1, keepdims=True) - start
    # Two seconds of training know where atoms are to a fifth of a bond length; the structure spreads over 0.3 nm.
    assert np.sqrt((away[:, heavy] ** 2).sum(-1).mean()) < 0.06
    rows = list(csv.DictReader(residue_weights.path.with_suffix(".csv").open()))
    assert {"train_frame", "train_torsion", "train_type", "validation_frame"} <= set(rows[0])


def test_training_goes_on_from_weights_of_heavy_atoms(
    tmp_path: Path, harmonic_frames: TrainingFrames, residue_weights: Weights
) -> None:
    config = replace(QUICK, stage_two_steps=4)
    assert isinstance(residue_weights.model, HeavyLamSlide)
    out = train_lam_slide(harmonic_frames, tmp_path / "m.safetensors", residue_weights.model.config, config,
                          start=residue_weights)  # fmt: skip
    before, after = residue_weights.model.state_dict(), load_weights(out).model.state_dict()
    assert before.keys() == after.keys()
    same = {name for name, tensor in before.items() if torch.equal(after[name], tensor)}
    assert all(name in same for name in before if name.startswith(("hydrogens", "model.autoencoder", "model.latent")))
    assert not all(name in same for name in before if name.startswith("model.approximator"))


def test_residue_losses_add_up_by_their_weights(harmonic_frames: TrainingFrames) -> None:
    model, heavy = residue_model(harmonic_frames)
    x = torch.from_numpy(heavy.positions_nm(np.arange(16)))
    elements = torch.full((heavy.scene.n_atoms,), 6)
    with torch.no_grad():
        model.autoencoder.to_element[-1].weight.zero_()
        model.autoencoder.to_element[-1].bias.zero_()
    loss, terms = autoencoder_loss(model, x, elements, torch.Generator().manual_seed(0))
    c = model.config.autoencoder
    weights = {"position": c.position_weight, "distance": c.distance_weight, "type": c.type_weight,
               "frame": c.frame_weight, "torsion": c.torsion_weight}  # fmt: skip
    assert set(terms) == set(weights)
    assert float(loss.detach()) == pytest.approx(sum(weights[k] * float(v) for k, v in terms.items()), rel=1e-5)
    # All residues look alike to it: the cross entropy is the logarithm of their number (eq. 16).
    assert float(terms["type"]) == pytest.approx(math.log(len(RESIDUE_TYPES)), abs=1e-5)
    # Logits that name the right residues, by hand: ACE, ALA, NME.
    logits = torch.zeros(1, 3, len(RESIDUE_TYPES))
    for row, name in enumerate(("ACE", "ALA", "NME")):
        logits[0, row, RESIDUE_TYPES.index(name)] = 50.0
    types = model.autoencoder.types(elements[None])
    assert torch.equal(logits.argmax(-1), types)
    # The same as of the untrained decoder's own atoms (eq. 13 and 14): position and distance see atoms, not places.
    scaled = x / model.config.position_scale_nm
    ids = model.identifiers(heavy.scene.n_atoms).expand(16, -1)
    assert ids.shape == (16, 3), "one identifier for each residue"
    with torch.no_grad():
        latents = model.autoencoder.encode(scaled, elements.expand(16, -1), ids)
        decoded = model.autoencoder.decode(latents, ids).positions
    assert decoded.shape == scaled.shape
    by_hand = ((decoded - scaled) ** 2).sum(-1).mean()
    assert float(terms["position"]) == pytest.approx(float(by_hand), rel=1e-4)
    assert float(terms["frame"]) == pytest.approx(float(model.autoencoder.frame_loss(scaled, decoded)), rel=1e-4)


def test_the_frame_loss_of_the_flow_is_weighed_like_its_other_terms(harmonic_frames: TrainingFrames) -> None:
    model, heavy = residue_model(harmonic_frames)
    n_atoms = heavy.scene.n_atoms
    x = torch.from_numpy(heavy.positions_nm(np.arange(32))).reshape(4, 8, n_atoms, 3)
    latents = model.encode(x, torch.full((n_atoms,), 6)).detach()
    tau = torch.tensor([0.1, 0.5, 0.7, 0.9])
    loss, terms = flow_loss(model, FlowWindows(latents, n_atoms), tau, torch.Generator().manual_seed(0))
    c = model.config.approximator
    expected = (terms["flow"] + c.position_weight * terms["position"] + c.distance_weight * terms["distance"]
                + c.frame_weight * terms["frame"])  # fmt: skip
    assert float(loss.detach()) == pytest.approx(float(expected), rel=1e-5)
    assert float(terms["frame"]) > 0.0
    assert loss.requires_grad


def test_stage_one_lowers_every_loss(harmonic_frames: TrainingFrames, residue_weights: Weights) -> None:
    assert isinstance(residue_weights.model, HeavyLamSlide)
    untrained, heavy = residue_model(harmonic_frames)
    x = torch.from_numpy(heavy.positions_nm(heavy.window_starts(1, validation=True)))
    elements = torch.full((heavy.scene.n_atoms,), 6)
    with torch.no_grad():
        before, after = (
            autoencoder_loss(model, x, elements, torch.Generator().manual_seed(0))[1]
            for model in (untrained, residue_weights.model.model)
        )
    for name, share in {"position": 0.7, "distance": 0.7, "frame": 0.7, "torsion": 0.7, "type": 0.9}.items():
        assert float(after[name]) < share * float(before[name]), f"{name}: {before[name]:.4g} -> {after[name]:.4g}"


@pytest.mark.slow
def test_a_minute_lowers_every_loss_of_both_stages(
    tmp_path: Path, harmonic_frames: TrainingFrames, residue_config: LamSlideConfig
) -> None:
    config = TrainingConfig(budget_s=60.0, stage_one_batch=32, stage_two_batch=16, bf16=False, validate_every_s=2.0)
    out = train_lam_slide(harmonic_frames, tmp_path / "m.safetensors", residue_config, config)
    rows = list(csv.DictReader(out.with_suffix(".csv").open()))
    for stage, names in (("autoencoder", ("position", "distance", "type", "frame", "torsion")),
                         ("flow", ("flow", "position", "distance", "frame"))):  # fmt: skip
        own = [row for row in rows if row["stage"] == stage]
        for name in names:
            first, last = float(own[0][f"train_{name}"]), float(own[-1][f"train_{name}"])
            assert last < first, f"{stage}, {name}: {first:.4g} -> {last:.4g}"


def test_identifiers_belong_to_residues(harmonic_frames: TrainingFrames) -> None:
    """Three of them suffice, drawn at random as well (Algorithm 1); two do not. Residues are told apart by nothing
    else: with those of two exchanged, each decodes to the other's place."""
    model, heavy = residue_model(harmonic_frames)
    x = torch.from_numpy(heavy.positions_nm(np.arange(8)))
    elements = torch.full((heavy.scene.n_atoms,), 6)
    drawn = LamSlide(replace(model.config, autoencoder=replace(model.config.autoencoder, identifier_pool=3,
                                                               random_identifiers=1.0)))  # fmt: skip
    loss, _ = autoencoder_loss(drawn, x, elements, torch.Generator().manual_seed(0))
    assert torch.isfinite(loss)
    latents = model.autoencoder.encode(x, elements.expand(8, -1), model.identifiers(10).expand(8, -1))
    decode = super(ResidueAutoencoder, model.autoencoder).decode
    ids = torch.arange(3).expand(8, -1)
    torch.testing.assert_close(
        decode(latents, ids).positions[:, [1, 0, 2]], decode(latents, ids[:, [1, 0, 2]]).positions
    )


def test_what_heavy_atoms_cannot_do_is_refused_in_one_line(
    tmp_path: Path, harmonic_frames: TrainingFrames, placed_config: LamSlideConfig, residue_config: LamSlideConfig
) -> None:
    out = tmp_path / "m.safetensors"
    sets = FrameSets((harmonic_frames, harmonic_frames))
    with pytest.raises(InputError, match="placed for one molecule"):
        train_lam_slide(sets, out, placed_config, QUICK)
    with pytest.raises(InputError, match="at one lag"):
        train_lam_slide(harmonic_frames, out, placed_config, replace(QUICK, longest_lag_ps=8.0))
    pool = replace(residue_config, autoencoder=replace(residue_config.autoencoder, identifier_pool=2))
    with pytest.raises(InputError, match=r"3 residues need autoencoder.identifier_pool >= 3, not 2"):
        train_lam_slide(harmonic_frames, out, pool, QUICK)
    ethanol = load("ethanol")
    frames = replace(harmonic_frames, scene=ethanol, coordinates=harmonic_frames.coordinates[:, : ethanol.n_atoms])
    with pytest.raises(InputError, match="none of the twenty amino acids"):
        train_lam_slide(frames, out, residue_config, QUICK)
    assert not out.exists()
