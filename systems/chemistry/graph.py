"""The bonded graph of a scene and what follows from it: key, stereocentres, torsions, exclusions, atom matching."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.geometry import torsion
from systems.chemistry.matching import match_atoms
from systems.chemistry.symmetry import bonded_graph, classify
from systems.scene import FloatArray, Scene, once_per_scene

IntArray = npt.NDArray[np.int64]

# Atoms that a turned torsion brings nearer than this are no state of the molecule.
_CLASH_NM = 0.14

__all__ = [
    "atom_classes",
    "backbone_torsions",
    "bonded_graph",
    "exclusions",
    "match_atoms",
    "molecule_key",
    "ring_bonds",
    "rotatable_torsions",
    "stereocentres",
    "torsion",
]


@once_per_scene
def molecule_key(scene: Scene) -> str:
    """Return a hash of elements, connectivity, total charge and stereo, 16 hexadecimal digits.

    Free of atom order, names, positions, bond orders and the atom a charge is drawn on; enantiomers, diastereomers and
    E/Z isomers differ. `systems.chemistry.symmetry` states the method and its limits. Of a model system it is a hash of
    the law, particle by particle: which of them are equivalent is not worked out.
    """
    record: tuple[object, ...] = (classify(scene).fingerprint, int(scene.formal_charges.sum()))
    if scene.interactions is not None:
        record = (*record, json.dumps(scene.interactions, sort_keys=True), scene.masses_da.tolist())
    return hashlib.sha256(repr(record).encode()).hexdigest()[:16]


@once_per_scene
def atom_classes(scene: Scene) -> IntArray:
    """Return a class number per atom `(n_atoms,)`: equal for atoms that connectivity and stereo do not tell apart.

    Numbers run from 0 in an order that is canonical for the molecule.
    """
    colours = classify(scene).colours
    rank = {c: k for k, c in enumerate(sorted(set(colours)))}
    return np.array([rank[c] for c in colours], dtype=np.int64)


@once_per_scene
def stereocentres(scene: Scene) -> IntArray:
    """Return the stereocentres as rows (centre, a, b, c), `(k, 4)`, neighbours in canonical order.

    The sign of `geometry.signed_volumes` for a row is the centre's handedness, the same for one molecule in any atom
    order and opposite for its mirror image.
    """
    return np.array(classify(scene).centres, dtype=np.int64).reshape(-1, 4)


@once_per_scene
def ring_bonds(scene: Scene) -> IntArray:
    """Return the bonds that lie in a ring, `(k, 2)` with i < j."""
    graph = bonded_graph(scene)
    bridges = {(min(e), max(e)) for e in nx.bridges(graph)}
    rows = [(i, j) for i, j in scene.bonds.tolist() if (min(i, j), max(i, j)) not in bridges]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def backbone_torsions(scene: Scene) -> dict[str, IntArray]:
    """Return the peptide torsions `phi`, `psi`, `omega`, each `(k, 4)`, ordered along the chain.

    Found from the graph: C(=O)-N-CA-C(=O) and N-CA-C(=O)-N, with omega (X, C, N, Y) about every C(=O)-N bond between
    carbons X and Y (caps included). CA has no multiple bond in a ring: caffeine and picolinamide are no peptides. Names
    and residues play no part; scenes without peptides give empty arrays.
    """
    graph = bonded_graph(scene)
    symbol = scene.elements

    def near(i: int, element: str) -> list[int]:
        return sorted(j for j in graph[i] if symbol[j] == element)

    def is_carbonyl(i: int) -> bool:
        return symbol[i] == "C" and graph.degree(i) == 3 and any(graph.degree(o) == 1 for o in near(i, "O"))

    ring = {frozenset(pair) for pair in ring_bonds(scene).tolist()}
    orders = zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True)
    aromatic = {i for pair, order in orders if order > 1.0 and frozenset(pair) in ring for i in pair}
    carbonyls = [i for i in range(scene.n_atoms) if is_carbonyl(i)]
    amides = {c: [n for n in near(c, "N") if near(n, "C") != [c]] for c in carbonyls}
    units: list[tuple[int, int, int]] = []  # (N, CA, C) of each residue
    for c in carbonyls:
        for alpha in near(c, "C"):
            if alpha not in carbonyls and alpha not in aromatic:
                units.extend((n, alpha, c) for n in near(alpha, "N"))
    joined = {n: c for c, nitrogens in amides.items() for n in nitrogens}
    units = [u for u in _along_chain(units, joined) if u[0] in joined or amides[u[2]]]
    phi = [(joined[n], n, a, c) for n, a, c in units if n in joined]
    psi = [(n, a, c, m) for n, a, c in units for m in amides[c]]
    along = {c: k for k, (_, _, c) in enumerate(units)}
    omega = []
    for c in sorted(carbonyls, key=lambda i: (along.get(i, -1), i)):
        for n in amides[c]:
            left = near(c, "C")
            right = [y for y in near(n, "C") if y != c]
            alphas = [y for y in right if any(u[:2] == (n, y) for u in units)] or right
            if left and alphas:
                omega.append((left[0], c, n, alphas[0]))
    return {
        key: np.array(rows, dtype=np.int64).reshape(-1, 4)
        for key, rows in (("phi", phi), ("psi", psi), ("omega", omega))
    }


def _along_chain(units: list[tuple[int, int, int]], joined: dict[int, int]) -> list[tuple[int, int, int]]:
    """Sort (N, CA, C) units from the first residue of each chain to its last; cycles start at their lowest atom."""
    by_carbonyl = {u[2]: u for u in units}
    follows = {u: by_carbonyl.get(joined.get(u[0], -1)) for u in units}
    next_of = {v: u for u, v in follows.items() if v is not None}
    starts = sorted((u for u in units if follows[u] is None), key=min) + sorted(units, key=min)
    out: dict[tuple[int, int, int], None] = {}
    for start in starts:
        unit: tuple[int, int, int] | None = start
        while unit is not None and unit not in out:
            out[unit] = None
            unit = next_of.get(unit)
    return list(out)


@once_per_scene
def exclusions(scene: Scene, depth: int = 3) -> IntArray:
    """Return the pairs (i < j) at most `depth` bonds apart, `(k, 2)`: 1-2, 1-3 and 1-4 pairs by default."""
    graph = bonded_graph(scene)
    rows = [
        (i, j)
        for i in range(scene.n_atoms)
        for j in nx.single_source_shortest_path_length(graph, i, cutoff=depth)
        if i < j
    ]
    return np.array(sorted(rows), dtype=np.int64).reshape(-1, 2)


def turned(positions_nm: FloatArray, quad: Sequence[int], angle: float, graph: nx.Graph) -> FloatArray:
    """Return positions `(n_atoms, 3)` with what hangs beyond a torsion's middle bond turned about it, so that the
    torsion grows by `angle` (radian). `graph`: `bonded_graph`, which the bond must hold together."""
    _, b, c, _ = (int(k) for k in quad)
    cut = graph.copy()
    cut.remove_edge(b, c)
    side = sorted(nx.node_connected_component(cut, c))
    axis = (positions_nm[c] - positions_nm[b]) / np.linalg.norm(positions_nm[c] - positions_nm[b])
    arm = positions_nm[side] - positions_nm[c]
    out = positions_nm.copy()
    along = np.outer(arm @ axis, axis) * (1.0 - np.cos(angle))
    out[side] = positions_nm[c] + arm * np.cos(angle) + np.cross(axis, arm) * np.sin(angle) + along
    return out


def _turned_apart(positions_nm: FloatArray, quad: Sequence[int], angle: float, graph: nx.Graph) -> FloatArray:
    """Return `turned` positions, unless atoms that this moves against each other then collide."""
    out = turned(positions_nm, quad, angle, graph)
    before, apart = (np.linalg.norm(at[:, None] - at, axis=-1) for at in (positions_nm, out))
    return positions_nm if apart[np.abs(apart - before) > 1e-9].min(initial=np.inf) < _CLASH_NM else out


def turn_torsions(scene: Scene, states_nm: FloatArray, every: int, rng: np.random.Generator) -> None:
    """Turn one torsion, rotors' too, of each `every`-th of the states `(n, n_atoms, 3)` nm to any angle, in place;
    where atoms would collide a state is left as it is."""
    torsions, graph = rotatable_torsions(scene, rotors=True), bonded_graph(scene)
    for k in range(0, len(states_nm) if len(torsions) else 0, every):
        quad = torsions[rng.integers(len(torsions))]
        states_nm[k] = _turned_apart(states_nm[k], quad, rng.uniform(-np.pi, np.pi), graph)


def rotatable_torsions(scene: Scene, *, rotors: bool = False) -> IntArray:
    """Return one torsion per rotatable bond, `(k, 4)`, sorted by its middle bond.

    Rotatable: single, in no ring, no amide C-N, heavy atoms beyond both ends. `rotors` adds bonds to groups whose only
    further atoms are hydrogens (methyl, hydroxyl, NH3). The outer atoms are heavy where they can be.
    """
    graph = bonded_graph(scene)
    in_ring = {(i, j) for i, j in ring_bonds(scene).tolist()}
    amide = {(min(r[1], r[2]), max(r[1], r[2])) for r in backbone_torsions(scene)["omega"].tolist()}
    rank = atom_classes(scene)
    rows = []
    for (b, c), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        if order > 1 or (b, c) in in_ring or (b, c) in amide:
            continue
        ends = []
        for atom, other in ((b, c), (c, b)):
            far = [j for j in graph[atom] if j != other]
            heavy = [j for j in far if scene.elements[j] != "H"]
            pool = heavy or (far if rotors else [])
            ends.append(max(pool, key=lambda j: (rank[j], -j)) if pool else -1)
        if -1 not in ends:
            rows.append((ends[0], b, c, ends[1]))
    return np.array(rows, dtype=np.int64).reshape(-1, 4)
