"""Scene -> openmm.System: protein force fields, implicit water or none, constraints and hydrogen masses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from systems.errors import PreparationError, UnknownNameError, nearest
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
                f"unknown force field {self.force_field!r}; known: {', '.join(known)}.{nearest(self.force_field, known)}"
            )
        if self.solvent not in SOLVENTS:
            raise UnknownNameError(
                f"unknown solvent {self.solvent!r}; known: {', '.join(SOLVENTS)}.{nearest(self.solvent, list(SOLVENTS))}"
            )
        if self.solvent == "amber99-obc" and self.force_field != "ff99SB-ILDN":
            raise PreparationError("solvent 'amber99-obc' goes with --force-field ff99SB-ILDN; use obc2 otherwise.")


def build_system(scene: Scene, spec: ForceFieldSpec, *, native_gb: bool = True) -> Any:
    """Return the `openmm.System` of a scene: no cut-off, no periodic box, no centre-of-mass removal.

    With `native_gb` the OBC2 term is OpenMM's GBSAOBCForce; without it, the CustomGBForce of implicit/obc2.xml, which
    gives the same energies (a test holds them together) and is several times slower on small scenes.
    Raises PreparationError when the force field has no parameters for a residue.
    """
    from openmm import CMMotionRemover, app, unit

    topology = scene.to_openmm_topology()
    files = [FORCE_FIELD_FILES[spec.force_field]]
    custom_gb = spec.solvent == "obc2" and not native_gb
    if spec.solvent == "amber99-obc":
        files.append("amber99_obc.xml")
    elif custom_gb:
        files.append("implicit/obc2.xml")
    force_field = app.ForceField(*files)
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
        first = str(error).splitlines()[0]
        raise PreparationError(
            f"{spec.force_field} has no parameters for scene {scene.name!r}: {first} "
            "Only peptides of standard residues are covered so far."
        ) from error
    if spec.solvent == "obc2" and native_gb:
        system.addForce(_native_obc2(topology, system))
    assert not any(isinstance(f, CMMotionRemover) for f in system.getForces())
    return system


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
