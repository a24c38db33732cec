"""Integrators and baths: Langevin middle (NVT, NPT), velocity Verlet (NVE), the Monte Carlo barostat."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from systems.errors import InputError, UnknownNameError, nearest

if TYPE_CHECKING:
    from systems.scene import Scene

ENSEMBLES = ("nvt", "nve", "npt")
_STEPS_BETWEEN_VOLUME_MOVES = 25


def check_ensemble(name: str, scene: Scene) -> str:
    """Return the ensemble in small letters.

    Raises UnknownNameError (with the nearest name), or InputError for a constant pressure without a periodic cell.
    """
    ensemble = name.lower()
    if ensemble not in ENSEMBLES:
        raise UnknownNameError(
            f"unknown ensemble {name!r}; known: {', '.join(ENSEMBLES)}." + nearest(ensemble, list(ENSEMBLES))
        )
    if ensemble == "npt" and scene.cell_nm is None:
        raise InputError(
            f"ensemble npt needs a volume, and scene {scene.name!r} has no periodic cell; use nvt, or give an explicit "
            "`solvent`."
        )
    return ensemble


def integrator_name(ensemble: str) -> str:
    """Return the name that records have for the integrator of an ensemble."""
    return "VelocityVerlet" if ensemble == "nve" else "LangevinMiddle"


def make_integrator(
    system: Any, ensemble: str, *, temperature_k: float, friction_per_ps: float, timestep_ps: float
) -> Any:
    """Return the `openmm.Integrator` of an ensemble."""
    import openmm

    if ensemble != "nve":
        return openmm.LangevinMiddleIntegrator(temperature_k, friction_per_ps, timestep_ps)
    return velocity_verlet(timestep_ps, constrained=system.getNumConstraints() > 0)


def velocity_verlet(timestep_ps: float, *, constrained: bool) -> Any:
    """Return velocity Verlet (Swope et al., J. Chem. Phys. 76, 637 (1982)), with RATTLE where bonds are constrained.

    Unlike those of OpenMM's VerletIntegrator, a leapfrog, its velocities belong to the same time as its positions.
    """
    import openmm

    integrator = openmm.CustomIntegrator(timestep_ps)
    integrator.addUpdateContextState()
    integrator.addComputePerDof("v", "v+0.5*dt*f/m")
    integrator.addComputePerDof("x", "x+dt*v")
    if constrained:
        integrator.addPerDofVariable("unconstrained", 0.0)
        integrator.addComputePerDof("unconstrained", "x")
        integrator.addConstrainPositions()
        integrator.addComputePerDof("v", "v+0.5*dt*f/m+(x-unconstrained)/dt")
        integrator.addConstrainVelocities()
    else:
        integrator.addComputePerDof("v", "v+0.5*dt*f/m")
    return integrator


def add_barostat(system: Any, *, pressure_bar: float, temperature_k: float, seed: int) -> None:
    """Add a Monte Carlo barostat (Åqvist et al., Chem. Phys. Lett. 384, 288 (2004)) to a periodic System."""
    import openmm

    barostat = openmm.MonteCarloBarostat(pressure_bar, temperature_k, _STEPS_BETWEEN_VOLUME_MOVES)
    barostat.setRandomNumberSeed(seed)
    system.addForce(barostat)
