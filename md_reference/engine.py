"""An OpenMM Context behind six verbs: energy, forces, minimise, step, state, close."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.forcefield import ForceFieldSpec, build_system
from md_reference.platforms import choose_platform
from systems.errors import SimulationError
from systems.scene import FloatArray, Scene

GAS_CONSTANT_KJ_MOL_K = 8.31446261815324e-3
# Minus the logarithm of how often chance may be taken for a blow-up.
_UNLIKELINESS = 50.0
_VELOCITY_TOLERANCE = 1e-8


@dataclass(frozen=True)
class State:
    """Positions `(n_atoms, 3)` nm, energies in kJ/mol, time in ps, kinetic temperature in K."""

    positions_nm: FloatArray
    potential_kj_mol: float
    kinetic_kj_mol: float
    time_ps: float
    temperature_k: float


def _one_line(error: Exception) -> str:
    """OpenMM's own words, without its advice and its address."""
    return str(error).splitlines()[0].split("  For more information")[0].rstrip(".")


class Engine:
    """One scene, one force field, one integrator, one Context. Use as a context manager or call `close`."""

    def __init__(
        self,
        scene: Scene,
        spec: ForceFieldSpec,
        *,
        temperature_k: float = 300.0,
        friction_per_ps: float = 1.0,
        timestep_ps: float = 0.004,
        seed: int = 0,
        platform: str = "auto",
        threads: int | None = None,
        native_gb: bool = True,
    ) -> None:
        import openmm

        self.scene = scene
        self.spec = spec
        choice = choose_platform(scene.n_atoms, platform, born=spec.solvent != "vacuum")
        self.platform_name = choice.name
        self._system = build_system(scene, spec, native_gb=native_gb)
        self._integrator = openmm.LangevinMiddleIntegrator(temperature_k, friction_per_ps, timestep_ps)
        # OpenMM reads a seed of 0 as "choose one from the clock".
        self._seed = seed % (2**31 - 1) + 1
        self._integrator.setRandomNumberSeed(self._seed)
        self._temperature_k = temperature_k
        properties = {"Threads": str(threads or choice.threads)} if choice.name == "CPU" else {}
        try:
            self._context: Any = openmm.Context(
                self._system, self._integrator, openmm.Platform.getPlatform(self.platform_name), properties
            )
        except openmm.OpenMMException as error:
            raise SimulationError(f"platform {choice.name} cannot run {scene.name!r}: {_one_line(error)}") from error
        self._context.setPositions(scene.positions_nm)
        n_virtual = sum(self._system.isVirtualSite(i) for i in range(self._system.getNumParticles()))
        self._n_dof = 3 * (scene.n_atoms - n_virtual) - self._system.getNumConstraints()

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_constraints(self) -> int:
        return int(self._system.getNumConstraints())

    def set_positions(self, positions_nm: npt.ArrayLike) -> None:
        """Place the atoms, `(n_atoms, 3)` nm."""
        self._context.setPositions(np.asarray(positions_nm, dtype=np.float64))

    def energy(self, positions_nm: npt.ArrayLike | None = None) -> float:
        """Return the potential energy in kJ/mol, here or at given positions `(n_atoms, 3)` nm."""
        if positions_nm is not None:
            self.set_positions(positions_nm)
        return float(self._query(energy=True).getPotentialEnergy()._value)

    def forces(self, positions_nm: npt.ArrayLike | None = None) -> FloatArray:
        """Return the forces `(n_atoms, 3)` in kJ/mol/nm."""
        if positions_nm is not None:
            self.set_positions(positions_nm)
        return np.asarray(self._query(forces=True).getForces(asNumpy=True)._value, dtype=np.float64)

    def minimise(self, *, max_iterations: int = 0) -> float:
        """Minimise in place (L-BFGS until converged when 0) and return the energy in kJ/mol.

        Raises SimulationError when the energy is not finite, as with atoms on top of each other.
        """
        import openmm

        # Without this the minimiser may search for ever.
        if not math.isfinite(self.energy()):
            raise SimulationError("the energy of the starting positions is not finite; atoms lie on top of each other")
        try:
            openmm.LocalEnergyMinimizer.minimize(self._context, maxIterations=max_iterations)
        except openmm.OpenMMException as error:
            raise SimulationError(f"minimisation failed: {_one_line(error)}") from error
        energy = self.energy()
        if not math.isfinite(energy):
            raise SimulationError("minimisation failed: the energy is no longer finite")
        return energy

    def thermalise(self) -> None:
        """Draw velocities from the Maxwell-Boltzmann distribution at the bath's temperature."""
        self._context.setVelocitiesToTemperature(self._temperature_k, self._seed)

    def reset_clock(self) -> None:
        self._context.setTime(0.0)
        self._context.setStepCount(0)

    def step(self, n_steps: int) -> None:
        """Integrate. Raises SimulationError when OpenMM itself notices that coordinates are no longer finite."""
        import openmm

        try:
            self._integrator.step(n_steps)
        except openmm.OpenMMException as error:
            raise SimulationError(f"integration failed: {_one_line(error)}") from error

    def positions(self) -> FloatArray:
        """Return positions `(n_atoms, 3)` nm without computing any energy."""
        return np.asarray(self._query(positions=True).getPositions(asNumpy=True)._value, dtype=np.float64)

    def state(self) -> State:
        """Return positions, energies, time and kinetic temperature.

        The Langevin middle integrator leaves in its velocities half of each step's noise along the constrained bonds,
        and projects it out after the next kick. Seen as temperature it would be n_constraints / (4 n_dof) of
        1 - exp(-2 friction timestep) too much: 5 K of 300 at 91/ps and 2 fs. It is projected out here, which changes
        no trajectory but in its rounding.

        Raises SimulationError for a state that is not finite, or hotter than the bath can make it: 1 + 2 sqrt(x/n) +
        2 x/n times, n degrees of freedom, x = 50, which chance exceeds in one frame of 10^21 (Laurent and Massart,
        Ann. Statist. 28, 1302 (2000), lemma 1).
        """
        if self.n_constraints:
            self._context.applyVelocityConstraints(_VELOCITY_TOLERANCE)
        raw = self._query(positions=True, energy=True)
        kinetic = float(raw.getKineticEnergy()._value)
        state = State(
            positions_nm=np.asarray(raw.getPositions(asNumpy=True)._value, dtype=np.float64),
            potential_kj_mol=float(raw.getPotentialEnergy()._value),
            kinetic_kj_mol=kinetic,
            time_ps=float(raw.getTime()._value),
            temperature_k=2.0 * kinetic / (self._n_dof * GAS_CONSTANT_KJ_MOL_K),
        )
        if not (np.isfinite(state.positions_nm).all() and math.isfinite(state.potential_kj_mol)):
            raise SimulationError("coordinates or energy are no longer finite")
        x = _UNLIKELINESS / self._n_dof
        if not state.temperature_k <= self._temperature_k * (1.0 + 2.0 * math.sqrt(x) + 2.0 * x):
            raise SimulationError(f"the system blew up (kinetic temperature {state.temperature_k:.3g} K)")
        return state

    def _query(self, **what: bool) -> Any:
        """Return OpenMM's State; some platforms notice here that coordinates are no longer finite."""
        import openmm

        try:
            return self._context.getState(**what)
        except openmm.OpenMMException as error:
            raise SimulationError(f"evaluation failed: {_one_line(error)}") from error

    def checkpoint(self) -> bytes:
        """Return OpenMM's binary checkpoint: positions, velocities, time, random states. Same platform only."""
        return bytes(self._context.createCheckpoint())

    def restore(self, blob: bytes) -> None:
        """Go back to a checkpoint. Raises SimulationError when it was made by another platform or system."""
        import openmm

        try:
            self._context.loadCheckpoint(blob)
        except openmm.OpenMMException as error:
            raise SimulationError(f"checkpoint does not fit this run: {_one_line(error)}") from error

    def close(self) -> None:
        """Free the Context. The engine cannot be used afterwards."""
        self._context = None
