"""Energies of an openmm.System, force by force."""

from __future__ import annotations

from typing import Any

from systems.scene import FloatArray


def energy_terms(system: Any, positions_nm: FloatArray) -> dict[str, float]:
    """Return the energy in kJ/mol of each force by its name, at positions `(n_particles, 3)` nm in double precision."""
    import openmm

    for group, force in enumerate(system.getForces()):
        force.setForceGroup(group)
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
    context.setPositions(positions_nm)
    return {
        force.getName(): context.getState(energy=True, groups={group}).getPotentialEnergy()._value
        for group, force in enumerate(system.getForces())
    }
