"""Scene -> openmm.System: which force field and solvent, what goes together, and who builds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from systems.errors import InputError, PreparationError, UnknownNameError, nearest
from systems.scene import IntArray, Scene

PROTEIN_FORCE_FIELDS = ("ff14SB", "ff19SB", "ff99SB-ILDN", "charmm36")
QUANTUM = "gfn2-xtb"
MODEL = "model"
_WITH_LIGANDS = tuple(f"{name}+gaff2" for name in PROTEIN_FORCE_FIELDS if name != "charmm36")
FORCE_FIELDS = (*PROTEIN_FORCE_FIELDS, "gaff2", *_WITH_LIGANDS, QUANTUM, MODEL, "auto")
IMPLICIT_SOLVENTS = ("obc2", "gbn2", "amber99-obc")
EXPLICIT_SOLVENTS = ("tip3p", "opc")
SOLVENTS = (*IMPLICIT_SOLVENTS, *EXPLICIT_SOLVENTS, "vacuum", "auto")


@dataclass(frozen=True)
class ForceFieldSpec:
    """What the forces are. `hydrogen_mass_da=None` leaves natural masses; bonds to hydrogen are always constrained
    when `constrain_hydrogens` (needed above 1 fs).

    `force_field`: a protein force field; 'gaff2' (GAFF2 with AM1-BCC charges) for any other molecule; 'ff14SB+gaff2'
    for scenes with both; 'gfn2-xtb' (quantum mechanics by tblite, no constraints); 'model' for scenes with
    `interactions`; 'auto', which `resolve` settles for a scene.

    `solvent`: 'obc2' (GBSA-OBC2, Onufriev 2004, with mbondi2 radii as in OpenMM's implicit/obc2.xml), 'gbn2' (Nguyen
    2013, mbondi3), 'amber99-obc' (the radii of OpenMM's amber99_obc.xml, ff99SB-ILDN only), 'tip3p' or 'opc' (explicit,
    for scenes with a periodic cell: `solvation.solvate`), 'vacuum', or 'auto'.
    """

    force_field: str = "ff14SB"
    solvent: str = "obc2"
    hydrogen_mass_da: float | None = 3.0
    constrain_hydrogens: bool = True

    def __post_init__(self) -> None:
        if self.force_field not in FORCE_FIELDS:
            raise UnknownNameError(
                f"unknown force field {self.force_field!r}; known: {', '.join(FORCE_FIELDS)}."
                + nearest(self.force_field, list(FORCE_FIELDS))
            )
        if self.solvent not in SOLVENTS:
            raise UnknownNameError(
                f"unknown solvent {self.solvent!r}; known: {', '.join(SOLVENTS)}."
                + nearest(self.solvent, list(SOLVENTS))
            )
        if self.solvent == "amber99-obc" and self.force_field != "ff99SB-ILDN":
            raise PreparationError("solvent 'amber99-obc' goes with --force-field ff99SB-ILDN; use obc2 otherwise.")
        if self.force_field in (QUANTUM, MODEL) and self.solvent not in ("vacuum", "auto"):
            raise PreparationError(f"{self.force_field} has no solvent; leave --solvent out or give vacuum.")
        if self.force_field == "charmm36" and self.solvent == "opc":
            raise PreparationError("charmm36 has no parameters for OPC water and its ions; use --solvent tip3p.")

    @staticmethod
    def of(record: Mapping[str, Any]) -> ForceFieldSpec:
        """Return what a trajectory's record, or the conditions of a training, say of the forces. Raises KeyError where
        they name no force field or no solvent."""
        return ForceFieldSpec(
            record["force_field"],
            record["solvent"],
            record.get("hydrogen_mass_da"),
            constrain_hydrogens=record.get("constrain_hydrogens", True),
        )

    @property
    def is_explicit(self) -> bool:
        """Whether the solvent is made of molecules, in a periodic cell."""
        return self.solvent in EXPLICIT_SOLVENTS

    @property
    def is_born(self) -> bool:
        """Whether there is a generalised Born term."""
        return self.solvent in IMPLICIT_SOLVENTS

    @property
    def protein(self) -> str:
        """The force field of peptides, water and ions."""
        name = self.force_field.removesuffix("+gaff2")
        return name if name in PROTEIN_FORCE_FIELDS else "ff14SB"

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is known to go badly together, one line each."""
        found = []
        name = self.protein
        if self.is_born and name == "ff19SB":
            found.append(f"ff19SB is tuned for OPC water; with {self.solvent} helices and turns are off. Use ff14SB.")
        if self.is_born and name == "charmm36":
            found.append(f"charmm36 was not made for {self.solvent}, whose radii are Amber's. Use ff14SB, or tip3p.")
        if self.solvent == "tip3p" and name == "ff19SB":
            found.append("ff19SB is tuned for OPC water; use --solvent opc.")
        return tuple(found)


def at_level(level: str | None, force_field: str | None) -> str | None:
    """Return the force field that a level of theory ('mm', 'gfn2-xtb' or None) leaves or demands.

    Raises UnknownNameError, and InputError where the two contradict each other.
    """
    if level is None:
        return force_field
    if level not in ("mm", QUANTUM):
        raise UnknownNameError(f"unknown level {level!r}; known: mm, {QUANTUM}." + nearest(level, ["mm", QUANTUM]))
    if (level == QUANTUM) != (force_field == QUANTUM) and force_field not in (None, "auto"):
        raise InputError(f"--level {level} contradicts --force-field {force_field}; give one of them.")
    return QUANTUM if level == QUANTUM else force_field


def resolve(scene: Scene, spec: ForceFieldSpec) -> ForceFieldSpec:
    """Return the spec with 'auto' settled for this scene; this is what a record states.

    Force field: ff14SB where it covers every residue, gaff2 where it covers no molecule but water and ions,
    ff14SB+gaff2 where it covers some. Solvent: TIP3P where the scene has a cell, vacuum for gaff2 alone, else obc2.
    Quantum and model scenes have natural masses and no constraints. Raises PreparationError for what contradicts.
    """
    name = spec.force_field
    if (name == MODEL) != (scene.interactions is not None) and name != "auto":
        if name == MODEL:
            raise PreparationError(
                f"scene {scene.name!r} has no law of its own; give a force field instead of 'model'."
            )
        raise PreparationError(f"scene {scene.name!r} brings its own law; leave --force-field out.")
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
    if name in (QUANTUM, MODEL):
        changes |= {"hydrogen_mass_da": None, "constrain_hydrogens": False}
    return replace(spec, **changes)


def _choose(scene: Scene) -> str:
    from md_reference.forces.mixture import is_water, molecules_of
    from md_reference.forces.nonstandard import find_chain
    from md_reference.forces.templates import uncovered_residue
    from systems.selection import part_of

    rest = [m for m in molecules_of(scene) if len(m) > 1 and not is_water(scene, m)]
    others = [m for m in rest if uncovered_residue(part_of(scene, m), "ff14SB") is not None]
    if not others:
        return "ff14SB"
    if len(others) < len(rest) or any(find_chain(part_of(scene, m)) for m in others):
        return "ff14SB+gaff2"
    return "gaff2"


def build_system(scene: Scene, spec: ForceFieldSpec, *, native_gb: bool = True) -> Any:
    """Return the `openmm.System` of a scene: without a cell no cut-off, in one PME; no centre-of-mass removal.

    Particles are the scene's atoms in its order; virtual sites (OPC) come after them. With `native_gb` the OBC2 term is
    OpenMM's GBSAOBCForce; without it, the CustomGBForce of implicit/obc2.xml, which gives the same energies (a test
    holds them together) and is several times slower on small scenes.
    Raises PreparationError when the force field has no parameters for a residue or a molecule, or does not suit the
    scene's cell.
    """
    spec = resolve(scene, spec)
    if spec.force_field == MODEL:
        from md_reference.forces.model_forces import build_model_system

        return build_model_system(scene)
    _check_cell(scene, spec)
    if spec.force_field == QUANTUM:
        from md_reference.forces.quantum import build_quantum_system

        return build_quantum_system(scene)
    from md_reference.forces.templates import build_templated

    if spec.force_field in PROTEIN_FORCE_FIELDS:
        system = build_templated(scene, spec, native_gb=native_gb)
    else:
        system = _build_mixed(scene, spec, native_gb)
    if scene.cell_nm is not None:
        system.setDefaultPeriodicBoxVectors(*(row.tolist() for row in scene.cell_nm))
    return system


def _check_cell(scene: Scene, spec: ForceFieldSpec) -> None:
    from md_reference.forces.templates import cutoff_nm

    if spec.is_explicit and scene.cell_nm is None:
        raise PreparationError(
            f"scene {scene.name!r} has no periodic cell for {spec.solvent} water; solvate it first (the command line "
            "and `solvation.solvate` do)."
        )
    if not spec.is_explicit and scene.cell_nm is not None:
        raise PreparationError(
            f"scene {scene.name!r} has a periodic cell, which {spec.solvent} does not; give --solvent tip3p or opc."
        )
    if scene.cell_nm is not None:
        far_nm, _ = cutoff_nm(spec.protein)
        # Heights of a reduced cell are its diagonal.
        smallest = float(np.diag(scene.cell_nm).min())
        if smallest < 2 * far_nm:
            raise PreparationError(
                f"the cell of scene {scene.name!r} is {smallest:.2f} nm wide, less than twice the cut-off of "
                f"{far_nm:g} nm; use a larger --padding."
            )


def _build_mixed(scene: Scene, spec: ForceFieldSpec, native_gb: bool) -> Any:
    """GAFF2 molecules and chains with residues from GAFF2, alone or beside peptides, water and ions."""
    from md_reference.forces import born
    from md_reference.forces.mixture import is_water, merge, molecules_of
    from md_reference.forces.nonstandard import build_chain, find_chain
    from md_reference.forces.templates import build_templated, uncovered_residue
    from systems.selection import part_of

    templated: list[IntArray] = []
    others: list[IntArray] = []
    for atoms in molecules_of(scene):
        known = len(atoms) == 1 or is_water(scene, atoms)
        if not known and spec.force_field != "gaff2":
            known = uncovered_residue(part_of(scene, atoms), spec.protein) is None
        (templated if known else others).append(atoms)
    parts = []
    if templated:
        atoms = np.sort(np.concatenate(templated))
        dry = spec.solvent if spec.is_explicit else "vacuum"
        parts.append(
            (atoms, build_templated(part_of(scene, atoms), replace(spec, force_field=spec.protein, solvent=dry)))
        )
    small: list[IntArray] = []
    for atoms in others:
        part = part_of(scene, atoms)
        chain = None if spec.force_field == "gaff2" else find_chain(part)
        if chain is None:
            small.append(atoms)
        elif spec.protein != "ff14SB":
            raise PreparationError(
                f"{spec.protein} has no parameters for {', '.join(chain.lacking[:4])} of scene {scene.name!r}; such "
                "residues are joined to ff14SB alone: use --force-field ff14SB+gaff2."
            )
        build = _build_molecule if chain is None else build_chain
        parts.append((atoms, build(part, spec)))
    system = merge(scene.n_atoms, parts)
    if spec.is_explicit:
        _use_pme(system, spec)
    if spec.is_born:
        topology = scene.to_openmm_topology()
        if spec.solvent == "gbn2":
            molecule_idx = np.sort(np.concatenate(small)) if small else np.empty(0, dtype=np.int64)
            system.addForce(born.gbn2(scene, topology, system, molecule_idx=molecule_idx))
        else:
            system.addForce((born.native_obc2 if native_gb else born.custom_obc2)(topology, system))
    return system


def _build_molecule(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the System of one GAFF2 molecule in vacuum."""
    from openmm import app, unit

    from md_reference.forces.small_molecules.gaff import parameters
    from md_reference.forces.small_molecules.prmtop import load_openmm

    return load_openmm(parameters(scene)).createSystem(
        nonbondedMethod=app.NoCutoff,
        constraints=app.HBonds if spec.constrain_hydrogens else None,
        rigidWater=False,
        removeCMMotion=False,
        hydrogenMass=None if spec.hydrogen_mass_da is None else spec.hydrogen_mass_da * unit.dalton,
    )


def _use_pme(system: Any, spec: ForceFieldSpec) -> None:
    from openmm import NonbondedForce

    from md_reference.forces.templates import cutoff_nm

    nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    nonbonded.setNonbondedMethod(NonbondedForce.PME)
    nonbonded.setCutoffDistance(cutoff_nm(spec.protein)[0])
