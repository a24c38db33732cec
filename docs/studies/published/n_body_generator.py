"""The n-body systems of LaM-SLidE, section 4.3, by the generator of GeoTDM (Han et al., 2024), in OpenMM.

The laws of a system, whose dimensionless numbers are taken over in nm, ps, Da and kJ/mol (all masses are 1 Da):

- `coulomb`: sum over pairs of C q_i q_j / r, with `coulomb_constant` C and `charges_e` q;
- `springs`: sum over `pairs` of k r^2 / 2, with `force_constant_kj_mol_nm2` k and zero rest length;
- `gravity`: minus the sum over pairs of G m_i m_j / sqrt(r^2 + s^2), with `gravitational_constant` G, `softening_nm` s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.errors import SimulationError

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class NBodyProtocol:
    """How one kind of n-body trajectory is made: LaM-SLidE, section 4.3, by the generator of GeoTDM (Han et al., 2024).

    `position_std_nm`: of every coordinate at the start. `speed_nm_ps`: of every particle, in a random direction; None:
    each component is unit normal and the centre of mass is brought to rest. `integrator`: `kick-drift` (symplectic
    Euler) or `kick-drift-kick` (velocity Verlet). `max_force`: each component of a particle's force is cut there,
    kJ/mol/nm. `first_frame_ps`: time of the first of the saved frames.
    """

    kind: str
    n_particles: int
    position_std_nm: float
    speed_nm_ps: float | None
    integrator: str
    max_force: float | None
    first_frame_ps: float
    timestep_ps: float = 0.001
    save_every_ps: float = 0.1
    n_frames: int = 30


N_BODY = {
    "n-body-charged": NBodyProtocol("coulomb", 5, 1.0, 0.5, "kick-drift", 100.0, 0.1),
    "n-body-spring": NBodyProtocol("springs", 5, 0.5, 0.5, "kick-drift", 100.0, 0.1),
    "n-body-gravity": NBodyProtocol("gravity", 10, 1.0, None, "kick-drift-kick", None, 0.0),
}


@dataclass(frozen=True, eq=False)
class NBodySystem:
    """Starting conditions: `positions_nm`, `velocities_nm_ps` `(n_particles, 3)` under a `law` (see the module)."""

    law: dict[str, Any]
    positions_nm: FloatArray
    velocities_nm_ps: FloatArray


def n_body(name: str, seed: int = 0) -> NBodySystem:
    """Return the n-body system `name` (a key of `N_BODY`) with the starting conditions of `seed`.

    Charges are ±1 with equal probability, springs join each pair with probability 1/2.
    """
    protocol = N_BODY[name]
    rng = np.random.default_rng([sorted(N_BODY).index(name), seed])
    n = protocol.n_particles
    law: dict[str, Any] = {"kind": protocol.kind}
    if protocol.kind == "coulomb":
        law |= {"coulomb_constant": 1.0, "charges_e": rng.choice([-1.0, 1.0], size=n).tolist()}
    elif protocol.kind == "springs":
        joined = rng.random((n, n)) < 0.5
        pairs = [[i, j] for i in range(n) for j in range(i + 1, n) if joined[i, j]]
        law |= {"force_constant_kj_mol_nm2": 0.1, "pairs": pairs}
    else:
        law |= {"gravitational_constant": 1.0, "softening_nm": 0.1}
    positions = rng.normal(size=(n, 3)) * protocol.position_std_nm
    velocities = rng.normal(size=(n, 3))
    if protocol.speed_nm_ps is None:
        velocities -= velocities.mean(axis=0)  # all masses are equal
    else:
        velocities *= protocol.speed_nm_ps / np.linalg.norm(velocities, axis=1, keepdims=True)
    return NBodySystem(law, positions, velocities)


def build_system(n: NBodySystem) -> Any:
    """Return the `openmm.System`: particles of 1 Da and one custom force; no cell, no centre-of-mass removal."""
    from openmm import System

    system = System()
    for _ in n.positions_nm:
        system.addParticle(1.0)
    system.addForce(_pair_force(n.law, len(n.positions_nm)))
    return system


def _pair_force(law: dict[str, Any], n: int) -> Any:
    """Every pair as a bond: 12 to 19 times faster than CustomNonbondedForce here."""
    from openmm import CustomBondForce

    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    if law["kind"] == "springs":
        force = CustomBondForce("0.5*force_constant_kj_mol_nm2*r^2")
        force.addGlobalParameter("force_constant_kj_mol_nm2", law["force_constant_kj_mol_nm2"])
        for i, j in law["pairs"]:
            force.addBond(i, j, [])
        return force
    if law["kind"] == "gravity":
        force = CustomBondForce("-gravitational_constant/sqrt(r^2+softening_nm^2)")
        for key in ("gravitational_constant", "softening_nm"):
            force.addGlobalParameter(key, law[key])
        for i, j in pairs:
            force.addBond(i, j, [])
        return force
    force = CustomBondForce("coulomb_constant*qq/r")
    force.addGlobalParameter("coulomb_constant", law["coulomb_constant"])
    force.addPerBondParameter("qq")
    for i, j in pairs:
        force.addBond(i, j, [law["charges_e"][i] * law["charges_e"][j]])
    return force


def build_integrator(scheme: str, timestep_ps: float, max_force: float | None) -> Any:
    """Return the `openmm.CustomIntegrator` without a bath of a protocol.

    `kick-drift` (symplectic Euler: v += dt F(x)/m, then x += dt v) for charged particles and springs, whose forces are
    cut at `max_force` (kJ/mol/nm) in each component, as published; else `kick-drift-kick` (velocity Verlet).
    """
    from openmm import CustomIntegrator

    force = "f" if max_force is None else f"max(-{max_force!r}, min({max_force!r}, f))"
    integrator = CustomIntegrator(timestep_ps)
    if scheme == "kick-drift":
        integrator.addComputePerDof("v", f"v+dt*{force}/m")
        integrator.addComputePerDof("x", "x+dt*v")
    else:
        integrator.addComputePerDof("v", f"v+0.5*dt*{force}/m")
        integrator.addComputePerDof("x", "x+dt*v")
        integrator.addComputePerDof("v", f"v+0.5*dt*{force}/m")
    return integrator


@dataclass(frozen=True, eq=False)
class NBodyTrajectories:
    """Trajectories of one kind: `positions_nm` and `velocities_nm_ps` `(n, n_frames, n_particles, 3)`.

    `time_ps (n_frames,)`. `charges_e (n, n_particles)`, 0 where the kind has none. `edges` are 1 for a spring,
    `(n, n_particles, n_particles)`.
    """

    name: str
    seeds: tuple[int, ...]
    positions_nm: FloatArray
    velocities_nm_ps: FloatArray
    time_ps: FloatArray
    charges_e: FloatArray
    edges: FloatArray


def generate_n_body(
    name: str,
    seeds: Sequence[int],
    *,
    n_frames: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> NBodyTrajectories:
    """Return the trajectories of the n-body systems `name`, `seed`, by the protocol `N_BODY[name]`.

    One trajectory depends on its seed alone, so sets may be made in parts. Raises SimulationError when a coordinate is
    not finite.
    """
    protocol = N_BODY[name]
    n_frames = protocol.n_frames if n_frames is None else n_frames
    n = protocol.n_particles
    stride = round(protocol.save_every_ps / protocol.timestep_ps)
    positions = np.empty((len(seeds), n_frames, n, 3))
    velocities = np.empty_like(positions)
    charges, edges = np.zeros((len(seeds), n)), np.zeros((len(seeds), n, n))
    for row, seed in enumerate(seeds):
        system = n_body(name, seed)
        law = system.law
        charges[row] = law.get("charges_e", 0.0)
        for i, j in law.get("pairs", []):
            edges[row, i, j] = edges[row, j, i] = 1.0
        positions[row], velocities[row] = _run(system, protocol, stride, n_frames)
        if progress is not None:
            progress(row + 1, len(seeds))
    if not np.isfinite(positions).all():
        bad = seeds[int(np.argmin(np.isfinite(positions).all(axis=(1, 2, 3))))]
        raise SimulationError(f"{name}:{bad}: coordinates are no longer finite.")
    times = protocol.first_frame_ps + protocol.save_every_ps * np.arange(n_frames, dtype=np.float64)
    return NBodyTrajectories(name, tuple(seeds), positions, velocities, times, charges, edges)


def _run(
    start: NBodySystem, protocol: NBodyProtocol, stride: int, n_frames: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    from openmm import Context, Platform

    integrator = build_integrator(protocol.integrator, protocol.timestep_ps, protocol.max_force)
    context = Context(build_system(start), integrator, Platform.getPlatformByName("Reference"))
    context.setPositions(start.positions_nm)
    context.setVelocities(start.velocities_nm_ps)
    positions = np.empty((n_frames, protocol.n_particles, 3))
    velocities = np.empty_like(positions)
    for frame in range(n_frames):
        if frame or protocol.first_frame_ps > 0:
            integrator.step(stride)
        state = context.getState(positions=True, velocities=True)
        positions[frame] = state.getPositions(asNumpy=True)._value
        velocities[frame] = state.getVelocities(asNumpy=True)._value
    return positions, velocities
