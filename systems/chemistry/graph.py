"""The bonded graph of a scene and what follows from it: classes of equivalent atoms, key, stereocentres, torsions,
exclusions, and the matching of one scene's atoms to another's.

Equivalence is by colour refinement (Weisfeiler and Lehman, 1968) on elements and ring sizes; stereocentres are atoms
whose neighbours all differ, their handedness enters the colours, and the refinement goes on until nothing new appears.
Axial chirality (allenes, hindered biaryls) and centres that only a fused ring system tells apart are not seen. RDKit's
canonical ranks tell apart equivalent atoms of rings (8 classes for 1,4-dimethylcyclohexane, which has 6), and training
runs without RDKit.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import networkx as nx
import numpy as np

from systems.chemistry.geometry import signed_volumes, torsion
from systems.errors import OutOfDomainError
from systems.scene import FloatArray, IntArray, Scene, once_per_scene

_LARGEST_RING = 12
_CC_DOUBLE_NM = 0.141
# Atoms that a turned torsion brings nearer than this are no state of the molecule.
_CLASH_NM = 0.14


@dataclass(frozen=True)
class AtomClasses:
    """Canonical colours `(n_atoms,)`, equal for equivalent atoms, and the stereocentres they reveal. `centres`: rows
    (centre, a, b, c), neighbours by falling colour, hydrogen last, the fourth left out."""

    colours: tuple[int, ...]
    centres: tuple[tuple[int, int, int, int], ...]

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
    Bond orders and atomic charges are left out: programs differ in them for one and the same molecule."""
    graph = bonded_graph(scene)
    rings = ring_sizes(graph)
    neighbours = scene.neighbours()
    labels = {(i, j): rings.get((min(i, j), max(i, j)), 0) for i in range(scene.n_atoms) for j in neighbours[i]}
    colours = _refine([_hash(e, len(n)) for e, n in zip(scene.elements, neighbours, strict=True)], neighbours, labels)
    if not stereo:
        return AtomClasses(tuple(colours), ())
    flip = -1 if mirrored else 1
    cycles = _lone_cycles(rings)
    double = {pair for pair in _double_bonds(scene) if pair not in rings}
    x = scene.positions_nm
    centres: dict[int, tuple[int, int, int, int]] = {}
    done: set[tuple[int, int]] = set()
    while True:
        marks: dict[int, list[object]] = {}
        fresh = _fresh_centres(scene.elements, neighbours, colours, set(centres))
        for row in fresh:
            centres[row[0]] = row
            marks[row[0]] = [flip * _sign(x, row)]
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
    return AtomClasses(tuple(colours), tuple(centres[i] for i in sorted(centres)))


def _hash(*parts: object) -> int:
    return int.from_bytes(hashlib.sha256(repr(parts).encode()).digest()[:8], "big")


def _refine(colours: list[int], neighbours: list[list[int]], labels: dict[tuple[int, int], int]) -> list[int]:
    n_classes = len(set(colours))
    while True:
        refined = [_hash(c, sorted((labels[i, j], colours[j]) for j in neighbours[i])) for i, c in enumerate(colours)]
        if len(set(refined)) == n_classes:
            return refined
        colours, n_classes = refined, len(set(refined))


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


# Between two atoms of at most two bonds: nitriles 0.116 nm, alkynes 0.121, azides 0.113, isocyanates 0.117, 0.121. Of a
# carbon that bears hydrogen to N or O: aldehydes 0.121, imines 0.128; in aromatic rings 0.132 and more. And the longest
# step of MD at quantum level with such a bond.
_TRIPLE_NM, _DOUBLE_NM, STIFF_STEP_PS = 0.1225, 0.130, 0.002
STIFF_BOND = "a bond this stiff (triple, aldehyde, imine, =CH2, CH=CH, C=O in a small ring)"
# Of CH=CH: shorter than in rings with five delocalised bonds, and than in benzene.
_VINYL_NM, _RING_NM = 0.136, 0.1385


def has_stiff_bond(scene: Scene) -> bool:
    """Return whether MD with heavy hydrogens cannot take steps of 4 fs: for a bond that is triple or one of two double
    bonds of an atom (2,000 to 2,300 per cm), or for a double bond of a carbon that gave mass to its hydrogens: of
    aldehydes, imines, =CH2 and CH=CH, in rings of furan's and thiazole's kind, too, but not in benzene's; and for the
    carbonyl of a ring of four, and imides and anhydrides in rings of five. Near 1,850 per cm four steps are a period,
    which is a resonance. Orders, lengths and numbers of bonds tell."""
    degree, order = (
        np.bincount(scene.bonds.ravel(), weights=weights, minlength=scene.n_atoms)
        for weights in (None, np.repeat(scene.bond_orders, 2))
    )
    if (scene.bond_orders == 3.0).any() or ((degree == 2) & (order == 4.0)).any():
        return True
    element = np.array(scene.elements)
    i, j = np.concatenate([scene.bonds, scene.bonds[:, ::-1]]).T
    n_hydrogens = np.bincount(i[element[j] == "H"], minlength=scene.n_atoms)
    if ((element == "C") & (degree == 3) & (n_hydrogens == 2)).any():
        return True
    length = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=-1)
    triple = (degree[i] <= 2) & (degree[j] <= 2) & (element[i] != "H") & (element[j] != "H") & (length < _TRIPLE_NM)
    double = (n_hydrogens[i] > 0) & (element[i] == "C") & np.isin(element[j], ("N", "O")) & (length < _DOUBLE_NM)
    # Cyclohexene flies apart at 4 fs; furan's and thiazole's CH=CH vibrate 1.4 times as far as at 2 fs, pyrrole's not.
    with_o, with_other = (
        np.bincount(i[np.isin(element[j], of)], minlength=scene.n_atoms) for of in ("O", ("N", "O", "S"))
    )
    both = (element[i] == "C") & (element[j] == "C") & (n_hydrogens[i] > 0) & (n_hydrogens[j] > 0)
    near_others = (with_o[i] > 0) | ((with_other[i] > 0) & (with_other[j] > 0))
    both &= (degree[i] == 3) & (degree[j] == 3) & (length < np.where(near_others, _RING_NM, _VINYL_NM))
    return bool((triple | double | both).any()) or _has_strained_carbonyl(scene)


def _has_strained_carbonyl(scene: Scene) -> bool:
    """Return whether a carbonyl is in a ring of four or less, or two are on one atom in a ring of five."""
    i, j = np.concatenate([scene.bonds, scene.bonds[:, ::-1]]).T
    element, degree = np.array(scene.elements), np.array([len(near) for near in scene.neighbours()])
    carbonyls = set(i[(element[i] == "C") & (degree[i] == 3) & (element[j] == "O") & (degree[j] == 1)].tolist())
    on: dict[int, int] = {}
    for (a, b), size in ring_sizes(bonded_graph(scene)).items() if carbonyls else ():
        if size <= 4 and {a, b} & carbonyls:
            return True
        for carbon, other in ((a, b), (b, a)):
            if size == 5 and carbon in carbonyls and element[other] in ("N", "O"):
                on[other] = on.get(other, 0) + 1
    return max(on.values(), default=0) > 1


def ring_sizes(graph: nx.Graph) -> dict[tuple[int, int], int]:
    """Return the size of the smallest ring through each ring bond (i < j); 13 for all larger ones."""
    acyclic = {(min(e), max(e)) for e in nx.bridges(graph)}
    sizes = {}
    for i, j in ((min(e), max(e)) for e in graph.edges):
        if (i, j) not in acyclic:
            others = nx.restricted_view(graph, [], [(i, j)])
            sizes[i, j] = min(nx.shortest_path_length(others, i, j) + 1, _LARGEST_RING + 1)
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
    """Cis and trans on rings whose two directions are alike (1,4-dimethylcyclohexane), which hold no stereocentre. The
    sign of (previous, next, higher substituent) changes with the direction of the walk; products of two do not."""
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


# ---- what the graph says -------------------------------------------------------------------------------------------


@once_per_scene
def molecule_key(scene: Scene) -> str:
    """Return a hash of elements, connectivity, total charge and stereo, 16 hexadecimal digits. Free of atom order,
    names, positions, bond orders and the atom a charge is drawn on; enantiomers, diastereomers and E/Z isomers differ.
    Of a model system it is a hash of the law, particle by particle."""
    record: tuple[object, ...] = (classify(scene).fingerprint, int(scene.formal_charges.sum()))
    if scene.interactions is not None:
        record = (*record, json.dumps(scene.interactions, sort_keys=True), scene.masses_da.tolist())
    return hashlib.sha256(repr(record).encode()).hexdigest()[:16]


@once_per_scene
def atom_classes(scene: Scene) -> IntArray:
    """Return a class number per atom `(n_atoms,)`: equal for atoms that connectivity and stereo do not tell apart.
    Numbers run from 0 in an order that is canonical for the molecule."""
    colours = classify(scene).colours
    rank = {c: k for k, c in enumerate(sorted(set(colours)))}
    return np.array([rank[c] for c in colours], dtype=np.int64)


@once_per_scene
def stereocentres(scene: Scene) -> IntArray:
    """Return the stereocentres as rows (centre, a, b, c), `(k, 4)`, neighbours in canonical order: the sign of
    `geometry.signed_volumes` is the same for one molecule in any atom order and opposite for its mirror image."""
    return np.array(classify(scene).centres, dtype=np.int64).reshape(-1, 4)


@once_per_scene
def ring_bonds(scene: Scene) -> IntArray:
    """Return the bonds that lie in a ring, `(k, 2)` with i < j."""
    graph = bonded_graph(scene)
    bridges = {(min(e), max(e)) for e in nx.bridges(graph)}
    rows = [(i, j) for i, j in scene.bonds.tolist() if (min(i, j), max(i, j)) not in bridges]
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def backbone_torsions(scene: Scene) -> dict[str, IntArray]:
    """Return the peptide torsions `phi`, `psi`, `omega`, each `(k, 4)`, ordered along the chain. Found from the graph:
    C(=O)-N-CA-C(=O) and N-CA-C(=O)-N, with omega (X, C, N, Y) about every C(=O)-N bond between carbons (caps included).
    CA has no multiple bond in a ring: caffeine and picolinamide are no peptides."""
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


def beyond(graph: nx.Graph, b: int, c: int) -> set[int]:
    """Return the atoms on the side of `c` of a bond to `b` in no ring, `c` among them."""
    cut = graph.copy()
    cut.remove_edge(b, c)
    return set(nx.node_connected_component(cut, c))


def turned(positions_nm: FloatArray, quad: Sequence[int], angle: float, graph: nx.Graph) -> FloatArray:
    """Return positions `(n_atoms, 3)` with what hangs beyond a torsion's middle bond turned about it, so that the
    torsion grows by `angle` (radian). `graph`: `bonded_graph`, which the bond must hold together."""
    _, b, c, _ = (int(k) for k in quad)
    side = sorted(beyond(graph, b, c))
    axis = (positions_nm[c] - positions_nm[b]) / np.linalg.norm(positions_nm[c] - positions_nm[b])
    arm = positions_nm[side] - positions_nm[c]
    out = positions_nm.copy()
    along = np.outer(arm @ axis, axis) * (1.0 - np.cos(angle))
    out[side] = positions_nm[c] + arm * np.cos(angle) + np.cross(axis, arm) * np.sin(angle) + along
    return out


def turn_torsions(scene: Scene, states_nm: FloatArray, every: int, rng: np.random.Generator) -> None:
    """Turn one torsion, rotors' too, of each `every`-th of the states `(n, n_atoms, 3)` nm to any angle, in place,
    where no atoms collide."""
    torsions, graph = rotatable_torsions(scene, rotors=True), bonded_graph(scene)
    for k in range(0, len(states_nm) if len(torsions) else 0, every):
        quad = torsions[rng.integers(len(torsions))]
        out = turned(states_nm[k], quad, rng.uniform(-np.pi, np.pi), graph)
        before, apart = (np.linalg.norm(at[:, None] - at, axis=-1) for at in (states_nm[k], out))
        if apart[np.abs(apart - before) > 1e-9].min(initial=np.inf) >= _CLASH_NM:
            states_nm[k] = out


def rotatable_torsions(scene: Scene, *, rotors: bool = False) -> IntArray:
    """Return one torsion per rotatable bond, `(k, 4)`, sorted by its middle bond: single, in no ring, no amide C-N,
    heavy atoms beyond both ends. `rotors` adds bonds to groups whose only further atoms are hydrogens. The outer atoms
    are heavy where they can be."""
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


# ---- matching: a graph isomorphism that keeps every chirality -------------------------------------------------------


_PATIENCE = 50_000
_FLAT = 0.05
_WRONG_HAND = 1000.0


def match_atoms(scene: Scene, template: Scene) -> IntArray:
    """Return `order (n_atoms,)` such that template atom k is scene atom `order[k]`.

    Elements, connectivity, total charge and stereo must agree; names, order, residues and bond orders play no part.
    Every four-coordinate atom keeps its handedness, prochiral groups and methyl hydrogens included, so that
    `positions_nm[order]` superposes on the template with no group inverted; rotors and planar NH2 take the labelling
    nearest in torsion. Particles of a model system are matched in their order. Raises OutOfDomainError with the reason.
    """
    if scene.interactions != template.interactions:
        raise OutOfDomainError(f"{scene.name} and {template.name} are under different laws: not the same model system.")
    if scene.interactions is not None:
        return np.arange(scene.n_atoms)
    if sorted(scene.elements) != sorted(template.elements):
        raise OutOfDomainError(f"{scene.name} is {scene.formula}, but {template.name} is {template.formula}.")
    charges = int(scene.formal_charges.sum()), int(template.formal_charges.sum())
    if charges[0] != charges[1]:
        raise OutOfDomainError(f"{scene.name} has charge {charges[0]:+d}, but {template.name} has {charges[1]:+d}.")
    classes, wanted = classify(scene), classify(template)
    if classes.fingerprint != wanted.fingerprint:
        raise OutOfDomainError(_why_not(scene, template, wanted))
    ours, theirs = _Side.of(scene, classes), _Side.of(template, wanted)
    found = None
    for check_planar in (True, False):
        found = _match_skeletons(ours, theirs, check_planar)
        if found is not None:
            break
    if found is None:
        raise OutOfDomainError(f"{scene.name} is a stereoisomer of {template.name}, not the same molecule.")
    return _match_hydrogens(ours, theirs, found)


def _why_not(scene: Scene, template: Scene, theirs: AtomClasses) -> str:
    if classify(scene, stereo=False).fingerprint != classify(template, stereo=False).fingerprint:
        return f"{scene.name} has the formula of {template.name} ({template.formula}) but other bonds."
    if classify(scene, mirrored=True).fingerprint == theirs.fingerprint:
        return f"{scene.name} is the mirror image (enantiomer) of {template.name}."
    return f"{scene.name} is a stereoisomer of {template.name}: some stereocentres or double bonds differ."


@dataclass(frozen=True, eq=False)
class _Side:
    """One of the two molecules as the search sees it; `leaves` are hydrogens with one bond, to a heavy atom."""

    positions_nm: FloatArray
    near: list[list[int]]
    colours: tuple[int, ...]
    leaves: frozenset[int]

    @staticmethod
    def of(scene: Scene, classes: AtomClasses) -> _Side:
        near, symbol = scene.neighbours(), scene.elements
        leaves = (i for i, on in enumerate(near) if symbol[i] == "H" and len(on) == 1 and symbol[on[0]] != "H")
        return _Side(scene.positions_nm, near, classes.colours, frozenset(leaves))


# Four template atoms, whether they span a planar bond or a stereocentre, and the sign that the image must keep.
_Check = tuple[tuple[int, int, int, int], bool, bool]


def _positive(positions_nm: FloatArray, quads: list[list[int]], planar: bool) -> bool:
    if planar:
        return bool(np.cos(torsion(positions_nm, quads)[0]) > 0)
    return bool(signed_volumes(positions_nm, quads)[0] > 0)


def _match_skeletons(ours: _Side, theirs: _Side, check_planar: bool) -> dict[int, int] | None:
    """Depth-first search over all atoms but terminal hydrogens, in breadth-first order, which puts equivalent atoms
    side by side: a wrong choice shows within a few atoms. `_PATIENCE` bounds what is left."""
    atoms = _walk(theirs)
    rank = {i: k for k, (i, _) in enumerate(atoms)}
    checks: dict[int, list[_Check]] = {}
    for check in _checks(theirs, set(rank), check_planar):
        checks.setdefault(max(check[0], key=lambda i: rank[i]), []).append(check)
    by_colour: dict[int, list[int]] = {}
    for i, colour in enumerate(ours.colours):
        if i not in ours.leaves:
            by_colour.setdefault(colour, []).append(i)
    image: dict[int, int] = {}
    used: set[int] = set()

    def candidates(k: int) -> Iterator[int]:
        atom, parent = atoms[k]
        pool = by_colour.get(theirs.colours[atom], []) if parent is None else ours.near[image[parent]]
        mapped = [image[j] for j in theirs.near[atom] if j in image]
        for i in pool:
            if i not in used and ours.colours[i] == theirs.colours[atom] and all(j in ours.near[i] for j in mapped):
                yield i

    if not atoms:
        return image
    stack = [candidates(0)]
    for _ in range(_PATIENCE + 20 * len(atoms)):
        atom = atoms[len(stack) - 1][0]
        if atom in image:
            used.discard(image.pop(atom))
        choice = next(stack[-1], None)
        if choice is None:
            stack.pop()
            if not stack:
                return None
            continue
        image[atom] = choice
        used.add(choice)
        if all(
            _positive(ours.positions_nm, [[image[i] for i in quad]], planar) == positive
            for quad, planar, positive in checks.get(atom, [])
        ):
            if len(stack) == len(atoms):
                return image
            stack.append(candidates(len(stack)))
    return None


def _walk(side: _Side) -> list[tuple[int, int | None]]:
    """Atoms but terminal hydrogens in breadth-first order, rare classes first, each with its parent."""
    kept = nx.Graph()
    kept.add_nodes_from(i for i in range(len(side.near)) if i not in side.leaves)
    kept.add_edges_from((i, j) for i in list(kept) for j in side.near[i] if j not in side.leaves)
    count = Counter(side.colours[i] for i in kept)
    parents: dict[int, int | None] = {}
    for start in sorted(kept, key=lambda i: (count[side.colours[i]], i)):
        if start not in parents:
            parents[start] = None
            parents.update((atom, parent) for parent, atom in nx.bfs_edges(kept, start))
    return list(parents.items())


def _checks(side: _Side, kept: set[int], check_planar: bool) -> Iterator[_Check]:
    x, near = side.positions_nm, side.near
    for i in kept:
        heavy = [j for j in near[i] if j in kept]
        if len(near[i]) == 4 and len(heavy) >= 3:
            quad = (i, heavy[0], heavy[1], heavy[2])
            yield quad, False, _positive(x, [list(quad)], False)
    if not check_planar:
        return
    for b, c in ((b, c) for b, on in enumerate(near) for c in on if b < c):
        if b not in kept or c not in kept or len(near[b]) != 3 or len(near[c]) != 3:
            continue
        left = [j for j in near[b] if j != c and j in kept]
        right = [j for j in near[c] if j != b and j in kept]
        tied = any(len(pair) == 2 and side.colours[pair[0]] == side.colours[pair[1]] for pair in (left, right))
        if tied and left and right and _is_flat(x, b, near[b]) and _is_flat(x, c, near[c]):
            quad = (left[0], b, c, right[0])
            yield quad, True, _positive(x, [list(quad)], True)


def _is_flat(x: FloatArray, i: int, near: list[int]) -> bool:
    a, b, c = (x[j] - x[i] for j in near)
    size = float(np.linalg.norm(a) * np.linalg.norm(b) * np.linalg.norm(c))
    return abs(float(np.dot(np.cross(a, b), c))) < 5 * _FLAT * size


def _match_hydrogens(ours: _Side, theirs: _Side, image: dict[int, int]) -> IntArray:
    full = dict(image)
    for parent in image:
        free = [j for j in ours.near[image[parent]] if j in ours.leaves]
        hydrogens = [j for j in theirs.near[parent] if j in theirs.leaves]
        if not hydrogens:
            continue
        rows = _hydrogen_rows(theirs.near, full, parent, hydrogens)

        def cost(chosen: tuple[int, ...], hydrogens: list[int] = hydrogens, rows: _Rows = rows) -> float:
            trial = full | dict(zip(hydrogens, chosen, strict=True))
            total = 0.0
            for row, planar in rows:
                mapped = [[trial[i] for i in row]]
                if planar:
                    gap = torsion(ours.positions_nm, mapped)[0] - torsion(theirs.positions_nm, [row])[0]
                    total += 1.0 - float(np.cos(gap))
                elif _positive(ours.positions_nm, mapped, False) != _positive(theirs.positions_nm, [row], False):
                    total += _WRONG_HAND
            return total

        best = min(permutations(free), key=cost) if len(free) > 1 else tuple(free)
        full.update(zip(hydrogens, best, strict=True))
    return np.array([full[k] for k in range(len(theirs.near))], dtype=np.int64)


_Rows = list[tuple[list[int], bool]]


def _hydrogen_rows(near: list[list[int]], mapped: dict[int, int], parent: int, hydrogens: list[int]) -> _Rows:
    """What the labelling of `hydrogens` on `parent` should keep: handedness (False) first, torsions (True) second."""
    rows: _Rows = []
    others = [j for j in near[parent] if j not in hydrogens]
    if len(near[parent]) == 4 and len(hydrogens) >= 2:
        inputs = [*others, *hydrogens][-3:]
        rows.append(([parent, *inputs], False))
    for b in others:
        far = [a for a in near[b] if a != parent and a in mapped]
        if far:
            rows.extend(([far[0], b, parent, h], True) for h in hydrogens)
            break
    return rows
