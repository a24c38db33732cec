"""Side chains whose added atoms stand in others, or off their bonds: built again by turning torsions to rotamers.

PDBFixer adds missing atoms in the shape of its template, and parts overlaps by a few steps of minimisation, which in
crowded places ends in bonds of 2.7 Å or in atoms 2 Å apart. Here every torsion that the file leaves open is tried at
its rotamers (60°, 180°, -60°; every 30° where a planar group turns: the centres of Dunbrack's library, Acta Cryst.
D58, 1862 (2002)), and the conformer farthest from all other heavy atoms is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib.resources import files
from itertools import product
from pathlib import Path

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.geometry import extend, torsion
from systems.errors import PreparationError
from systems.prepare.read.structure_text import read_structure

Vector = npt.NDArray[np.float64]
Sites = dict[str, int]

_STAGGERED = (-60.0, 180.0, 60.0)
_PLANAR = tuple(float(k) for k in range(-180, 180, 30))
# The atom at the end of the last torsion that turns a planar group.
_PLANAR_AT = {"ASP": "CG", "ASN": "CG", "PHE": "CG", "TYR": "CG", "TRP": "CG", "HIS": "CG", "GLU": "CD", "GLN": "CD"}
_RIGID = frozenset({frozenset(("NE", "CZ"))})
_BACKBONE = frozenset(("N", "C", "O", "OXT"))
# Hydrogen bonds of heavy atoms start at 2.4 Å, contacts with carbon and sulfur at 3.0: nearer than the first an added
# atom is built again, nearer than the second nothing is left to part.
_NEAR_ANGSTROM, _NEAR_POLAR_ANGSTROM = 2.9, 2.4
_OVERLAP_ANGSTROM = 2.1


def residue_shape(name: str) -> dict[str, Vector]:
    """Return the heavy atoms of PDBFixer's template of a residue, nm."""
    return {k: v.copy() for k, v in _shape(name).items()}


@lru_cache(maxsize=64)
def _shape(name: str) -> dict[str, Vector]:
    path = Path(str(files("pdbfixer") / "templates" / f"{name}.pdb"))
    return {a.name: np.array(a.position_angstrom) / 10.0 for a in read_structure(path).atoms if a.element != "H"}


def resolve_side_chains(
    positions_nm: Vector,
    elements: Sequence[str],
    bonds: Sequence[tuple[int, int]],
    residues: Sequence[tuple[str, str, Sites, Sequence[str]]],
) -> list[str]:
    """Build added side chains that overlap again, in place; return a line for each.

    `positions_nm` `(n_atoms, 3)`, heavy atoms alone; `bonds` pairs of them; `residues`: label, standard name, atoms by
    name, and the names that were added. Raises PreparationError where an added atom stands in another in every rotamer.
    """
    graph = nx.Graph(bonds)
    graph.add_nodes_from(range(len(elements)))
    radii = np.array([covalent_radius_nm(e) for e in elements])
    polar = np.array([e in ("N", "O") for e in elements])
    notes = []
    for label, name, sites, added in residues:
        moved = [a for a in added if a in sites and a not in (*_BACKBONE, "CB")]
        if not moved:
            continue
        idx = np.array([sites[a] for a in moved])
        near = [sorted(nx.single_source_shortest_path_length(graph, int(i), cutoff=3)) for i in idx]

        def clearance(x: Vector, idx: npt.NDArray[np.intp] = idx, near: list[list[int]] = near) -> tuple[float, float]:
            """The least distance of an added atom, and the least by which one exceeds what is called near, nm."""
            gap = np.linalg.norm(x[idx, None] - x[None], axis=2)
            for k, around in enumerate(near):
                gap[k, around] = np.inf
            limit = np.where(polar[idx, None] & polar[None], _NEAR_POLAR_ANGSTROM, _NEAR_ANGSTROM) / 10.0
            return float(gap.min()), float((gap - limit).min())

        joined = [(i, j) for i, j in bonds if i in idx or j in idx]
        ratio = [float(np.linalg.norm(positions_nm[i] - positions_nm[j]) / (radii[i] + radii[j])) for i, j in joined]
        off = any(not 0.75 < r < 1.25 for r in ratio)
        least, margin = clearance(positions_nm)
        if not off and margin >= 0:
            continue
        best = positions_nm.copy() if not off else None
        for trial in _conformers(name, {a: positions_nm[i] for a, i in sites.items() if a not in moved}, moved):
            x = positions_nm.copy()
            x[idx] = [trial[a] for a in moved]
            of_trial = clearance(x)
            if best is None or of_trial[1] > margin + 1e-6:
                best, (least, margin) = x, of_trial
        if best is None:
            continue  # its bonds are refused with their lengths
        if 10.0 * least < _OVERLAP_ANGSTROM:
            raise PreparationError(
                f"{label}: {' '.join(moved)}, which were missing, come out {10 * least:.2f} Å from another heavy atom "
                "in every rotamer; give the residue with all its heavy atoms, or make place for it."
            )
        if not np.array_equal(best, positions_nm):
            positions_nm[:] = best
            notes.append(f"{label}: {' '.join(moved)} overlapped and were built again in the rotamer with most room")
    return notes


def _conformers(name: str, there: Mapping[str, Vector], moved: Sequence[str]) -> list[dict[str, Vector]]:
    """Positions in nm of the `moved` atoms of a residue in every combination of rotamers, `there` being its others;
    none of proline, whose ring leaves no choice, nor where what they hang on is missing."""
    shape = _shape(name)
    tree = _tree(name)
    if name == "PRO" or any(a not in shape or a not in tree for a in moved) or not {"N", "CA", "CB"} <= set(there):
        return []
    order = [a for a in tree if a in moved]
    axes: list[tuple[str, str, str, str, tuple[float, ...]]] = []
    for atom, (p, g, q) in tree.items():
        if any(axis[1:3] == (g, p) for axis in axes) or frozenset((g, p)) in _RIGID:
            continue
        if _turns(name, g, p):
            values: tuple[float, ...] = _PLANAR if _PLANAR_AT.get(name) == p else _STAGGERED
            fixed = next((b for b, (pb, _, _) in tree.items() if pb == p and b in there), None)
            if fixed is not None:
                values = (_torsion_deg(there, q, g, p, fixed),)
            axes.append((q, g, p, fixed or atom, values))
    out = []
    for chosen in product(*(values for *_, values in axes)):
        turn = {(g, p): value - _torsion_deg(shape, q, g, p, d)
                for (q, g, p, d, _), value in zip(axes, chosen, strict=True)}  # fmt: skip
        placed = dict(there)
        for atom in order:
            p, g, q = tree[atom]
            length = float(np.linalg.norm(shape[atom] - shape[p]))
            u, v = shape[g] - shape[p], shape[atom] - shape[p]
            bend = float(np.degrees(np.arccos(np.dot(u, v) / np.linalg.norm(u) / np.linalg.norm(v))))
            value = _torsion_deg(shape, q, g, p, atom) + turn.get((g, p), 0.0)
            placed[atom] = extend(placed[q], placed[g], placed[p], length, bend, value)
        out.append({a: placed[a] for a in moved})
    return out


@lru_cache(maxsize=64)
def _skeleton(name: str) -> nx.Graph:
    from systems.chemistry.residues import template_for

    template = template_for(name)
    return nx.Graph() if template is None else nx.Graph(template.bonds)


@lru_cache(maxsize=64)
def _tree(name: str) -> dict[str, tuple[str, str, str]]:
    """Of each side-chain atom beyond CB, nearest first, the three atoms that it hangs on: parent, grandparent, and
    that one's parent."""
    graph = _skeleton(name)
    if "CB" not in graph:
        return {}
    graph = graph.subgraph([a for a in graph if a not in _BACKBONE])
    parent = {"CA": "N", **{b: a for a, b in nx.bfs_edges(graph, "CA")}}
    return {a: (parent[a], parent[parent[a]], parent[parent[parent[a]]]) for a in parent if a not in ("CA", "CB")}


def _turns(name: str, a: str, b: str) -> bool:
    """Whether the bond is in no ring."""
    graph = _skeleton(name).copy()
    graph.remove_edge(a, b)
    return not nx.has_path(graph, a, b)


def _torsion_deg(shape: Mapping[str, Vector], *names: str) -> float:
    return float(np.degrees(torsion(np.array([shape[k] for k in names]), [[0, 1, 2, 3]])[0]))
