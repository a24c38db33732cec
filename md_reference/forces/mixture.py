"""Scenes of several molecules: which are water, ions, peptides or others, and one System from the parts' Systems."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.errors import PreparationError
from systems.scene import Scene

IntArray = npt.NDArray[np.int64]


def molecules_of(scene: Scene) -> list[IntArray]:
    """Return the atoms of each molecule (connected by bonds), each ascending, by first atom."""
    graph: nx.Graph = nx.Graph()
    graph.add_nodes_from(range(scene.n_atoms))
    graph.add_edges_from(scene.bonds.tolist())
    return [np.array(sorted(part), dtype=np.int64) for part in sorted(nx.connected_components(graph), key=min)]


def is_water(elements: Sequence[str], atoms: IntArray) -> bool:
    """Return whether a molecule's atoms are those of water."""
    return len(atoms) == 3 and sorted(elements[i] for i in atoms.tolist()) == ["H", "H", "O"]


def solute_of(scene: Scene) -> IntArray:
    """Return the atoms of all molecules but water and single ions, ascending."""
    parts = [m for m in molecules_of(scene) if len(m) > 1 and not is_water(scene.elements, m)]
    return np.sort(np.concatenate(parts)) if parts else np.empty(0, np.int64)


def merge(n_atoms: int, parts: Iterable[tuple[IntArray, Any]]) -> Any:
    """Return one `openmm.System` of parts that do not share atoms: atom k of a part is particle `atoms[k]`.

    A part's particles beyond its atoms (virtual sites) come after all atoms, in order. Parts interact by one
    NonbondedForce with the usual combination rules, whose settings are those of the first part. Raises PreparationError
    for forces that cannot be merged.
    """
    import openmm

    pieces = []
    n_particles = n_atoms
    for atoms, system in parts:
        extra = system.getNumParticles() - len(atoms)
        pieces.append(([*map(int, atoms), *range(n_particles, n_particles + extra)], system))
        n_particles += extra
    out = openmm.System()
    masses: list[Any] = [0.0] * n_particles
    for to, system in pieces:
        for k, place in enumerate(to):
            masses[place] = system.getParticleMass(k)
    for mass in masses:
        out.addParticle(mass)
    forces = {
        kind: kind()
        for kind in (openmm.HarmonicBondForce, openmm.HarmonicAngleForce, openmm.PeriodicTorsionForce,
                     openmm.CMAPTorsionForce)
    }  # fmt: skip
    nonbonded: dict[int, Any] = {}
    exceptions: list[tuple[Any, ...]] = []
    settings = None
    for to, system in pieces:
        for k in range(system.getNumConstraints()):
            i, j, length = system.getConstraintParameters(k)
            out.addConstraint(to[i], to[j], length)
        for k, place in enumerate(to):
            if system.isVirtualSite(k):
                out.setVirtualSite(place, moved_site(system.getVirtualSite(k), to))
        for force in system.getForces():
            if isinstance(force, openmm.NonbondedForce):
                settings = settings or force
                for k, place in enumerate(to):
                    nonbonded[place] = force.getParticleParameters(k)
                for k in range(force.getNumExceptions()):
                    i, j, *rest = force.getExceptionParameters(k)
                    exceptions.append((to[i], to[j], *rest))
            elif type(force) in forces:
                _append(forces[type(force)], force, to)
            else:
                raise PreparationError(f"a {type(force).__name__} cannot be combined with GAFF2 molecules.")
    for force in forces.values():
        if (force.getNumTorsions() if hasattr(force, "getNumTorsions") else _count(force)) > 0:
            out.addForce(force)
    joint = openmm.NonbondedForce()
    for place in range(n_particles):
        joint.addParticle(*nonbonded[place])
    for row in exceptions:
        joint.addException(*row)
    if settings is not None:
        joint.setNonbondedMethod(settings.getNonbondedMethod())
        joint.setCutoffDistance(settings.getCutoffDistance())
        joint.setUseDispersionCorrection(settings.getUseDispersionCorrection())
        joint.setEwaldErrorTolerance(settings.getEwaldErrorTolerance())
    out.addForce(joint)
    return out


def moved_site(site: Any, to: list[int]) -> Any:
    """Return a virtual site whose parents have moved: particle k is now `to[k]`. Raises PreparationError."""
    import openmm

    parents = [to[site.getParticle(k)] for k in range(site.getNumParticles())]
    if isinstance(site, openmm.ThreeParticleAverageSite):
        return openmm.ThreeParticleAverageSite(*parents, *(site.getWeight(k) for k in range(3)))
    raise PreparationError(f"a {type(site).__name__} cannot be reordered; give standard residues, in order.")


def _count(force: Any) -> int:
    return int(force.getNumBonds() if hasattr(force, "getNumBonds") else force.getNumAngles())


def _append(joint: Any, force: Any, to: list[int]) -> None:
    """Add the terms of `force`, atom k being now `to[k]`, to a force of the same kind."""
    import openmm

    if isinstance(force, openmm.HarmonicBondForce):
        for k in range(force.getNumBonds()):
            i, j, *rest = force.getBondParameters(k)
            joint.addBond(to[i], to[j], *rest)
    elif isinstance(force, openmm.HarmonicAngleForce):
        for k in range(force.getNumAngles()):
            i, j, m, *rest = force.getAngleParameters(k)
            joint.addAngle(to[i], to[j], to[m], *rest)
    elif isinstance(force, openmm.PeriodicTorsionForce):
        for k in range(force.getNumTorsions()):
            i, j, m, n, *rest = force.getTorsionParameters(k)
            joint.addTorsion(to[i], to[j], to[m], to[n], *rest)
    else:
        first = joint.getNumMaps()
        for k in range(force.getNumMaps()):
            joint.addMap(*force.getMapParameters(k))
        for k in range(force.getNumTorsions()):
            grid, *atoms = force.getTorsionParameters(k)
            joint.addTorsion(first + grid, *(to[i] for i in atoms))
