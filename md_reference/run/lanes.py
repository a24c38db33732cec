"""Molecular dynamics of sixteen copies of one molecule at once, each in its lane of the processor's vector registers.

OpenMM's Reference and CPU platforms evaluate one molecule at a time, of which a register holds nothing alike; copies of
one molecule are alike in everything but their coordinates. The terms come from an `openmm.System` and are evaluated by
`lanes.cpp` in single precision, compiled by this machine's C++ compiler at first use; `Lanes.check` compares energies
and forces with OpenMM's. Integrator: Langevin middle, with constraints, as OpenMM has it.
"""

from __future__ import annotations

import ctypes
import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.run.engine import GAS_CONSTANT_KJ_MOL_K, hottest_k
from md_reference.run.platforms import LANES, PlatformChoice
from systems.errors import InputError, SimulationError
from systems.files.native import CompilerError, compiled_program
from systems.scene import FloatArray

_SOURCE = Path(__file__).with_name("lanes.cpp")
_COULOMB = 138.93545764438198
_OFFSET_NM = 0.009
_PERIODS = 6
# Of a force's root mean square over the molecule: single precision leaves 1e-5, a missing term more than 1e-2.
_FORCE_TOLERANCE = 2e-4
_ENERGY_TOLERANCE_KJ_MOL = 0.02
_CHECKED_AT = 0.002
_CENTRED_STEPS = 500


class LanesUnavailableError(SimulationError):
    """This machine cannot compile the program, or it does not know a term of the System."""


_COUNTS = ("n_atoms", "n_bonds", "n_angles", "n_torsions", "n_constraints", "born", "n_biased")
_ARRAYS = (
    "bonds", "bond_terms", "angles", "angle_terms", "torsions", "torsion_terms", "biases", "pairs", "atoms",
    "constraints", "lengths",
)  # fmt: skip
_NUMBERS = ("surface", "timestep", "keep", "noise")


class _System(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int32) for name in _COUNTS),
        *((name, ctypes.c_void_p) for name in _ARRAYS),
        *((name, ctypes.c_float) for name in _NUMBERS),
        ("work", ctypes.c_void_p),
    ]


@lru_cache(maxsize=1)
def _program() -> ctypes.CDLL:
    """Return `lanes.cpp` compiled for this processor."""
    try:
        program = compiled_program(_SOURCE)
    except CompilerError as error:
        raise LanesUnavailableError(f"{error}, which platform lanes needs; take another platform.") from error
    pointer = ctypes.c_void_p
    program.work_floats.restype, program.work_floats.argtypes = ctypes.c_int64, [ctypes.c_int64]
    program.forces.restype, program.forces.argtypes = None, [pointer, pointer, pointer, pointer]
    program.constrain_velocities.restype, program.constrain_velocities.argtypes = ctypes.c_int32, [pointer] * 3
    program.step.restype = ctypes.c_int64
    program.step.argtypes = [pointer, pointer, pointer, pointer, ctypes.c_int64]
    return program


def n_lanes() -> int:
    """How many copies a batch has. Raises LanesUnavailableError."""
    return int(_program().lanes())


def lanes_choice() -> PlatformChoice:
    """Return the platform as plans and records name it. Raises LanesUnavailableError."""
    return PlatformChoice(LANES, 1, f"{n_lanes()} replicas at once on a core, forces checked against OpenMM's")


class Lanes:
    """`n_lanes()` copies of one molecule under Langevin dynamics.

    `system`: an `openmm.System` without a box, of harmonic bonds and angles, periodic torsions, NonbondedForce without
    a cutoff and, if any, GBSAOBCForce; anything else raises LanesUnavailableError. Friction 0 is NVE (leapfrog).
    Positions and velocities are `(n_lanes, n_atoms, 3)` in nm and nm/ps. `biased`: torsions, each four atoms, that
    `set_bias` may hold in each copy at another angle.
    """

    def __init__(
        self,
        system: Any,
        *,
        temperature_k: float,
        friction_per_ps: float,
        timestep_ps: float,
        seed: int,
        biased: Sequence[Sequence[int]] = (),
    ) -> None:
        self._program = _program()
        self.n_lanes = n_lanes()
        self.n_atoms = system.getNumParticles()
        self.temperature_k, self.timestep_ps = temperature_k, timestep_ps
        self.masses_da = np.array([system.getParticleMass(k)._value for k in range(self.n_atoms)])
        terms = _terms(system)
        keep = math.exp(-friction_per_ps * timestep_ps)
        terms["atoms"][:, 0] = 1.0 / self.masses_da
        # Biased torsions come first; the molecule's own terms of the same four atoms stand apart.
        for name, rows in (("torsions", list(biased)), ("torsion_terms", np.zeros((len(biased), 1 + 2 * _PERIODS)))):
            given = terms[name]
            terms[name] = np.concatenate([np.reshape(rows, (-1, given.shape[1])), given]).astype(given.dtype)
        terms["biases"] = np.zeros((len(biased), 2, self.n_lanes), dtype=np.float32)
        terms["atoms"][:, 1] = np.sqrt(GAS_CONSTANT_KJ_MOL_K * temperature_k / self.masses_da)
        # The program reads these arrays in place.
        self._kept = {name: np.ascontiguousarray(terms[name]) for name in _ARRAYS}
        self._work = np.zeros(int(self._program.work_floats(self.n_atoms)), dtype=np.float32)
        self._system = _System(
            n_atoms=self.n_atoms,
            n_bonds=len(terms["bonds"]),
            n_angles=len(terms["angles"]),
            n_torsions=len(terms["torsions"]),
            n_constraints=len(terms["constraints"]),
            born=int(terms["born"]),
            n_biased=len(biased),
            surface=float(terms["surface"]),
            timestep=timestep_ps,
            keep=keep,
            noise=math.sqrt(1.0 - keep * keep),
            work=self._work.ctypes.data,
            **{name: self._kept[name].ctypes.data for name in _ARRAYS},
        )
        self.n_dof = 3 * self.n_atoms - len(terms["constraints"])
        self._rng = np.random.default_rng(seed)
        self._random = self._rng.integers(1, 2**32, size=(4, self.n_lanes), dtype=np.uint32)
        shape = (self.n_atoms, 3, self.n_lanes)
        self._positions, self._velocities = np.zeros(shape, np.float32), np.zeros(shape, np.float32)

    def check(self, system: Any, positions_nm: npt.ArrayLike) -> None:
        """Compare energies and forces with OpenMM's at slightly disturbed copies of one structure `(n_atoms, 3)` nm.

        Raises SimulationError where they differ by more than single precision explains.
        """
        import openmm

        given = self._centred(np.asarray(positions_nm, dtype=np.float64))
        disturbed = given + self._rng.normal(0.0, _CHECKED_AT, (self.n_lanes, *given.shape))
        energies, forces = self.energies_and_forces(disturbed)
        context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform("Reference"))
        for k, frame in enumerate(disturbed.astype(np.float32)):
            context.setPositions(frame)
            state = context.getState(energy=True, forces=True)
            exact = state.getForces(asNumpy=True)._value
            size = math.sqrt(float(np.mean(exact**2)))
            off = float(np.abs(forces[k] - exact).max()) / size
            wrong = abs(float(energies[k]) - state.getPotentialEnergy()._value)
            if not (off < _FORCE_TOLERANCE and wrong < _ENERGY_TOLERANCE_KJ_MOL):
                raise SimulationError(
                    f"molecular dynamics in lanes differs from OpenMM by {off:.2g} of the root mean square force and "
                    f"{wrong:.2g} kJ/mol; take another platform."
                )

    def energies_and_forces(self, positions_nm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return energies `(n_lanes,)` kJ/mol and forces `(n_lanes, n_atoms, 3)` kJ/mol/nm at given positions."""
        positions, forces = _inwards(positions_nm), np.zeros_like(self._positions)
        energies = np.zeros(self.n_lanes)
        self._program.forces(
            ctypes.byref(self._system), positions.ctypes.data, forces.ctypes.data, energies.ctypes.data
        )
        return energies, _outwards(forces)

    def set_positions(self, positions_nm: npt.ArrayLike) -> None:
        """Place the atoms `(n_lanes, n_atoms, 3)` nm, each copy's centre of mass at the origin."""
        self._positions = _inwards(self._centred(np.asarray(positions_nm, dtype=np.float64)))

    def set_velocities(self, velocities_nm_ps: npt.ArrayLike) -> None:
        """Set velocities `(n_lanes, n_atoms, 3)` nm/ps."""
        self._velocities = _inwards(velocities_nm_ps)

    def set_bias(self, place: int, centres_rad: npt.ArrayLike, stiffness_kj_mol: float) -> None:
        """Add -stiffness cos(angle - centre) of the biased torsion at this place to the energy of each copy;
        `centres_rad` (n_lanes,)."""
        centres = np.asarray(centres_rad, dtype=np.float64)
        self._kept["biases"][place] = -stiffness_kj_mol * np.stack([np.cos(centres), np.sin(centres)])

    def thermalise(self) -> None:
        """Draw velocities from the Maxwell-Boltzmann distribution; the first step removes those along rigid bonds."""
        speed = np.sqrt(GAS_CONSTANT_KJ_MOL_K * self.temperature_k / self.masses_da)[:, None]
        self.set_velocities(self._rng.normal(size=(self.n_lanes, self.n_atoms, 3)) * speed)

    def step(self, n_steps: int) -> None:
        """Integrate. Raises SimulationError when a constraint cannot be met, or a copy is hotter than chance allows."""
        for done in range(0, n_steps, _CENTRED_STEPS):
            met = self._program.step(
                ctypes.byref(self._system),
                self._positions.ctypes.data,
                self._velocities.ctypes.data,
                self._random.ctypes.data,
                min(_CENTRED_STEPS, n_steps - done),
            )
            if met:
                raise SimulationError("a copy of the molecule blew up: its constraints cannot be met")
            self.set_positions(self.positions_nm)
        hottest = hottest_k(self.temperature_k, self.n_dof)
        if not (np.isfinite(self._positions).all() and self.temperatures_k().max() < hottest):
            raise SimulationError("a copy of the molecule blew up: it is hotter than the bath can make it")

    def checkpoint(self) -> bytes:
        """Return positions, velocities and random states: `restore` goes on as if nothing had been."""
        return b"".join(array.tobytes() for array in (self._positions, self._velocities, self._random))

    def restore(self, blob: bytes) -> None:
        """Go back to a checkpoint. Raises InputError when it is of another molecule or number of lanes."""
        arrays = (self._positions, self._velocities, self._random)
        if len(blob) != sum(array.nbytes for array in arrays):
            raise InputError("the checkpoint of these replicas is of another molecule or processor.")
        at = 0
        for array in arrays:
            array[...] = np.frombuffer(blob, array.dtype, array.size, at).reshape(array.shape)
            at += array.nbytes

    def _centred(self, positions_nm: FloatArray) -> FloatArray:
        """Far from the origin, where copies wander, single precision is too coarse for constraints."""
        return positions_nm - np.average(positions_nm, axis=-2, weights=self.masses_da)[..., None, :]

    @property
    def positions_nm(self) -> FloatArray:
        return _outwards(self._positions)

    @property
    def velocities_nm_ps(self) -> FloatArray:
        return _outwards(self._velocities)

    def energies(self) -> FloatArray:
        """Return the potential energy of each copy `(n_lanes,)` kJ/mol."""
        return self.energies_and_forces(self.positions_nm)[0]

    def temperatures_k(self) -> FloatArray:
        """Return the kinetic temperature of each copy `(n_lanes,)` K, as `Engine.state` has it."""
        velocities = self._velocities.copy()
        self._program.constrain_velocities(
            ctypes.byref(self._system), self._positions.ctypes.data, velocities.ctypes.data
        )
        kinetic = 0.5 * np.einsum("a,adl->l", self.masses_da, velocities.astype(np.float64) ** 2)
        return np.asarray(2.0 * kinetic / (self.n_dof * GAS_CONSTANT_KJ_MOL_K))


def _inwards(values: npt.ArrayLike) -> npt.NDArray[np.float32]:
    return np.ascontiguousarray(np.moveaxis(np.asarray(values), 0, -1), dtype=np.float32)


def _outwards(values: npt.NDArray[np.float32]) -> FloatArray:
    return np.ascontiguousarray(np.moveaxis(values, -1, 0), dtype=np.float64)


def _terms(system: Any) -> dict[str, Any]:
    """Return the arrays that `lanes.cpp` reads. Raises LanesUnavailableError for a term that it does not know."""
    import openmm

    n = system.getNumParticles()
    if any(system.isVirtualSite(k) or system.getParticleMass(k)._value <= 0 for k in range(n)):
        raise LanesUnavailableError("platform lanes knows no virtual sites or fixed atoms; take another platform.")
    terms: dict[str, Any] = {
        "bonds": [], "bond_terms": [], "angles": [], "angle_terms": [], "born": False, "surface": 0.0,
        "pairs": np.zeros((n * (n - 1) // 2, 4)), "atoms": np.zeros((n, 6)),
    }  # fmt: skip
    torsions: dict[tuple[int, ...], FloatArray] = defaultdict(lambda: np.zeros(1 + 2 * _PERIODS))
    for force in system.getForces():
        kind = type(force).__name__
        if isinstance(force, openmm.HarmonicBondForce):
            for k in range(force.getNumBonds()):
                *atoms, length, stiff = force.getBondParameters(k)
                terms["bonds"].append(atoms)
                terms["bond_terms"].append((length._value, stiff._value))
        elif isinstance(force, openmm.HarmonicAngleForce):
            for k in range(force.getNumAngles()):
                *atoms, angle, stiff = force.getAngleParameters(k)
                terms["angles"].append(atoms)
                terms["angle_terms"].append((angle._value, stiff._value))
        elif isinstance(force, openmm.PeriodicTorsionForce):
            for k in range(force.getNumTorsions()):
                *quad, period, phase, stiff = force.getTorsionParameters(k)
                if period > _PERIODS:
                    raise LanesUnavailableError(
                        f"platform lanes knows no torsion of period {period}; take another platform."
                    )
                quad = min(tuple(quad), tuple(quad[::-1]))
                torsions[quad][0] += stiff._value
                torsions[quad][2 * period - 1] += stiff._value * math.cos(phase._value)
                torsions[quad][2 * period] += stiff._value * math.sin(phase._value)
        elif isinstance(force, openmm.NonbondedForce) and force.getNonbondedMethod() == force.NoCutoff:
            _nonbonded(force, terms["pairs"])
        elif isinstance(force, openmm.GBSAOBCForce) and force.getNonbondedMethod() == force.NoCutoff:
            _born(force, terms)
        elif not isinstance(force, openmm.CMMotionRemover):
            cut = " with a cutoff" if kind in ("NonbondedForce", "GBSAOBCForce") else ""
            raise LanesUnavailableError(f"platform lanes knows no {kind}{cut}; take another platform.")
    constraints = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    terms["torsions"] = np.reshape(list(torsions), (-1, 4))
    terms["torsion_terms"] = np.reshape(list(torsions.values()), (-1, 1 + 2 * _PERIODS))
    terms["constraints"] = [(c[0], c[1]) for c in constraints]
    terms["lengths"] = [c[2]._value for c in constraints]
    # Bonds between atoms whose distance is a constraint exert no force.
    rigid = {frozenset(pair) for pair in terms["constraints"]}
    kept = [k for k, pair in enumerate(terms["bonds"]) if frozenset(pair) not in rigid]
    terms["bonds"], terms["bond_terms"] = ([terms[name][k] for k in kept] for name in ("bonds", "bond_terms"))
    indices = ("bonds", "angles", "torsions", "constraints")
    return {
        name: values
        if name in ("born", "surface")
        else np.asarray(values, dtype=np.int32 if name in indices else np.float32)
        for name, values in terms.items()
    }


def _nonbonded(force: Any, pairs: FloatArray) -> None:
    """Write Coulomb, C12 and C6 of every pair, combined as Lorentz and Berthelot say but for the exceptions."""
    n = force.getNumParticles()
    charge, sigma, epsilon = np.array([[v._value for v in force.getParticleParameters(k)] for k in range(n)]).T
    i, j = np.triu_indices(n, 1)
    product, size, depth = charge[i] * charge[j], 0.5 * (sigma[i] + sigma[j]), np.sqrt(epsilon[i] * epsilon[j])
    place = {pair: k for k, pair in enumerate(itertools.combinations(range(n), 2))}
    for k in range(force.getNumExceptions()):
        a, b, q, s, e = force.getExceptionParameters(k)
        at = place[min(a, b), max(a, b)]
        product[at], size[at], depth[at] = q._value, s._value, e._value
    pairs[:, 0] = _COULOMB * product
    pairs[:, 1] = 4.0 * depth * size**12
    pairs[:, 2] = 4.0 * depth * size**6


def _born(force: Any, terms: dict[str, Any]) -> None:
    n = force.getNumParticles()
    charge, radius, scale = np.array(
        [[getattr(v, "_value", v) for v in force.getParticleParameters(k)] for k in range(n)]
    ).T
    factor = -_COULOMB * (1.0 / force.getSoluteDielectric() - 1.0 / force.getSolventDielectric())
    i, j = np.triu_indices(n, 1)
    terms["born"] = True
    terms["surface"] = 4.0 * math.pi * force.getSurfaceAreaEnergy()._value
    terms["pairs"][:, 3] = factor * charge[i] * charge[j]
    terms["atoms"][:, 2] = radius
    terms["atoms"][:, 3] = radius - _OFFSET_NM
    terms["atoms"][:, 4] = scale * (radius - _OFFSET_NM)
    terms["atoms"][:, 5] = factor * charge**2
