"""Canonical classes of atoms: which atoms of a molecule are equivalent, by connectivity and by stereo.

Colour refinement (Weisfeiler and Lehman, 1968) on elements and ring sizes; stereocentres are found as atoms whose
neighbours all differ, their handedness enters the colours, and the refinement goes on until nothing new appears. Known
limits, not seen: axial chirality (allenes, hindered biaryls) and centres that only a fused ring system tells apart.
RDKit's canonical ranks are not used: they tell apart equivalent atoms of rings (8 classes for
1,4-dimethylcyclohexane, which has 6), they are no hash of a molecule, and training runs without RDKit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import networkx as nx
import numpy as np

from systems.chemistry.geometry import signed_volumes, torsion
from systems.scene import ATOMIC_NUMBERS, FloatArray, Scene, once_per_scene

_LARGEST_RING = 12
_CC_DOUBLE_NM = 0.141


@dataclass(frozen=True)
class AtomClasses:
    """Canonical colours `(n_atoms,)`, equal for equivalent atoms, and the stereocentres they reveal.

    `centres`: rows (centre, a, b, c), neighbours by falling colour, hydrogen last, the fourth left out; `signs` their
    handedness at the scene's positions: the sign of (a-centre) x (b-centre) . (c-centre).
    """

    colours: tuple[int, ...]
    centres: tuple[tuple[int, int, int, int], ...]
    signs: tuple[int, ...]

    @property
    def fingerprint(self) -> tuple[int, ...]:
        """Equal for isomorphic molecules of the same stereo, whatever the atom order."""
        return tuple(sorted(self.colours))


@once_per_scene
def bonded_graph(scene: Scene) -> nx.Graph:
    """Return the graph of atoms (node attribute `element`) and bonds (edge attribute `order`, 0 where unknown), frozen:
    it is made once per scene, so `copy()` it to change it."""
    graph = nx.Graph()
    graph.add_nodes_from((i, {"element": e}) for i, e in enumerate(scene.elements))
    orders = zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True)
    graph.add_edges_from((i, j, {"order": order}) for (i, j), order in orders)
    return nx.freeze(graph)


@once_per_scene
def classify(scene: Scene, *, stereo: bool = True, mirrored: bool = False) -> AtomClasses:
    """Return the classes of a scene's atoms; `mirrored` classifies its mirror image, `stereo=False` connectivity only.

    Bond orders and atomic charges are left out: programs differ in them for one and the same molecule.
    """
    graph = bonded_graph(scene)
    rings = _ring_sizes(graph)
    neighbours = [sorted(graph[i]) for i in range(scene.n_atoms)]
    labels = {(i, j): rings.get((min(i, j), max(i, j)), 0) for i in range(scene.n_atoms) for j in neighbours[i]}
    colours = _refine([_hash(e, len(n)) for e, n in zip(scene.elements, neighbours, strict=True)], neighbours, labels)
    if not stereo:
        return AtomClasses(tuple(colours), (), ())
    flip = -1 if mirrored else 1
    cycles = _lone_cycles(rings)
    double = {pair for pair in _double_bonds(scene) if pair not in rings}
    x = scene.positions_nm
    centres: dict[int, tuple[int, int, int, int]] = {}
    signs: dict[int, int] = {}
    done: set[tuple[int, int]] = set()
    while True:
        marks: dict[int, list[object]] = {}
        fresh = _fresh_centres(scene.elements, neighbours, colours, set(centres))
        for row in fresh:
            centres[row[0]] = row
            signs[row[0]] = flip * _sign(x, row)
            marks[row[0]] = [signs[row[0]]]
        resolved = len(done)
        for i, j in double - done:
            mark = _cis_trans(x, neighbours, colours, i, j)
            if mark:
                done.add((i, j))
                marks.setdefault(i, []).append(mark)
                marks.setdefault(j, []).append(mark)
        for cycle in cycles:
            for atom, relation in _ring_relations(x, neighbours, colours, cycle, set(centres)).items():
                marks.setdefault(atom, []).append(relation)
        if not marks:
            break
        n_classes = len(set(colours))
        marked = [_hash(c, marks[i]) if i in marks else c for i, c in enumerate(colours)]
        colours = _refine(marked, neighbours, labels)
        if not fresh and len(done) == resolved and len(set(colours)) == n_classes:
            break
    order = sorted(centres)
    return AtomClasses(tuple(colours), tuple(centres[i] for i in order), tuple(signs[i] for i in order))


def _hash(*parts: object) -> int:
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:8], "big")


def _refine(colours: list[int], neighbours: list[list[int]], labels: dict[tuple[int, int], int]) -> list[int]:
    n_classes = len(set(colours))
    while True:
        refined = [_hash(c, sorted((labels[i, j], colours[j]) for j in neighbours[i])) for i, c in enumerate(colours)]
        if len(set(refined)) == n_classes:
            return refined
        colours, n_classes = refined, len(set(refined))


def local_handedness(scene: Scene) -> dict[int, int]:
    """Return the handedness of each stereocentre, -1 or 1, by an order of neighbours that means the same in every
    molecule; 0 where that order leaves two of them alike.

    Neighbours are ranked by their atomic number, then by the sorted atomic numbers one, two and three bonds behind
    them, as the rules of Cahn, Ingold and Prelog begin; the sign is that of the three highest.
    """
    graph = bonded_graph(scene)
    number = [ATOMIC_NUMBERS.get(e, 0) for e in scene.elements]

    def rank(start: int, centre: int) -> tuple[tuple[int, ...], ...]:
        shells, before, here = [], {centre}, {start}
        for _ in range(4):
            shells.append(tuple(sorted((number[i] for i in here), reverse=True)))
            before |= here
            here = {j for i in here for j in graph[i]} - before
        return tuple(shells)

    found = {}
    for centre, *_ in classify(scene).centres:
        ranked = sorted(((rank(j, centre), j) for j in graph[centre]), reverse=True)
        alike = any(a == b for (a, _), (b, _) in pairwise(ranked))
        top = [j for _, j in ranked[:3]]
        found[centre] = 0 if alike else _sign(scene.positions_nm, (centre, top[0], top[1], top[2]))
    return found


def _sign(positions_nm: FloatArray, row: tuple[int, int, int, int]) -> int:
    return 1 if float(signed_volumes(positions_nm, [row])[0]) > 0 else -1


def _fresh_centres(
    elements: Sequence[str], neighbours: list[list[int]], colours: list[int], known: set[int]
) -> list[tuple[int, int, int, int]]:
    rows = []
    for i, symbol in enumerate(elements):
        near = neighbours[i]
        tetrahedral = len(near) == 4 and symbol != "H"
        pyramidal = len(near) == 3 and symbol in ("S", "P", "Se", "As")
        if i in known or not (tetrahedral or pyramidal):
            continue
        if symbol == "N" and any(elements[j] == "H" for j in near):
            continue  # inverts by losing and taking up its proton
        if len({colours[j] for j in near}) == len(near):
            a, b, c = sorted(near, key=lambda j: (elements[j] == "H", -colours[j]))[:3]
            rows.append((i, a, b, c))
    return rows


def _double_bonds(scene: Scene) -> set[tuple[int, int]]:
    """C=C bonds between atoms of three bonds, by their order or, where this is unknown, by their length."""
    length = np.linalg.norm(np.diff(scene.positions_nm[scene.bonds], axis=1)[:, 0], axis=1)
    degree = np.bincount(scene.bonds.ravel(), minlength=scene.n_atoms)
    carbon = np.array([e == "C" for e in scene.elements]) & (degree == 3)
    double = (scene.bond_orders == 2) | ((scene.bond_orders == 0) & (length < _CC_DOUBLE_NM))
    return {(min(i, j), max(i, j)) for i, j in scene.bonds[double & carbon[scene.bonds].all(axis=1)].tolist()}


def _cis_trans(positions_nm: FloatArray, neighbours: list[list[int]], colours: list[int], i: int, j: int) -> str:
    ends = []
    for atom, other in ((i, j), (j, i)):
        a, b = (k for k in neighbours[atom] if k != other)
        if colours[a] == colours[b]:
            return ""
        ends.append(a if colours[a] > colours[b] else b)
    angle = float(torsion(positions_nm, [[ends[0], i, j, ends[1]]])[0])
    return "cis" if abs(angle) < np.pi / 2 else "trans"


def _ring_sizes(graph: nx.Graph) -> dict[tuple[int, int], int]:
    """Size of the smallest ring through each ring bond (i < j); larger ones than `_LARGEST_RING` count as that + 1."""
    acyclic = {(min(e), max(e)) for e in nx.bridges(graph)}
    sizes = {}
    for i, j in ((min(e), max(e)) for e in graph.edges):
        if (i, j) in acyclic:
            continue
        front, seen, size = {i}, {i}, 1
        while front and j not in seen and size <= _LARGEST_RING:
            front = {k for f in front for k in graph[f] if k not in seen and {f, k} != {i, j}}
            seen |= front
            size += 1
        sizes[i, j] = size
    return sizes


def _lone_cycles(rings: dict[tuple[int, int], int]) -> list[list[int]]:
    """Rings that share no bond and no atom with another, each as a walk around it."""
    graph = nx.Graph(list(rings))
    cycles = []
    for component in nx.connected_components(graph):
        if all(graph.degree(i) == 2 for i in component):
            start = min(component)
            cycles.append([start, *[v for _, v in nx.dfs_edges(graph, start)]])
    return cycles


def _ring_relations(
    positions_nm: FloatArray, neighbours: list[list[int]], colours: list[int], cycle: list[int], known: set[int]
) -> dict[int, list[tuple[int, int, int]]]:
    """Cis and trans on rings whose two directions are alike (1,4-dimethylcyclohexane), which hold no stereocentre.

    The sign of (previous, next, higher substituent) changes with the direction of the walk; products of two do not.
    """
    n = len(cycle)
    signs: dict[int, int] = {}
    for k, atom in enumerate(cycle):
        before, after = cycle[k - 1], cycle[(k + 1) % n]
        others = [j for j in neighbours[atom] if j not in (before, after)]
        if atom in known or len(others) != 2 or colours[before] != colours[after]:
            continue
        if colours[others[0]] != colours[others[1]]:
            signs[k] = _sign(positions_nm, (atom, before, after, max(others, key=lambda j: colours[j])))
    relations: dict[int, list[tuple[int, int, int]]] = {}
    for k, sign in signs.items():
        pairs = [
            (colours[cycle[m]], min((k - m) % n, (m - k) % n), sign * other) for m, other in signs.items() if m != k
        ]
        if pairs:
            relations[cycle[k]] = sorted(pairs)
    return relations
