"""One model for many molecules: training on several, split by system, rollouts of seen and unseen ones, refusals."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate.data.descriptions import describe
from surrogate.data.features.stiff_terms import holds_hydrogens
from surrogate.data.frames import collect_frames
from surrogate.data.molecules import FrameSets, collect_sets
from surrogate.data.poses import in_standard_pose
from surrogate.data.weights import Weights, load_weights, read_header
from surrogate.models.lam_slide.config import GraphConfig, LamSlideConfig
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.lam_slide.trainer import TrainingConfig, train_lam_slide
from surrogate.sampling.domain import find_deviations, match_domain
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.symmetry import local_handedness
from systems.errors import InputError, OutOfDomainError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer

QUICK = TrainingConfig(
    stage_one_steps=12, stage_two_steps=8, stage_one_batch=8, stage_two_batch=4, bf16=False, validate_every_s=1e9
)
ROLL = RolloutConfig(time_ps=14.0, solver_steps=2, precision="fp32", guard="off")
Write = Callable[..., Path]


@pytest.fixture(scope="module")
def write(tmp_path_factory: pytest.TempPathFactory) -> Write:
    """Write a trajectory of correlated Gaussian motion about a molecule's structure."""
    folder = tmp_path_factory.mktemp("references")

    def one(
        scene: Scene, name: str, *, n: int = 240, seed: int = 0, lag_ps: float = 1.0, kelvin: float = 300.0
    ) -> Path:
        rng, path = np.random.default_rng(seed), folder / f"{name}.h5"
        if path.exists():
            return path
        noise = rng.normal(size=(n, scene.n_atoms, 3))
        for t in range(1, n):
            noise[t] = 0.8 * noise[t - 1] + 0.6 * noise[t]
        record = {"temperature_k": kelvin, "force_field": name.split("-")[0], "solvent": "vacuum"}
        with open_writer(path, scene, record) as writer:
            writer.append(scene.positions_nm + 0.004 * noise, np.arange(1, n + 1) * lag_ps)
        return path

    return one


@pytest.fixture(scope="module")
def graph_config(small_model_config: LamSlideConfig) -> LamSlideConfig:
    return replace(small_model_config, graph=True, atoms=GraphConfig(width=32, n_rounds=2))


@pytest.fixture(scope="module", params=["set", "atoms"])
def weights(
    request: pytest.FixtureRequest, write: Write, graph_config: LamSlideConfig, tmp_path_factory: pytest.TempPathFactory
) -> Weights:
    """Of propanol and propane, with ethanol held out whole."""
    sets = collect_sets([write(smiles("CCCO"), "propanol"), write(smiles("CCC"), "propane")],
                        held=[write(smiles("CCO"), "ethanol")])  # fmt: skip
    config = replace(graph_config, atoms=replace(graph_config.atoms, latents=request.param))
    out = tmp_path_factory.mktemp("many") / "many.safetensors"
    return load_weights(train_lam_slide(sets, out, config, replace(QUICK, stage_one_steps=60)))


def smiles(text: str) -> Scene:
    return scene_from_smiles(text)


def roll(scene: Scene, weights: Weights, out: Path, config: RolloutConfig = ROLL) -> tuple[np.ndarray, dict]:
    rollout(scene, weights, [out], config)
    with open_trajectory(out) as reader:
        return reader.read().astype(np.float64), dict(reader.record)


def test_two_molecules_train_one_model_and_a_third_is_watched(weights: Weights) -> None:
    domain = weights.domain
    assert [member.scene.formula for member in domain.members] == ["C3H8O", "C3H8"]
    assert [member.conditions["force_field"] for member in domain.members] == ["propanol", "propane"]
    assert domain.transferable
    assert "2 molecules of up to 12 atoms" in domain.describe() and "like them" in domain.describe()
    assert weights.provenance["held_out_molecules"] == [smiles("CCO").name]
    assert weights.provenance["reference_ns"] == pytest.approx(0.48)
    rows = list(csv.DictReader(weights.path.with_suffix(".csv").open()))
    errors = {row["stage"]: row for row in rows}
    assert ("autoencoder" in errors) != weights.model.config.latents_are_atoms
    if "autoencoder" in errors:
        assert 0.0 < float(errors["autoencoder"]["validation_rmsd_nm"]) < 0.05
        assert float(errors["autoencoder"]["unseen_rmsd_nm"]) > 0.0
    assert float(errors["flow"]["validation_flow"]) != float(errors["flow"]["unseen_flow"])


def test_seen_and_unseen_molecules_roll_and_the_record_tells_which(weights: Weights, tmp_path: Path) -> None:
    for text, unseen in (("CCCO", None), ("CCC", None), ("CCO", True)):
        scene = smiles(text)
        frames, record = roll(scene, weights, tmp_path / f"{text}.h5")
        assert frames.shape == (14, scene.n_atoms, 3) and np.isfinite(frames).all()
        assert record.get("unseen_molecule") is unseen
        assert "out_of_domain" not in record
        # Frames stay near the molecule: displacements are added to its own template, whoever it is.
        bond = np.linalg.norm(frames[:, scene.bonds[:, 0]] - frames[:, scene.bonds[:, 1]], axis=-1)
        rest = np.linalg.norm(scene.positions_nm[scene.bonds[:, 0]] - scene.positions_nm[scene.bonds[:, 1]], axis=-1)
        assert np.abs(bond - rest).max() < 0.1


@pytest.mark.parametrize("text", ["CCCO", "CCO"])
def test_rollouts_turn_shift_and_permute_with_the_scene(weights: Weights, tmp_path: Path, text: str) -> None:
    """Of an unseen molecule too, whose pose its own shape decides."""
    scene, rng = smiles(text), np.random.default_rng(1)
    base, _ = roll(scene, weights, tmp_path / "base.h5")
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = q * np.sign(np.diag(r))
    turn *= np.sign(np.linalg.det(turn))
    moved, _ = roll(scene.with_positions(scene.positions_nm @ turn.T + 0.3), weights, tmp_path / "moved.h5")
    n = weights.model.n_new
    np.testing.assert_allclose(moved[:n], base[:n] @ turn.T + 0.3, rtol=0, atol=5e-5)
    order = rng.permutation(scene.n_atoms)
    back = np.argsort(order)
    permuted = replace(
        scene,
        atom_names=tuple(scene.atom_names[i] for i in order), elements=tuple(scene.elements[i] for i in order),
        residue_of_atom=scene.residue_of_atom[order], formal_charges=scene.formal_charges[order],
        masses_da=scene.masses_da[order], positions_nm=scene.positions_nm[order], bonds=np.sort(back[scene.bonds]),
    )  # fmt: skip
    shuffled, _ = roll(permuted, weights, tmp_path / "permuted.h5")
    np.testing.assert_allclose(shuffled[:n], base[:n][:, order], rtol=0, atol=5e-5)
    other, _ = roll(scene, weights, tmp_path / "seed.h5", replace(ROLL, seed=1))
    assert np.abs(other[:n] - base[:n]).max() > 2e-4, "the control: another seed is another rollout"


def test_the_molecule_is_told_to_the_flow(weights: Weights) -> None:
    model = weights.model
    molecules = [describe(model, member.scene) for member in weights.domain.members]
    told = [model.told(model.atoms_of(molecule), None, 1) for molecule in molecules]
    assert (told[0].whole - told[1].whole).abs().max() > 1e-3
    order = torch.randperm(molecules[0].n_atoms, generator=torch.Generator().manual_seed(0))
    again = model.told(model.atoms_of(molecules[0].permuted(order)), None, 1)
    torch.testing.assert_close(again.whole, told[0].whole, rtol=0, atol=1e-5)
    if weights.model.config.latents_are_atoms:
        torch.testing.assert_close(again.tags, told[0].tags[:, order], rtol=0, atol=1e-5)
        assert torch.equal(again.hops, told[0].hops[order][:, order])


@pytest.mark.parametrize(
    ("text", "what", "forcible"),
    [
        ("CCN", "elements", False),
        ("CCCC", "torsion environments", True),
        ("CCCCO", "size", True),
        ("CO", "atom environments", True),
        ("CC=O", "bond types", True),
        ("C1CC1", "atom environments", True),
        ("CC[O-]", "charge", True),
    ],
)
def test_molecules_unlike_those_trained_on_are_refused(weights: Weights, text: str, what: str, forcible: bool) -> None:
    scene = smiles(text)
    found = {d.what: d.forcible for d in find_deviations(scene, weights.domain)}
    assert found[what] is forcible
    with pytest.raises(OutOfDomainError, match=what):
        match_domain(scene, weights)
    if forcible:
        forced = match_domain(scene, weights, force=True)
        assert not forced.seen and what in {d.what for d in forced.deviations}
    else:
        with pytest.raises(OutOfDomainError, match="surromd reference"):
            match_domain(scene, weights, force=True)


def test_strained_and_broken_starts_of_unseen_molecules_are_noticed(weights: Weights) -> None:
    ethanol = smiles("CCO")
    assert find_deviations(ethanol, weights.domain) == ()
    strained = find_deviations(ethanol.with_positions(1.4 * ethanol.positions_nm), weights.domain)
    assert [(d.what, d.forcible) for d in strained] == [("start", True)]
    broken = find_deviations(ethanol.with_positions(np.nan * ethanol.positions_nm), weights.domain)
    assert [(d.what, d.forcible) for d in broken] == [("start", False)]
    assert [d.what for d in find_deviations(ethanol, weights.domain, temperature_k=310.0)] == ["temperature"]


def test_a_forced_rollout_says_what_it_left(weights: Weights, tmp_path: Path) -> None:
    _, record = roll(smiles("CCCC"), weights, tmp_path / "butane.h5", replace(ROLL, force=True))
    assert record["unseen_molecule"] and {d["what"] for d in record["out_of_domain"]} >= {"torsion environments"}


def test_training_goes_on_with_another_molecule(weights: Weights, write: Write, tmp_path: Path) -> None:
    sets = collect_sets([write(smiles("CCO"), "ethanol")])
    out = train_lam_slide(sets, tmp_path / "t.safetensors", weights.model.config, QUICK, start=weights)
    assert load_weights(out).domain.scene.formula == "C2H6O"
    assert read_header(out).provenance["from"]["hash"] == weights.hash


def test_a_held_out_system_that_is_trained_on_in_another_order_is_refused(write: Write) -> None:
    scene = smiles("CCO")
    order = np.r_[2, 1, 0, 3 : scene.n_atoms]
    other = replace(scene, elements=tuple(scene.elements[i] for i in order), positions_nm=scene.positions_nm[order],
                    masses_da=scene.masses_da[order], bonds=np.sort(np.argsort(order)[scene.bonds]))  # fmt: skip
    plain, turned = write(scene, "ethanol"), write(other, "ethanol-turned", seed=3)
    with pytest.raises(InputError, match="both trained on and held out"):
        collect_sets([plain], held=[turned])
    with pytest.raises(InputError, match="one molecule in two atom orders"):
        collect_sets([plain, turned])
    # The same order is a second trajectory of the molecule, held out for validation.
    again = write(scene, "ethanol-again", seed=4)
    sets = collect_sets([plain], held=[again])
    assert len(sets.trained) == 1 and sets.trained[0].split.held == (1,)
    with pytest.raises(InputError, match="held out for validation and trained on"):
        collect_sets([plain], held=[plain])


def test_mixtures_that_no_model_can_learn_are_refused(
    write: Write, graph_config: LamSlideConfig, small_model_config: LamSlideConfig, tmp_path: Path
) -> None:
    ethanol, propane = write(smiles("CCO"), "ethanol"), write(smiles("CCC"), "propane")
    with pytest.raises(InputError, match="every 2 ps"):
        collect_sets([ethanol, write(smiles("CCC"), "propane-2ps", lag_ps=2.0)])
    with pytest.raises(InputError, match="350"):
        collect_sets([ethanol, write(smiles("CCC"), "propane-hot", kelvin=350.0)])
    sets = collect_sets([ethanol, propane])
    with pytest.raises(InputError, match="graph = true"):
        train_lam_slide(sets, tmp_path / "x.safetensors", small_model_config, QUICK)
    with pytest.raises(InputError, match="rare"):
        train_lam_slide(sets, tmp_path / "x.safetensors", graph_config, replace(QUICK, rare_kinds=True))


def test_windows_that_turn_with_their_template_train(
    write: Write, graph_config: LamSlideConfig, tmp_path: Path
) -> None:
    turned = replace(graph_config, atoms=replace(graph_config.atoms, turn=True))
    sets = collect_sets([write(smiles("CCO"), "ethanol"), write(smiles("CCC"), "propane")])
    out = train_lam_slide(sets, tmp_path / "t.safetensors", turned, replace(QUICK, stage_one_steps=60))
    rows = list(csv.DictReader(out.with_suffix(".csv").open()))
    assert float(rows[0]["validation_rmsd_nm"]) < 0.05
    assert load_weights(out).model.config.atoms.turn


def test_rigid_hydrogens_are_learned_from_the_references(
    write: Write, graph_config: LamSlideConfig, tmp_path: Path
) -> None:
    """From their frames: what made a trajectory may not say."""
    scene = smiles("CCC")
    hydrogens = np.array([e == "H" for e in scene.elements])
    parent = {h: p for i, j in scene.bonds.tolist() for h, p in ((i, j), (j, i)) if hydrogens[h]}
    rng, rigid = np.random.default_rng(0), tmp_path / "rigid.h5"
    with open_writer(rigid, scene, {"temperature_k": 300.0}) as writer:
        heavy = scene.positions_nm + 0.004 * rng.normal(size=(240, scene.n_atoms, 3))
        for h, p in parent.items():
            heavy[:, h] = heavy[:, p] + scene.positions_nm[h] - scene.positions_nm[p]
        writer.append(heavy, np.arange(1, 241) * 1.0)
    config = replace(graph_config, atoms=replace(graph_config.atoms, latents="atoms"))
    for paths, held in (([rigid], True), ([rigid, write(smiles("CCO"), "ethanol")], False)):
        sets = collect_sets(paths)
        assert [holds_hydrogens(f.scene, f.some_nm(100)) for f in sets.trained] == ([True] if held else [True, False])
        out = train_lam_slide(sets, tmp_path / f"{held}.safetensors", config, QUICK)
        weights = load_weights(out)
        assert weights.model.config.atoms.rigid_hydrogens is held
        frames, _ = roll(scene, weights, tmp_path / f"{held}.h5", replace(ROLL, force=True))
        off = [
            np.abs(np.linalg.norm(frames[:, h] - frames[:, p], axis=-1)
                   - np.linalg.norm(scene.positions_nm[h] - scene.positions_nm[p])).max()
            for h, p in parent.items()
        ]  # fmt: skip
        assert max(off) < 1e-5 if held else max(off) > 1e-3


def test_the_atom_encoder_is_trained_where_there_is_no_stage_one_too(weights: Weights) -> None:
    torch.manual_seed(QUICK.seed)
    begun, ended = LamSlide(weights.model.config).atom_encoder, weights.model.atom_encoder
    assert begun is not None and ended is not None
    for name, value in begun.named_parameters():
        if "elements" not in name:  # most elements do not occur
            assert not torch.equal(value, ended.state_dict()[name]), name
    stages = {row["stage"] for row in csv.DictReader(weights.path.with_suffix(".csv").open())}
    assert stages == ({"flow"} if weights.model.config.latents_are_atoms else {"autoencoder", "flow"})


def test_settings_for_many_molecules_are_laid_over_sizes_that_suit_their_latents() -> None:
    plain = LamSlideConfig.of_many({})
    assert plain.latents_are_atoms and plain.approximator.width == 128
    of_set = LamSlideConfig.of_many({"atoms": {"latents": "set"}})
    assert of_set.graph and not of_set.latents_are_atoms and of_set.approximator == LamSlideConfig().approximator
    own = LamSlideConfig.of_many({"approximator": {"n_layers": 2}, "atoms": {"width": 8}})
    assert (own.approximator.n_layers, own.approximator.chunk_frames, own.atoms.width) == (2, 8, 8)
    with pytest.raises(InputError, match="widht"):
        LamSlideConfig.of_many({"atoms": {"widht": 8}})


def test_the_standard_pose_follows_the_molecule(write: Write) -> None:
    for text in ("CCCO", "C[C@H](N)C(=O)O"):
        scene = smiles(text)
        q, r = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))
        turn = q * np.sign(np.diag(r))
        turn *= np.sign(np.linalg.det(turn))
        base, moved = in_standard_pose(scene), in_standard_pose(scene.with_positions(scene.positions_nm @ turn.T - 1.0))
        np.testing.assert_allclose(moved.positions_nm, base.positions_nm, rtol=0, atol=1e-9)
        assert np.abs(base.positions_nm - scene.positions_nm).max() > 0.02
        mirrored = in_standard_pose(scene.with_positions(scene.positions_nm * [1, 1, -1]))
        assert np.abs(mirrored.positions_nm - base.positions_nm).max() > 0.02, "a mirror image is another shape"
    path = write(smiles("CCCO"), "propanol")
    posed, plain = collect_sets([path]).trained[0], collect_frames([path])
    idx = np.arange(5)
    assert np.abs(posed.positions_nm(idx).mean(0) - posed.scene.positions_nm).max() < 0.02
    apart = lambda x: np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)  # noqa: E731
    np.testing.assert_allclose(apart(posed.positions_nm(idx)), apart(plain.positions_nm(idx)), rtol=0, atol=1e-6)
    assert isinstance(FrameSets((posed,)).names, str)


def test_handedness_means_the_same_in_every_molecule() -> None:
    left = {text: set(local_handedness(smiles(text)).values()) for text in ("C[C@H](N)C(=O)O", "CC[C@H](N)C(=O)NC")}
    assert len(set.union(*left.values())) == 1, left
    right = set(local_handedness(smiles("C[C@@H](N)C(=O)O")).values())
    assert right == {-s for s in left["C[C@H](N)C(=O)O"]}
    assert local_handedness(smiles("CCO")) == {}
