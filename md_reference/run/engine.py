"""A scene in an OpenMM Context: energies, forces, minimisation, steps; and relaxation of the stiff bonds of a frame."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import solute_of
from md_reference.forces.quantum import refuse_rearranged
from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.machine import make_context, platform_for
from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.validity import changed_stereo
from systems.errors import PreparationError, SimulationError, first_line, listed
from systems.files.whole_file import Closing
from systems.scene import FloatArray, Scene, part_of
from systems.units import GAS_CONSTANT_KJ_MOL_K, hottest_k

_VELOCITY_TOLERANCE = 1e-8
_STEPS_BETWEEN_VOLUME_MOVES = 25
# A bond is broken that is longer than so many sums of covalent radii; the longest of a minimised molecule are 1.1.
_BROKEN = 1.25
# Each atom's spring in `Relaxer`. Bonds are a hundred times stiffer, so that a bond 0.05 nm off comes back to within
# 0.001 nm of its rest, where an atom pulled by kT strays 0.03 nm.
_SPRING_KJ_MOL_NM2 = 2500.0
_CONSTRAINT_TOLERANCE = 1e-5


@dataclass(frozen=True)
class State:
    """Positions `(n_atoms, 3)` nm, energies in kJ/mol, kinetic temperature in K. Where asked for: velocities `(n_atoms,
    3)` nm/ps and forces `(n_atoms, 3)` kJ/mol/nm, without those of constraints. Box vectors `(3, 3)` nm in a periodic
    system."""

    positions_nm: FloatArray
    potential_kj_mol: float
    kinetic_kj_mol: float
    temperature_k: float
    velocities_nm_ps: FloatArray | None = None
    forces_kj_mol_nm: FloatArray | None = None
    cell_nm: FloatArray | None = None


@contextmanager
def _openmm_errors(what: str) -> Iterator[None]:
    """Turn an error of OpenMM into `what: reason`, one line without the advice and the web address behind it."""
    import openmm

    try:
        yield
    except openmm.OpenMMException as error:
        reason = first_line(error).split("  For more information")[0].rstrip(".")
        raise SimulationError(f"{what}: {reason}") from error


def refuse_damaged(scene: Scene, minimised_nm: FloatArray) -> None:
    """Raise PreparationError where a bond of the solute broke in the minimisation, which left positions `(n_atoms, 3)`
    nm, as one that runs through a ring does, or where its handedness changed."""
    atoms = solute_of(scene)
    if scene.interactions is not None or not len(atoms):
        return
    bonds = scene.bonds[np.isin(scene.bonds, atoms).all(axis=1)]
    radii_nm = np.array([sum(covalent_radius_nm(scene.elements[i]) for i in bond) for bond in bonds.tolist()])
    was, now = (np.linalg.norm(x[bonds[:, 0]] - x[bonds[:, 1]], axis=1) for x in (scene.positions_nm, minimised_nm))
    broken = np.flatnonzero((now > _BROKEN * radii_nm) & (was <= _BROKEN * radii_nm))
    if len(broken):
        residue = scene.residue_of_atom
        label = [f"{scene.residue_names[r]} {scene.residue_ids[r]} {a}" for a, r in zip(scene.atom_names, residue)]
        names = [" - ".join(label[i] for i in bonds[k]) for k in broken]
        raise PreparationError(
            f"{scene.name}: energy minimisation breaks the bond {listed(names, 3)} ({10 * now[broken[0]]:.2f} Å) "
            "because atoms overlap there; correct the coordinates or rebuild the molecule."
        )
    if what := changed_stereo(part_of(scene, atoms), minimised_nm[atoms][None])[0]:
        raise PreparationError(
            f"{scene.name}: in energy minimisation {what} because the geometry is broken there; correct the "
            "coordinates or rebuild the molecule."
        )


class Engine(Closing):
    """One scene, one force field, one integrator, one Context. Use as a context manager or call `close`.

    `conditions`: force field and ensemble resolved for the scene (`config.resolved`). `threads`: of the CPU platform.
    `system`: what `build_system` returned, where it is there already; a barostat is added to it. Virtual sites are
    placed here and appear nowhere else. Raises what `build_system` raises, and SimulationError when the platform cannot
    run the scene.
    """

    def __init__(self, scene: Scene, conditions: Conditions, *, threads: int | None = None, system: Any = None) -> None:
        import openmm

        self.ensemble = conditions.ensemble
        self.scene = scene
        self.spec = conditions.force
        choice = platform_for(scene, conditions)
        self.platform_name, self.threads = choice.name, threads or choice.threads
        self._system = build_system(scene, self.spec) if system is None else system
        # OpenMM reads a seed of 0 as "choose one from the clock".
        self._seed = conditions.seed % (2**31 - 1) + 1
        self._temperature_k = conditions.temperature_k
        if self.ensemble == "npt":  # Åqvist et al., Chem. Phys. Lett. 384, 288 (2004)
            pressure = conditions.pressure_bar, self._temperature_k, _STEPS_BETWEEN_VOLUME_MOVES
            barostat = openmm.MonteCarloBarostat(*pressure)
            barostat.setRandomNumberSeed(self._seed)
            self._system.addForce(barostat)
        if self.ensemble == "nve":
            constrained = self._system.getNumConstraints() > 0
            self._integrator = _velocity_verlet(conditions.timestep_ps, constrained=constrained)
        else:
            bath = self._temperature_k, conditions.friction_per_ps, conditions.timestep_ps
            self._integrator = openmm.LangevinMiddleIntegrator(*bath)
        self._integrator.setRandomNumberSeed(self._seed)
        with _openmm_errors(f"platform {choice.name} cannot run {scene.name!r}"):
            self._context: Any = make_context(self._system, self._integrator, choice.name, self.threads)
        masses = [self._system.getParticleMass(k)._value for k in range(self._system.getNumParticles())]
        self._masses_da = np.array(masses, dtype=np.float64)
        self.set_positions(scene.positions_nm)
        # Degrees of freedom that hold kinetic energy; without a bath those of the centre of mass are at rest.
        self.n_dof = 3 * int(np.count_nonzero(self._masses_da)) - self.n_constraints - 3 * self._keeps_momentum

    @property
    def n_constraints(self) -> int:
        return int(self._system.getNumConstraints())

    @property
    def _keeps_momentum(self) -> bool:
        return self.ensemble == "nve" and self.scene.interactions is None

    def _with_virtual(self, values: npt.ArrayLike) -> FloatArray:
        """Append a row of zeros for each virtual site to per-atom vectors."""
        given = np.asarray(values, dtype=np.float64)
        return np.concatenate([given, np.zeros((len(self._masses_da) - len(given), 3))])

    def set_positions(self, positions_nm: npt.ArrayLike) -> None:
        """Place the atoms, `(n_atoms, 3)` nm."""
        self._context.setPositions(self._with_virtual(positions_nm))
        self._context.computeVirtualSites()

    def set_velocities(self, velocities_nm_ps: npt.ArrayLike) -> None:
        """Set velocities `(n_atoms, 3)` nm/ps. In NVE the centre of mass is put at rest, where it then stays."""
        velocities = self._with_virtual(velocities_nm_ps)
        if self._keeps_momentum:
            drift = self._masses_da @ velocities / self._masses_da.sum()
            velocities = velocities - drift * (self._masses_da > 0)[:, None]
        self._context.setVelocities(velocities)

    def take_over(self, state: State) -> None:
        """Take over cell, positions and velocities of another engine of this scene."""
        if state.cell_nm is not None:
            self._context.setPeriodicBoxVectors(*np.asarray(state.cell_nm, dtype=np.float64).tolist())
        self.set_positions(state.positions_nm)
        if state.velocities_nm_ps is not None:
            self.set_velocities(state.velocities_nm_ps)

    def energy(self, positions_nm: npt.ArrayLike | None = None) -> float:
        """Return the potential energy in kJ/mol, here or at given positions `(n_atoms, 3)` nm."""
        if positions_nm is not None:
            self.set_positions(positions_nm)
        return float(self._query(energy=True).getPotentialEnergy()._value)

    def forces(self, positions_nm: npt.ArrayLike | None = None) -> FloatArray:
        """Return the forces `(n_atoms, 3)` in kJ/mol/nm."""
        if positions_nm is not None:
            self.set_positions(positions_nm)
        return self._of_atoms(self._query(forces=True).getForces(asNumpy=True))

    def minimise(self, *, max_iterations: int = 0) -> float:
        """Minimise in place (L-BFGS until converged when 0) and return the energy in kJ/mol. Raises SimulationError
        when the energy is not finite, and PreparationError where quantum forces lead to another molecule."""
        import openmm

        # Without this the minimiser may search for ever.
        if not math.isfinite(self.energy()):
            raise SimulationError("the energy of the starting positions is not finite; atoms lie on top of each other")
        with _openmm_errors("minimisation failed"):
            openmm.LocalEnergyMinimizer.minimize(self._context, maxIterations=max_iterations)
        energy = self.energy()
        if not math.isfinite(energy):
            raise SimulationError("minimisation failed: the energy is no longer finite")
        if self.spec.force_field == QUANTUM:
            refuse_rearranged(self.scene, self.positions())
        return energy

    def thermalise(self) -> None:
        """Draw velocities from the Maxwell-Boltzmann distribution at the bath's temperature."""
        self._context.setVelocitiesToTemperature(self._temperature_k, self._seed)
        if self._keeps_momentum:
            self.set_velocities(self._of_atoms(self._query(velocities=True).getVelocities(asNumpy=True)))

    def step(self, n_steps: int) -> None:
        """Integrate. Raises SimulationError when OpenMM itself notices that coordinates are no longer finite."""
        with _openmm_errors("integration failed"):
            self._integrator.step(n_steps)

    def positions(self) -> FloatArray:
        """Return positions `(n_atoms, 3)` nm without computing any energy."""
        return self._of_atoms(self._query(positions=True).getPositions(asNumpy=True))

    def _of_atoms(self, values: Any) -> FloatArray:
        """Return OpenMM's per-particle vectors without those of virtual sites."""
        return np.asarray(values._value, dtype=np.float64)[: self.scene.n_atoms]

    def state(self, *, velocities: bool = False, forces: bool = False) -> State:
        """Return positions, energies and kinetic temperature, and what else is asked for.

        With a bath, velocities are those of half steps (Zhang et al., J. Phys. Chem. A 123, 6056 (2019)), and so is the
        temperature. Raises SimulationError for a state that is not finite, or hotter than the bath can make it
        (`hottest_k`); a model system without a bath may be as hot as it likes.
        """
        # The Langevin middle integrator leaves in its velocities half of each step's noise along the constrained bonds,
        # and projects it out after the next kick. Seen as temperature it would be n_constraints / (4 n_dof) of
        # 1 - exp(-2 friction timestep) too much: 5 K of 300 at 91/ps and 2 fs. It is projected out here, which changes
        # no trajectory but in its rounding.
        if self.n_constraints and self.ensemble != "nve":
            self._context.applyVelocityConstraints(_VELOCITY_TOLERANCE)
        raw = self._query(positions=True, energy=True, velocities=velocities, forces=forces)
        kinetic = float(raw.getKineticEnergy()._value)
        periodic = self.scene.cell_nm is not None
        state = State(
            positions_nm=self._of_atoms(raw.getPositions(asNumpy=True)),
            potential_kj_mol=float(raw.getPotentialEnergy()._value),
            kinetic_kj_mol=kinetic,
            temperature_k=2.0 * kinetic / (max(self.n_dof, 1) * GAS_CONSTANT_KJ_MOL_K),
            velocities_nm_ps=self._of_atoms(raw.getVelocities(asNumpy=True)) if velocities else None,
            forces_kj_mol_nm=self._of_atoms(raw.getForces(asNumpy=True)) if forces else None,
            cell_nm=np.asarray(raw.getPeriodicBoxVectors(asNumpy=True)._value) if periodic else None,
        )
        if not (np.isfinite(state.positions_nm).all() and math.isfinite(state.potential_kj_mol)):
            raise SimulationError("coordinates or energy are no longer finite")
        is_free = self.ensemble == "nve" and self.scene.interactions is not None
        if not (is_free or state.temperature_k <= hottest_k(self._temperature_k, self.n_dof)):
            raise SimulationError(f"the system blew up (kinetic temperature {state.temperature_k:.3g} K)")
        return state

    def _query(self, **what: Any) -> Any:
        """Return OpenMM's State; some platforms notice here that coordinates are no longer finite."""
        with _openmm_errors("evaluation failed"):
            return self._context.getState(**what)

    def checkpoint(self) -> bytes:
        """Return OpenMM's binary checkpoint: positions, velocities, time, random states. Same platform only."""
        return bytes(self._context.createCheckpoint())

    def restore(self, blob: bytes) -> None:
        """Go back to a checkpoint. Raises SimulationError when it was made by another platform or system."""
        with _openmm_errors("checkpoint does not fit this run"):
            self._context.loadCheckpoint(blob)

    def close(self) -> None:
        """Free the Context. The engine cannot be used afterwards."""
        self._context = None


def _velocity_verlet(timestep_ps: float, *, constrained: bool) -> Any:
    """Return velocity Verlet (Swope et al., J. Chem. Phys. 76, 637 (1982)), with RATTLE where bonds are constrained.
    Unlike those of OpenMM's VerletIntegrator, a leapfrog, its velocities belong to the same time as its positions."""
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


# ---- frames whose stiff bonds are off -------------------------------------------------------------------------------


class Relaxer(Engine):
    """An engine with a spring on each atom. `system`: as `build_system` returns it; it is copied."""

    def __init__(self, scene: Scene, system: Any, *, platform: str = "auto", born: bool = True) -> None:
        import openmm

        held = openmm.XmlSerializer.clone(system)
        self._springs = openmm.CustomExternalForce("0.5*k*((x-x0)^2+(y-y0)^2+(z-z0)^2)")
        self._springs.addGlobalParameter("k", _SPRING_KJ_MOL_NM2)
        for name in ("x0", "y0", "z0"):
            self._springs.addPerParticleParameter(name)
        for k in range(scene.n_atoms):
            self._springs.addParticle(k, [0.0, 0.0, 0.0])
        held.addForce(self._springs)
        # Of the forces only whether they have a Born term matters here, for the choice of a platform.
        spec = ForceFieldSpec("auto", "auto" if born else "vacuum")
        super().__init__(scene, Conditions(force=spec, platform=platform), system=held)

    def relax(self, positions_nm: npt.ArrayLike) -> FloatArray:
        """Restore constrained bonds exactly, then minimise under the springs; return the positions `(n_atoms, 3)` nm.
        Raises SimulationError where the energy is not finite before or after."""
        start = np.asarray(positions_nm, dtype=np.float64)
        if not np.isfinite(start).all():
            raise SimulationError("a frame that is not finite cannot be relaxed")
        for k, at in enumerate(start.tolist()):
            self._springs.setParticleParameters(k, k, at)
        with _openmm_errors("relaxation failed"):
            self._springs.updateParametersInContext(self._context)
            if not math.isfinite(self.energy(start)):
                raise SimulationError("the energy of a frame to relax is not finite; atoms lie on top of each other")
            self._context.applyConstraints(_CONSTRAINT_TOLERANCE)
            self.minimise()
        return self.positions()
