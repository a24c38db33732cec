"""Molecules and residues of a scene, found in its bonds; Systems of OpenMM joined, or put into another atom order."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np

from systems.chemistry.graph import backbone_torsions, bonded_graph
from systems.errors import PreparationError
from systems.scene import IntArray, Scene, part_of, reordered

# What OpenMM calls the terms of a bonded force, and which of a term's values are particles.
_TERMS = {
    "HarmonicBondForce": ("Bond", slice(0, 2)),
    "CustomBondForce": ("Bond", slice(0, 2)),
    "HarmonicAngleForce": ("Angle", slice(0, 3)),
    "PeriodicTorsionForce": ("Torsion", slice(0, 4)),
    "CustomTorsionForce": ("Torsion", slice(0, 4)),
    "CMAPTorsionForce": ("Torsion", slice(1, 9)),
}
_MERGED = ("HarmonicBondForce", "HarmonicAngleForce", "PeriodicTorsionForce", "CMAPTorsionForce")


def molecules_of(scene: Scene) -> list[IntArray]:
    """Return the atoms of each molecule (connected by bonds), each ascending, by first atom."""
    parts = nx.connected_components(bonded_graph(scene))
    return [np.array(sorted(part), dtype=np.int64) for part in sorted(parts, key=min)]


def is_water(elements: Sequence[str], atoms: IntArray) -> bool:
    """Return whether a molecule's atoms are those of water."""
    return len(atoms) == 3 and sorted(elements[i] for i in atoms.tolist()) == ["H", "H", "O"]


def solute_of(scene: Scene) -> IntArray:
    """Return the atoms of all molecules but water and single ions, ascending."""
    parts = [m for m in molecules_of(scene) if len(m) > 1 and not is_water(scene.elements, m)]
    return np.sort(np.concatenate(parts)) if parts else np.empty(0, np.int64)


def dry_part(scene: Scene) -> Scene:
    """Return a scene in a periodic cell without the cell and its water and single ions, any other as it is."""
    if scene.cell_nm is None:
        return scene
    solute = solute_of(scene)
    return replace(scene if len(solute) == scene.n_atoms else part_of(scene, solute), cell_nm=None)


# ---- residues -------------------------------------------------------------------------------------------------------


def regroup(scene: Scene) -> tuple[Scene, IntArray]:
    """Return the scene with its atoms gathered into residues, and `order (n_atoms,)`: its atom k was atom `order[k]`.

    Residues are what is left connected when the amide bonds of the backbone (C(=O)-N between carbons, and that of an
    NH2 that ends a chain) and the disulfide bonds are cut; they follow the chain from N to C terminus, atoms keep their
    order within one. Force fields recognise residues by their bonds, so a whole peptide in one residue 'UNL', or
    residues whose atoms lie mixed, become what OpenMM's templates know.

    In residues with several equal neighbours about a planar atom (ARG, TRP, HIS) Amber's improper torsions depend on
    the order of atoms, by some tenths of a kJ/mol.
    """
    ends = np.array(_amide_ends(scene), dtype=np.int64).reshape(-1, 2)
    amides = np.concatenate([backbone_torsions(scene)["omega"][:, 1:3], ends]).tolist()
    cut = {(min(c, n), max(c, n)) for c, n in amides}
    cut |= {(i, j) for i, j in scene.bonds.tolist() if scene.elements[i] == scene.elements[j] == "S"}
    pieces = bonded_graph(scene).copy()
    pieces.remove_edges_from(cut)
    residues = [sorted(part) for part in nx.connected_components(pieces)]
    of_atom = {atom: k for k, atoms in enumerate(residues) for atom in atoms}
    along: nx.DiGraph = nx.DiGraph()
    along.add_nodes_from(range(len(residues)))
    along.add_edges_from((of_atom[c], of_atom[n]) for c, n in amides if of_atom[c] != of_atom[n])
    ranked: list[int] = []
    chains: list[str] = []
    for number, molecule in enumerate(molecules_of(scene), 1):
        members = sorted({of_atom[i] for i in molecule.tolist()}, key=lambda k: residues[k][0])
        chain = along.subgraph(members)
        if nx.is_directed_acyclic_graph(chain):
            members = list(nx.lexicographical_topological_sort(chain, key=lambda k: residues[k][0]))
        chains += [str(number)] * len(members)
        ranked += members
    order = np.array([atom for k in ranked for atom in residues[k]], dtype=np.int64)
    regrouped = replace(
        reordered(scene, order),
        residue_of_atom=np.repeat(np.arange(len(ranked)), [len(residues[k]) for k in ranked]),
        residue_names=tuple(scene.residue_names[scene.residue_of_atom[residues[k][0]]] for k in ranked),
        residue_ids=tuple(str(k + 1) for k in range(len(ranked))),
        chain_of_residue=tuple(chains),
    )
    return regrouped, order


def _amide_ends(scene: Scene) -> list[tuple[int, int]]:
    """Return (C, N) of each NH2 on the carbonyl of a residue's backbone; NH2 of asparagine and glutamine is none."""
    near, symbol = scene.neighbours(), scene.elements
    found = []
    for n in (i for i, e in enumerate(symbol) if e == "N" and len(near[i]) == 3):
        carbons = [c for c in near[n] if symbol[c] == "C"]
        if len(carbons) != 1 or sum(symbol[h] == "H" for h in near[n]) != 2:
            continue
        c = carbons[0]
        if len(near[c]) == 3 and any(symbol[o] == "O" and len(near[o]) == 1 for o in near[c]):
            alphas = [a for a in near[c] if symbol[a] == "C"]
            if any(symbol[m] == "N" for a in alphas for m in near[a]):
                found.append((c, n))
    return found


# ---- Systems --------------------------------------------------------------------------------------------------------


def terms_of(force: Any) -> Iterator[tuple[str, tuple[int, ...], list[Any]]]:
    """Yield each term of a bonded force of OpenMM: 'Bond', 'Angle' or 'Torsion', its particles, its other values.
    Nothing of other forces."""
    if (name := type(force).__name__) in _TERMS:
        kind, at = _TERMS[name]
        for row in _moved_terms(force, None):
            yield kind, tuple(row[at]), [*row[: at.start], *row[at.stop :]]


def _moved_terms(force: Any, to: Sequence[int] | None) -> Iterator[list[Any]]:
    """Yield the values of each term as OpenMM has them, particle k being now `to[k]`."""
    kind, at = _TERMS[type(force).__name__]
    for k in range(getattr(force, f"getNum{kind}s")()):
        row = list(getattr(force, f"get{kind}Parameters")(k))
        if to is not None:
            row[at] = [to[i] for i in row[at]]
        yield row


def merge(n_atoms: int, parts: Iterable[tuple[IntArray, Any]]) -> Any:
    """Return one `openmm.System` of parts that do not share atoms: atom k of a part is particle `atoms[k]`. Virtual
    sites come after all atoms, in order. Parts interact by one NonbondedForce with the usual combination rules, whose
    settings are those of the first part. Raises PreparationError for forces that cannot be merged."""
    import openmm

    pieces = []
    n_particles = n_atoms
    for atoms, system in parts:
        extra = system.getNumParticles() - len(atoms)
        pieces.append(([*map(int, atoms), *range(n_particles, n_particles + extra)], system))
        n_particles += extra
    out = openmm.System()
    place_of = {place: (system, k) for to, system in pieces for k, place in enumerate(to)}
    for place in range(n_particles):
        system, k = place_of[place]
        out.addParticle(system.getParticleMass(k))
    forces = {name: getattr(openmm, name)() for name in _MERGED}
    nonbonded: dict[int, Any] = {}
    exceptions: list[list[Any]] = []
    settings = None
    for to, system in pieces:
        _copy_constraints_and_sites(system, out, to)
        for force in system.getForces():
            name = type(force).__name__
            if name == "NonbondedForce":
                settings = settings or force
                nonbonded |= {place: force.getParticleParameters(k) for k, place in enumerate(to)}
                for k in range(force.getNumExceptions()):
                    i, j, *rest = force.getExceptionParameters(k)
                    exceptions.append([to[i], to[j], *rest])
            elif name in forces:
                _append(forces[name], force, to)
            else:
                raise PreparationError(f"a {name} cannot be combined with GAFF2 molecules.")
    for force in forces.values():
        if any(terms_of(force)):
            out.addForce(force)
    joint = openmm.NonbondedForce()
    for place in range(n_particles):
        joint.addParticle(*nonbonded[place])
    for row in exceptions:
        joint.addException(*row)
    for setting in ("NonbondedMethod", "CutoffDistance", "UseDispersionCorrection", "EwaldErrorTolerance"):
        getattr(joint, f"set{setting}")(getattr(settings, f"get{setting}")())
    out.addForce(joint)
    return out


def _append(joint: Any, force: Any, to: list[int]) -> None:
    """Add the terms of `force`, atom k being now `to[k]`, to a force of the same kind."""
    has_maps = hasattr(joint, "addMap")
    first = joint.getNumMaps() if has_maps else 0
    for k in range(force.getNumMaps() if has_maps else 0):
        joint.addMap(*force.getMapParameters(k))
    add = getattr(joint, f"add{_TERMS[type(force).__name__][0]}")
    for row in _moved_terms(force, to):
        if has_maps:
            row[0] += first
        add(*row)


def permuted(system: Any, order: IntArray) -> Any:
    """Return an `openmm.System` whose particle `order[k]` is particle k of `system`: same masses, forces, constraints.
    Virtual sites, which come after all atoms, keep their places. Raises PreparationError for a kind of force or of
    virtual site not known here."""
    import openmm

    to = [*(int(i) for i in order), *range(len(order), system.getNumParticles())]
    if to == sorted(to):
        return system
    out = openmm.System()
    for k in np.argsort(to):
        out.addParticle(system.getParticleMass(int(k)))
    _copy_constraints_and_sites(system, out, to)
    if system.usesPeriodicBoundaryConditions():
        out.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    for force in system.getForces():
        out.addForce(_permuted_force(force, to))
    return out


def _permuted_force(force: Any, to: list[int]) -> Any:
    new, name = copy.deepcopy(force), type(force).__name__
    if name in _TERMS:
        put = getattr(new, f"set{_TERMS[name][0]}Parameters")
        for k, row in enumerate(_moved_terms(force, to)):
            put(k, *row)
    elif name in ("NonbondedForce", "GBSAOBCForce"):
        for k in range(force.getNumParticles()):
            new.setParticleParameters(to[k], *force.getParticleParameters(k))
        for k in range(force.getNumExceptions() if name == "NonbondedForce" else 0):
            i, j, *rest = force.getExceptionParameters(k)
            new.setExceptionParameters(k, to[i], to[j], *rest)
    elif name in ("CustomGBForce", "CustomNonbondedForce"):
        for k in range(force.getNumParticles()):
            new.setParticleParameters(to[k], force.getParticleParameters(k))
        for k in range(force.getNumExclusions()):
            new.setExclusionParticles(k, *(to[i] for i in force.getExclusionParticles(k)))
    elif name != "CMMotionRemover":
        raise PreparationError(f"a {name} cannot be reordered; give standard residues, in order.")
    return new


def _copy_constraints_and_sites(system: Any, out: Any, to: list[int]) -> None:
    """Give `out` the constraints and virtual sites of `system`, whose particle k is now `to[k]`. Raises
    PreparationError for sites other than the average of three particles."""
    import openmm

    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        out.addConstraint(to[i], to[j], length)
    for k in filter(system.isVirtualSite, range(system.getNumParticles())):
        site = system.getVirtualSite(k)
        if not isinstance(site, openmm.ThreeParticleAverageSite):
            raise PreparationError(f"a {type(site).__name__} cannot be reordered; give standard residues, in order.")
        parents, weights = ([get(n) for n in range(3)] for get in (site.getParticle, site.getWeight))
        out.setVirtualSite(to[k], openmm.ThreeParticleAverageSite(*(to[i] for i in parents), *weights))
