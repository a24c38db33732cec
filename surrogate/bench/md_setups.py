"""The same model twice: as `surromd reference` sets it up, and as OpenMM does when it is told nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.forces.template_files import PROTEIN_FILES, cutoff_nm, water_file
from md_reference.run.config import Conditions
from md_reference.run.machine import platform_properties
from md_reference.run.platforms import measured_platform
from systems.scene import Scene

TEMPERATURE_K, FRICTION_PER_PS = 300.0, 1.0
TIMESTEP_PS, LONG_TIMESTEP_PS, HYDROGEN_MASS_DA = 0.002, 0.004, 3.0


@dataclass(frozen=True)
class Case:
    """A scene in a solvent. `padding_nm` makes the box of explicit water."""

    name: str
    scene: str
    solvent: str
    force_field: str = "ff14SB"
    padding_nm: float = 1.0

    def prepared(self) -> Scene:
        """Return the scene, solvated where the solvent is explicit. Raises PreparationError."""
        from systems.source import prepare

        scene = prepare(self.scene)
        if not self.spec().is_explicit:
            return scene
        from md_reference.forces.solvation import solvate

        return solvate(scene, self.spec(), WaterBox(padding_nm=self.padding_nm))

    def spec(self, *, repartitioned: bool = False) -> ForceFieldSpec:
        """Return the force field; hydrogens keep their natural mass unless `repartitioned`."""
        mass = HYDROGEN_MASS_DA if repartitioned else None
        return ForceFieldSpec(force_field=self.force_field, solvent=self.solvent, hydrogen_mass_da=mass)


_PEPTIDES = (
    ("ACE-ALA-NME", "alanine-dipeptide"),
    ("ACE-ALA-GLY5-NME", "sequence:ACE-ALA-GLY-GLY-GLY-GLY-GLY-NME"),
    ("CLN025", "sequence:YYDPETGTWY"),
    ("ACE-ALA99-NME", "sequence:ACE-" + "ALA-" * 99 + "NME"),
)
CASES = (
    *(Case("ethanol", "ethanol", solvent, "gaff2") for solvent in ("vacuum", "obc2")),
    *(Case(name, scene, solvent) for name, scene in _PEPTIDES for solvent in ("vacuum", "obc2")),
    Case("ACE-ALA-NME", "alanine-dipeptide", "tip3p"),
)


@dataclass(frozen=True)
class Setup:
    """A Context ready to run, and in words what it is."""

    context: Any
    platform: str
    threads: str
    timestep_ps: float


def ours(case: Case, scene: Scene, *, cores: int, repartitioned: bool = False) -> Setup:
    """Return our set-up of one replica out of one per core."""
    import openmm

    spec = resolve(scene, case.spec(repartitioned=repartitioned))
    step_ps = LONG_TIMESTEP_PS if repartitioned else TIMESTEP_PS
    system = build_system(scene, spec)
    choice = measured_platform(
        scene, Conditions(force=spec, timestep_ps=step_ps), max_threads=1, side_by_side=cores, system=lambda: system
    )
    properties = platform_properties(choice.name, choice.threads)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE_K, FRICTION_PER_PS, step_ps)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(choice.name), properties)
    return Setup(context, choice.name, str(choice.threads), step_ps)


def plain(case: Case, scene: Scene, *, threads: int | None) -> Setup:
    """Return what OpenMM's manual makes of the model: its files, its defaults, the platform it picks by itself.

    `threads`: of the CPU platform where that is picked; None leaves its default, all cores.
    """
    from openmm import LangevinMiddleIntegrator, Platform, app

    topology = scene.to_openmm_topology()
    system = plain_system(case, scene)
    integrator = LangevinMiddleIntegrator(TEMPERATURE_K, FRICTION_PER_PS, TIMESTEP_PS)
    simulation = app.Simulation(topology, system, integrator)
    name = simulation.context.getPlatform().getName()
    if name == "CPU" and threads is not None:
        integrator = LangevinMiddleIntegrator(TEMPERATURE_K, FRICTION_PER_PS, TIMESTEP_PS)
        properties = {"Threads": str(threads)}
        simulation = app.Simulation(topology, system, integrator, Platform.getPlatform(name), properties)
    context = simulation.context
    threads_used = context.getPlatform().getPropertyValue(context, "Threads") if name == "CPU" else "1"
    return Setup(context, name, threads_used, TIMESTEP_PS)


def plain_system(case: Case, scene: Scene) -> Any:
    """Return the `openmm.System` by OpenMM's own way: its XML files, or for GAFF2 its reader of the same prmtop.

    Bonds to hydrogen are rigid, as a step of 2 fs needs; all else is default, the removal of the centre of mass's
    motion included.
    """
    from openmm import app, unit

    rigid = {"constraints": app.HBonds}
    if case.force_field == "gaff2":
        from md_reference.forces.small_molecules.gaff import parameters
        from md_reference.forces.small_molecules.prmtop import load_openmm

        implicit = {"implicitSolvent": app.OBC2} if case.solvent == "obc2" else {}
        return load_openmm(parameters(scene)).createSystem(nonbondedMethod=app.NoCutoff, **rigid, **implicit)
    files = [PROTEIN_FILES[case.force_field]]
    box: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if case.solvent == "obc2":
        files.append("implicit/obc2.xml")
    elif case.spec().is_explicit:
        files.append(str(water_file(case.force_field, case.solvent)))
        box = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff_nm(case.force_field)[0] * unit.nanometer}
    topology = scene.to_openmm_topology()
    if scene.cell_nm is not None:
        topology.setPeriodicBoxVectors(scene.cell_nm * unit.nanometer)
    return app.ForceField(*files).createSystem(topology, **rigid, **box)
