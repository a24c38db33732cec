"""Whether weights cover a scene: one molecule, unseen peptides, and the choice among those that are shipped."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.models.weights import Weights, load_weights
from surrogate.sampling import domain as choice
from surrogate.sampling.domain import bond_types, choose_weights, find_deviations, match_domain, torsion_environments
from systems.chemistry.geometry import signed_volumes
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
    ("spec", "expected"),
    [
        ("sequence:ACE-ALA-ALA-NME", {"size"}),
        ("sequence:ACE-GLY-NME", {"size", "torsion environments"}),
        ("smiles:CC(=O)N[C@@H](C)C(=O)[O-]", {"size", "charge"}),
        ("smiles:C[S@](=O)CC", {"elements", "size", "bond types"}),
    ],
)
def test_other_molecules_are_refused_with_each_reason(small_weights: Weights, spec: str, expected: set[str]) -> None:
    scene = prepare(spec)
    found = kinds(scene, small_weights)
    assert expected <= set(found) and not any(found.values())
    for force in (False, True):
        with pytest.raises(OutOfDomainError, match=r"surromd reference.*surromd train") as refused:
            match_domain(scene, small_weights, force=force)
        assert all(what in str(refused.value) for what in expected)


def test_the_sulfur_and_the_new_torsion_are_named(small_weights: Weights) -> None:
    with pytest.raises(OutOfDomainError, match=r"elements: S not seen.*bond types: C-S"):
        match_domain(prepare("smiles:CSC"), small_weights)
    assert torsion_environments(load("alanine-dipeptide")) == {"C(C,H,N)-C(N,O)", "C(C,C,H)-N(C,H)"}
    assert bond_types(load("alanine-dipeptide")) == {"C-C", "C-H", "C-N", "C=O", "H-N"}


def test_an_isomer_with_the_same_formula_has_other_bonds(small_weights: Weights) -> None:
    isomer = prepare("smiles:CNC(=O)[C@H](C)NC(C)=O")  # the molecule itself, drawn backwards
    assert not {"size", "connectivity"} & set(kinds(isomer, small_weights))
    other = prepare("smiles:CC(=O)NCC(C)C(N)=O")
    found = kinds(other, small_weights)
    assert found and not any(found.values())


def test_the_mirror_image_can_be_forced_and_is_named(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    mirrored = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * [1.0, -1.0, 1.0])
    assert kinds(mirrored, small_weights) == {"stereo": True, "start": True}
    with pytest.raises(OutOfDomainError, match=r"mirror image.*`force"):
        match_domain(mirrored, small_weights)
    forced = match_domain(mirrored, small_weights, force=True)
    assert [d.what for d in forced.deviations] == ["stereo", "start"]
    # Every CH3 keeps its labels in the mirror: no hydrogen is exchanged on top of the one inversion.
    methyl = [[1, 0, 2, 3]]
    template = small_weights.domain.scene.positions_nm
    assert signed_volumes(mirrored.positions_nm[forced.order], methyl) * signed_volumes(template, methyl) < 0


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


def test_another_protonation_is_a_matter_of_size_and_charge(small_weights: Weights, alanine_dipeptide: Scene) -> None:
    charged = replace(alanine_dipeptide, formal_charges=np.eye(22, dtype=np.int64)[6])
    assert kinds(charged, small_weights) == {"charge": False}


def test_a_molecule_that_was_trained_on_gets_its_weights() -> None:
    weights, why = choose_weights(load("alanine-dipeptide"))
    assert weights.path.stem == "peptides" and weights.domain.jumps
    assert "trained on this molecule" in why and "alanine-dipeptide would do, too" in why


@pytest.mark.parametrize("sequence", ["ACE-LEU-SER-NME", "GLY-VAL", "ACE-TRP-ARG", "LYS-SER"])
def test_an_unseen_peptide_gets_the_weights_of_peptides(sequence: str) -> None:
    """Capped or with free ends, or both."""
    weights, why = choose_weights(prepare(f"sequence:{sequence}"))
    assert weights.path.stem == "peptides" and "without having seen it" in why


@pytest.mark.parametrize("scene", ["smiles:c1ccccc1", "smiles:CCCCCO", "sequence:ACE-ASH-NME"])
def test_a_molecule_that_none_covers_is_refused_with_a_reason(scene: str) -> None:
    with pytest.raises(OutOfDomainError, match=r"no shipped weights cover .* The nearest: .*does not cover"):
        choose_weights(prepare(scene))


def test_another_temperature_is_covered_by_none() -> None:
    with pytest.raises(OutOfDomainError, match="temperature"):
        choose_weights(load("alanine-dipeptide"), temperature_k=350.0)


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
    for sequence, why in (
        ("LEU-ALA-SER", "3 amino acids with free ends; trained on up to 2"),
        ("SER-LEU", "free ends that no training peptide has: NH3[+]-SER, LEU-COO-"),
    ):
        with pytest.raises(OutOfDomainError, match=why):
            choose_weights(prepare(f"sequence:{sequence}"))


def test_weights_of_another_force_field_are_no_choice_where_one_is_asked_for() -> None:
    paracetamol, peptide = prepare("smiles:CC(=O)Nc1ccc(O)cc1"), load("alanine-dipeptide")
    quantum, classical = {"force_field": "gfn2-xtb", "solvent": "vacuum"}, {"force_field": "ff14SB", "solvent": "obc2"}
    assert choose_weights(paracetamol, conditions=quantum)[0].path.stem == "paracetamol-gfn2-xtb"
    assert choose_weights(peptide, conditions=classical)[0].path.stem == "peptides"
    with pytest.raises(OutOfDomainError, match="other conditions: force_field gfn2-xtb, not ff14SB"):
        choose_weights(paracetamol, conditions=classical)
