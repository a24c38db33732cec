"""Build the openmm.System of a scene: settle the force field for it, and join what builds its parts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from md_reference.forces import gaff
from md_reference.forces.mixture import is_water, merge, molecules_of
from md_reference.forces.nonstandard import build_chain, find_chain
from md_reference.forces.quantum import build_quantum_system
from md_reference.forces.spec import MODEL, PROTEIN_FORCE_FIELDS, QUANTUM, ForceFieldSpec, cutoff_nm
from md_reference.forces.templates import build_templated, gbn2, native_obc2, uncovered_residue
from systems.errors import PreparationError
from systems.library.named_scenes import check_law
from systems.scene import IntArray, Scene, once_per_scene, part_of

# Hydrogen of natural mass is the lightest atom that there is.
_LEAST_MASS_DA = 1.0
# Energies of the model systems, in kJ/mol; lengths in nm.
_LAWS = {
    "harmonic": "0.5*(kx*x^2+ky*y^2+kz*z^2)",
    "double-well": "barrier_kj_mol*((x/minimum_nm)^2-1)^2 + tilt_kj_mol_nm*x + 0.5*transverse_kj_mol_nm2*(y^2+z^2)",
}


def build_model_system(scene: Scene) -> Any:
    """Return the `openmm.System` of a scene with `interactions`: particles with the scene's masses, one custom force.
    No constraints, no cell, no centre-of-mass removal. Raises InputError for a law that is unknown or incomplete."""
    from openmm import CustomExternalForce, System

    law = dict(scene.interactions or {})
    check_law(law)
    kind = law.pop("kind")
    if kind == "harmonic":
        law = dict(zip(("kx", "ky", "kz"), law["force_constants_kj_mol_nm2"], strict=True))
    system, force = System(), CustomExternalForce(_LAWS[kind])
    force.setName(f"{kind} law")
    for name, value in law.items():
        force.addGlobalParameter(name, value)
    for k, mass_da in enumerate(scene.masses_da.tolist()):
        system.addParticle(mass_da)
        force.addParticle(k, [])
    system.addForce(force)
    return system


# ---- the force field of a scene -------------------------------------------------------------------------------------


@once_per_scene
def resolve(scene: Scene, spec: ForceFieldSpec) -> ForceFieldSpec:
    """Return the spec with 'auto' resolved for this scene; this is what a record states.

    Force field: ff14SB where it covers every residue, gaff2 where it covers no molecule but water and ions,
    ff14SB+gaff2 where it covers some. Solvent: TIP3P where the scene has a cell, vacuum for gaff2 alone, else obc2.
    Raises PreparationError for what contradicts.
    """
    name = spec.force_field
    if (name == MODEL) != (scene.interactions is not None) and name != "auto":
        defines = "does not define" if name == MODEL else "defines"
        raise PreparationError(f"scene {scene.name!r} {defines} its own potential; leave `force_field` out.")
    if name == "auto":
        name = MODEL if scene.interactions is not None else _choose(scene)
    solvent = spec.solvent
    if solvent == "auto":
        if name in (QUANTUM, MODEL):
            solvent = "vacuum"
        elif scene.cell_nm is not None:
            solvent = "tip3p"
        else:
            solvent = "vacuum" if name == "gaff2" else "obc2"
    changes: dict[str, Any] = {"force_field": name, "solvent": solvent}
    if name == MODEL:
        changes |= {"hydrogen_mass_da": None, "constrain_hydrogens": False}
    return replace(spec, **changes)


def _choose(scene: Scene) -> str:
    rest = [m for m in molecules_of(scene) if len(m) > 1 and not is_water(scene.elements, m)]
    others = [m for m in rest if uncovered_residue(part_of(scene, m), "ff14SB") is not None]
    if not others:
        return "ff14SB"
    if len(others) < len(rest) or any(find_chain(part_of(scene, m)) for m in others):
        return "ff14SB+gaff2"
    return "gaff2"


def build_system(scene: Scene, spec: ForceFieldSpec, *, rough: bool = False) -> Any:
    """Return the `openmm.System` of a scene: without a cell no cut-off, in one PME; no centre-of-mass removal.

    Particles are the scene's atoms in its order; virtual sites (OPC) come after them. The OBC2 term is OpenMM's
    GBSAOBCForce, several times faster than the CustomGBForce of implicit/obc2.xml, with the same energies. `rough`: see
    `gaff.entry`. Raises PreparationError when the force field has no parameters for a residue or a molecule, or does
    not suit the scene's cell.
    """
    spec = resolve(scene, spec)
    if spec.force_field == MODEL:
        return build_model_system(scene)
    _check_cell(scene, spec)
    if spec.force_field == QUANTUM:
        heavy, rigid = spec.hydrogen_mass_da, spec.constrain_hydrogens
        return build_quantum_system(scene, solvent=spec.solvent, hydrogen_mass_da=heavy, constrain_hydrogens=rigid)
    if spec.force_field in PROTEIN_FORCE_FIELDS:
        system = build_templated(scene, spec)
    else:
        system = _build_mixed(scene, spec, rough=rough)
    if scene.cell_nm is not None:
        system.setDefaultPeriodicBoxVectors(*(row.tolist() for row in scene.cell_nm))
    masses_da = [system.getParticleMass(k)._value for k in range(scene.n_atoms)]
    lightest = int(np.argmin(masses_da))
    if masses_da[lightest] < _LEAST_MASS_DA:
        raise PreparationError(
            f"scene {scene.name!r}: hydrogens of {spec.hydrogen_mass_da} Da leave atom {scene.atom_names[lightest]} "
            f"{masses_da[lightest]:.2f} Da; use a smaller `hydrogen_mass_da`, such as 3Da."
        )
    return system


def _check_cell(scene: Scene, spec: ForceFieldSpec) -> None:
    if spec.is_explicit and scene.cell_nm is None:
        raise PreparationError(
            f"scene {scene.name!r} has no periodic cell for {spec.solvent} water; solvate it first (the command line "
            "and `solvation.solvate` do)."
        )
    if not spec.is_explicit and scene.cell_nm is not None:
        raise PreparationError(
            f"scene {scene.name!r} has a periodic cell, which {spec.solvent} does not; give `solvent='tip3p'` or opc."
        )
    if scene.cell_nm is not None:
        far_nm, _ = cutoff_nm(spec.protein)
        # Heights of a reduced cell are its diagonal.
        smallest = float(np.diag(scene.cell_nm).min())
        if smallest < 2 * far_nm:
            raise PreparationError(
                f"the cell of scene {scene.name!r} is {smallest:.2f} nm wide, less than twice the cut-off of "
                f"{far_nm:g} nm; use a larger `padding_nm`."
            )


def _build_mixed(scene: Scene, spec: ForceFieldSpec, *, rough: bool) -> Any:
    """GAFF2 molecules and chains with residues from GAFF2, alone or beside peptides, water and ions."""
    from openmm import NonbondedForce, app

    templated: list[IntArray] = []
    others: list[IntArray] = []
    for atoms in molecules_of(scene):
        known = len(atoms) == 1 or is_water(scene.elements, atoms)
        if not known and spec.force_field != "gaff2":
            known = uncovered_residue(part_of(scene, atoms), spec.protein) is None
        (templated if known else others).append(atoms)
    parts = []
    if templated:
        atoms = np.sort(np.concatenate(templated))
        dry = replace(spec, force_field=spec.protein, solvent=spec.solvent if spec.is_explicit else "vacuum")
        parts.append((atoms, build_templated(part_of(scene, atoms), dry)))
    small: list[IntArray] = []
    for atoms in others:
        part = part_of(scene, atoms)
        chain = None if spec.force_field == "gaff2" else find_chain(part)
        if chain is None:
            small.append(atoms)
        elif spec.protein != "ff14SB":
            raise PreparationError(
                f"{spec.protein} has no parameters for {', '.join(chain.lacking[:4])} of scene {scene.name!r}; such "
                "residues are joined to ff14SB alone: use `force_field='ff14SB+gaff2'`."
            )
        vacuum = {"nonbondedMethod": app.NoCutoff, "rigidWater": False, **spec.openmm_settings()}
        parts.append(
            (atoms, build_chain(chain, spec) if chain else gaff.entry(part, rough=rough).system(part, **vacuum))
        )
    system = merge(scene.n_atoms, parts)
    if spec.is_explicit:
        nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
        nonbonded.setNonbondedMethod(NonbondedForce.PME)
        nonbonded.setCutoffDistance(cutoff_nm(spec.protein)[0])
    if spec.is_born:
        topology = scene.to_openmm_topology()
        if spec.solvent == "gbn2":
            molecule_idx = np.sort(np.concatenate(small)) if small else np.empty(0, dtype=np.int64)
            born = gbn2(scene, topology, system, molecule_idx=molecule_idx)
        else:
            born = native_obc2(topology, system)
        system.addForce(born)
    return system
