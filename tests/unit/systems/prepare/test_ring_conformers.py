"""Conformers of other ring puckers: both chairs, the same molecule, none where none is to be had."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from systems.chemistry.geometry import torsion
from systems.chemistry.validity import CHIRALITY, check_frames, geometry_from_scene
from systems.library.named_scenes import load, prepare
from systems.prepare.ring_conformers import conformer_of, ring_conformers


def test_both_chairs_of_methylcyclohexane_are_found() -> None:
    scene = prepare("smiles:CC1CCCCC1")
    found = ring_conformers(scene)
    np.testing.assert_array_equal(found[0], scene.positions_nm)
    assert len(found) == 2
    # Methyl to the ring's third atom: gauche where it is axial, anti where it is equatorial.
    methyl = np.abs(np.degrees(np.asarray(torsion(found, np.array([[0, 1, 2, 3]])))[:, 0]))
    assert sorted(methyl) == pytest.approx([70.0, 178.0], abs=8.0)


def test_the_chair_of_a_sugar_that_costs_too_much_and_other_hands_are_left_out() -> None:
    glucose = prepare("smiles:OC[C@H]1OC(O)[C@H](O)[C@@H](O)[C@@H]1O")
    assert len(ring_conformers(glucose)) == 1
    dimethyl = prepare("smiles:C[C@H]1CCCC[C@H]1C")
    found = ring_conformers(dimethyl)
    assert len(found) > 1 and not (check_frames(found, geometry_from_scene(dimethyl)) & CHIRALITY).any()


@pytest.mark.parametrize("text", ["smiles:Cc1ccccc1", "smiles:C1CCCC1", "smiles:CCCCCC"])
def test_flat_and_small_rings_have_their_own_alone(text: str) -> None:
    assert len(ring_conformers(prepare(text))) == 1


def test_what_rdkit_cannot_tell_is_left_as_it_is() -> None:
    scene = prepare("smiles:CC1CCCCC1")
    assert len(ring_conformers(replace(scene, bond_orders=0.0 * scene.bond_orders))) == 1
    assert len(ring_conformers(load("alanine-dipeptide"))) == 1


def test_two_replicas_of_three_keep_the_structure_given() -> None:
    assert [conformer_of(k, 3) for k in range(9)] == [0, 0, 1, 0, 0, 2, 0, 0, 1]
    assert {conformer_of(k, 1) for k in range(9)} == {0}
