"""Diverse starting structures of a peptide: metadynamics on phi and psi of each residue, then a stratified choice.

Well-tempered metadynamics (Barducci, Bussi and Parrinello, Phys. Rev. Lett. 100, 020603 (2008)) by OpenMM's own class,
one bias in two dimensions for each residue, at 500 K so that side chains turn as well; of two residues with free
termini the first has no phi and the second no psi, and the bias is on the two that there are. Seeds carry no weights: a
propagator is conditional, so its forward windows need none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import platform_properties
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions, bonded_graph, rotatable_torsions, turned
from systems.errors import InputError
from systems.scene import Scene

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Quad = tuple[int, int, int, int]

_HOT_K = 500.0
_WIDTH_RAD = 0.30
_HEIGHT_KJ_MOL = 2.4
_BIAS_FACTOR = 8.0
_DEPOSIT_STEPS = 250
_TIMESTEP_PS = 0.004
_SAVE_STEPS = 250
_CELL_RAD = math.pi / 3
# Of the starts: with some phi above 0, and near barriers of some residue's map (the rarest of what is visited).
_POSITIVE_SHARE = 1 / 3
_BARRIER_SHARE = 1 / 4
_BARRIER_QUANTILE = 0.8
_CIS_SHARE = 1 / 6


@dataclass(frozen=True)
class ResidueTorsions:
    """Torsions of one residue by atom indices, None where the chain or the side chain has none."""

    name: str
    phi: Quad | None
    psi: Quad | None
    omega: Quad | None
    chi1: Quad | None


@dataclass(frozen=True)
class Seeds:
    """Starting structures `(n, n_atoms, 3)` nm, and of each the group it was chosen for."""

    positions_nm: FloatArray
    groups: tuple[str, ...]


def residue_torsions(scene: Scene) -> list[ResidueTorsions]:
    """Return phi, psi, the omega before it and chi1 of every amino acid of a scene, in order."""

    def by_residue(quads: npt.NDArray[Any], place: int) -> dict[int, Quad]:
        return {int(scene.residue_of_atom[q[place]]): (int(q[0]), int(q[1]), int(q[2]), int(q[3])) for q in quads}

    backbone = backbone_torsions(scene)
    phi, psi = by_residue(backbone["phi"], 2), by_residue(backbone["psi"], 1)
    # Of the bond C-N it belongs to the residue of N.
    omega = by_residue(backbone["omega"], 2)
    names = scene.atom_names
    chi1 = {
        int(scene.residue_of_atom[q[1]]): (int(q[0]), int(q[1]), int(q[2]), int(q[3]))
        for q in _outwards(scene, rotatable_torsions(scene, rotors=False))
        if names[q[1]] == "CA" and names[q[2]] == "CB"
    }
    return [
        ResidueTorsions(scene.residue_names[k], phi.get(k), psi.get(k), omega.get(k), chi1.get(k))
        for k in sorted({*phi, *psi})
    ]


def biased_torsions(residues: list[ResidueTorsions]) -> list[tuple[Quad, Quad]]:
    """Return what has a bias, pairs of a phi and a psi: those of each residue with both, or, where none has, the psi of
    each residue and the phi that follows it. Raises InputError where there is no pair."""
    both = [(r.phi, r.psi) for r in residues if r.phi is not None and r.psi is not None]
    found = both or [
        (after.phi, r.psi) for r, after in pairwise(residues) if r.psi is not None and after.phi is not None
    ]
    if not found:
        raise InputError("metadynamics takes two residues, or one that is capped: there are no phi and psi to bias.")
    return found


def _outwards(scene: Scene, quads: npt.NDArray[Any]) -> list[tuple[int, ...]]:
    """Turn quads round whose bond is named CB-CA."""
    found = [tuple(int(a) for a in q) for q in quads]
    return [q[::-1] if scene.atom_names[q[1]] == "CB" and scene.atom_names[q[2]] == "CA" else q for q in found]


def metadynamics(
    scene: Scene,
    *,
    time_ps: float,
    temperature_k: float,
    bias_factor: float,
    seed: int,
    platform: str,
    spec: ForceFieldSpec | None = None,
) -> tuple[FloatArray, list[FloatArray]]:
    """Run well-tempered metadynamics on every pair of `biased_torsions`.

    Returns frames `(n, n_atoms, 3)` nm, one a ps, and for each pair its free energy in kJ/mol at this temperature on a
    grid `(n_psi, n_phi)` from -π, both ends included. In chains every residue's bias is its own.
    """
    import openmm
    from openmm import app, unit

    system = build_system(scene, spec or ForceFieldSpec("ff14SB", "obc2"))
    biases = []
    for pair in biased_torsions(residue_torsions(scene)):
        variables = []
        for quad in pair:
            force = openmm.CustomTorsionForce("theta")
            force.addTorsion(*quad)
            variables.append(app.BiasVariable(force, -math.pi, math.pi, _WIDTH_RAD, periodic=True, gridWidth=61))
        biases.append(
            app.Metadynamics(
                system, variables, temperature_k * unit.kelvin, bias_factor,
                _HEIGHT_KJ_MOL * unit.kilojoule_per_mole, _DEPOSIT_STEPS,
            )
        )  # fmt: skip
    integrator = openmm.LangevinMiddleIntegrator(temperature_k, 1.0, _TIMESTEP_PS)
    integrator.setRandomNumberSeed(seed % (2**31 - 2) + 1)
    simulation = app.Simulation(
        scene.to_openmm_topology(), system, integrator, openmm.Platform.getPlatform(platform),
        platform_properties(platform, 1),
    )  # fmt: skip
    simulation.context.setPositions(scene.positions_nm)
    simulation.minimizeEnergy()
    simulation.context.setVelocitiesToTemperature(temperature_k, seed % (2**31 - 2) + 1)
    frames = []
    for k in range(round(time_ps / (_SAVE_STEPS * _TIMESTEP_PS))):
        biases[k % len(biases)].step(simulation, _SAVE_STEPS)
        state = simulation.context.getState(positions=True)
        frames.append(state.getPositions(asNumpy=True)._value)
    free = [np.asarray(bias.getFreeEnergy().value_in_unit(unit.kilojoule_per_mole)) for bias in biases]
    return np.asarray(frames, dtype=np.float64), free


def choose_seeds(scene: Scene, n: int, *, seed: int, platform: str) -> Seeds:
    """Return `n` diverse structures of a peptide: a third with some phi > 0 (proline excepted), a quarter near
    barriers, spread evenly over coarse cells of phi, psi and chi1; of chains with proline a sixth with cis omega.

    Raises SimulationError when OpenMM fails.
    """
    residues = residue_torsions(scene)
    time_ps = 500.0 + 400.0 * len(residues)
    frames, free = metadynamics(
        scene, time_ps=time_ps, temperature_k=_HOT_K, bias_factor=_BIAS_FACTOR, seed=seed, platform=platform
    )
    # The first tenth starts from one structure.
    frames = frames[len(frames) // 10 :]
    rng = np.random.default_rng(seed)
    cells = _cells(frames, residues)
    positive = _positive_phi(frames, residues)
    rare = _near_barriers(frames, residues, free)
    n_positive = round(n * _POSITIVE_SHARE) if positive.any() else 0
    n_barrier = round(n * _BARRIER_SHARE) if rare.any() else 0
    groups = ["phi>0"] * n_positive + ["barrier"] * n_barrier
    groups += ["basin"] * (n - len(groups))
    pools = {"phi>0": positive & ~rare, "barrier": rare, "basin": ~positive & ~rare}
    chosen: list[int] = []
    for group in dict.fromkeys(groups):
        pool = np.flatnonzero(pools[group])
        pool = pool if len(pool) >= groups.count(group) else np.arange(len(frames))
        chosen += _evenly(pool, cells, groups.count(group), rng)
    positions = frames[chosen]
    prolines = [r for r in residues if r.name == "PRO" and r.omega is not None]
    if prolines:
        cis, graph = rng.choice(n, size=round(n * _CIS_SHARE), replace=False), bonded_graph(scene)
        for i, k in enumerate(cis):
            quad = prolines[i % len(prolines)].omega
            assert quad is not None
            positions[k] = turned(positions[k], quad, math.pi, graph)
            groups[k] = "cis"
        positions = _relaxed(scene, positions, cis, platform)
    order = rng.permutation(n)
    return Seeds(positions[order], tuple(groups[k] for k in order))


def _angles(frames_nm: FloatArray, quad: Quad) -> FloatArray:
    return np.asarray(torsion(frames_nm, np.array([quad]))[:, 0], dtype=np.float64)


def _cells(frames_nm: FloatArray, residues: list[ResidueTorsions]) -> IntArray:
    """Return a number for each frame, equal where all torsions lie in the same sixth of the circle."""
    quads = [q for r in residues for q in (r.phi, r.psi, r.chi1) if q is not None]
    digits = np.stack([np.floor((_angles(frames_nm, q) + math.pi) / _CELL_RAD).astype(int) % 6 for q in quads], 1)
    return np.unique(digits, axis=0, return_inverse=True)[1].ravel()


def _positive_phi(frames_nm: FloatArray, residues: list[ResidueTorsions]) -> npt.NDArray[np.bool_]:
    marks = [_angles(frames_nm, r.phi) > 0 for r in residues if r.phi is not None and r.name != "PRO"]
    return np.any(marks, axis=0) if marks else np.zeros(len(frames_nm), dtype=bool)


def _near_barriers(
    frames_nm: FloatArray, residues: list[ResidueTorsions], free: list[FloatArray]
) -> npt.NDArray[np.bool_]:
    """Mark frames in the highest fifth of any bias's free energy among those visited."""
    marks = np.zeros(len(frames_nm), dtype=bool)
    for pair, surface in zip(biased_torsions(residues), free, strict=True):
        n = surface.shape[0] - 1
        phi, psi = (np.rint((_angles(frames_nm, q) + math.pi) / (2 * math.pi) * n).astype(int) for q in pair)
        height = surface[psi, phi]
        marks |= height >= np.quantile(height, 1 - (1 - _BARRIER_QUANTILE) / len(free))
    return marks


def _evenly(pool: IntArray, cells: IntArray, n: int, rng: np.random.Generator) -> list[int]:
    """Draw `n` frames of a pool, each cell as likely as any other, each frame at most once."""
    _, inverse, counts = np.unique(cells[pool], return_inverse=True, return_counts=True)
    weights = 1.0 / counts[inverse.ravel()]
    return [int(k) for k in rng.choice(pool, size=n, replace=False, p=weights / weights.sum())]


def _relaxed(scene: Scene, positions_nm: FloatArray, which: IntArray, platform: str) -> FloatArray:
    with Engine(scene, Conditions(force=ForceFieldSpec("ff14SB", "obc2"), platform=platform)) as engine:
        for k in which:
            engine.set_positions(positions_nm[k])
            engine.minimise()
            positions_nm[k] = engine.positions()
    return positions_nm
