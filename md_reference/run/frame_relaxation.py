"""Relax the stiff bonds of a given frame while everything else is held near where it was."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.run.engine import one_line
from md_reference.run.machine import platform_properties
from md_reference.run.platforms import choose_platform
from systems.errors import SimulationError
from systems.scene import FloatArray, Scene

# Each atom's spring. Bonds are a hundred times stiffer, so that a bond 0.05 nm off comes back to within 0.001 nm of its
# rest, where an atom pulled by kT strays 0.03 nm.
STIFFNESS_KJ_MOL_NM2 = 2500.0
_TOLERANCE = 1e-5
_GROUP = 31


@dataclass(frozen=True, eq=False)
class Relaxed:
    """Positions `(n_atoms, 3)` nm after relaxation and their potential energy in kJ/mol, without the springs."""

    positions_nm: FloatArray
    potential_kj_mol: float


class Relaxer:
    """One Context with a spring on each atom. Use as a context manager or call `close`.

    `system`: an OpenMM System of `scene` as `build_system` returns it; it is copied. Raises SimulationError when the
    platform cannot run it.
    """

    def __init__(self, scene: Scene, system: Any, *, platform: str = "auto", born: bool = True) -> None:
        import openmm

        self._n_atoms, self._system = scene.n_atoms, openmm.XmlSerializer.clone(system)
        self._springs = openmm.CustomExternalForce("0.5*k*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
        self._springs.addGlobalParameter("k", STIFFNESS_KJ_MOL_NM2)
        for name in ("x0", "y0", "z0"):
            self._springs.addPerParticleParameter(name)
        for k in range(self._n_atoms):
            self._springs.addParticle(k, [0.0, 0.0, 0.0])
        self._springs.setForceGroup(_GROUP)
        self._system.addForce(self._springs)
        self._integrator = openmm.VerletIntegrator(0.001)
        choice = choose_platform(scene.n_atoms, platform, born=born)
        try:
            self._context: Any = openmm.Context(
                self._system,
                self._integrator,
                openmm.Platform.getPlatform(choice.name),
                platform_properties(choice.name, choice.threads),
            )
        except openmm.OpenMMException as error:
            raise SimulationError(f"platform {choice.name} cannot run {scene.name!r}: {one_line(error)}") from error

    def relax(self, positions_nm: npt.ArrayLike) -> Relaxed:
        """Restore constrained bonds exactly, then minimise under the springs until converged.

        Raises SimulationError where the energy is not finite before or after, as with atoms on top of each other.
        """
        import openmm

        start = np.asarray(positions_nm, dtype=np.float64)
        if not np.isfinite(start).all():
            raise SimulationError("a frame that is not finite cannot be relaxed")
        for k, at in enumerate(start.tolist()):
            self._springs.setParticleParameters(k, k, at)
        n_virtual = self._system.getNumParticles() - self._n_atoms
        try:
            self._springs.updateParametersInContext(self._context)
            self._context.setPositions(np.concatenate([start, np.zeros((n_virtual, 3))]))
            if n_virtual:
                self._context.computeVirtualSites()
            if not math.isfinite(self._potential()):
                raise SimulationError("the energy of a frame to relax is not finite; atoms lie on top of each other")
            self._context.applyConstraints(_TOLERANCE)
            openmm.LocalEnergyMinimizer.minimize(self._context)
            raw = self._context.getState(positions=True)
        except openmm.OpenMMException as error:
            raise SimulationError(f"relaxation failed: {one_line(error)}") from error
        relaxed = np.asarray(raw.getPositions(asNumpy=True)._value, dtype=np.float64)[: self._n_atoms]
        energy = self._potential()
        if not (math.isfinite(energy) and np.isfinite(relaxed).all()):
            raise SimulationError("relaxation failed: coordinates or energy are no longer finite")
        return Relaxed(relaxed, energy)

    def _potential(self) -> float:
        raw = self._context.getState(energy=True, groups=~(1 << _GROUP) & 0xFFFFFFFF)
        return float(raw.getPotentialEnergy()._value)

    def close(self) -> None:
        """Free the Context. The relaxer cannot be used afterwards."""
        self._context = None

    def __enter__(self) -> Relaxer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
