"""Residues found in the bond graph, for peptides whose file divides them in a way no force field knows."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np
import numpy.typing as npt

from md_reference.forces.mixture import moved_site
from systems.chemistry.graph import backbone_torsions
from systems.errors import PreparationError
from systems.scene import Scene, reordered

IntArray = npt.NDArray[np.int64]


def regroup(scene: Scene, *, uncut: Iterable[tuple[int, int]] = ()) -> tuple[Scene, IntArray]:
    """Return the scene with its atoms gathered into residues, and `order (n_atoms,)`: its atom k was atom `order[k]`.

    Residues are what is left connected when the amide bonds of the backbone (C(=O)-N between carbons, and that of an
    NH2 that ends a chain) and the disulfide bonds are cut, except the bonds `uncut` (i < j); they follow the chain from
    its N to its C terminus, atoms keep their order within one. Names come from the first atom's residue. Force fields
    recognise residues by their bonds, so names need not be right: a whole peptide in one residue 'UNL', or residues
    whose atoms lie mixed, become what OpenMM's templates know.

    Energies do not depend on the order of atoms for alanine dipeptide (to rounding); in residues with several equal
    neighbours about a planar atom (ARG, TRP, HIS) Amber's improper torsions depend on it, by some tenths of a kJ/mol.
    """
    torsions = backbone_torsions(scene)
    ends = _amide_ends(scene)
    amides = np.concatenate([torsions["omega"][:, 1:3], np.array(ends, dtype=np.int64).reshape(-1, 2)])
    cut = {(min(c, n), max(c, n)) for c, n in amides.tolist()} - set(uncut)
    whole: nx.Graph = nx.Graph()
    whole.add_nodes_from(range(scene.n_atoms))
    whole.add_edges_from(scene.bonds.tolist())
    pieces = whole.copy()
    pieces.remove_edges_from(
        (i, j)
        for i, j in scene.bonds.tolist()
        if (i, j) in cut or (scene.elements[i] == "S" and scene.elements[j] == "S" and (i, j) not in set(uncut))
    )
    residues = [sorted(part) for part in nx.connected_components(pieces)]
    of_atom = {atom: k for k, atoms in enumerate(residues) for atom in atoms}
    along: nx.DiGraph = nx.DiGraph()
    along.add_nodes_from(range(len(residues)))
    along.add_edges_from((of_atom[c], of_atom[n]) for c, n in amides.tolist() if of_atom[c] != of_atom[n])
    ranked: list[int] = []
    chains: list[str] = []
    for molecule in sorted(nx.connected_components(whole), key=min):
        members = sorted({of_atom[i] for i in molecule}, key=lambda k: residues[k][0])
        chain = along.subgraph(members)
        if nx.is_directed_acyclic_graph(chain):
            members = list(nx.lexicographical_topological_sort(chain, key=lambda k: residues[k][0]))
        chains += [str(len(set(chains)) + 1)] * len(members)
        ranked += members
    order = np.array([atom for k in ranked for atom in residues[k]], dtype=np.int64)
    first = [int(scene.residue_of_atom[residues[k][0]]) for k in ranked]
    regrouped = replace(
        reordered(scene, order),
        residue_of_atom=np.repeat(np.arange(len(ranked)), [len(residues[k]) for k in ranked]),
        residue_names=tuple(scene.residue_names[r] for r in first),
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


def permuted(system: Any, order: IntArray) -> Any:
    """Return an `openmm.System` whose particle `order[k]` is particle k of `system`: same masses, forces, constraints.

    Particles beyond `order` (virtual sites, which come after all atoms) keep their places. Raises PreparationError for
    a kind of force or of virtual site not known here, rather than guess its indices.
    """
    import openmm

    n = system.getNumParticles()
    to = [*(int(i) for i in order), *range(len(order), n)]
    out = openmm.System()
    for k in np.argsort(to):
        out.addParticle(system.getParticleMass(int(k)))
    for k in range(n):
        if system.isVirtualSite(k):
            out.setVirtualSite(to[k], moved_site(system.getVirtualSite(k), to))
    if system.usesPeriodicBoundaryConditions():
        out.setDefaultPeriodicBoxVectors(*system.getDefaultPeriodicBoxVectors())
    for k in range(system.getNumConstraints()):
        i, j, length = system.getConstraintParameters(k)
        out.addConstraint(to[i], to[j], length)
    for force in system.getForces():
        out.addForce(_permuted_force(force, to))
    return out


def _permuted_force(force: Any, to: list[int]) -> Any:
    import openmm

    new = copy.deepcopy(force)
    if isinstance(force, openmm.HarmonicBondForce):
        for k in range(force.getNumBonds()):
            i, j, *rest = force.getBondParameters(k)
            new.setBondParameters(k, to[i], to[j], *rest)
    elif isinstance(force, openmm.HarmonicAngleForce):
        for k in range(force.getNumAngles()):
            a, b, c, *rest = force.getAngleParameters(k)
            new.setAngleParameters(k, to[a], to[b], to[c], *rest)
    elif isinstance(force, openmm.PeriodicTorsionForce):
        for k in range(force.getNumTorsions()):
            a, b, c, d, *rest = force.getTorsionParameters(k)
            new.setTorsionParameters(k, to[a], to[b], to[c], to[d], *rest)
    elif isinstance(force, openmm.CMAPTorsionForce):
        for k in range(force.getNumTorsions()):
            grid, *atoms = force.getTorsionParameters(k)
            new.setTorsionParameters(k, grid, *(to[a] for a in atoms))
    elif isinstance(force, openmm.NonbondedForce):
        for k in range(force.getNumParticles()):
            new.setParticleParameters(to[k], *force.getParticleParameters(k))
        for k in range(force.getNumExceptions()):
            i, j, *rest = force.getExceptionParameters(k)
            new.setExceptionParameters(k, to[i], to[j], *rest)
    elif isinstance(force, openmm.GBSAOBCForce):
        for k in range(force.getNumParticles()):
            new.setParticleParameters(to[k], *force.getParticleParameters(k))
    elif isinstance(force, openmm.CustomBondForce):
        for k in range(force.getNumBonds()):
            i, j, *rest = force.getBondParameters(k)
            new.setBondParameters(k, to[i], to[j], *rest)
    elif isinstance(force, openmm.CustomTorsionForce):
        for k in range(force.getNumTorsions()):
            a, b, c, d, *rest = force.getTorsionParameters(k)
            new.setTorsionParameters(k, to[a], to[b], to[c], to[d], *rest)
    elif isinstance(force, openmm.CustomGBForce | openmm.CustomNonbondedForce):
        for k in range(force.getNumParticles()):
            new.setParticleParameters(to[k], force.getParticleParameters(k))
        for k in range(force.getNumExclusions()):
            new.setExclusionParticles(k, *(to[i] for i in force.getExclusionParticles(k)))
    else:
        raise PreparationError(f"a {type(force).__name__} cannot be reordered; give standard residues, in order.")
    return new
