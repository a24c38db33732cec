"""A model as OpenMM sets it up when it is told nothing: its own files, defaults and choice of platform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from md_reference.forces.spec import PROTEIN_FILES, ForceFieldSpec, cutoff_nm, water_file
from systems.scene import Scene

TEMPERATURE_K, FRICTION_PER_PS, TIMESTEP_PS = 300.0, 1.0, 0.002


@dataclass(frozen=True)
class Setup:
    """A Context ready to run, and in words what it is."""

    context: Any
    platform: str
    threads: str
    timestep_ps: float


def plain(scene: Scene, spec: ForceFieldSpec, *, threads: int | None) -> Setup:
    """Return what OpenMM's manual makes of the model: its files, its defaults, the platform it picks by itself.

    `threads`: of the CPU platform where that is picked; None leaves its default, all cores.
    """
    from openmm import LangevinMiddleIntegrator, Platform, app

    topology = scene.to_openmm_topology()
    system = plain_system(scene, spec)
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


def plain_system(scene: Scene, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System` by OpenMM's own way: its XML files, or for GAFF2 its reader of the same prmtop.

    Bonds to hydrogen are rigid, as a step of 2 fs needs; all else is default, the removal of the centre of mass's
    motion included.
    """
    from openmm import app, unit

    rigid = {"constraints": app.HBonds}
    if spec.force_field == "gaff2":
        from md_reference.forces.small_molecules.gaff import parameters
        from md_reference.forces.small_molecules.prmtop import load_openmm

        implicit = {"implicitSolvent": app.OBC2} if spec.solvent == "obc2" else {}
        return load_openmm(parameters(scene)).createSystem(nonbondedMethod=app.NoCutoff, **rigid, **implicit)
    files = [PROTEIN_FILES[spec.force_field]]
    box: dict[str, Any] = {"nonbondedMethod": app.NoCutoff}
    if spec.solvent == "obc2":
        files.append("implicit/obc2.xml")
    elif spec.is_explicit:
        files.append(str(water_file(spec.force_field, spec.solvent)))
        box = {"nonbondedMethod": app.PME, "nonbondedCutoff": cutoff_nm(spec.force_field)[0] * unit.nanometer}
    topology = scene.to_openmm_topology()
    if scene.cell_nm is not None:
        topology.setPeriodicBoxVectors(scene.cell_nm * unit.nanometer)
    return app.ForceField(*files).createSystem(topology, **rigid, **box)
