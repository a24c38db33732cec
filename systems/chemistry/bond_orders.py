"""Bond orders and formal charges from elements and connectivity, hydrogens included."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.lewis import is_usual, lewis_structure

_VALENCE = {"H": 1, "B": 3, "C": 4, "N": 3, "O": 2, "F": 1, "Si": 4, "P": 3, "S": 2, "Cl": 1, "Se": 2, "Br": 1, "I": 1}
_IONS = {"Li": 1, "Na": 1, "K": 1, "Rb": 1, "Cs": 1, "Mg": 2, "Ca": 2, "Sr": 2, "Ba": 2, "Zn": 2, "F": -1, "Cl": -1,
         "Br": -1, "I": -1, "Cu": 2, "Fe": 2, "Mn": 2, "Co": 2, "Ni": 2, "Cd": 2}  # fmt: skip

# |triple product| of three unit vectors (0.77 in a tetrahedron), and the cosine between two (-0.5 at 120 degrees).
_FLAT = 0.55
_STRAIGHT = -0.8


class ValenceError(ValueError):
    """Connectivity that fits no Lewis structure; `atoms` lists the atoms at fault."""

    def __init__(self, atoms: list[int]) -> None:
        super().__init__(f"no Lewis structure for atoms {atoms}")
        self.atoms = atoms


def perceive(
    elements: Sequence[str],
    bonds: npt.NDArray[np.int64],
    positions_nm: npt.NDArray[np.float64] | None = None,
    trusted: Collection[int] = (),
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return bond orders `(n_bonds,)` and formal charges `(n_atoms,)` of one Kekulé structure.

    Every hydrogen must be present. Open valences are paired by a maximum matching (C=O before C=N before C=C); what
    stays open is an anion on O and S, a cation on a nitrogen beside an open carbon (guanidinium, imidazolium). A
    molecule that this leaves with an atom in no usual state is given the Lewis structure of least penalty
    (`systems.chemistry.lewis`). With `positions_nm` `(n_atoms, 3)`, carbons that such a structure, a charge beside them
    or a C=C makes unsaturated must be flat or straight: one that is not misses a hydrogen, unless it is `trusted` to
    have all. Raises ValenceError naming the atoms that fit nothing (missing hydrogens, wrong bonds, unknown elements).
    """
    neighbours: list[list[int]] = [[] for _ in elements]
    for i, j in bonds.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)
    orders, charges, bad = _match(elements, bonds, neighbours)
    valence = np.zeros(len(elements))
    np.add.at(valence, bonds.ravel(), np.repeat(orders, 2))
    doubtful = set(bad) | {
        i
        for i, q in enumerate(charges.tolist())
        if neighbours[i] and not is_usual(elements, neighbours, i, round(valence[i]), q)
    }
    if positions_nm is not None:
        cations = [i for i in np.flatnonzero((charges > 0) & (valence == 4)).tolist() if elements[i] == "N"]
        double = [k for k, order in enumerate(orders) if order > 1 and all(elements[i] == "C" for i in bonds[k])]
        doubted = [*(j for i in cations for j in neighbours[i]), *bonds[double].ravel().tolist()]
        _refuse_bent(elements, neighbours, set(doubted) - set(trusted), positions_nm)
    if not doubtful:
        return orders, charges
    graph = nx.Graph(bonds.tolist())
    graph.add_nodes_from(range(len(elements)))
    for molecule in nx.connected_components(graph):
        if not molecule & doubtful:
            continue
        atoms = sorted(molecule)
        rank = {i: k for k, i in enumerate(atoms)}
        rows = [k for k, (i, _) in enumerate(bonds.tolist()) if i in rank]
        own = np.array([[rank[i], rank[j]] for i, j in bonds[rows].tolist()], dtype=np.int64).reshape(-1, 2)
        found = lewis_structure([elements[i] for i in atoms], own)
        if found is None and positions_nm is not None:  # with every carbon flat, one of them may be an ion
            found = lewis_structure([elements[i] for i in atoms], own, carbon_ions=True)
        if found is None:
            raise ValenceError(sorted(molecule & set(bad)) or sorted(molecule & doubtful))
        if positions_nm is not None:
            _refuse_bent(elements, neighbours, molecule - set(trusted), positions_nm)
        orders[rows], charges[atoms] = found
    return orders, charges


def bent_carbons(
    elements: Sequence[str],
    neighbours: Sequence[Sequence[int]],
    atoms: Collection[int],
    positions_nm: npt.NDArray[np.float64],
) -> list[int]:
    """Those of the atoms that are carbons with three neighbours and not flat, or with two and not straight."""
    bent = []
    for i in sorted(atoms):
        if elements[i] != "C" or len(neighbours[i]) not in (2, 3):
            continue
        arms = positions_nm[neighbours[i]] - positions_nm[i]
        arms = arms / np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-9)
        if (len(arms) == 3 and abs(float(np.linalg.det(arms))) > _FLAT) or (
            len(arms) == 2 and float(arms[0] @ arms[1]) > _STRAIGHT
        ):
            bent.append(i)
    return bent


def _refuse_bent(
    elements: Sequence[str],
    neighbours: Sequence[Sequence[int]],
    atoms: Collection[int],
    positions_nm: npt.NDArray[np.float64],
) -> None:
    bent = bent_carbons(elements, neighbours, atoms, positions_nm)
    if bent:
        raise ValenceError(bent)


def _match(
    elements: Sequence[str], bonds: npt.NDArray[np.int64], neighbours: list[list[int]]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64], list[int]]:
    """Orders and charges by matching, and the atoms that fit nothing."""
    charges = np.zeros(len(elements), dtype=np.int64)
    order = {(min(i, j), max(i, j)): 1 for i, j in bonds.tolist()}
    open_valence = [_open_valence(elements, neighbours, i, charges) for i in range(len(elements))]
    bad = [i for i, u in enumerate(open_valence) if u < 0]
    if not bad:
        _hypervalent(elements, neighbours, open_valence, order, charges)
        _pair(elements, neighbours, open_valence, order)
        _settle(elements, neighbours, open_valence, order, charges)
        bad = [i for i, u in enumerate(open_valence) if u > 0]
    orders = np.array([order[min(i, j), max(i, j)] for i, j in bonds.tolist()], dtype=np.float64)
    return orders, charges, bad


def _pair(
    elements: Sequence[str],
    neighbours: list[list[int]],
    open_valence: list[int],
    order: dict[tuple[int, int], int],
) -> None:
    while True:  # a second round makes triple bonds
        graph = nx.Graph()
        for i, j in order:
            if open_valence[i] > 0 and open_valence[j] > 0:
                graph.add_edge(i, j, weight=_preference(elements, neighbours, i, j))
        pairs = nx.max_weight_matching(graph, maxcardinality=True)
        if not pairs:
            break
        for a, b in pairs:
            order[min(a, b), max(a, b)] += 1
            open_valence[a] -= 1
            open_valence[b] -= 1


def _open_valence(elements: Sequence[str], neighbours: list[list[int]], i: int, charges: npt.NDArray[np.int64]) -> int:
    symbol, degree = elements[i], len(neighbours[i])
    if degree == 0 and symbol in _IONS:
        charges[i] = _IONS[symbol]
        return 0
    if symbol not in _VALENCE:
        return -1
    if symbol in ("P", "S", "Se") and degree >= 3:
        return 0
    if (symbol == "N" and degree == 4) or (symbol == "O" and degree == 3):
        charges[i] = 1
        return 0
    if symbol == "B" and degree == 4:
        charges[i] = -1
        return 0
    return _VALENCE[symbol] - degree


def _preference(elements: Sequence[str], neighbours: list[list[int]], i: int, j: int) -> int:
    pair = {elements[i], elements[j]}
    if pair == {"C", "O"}:
        return 9
    if "O" in pair:
        return 7
    if pair == {"C", "N"}:
        return 6
    if pair == {"C", "S"}:
        return 4
    return 5


def _hypervalent(
    elements: Sequence[str],
    neighbours: list[list[int]],
    open_valence: list[int],
    order: dict[tuple[int, int], int],
    charges: npt.NDArray[np.int64],
) -> None:
    """Nitro groups and the oxides of P and S, whose centres have no open valence of their own."""
    for i, symbol in enumerate(elements):
        ends = [j for j in neighbours[i] if elements[j] in ("O", "S") and len(neighbours[j]) == 1]
        degree = len(neighbours[i])
        room = 0
        if symbol == "N" and degree == 3 and len(ends) >= 2:
            room, charges[i] = 1, 1
        elif (symbol, degree) in (("P", 4), ("S", 3), ("Se", 3)):
            room = 1
        elif symbol in ("S", "Se") and degree == 4:
            room = 2
        made = 0
        for j in ends[:room]:
            order[min(i, j), max(i, j)] += 1
            open_valence[j] -= 1
            made += 1
        if symbol in ("S", "Se") and degree == 3 and not made:
            charges[i] = 1  # sulfonium
        if symbol == "P" and degree == 4 and not made:
            charges[i] = 1  # phosphonium


def _settle(
    elements: Sequence[str],
    neighbours: list[list[int]],
    open_valence: list[int],
    order: dict[tuple[int, int], int],
    charges: npt.NDArray[np.int64],
) -> None:
    """Give charges to what no double bond took."""
    for i, symbol in enumerate(elements):
        if open_valence[i] == 1 and symbol == "C":
            donors = [
                j
                for j in neighbours[i]
                if elements[j] == "N" and charges[j] == 0 and len(neighbours[j]) == 3 and open_valence[j] == 0
            ]
            if donors:
                donor = max(donors, key=lambda j: sum(elements[k] == "H" for k in neighbours[j]))
                order[min(i, donor), max(i, donor)] += 1
                open_valence[i] -= 1
                charges[donor] = 1
        elif open_valence[i] > 0 and symbol in ("O", "S", "N") and neighbours[i]:
            charges[i] -= open_valence[i]
            open_valence[i] = 0
