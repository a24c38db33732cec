"""The cheapest Lewis structure of a connectivity: bond orders and formal charges by integer programming."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import networkx as nx
import numpy as np
import numpy.typing as npt

# (valence, charge, penalty) by element and number of neighbours. As in antechamber's bond type perception (Wang, Wang,
# Kollman and Case, J. Mol. Graph. Model. 2006, 25, 247) a penalty says how unusual a state is; here every state is
# closed-shell and carries its formal charge. Carbon carries none: one that seems to be charged misses a hydrogen.
_State = tuple[int, int, float]
_ANY: dict[str, dict[int, tuple[_State, ...]]] = {
    "H": {1: ((1, 0, 0.0),)},
    "B": {3: ((3, 0, 0.0),), 4: ((4, -1, 0.0),)},
    "C": {2: ((4, 0, 0.0),), 3: ((4, 0, 0.0),), 4: ((4, 0, 0.0),)},
    "N": {1: ((3, 0, 0.0),), 2: ((3, 0, 0.0), (4, 1, 18.0), (2, -1, 14.0)), 3: ((3, 0, 0.0), (4, 1, 12.0)),
          4: ((4, 1, 0.0),)},
    "O": {1: ((2, 0, 0.0), (1, -1, 10.0)), 2: ((2, 0, 0.0),), 3: ((3, 1, 0.0),)},
    "F": {1: ((1, 0, 0.0),)},
    "Si": {4: ((4, 0, 0.0),), 5: ((5, -1, 0.0),), 6: ((6, -2, 0.0),)},
    "P": {1: ((3, 0, 0.0),), 2: ((3, 0, 0.0),), 3: ((3, 0, 0.0), (5, 0, 5.0)), 4: ((5, 0, 0.0), (4, 1, 10.0)),
          5: ((5, 0, 0.0),), 6: ((6, -1, 0.0),)},
    "S": {1: ((2, 0, 0.0), (1, -1, 9.0)), 2: ((2, 0, 0.0), (4, 0, 15.0), (3, 1, 25.0)),
          3: ((4, 0, 0.0), (3, 1, 6.0), (6, 0, 6.0)), 4: ((6, 0, 0.0), (5, 1, 6.0), (4, 0, 12.0)), 5: ((6, 0, 0.0),),
          6: ((6, 0, 0.0),)},
    "Cl": {1: ((1, 0, 0.0),), 2: ((3, 0, 5.0), (2, 1, 8.0)), 3: ((5, 0, 0.0), (3, 0, 5.0)), 4: ((7, 0, 0.0),)},
}  # fmt: skip
_ANY |= {"Se": _ANY["S"], "Br": _ANY["Cl"], "I": _ANY["Cl"]}
# Nitrogen between a heavy atom and a terminal one: of azides, diazo groups, nitrile oxides, diazonium.
_MIDDLE: tuple[_State, ...] = ((3, 0, 0.0), (4, 1, 12.0), (2, -1, 14.0))
# Four pi electrons of a five-ring take two more (cyclopentadienide); elsewhere a flat carbon is a cation (trityl).
_CARBENIUM: _State = (3, 1, 25.0)
_CARBANION: _State = (3, -1, 30.0)
_CYCLOPENTADIENIDE: _State = (3, -1, 20.0)
_CYANIDE: _State = (3, -1, 20.0)
_AZIDE_END: _State = (2, -1, 13.0)
_OXONIUM: _State = (3, 1, 22.0)
_OZONE: _State = (3, 1, 0.0)
# Real molecules take milliseconds; a protein without its hydrogens may be hopeless.
_LONGEST_S = 30.0
# Of a net charge on a group of conjugated atoms, an elementary charge.
_NET_CHARGE = 4.0
# Ties: an order other than the file's, bonds that rarely are double, hydrogens on a nitrogen that takes a charge.
_OTHER_ORDER = 0.1
_UNUSUAL = {frozenset("NO"): 0.0, frozenset("CO"): 0.02, frozenset("CN"): 0.03, frozenset("C"): 0.04,
            frozenset("CS"): 0.05}  # fmt: skip
_HYDROGEN_ON_CATION = -0.02


def is_usual(elements: Sequence[str], neighbours: Sequence[Sequence[int]], i: int, valence: int, charge: int) -> bool:
    """Whether atom `i` may have this valence and charge without a doubt: a state of the table, no anion of nitrogen."""
    known = any(s[:2] == (valence, charge) for s in _ANY.get(elements[i], {}).get(len(neighbours[i]), ()))
    return known and not (elements[i] == "N" and charge < 0)


def lewis_structure(
    elements: Sequence[str],
    bonds: npt.NDArray[np.int64],
    *,
    stated: Mapping[tuple[int, int], int] | None = None,
    total_charge: int | None = None,
    carbon_ions: bool = False,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]] | None:
    """Return bond orders `(n_bonds,)` and formal charges `(n_atoms,)` of the structure of least penalty, or None.

    Every hydrogen must be present; no atom keeps an unpaired electron. `stated` holds orders that a file gives pairs
    i < j, which decide between structures that are otherwise alike; `total_charge` is the only one allowed.
    `carbon_ions` admits carbocations and carbanions.
    """
    pairs = [(min(i, j), max(i, j)) for i, j in bonds.tolist()]
    graph = nx.Graph(pairs)
    graph.add_nodes_from(range(len(elements)))
    neighbours = [sorted(graph[i]) for i in range(len(elements))]
    rings = _oxonium_rings(elements, graph)
    states = [_states(elements, graph, neighbours, i, rings, carbon_ions) for i in range(len(elements))]
    if not all(states):
        return None
    orders = np.ones(len(pairs))
    charges = np.array([s[0][1] for s in states], dtype=np.int64)
    unsettled = [i for i, s in enumerate(states) if len(s) > 1 or s[0][0] != len(neighbours[i])]
    rest = None if total_charge is None else total_charge - int(charges.sum() - charges[unsettled].sum())
    if not unsettled:
        return None if rest else (orders, charges)
    room = {i for i in unsettled if max(s[0] for s in states[i]) > len(neighbours[i])}
    open_bonds = [
        k
        for k, (i, j) in enumerate(pairs)
        if {i, j} <= room and ((stated or {}).get((i, j), 1) > 1 or not _is_ylide(elements, neighbours, i, j))
    ]
    solved = _solve(elements, neighbours, states, unsettled, [pairs[k] for k in open_bonds], stated or {}, rest)
    if solved is None:
        return None
    extra, chosen = solved
    orders[open_bonds] += extra
    charges[unsettled] = chosen
    return orders, charges


def _states(
    elements: Sequence[str],
    graph: nx.Graph,
    neighbours: Sequence[Sequence[int]],
    i: int,
    rings: set[int],
    carbon_ions: bool,
) -> tuple[_State, ...]:
    symbol, near = elements[i], neighbours[i]
    states = _ANY.get(symbol, {}).get(len(near), ())
    around = [(elements[j], len(neighbours[j])) for j in near]
    if symbol == "C" and len(near) == 2 and _in_small_ring(graph, i):
        return ()  # as bent as no triple bond or cumulene is: a ring that misses a hydrogen
    if symbol == "C" and len(near) == 1 and around[0] in (("N", 1), ("N", 2), ("O", 1)):
        states = (_CYANIDE,)
    elif symbol == "C" and carbon_ions:
        anion = _CYCLOPENTADIENIDE if len(near) == 3 and _in_five_ring(graph, i) else _CARBANION
        states = (*states, anion, *((_CARBENIUM,) if len(near) == 3 else ()))
    elif symbol == "N" and len(near) == 2 and any(e != "H" and degree == 1 for e, degree in around):
        states = _MIDDLE
    elif symbol == "N" and len(near) == 1 and around[0][0] in ("N", "P", "S"):
        states = (*states, _AZIDE_END)
    elif symbol == "O" and around == [("O", 1)] * 2:
        states = (_OZONE,)
    elif symbol == "O" and (i in rings or around == [("C", 1)]):
        states = (*states, _OXONIUM)
    return states


def _is_ylide(elements: Sequence[str], neighbours: Sequence[Sequence[int]], i: int, j: int) -> bool:
    """Whether a double bond between these would be one of carbon and hypervalent S, Se or P."""
    return any(
        elements[a] == "C" and elements[b] in ("S", "Se", "P") and len(neighbours[b]) >= 3 for a, b in ((i, j), (j, i))
    )


def _in_small_ring(graph: nx.Graph, i: int) -> bool:
    """Whether an atom with two neighbours is in a ring of fewer than eight."""
    a, b = graph[i]
    near = nx.single_source_shortest_path_length(nx.restricted_view(graph, [i], []), a, cutoff=5)
    return b in near


def _in_five_ring(graph: nx.Graph, i: int) -> bool:
    rest = nx.restricted_view(graph, [i], [])
    reached = {j: nx.single_source_shortest_path_length(rest, j, cutoff=3) for j in graph[i]}
    return any(reached[j].get(k) == 3 for j in graph[i] for k in graph[i])


def _oxonium_rings(elements: Sequence[str], graph: nx.Graph) -> set[int]:
    """Oxygens of six-rings without a saturated member (pyrylium, flavylium), which may take a third bond."""
    found: set[int] = set()
    flat = graph.subgraph(
        i for i in graph if (elements[i] in ("C", "N") and graph.degree(i) in (2, 3)) or
        (elements[i] == "O" and graph.degree(i) == 2)
    )  # fmt: skip
    for i in flat:
        if elements[i] == "O" and flat.degree(i) == 2:
            a, b = flat[i]
            rest = flat.subgraph(j for j in flat if j != i)
            if nx.has_path(rest, a, b) and nx.shortest_path_length(rest, a, b) == 4:
                found.add(i)
    return found


def _solve(
    elements: Sequence[str],
    neighbours: Sequence[Sequence[int]],
    states: Sequence[tuple[_State, ...]],
    atoms: Sequence[int],
    bonds: Sequence[tuple[int, int]],
    stated: Mapping[tuple[int, int], int],
    total: int | None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]] | None:
    """Return the orders of `bonds` beyond one and the charges of `atoms` of least penalty, None where nothing fits."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import lil_matrix

    choices = [(k, s) for k, i in enumerate(atoms) for s in states[i]]
    conjugated = nx.Graph(bonds)
    conjugated.add_nodes_from(atoms)
    groups = [set(group) for group in nx.connected_components(conjugated)]
    n_atoms, n_bonds = len(atoms), len(bonds)
    first_sum = 2 * n_bonds + len(choices)
    n = first_sum + len(groups)
    row_of = {i: k for k, i in enumerate(atoms)}
    # Columns: a second and a third bond of each pair, the states, |charge| of each group.
    cost = np.zeros(n)
    # Rows: one state an atom; valence; a third bond needs a second; |charge| of each group, twice; the total.
    third, net = 2 * n_atoms, 2 * n_atoms + n_bonds
    matrix = lil_matrix((net + 2 * len(groups) + (total is not None), n))
    low, high = np.zeros(matrix.shape[0]), np.zeros(matrix.shape[0])
    low[:n_atoms] = high[:n_atoms] = 1.0
    for k, (i, j) in enumerate(bonds):
        cost[[k, n_bonds + k]] = _UNUSUAL.get(frozenset((elements[i], elements[j])), 0.06)
        if (wanted := stated.get((i, j))) is not None:
            cost[k] += _OTHER_ORDER if wanted < 2 else -_OTHER_ORDER
            cost[n_bonds + k] += _OTHER_ORDER if wanted < 3 else -_OTHER_ORDER
        for end in (i, j):
            matrix[n_atoms + row_of[end], [k, n_bonds + k]] = 1.0
        matrix[third + k, k], matrix[third + k, n_bonds + k] = 1.0, -1.0
        high[third + k] = 1.0
    for c, (k, (valence, charge, penalty)) in enumerate(choices):
        i, column = atoms[k], 2 * n_bonds + c
        hydrogens = sum(elements[j] == "H" for j in neighbours[i]) if elements[i] == "N" and charge > 0 else 0
        cost[column] = penalty + _HYDROGEN_ON_CATION * hydrogens
        matrix[k, column] = 1.0
        matrix[n_atoms + k, column] = len(neighbours[i]) - valence
        group = next(g for g, members in enumerate(groups) if i in members)
        matrix[net + 2 * group, column], matrix[net + 2 * group + 1, column] = charge, -charge
        if total is not None:
            matrix[net + 2 * len(groups), column] = charge
    for g in range(len(groups)):
        cost[first_sum + g] = _NET_CHARGE
        matrix[[net + 2 * g, net + 2 * g + 1], first_sum + g] = -1.0
        low[[net + 2 * g, net + 2 * g + 1]] = -np.inf
    if total is not None:
        low[-1] = high[-1] = total
    whole, upper = np.ones(n), np.ones(n)
    whole[first_sum:], upper[first_sum:] = 0, np.inf
    found = milp(
        cost,
        integrality=whole,
        bounds=Bounds(np.zeros(n), upper),
        constraints=LinearConstraint(matrix.tocsr(), low, high),
        options={"time_limit": _LONGEST_S},
    )
    if found.status != 0:
        return None
    x = np.round(found.x)
    charges = np.zeros(n_atoms, dtype=np.int64)
    for c, (k, (_, charge, _)) in enumerate(choices):
        charges[k] += int(x[2 * n_bonds + c]) * charge
    return x[:n_bonds] + x[n_bonds : 2 * n_bonds], charges
