"""Whether weights cover a scene: one molecule, unseen peptides, and the choice among those that are shipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.models.weights import Weights, load_weights
from surrogate.sampling import domain as choice
from surrogate.sampling.domain import choose_weights, find_deviations, match_domain
from systems.errors import OutOfDomainError
from systems.library.named_scenes import load, prepare
from systems.scene import Scene


def kinds(scene: Scene, weights: Weights, **asked: float) -> dict[str, bool]:
    """What deviates, and whether it can be forced."""
    return {d.what: d.forcible for d in find_deviations(scene, weights.domain, **asked)}


def test_the_training_molecule_is_covered_in_any_atom_order(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    assert find_deviations(alanine_dipeptide, small_weights.domain, temperature_k=300.0) == ()
    found = match_domain(alanine_dipeptide, small_weights, temperature_k=300.4)
    assert np.array_equal(found.order, np.arange(22)) and found.deviations == ()


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ("sequence:ACE-ALA-ALA-NME", "is C9H17N3O3, but .* is C6H12N2O2"),
        ("smiles:C[S@](=O)CC", "is C3H8OS, but"),
        ("smiles:CC(=O)NCC(C)C(N)=O", "but other bonds"),
    ],
)
def test_other_molecules_are_refused_with_the_reason(small_weights: Weights, spec: str, reason: str) -> None:
    scene = prepare(spec)
    assert kinds(scene, small_weights) == {"molecule": False}
    for force in (False, True):
        with pytest.raises(OutOfDomainError, match=rf"{reason}.*surromd reference.*surromd train"):
            match_domain(scene, small_weights, force=force)


def test_the_molecule_drawn_backwards_is_the_same(small_weights: Weights) -> None:
    assert "molecule" not in kinds(prepare("smiles:CNC(=O)[C@H](C)NC(C)=O"), small_weights)


def test_the_mirror_image_is_another_molecule(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    mirrored = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * [1.0, -1.0, 1.0])
    assert kinds(mirrored, small_weights) == {"molecule": False}
    with pytest.raises(OutOfDomainError, match="mirror image"):
        match_domain(mirrored, small_weights, force=True)


def test_a_strained_start_and_another_temperature_can_be_forced(
    small_weights: Weights, alanine_dipeptide: Scene
) -> None:
    strained = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * 1.6)
    assert kinds(strained, small_weights, temperature_k=350.0) == {"start": True, "temperature": True}
    with pytest.raises(OutOfDomainError, match=r"start: .*bond more than 0.5 Å off.*350 K, trained at 300 K"):
        match_domain(strained, small_weights, temperature_k=350.0)
    assert len(match_domain(strained, small_weights, temperature_k=350.0, force=True).deviations) == 2
    for nearly in (299.6, 300.4):
        assert kinds(alanine_dipeptide, small_weights, temperature_k=nearly) == {}
    assert kinds(alanine_dipeptide, small_weights, temperature_k=301.0) == {"temperature": True}


def test_a_start_that_is_no_number_cannot_be_forced(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    positions = alanine_dipeptide.positions_nm.copy()
    positions[5, 1] = np.nan
    with pytest.raises(OutOfDomainError, match="not finite"):
        match_domain(alanine_dipeptide.with_positions(positions), small_weights, force=True)


def test_another_protonation_is_another_molecule(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    charged = replace(alanine_dipeptide, formal_charges=np.eye(22, dtype=np.int64)[6])
    with pytest.raises(OutOfDomainError, match=r"has charge [+]1"):
        match_domain(charged, small_weights)


def test_a_molecule_that_was_trained_on_gets_its_weights() -> None:
    weights, why = choose_weights(load("alanine-dipeptide"))
    assert weights.path.stem == "peptides" and weights.domain.jumps
    assert "trained on this molecule" in why and "alanine-dipeptide would also work" in why


@pytest.mark.parametrize("sequence", ["ACE-LEU-SER-NME", "GLY-VAL", "ACE-TRP-ARG", "LYS-SER"])
def test_an_unseen_peptide_gets_the_weights_of_peptides(sequence: str) -> None:
    """Capped or with free ends, or both."""
    weights, why = choose_weights(prepare(f"sequence:{sequence}"))
    assert weights.path.stem == "peptides" and "not in their training set" in why


@pytest.mark.parametrize("scene", ["smiles:C[Si](C)(C)C", "smiles:CB(O)O", "smiles:CC[O]"])
def test_a_molecule_that_none_covers_is_refused_with_a_reason(scene: str) -> None:
    with pytest.raises(OutOfDomainError, match=r"no shipped weights cover .* The nearest: .*does not cover"):
        choose_weights(prepare(scene))


def test_another_temperature_is_covered_by_none() -> None:
    with pytest.raises(OutOfDomainError, match="temperature"):
        choose_weights(load("alanine-dipeptide"), temperature_k=350.0)
    drug = choose_weights(prepare("smiles:CC(=O)Nc1ccc(O)cc1"), temperature_k=350.0)[0]
    assert drug.path.stem == "paracetamol-gfn2-xtb", "but by a potential"


def test_only_the_weights_chosen_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[str] = []

    def load_one(path: Path) -> Weights:
        loaded.append(path.stem)
        return load_weights(path)

    monkeypatch.setattr(choice, "load_weights", load_one)
    choose_weights(load("alanine-dipeptide"))
    assert loaded == ["peptides"]


def test_the_nearest_weights_are_those_that_could_be_forced() -> None:
    """So many residues are more than these weights saw, which `force` allows; others lack elements, which it does
    not."""
    nearest = "The nearest: peptides.safetensors does not cover .* 5 amino acids; trained on up to 4"
    with pytest.raises(OutOfDomainError, match=nearest):
        choose_weights(prepare("sequence:ACE-LEU-SER-ALA-GLY-VAL-NME"))
    for sequence, solvent, why in (
        ("LEU-ALA-SER-ALA-GLY", "obc2", "5 amino acids with free ends; trained on up to 4"),
        ("SER-PHE", "tip3p", "free ends that no training peptide has: .*PHE-COO-"),
    ):
        with pytest.raises(OutOfDomainError, match=why):
            choose_weights(prepare(f"sequence:{sequence}"), conditions={"solvent": solvent})
    assert choose_weights(prepare("sequence:SER-PHE"))[0].path.stem == "peptides"


def test_weights_of_another_force_field_are_no_choice_where_one_is_asked_for() -> None:
    paracetamol, peptide = prepare("smiles:CC(=O)Nc1ccc(O)cc1"), load("alanine-dipeptide")
    quantum, classical = {"force_field": "gfn2-xtb", "solvent": "vacuum"}, {"force_field": "ff14SB", "solvent": "obc2"}
    assert choose_weights(paracetamol, conditions=quantum)[0].path.stem == "paracetamol-gfn2-xtb"
    assert choose_weights(peptide, conditions=classical)[0].path.stem == "peptides"
    drug = prepare("smiles:CCO")
    assert choose_weights(drug, conditions=quantum)[0].path.stem == "drug-like-gfn2-xtb"
    with pytest.raises(
        OutOfDomainError, match="The nearest: drug-like-gfn2-xtb, where its level is asked for: `level='gfn2"
    ):
        choose_weights(drug)
    with pytest.raises(OutOfDomainError, match="other conditions: force_field gfn2-xtb, not ff14SB"):
        choose_weights(paracetamol, conditions=classical)
