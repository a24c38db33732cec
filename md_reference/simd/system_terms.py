"""What an `openmm.System` says, as the arrays that `force_field.cpp` reads."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import erf

from systems.errors import SimulationError
from systems.scene import FloatArray, IntArray

COULOMB = 138.93545764438198
_BORN_OFFSET_NM = 0.009
_PERIODS = 6
# Of water.h's polynomials in r^2: degree of the force's, by the number of pieces, and of the energy's.
FORCE_DEGREES, ENERGY_DEGREE = {16: 3, 8: 4, 4: 6}, 14
_GRID_FACTORS = (4, 2, 3, 5, 7)
_MOST_POINTS = 128
# pme.h has 24 times the weights of a spline in each direction, which are whole numbers.
_SPLINE_UNIT = 24.0**3


class SimdUnavailableError(SimulationError):
    """This machine cannot compile the program, or it does not know a term of the System."""


@dataclass
class Terms:
    """The System in the program's order: `order` (n_atoms,) has the solute first, then waters as O, H, H. `rigid` (n,
    2) bonds outside water with their `lengths` (n,) nm; the other fields hold what the program's structures of these
    names do."""

    order: IntArray
    n_solute: int
    rigid: IntArray
    lengths: FloatArray
    molecule: dict[str, Any]
    n_waters: int = 0
    rigid_water: dict[str, Any] = field(default_factory=dict)
    cell_nm: FloatArray | None = None
    water: dict[str, Any] = field(default_factory=dict)
    mesh: dict[str, Any] = field(default_factory=dict)
    grid: tuple[int, int, int] = (0, 0, 0)
    units: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    middles_nm: float = 0.0
    constant_kj_mol: float = 0.0


def read_terms(system: Any, biased: Sequence[Sequence[int]], width: int) -> Terms:
    """Return the terms of a System; torsions of the atoms in `biased` come first, without a force. `width`: replicas of
    a register. Raises SimdUnavailableError for a term that the program does not know."""
    import openmm

    n = system.getNumParticles()
    if any(system.isVirtualSite(k) or system.getParticleMass(k)._value <= 0 for k in range(n)):
        raise _unknown("virtual sites or fixed atoms")
    constraints = [system.getConstraintParameters(k) for k in range(system.getNumConstraints())]
    nonbonded = [f for f in system.getForces() if isinstance(f, openmm.NonbondedForce)]
    is_periodic = any(f.usesPeriodicBoundaryConditions() for f in nonbonded)
    masses = np.array([system.getParticleMass(k)._value for k in range(n)])
    waters = _rigid_waters(constraints, masses) if is_periodic else np.zeros((0, 3), np.int64)
    order = np.concatenate([np.setdiff1d(np.arange(n), waters), waters.ravel()]).astype(np.int64)
    n_solute = n - waters.size
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    bonded = _bonded(system, place, n_solute)
    rigid = [(place[a], place[b], d._value) for a, b, d in constraints if min(place[a], place[b]) < n_solute]
    # Bonds between atoms whose distance is a constraint exert no force.
    fixed = {frozenset(row[:2]) for row in rigid}
    kept = [k for k, pair in enumerate(bonded["bonds"]) if frozenset(pair) not in fixed]
    none = np.zeros((len(biased), 1 + 2 * _PERIODS))
    molecule: dict[str, Any] = {
        "n_bonds": len(kept),
        "n_angles": len(bonded["angles"]),
        "n_torsions": len(biased) + len(bonded["torsions"]),
        "n_biased": len(biased),
        "born": 0,
        "bonds": _integers([bonded["bonds"][k] for k in kept], 2),
        "bond_terms": _numbers([bonded["bond_terms"][k] for k in kept], 2),
        "angles": _integers(bonded["angles"], 3),
        "angle_terms": _numbers(bonded["angle_terms"], 2),
        "torsions": np.concatenate([_integers([[place[a] for a in quad] for quad in biased], 4),
                                    _integers(list(bonded["torsions"]), 4)]),
        "torsion_terms": np.concatenate([none, _numbers(list(bonded["torsions"].values()), 1 + 2 * _PERIODS)]),
        "radii": np.zeros((n_solute, 4)),
        "surface": 0.0,
    }  # fmt: skip
    terms = Terms(
        order=order,
        n_solute=n_solute,
        rigid=_integers([row[:2] for row in rigid], 2),
        lengths=np.array([row[2] for row in rigid], dtype=np.float64),
        molecule=molecule,
    )
    molecule["pairs"] = np.zeros((0, 4))
    if not is_periodic:
        molecule["pairs"] = np.zeros((n * (n - 1) // 2, 4))
        for force in nonbonded:
            _all_pairs(force, molecule["pairs"])
        for force in system.getForces():
            if isinstance(force, openmm.GBSAOBCForce):
                _born(force, molecule)
    elif len(nonbonded) == 1:
        terms.n_waters = len(waters)
        _add_water(terms, nonbonded[0], system, constraints, masses, width)
    else:
        raise _unknown("more than one NonbondedForce")
    return terms


def _unknown(what: str) -> SimdUnavailableError:
    return SimdUnavailableError(f"platform simd does not support {what}; use another platform.")


def _integers(rows: Any, width: int) -> IntArray:
    return np.reshape(np.asarray(rows, dtype=np.int64), (-1, width))


def _numbers(rows: Any, width: int) -> FloatArray:
    return np.reshape(np.asarray(rows, dtype=np.float64), (-1, width))


def _rigid_waters(constraints: list[Any], masses: FloatArray) -> IntArray:
    """Return the triangles of constraints `(n, 3)`, the heaviest atom first. Raises SimdUnavailableError."""
    partners = defaultdict(set)
    for a, b, _ in constraints:
        partners[a].add(b)
        partners[b].add(a)
    found = {
        tuple(sorted((a, *partners[a])))
        for a in partners
        if len(partners[a]) == 2 and all(partners[b] == ({a} | partners[a]) - {b} for b in partners[a])
    }
    rows = np.array(sorted(found), dtype=np.int64).reshape(-1, 3)
    heaviest = masses[rows].argmax(axis=1) if len(rows) else np.zeros(0, np.int64)
    return np.array([np.roll(row, -k) for row, k in zip(rows, heaviest, strict=True)], np.int64).reshape(-1, 3)


def _bonded(system: Any, place: IntArray, n_solute: int) -> dict[str, Any]:
    """Return bonds, angles and torsions in the program's order. Raises SimdUnavailableError for another force."""
    import openmm

    found: dict[str, Any] = {"bonds": [], "bond_terms": [], "angles": [], "angle_terms": []}
    torsions: dict[tuple[int, ...], FloatArray] = defaultdict(lambda: np.zeros(1 + 2 * _PERIODS))
    for force in system.getForces():
        if isinstance(force, openmm.HarmonicBondForce):
            kinds, many, parameters = ("bonds", "bond_terms"), force.getNumBonds(), force.getBondParameters
        elif isinstance(force, openmm.HarmonicAngleForce):
            kinds, many, parameters = ("angles", "angle_terms"), force.getNumAngles(), force.getAngleParameters
        elif isinstance(force, openmm.PeriodicTorsionForce):
            for k in range(force.getNumTorsions()):
                *quad, period, phase, stiff = force.getTorsionParameters(k)
                if period > _PERIODS:
                    raise _unknown(f"torsions of period {period}")
                quad = [int(place[a]) for a in quad]
                row = torsions[min(tuple(quad), tuple(quad[::-1]))]
                row[0] += stiff._value
                row[2 * period - 1] += stiff._value * math.cos(phase._value)
                row[2 * period] += stiff._value * math.sin(phase._value)
            continue
        elif isinstance(force, openmm.NonbondedForce | openmm.CMMotionRemover) or (
            isinstance(force, openmm.GBSAOBCForce) and force.getNonbondedMethod() == force.NoCutoff
        ):
            continue
        else:
            kind = type(force).__name__
            raise _unknown(kind + (" with a cutoff" if kind == "GBSAOBCForce" else ""))
        for k in range(many):
            *atoms, rest, stiff = parameters(k)
            atoms = [int(place[a]) for a in atoms]
            # Within a rigid water nothing changes.
            if min(atoms) < n_solute:
                found[kinds[0]].append(atoms)
                found[kinds[1]].append((rest._value, stiff._value))
    return found | {"torsions": torsions}


def _particles(force: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    if force.getNumParticleParameterOffsets() or force.getNumExceptionParameterOffsets():
        raise _unknown("NonbondedForce with parameter offsets")
    rows = [[v._value for v in force.getParticleParameters(k)] for k in range(force.getNumParticles())]
    charge, sigma, epsilon = np.array(rows).T
    return charge, sigma, epsilon


def _lennard_jones(sigma: Any, epsilon: Any) -> tuple[Any, Any]:
    """Return C12 and C6 in kJ/mol nm^12 and nm^6."""
    return 4.0 * epsilon * sigma**12, 4.0 * epsilon * sigma**6


def _all_pairs(force: Any, pairs: FloatArray) -> None:
    """Write Coulomb, C12 and C6 of every pair, combined as Lorentz and Berthelot say but for the exceptions."""
    if force.getNonbondedMethod() != force.NoCutoff:
        raise _unknown("NonbondedForce with a cutoff but without a cell")
    charge, sigma, epsilon = _particles(force)
    n = len(charge)
    i, j = np.triu_indices(n, 1)
    product, size, depth = charge[i] * charge[j], 0.5 * (sigma[i] + sigma[j]), np.sqrt(epsilon[i] * epsilon[j])
    place = {pair: k for k, pair in enumerate(itertools.combinations(range(n), 2))}
    for k in range(force.getNumExceptions()):
        a, b, q, s, e = force.getExceptionParameters(k)
        at = place[min(a, b), max(a, b)]
        product[at], size[at], depth[at] = q._value, s._value, e._value
    pairs[:, 0] = COULOMB * product
    pairs[:, 1], pairs[:, 2] = _lennard_jones(size, depth)


def _born(force: Any, molecule: dict[str, Any]) -> None:
    rows = [[getattr(v, "_value", v) for v in force.getParticleParameters(k)] for k in range(force.getNumParticles())]
    charge, radius, scale = np.array(rows).T
    factor = -COULOMB * (1.0 / force.getSoluteDielectric() - 1.0 / force.getSolventDielectric())
    i, j = np.triu_indices(len(rows), 1)
    offset = radius - _BORN_OFFSET_NM
    molecule["born"], molecule["surface"] = 1, 4.0 * math.pi * force.getSurfaceAreaEnergy()._value
    molecule["pairs"][:, 3] = factor * charge[i] * charge[j]
    molecule["radii"] = np.stack([radius, offset, scale * offset, factor * charge**2], axis=1)


def _add_water(terms: Terms, force: Any, system: Any, constraints: list[Any], masses: FloatArray, width: int) -> None:
    """Write everything that a cell with water needs. Raises SimdUnavailableError."""
    charge, sigma, epsilon = (values[terms.order] for values in _particles(force))
    n_solute, n_waters = terms.n_solute, terms.n_waters
    wet = slice(n_solute, None)
    if not n_waters:
        raise _unknown("a periodic cell without rigid three-site water")
    for values in (charge, sigma * (epsilon > 0), epsilon, masses[terms.order]):
        rows = values[wet].reshape(-1, 3)
        if np.ptp(rows, axis=0).max() > 1e-9 or abs(rows[0, 1] - rows[0, 2]) > 1e-9:
            raise _unknown("water of more than one kind")
    if epsilon[n_solute + 1] > 0:
        raise _unknown("water whose hydrogens have Lennard-Jones terms")
    if force.getUseSwitchingFunction():
        raise _unknown("a switching function")
    terms.cell_nm = np.array([list(v._value) for v in system.getDefaultPeriodicBoxVectors()], dtype=np.float64)
    cutoff = force.getCutoffDistance()._value
    place = np.empty(len(charge), np.int64)
    place[terms.order] = np.arange(len(charge))
    legs = _legs(constraints, place, n_solute)
    _rigid_triangle(terms, masses[terms.order][n_solute : n_solute + 2], legs)
    # Middles lie between the hydrogens; the oxygen is no farther than a hydrogen from there.
    height = math.sqrt(legs[0] ** 2 - legs[1] ** 2 / 4)
    terms.middles_nm = cutoff + 2 * max(height, legs[1] / 2)
    if np.diag(terms.cell_nm).min() < 2 * terms.middles_nm:
        raise SimdUnavailableError(
            f"platform simd needs a cell of at least {2 * terms.middles_nm:.3f} nm, twice the cutoff and a water; this "
            f"one is {np.diag(terms.cell_nm).min():.3f} nm wide: use a larger `padding_nm` or another platform."
        )
    cell = terms.cell_nm
    ewald = force.getNonbondedMethod() == force.PME
    if not ewald and force.getNonbondedMethod() != force.CutoffPeriodic:
        raise _unknown("Ewald sums other than PME")
    alpha, grid = _pme(force, cell) if ewald else (0.0, (0, 0, 0))
    own = COULOMB * np.outer(charge[n_solute : n_solute + 2], charge[n_solute : n_solute + 2])
    oxygen = n_solute
    with_oxygen = np.sqrt(epsilon[:n_solute] * epsilon[oxygen]), 0.5 * (sigma[:n_solute] + sigma[oxygen])
    to_oxygen = _lennard_jones(with_oxygen[1], with_oxygen[0])
    spread = (math.sqrt(COULOMB) * charge / _SPLINE_UNIT).astype(np.float32)
    # What reciprocal space counts too much, ten times the energy of the cell, is of the charges as rounded.
    rounded = _SPLINE_UNIT / math.sqrt(COULOMB) * spread.astype(np.float64)
    inside = _within_solute(force, place, charge, sigma, epsilon, n_solute, rounded)
    force_terms, energy_terms = polynomials(cutoff, alpha, force.getReactionFieldDielectric(), width)
    terms.units = _units(terms)
    terms.water = {
        "n_excluded": len(inside["excluded"]),
        "n_pairs": len(inside["pairs"]),
        "cell": [cell[0, 0], cell[1, 0], cell[1, 1], *cell[2]],
        "inverse": 1.0 / np.diag(cell),
        "cutoff2": cutoff**2,
        "force": force_terms,
        "piece": (width - 1) / cutoff**2,
        "energy": energy_terms,
        "own": [own[0, 0] / 8, own[0, 1] / 8, own[1, 1] / 8, 0.0],
        "lennard_jones": _lennard_jones(sigma[oxygen], epsilon[oxygen]),
        "inside": COULOMB * rounded[n_solute + 1] * rounded[n_solute : n_solute + 2],
        "solute": np.stack(
            [COULOMB * charge[:n_solute] * charge[oxygen] / 8, COULOMB * charge[:n_solute] * charge[oxygen + 1] / 8,
             *to_oxygen], axis=1),
        "ewald": int(ewald),
        **inside,
    }  # fmt: skip
    volume = float(np.linalg.det(cell))
    if force.getUseDispersionCorrection():
        terms.constant_kj_mol += _dispersion(sigma, epsilon, cutoff) / volume
    if ewald:
        terms.constant_kj_mol -= alpha / math.sqrt(math.pi) * COULOMB * float((rounded**2).sum())
        terms.grid = grid
        waters = n_solute + 3 * np.arange(n_waters)
        terms.mesh = {
            # Oxygens, then hydrogens: atoms of one water share rows of the grid.
            "order": np.concatenate([np.arange(n_solute), waters, waters + 1, waters + 2]),
            "charges": spread,
            "influence": influence(cell, alpha, grid),
            "to_cell": np.linalg.inv(cell),
        }


def _legs(constraints: list[Any], place: IntArray, n_solute: int) -> tuple[float, float]:
    """Return O-H and H-H of the waters. Raises SimdUnavailableError where they differ."""
    lengths: dict[bool, set[float]] = {True: set(), False: set()}
    for a, b, d in constraints:
        i, j = place[a] - n_solute, place[b] - n_solute
        if min(i, j) >= 0:
            lengths[bool(i % 3 and j % 3)].add(round(d._value, 9))
    if any(len(found) != 1 for found in lengths.values()):
        raise _unknown("water of more than one shape")
    return lengths[False].pop(), lengths[True].pop()


def _rigid_triangle(terms: Terms, masses: FloatArray, legs: tuple[float, float]) -> None:
    oxygen, hydrogen = masses
    oh, hh = legs
    p = np.array([hh / 2, math.sqrt(oh**2 - hh**2 / 4)])
    q = p * [-1, 1]
    s = q - p
    mo, mh = 1 / oxygen, 1 / hydrogen
    matrix = np.array([
        [(mo + mh) * (p @ p), mo * (p @ q), -mh * (p @ s)],
        [mo * (p @ q), (mo + mh) * (q @ q), mh * (q @ s)],
        [-mh * (p @ s), mh * (q @ s), 2 * mh * (s @ s)],
    ])  # fmt: skip
    terms.rigid_water = {
        "masses": [oxygen, hydrogen, 1 / (oxygen + 2 * hydrogen)],
        "legs": legs,
        "inverse": np.linalg.inv(matrix),
    }


def _pme(force: Any, cell: FloatArray) -> tuple[float, tuple[int, int, int]]:
    """Return Ewald's alpha in 1/nm and the points of the grid, as OpenMM chooses them but of small factors."""
    alpha, *points = force.getPMEParameters()
    alpha = getattr(alpha, "_value", alpha)
    if alpha == 0:
        tolerance = force.getEwaldErrorTolerance()
        alpha = math.sqrt(-math.log(2 * tolerance)) / force.getCutoffDistance()._value
        points = [max(6, math.ceil(2 * alpha * edge / (3 * tolerance**0.2))) for edge in np.diag(cell)]
    found = []
    for n in points:
        n = next(m for m in range(int(n), 2 * _MOST_POINTS) if math.prod(factorised(m)) == m)
        if n > _MOST_POINTS:
            raise _unknown(f"a PME grid of {n} points")
        found.append(n)
    return float(alpha), (found[0], found[1], found[2])


def factorised(n: int) -> list[int]:
    """Return the factors 4, 2, 3, 5 and 7 of a number; their product is less where it has others."""
    factors = []
    for factor in _GRID_FACTORS:
        while n % factor == 0:
            factors.append(factor)
            n //= factor
    return factors


def influence(cell: FloatArray, alpha: float, grid: tuple[int, int, int]) -> FloatArray:
    """Return `(nx, ny, nz // 2 + 1)`: exp(-pi^2 m^2 / alpha^2) / (pi V m^2 |b|^2) of modes (Essmann et al. 1995)."""
    inverse = np.linalg.inv(cell)
    modes = [*(np.fft.fftfreq(n, 1 / n) for n in grid[:2]), np.fft.rfftfreq(grid[2], 1 / grid[2])]
    m = np.stack(np.meshgrid(*modes, indexing="ij"), axis=-1)
    square = ((m @ inverse.T) ** 2).sum(axis=-1)
    splines = np.array([1.0, 11.0, 11.0, 1.0]) / 24.0
    moduli = []
    for n in grid:
        size = np.abs(np.exp(2j * np.pi * np.outer(np.arange(n), np.arange(4)) / n) @ splines) ** 2
        for k in np.flatnonzero(size < 1e-7):
            size[k] = 0.5 * (size[k - 1] + size[(k + 1) % n])
        moduli.append(size)
    moduli[2] = moduli[2][: grid[2] // 2 + 1]
    b = moduli[0][:, None, None] * moduli[1][None, :, None] * moduli[2]
    square[0, 0, 0] = np.inf
    return np.exp(-np.where(np.isinf(square), 0, square) * (math.pi / alpha) ** 2) / (
        math.pi * np.linalg.det(cell) * square * b
    )


def polynomials(cutoff: float, alpha: float, dielectric: float, width: int) -> tuple[FloatArray, FloatArray]:
    """Return what water.h's `force` and `energy` hold: of Ewald's complementary part, or of a reaction field (alpha 0).
    Unit charges have the force (1/r^3 - p(r^2)) r, p in `width` pieces, and the energy 1/r + e(2 r^2/cutoff^2 - 1)."""
    square, degree = cutoff**2, FORCE_DEGREES[width]
    p, e = np.zeros((degree + 1, width)), np.zeros(ENERGY_DEGREE + 1)
    if alpha == 0:
        krf = (dielectric - 1) / (2 * dielectric + 1) / cutoff**3
        crf = 3 * dielectric / (2 * dielectric + 1) / cutoff
        p[0], e[0], e[1] = 2 * krf, krf * square / 2 - crf, krf * square / 2
        return -8 * p, e
    half = 0.5 * square / (width - 1)
    for k in range(width):
        low, high = max(0.0, (2 * k - 1) * half), (2 * k + 1) * half
        nodes = _nodes(low, high)
        fitted = Chebyshev.fit(nodes, _screened_force(alpha, nodes), degree, domain=[low, high])
        p[:, k] = fitted.convert(kind=Polynomial).coef
    nodes = _nodes(0.0, square)
    fitted = Chebyshev.fit(nodes, -erf(alpha * np.sqrt(nodes)) / np.sqrt(nodes), ENERGY_DEGREE, domain=[0, square])
    return -8 * p, np.asarray(fitted.convert(kind=Polynomial, domain=[0, square], window=[-1, 1]).coef, np.float64)


def _nodes(low: float, high: float) -> FloatArray:
    return low + 0.5 * (high - low) * (1 - np.cos(math.pi * (np.arange(400) + 0.5) / 400))


def _screened_force(alpha: float, square: FloatArray) -> FloatArray:
    """Return (erf(a r)/r - 2 a exp(-a^2 r^2)/sqrt(pi)) / r^2; near the origin, where it cancels, by its series."""
    r = np.sqrt(square)
    near = alpha**2 * square < 0.05
    series = sum((-1) ** k * (alpha * r) ** (2 * k) / (math.factorial(k) * (2 * k + 3)) for k in range(8))
    exact = (erf(alpha * r) / r - 2 * alpha / math.sqrt(math.pi) * np.exp(-((alpha * r) ** 2))) / square
    return np.asarray(np.where(near, 4 * alpha**3 / math.sqrt(math.pi) * series, exact))


def _within_solute(
    force: Any,
    place: IntArray,
    charge: FloatArray,
    sigma: FloatArray,
    epsilon: FloatArray,
    n_solute: int,
    rounded: FloatArray,
) -> dict[str, Any]:
    """Return pairs of solute atoms and, apart, those that are exceptions."""
    apart, terms = [], []
    for k in range(force.getNumExceptions()):
        a, b, q, s, e = force.getExceptionParameters(k)
        i, j = sorted((int(place[a]), int(place[b])))
        if j >= n_solute:
            if i < n_solute or (i - n_solute) // 3 != (j - n_solute) // 3:
                raise _unknown("exceptions between molecules of water")
            continue
        apart.append((i, j))
        terms.append((COULOMB * q._value, *_lennard_jones(s._value, e._value), COULOMB * rounded[i] * rounded[j]))
    excluded = set(apart)
    i, j = _integers([p for p in itertools.combinations(range(n_solute), 2) if p not in excluded], 2).T
    c12, c6 = _lennard_jones(0.5 * (sigma[i] + sigma[j]), np.sqrt(epsilon[i] * epsilon[j]))
    return {
        "pairs": np.stack([i, j], axis=1),
        "pair_terms": np.stack([COULOMB * charge[i] * charge[j] / 8, c12, c6], axis=1),
        "excluded": _integers(apart, 2),
        "excluded_terms": _numbers(terms, 4),
    }


def _units(terms: Terms) -> IntArray:
    """Return first atom and number of atoms of each molecule but the first, which stays at the origin."""
    n = terms.n_solute
    links = np.concatenate([terms.molecule["bonds"], terms.rigid])
    graph = coo_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    _, label = connected_components(graph, directed=False)
    rows = []
    for k in range(1, label.max() + 1 if n else 0):
        atoms = np.flatnonzero(label == k)
        if np.ptp(atoms) != len(atoms) - 1:
            raise _unknown("molecules whose atoms are not contiguous")
        rows.append((atoms[0], len(atoms)))
    rows += [(n + 3 * k, 3) for k in range(terms.n_waters)]
    return _integers(rows, 2)


def _dispersion(sigma: FloatArray, epsilon: FloatArray, cutoff: float) -> float:
    """Return OpenMM's long-range correction times the volume: Lennard-Jones of average pairs beyond the cutoff."""
    kinds, counts = np.unique(np.stack([sigma, epsilon], axis=1), axis=0, return_counts=True)
    n = len(sigma)
    size = 0.5 * (kinds[:, None, 0] + kinds[None, :, 0])
    depth = np.sqrt(kinds[:, None, 1] * kinds[None, :, 1])
    # Every pair once, and every particle with itself.
    many = 0.5 * np.outer(counts, counts) + np.diag(0.5 * counts)
    pairs = n * (n + 1) / 2
    twelve, six = (float((many * depth * size**power).sum()) / pairs for power in (12, 6))
    return 8 * n**2 * math.pi * (twelve / (9 * cutoff**9) - six / (3 * cutoff**3))
