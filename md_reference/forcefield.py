"""Scene -> openmm.System: protein force fields, implicit water or none, constraints and hydrogen masses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from systems.errors import InputError, PreparationError, UnknownNameError, nearest
from systems.scene import Scene

# OpenMM's own file names, in order of preference.
FORCE_FIELD_FILES = {
    "ff14SB": "amber14/protein.ff14SB.xml",
    "ff99SB-ILDN": "amber99sbildn.xml",
}
SOLVENTS = ("obc2", "vacuum", "amber99-obc")


@dataclass(frozen=True)
class ForceFieldSpec:
    """What the forces are. `hydrogen_mass_da=None` leaves natural masses; bonds to hydrogen are always constrained
    when `constrain_hydrogens` (needed above 1 fs).

    `solvent`: 'obc2' (GBSA-OBC2, Onufriev 2004, with mbondi radii as in OpenMM's implicit/obc2.xml), 'amber99-obc' (the
    radii of OpenMM's amber99_obc.xml, ff99SB-ILDN only), or 'vacuum'.
    """

    force_field: str = "ff14SB"
    solvent: str = "obc2"
    hydrogen_mass_da: float | None = 3.0
    constrain_hydrogens: bool = True

    def __post_init__(self) -> None:
        if self.force_field not in FORCE_FIELD_FILES:
            known = list(FORCE_FIELD_FILES)
            raise UnknownNameError(
                f"unknown force field {self.force_field!r}; known: {', '.join(known)}."
                + nearest(self.force_field, known)
            )
        if self.solvent not in SOLVENTS:
            raise UnknownNameError(
                f"unknown solvent {self.solvent!r}; known: {', '.join(SOLVENTS)}."
                + nearest(self.solvent, list(SOLVENTS))
            )
        if self.solvent == "amber99-obc" and self.force_field != "ff99SB-ILDN":
            raise PreparationError("solvent 'amber99-obc' goes with --force-field ff99SB-ILDN; use obc2 otherwise.")


def build_system(scene: Scene, spec: ForceFieldSpec, *, native_gb: bool = True) -> Any:
    """Return the `openmm.System` of a scene: no cut-off, no periodic box, no centre-of-mass removal.

    With `native_gb` the OBC2 term is OpenMM's GBSAOBCForce; without it, the CustomGBForce of implicit/obc2.xml, which
    gives the same energies (a test holds them together) and is several times slower on small scenes.
    Where the scene's own division into residues is not known to the force field, the one found in the bond graph is
    tried (`regrouping`): the particles are in the scene's order either way.
    Raises PreparationError when the force field has no parameters for a residue.
    """
    from md_reference.regrouping import permuted, regroup

    try:
        return _build(scene, spec, native_gb)
    except PreparationError:
        raise
    except (_Unmatched, InputError):
        regrouped, order = regroup(scene)
    try:
        return permuted(_build(regrouped, spec, native_gb), order)
    except _Unmatched as error:
        raise PreparationError(
            f"{spec.force_field} has no parameters for {error.residue} of scene {scene.name!r}; covered so far are "
            "peptides of the standard amino acids with the caps ACE and NME, every hydrogen in place."
        ) from error


class _Unmatched(Exception):
    """No template of the force field has the bonds of this residue."""

    def __init__(self, residue: str) -> None:
        super().__init__(residue)
        self.residue = residue


def _build(scene: Scene, spec: ForceFieldSpec, native_gb: bool) -> Any:
    """Return the System of a scene whose residues the force field knows; raises _Unmatched for one it does not."""
    from openmm import app, unit

    topology = scene.to_openmm_topology()
    files = [FORCE_FIELD_FILES[spec.force_field]]
    if spec.solvent == "amber99-obc":
        files.append("amber99_obc.xml")
    elif spec.solvent == "obc2" and not native_gb:
        files.append("implicit/obc2.xml")
    force_field = app.ForceField(*files)
    for residue in force_field.getUnmatchedResidues(topology):
        raise _Unmatched(_describe(scene, residue.index))
    try:
        system = force_field.createSystem(
            topology,
            nonbondedMethod=app.NoCutoff,
            constraints=app.HBonds if spec.constrain_hydrogens else None,
            rigidWater=True,
            removeCMMotion=False,
            hydrogenMass=None if spec.hydrogen_mass_da is None else spec.hydrogen_mass_da * unit.dalton,
        )
    except (ValueError, KeyError) as error:
        reason = (str(error).splitlines() or ["no reason given"])[0]
        raise PreparationError(f"{spec.force_field} cannot describe scene {scene.name!r}: {reason}") from error
    if spec.solvent == "obc2" and native_gb:
        system.addForce(_native_obc2(topology, system))
    return system


def _describe(scene: Scene, residue: int) -> str:
    """`residue UNL 1 (C9 H8 O4)`, for messages."""
    symbols = [e for e, r in zip(scene.elements, scene.residue_of_atom, strict=True) if r == residue]
    formula = " ".join(f"{e}{symbols.count(e) if symbols.count(e) > 1 else ''}" for e in sorted(set(symbols)))
    return f"residue {scene.residue_names[residue]} {scene.residue_ids[residue]} ({formula})"


def _native_obc2(topology: Any, system: Any) -> Any:
    """OBC2 as GBSAOBCForce: charges from the NonbondedForce, radii and scales from OpenMM's standard OBC2 table."""
    from openmm import GBSAOBCForce, NonbondedForce
    from openmm.app.internal.customgbforces import GBSAOBC2Force

    nonbonded = next(f for f in system.getForces() if isinstance(f, NonbondedForce))
    gb = GBSAOBCForce()
    gb.setNonbondedMethod(GBSAOBCForce.NoCutoff)
    gb.setSoluteDielectric(1.0)
    gb.setSolventDielectric(78.5)
    for index, (radius_nm, scale) in enumerate(GBSAOBC2Force.getStandardParameters(topology)):
        charge, _, _ = nonbonded.getParticleParameters(index)
        gb.addParticle(charge, radius_nm, scale)
    return gb
