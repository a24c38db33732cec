"""Explicit water: the cell, its contents and its energies, and what fits together."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.mixture import is_water, molecules_of
from md_reference.forces.solvation import solvate, solvate_if_asked
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from systems.errors import InputError, PreparationError
from systems.library.named_scenes import load
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene, part_of

TIP3P = ForceFieldSpec("ff14SB", "tip3p")
AVOGADRO_NM3 = 602.214  # dalton per nm³ in one g/cm³


@cache
def peptide_box() -> Scene:
    return solvate(load("alanine-dipeptide"), TIP3P, WaterBox(padding_nm=0.7, ionic_strength_molar=0.2), seed=3)


def nonbonded(system: Any) -> Any:
    return next(f for f in system.getForces() if type(f).__name__ == "NonbondedForce")


def image_distances(x: FloatArray, y: FloatArray, cell: FloatArray) -> FloatArray:
    """Shortest distance over 27 images for each pair."""
    shifts = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]) @ cell
    return np.min([np.linalg.norm(x[:, None] - y[None] + s, axis=-1) for s in shifts], axis=0)


# ---- the cell ------------------------------------------------------------------------------------------------------


def test_the_solute_comes_first_whole_and_the_box_is_neutral_and_dense() -> None:
    dry, wet = load("alanine-dipeptide"), peptide_box()
    n = dry.n_atoms
    assert wet.elements[:n] == dry.elements and wet.residue_names[:3] == dry.residue_names
    moved = wet.positions_nm[:n] - dry.positions_nm
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-12)
    assert wet.formal_charges.sum() == 0
    assert wet.cell_nm is not None
    density = wet.masses_da.sum() / np.linalg.det(wet.cell_nm) / AVOGADRO_NM3
    assert 0.97 < density < 1.03
    molecules = molecules_of(wet)
    assert sum(is_water(wet.elements, m) for m in molecules) == len(molecules) - 1 - wet.elements.count("Na") * 2
    assert wet.elements.count("Na") == wet.elements.count("Cl") == round(0.2 * sum(map(len, molecules)) / 3 / 55.4)


def test_no_water_touches_the_solute_or_another_water_through_any_wall() -> None:
    wet = peptide_box()
    assert wet.cell_nm is not None
    n = load("alanine-dipeptide").n_atoms
    oxygens = wet.positions_nm[[i for i in range(n, wet.n_atoms) if wet.elements[i] == "O"]]
    gaps = image_distances(oxygens, oxygens, wet.cell_nm)
    np.fill_diagonal(gaps, np.inf)
    assert gaps.min() >= 0.24
    assert image_distances(oxygens, wet.positions_nm[:n], wet.cell_nm).min() > 0.2
    images = image_distances(wet.positions_nm[:n], wet.positions_nm[:n] + wet.cell_nm[2], wet.cell_nm)
    assert images.shape == (n, n)


@pytest.mark.parametrize(
    "source, padding_nm, slanted", [("alanine-dipeptide", 1.0, False), ("alanine-dipeptide", 2.4, True)]
)
def test_the_cell_is_the_smallest_that_keeps_images_apart(source: str, padding_nm: float, slanted: bool) -> None:
    """Of a stretched molecule, eight bonds from tip to tip; a barostat may shrink the cell a little."""
    wet = solvate(load(source), TIP3P, WaterBox(padding_nm=padding_nm))
    cell = np.asarray(wet.cell_nm)
    shifts = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0)])
    nearest = np.linalg.norm(shifts @ cell, axis=1).min()
    assert nearest > 0.99 * (8 * 0.126 + padding_nm) and np.diag(cell).min() > 2 * 0.9 + 0.3
    assert (np.abs(cell - np.diag(np.diag(cell))).max() > 0) == slanted
    # The other shape, as wide as it must be, is larger.
    cube, dodecahedron = (max(8 * 0.126 + padding_nm, 2.15 / h) ** 3 * h for h in (1.0, 0.5**0.5))
    assert np.linalg.det(cell) < 1.02 * min(cube, dodecahedron)


def test_the_volume_is_that_of_one_bar() -> None:
    """OpenMM's mean of 400 ps at 300 K and 1 bar, 325 waters, is 10.077 nm^3; at 350 K water is 5 % less dense."""

    def per_water(wet: Scene) -> float:
        peptide_nm3 = load("alanine-dipeptide").masses_da.sum() * 0.8 / AVOGADRO_NM3
        return float((np.linalg.det(np.asarray(wet.cell_nm)) - peptide_nm3) / wet.residue_names.count("HOH"))

    cold, warm = (solvate(load("alanine-dipeptide"), TIP3P, WaterBox(), temperature_k=t) for t in (300.0, 350.0))
    assert per_water(cold) == pytest.approx((10.077 - 0.1915) / 325, rel=2e-3)
    assert 1.03 < per_water(warm) / per_water(cold) < 1.07


def test_the_seed_decides_alone() -> None:
    scene = load("alanine-dipeptide")
    again = solvate(scene, TIP3P, WaterBox(padding_nm=0.7, ionic_strength_molar=0.2), seed=3)
    other = solvate(scene, TIP3P, WaterBox(padding_nm=0.7, ionic_strength_molar=0.2), seed=4)
    np.testing.assert_array_equal(again.positions_nm, peptide_box().positions_nm)
    assert again.topology_hash == peptide_box().topology_hash
    assert not np.array_equal(other.positions_nm, again.positions_nm)


def test_a_charged_molecule_gets_its_counter_ion() -> None:
    scene = scene_from_smiles("CC(=O)[O-]")
    wet = solvate(scene, replace(TIP3P, force_field="gaff2"), WaterBox(padding_nm=0.7))
    assert (wet.elements.count("Na"), wet.elements.count("Cl")) == (1, 0)
    assert wet.formal_charges.sum() == 0


# ---- energies ------------------------------------------------------------------------------------------------------


def test_charges_cut_off_and_constraints_of_a_box() -> None:
    wet = peptide_box()
    system = build_system(wet, TIP3P)
    force = nonbonded(system)
    assert force.getNonbondedMethod() == force.PME
    assert force.getCutoffDistance()._value == 0.9
    assert sum(force.getParticleParameters(i)[0]._value for i in range(wet.n_atoms)) == pytest.approx(0, abs=1e-9)
    n_water = wet.residue_names.count("HOH")
    assert system.getNumConstraints() == 3 * n_water + 12
    # Rigid water keeps its natural masses; the peptide's hydrogens are heavy.
    masses = [system.getParticleMass(i)._value for i in range(wet.n_atoms)]
    hydrogens = [i for i, e in enumerate(wet.elements) if e == "H"]
    assert sorted({round(masses[i], 2) for i in hydrogens}) == [1.01, 3.0]


def test_a_box_is_what_openmm_makes_of_it() -> None:
    """The System of a peptide in water equals OpenMM's own from the same files."""
    from openmm import app, unit

    wet = peptide_box()
    topology = wet.to_openmm_topology()
    topology.setPeriodicBoxVectors(wet.cell_nm * unit.nanometer)
    theirs = app.ForceField("amber14/protein.ff14SB.xml", "amber14/tip3p.xml").createSystem(
        topology,
        nonbondedMethod=app.PME,
        nonbondedCutoff=0.9 * unit.nanometer,
        constraints=app.HBonds,
        removeCMMotion=False,
    )
    assert energy(build_system(wet, TIP3P), wet) == pytest.approx(energy(theirs, wet), abs=1e-2)
    # Negative control: one ion's charge.
    wrong = build_system(wet, TIP3P)
    force, sodium = nonbonded(wrong), wet.elements.index("Na")
    charge, sigma, epsilon = force.getParticleParameters(sodium)
    force.setParticleParameters(sodium, 1.1 * charge, sigma, epsilon)
    assert abs(energy(wrong, wet) - energy(theirs, wet)) > 1.0


def energy(system: Any, scene: Scene) -> float:
    import openmm

    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    extra = np.zeros((system.getNumParticles() - scene.n_atoms, 3))
    context.setPositions(np.concatenate([scene.positions_nm, extra]))
    context.computeVirtualSites()
    return float(context.getState(energy=True).getPotentialEnergy()._value)


def test_opc_sites_follow_the_atoms_and_the_engine_hides_them() -> None:
    spec = ForceFieldSpec("ff19SB", "opc")
    wet = solvate(load("alanine-dipeptide"), spec, WaterBox(padding_nm=0.5))
    n_water = wet.residue_names.count("HOH")
    system = build_system(wet, spec)
    assert system.getNumParticles() == wet.n_atoms + n_water
    assert all(system.isVirtualSite(i) == (i >= wet.n_atoms) for i in range(system.getNumParticles()))
    with Engine(wet, Conditions(force=spec, platform="CPU"), threads=1) as engine:
        before = engine.energy()
        after = engine.minimise(max_iterations=5)
        state = engine.state()
    assert after < before < 0
    assert state.positions_nm.shape == (wet.n_atoms, 3)
    assert state.cell_nm is not None and state.cell_nm.shape == (3, 3)
    oh = np.linalg.norm(state.positions_nm[22] - state.positions_nm[23])
    assert oh == pytest.approx(0.08724, abs=1e-5)


# ---- mixtures ------------------------------------------------------------------------------------------------------


def beside(scene: Scene, other: Scene, gap_nm: float = 0.6) -> Scene:
    """Two scenes in one, the second moved away along x."""
    shift = [float(scene.positions_nm[:, 0].max() - other.positions_nm[:, 0].min()) + gap_nm, 0.0, 0.0]
    return replace(
        scene,
        atom_names=scene.atom_names + other.atom_names,
        elements=scene.elements + other.elements,
        residue_of_atom=np.concatenate([scene.residue_of_atom, other.residue_of_atom + len(scene.residue_names)]),
        residue_names=scene.residue_names + other.residue_names,
        residue_ids=scene.residue_ids + other.residue_ids,
        chain_of_residue=scene.chain_of_residue + tuple("Z" for _ in other.chain_of_residue),
        bonds=np.concatenate([scene.bonds, other.bonds + scene.n_atoms]),
        bond_orders=np.concatenate([scene.bond_orders, other.bond_orders]),
        formal_charges=np.concatenate([scene.formal_charges, other.formal_charges]),
        masses_da=np.concatenate([scene.masses_da, other.masses_da]),
        positions_nm=np.concatenate([scene.positions_nm, other.positions_nm + shift]),
    )


def test_a_peptide_and_a_ligand_far_apart_have_the_sum_of_their_energies() -> None:
    peptide, ligand = load("alanine-dipeptide"), load("aspirin")
    pair = beside(peptide, ligand, gap_nm=2000.0)
    spec = ForceFieldSpec("auto", "vacuum", None, False)
    assert resolve(pair, spec).force_field == "ff14SB+gaff2"
    alone = [
        energy(build_system(s, ForceFieldSpec(f, "vacuum", None, False)), s)
        for s, f in ((peptide, "ff14SB"), (ligand, "gaff2"))
    ]
    together = energy(build_system(pair, spec), pair)
    assert together == pytest.approx(sum(alone), abs=1e-2)
    # Near each other they interact: the merged force couples the parts.
    near = beside(peptide, ligand, gap_nm=0.25)
    assert abs(energy(build_system(near, spec), near) - sum(alone)) > 0.5


def test_parts_may_lie_in_any_order() -> None:
    peptide, ligand = load("alanine-dipeptide"), load("ethanol")
    one = beside(ligand, peptide)
    spec = ForceFieldSpec("ff14SB+gaff2", "obc2", None, False)
    system = build_system(one, spec)
    kinds = [type(f).__name__ for f in system.getForces()]
    assert len(kinds) == len(set(kinds))
    other = beside(peptide, ligand)
    other = other.with_positions(np.roll(one.positions_nm, -ligand.n_atoms, axis=0))
    assert energy(system, one) == pytest.approx(energy(build_system(other, spec), other), abs=1e-3)
    np.testing.assert_array_equal(
        part_of(one, np.arange(ligand.n_atoms)).positions_nm, one.positions_nm[: ligand.n_atoms]
    )


# ---- what fits together ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("force_field", "solvent", "said"),
    [
        ("ff19SB", "obc2", "OPC"),
        ("ff19SB", "gbn2", "OPC"),
        ("charmm36", "obc2", "Amber"),
        ("ff19SB", "tip3p", "opc"),
        ("ff14SB", "obc2", ""),
        ("ff19SB", "opc", ""),
        ("gaff2", "obc2", ""),
    ],
)
def test_poor_combinations_are_warned_of(force_field: str, solvent: str, said: str) -> None:
    warnings = ForceFieldSpec(force_field, solvent).warnings
    assert bool(warnings) == bool(said)
    assert all(said in line for line in warnings)


def test_contradictions_are_refused() -> None:
    scene = load("alanine-dipeptide")
    with pytest.raises(PreparationError, match="no periodic cell"):
        build_system(scene, TIP3P)
    with pytest.raises(PreparationError, match="has a periodic cell"):
        build_system(peptide_box(), ForceFieldSpec())
    with pytest.raises(PreparationError, match="twice the cut-off"):
        build_system(replace(peptide_box(), cell_nm=np.eye(3) * 1.7), TIP3P)
    with pytest.raises(InputError, match="`padding_nm"):
        solvate_if_asked(scene, ForceFieldSpec(), padding_nm=1.0)
    with pytest.raises(InputError, match="cell already"):
        solvate_if_asked(peptide_box(), TIP3P, padding_nm=1.0)
    with pytest.raises(PreparationError, match="no solvent 'opc'"):
        ForceFieldSpec("charmm36", "opc")
    with pytest.raises(PreparationError, match="gfn2-xtb"):
        ForceFieldSpec("gfn2-xtb", "obc2")
    assert solvate_if_asked(scene, ForceFieldSpec()) is scene


def test_auto_resolves_by_what_templates_cover() -> None:
    auto = ForceFieldSpec("auto", "auto")
    assert resolve(load("alanine-dipeptide"), auto) == ForceFieldSpec("ff14SB", "obc2")
    assert resolve(load("aspirin"), auto) == ForceFieldSpec("gaff2", "vacuum")
    assert resolve(peptide_box(), auto).solvent == "tip3p"
    quantum = resolve(load("aspirin"), ForceFieldSpec("gfn2-xtb", "auto"))
    assert quantum == ForceFieldSpec("gfn2-xtb", "vacuum")
