"""Keys, stereo, torsions and matching, each with a molecule that must be told apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from time import process_time

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from small_scenes import n_unpaired_electrons
from systems.chemistry import graph as graphs
from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.geometry import signed_volumes, superpose, torsion
from systems.chemistry.graph import (
    atom_classes,
    backbone_torsions,
    bonded_graph,
    exclusions,
    match_atoms,
    molecule_key,
    ring_bonds,
    rotatable_torsions,
    stereocentres,
    turn_torsions,
    turned,
)
from systems.errors import OutOfDomainError
from systems.library.named_scenes import load
from systems.prepare.molecule import scene_from_smiles
from systems.scene import Scene, part_of

ALA2 = load("alanine-dipeptide")
MAKE = Callable[..., Scene]

SYMMETRIC = [
    "CC(C)(C)C",
    "C1CCCCC1",
    "CC(C)C[C@H](NC(C)=O)C(=O)N[C@@H](C(C)C)C(=O)NC",
    "CCO",
    "CC",
    "C",
    "O",
    "[NH4+]",
    "NC(=[NH2+])NCC",
    "CN(C)C=O",
    "CC(=O)Nc1ccc(O)cc1",
    "c1ccc2ccccc2c1",
    "C12C3C4C1C5C2C3C45",
    "CC#N",
]


def _inverted_groups(scene: Scene, template: Scene, order: np.ndarray) -> int:
    graph = bonded_graph(template)
    rows = [[i, *sorted(graph[i])[:3]] for i in graph if graph.degree(i) == 4]
    if not rows:
        return 0
    ours = signed_volumes(scene.positions_nm[order], rows)
    return int((np.sign(ours) != np.sign(signed_volumes(template.positions_nm, rows))).sum())


def _is_isomorphism(scene: Scene, template: Scene, order: np.ndarray) -> bool:
    ours = {tuple(sorted(b)) for b in scene.bonds.tolist()}
    image = {tuple(sorted(order[list(b)].tolist())) for b in template.bonds.tolist()}
    same = all(scene.elements[i] == e for i, e in zip(order, template.elements, strict=True))
    return same and image == ours and sorted(order.tolist()) == list(range(scene.n_atoms))


# ---- keys and stereo ----------------------------------------------------------------------------------------------


@given(order=st.permutations(range(22)), seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_key_and_match_survive_permutation_rotation_and_renaming(order: list[int], seed: int) -> None:
    where = np.argsort(order)
    turned = ALA2.positions_nm @ Rotation.random(random_state=seed).as_matrix().T + 3.0
    other = Scene(
        name="other",
        atom_names=tuple(f"Q{i}" for i in order),
        elements=tuple(ALA2.elements[i] for i in order),
        residue_of_atom=np.zeros(22, dtype=np.int64),
        residue_names=("UNL",),
        residue_ids=("7",),
        chain_of_residue=("Z",),
        bonds=where[ALA2.bonds],
        bond_orders=np.zeros(len(ALA2.bonds)),
        formal_charges=np.zeros(22, dtype=np.int64),
        masses_da=ALA2.masses_da[order],
        positions_nm=turned[order],
    )
    assert molecule_key(other) == molecule_key(ALA2)
    found = match_atoms(other, ALA2)
    assert np.array(order)[found].tolist() == list(range(22))


def test_mirror_image_has_another_key_and_is_refused_by_name(mirrored: MAKE) -> None:
    d_alanine = mirrored(ALA2)
    assert molecule_key(d_alanine) != molecule_key(ALA2)
    with pytest.raises(OutOfDomainError, match="enantiomer"):
        match_atoms(d_alanine, ALA2)
    rows = stereocentres(ALA2)
    assert rows.shape == (1, 4)
    assert rows[0, 0] == 8
    assert 9 not in rows  # the hydrogen is left out
    assert (stereocentres(d_alanine) == rows).all()
    assert signed_volumes(ALA2.positions_nm, rows) * signed_volumes(d_alanine.positions_nm, rows) < 0


def test_achiral_molecules_equal_their_mirror_image(from_smiles: MAKE, mirrored: MAKE) -> None:
    for smiles in ("CCO", "C[C@H](O)[C@H](O)C", "C[C@H]1CC[C@H](C)CC1", "c1ccccc1"):
        scene = from_smiles(smiles)
        assert molecule_key(scene) == molecule_key(mirrored(scene)), smiles
        assert _inverted_groups(mirrored(scene), scene, match_atoms(mirrored(scene), scene)) == 0


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("C[C@H](O)[C@@H](O)C", "C[C@H](O)[C@H](O)C"),
        ("C[C@H]1CC[C@H](C)CC1", "C[C@H]1CC[C@@H](C)CC1"),
        ("C/C=C/C", "C/C=C\\C"),
        ("C1CCC(C1)C1CCCC1", "C1CCC2CCCCC2C1"),
        ("CCCO", "CCOC"),
        ("C[S@](=O)CC", "C[S@@](=O)CC"),
        ("CC(=O)O", "CC(=O)[O-]"),
    ],
    ids=["meso", "ring-cis-trans", "E-Z", "decalin", "constitution", "sulfoxide", "protonation"],
)
def test_isomers_have_different_keys_and_do_not_match(from_smiles: MAKE, one: str, other: str) -> None:
    a, b = from_smiles(one), from_smiles(other)
    assert molecule_key(a) == molecule_key(from_smiles(one, seed=5))
    assert molecule_key(a) != molecule_key(b)
    with pytest.raises(OutOfDomainError):
        match_atoms(b, a)


def test_refusals_say_why(from_smiles: MAKE) -> None:
    with pytest.raises(OutOfDomainError, match="C2H6O"):
        match_atoms(from_smiles("CCO"), ALA2)
    with pytest.raises(OutOfDomainError, match="other bonds"):
        match_atoms(from_smiles("COC"), from_smiles("CCO"))
    with pytest.raises(OutOfDomainError, match="stereoisomer"):
        match_atoms(from_smiles("C/C=C/C"), from_smiles("C/C=C\\C"))
    charged = replace(ALA2, formal_charges=np.eye(22, dtype=np.int64)[0])
    with pytest.raises(OutOfDomainError, match=r"charge \+1"):
        match_atoms(charged, ALA2)


def test_classes_count_equivalent_atoms(from_smiles: MAKE) -> None:
    assert len(set(atom_classes(from_smiles("c1ccccc1")).tolist())) == 2
    assert len(set(atom_classes(from_smiles("CC(C)(C)C")).tolist())) == 3
    assert len(set(atom_classes(ALA2).tolist())) == 16


# ---- matching -----------------------------------------------------------------------------------------------------


def test_swapped_methyl_hydrogens_are_put_right(reordered: MAKE) -> None:
    order = np.arange(22)
    order[[11, 12]] = [12, 11]
    swapped = reordered(ALA2, order)
    assert _inverted_groups(swapped, ALA2, np.arange(22)) == 1  # taken as they stand, the methyl is inverted
    found = match_atoms(swapped, ALA2)
    assert found.tolist() == order.tolist()
    moved = superpose(swapped.positions_nm[found], ALA2.positions_nm)
    assert np.abs(moved - ALA2.positions_nm).max() < 1e-9


def test_another_conformation_matches_without_inverted_groups(reordered: MAKE) -> None:
    rng = np.random.default_rng(3)
    x = ALA2.positions_nm.copy()
    for b, c, tail in ((8, 14, range(15, 22)), (6, 8, range(9, 22)), (8, 10, range(11, 14))):
        axis = (x[c] - x[b]) / np.linalg.norm(x[c] - x[b])
        turn = Rotation.from_rotvec(axis * rng.uniform(1, 5)).as_matrix()
        x[list(tail)] = (x[list(tail)] - x[c]) @ turn.T + x[c]
    other = reordered(ALA2.with_positions(x), rng.permutation(22))
    found = match_atoms(other, ALA2)
    assert _is_isomorphism(other, ALA2, found)
    assert _inverted_groups(other, ALA2, found) == 0


@pytest.mark.parametrize("smiles", SYMMETRIC)
def test_symmetric_molecules_match_fast_and_keep_hands(from_smiles: MAKE, reordered: MAKE, smiles: str) -> None:
    template = from_smiles(smiles)
    rng = np.random.default_rng(0)
    for seed in range(2, 5):
        scene = reordered(from_smiles(smiles, seed=seed), rng.permutation(template.n_atoms))
        start = process_time()
        order = match_atoms(scene, template)
        assert process_time() - start < 2.0
        assert _is_isomorphism(scene, template, order)
        assert _inverted_groups(scene, template, order) == 0


def test_planar_nh2_is_matched_by_torsion(from_smiles: MAKE, reordered: MAKE) -> None:
    amide = from_smiles("CC(N)=O")
    n = amide.elements.index("N")
    h1, h2 = (j for j in sorted(bonded_graph(amide)[n]) if amide.elements[j] == "H")
    order = np.arange(amide.n_atoms)
    order[[h1, h2]] = [h2, h1]
    assert match_atoms(reordered(amide, order), amide).tolist() == order.tolist()


def test_rigid_methyls_of_dimethylformamide_keep_cis_and_trans(from_smiles: MAKE, reordered: MAKE) -> None:
    dmf = from_smiles("CN(C)C=O")
    carbons = [0, 2]
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(dmf.n_atoms)
        found = match_atoms(reordered(dmf, order), dmf)
        assert order[found][carbons].tolist() == carbons


# ---- graph --------------------------------------------------------------------------------------------------------


def test_backbone_torsions_of_alanine_dipeptide() -> None:
    found = backbone_torsions(ALA2)
    assert found["phi"].tolist() == [[4, 6, 8, 14]]
    assert found["psi"].tolist() == [[6, 8, 14, 16]]
    assert found["omega"].tolist() == [[1, 4, 6, 8], [8, 14, 16, 18]]


def test_backbone_torsions_run_along_the_chain_whatever_the_order(from_smiles: MAKE, reordered: MAKE) -> None:
    side = ["C", "CC(N)=O", "CCC(=O)O", "CO", "C(C)C"]
    smiles = "CC(=O)" + "".join(f"N[C@@H]({s})C(=O)" for s in side) + "N1CCC[C@H]1C(=O)NC"
    scene = from_smiles(smiles)
    order = np.random.default_rng(1).permutation(scene.n_atoms)
    straight, shuffled = backbone_torsions(scene), backbone_torsions(reordered(scene, order))
    for key, n in (("phi", 6), ("psi", 6), ("omega", 7)):
        assert straight[key].shape == (n, 4)
        if key != "omega":
            assert order[shuffled[key]].tolist() == straight[key].tolist()
    assert all(a[3] == b[2] for a, b in zip(straight["phi"], straight["psi"], strict=True))
    assert all(p[3] == f[1] for p, (_, f) in zip(straight["psi"][:-1], pairwise(straight["phi"]), strict=True))
    assert {tuple(r) for r in order[shuffled["omega"]].tolist()} == {tuple(r) for r in straight["omega"].tolist()}
    assert np.abs(np.cos(torsion(scene.positions_nm, straight["omega"]))).min() > 0.8


def test_molecules_without_peptides_have_no_backbone(from_smiles: MAKE) -> None:
    for smiles in ("CCO", "CC(N)=O", "CC(=O)OC"):
        assert all(len(rows) == 0 for rows in backbone_torsions(from_smiles(smiles)).values())


def test_flat_rings_are_no_residues(from_smiles: MAKE) -> None:
    n_psi = {
        "Cn1cnc2c1c(=O)n(C)c(=O)n2C": 0,
        "NC(=O)c1ccccn1": 0,
        "O=C1CNC(=O)CN1": 2,  # a ring of two glycines
        "CC(=O)NC(=C)C(=O)NC": 1,  # dehydroalanine
    }
    for smiles, n in n_psi.items():
        assert len(backbone_torsions(from_smiles(smiles))["psi"]) == n, smiles


def test_exclusions_are_the_short_paths() -> None:
    graph = bonded_graph(ALA2)
    lengths = dict(nx.all_pairs_shortest_path_length(graph))
    for depth in (1, 2, 3):
        expected = {(i, j) for i in graph for j in graph if i < j and lengths[i][j] <= depth}
        assert {tuple(r) for r in exclusions(ALA2, depth).tolist()} == expected
    assert len(exclusions(ALA2, 1)) == len(ALA2.bonds)


def test_rotatable_torsions_and_rings(from_smiles: MAKE) -> None:
    middle = {tuple(sorted(r[1:3])) for r in rotatable_torsions(ALA2).tolist()}
    assert middle == {(6, 8), (8, 14)}
    assert len(rotatable_torsions(ALA2, rotors=True)) == 5
    assert len(rotatable_torsions(from_smiles("C1CCCCC1"))) == 0
    assert len(rotatable_torsions(from_smiles("C=CC=C"))) == 1
    assert len(ring_bonds(from_smiles("C1CCCCC1CC"))) == 6
    assert len(ring_bonds(ALA2)) == 0


def test_a_turned_torsion_grows_by_the_angle_and_nothing_else_changes() -> None:
    graph, at = bonded_graph(ALA2), ALA2.positions_nm
    for quad in rotatable_torsions(ALA2, rotors=True):
        moved = turned(at, quad, 0.7, graph)
        grown = float((torsion(moved, [quad]) - torsion(at, [quad]))[0])
        assert grown % (2.0 * np.pi) == pytest.approx(0.7, abs=1e-9)
        for pairs in (ALA2.bonds, exclusions(ALA2, 2)):
            before, after = (np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) for x in (at, moved))
            assert after == pytest.approx(before, abs=1e-12)
        others = [q for q in rotatable_torsions(ALA2, rotors=True).tolist() if q != quad.tolist()]
        assert torsion(moved, others) == pytest.approx(torsion(at, others), abs=1e-9)


# ---- bond orders --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "smiles",
    [
        "CC(=O)[O-]",
        "NC(=[NH2+])NCC",
        "Cc1c[nH]c[nH+]1",
        "C[N+](=O)[O-]",
        "CS(=O)(=O)C",
        "C[S@](=O)CC",
        "CC#N",
        "[O-]P(=O)([O-])OC",
        "c1ccc2ccccc2c1",
        "Cn1cnc2c1c(=O)n(C)c(=O)n2C",
        "C[NH3+]",
        "CC(=O)Oc1ccccc1C(=O)O",
    ],
)
def test_perceived_orders_and_charges_equal_rdkit(from_smiles: MAKE, smiles: str) -> None:
    scene = from_smiles(smiles)
    orders, charges = perceive(scene.elements, scene.bonds)
    assert sorted(orders) == sorted(scene.bond_orders)
    assert charges.sum() == scene.formal_charges.sum()
    assert sorted(charges) == sorted(scene.formal_charges)


@pytest.mark.parametrize(
    ("smiles", "charge"),
    [
        ("NC(=[NH2+])c1ccccc1", 1),
        ("C[N+]([O-])=Cc1ccccc1", 0),
        ("c1ccc(cc1)-c1ccc2ccccc2[o+]1", 1),
        ("[O-]c1ccccc1", -1),
        ("[C-]#N", -1),
        ("CC[N+]#[C-]", 0),
        ("CC#[N+][O-]", 0),
        ("[O-]c1ccc(cc1)[N+](=O)[O-]", -1),
        ("CN=[N+]=[N-]", 0),
        ("C=[N+]=[N-]", 0),
        ("N#[N+]c1ccccc1", 1),
        ("[O-][n+]1ccccc1", 0),
        ("Cc1ccc(cc1)-c1nn[n-]n1", -1),
        ("O=C1[N-]S(=O)(=O)c2ccccc12", -1),
        ("CS(C)(=O)=N", 0),
        ("C[S+](C)(C)=O", 1),
        ("[O-]Cl(=O)(=O)=O", -1),
        ("F[P-](F)(F)(F)(F)F", -1),
        ("CN(C)c1ccc(cc1)C(=C1C=CC(=[N+](C)C)C=C1)c1ccccc1", 1),
        ("O=C1N(C)C(C)=NC1=Cc1ccc([O-])cc1", -1),
        ("c1ccc(cc1)[C+](c1ccccc1)c1ccccc1", 1),
        ("[CH+]1C=CC=CC=C1", 1),
        ("[CH-]1C=CC=C1", -1),
    ],
)
def test_charges_that_no_matching_finds_are_those_of_the_cheapest_lewis_structure(
    from_smiles: MAKE, smiles: str, charge: int
) -> None:
    scene = from_smiles(smiles)
    orders, charges = perceive(scene.elements, scene.bonds, scene.positions_nm)
    assert charges.sum() == charge
    assert n_unpaired_electrons(replace(scene, bond_orders=orders, formal_charges=charges)) == 0


@pytest.mark.parametrize("smiles", ["Cc1ccccc1C(N)=[NH2+]", "Cc1ccc([O-])cc1", "CSC", "CCN=[N+]=[N-]", "CNC(=O)C"])
def test_no_structure_is_found_for_a_carbon_without_its_hydrogen(from_smiles: MAKE, smiles: str) -> None:
    scene = from_smiles(smiles)
    hydrogens = [j for i, j in scene.bonds.tolist() if (scene.elements[i], scene.elements[j]) == ("C", "H")]
    assert hydrogens
    for hydrogen in hydrogens:
        part = part_of(scene, np.delete(np.arange(scene.n_atoms), hydrogen))
        with pytest.raises(ValenceError):
            perceive(part.elements, part.bonds, part.positions_nm)


def test_missing_hydrogen_is_named(from_smiles: MAKE) -> None:
    scene = from_smiles("CCC")
    hydrogen = scene.n_atoms - 1
    bonds = scene.bonds[(scene.bonds != hydrogen).all(axis=1)]
    with pytest.raises(ValenceError) as caught:
        perceive(scene.elements[:hydrogen], bonds)
    assert len(caught.value.atoms) == 1


def test_torsions_are_turned_in_every_second_state_with_bonds_as_they_were() -> None:
    scene = scene_from_smiles("CCO")
    states = np.repeat(scene.positions_nm[None], 40, axis=0)
    found = states.copy()
    turn_torsions(scene, found, 2, np.random.default_rng(0))
    moved = np.abs(found - states).max((1, 2)) > 1e-3
    assert not moved[1::2].any() and moved[::2].mean() > 0.8
    first, second = scene.bonds.T
    assert np.ptp(np.linalg.norm(found[:, first] - found[:, second], axis=-1), axis=0).max() < 1e-9
    apart = np.linalg.norm(found[:, :, None] - found[:, None], axis=-1) + np.eye(scene.n_atoms)
    assert apart.min() > 0.09
    still = np.zeros((2, 3, 3))  # water has no torsion
    turn_torsions(scene_from_smiles("O"), still, 2, np.random.default_rng(0))
    assert not still.any()


def test_what_follows_from_a_scene_is_worked_out_once_and_shared_read_only(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = ALA2.with_positions(ALA2.positions_nm)
    asked: list[Scene] = []
    find = graphs._double_bonds
    monkeypatch.setattr(graphs, "_double_bonds", lambda scene: asked.append(scene) or find(scene))
    assert molecule_key(scene) == molecule_key(ALA2)
    atom_classes(scene), stereocentres(scene), molecule_key(scene)
    assert asked.count(scene) == 1
    assert bonded_graph(scene) is bonded_graph(scene)
    with pytest.raises(nx.NetworkXError, match="Frozen"):
        bonded_graph(scene).remove_node(0)
    with pytest.raises(ValueError, match="read-only"):
        atom_classes(scene)[0] = 0
    # Another object, of other handedness, gets its own.
    mirrored = scene.with_positions(scene.positions_nm * [1, 1, -1])
    assert molecule_key(mirrored) != molecule_key(scene)
    assert asked.count(mirrored) == 1
