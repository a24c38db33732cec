"""The training domain: what weights cover, what they refuse and why, what may be forced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surrogate.models.weights import Weights
from surrogate.sampling.domain import bond_types, find_deviations, match_domain, torsion_environments
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
