"""Weights that the user does not name: those that were trained on the molecule, else those that cover it."""

from __future__ import annotations

from pathlib import Path

import pytest

from surrogate.models.weights import Weights, load_weights
from surrogate.sampling import domain as choice
from surrogate.sampling.domain import choose_weights
from systems.errors import OutOfDomainError
from systems.library.named_scenes import load, prepare


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
