"""The reference's forces: native OBC2 against the custom force, gradients, what is left out, masses and constraints."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from md_speed import plain_system
from openmm import NonbondedForce

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from systems.errors import PreparationError, UnknownNameError
from systems.library.named_scenes import prepare
from systems.scene import FloatArray, Scene

ENERGY_TOLERANCE_KJ_MOL = 1e-3
FORCE_TOLERANCE_KJ_MOL_NM = 1e-3
# The second has every element of the force fields and charges of both signs.
SCENES = ["alanine-dipeptide", "sequence:ACE-CYS-ASP-LYS-NME"]
SPECS = {
    "ff14SB": ForceFieldSpec("ff14SB", "obc2"),
    "ff99SB-ILDN": ForceFieldSpec("ff99SB-ILDN", "obc2"),
    "amber99-obc": ForceFieldSpec("ff99SB-ILDN", "amber99-obc"),
    "vacuum": ForceFieldSpec("ff14SB", "vacuum"),
}


@cache
def scene_of(name: str) -> Scene:
    return prepare(name)


@cache
def thermal_geometries(name: str, n: int = 4) -> FloatArray:
    """Positions `(n, n_atoms, 3)` nm, 0.4 ps apart, of a hot run: 600 K, so that no term is near its minimum."""
    scene = scene_of(name)
    out = []
    with Engine(scene, Conditions(temperature_k=600.0, timestep_ps=0.002, seed=5)) as engine:
        engine.minimise(max_iterations=50)
        engine.thermalise()
        for _ in range(n):
            engine.step(200)
            out.append(engine.positions())
    return np.array(out)


def evaluate(system: Any, positions_nm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return energies `(n,)` kJ/mol and forces `(n, n_atoms, 3)` kJ/mol/nm of a System in double precision."""
    import openmm

    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    energies, forces = [], []
    for positions in positions_nm:
        context.setPositions(positions)
        state = context.getState(energy=True, forces=True)
        energies.append(state.getPotentialEnergy()._value)
        forces.append(state.getForces(asNumpy=True)._value)
    return np.array(energies), np.array(forces)


def largest_gaps(system: Any, other: Any, positions_nm: FloatArray) -> tuple[float, float]:
    energies, forces = evaluate(system, positions_nm)
    energies_2, forces_2 = evaluate(other, positions_nm)
    return float(np.abs(energies - energies_2).max()), float(np.abs(forces - forces_2).max())


def force_of(system: Any, kind: str) -> Any:
    (force,) = [f for f in system.getForces() if type(f).__name__ == kind]
    return force


# ---- native OBC2 against implicit/obc2.xml -------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("force_field", ["ff14SB", "ff99SB-ILDN"])
def test_native_obc2_equals_the_custom_force(name: str, force_field: str) -> None:
    scene, spec = scene_of(name), ForceFieldSpec(force_field, "obc2")
    native, custom = build_system(scene, spec), plain_system(scene, spec)
    assert force_of(native, "GBSAOBCForce").getNumParticles() == scene.n_atoms
    assert force_of(custom, "CustomGBForce").getNumParticles() == scene.n_atoms
    energy_gap, force_gap = largest_gaps(native, custom, thermal_geometries(name))
    assert energy_gap < ENERGY_TOLERANCE_KJ_MOL
    assert force_gap < FORCE_TOLERANCE_KJ_MOL_NM


@pytest.mark.parametrize("changed", ["radius", "scale", "charge", "dielectric", "surface"])
def test_the_comparison_notices_one_wrong_parameter(changed: str) -> None:
    name = "alanine-dipeptide"
    scene, spec = scene_of(name), ForceFieldSpec("ff14SB", "obc2")
    native, custom = build_system(scene, spec), plain_system(scene, spec)
    force = force_of(native, "GBSAOBCForce")
    oxygen = scene.elements.index("O")
    charge, radius, scale = force.getParticleParameters(oxygen)
    if changed == "radius":
        force.setParticleParameters(oxygen, charge, 1.01 * radius, scale)
    elif changed == "scale":
        force.setParticleParameters(oxygen, charge, radius, 1.01 * scale)
    elif changed == "charge":
        force.setParticleParameters(oxygen, 1.01 * charge, radius, scale)
    elif changed == "dielectric":
        force.setSolventDielectric(80.0)
    else:
        force.setSurfaceAreaEnergy(0.0)
    energy_gap, _ = largest_gaps(native, custom, thermal_geometries(name))
    assert energy_gap > 10 * ENERGY_TOLERANCE_KJ_MOL


def test_amber99_obc_has_its_own_radii_and_the_charges_of_the_force_field() -> None:
    scene = scene_of("alanine-dipeptide")
    system, other = build_system(scene, SPECS["amber99-obc"]), build_system(scene, SPECS["ff99SB-ILDN"])
    nonbonded, born, plain = (
        force_of(system, "NonbondedForce"),
        force_of(system, "GBSAOBCForce"),
        force_of(other, "GBSAOBCForce"),
    )
    for i in range(scene.n_atoms):
        charge, radius, _ = born.getParticleParameters(i)
        assert charge == nonbonded.getParticleParameters(i)[0]
        assert radius != plain.getParticleParameters(i)[1]


# ---- what is left out ----------------------------------------------------------------------------------------------


def test_vacuum_has_no_solvent_term() -> None:
    scene = scene_of("alanine-dipeptide")
    kinds = {key: {type(f).__name__ for f in build_system(scene, spec).getForces()} for key, spec in SPECS.items()}
    assert not {k for k in kinds["vacuum"] if "GB" in k}
    assert "GBSAOBCForce" in kinds["ff14SB"]
    assert kinds["ff14SB"] - kinds["vacuum"] == {"GBSAOBCForce"}
    gap, _ = largest_gaps(
        build_system(scene, SPECS["vacuum"]),
        build_system(scene, SPECS["ff14SB"]),
        thermal_geometries("alanine-dipeptide"),
    )
    assert gap > 10.0


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_no_centre_of_mass_removal_and_no_box(spec: ForceFieldSpec) -> None:
    import openmm

    system = build_system(scene_of("alanine-dipeptide"), spec)
    assert not any(isinstance(f, openmm.CMMotionRemover) for f in system.getForces())
    assert not system.usesPeriodicBoundaryConditions()
    assert force_of(system, "NonbondedForce").getNonbondedMethod() == openmm.NonbondedForce.NoCutoff


# ---- masses and constraints ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mass_da", [None, 2.0, 3.0, 4.0])
def test_repartitioned_masses(mass_da: float | None) -> None:
    scene = scene_of("alanine-dipeptide")
    system = build_system(scene, ForceFieldSpec(hydrogen_mass_da=mass_da))
    masses = np.array([system.getParticleMass(i)._value for i in range(scene.n_atoms)])
    hydrogen = np.array([e == "H" for e in scene.elements])
    assert masses.sum() == pytest.approx(scene.masses_da.sum(), rel=1e-4)
    natural = build_system(scene, ForceFieldSpec(hydrogen_mass_da=None))
    assert masses.sum() == pytest.approx(sum(natural.getParticleMass(i)._value for i in range(scene.n_atoms)), rel=1e-9)
    np.testing.assert_allclose(masses[hydrogen], 1.008 if mass_da is None else mass_da, rtol=1e-3)
    assert (masses > 1.0).all()
    # Repartitioning moves mass along bonds, so it leaves each heavy atom with its hydrogens as heavy as it was.
    for i in np.flatnonzero(~hydrogen):
        group = [
            i,
            *(b if a == i else a for a, b in scene.bonds.tolist() if i in (a, b) and hydrogen[b if a == i else a]),
        ]
        assert masses[group].sum() == pytest.approx(scene.masses_da[group].sum(), rel=1e-3)


def test_exactly_the_bonds_to_hydrogen_are_constrained() -> None:
    scene = scene_of("alanine-dipeptide")
    system = build_system(scene, ForceFieldSpec())
    constrained = {}
    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        constrained[min(i, j), max(i, j)] = length._value
    to_hydrogen = {(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])}
    assert set(constrained) == to_hydrogen
    assert len(constrained) == 12
    assert build_system(scene, ForceFieldSpec(constrain_hydrogens=False)).getNumConstraints() == 0
    with Engine(scene, Conditions(seed=2)) as engine:
        engine.minimise()
        engine.thermalise()
        engine.step(100)
        x = engine.positions()
    for (i, j), length in constrained.items():
        assert float(np.linalg.norm(x[i] - x[j])) == pytest.approx(length, rel=1e-4)


# ---- forces are gradients ------------------------------------------------------------------------------------------


def gradient(engine: Engine, positions_nm: FloatArray, step_nm: float = 1e-5) -> FloatArray:
    """Central differences of the energy, `(n_atoms, 3)` kJ/mol/nm."""
    out = np.empty_like(positions_nm)
    for i, axis in np.ndindex(*positions_nm.shape):
        ends = []
        for sign in (1, -1):
            moved = positions_nm.copy()
            moved[i, axis] += sign * step_nm
            ends.append(engine.energy(moved))
        out[i, axis] = (ends[0] - ends[1]) / (2 * step_nm)
    return out


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_forces_are_minus_the_gradient(spec: ForceFieldSpec) -> None:
    name = "alanine-dipeptide"
    here, elsewhere = thermal_geometries(name)[:2]
    with Engine(scene_of(name), Conditions(force=spec)) as engine:
        numeric = -gradient(engine, here)
        scale = np.abs(numeric).max()
        np.testing.assert_allclose(engine.forces(here), numeric, atol=1e-5 * scale)
        # Negative control: the forces of another geometry are not within a thousand times that.
        assert np.abs(engine.forces(elsewhere) - numeric).max() > 1e-2 * scale


# ---- refusals ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"force_field": "ff14sb"}, "ff14SB"),
        ({"solvent": "obc"}, "Did you mean 'obc2'?"),
        ({"solvent": "vacum"}, "Did you mean 'vacuum'?"),
    ],
)
def test_unknown_names_are_one_line_with_the_nearest(arguments: dict[str, str], said: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        ForceFieldSpec(**arguments)  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_radii_of_one_force_field_are_refused_with_another() -> None:
    with pytest.raises(PreparationError, match="ff99SB-ILDN"):
        ForceFieldSpec("ff14SB", "amber99-obc")


@pytest.mark.parametrize(
    ("element", "residue", "charge", "force_field", "solvent"),
    [("Fe", "FE", 3, "ff14SB", "vacuum"), ("Fe", "FE", 2, "ff14SB", "obc2"), ("Fe", "XX", 3, "ff19SB", "vacuum"),
     ("Cu", "CU1", 1, "ff14SB", "refused"), ("Mn", "MN3", 3, "ff14SB", "refused"),
     ("Cl", "MOL", -1, "ff99SB-ILDN", "vacuum")],
)  # fmt: skip
def test_ions_have_the_charge_of_the_scene(
    element: str, residue: str, charge: int, force_field: str, solvent: str
) -> None:
    ion = replace(
        prepare("smiles:[Cl-]"), elements=(element,), residue_names=(residue,), formal_charges=np.array([charge])
    )
    if solvent == "refused":
        with pytest.raises(PreparationError, match=rf"has no {element} ion of charge \+{charge}, only \+2"):
            build_system(ion, ForceFieldSpec(force_field, "vacuum"))
        return
    system = build_system(ion, ForceFieldSpec(force_field, solvent))
    (nonbonded,) = (f for f in system.getForces() if isinstance(f, NonbondedForce))
    assert nonbonded.getParticleParameters(0)[0]._value == charge


@pytest.mark.parametrize("smiles", ["[H]", "[H+]", "[O]"])
def test_a_lone_atom_that_is_no_ion_blames_no_flag(smiles: str) -> None:
    with pytest.raises(PreparationError, match="a single atom") as caught:
        build_system(prepare(f"smiles:{smiles}"), ForceFieldSpec("auto", "auto"))
    assert "force_field" not in str(caught.value) and "gfn2-xtb" in str(caught.value)
    assert build_system(prepare("smiles:[Cl-]"), ForceFieldSpec("auto", "auto")).getNumParticles() == 1, "control"
    with pytest.raises(PreparationError, match="leave `force_field` out"):
        build_system(prepare("smiles:CCO"), ForceFieldSpec("ff14SB", "auto"))
