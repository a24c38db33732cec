"""Molecular dynamics of many replicas of one scene on one core, each in an element of the vector registers.

OpenMM evaluates one replica at a time; replicas of a scene are alike in everything but their coordinates. The terms
come from an `openmm.System` and are evaluated by `force_field.cpp` in single precision, compiled by this machine's C++
compiler at first use; `SimdReplicas.check` compares energies and forces with OpenMM's. Integrator: Langevin middle,
with constraints, as OpenMM has it.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.simd.system_terms import ENERGY_DEGREE, SimdUnavailableError, Terms, factorised, read_terms
from systems.errors import InputError, SimulationError
from systems.files.native import CompilerError, compiled_program
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K, hottest_k

_SOURCE = Path(__file__).with_name("force_field.cpp")
# Of a force's root mean square over the molecule: single precision leaves 1e-5, a missing term more than 1e-2. In water
# a reciprocal grid of other points than OpenMM's adds its own error. Energies: of a molecule; of each atom in water.
_FORCE_TOLERANCE, _WET_FORCE_TOLERANCE = 2e-4, 2e-3
_ENERGY_TOLERANCE_KJ_MOL, _WET_ENERGY_TOLERANCE_KJ_MOL = 0.02, 2e-4
_CHECKED_AT = 0.002
CENTRED_STEPS = 500
# Waters are listed out to the cutoff and this, for so many steps.
_LIST_MARGIN_NM = 0.1
_LIST_STEPS = 20
# Waters whose places are nearer than this may trade them: the first shell of neighbours.
_TRADED_NM = 0.45
_TOLERANCE = 1e-5


def _structure(name: str, *fields: tuple[str, Any]) -> type[ctypes.Structure]:
    return type(name, (ctypes.Structure,), {"_fields_": list(fields)})


def _all(kind: Any, names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names.split()]


_INT, _FLOAT, _POINTER = ctypes.c_int32, ctypes.c_float, ctypes.c_void_p
_Bath = _structure(
    "_Bath",
    *_all(_INT, "n_atoms n_bonds"),
    *_all(_POINTER, "atoms bonds lengths"),
    *_all(_FLOAT, "timestep keep noise tolerance"),
)
_RigidWaters = _structure(
    "_RigidWaters", ("n", _INT), ("masses", _FLOAT * 3), ("legs", _FLOAT * 2), ("inverse", _FLOAT * 9)
)
_Molecule = _structure(
    "_Molecule",
    *_all(_INT, "n_atoms n_bonds n_angles n_torsions n_biased born"),
    *_all(_POINTER, "bonds bond_terms angles angle_terms torsions torsion_terms biases pairs radii"),
    ("surface", _FLOAT),
    ("work", _POINTER),
)
_Water = _structure(
    "_Water",
    *_all(_INT, "n_solute n_waters n_excluded n_pairs"),
    ("cell", _FLOAT * 6),
    ("inverse", _FLOAT * 3),
    *_all(_FLOAT, "cutoff2 list2"),
    ("force", _POINTER),
    ("piece", _FLOAT),
    ("energy", _FLOAT * (ENERGY_DEGREE + 1)),
    ("own", _FLOAT * 4),
    ("lennard_jones", _FLOAT * 2),
    ("inside", _FLOAT * 2),
    *_all(_POINTER, "solute pairs pair_terms excluded excluded_terms"),
    *_all(_INT, "n_units ewald"),
    *_all(_POINTER, "middles partners begins sites near"),
    ("n_near", _INT),
    *_all(_POINTER, "names images"),
)
_Transform = _structure("_Transform", ("n", _INT), ("n_factors", _INT), ("factors", _INT * 8), ("turns", _FLOAT * 256))
_Mesh = _structure(
    "_Mesh",
    *_all(_INT, "n_atoms nx ny nz"),
    *_all(_POINTER, "order charges influence"),
    ("to_cell", _FLOAT * 9),
    ("along", _Transform * 3),
    *_all(_POINTER, "own modes fractions felt cells"),
)
_System = _structure(
    "_System",
    *[("bath", _Bath), ("rigid", _RigidWaters), ("molecule", _Molecule), ("water", _Water), ("mesh", _Mesh)],
    *_all(_INT, "periodic listed_steps"),
    ("constant", ctypes.c_double),
)


@lru_cache(maxsize=1)
def _program(width: int | None = None) -> ctypes.CDLL:
    """Return `force_field.cpp` compiled for this processor, for batches of 16, 8 or 4, or what its registers hold."""
    try:
        program = compiled_program(_SOURCE, {} if width is None else {"W": width})
    except CompilerError as error:
        raise SimdUnavailableError(f"{error}, which platform simd needs; use another platform.") from error
    program.work_floats.restype, program.work_floats.argtypes = ctypes.c_int64, [ctypes.c_int64]
    program.size_of_system.restype = ctypes.c_int64
    program.forces.restype, program.forces.argtypes = None, [_POINTER] * 4
    program.constrain_velocities.restype, program.constrain_velocities.argtypes = _INT, [_POINTER] * 3
    program.step.restype, program.step.argtypes = ctypes.c_int64, [*[_POINTER] * 6, ctypes.c_int64]
    if program.size_of_system() != ctypes.sizeof(_System):
        raise SimdUnavailableError("force_field.cpp and force_field.py differ in their structures; report this.")
    return program


def n_replicas() -> int:
    """How many replicas a batch has: 16, 8 or 4, what a register of this processor holds. Raises
    SimdUnavailableError."""
    return int(_program().replicas())


def aligned(shape: Sequence[int], kind: Any = np.float32) -> npt.NDArray[Any]:
    """Return zeros that begin at a multiple of 64 bytes, as registers are loaded fastest."""
    kind = np.dtype(kind)
    n_bytes = int(np.prod(shape)) * kind.itemsize
    room = np.zeros(n_bytes + 64, np.uint8)
    begin = -room.ctypes.data % 64
    return room[begin : begin + n_bytes].view(kind).reshape(shape)


class SimdReplicas:
    """`n_replicas()` copies of one scene under Langevin dynamics.

    `system`: an `openmm.System` of harmonic bonds and angles, periodic torsions and a NonbondedForce; without a cell
    NoCutoff and, if any, GBSAOBCForce; with one PME or a reaction field, and rigid three-site waters. Anything else
    raises SimdUnavailableError. Friction 0 is NVE (leapfrog). Positions and velocities are `(n_replicas, n_atoms, 3)`
    in nm and nm/ps, in the System's order. `biased`: torsions, each four atoms, for `set_bias`.
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
        self.n_replicas = n_replicas()
        self.n_atoms = system.getNumParticles()
        self.temperature_k, self.timestep_ps = temperature_k, timestep_ps
        terms = read_terms(system, biased, self.n_replicas)
        # The program's order of atoms is the solute, then waters as O, H, H.
        self.order = terms.order
        self.masses_da = np.array([system.getParticleMass(k)._value for k in range(self.n_atoms)])
        self.is_water = np.zeros(self.n_atoms, dtype=bool)
        self.is_water[self.order[terms.n_solute :]] = True
        self.cell_nm = terms.cell_nm
        keep = math.exp(-friction_per_ps * timestep_ps)
        masses = self.masses_da[self.order]
        speeds = np.sqrt(GAS_CONSTANT_KJ_MOL_K * temperature_k / masses)
        self._kept: list[Any] = []
        self._system = _System()
        self._fill(
            self._system.bath, n_atoms=terms.n_solute, n_bonds=len(terms.rigid), bonds=terms.rigid,
            atoms=np.stack([1.0 / masses, speeds], axis=1), lengths=terms.lengths,
            timestep=timestep_ps, keep=keep, noise=math.sqrt(1.0 - keep * keep), tolerance=_TOLERANCE,
        )  # fmt: skip
        self._fill(self._system.rigid, n=terms.n_waters, **terms.rigid_water)
        self._biases = aligned((len(biased), 2, self.n_replicas))
        self._fill(
            self._system.molecule,
            n_atoms=terms.n_solute,
            biases=self._biases,
            work=aligned((int(self._program.work_floats(terms.n_solute if terms.molecule["born"] else 0)) + 16,)),
            **terms.molecule,
        )
        if terms.cell_nm is not None:
            self._fill_water(terms)
        self._system.constant = terms.constant_kj_mol
        self.n_dof = 3 * self.n_atoms - len(terms.rigid) - 3 * terms.n_waters
        self.n_solute_dof = 3 * terms.n_solute - len(terms.rigid)
        self._rng = np.random.default_rng(seed)
        self._random = aligned((4, self.n_replicas), np.uint32)
        self._random[...] = self._rng.integers(1, 2**32, size=(4, self.n_replicas), dtype=np.uint32)
        shape = (self.n_atoms, 3, self.n_replicas)
        self._positions, self._low, self._velocities = aligned(shape), aligned(shape), aligned(shape)
        self._room = aligned((2, *shape))

    def _fill(self, target: Any, **values: Any) -> None:
        """Set fields; arrays, which the program reads in place, are kept alive."""
        kinds = dict(target._fields_)
        for name, value in values.items():
            if kinds[name] is _POINTER:
                kind = np.int32 if np.issubdtype(value.dtype, np.integer) else np.float32
                array = np.ascontiguousarray(value, kind)
                self._kept.append(array)
                setattr(target, name, array.ctypes.data)
            elif issubclass(kinds[name], ctypes.Array):
                setattr(target, name, kinds[name](*np.ravel(value).tolist()))
            else:
                setattr(target, name, value)

    @staticmethod
    def _table(values: FloatArray) -> npt.NDArray[np.float32]:
        table = aligned(values.shape)
        table[...] = values
        return table

    def _fill_water(self, terms: Terms) -> None:
        water, w, n = self._system.water, self.n_replicas, terms.n_waters
        self._names = aligned((n, w), np.int32)
        self._names[...] = np.arange(n)[:, None]
        self._images = aligned((len(terms.units), 3, w), np.int32)
        self._units_of_cell = terms.units
        self._sites = aligned((n, 3))
        self._origin = np.zeros((w, 3))
        self._fill(
            water,
            n_solute=terms.n_solute,
            n_waters=n,
            list2=(terms.middles_nm + _LIST_MARGIN_NM) ** 2,
            middles=aligned((n, 3, w)),
            partners=np.zeros(n * (n - 1) // 2 + 1, np.int32),
            begins=np.zeros(n + 1, np.int32),
            n_units=len(terms.units),
            sites=self._sites,
            near=np.zeros((0, 2), np.int32),
            names=self._names,
            images=self._images,
            **terms.water | {"force": self._table(terms.water["force"])},
        )
        self._system.periodic, self._system.listed_steps = 1, _LIST_STEPS
        if not terms.mesh:
            return
        mesh, (nx, ny, nz) = self._system.mesh, terms.grid
        many = -(-self.n_atoms // w) * w
        self._fill(mesh, n_atoms=self.n_atoms, nx=nx, ny=ny, nz=nz)
        self._fill(
            mesh,
            own=aligned((w * nx * ny * (nz + 8) + 64,)),
            modes=aligned((nx * ny * (nz // 2 + 1) * 2 * w,)),
            fractions=aligned((w, 3, many)),
            felt=aligned((w, 3, many)),
            cells=aligned((w, 3, many), np.int32),
            **terms.mesh,
        )
        for along, size in zip(mesh.along, terms.grid, strict=True):
            factors = factorised(size)
            turns = np.exp(-2j * np.pi * np.arange(size) / size)
            along.n, along.n_factors = size, len(factors)
            along.factors[: len(factors)] = factors
            along.turns[: 2 * size] = np.stack([turns.real, turns.imag], axis=1).ravel().tolist()

    def check(self, system: Any, positions_nm: npt.ArrayLike) -> None:
        """Compare energies and forces with OpenMM's at slightly disturbed copies of one structure `(n_atoms, 3)` nm.
        Raises SimulationError where they differ by more than single precision, or in water reciprocal grids of other
        points, explain."""
        import openmm

        given = np.asarray(positions_nm, dtype=np.float64)
        if self.cell_nm is None:
            given = self._centred(given)
        disturbed = given + self._rng.normal(0.0, _CHECKED_AT, (self.n_replicas, *given.shape))
        energies, forces = self.energies_and_forces(disturbed)
        is_wet = self.cell_nm is not None
        # In slanted cells OpenMM 8.6's Reference platform leaves out pairs.
        platform = openmm.Platform.getPlatform("CPU" if is_wet else "Reference")
        context = openmm.Context(system, openmm.VerletIntegrator(0.001), platform)
        for k, frame in enumerate(disturbed.astype(np.float32)[: 1 if is_wet else None]):
            context.setPositions(frame)
            state = context.getState(energy=True, forces=True)
            exact = state.getForces(asNumpy=True)._value
            size = math.sqrt(float(np.mean(exact**2)))
            off = float(np.abs(forces[k] - exact).max()) / size
            wrong = abs(float(energies[k]) - state.getPotentialEnergy()._value)
            most = _WET_ENERGY_TOLERANCE_KJ_MOL * self.n_atoms if is_wet else _ENERGY_TOLERANCE_KJ_MOL
            if not (off < (_WET_FORCE_TOLERANCE if is_wet else _FORCE_TOLERANCE) and wrong < most):
                raise SimulationError(
                    f"platform simd differs from OpenMM by {off:.2g} of the root mean square force and {wrong:.2g} "
                    "kJ/mol; use another platform."
                )

    def energies_and_forces(self, positions_nm: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return energies `(n_replicas,)` kJ/mol and forces `(n_replicas, n_atoms, 3)` kJ/mol/nm at given positions."""
        positions = self._inwards(positions_nm)
        energies, forces = self._evaluate(positions)
        found = np.empty_like(forces)
        found[:, self.order] = forces
        return energies, found

    def _evaluate(self, positions: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Return energies, and forces in the program's order."""
        forces, energies = aligned(positions.shape), np.zeros(self.n_replicas)
        self._program.forces(
            ctypes.byref(self._system), positions.ctypes.data, forces.ctypes.data, energies.ctypes.data
        )
        return energies, _outwards(forces)

    def set_positions(self, positions_nm: npt.ArrayLike) -> None:
        """Place the atoms `(n_replicas, n_atoms, 3)` nm: without a cell, each copy's centre of mass at the origin."""
        given = np.asarray(positions_nm, dtype=np.float64)[:, self.order]
        if self.cell_nm is not None:
            self._origin = np.zeros((self.n_replicas, 3))
            self._names[...] = np.arange(len(self._names))[:, None]
            self._images[...] = 0
        self._place(given)
        if self.cell_nm is not None:  # the places of waters are those of the first replica
            n = len(self._sites)
            hydrogens = self._positions[self.n_atoms - 3 * n :, :, 0].reshape(n, 3, 3)[:, 1:]
            self._sites[...] = hydrogens.mean(axis=1)
            self._list_neighbours()

    def _list_neighbours(self) -> None:
        assert self.cell_nm is not None
        apart = (self._sites[:, None] - self._sites).astype(np.float64) @ np.linalg.inv(self.cell_nm)
        apart = (apart - np.round(apart)) @ self.cell_nm
        near = np.argwhere(np.triu(np.linalg.norm(apart, axis=-1) < _TRADED_NM, 1))
        self._fill(self._system.water, near=near, n_near=len(near))

    def _place(self, positions: FloatArray) -> None:
        """Place the atoms, in the program's order, near the origin: far from it single precision is coarse."""
        if self.cell_nm is None:
            given = self._centred(positions, self.masses_da[self.order])
        else:
            first = self._units_of_cell[0, 0] if len(self._units_of_cell) else self.n_atoms
            middle = positions[:, : max(int(first), 1)].mean(axis=1)
            self._origin += middle
            given = positions - middle[:, None]
            self._wrap(given)
        self._positions[...] = np.moveaxis(given, 0, -1)
        self._low[...] = np.moveaxis(given, 0, -1) - self._positions.astype(np.float64)

    def _wrap(self, positions: FloatArray) -> None:
        """Bring molecules into the cell around the origin, in place, and count by how many cells they were moved."""
        assert self.cell_nm is not None
        starts = self._units_of_cell[:, 0]
        cells = np.round(positions[:, starts] @ np.linalg.inv(self.cell_nm))
        by_atom = np.repeat(cells, self._units_of_cell[:, 1], axis=1)
        positions[:, starts[0] :] -= by_atom @ self.cell_nm
        self._images += np.moveaxis(cells, 0, -1).astype(np.int32)

    def set_velocities(self, velocities_nm_ps: npt.ArrayLike) -> None:
        """Set velocities `(n_replicas, n_atoms, 3)` nm/ps."""
        self._velocities[...] = self._inwards(velocities_nm_ps)

    def set_bias(self, place: int, centres_rad: npt.ArrayLike, stiffness_kj_mol: float) -> None:
        """Add -stiffness cos(angle - centre) of the biased torsion at this place to the energy of each copy;
        `centres_rad` (n_replicas,)."""
        centres = np.asarray(centres_rad, dtype=np.float64)
        self._biases[place] = -stiffness_kj_mol * np.stack([np.cos(centres), np.sin(centres)])

    def thermalise(self) -> None:
        """Draw velocities from the Maxwell-Boltzmann distribution; the first step removes those along rigid bonds."""
        speed = np.sqrt(GAS_CONSTANT_KJ_MOL_K * self.temperature_k / self.masses_da)[:, None]
        self.set_velocities(self._rng.normal(size=(self.n_replicas, self.n_atoms, 3)) * speed)

    def step(self, n_steps: int) -> None:
        """Integrate. Raises SimulationError when a constraint cannot be met, or a copy is hotter than chance allows."""
        for done in range(0, n_steps, CENTRED_STEPS):
            arrays = (self._positions, self._low, self._velocities, self._random, self._room)
            at = [array.ctypes.data for array in arrays]
            met = self._program.step(ctypes.byref(self._system), *at, min(CENTRED_STEPS, n_steps - done))
            if met:
                raise SimulationError("a copy of the molecule blew up: its constraints cannot be met")
            self._place(_outwards(self._positions) + _outwards(self._low))
        hottest = hottest_k(self.temperature_k, self.n_dof)
        if not (np.isfinite(self._positions).all() and self.temperatures_k().max() < hottest):
            raise SimulationError("a copy of the molecule blew up: it is hotter than the bath can make it")

    @property
    def _state(self) -> list[npt.NDArray[Any]]:
        arrays = [self._positions, self._low, self._velocities, self._random]
        return arrays if self.cell_nm is None else [*arrays, self._names, self._images, self._origin, self._sites]

    def checkpoint(self) -> bytes:
        """Return positions, velocities and random states: `restore` goes on as if nothing had been."""
        return b"".join(array.tobytes() for array in self._state)

    def restore(self, blob: bytes) -> None:
        """Go back to a checkpoint. Raises InputError when it is of another molecule or another processor."""
        if len(blob) != sum(array.nbytes for array in self._state):
            raise InputError("the checkpoint of these replicas is of another molecule or processor.")
        at = 0
        for array in self._state:
            array[...] = np.frombuffer(blob, array.dtype, array.size, at).reshape(array.shape)
            at += array.nbytes
        if self.cell_nm is not None:
            self._list_neighbours()

    def _centred(self, positions_nm: FloatArray, masses_da: FloatArray | None = None) -> FloatArray:
        masses_da = self.masses_da if masses_da is None else masses_da
        return positions_nm - np.average(positions_nm, axis=-2, weights=masses_da)[..., None, :]

    def _inwards(self, values: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Return what is `(n_replicas, n_atoms, 3)` as the program has it."""
        given = np.asarray(values)[:, self.order]
        array = aligned((*given.shape[1:], self.n_replicas))
        array[...] = np.moveaxis(given, 0, -1)
        return array

    @property
    def positions_nm(self) -> FloatArray:
        """Positions `(n_replicas, n_atoms, 3)` nm: molecules are whole, and never jump from one cell to another."""
        given = _outwards(self._positions) + _outwards(self._low)
        if self.cell_nm is not None:
            cells = np.repeat(np.moveaxis(self._images, -1, 0), self._units_of_cell[:, 1], axis=1)
            given[:, self._units_of_cell[0, 0] :] += cells @ self.cell_nm
            given += self._origin[:, None]
        return self._in_order(given)

    def _in_order(self, values: FloatArray) -> FloatArray:
        """Return the program's values of atoms in the System's order; waters that traded places under their names."""
        found = np.empty_like(values)
        if self.cell_nm is not None:
            n = self.n_atoms - 3 * len(self._names)
            for k, names in enumerate(self._names.T):
                waters = np.empty((len(names), 3, 3))
                waters[names] = values[k, n:].reshape(-1, 3, 3)
                values[k, n:] = waters.reshape(-1, 3)
        found[:, self.order] = values
        return found

    @property
    def velocities_nm_ps(self) -> FloatArray:
        return self._in_order(_outwards(self._velocities))

    def energies(self) -> FloatArray:
        """Return the potential energy of each copy `(n_replicas,)` kJ/mol."""
        return self._evaluate(self._positions)[0]

    def temperatures_k(self) -> FloatArray:
        """Return the kinetic temperature of each copy `(n_replicas,)` K, as `Engine.state` has it."""
        return self._kinetic(slice(None)) * 2.0 / (self.n_dof * GAS_CONSTANT_KJ_MOL_K)

    def temperatures_of_solute_and_water_k(self) -> tuple[FloatArray, FloatArray]:
        """Return the kinetic temperatures `(n_replicas,)` K of what is not water, and of water."""
        n, r = self.n_atoms - 3 * len(self._names), 0.5 * GAS_CONSTANT_KJ_MOL_K
        wet = self.n_dof - self.n_solute_dof
        return self._kinetic(slice(n)) / (r * self.n_solute_dof), self._kinetic(slice(n, None)) / (r * wet)

    def _kinetic(self, atoms: slice) -> FloatArray:
        velocities = aligned(self._velocities.shape)
        velocities[...] = self._velocities
        self._program.constrain_velocities(
            ctypes.byref(self._system), self._positions.ctypes.data, velocities.ctypes.data
        )
        masses = self.masses_da[self.order][atoms]
        return np.asarray(0.5 * np.einsum("a,adl->l", masses, velocities[atoms].astype(np.float64) ** 2))


def _outwards(values: npt.NDArray[np.float32]) -> FloatArray:
    return np.ascontiguousarray(np.moveaxis(values, -1, 0), dtype=np.float64)
