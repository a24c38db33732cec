"""Peptides, nucleic acids, water and ions: Systems from OpenMM's residue templates, with generalised Born terms."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from md_reference.forces.mixture import is_water, molecules_of, permuted, regroup
from md_reference.forces.spec import (
    ForceFieldSpec,
    chain_files,
    cutoff_nm,
    force_field_of,
    unmatched_residues,
    water_file,
)
from systems.errors import InputError, PreparationError, first_line, listed
from systems.scene import IntArray, Scene


class Unmatched(Exception):
    """No template of the force field has the bonds of this residue."""

    def __init__(self, scene: Scene, residue: int) -> None:
        self.residue = _describe(scene, residue)
        self.is_atom = int((scene.residue_of_atom == residue).sum()) == 1
        super().__init__(self.residue)


def build_templated(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System` of a scene that the templates of `spec.force_field` cover, implicit solvent included,
    particles in the scene's order, virtual sites after all atoms. Where the force field does not know the scene's
    residues, those found in the bond graph are tried. Raises PreparationError for a residue without parameters."""
    scene = _with_water_named(scene)
    try:
        return _build(scene, spec)
    except (Unmatched, InputError) as error:
        if isinstance(error, PreparationError):
            raise
        regrouped, order = regroup(scene)
    try:
        return permuted(_build(regrouped, spec), order)
    except Unmatched as error:
        advice = (
            "hydrogens as they are; leave `force_field` out, or give `force_field='ff14SB+gaff2'`, for residues that "
            "it lacks"
        )
        if error.is_atom:  # whatever was asked for, lone atoms are the templates'
            advice = "a single atom that is not one of its ions; give the whole molecule, or use `level='gfn2-xtb'`"
        raise PreparationError(
            f"{spec.force_field} has no parameters for {error.residue} of scene {scene.name!r}, {advice}."
        ) from error


def uncovered_residue(scene: Scene, protein: str) -> str | None:
    """Return which residue the templates lack, in words, or None: the scene is covered, as it is or regrouped."""
    force_field = force_field_of(chain_files(protein))
    try:
        found = unmatched_residues(scene, force_field)
    except InputError:
        found = [0]  # residues that are not contiguous
    if found:
        scene = regroup(scene)[0]
        found = unmatched_residues(scene, force_field)
    return _describe(scene, found[0]) if found else None


def _build(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the System of a scene whose residues the force field knows; raises Unmatched for one it does not."""
    from openmm import app, unit

    is_charmm = spec.force_field == "charmm36"
    if is_charmm:
        scene = _with_caps_joined(scene)
    topology = scene.to_openmm_topology()
    wanted = [*chain_files(spec.force_field)]
    templates = {}
    if is_charmm:  # capped alanine is in its files twice; ALAD is the one with the protein's types
        templates = {r: "ALAD" for r in topology.residues() if r.name == "ALA" and len(r) == 22}
    needs_water = spec.is_explicit or any(len(m) == 1 or is_water(scene.elements, m) for m in molecules_of(scene))
    if needs_water and (water := water_file(spec.force_field, spec.solvent)):
        wanted.append(water)
    if spec.solvent == "amber99-obc":
        wanted.append("amber99_obc.xml")
    force_field = force_field_of(tuple(wanted))
    ions = _ion_templates(scene, force_field, spec.force_field)
    templates |= {r: ions[r.index] for r in topology.residues() if r.index in ions}
    settings: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if spec.is_explicit:
        far_nm, near_nm = cutoff_nm(spec.force_field)
        topology.setPeriodicBoxVectors(scene.cell_nm * unit.nanometer)
        settings = {"nonbondedMethod": app.PME, "nonbondedCutoff": far_nm * unit.nanometer}
        if near_nm is not None:
            settings["switchDistance"] = near_nm * unit.nanometer
    real = list(range(scene.n_atoms))
    try:
        # CHARMM's terminal residues are patches, which only createSystem tries.
        if spec.solvent != "opc" and not is_charmm:
            for residue in force_field.getUnmatchedResidues(topology, templates):
                raise Unmatched(scene, residue.index)
        if spec.solvent == "opc":  # whose waters have a virtual site
            modeller = app.Modeller(topology, scene.positions_nm * unit.nanometer)
            modeller.addExtraParticles(force_field, residueTemplates=templates)
            topology = modeller.topology
            templates = {r: ions[r.index] for r in topology.residues() if r.index in ions}
            real = [a.index for a in topology.atoms() if a.element is not None]
        system = force_field.createSystem(
            topology, residueTemplates=templates, rigidWater=True, **settings, **spec.openmm_settings()
        )
    except Unmatched:
        raise
    except Exception as error:  # OpenMM raises KeyError, ValueError and bare Exception here
        if absent := re.match(r"No template found for residue (\d+)", str(error)):
            raise Unmatched(scene, int(absent[1])) from error
        raise PreparationError(
            f"{spec.force_field} cannot describe scene {scene.name!r}: {first_line(error)}."
        ) from error
    if spec.solvent == "obc2":
        system.addForce(native_obc2(topology, system))
    elif spec.solvent == "gbn2":
        system.addForce(gbn2(scene, topology, system))
    if len(real) != system.getNumParticles():
        virtual = sorted(set(range(system.getNumParticles())) - set(real))
        order = np.empty(system.getNumParticles(), dtype=np.int64)
        order[[*real, *virtual]] = np.arange(len(order))
        system = permuted(system, order)
    return system


def _ion_templates(scene: Scene, force_field: Any, name: str) -> dict[int, str]:
    """The templates of lone atoms, by residue, where the force field has several of their element: by charge (Fe2+,
    Fe3+), then by the residue's name, else those that go with the water, which come last. Raises PreparationError where
    the force field `name` has the element's ions in other charges alone."""
    from openmm.app.forcefield import NonbondedGenerator

    (nonbonded,) = (g for g in force_field.getGenerators() if isinstance(g, NonbondedGenerator))
    known: dict[str, dict[str, int]] = {}
    for key, template in force_field._templates.items():
        if len(template.atoms) == 1 and (atom := template.atoms[0]).element is not None:
            parameters = {**nonbonded.params.paramsForType.get(atom.type, {}), **atom.parameters}
            known.setdefault(atom.element.symbol, {})[key] = round(parameters["charge"])
    found = {}
    for residue in np.flatnonzero(np.bincount(scene.residue_of_atom) == 1).tolist():
        i = int(np.flatnonzero(scene.residue_of_atom == residue)[0])
        ions, charge = known.get(scene.elements[i], {}), int(scene.formal_charges[i])
        fitting = [key for key, q in ions.items() if q == charge]
        if ions and not fitting:
            others = listed([f"{q:+d}" for q in ions.values()])
            raise PreparationError(
                f"{name} has no {scene.elements[i]} ion of charge {charge:+d}, only {others} "
                f"({_describe(scene, residue)} of scene {scene.name!r}); leave it out, or use `level='gfn2-xtb'`."
            )
        if len(ions) > 1:
            own = scene.residue_names[residue]
            found[residue] = own if own in fitting else fitting[-1]
    return found


def _with_water_named(scene: Scene) -> Scene:
    """Return the scene with every water molecule called HOH, the name by which OpenMM knows what is rigid."""
    water = {int(scene.residue_of_atom[m[0]]) for m in molecules_of(scene) if is_water(scene.elements, m)}
    names = tuple("HOH" if r in water else name for r, name in enumerate(scene.residue_names))
    return scene if names == scene.residue_names else replace(scene, residue_names=names)


def _with_caps_joined(scene: Scene) -> Scene:
    """Return the scene with each cap in the residue it sits on: CHARMM's caps are patches of that residue."""
    last = len(scene.residue_names) - 1
    joined = {r: r + 1 for r, name in enumerate(scene.residue_names) if name == "ACE" and r < last}
    joined |= {r: r - 1 for r, name in enumerate(scene.residue_names) if name in ("NME", "NH2") and r > 0}
    if not joined:
        return scene
    kept = [r for r in range(last + 1) if r not in joined]
    rank = {r: k for k, r in enumerate(kept)}
    return replace(
        scene,
        residue_of_atom=np.array([rank[joined.get(r, r)] for r in scene.residue_of_atom.tolist()], dtype=np.int64),
        residue_names=tuple(scene.residue_names[r] for r in kept),
        residue_ids=tuple(scene.residue_ids[r] for r in kept),
        chain_of_residue=tuple(scene.chain_of_residue[r] for r in kept),
    )


def _describe(scene: Scene, residue: int) -> str:
    """`residue UNL 1 (C9 H8 O4)`, for messages."""
    symbols = [e for e, r in zip(scene.elements, scene.residue_of_atom, strict=True) if r == residue]
    formula = " ".join(f"{e}{symbols.count(e) if symbols.count(e) > 1 else ''}" for e in sorted(set(symbols)))
    return f"residue {scene.residue_names[residue]} {scene.residue_ids[residue]} ({formula})"


# ---- generalised Born terms ------------------------------------------------------------------------------------------


def native_obc2(topology: Any, system: Any) -> Any:
    """OBC2 (Onufriev, Bashford and Case 2004, igb=5) as GBSAOBCForce. Charges from the NonbondedForce, radii (mbondi2)
    and scales from OpenMM's standard OBC2 table."""
    from openmm import GBSAOBCForce
    from openmm.app.internal.customgbforces import GBSAOBC2Force

    gb = GBSAOBCForce()
    gb.setNonbondedMethod(GBSAOBCForce.NoCutoff)
    gb.setSoluteDielectric(1.0)
    gb.setSolventDielectric(78.5)
    charges = _charges(system)
    for index, (radius_nm, scale) in enumerate(GBSAOBC2Force.getStandardParameters(topology)):
        gb.addParticle(charges[index], radius_nm, scale)
    return gb


def gbn2(scene: Scene, topology: Any, system: Any, *, molecule_idx: IntArray | None = None) -> Any:
    """GBn2 (Nguyen, Roe and Simmerling 2013, igb=8) as OpenMM's CustomGBForce, radii mbondi3. Atoms in `molecule_idx`
    (GAFF2) keep their mbondi2 radii: Amber changes those of protein residues alone. Arginine is known by its bonds, so
    that a peptide in residues of other names gets the same energy."""
    from openmm.app.internal.customgbforces import GBSAGBn2Force, GBSAOBC2Force

    gb = GBSAGBn2Force(SA="ACE")
    parameters = [list(map(float, row)) for row in GBSAGBn2Force.getStandardParameters(topology)]
    for i in _guanidinium_hydrogens(scene):
        parameters[i][0] = 0.117  # nm, of Amber's radius set mbondi3
    if molecule_idx is not None and len(molecule_idx):
        plain = GBSAOBC2Force.getStandardParameters(topology)
        for i in molecule_idx.tolist():
            parameters[i][0] = float(plain[i][0])
    for charge, row in zip(_charges(system), parameters, strict=True):
        gb.addParticle([charge, *row])
    gb.finalize()
    return gb


def _charges(system: Any) -> list[Any]:
    from openmm import NonbondedForce

    nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    return [nonbonded.getParticleParameters(i)[0] for i in range(nonbonded.getNumParticles())]


def _guanidinium_hydrogens(scene: Scene) -> list[int]:
    """Hydrogens on the nitrogens of carbons that have three of them."""
    near, symbol = scene.neighbours(), scene.elements
    found = []
    for c in (i for i, e in enumerate(symbol) if e == "C"):
        nitrogens = [n for n in near[c] if symbol[n] == "N"]
        if len(nitrogens) == 3:
            found += [h for n in nitrogens for h in near[n] if symbol[h] == "H"]
    return found
