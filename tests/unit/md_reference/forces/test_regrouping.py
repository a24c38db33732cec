"""Scenes whose residues no template knows by name or extent: parametrised by their bonds, in their own atom order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from openmm import NonbondedForce

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import permuted, regroup
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.simulate import MDConfig, simulate
from systems.errors import PreparationError
from systems.library.named_scenes import prepare
from systems.scene import IntArray, Scene, part_of, reordered
from systems.trajectory.codec import open_trajectory
from systems.trajectory.companion_writer import pdb_text

SPECS = {
    "ff14SB": ForceFieldSpec(),
    "ff99SB-ILDN": ForceFieldSpec("ff99SB-ILDN", "obc2", hydrogen_mass_da=None),
    "amber99-obc": ForceFieldSpec("ff99SB-ILDN", "amber99-obc"),
    "vacuum": ForceFieldSpec(solvent="vacuum", constrain_hydrogens=False),
}


@pytest.mark.parametrize("solvent", ["obc2", "tip3p", "opc"])
def test_ff99sb_ildn_takes_the_ions_of_its_water(solvent: str) -> None:
    spec = ForceFieldSpec("ff99SB-ILDN", solvent)
    wet = ForceFieldSpec("ff14SB", "tip3p") if solvent == "obc2" else spec
    scene = solvate(prepare("ACE-GLY-NME"), wet, WaterBox(ionic_strength_molar=0.15))
    if solvent == "obc2":
        is_ion = np.isin(scene.elements, ["Na", "Cl"])
        scene = replace(part_of(scene, np.flatnonzero(is_ion | (np.arange(scene.n_atoms) < 19))), cell_nm=None)
    system = build_system(scene, spec)
    force = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    charges = [force.getParticleParameters(k)[0]._value for k in range(system.getNumParticles())]
    assert sum(charges) == pytest.approx(scene.formal_charges.sum(), abs=1e-6)


def shuffled(scene: Scene, order: IntArray) -> Scene:
    """Atom k of the result is atom order[k]; as in files, each run of atoms of one residue becomes a residue."""
    old = scene.residue_of_atom[order]
    starts = np.concatenate([[True], old[1:] != old[:-1]])
    runs = old[starts]
    return replace(
        reordered(scene, order),
        name="shuffled",
        residue_of_atom=np.cumsum(starts) - 1,
        residue_names=tuple(scene.residue_names[r] for r in runs),
        residue_ids=tuple(scene.residue_ids[r] for r in runs),
        chain_of_residue=tuple(scene.chain_of_residue[r] for r in runs),
    )


def as_one_residue(scene: Scene, name: str = "UNL") -> Scene:
    return replace(
        scene,
        name=name.lower(),
        residue_of_atom=np.zeros(scene.n_atoms, dtype=np.int64),
        residue_names=(name,),
        residue_ids=("1",),
        chain_of_residue=("A",),
    )


@pytest.fixture
def order(alanine_dipeptide: Scene) -> IntArray:
    return np.random.default_rng(4).permutation(alanine_dipeptide.n_atoms)


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
@pytest.mark.parametrize("form", ["one residue", "one residue, shuffled", "residues interleaved"])
def test_same_system_as_the_library_scene(
    alanine_dipeptide: Scene, order: IntArray, form: str, spec: ForceFieldSpec
) -> None:
    order = np.arange(22) if form == "one residue" else order
    scene = shuffled(alanine_dipeptide, order)
    if form != "residues interleaved":
        scene = as_one_residue(scene)
    rng = np.random.default_rng(0)
    with (
        Engine(alanine_dipeptide, Conditions(force=spec)) as expected,
        Engine(scene, Conditions(force=spec)) as engine,
    ):
        assert engine.n_constraints == expected.n_constraints
        for _ in range(3):
            x = alanine_dipeptide.positions_nm + rng.normal(scale=0.005, size=(22, 3))
            assert engine.energy(x[order]) == pytest.approx(expected.energy(x), abs=1e-8)
            np.testing.assert_allclose(engine.forces(), expected.forces()[order], atol=1e-6)
        # Negative control: the atoms in any other order are another geometry.
        if form != "one residue":
            assert abs(engine.energy(x) - expected.energy(x)) > 1.0


def test_masses_and_constraints_follow_their_atoms(alanine_dipeptide: Scene, order: IntArray) -> None:
    scene = as_one_residue(shuffled(alanine_dipeptide, order))
    ours, theirs = build_system(scene, ForceFieldSpec()), build_system(alanine_dipeptide, ForceFieldSpec())
    masses = [theirs.getParticleMass(i)._value for i in range(22)]
    assert [ours.getParticleMass(k)._value for k in range(22)] == [masses[i] for i in order]
    for k in range(ours.getNumConstraints()):
        i, j, _ = ours.getConstraintParameters(k)
        assert "H" in (scene.elements[i], scene.elements[j])
        assert [min(i, j), max(i, j)] in scene.bonds.tolist()


def test_residues_follow_the_chain_whatever_the_order_of_atoms() -> None:
    peptide = prepare("sequence:ACE-GLY-SER-ALA-NME")
    for seed in range(3):
        mixed = np.random.default_rng(seed).permutation(peptide.n_atoms)
        found, order = regroup(shuffled(peptide, mixed))
        assert found.residue_names == peptide.residue_names
        assert sorted(order.tolist()) == list(range(peptide.n_atoms))
        assert [found.elements.count(e) for e in "CHNO"] == [peptide.elements.count(e) for e in "CHNO"]
        for residue in range(5):
            ours = sorted(n for n, r in zip(found.atom_names, found.residue_of_atom, strict=True) if r == residue)
            theirs = sorted(n for n, r in zip(peptide.atom_names, peptide.residue_of_atom, strict=True) if r == residue)
            assert ours == theirs
    with Engine(peptide, Conditions()) as a, Engine(as_one_residue(peptide), Conditions()) as b:
        assert b.energy() == pytest.approx(a.energy(), abs=1e-8)


def test_a_mirror_image_has_the_energy_of_its_original(alanine_dipeptide: Scene) -> None:
    mirrored = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm * [1.0, 1.0, -1.0])
    with (
        Engine(alanine_dipeptide, Conditions()) as left,
        Engine(as_one_residue(mirrored), Conditions()) as right,
    ):
        assert right.energy() == pytest.approx(left.energy(), abs=1e-8)


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside a peptide"])
def test_what_no_template_fits_is_one_clear_line(alanine_dipeptide: Scene, beside: bool) -> None:
    methanol = Scene(
        name="methanol",
        atom_names=("C", "O", "H", "H1", "H2", "H3"),
        elements=("C", "O", "H", "H", "H", "H"),
        residue_of_atom=np.zeros(6, dtype=np.int64),
        residue_names=("MOH",),
        residue_ids=("7",),
        chain_of_residue=("B",),
        bonds=np.array([[0, 1], [1, 2], [0, 3], [0, 4], [0, 5]]),
        bond_orders=np.ones(5),
        formal_charges=np.zeros(6, dtype=np.int64),
        masses_da=np.array([12.011, 15.999, 1.008, 1.008, 1.008, 1.008]),
        positions_nm=np.random.default_rng(0).normal(size=(6, 3)),
    )
    scene = _side_by_side(alanine_dipeptide, methanol) if beside else methanol
    with pytest.raises(PreparationError) as caught:
        build_system(scene, ForceFieldSpec())
    message = str(caught.value)
    assert "\n" not in message
    assert "has no parameters for residue MOH" in message
    assert "(C H4 O)" in message
    assert repr(scene.name) in message


def _side_by_side(a: Scene, b: Scene) -> Scene:
    return replace(
        a,
        atom_names=a.atom_names + b.atom_names,
        elements=a.elements + b.elements,
        residue_of_atom=np.concatenate([a.residue_of_atom, b.residue_of_atom + len(a.residue_names)]),
        residue_names=a.residue_names + b.residue_names,
        residue_ids=a.residue_ids + b.residue_ids,
        chain_of_residue=a.chain_of_residue + b.chain_of_residue,
        bonds=np.concatenate([a.bonds, b.bonds + a.n_atoms]),
        bond_orders=np.concatenate([a.bond_orders, b.bond_orders]),
        formal_charges=np.concatenate([a.formal_charges, b.formal_charges]),
        masses_da=np.concatenate([a.masses_da, b.masses_da]),
        positions_nm=np.concatenate([a.positions_nm, b.positions_nm + 1.0]),
    )


def test_a_missing_hydrogen_is_named_with_its_residue(alanine_dipeptide: Scene) -> None:
    last = alanine_dipeptide.n_atoms - 1
    keep = np.delete(np.arange(last + 1), alanine_dipeptide.atom_names.index("HB1"))
    where = np.full(last + 1, -1)
    where[keep] = np.arange(last)
    bonds = where[alanine_dipeptide.bonds]
    kept = (bonds >= 0).all(axis=1)
    scene = replace(
        alanine_dipeptide,
        atom_names=tuple(alanine_dipeptide.atom_names[i] for i in keep),
        elements=tuple(alanine_dipeptide.elements[i] for i in keep),
        residue_of_atom=alanine_dipeptide.residue_of_atom[keep],
        bonds=bonds[kept],
        bond_orders=alanine_dipeptide.bond_orders[kept],
        formal_charges=alanine_dipeptide.formal_charges[keep],
        masses_da=alanine_dipeptide.masses_da[keep],
        positions_nm=alanine_dipeptide.positions_nm[keep],
    )
    with pytest.raises(PreparationError, match="residue ALA 2"):
        build_system(scene, ForceFieldSpec())


def test_an_unknown_force_is_not_guessed_at(alanine_dipeptide: Scene) -> None:
    import openmm

    system = build_system(alanine_dipeptide, ForceFieldSpec())
    system.addForce(openmm.CustomExternalForce("x"))
    with pytest.raises(PreparationError, match="CustomExternalForce"):
        permuted(system, np.arange(22)[::-1].copy())


def test_reference_of_a_file_in_one_residue(alanine_dipeptide: Scene, order: IntArray, tmp_path: Path) -> None:
    (tmp_path / "some.pdb").write_text(pdb_text(as_one_residue(shuffled(alanine_dipeptide, order))))
    scene = prepare(str(tmp_path / "some.pdb"))
    assert scene.residue_names == ("UNL",)
    out = simulate(scene, MDConfig(time_ps=0.4, save_every_ps=0.1, equilibrate_ps=0.4), tmp_path / "a.h5")
    with open_trajectory(out) as reader:
        assert reader.n_frames == 4
        x = reader.read()
    lengths = np.linalg.norm(x[:, scene.bonds[:, 0]] - x[:, scene.bonds[:, 1]], axis=2)
    assert lengths.min() > 0.09
    assert lengths.max() < 0.17
