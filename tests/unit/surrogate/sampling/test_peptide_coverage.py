"""Weights by residues cover sequences that training never saw, under any program's names; and say where they end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surrogate import api
from surrogate.data import Split, TrainingFrames, canonicalise, quantise
from surrogate.models.architecture import weights_path
from surrogate.models.peptides import trainer
from surrogate.models.peptides.layout import PeptideConfig, chain_features, standard_peptide
from surrogate.models.peptides.model import PeptideSlide
from surrogate.models.peptides.subjects import PeptideSubject
from surrogate.models.peptides.trainer import normalise, with_scale
from surrogate.models.weights import TrainingDomain, Weights, load_weights, read_header, save_weights, training_domain
from surrogate.sampling.domain import find_deviations, match_domain
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.chemistry.graph import backbone_torsions, bonded_graph, turned
from systems.errors import InputError, OutOfDomainError, PreparationError
from systems.files.schema import built
from systems.prepare.peptide import build_peptide
from systems.scene import Scene, reordered
from systems.trajectory.codec import open_trajectory

TRAINED = ("ACE-ALA-NME", "ACE-SER-NME", "ACE-ALA-SER-NME")
SMALL = PeptideConfig(width=32, n_layers=1, n_heads=2, chunk_frames=4, longest_ps=40.0)


def trembling(name: str) -> TrainingFrames:
    scene = build_peptide(name)
    x = scene.positions_nm + 0.003 * np.random.default_rng(0).normal(size=(200, scene.n_atoms, 3))
    conditions = {"force_field": "ff14SB", "solvent": "obc2", "temperature_k": 300.0}
    posed = quantise(canonicalise(x, scene))
    return TrainingFrames(scene, posed, np.array([0, 200]), 1.0, True, conditions, (), split=Split(0.2))


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Weights:
    sets = [trembling(name) for name in TRAINED]
    config = with_scale(SMALL, sets)
    torch.manual_seed(0)
    model = PeptideSlide(config)
    normalise(model, [PeptideSubject(f, chain_features(f.scene, config)) for f in sets], 0)
    domains = [training_domain(f, strides=(1, 2)) for f in sets]
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_weights(path, model, replace(domains[0], further=tuple(domains[1:]), transferable=True), {})
    return load_weights(path)


def as_another_program(scene: Scene, seed: int = 0) -> Scene:
    """Atoms shuffled within residues and all hydrogens renamed, as files of other programs have them."""
    rng = np.random.default_rng(seed)
    order = np.concatenate([
        rng.permutation(np.flatnonzero(scene.residue_of_atom == r)) for r in range(len(scene.residue_names))
    ])  # fmt: skip
    mixed = reordered(scene, order)
    names = tuple(
        f"H{k}" if e == "H" else n for k, (n, e) in enumerate(zip(mixed.atom_names, mixed.elements, strict=True))
    )
    return replace(mixed, atom_names=names)


def test_an_unseen_sequence_is_covered_under_any_names(weights: Weights) -> None:
    built = build_peptide("ACE-SER-ALA-NME")
    scene = as_another_program(built)
    found = match_domain(scene, weights)
    assert not found.deviations and not found.seen
    assert found.domain.scene.atom_names == built.atom_names
    i, j = built.bonds.T
    ours, theirs = scene.positions_nm[found.order], built.positions_nm
    assert np.allclose(np.linalg.norm(ours[i] - ours[j], axis=1), np.linalg.norm(theirs[i] - theirs[j], axis=1))
    remark = found.input_notes("small")[0]
    assert "SER-ALA" in remark and "ALA-NME" not in remark


def test_a_peptide_that_was_trained_on_is_seen(weights: Weights) -> None:
    found = match_domain(as_another_program(build_peptide("ACE-ALA-SER-NME")), weights)
    assert found.seen and found.input_notes("small") == ()


@pytest.mark.parametrize("sequence", ["ACE-GLY-NME", "ALA-SER"])
def test_residues_and_ends_without_training_are_refused_for_good(weights: Weights, sequence: str) -> None:
    for force in (False, True):
        with pytest.raises(OutOfDomainError, match="residues: "):
            match_domain(build_peptide(sequence), weights, force=force)


def test_a_form_that_the_force_field_lacks_at_an_end_hides_no_other() -> None:
    with pytest.raises(PreparationError, match=r"ff14SB lacks .*LYS"):
        build_peptide("HIE-LYN")
    for sequence in ("HID-LYS", "ACE-HID-ASP-GLU-LYS-NME", "ACE-HIP-ASH-LYS-HID-ASP-NME"):
        standard, _ = standard_peptide(as_another_program(build_peptide(sequence)))
        assert standard.name == sequence, "though others of as many hydrogens, or more, are tried before it"


def test_d_residues_are_refused(weights: Weights) -> None:
    scene = build_peptide("ACE-SER-ALA-NME")
    mirrored = scene.with_positions(scene.positions_nm * np.array([1.0, 1.0, -1.0]))
    assert [d.what for d in find_deviations(mirrored, weights.domain, model=weights.model)] == ["residues"]


def test_longer_and_strained_peptides_roll_when_forced(weights: Weights) -> None:
    long = build_peptide("ACE-SER-ALA-SER-NME")
    assert [d.what for d in find_deviations(long, weights.domain, model=weights.model)] == ["size"]
    assert match_domain(long, weights, force=True).deviations
    scene = build_peptide("ACE-SER-ALA-NME")
    strained = scene.with_positions(1.5 * scene.positions_nm)
    assert [d.what for d in find_deviations(strained, weights.domain, model=weights.model)] == ["start"]
    omega = backbone_torsions(scene)["omega"][1].tolist()
    cis = scene.with_positions(turned(scene.positions_nm, omega, np.pi, bonded_graph(scene)))
    found = match_domain(cis, weights, force=True).deviations
    assert {d.what for d in found} == {"start"} and "peptide bond is cis" in found[-1].reason


def test_info_says_how_near_training_comes(weights: Weights) -> None:
    unseen = api.info(weights.path, "sequence:ACE-SER-ALA-NME")
    assert unseen["covered"] == "yes" and "SER-ALA" in unseen["training"] and "reason" not in unseen
    assert "trained on this molecule" in api.info(weights.path, "sequence:ACE-ALA-SER-NME")["training"]
    longer = api.info(weights.path, "sequence:ACE-SER-ALA-SER-NME")
    assert longer["covered"] == "only with force" and "3 amino acids" in longer["reason"]
    assert api.info(weights.path, "sequence:ACE-GLY-NME")["covered"] == "no"
    with pytest.raises(InputError, match="nor shipped weights of that name"):
        api.info("alanine", "sequence:ACE-GLY-NME")
    with pytest.raises(InputError, match="no weights file"):
        api.info(Path(__file__), "sequence:ACE-GLY-NME")


def test_an_unseen_peptide_rolls_in_the_order_of_its_file(weights: Weights, tmp_path: Path) -> None:
    scene = as_another_program(build_peptide("ACE-SER-ALA-NME"), 3)
    rollout(scene, weights, [tmp_path / "out.h5"], RolloutConfig(time_ps=40.0, seed=1, guard="flag"))
    with open_trajectory(tmp_path / "out.h5") as reader:
        assert reader.scene.atom_names == scene.atom_names
        x = reader.read().astype(np.float64)
    i, j = scene.bonds.T
    lengths = np.linalg.norm(x[:, i] - x[:, j], axis=-1)
    start = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=-1)
    assert np.abs(lengths - start).max() < 0.03
    assert np.abs(lengths - np.roll(start, 1)).max() > 0.03, "bonds of another order would be seen"


def test_without_its_model_a_domain_of_peptides_covers_those_trained_on_alone() -> None:
    header = read_header(weights_path("peptides"))
    assert find_deviations(build_peptide("ACE-ALA-NME"), header.domain) == ()
    unseen = find_deviations(build_peptide("ACE-LEU-SER-NME"), header.domain)
    assert [(d.what, d.forcible) for d in unseen] == [("molecule", False)]


def test_of_many_peptides_the_larger_are_known_by_their_residues(
    weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer, "_WHOLE", 2)
    domain = trainer.peptides_domain([trembling(name) for name in reversed(TRAINED)], weights.model.config)
    assert [d.scene.name for d in domain.members] == list(TRAINED[1::-1]) and domain.sequences == TRAINED[2:]
    assert built(TrainingDomain, domain.to_dict()).sequences == domain.sequences and "3 molecules" in domain.describe()
    # Where a part of weights stays, what they cover stays covered, the larger by their residues.
    first = trainer.peptides_domain([trembling(name) for name in TRAINED[:2]], weights.model.config)
    whole = replace(first, further=(*first.further, replace(domain, scene=build_peptide(TRAINED[2]), sequences=())))
    kept = trainer.peptides_domain([trembling(name) for name in TRAINED[:2]], weights.model.config, whole)
    assert (kept.members[1:], kept.sequences) == (first.members[1:], TRAINED[2:])
    more = [trembling(name) for name in TRAINED[1:]]
    further = trainer.peptides_domain(more, weights.model.config, first)
    assert further.members[1:] == first.members[1:] and further == replace(
        first, sequences=TRAINED[2:], further=further.further
    )
    warm = [replace(frames, conditions={**frames.conditions, "temperature_k": 350.0}) for frames in more]
    assert (
        trainer.peptides_domain(warm, weights.model.config, first).peptides
        == trainer.peptides_domain(warm, weights.model.config).peptides
    )
    pair = build_peptide(TRAINED[2])
    for known, seen in ((domain, True), (replace(domain, sequences=()), False)):
        match = match_domain(pair, replace(weights, domain=known), force=True)
        assert match.seen == seen and bool(match.input_notes("w")) != seen
        assert match.domain.sequences == () and match.domain.scene.residue_names == pair.residue_names
    assert [d.what for d in find_deviations(pair, replace(domain, sequences=()), model=weights.model)] == ["size"]
