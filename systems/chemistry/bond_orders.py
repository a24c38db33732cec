"""Bond orders and formal charges from elements and connectivity, hydrogens included: the cheapest Lewis structure."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import networkx as nx
import numpy as np
import numpy.typing as npt

from systems.chemistry.graph import ring_sizes

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


def lewis_structure(
    elements: Sequence[str],
    bonds: npt.NDArray[np.int64],
    *,
    stated: Mapping[tuple[int, int], int] | None = None,
    total_charge: int | None = None,
    carbon_ions: bool = False,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]] | None:
    """Return bond orders `(n_bonds,)` and formal charges `(n_atoms,)` of the structure of least penalty, or None.

    Every hydrogen must be present; no atom keeps an unpaired electron. `stated`: orders that a file gives pairs i < j,
    which decide between structures that are otherwise alike; `total_charge`: the only one allowed; `carbon_ions` admits
    carbocations and carbanions.
    """
    pairs = [(min(i, j), max(i, j)) for i, j in bonds.tolist()]
    graph = nx.Graph(pairs)
    graph.add_nodes_from(range(len(elements)))
    neighbours = [sorted(graph[i]) for i in range(len(elements))]
    rings, oxonium = ring_sizes(graph), _oxonium(elements, graph)
    states = [_states(elements, neighbours, i, rings, oxonium, carbon_ions) for i in range(len(elements))]
    if not all(states):
        return None
    orders = np.ones(len(pairs))
    charges = np.array([s[0][1] for s in states], dtype=np.int64)
    unresolved = [i for i, s in enumerate(states) if len(s) > 1 or s[0][0] != len(neighbours[i])]
    rest = None if total_charge is None else total_charge - int(charges.sum() - charges[unresolved].sum())
    if not unresolved:
        return None if rest else (orders, charges)
    room = {i for i in unresolved if max(s[0] for s in states[i]) > len(neighbours[i])}
    open_bonds = [
        k
        for k, (i, j) in enumerate(pairs)
        if {i, j} <= room and ((stated or {}).get((i, j), 1) > 1 or not _is_ylide(elements, neighbours, i, j))
    ]
    solved = _solve(elements, neighbours, states, unresolved, [pairs[k] for k in open_bonds], stated or {}, rest)
    if solved is None:
        return None
    extra, chosen = solved
    orders[open_bonds] += extra
    charges[unresolved] = chosen
    return orders, charges


def _states(
    elements: Sequence[str],
    neighbours: Sequence[Sequence[int]],
    i: int,
    rings: Mapping[tuple[int, int], int],
    oxonium: set[int],
    carbon_ions: bool,
) -> tuple[_State, ...]:
    symbol, near = elements[i], neighbours[i]
    states = _ANY.get(symbol, {}).get(len(near), ())
    around = [(elements[j], len(neighbours[j])) for j in near]
    sizes = {rings[bond] for j in near if (bond := (min(i, j), max(i, j))) in rings}
    if symbol == "C" and len(near) == 2 and min(sizes, default=8) < 8:
        return ()  # as bent as no triple bond or cumulene is: a ring that misses a hydrogen
    if symbol == "C" and len(near) == 1 and around[0] in (("N", 1), ("N", 2), ("O", 1)):
        states = (_CYANIDE,)
    elif symbol == "C" and carbon_ions:
        anion = _CYCLOPENTADIENIDE if len(near) == 3 and 5 in sizes else _CARBANION
        states = (*states, anion, *((_CARBENIUM,) if len(near) == 3 else ()))
    elif symbol == "N" and len(near) == 2 and any(e != "H" and degree == 1 for e, degree in around):
        states = _MIDDLE
    elif symbol == "N" and len(near) == 1 and around[0][0] in ("N", "P", "S"):
        states = (*states, _AZIDE_END)
    elif symbol == "O" and around == [("O", 1)] * 2:
        states = (_OZONE,)
    elif symbol == "O" and (i in oxonium or around == [("C", 1)]):
        states = (*states, _OXONIUM)
    return states


def _is_ylide(elements: Sequence[str], neighbours: Sequence[Sequence[int]], i: int, j: int) -> bool:
    """Whether a double bond between these would be one of carbon and hypervalent S, Se or P."""
    return any(
        elements[a] == "C" and elements[b] in ("S", "Se", "P") and len(neighbours[b]) >= 3 for a, b in ((i, j), (j, i))
    )


def _oxonium(elements: Sequence[str], graph: nx.Graph) -> set[int]:
    """Oxygens of six-rings without a saturated member (pyrylium, flavylium), which may take a third bond."""
    flat = graph.subgraph(
        i for i in graph if (elements[i] in ("C", "N") and graph.degree(i) in (2, 3)) or
        (elements[i] == "O" and graph.degree(i) == 2)
    )  # fmt: skip
    return {i for bond, size in ring_sizes(flat).items() if size == 6 for i in bond if elements[i] == "O"}


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


# ---- of a whole structure -------------------------------------------------------------------------------------------


VALENCE = {"H": 1, "B": 3, "C": 4, "N": 3, "O": 2, "F": 1, "Si": 4, "P": 3, "S": 2, "Cl": 1, "Se": 2, "Br": 1, "I": 1}
_IONS = {"Li": 1, "Na": 1, "K": 1, "Rb": 1, "Cs": 1, "Mg": 2, "Ca": 2, "Sr": 2, "Ba": 2, "Zn": 2, "F": -1, "Cl": -1,
         "Br": -1, "I": -1, "Cu": 2, "Fe": 2, "Mn": 2, "Co": 2, "Ni": 2, "Cd": 2}  # fmt: skip

# Which double bonds come first, where valences are open; 7 of other ones to oxygen, else 5.
_PREFERENCES = {frozenset("CO"): 9, frozenset("CN"): 6, frozenset("CS"): 4}
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
    ions: Mapping[int, int] | None = None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return bond orders `(n_bonds,)` and formal charges `(n_atoms,)` of one Kekulé structure.

    Every hydrogen must be present. Open valences are paired by a maximum matching (C=O before C=N before C=C); what
    stays open is an anion on O and S, a cation on a nitrogen beside an open carbon. A molecule that this leaves with an
    atom in no usual state is given the Lewis structure of least penalty. With `positions_nm` `(n_atoms, 3)`, carbons
    that are unsaturated in such a structure, beside a charge or in C=C must be flat or straight, unless they are
    `trusted` to have all hydrogens. Lone atoms have the charges of `ions`, else their element's usual one. Raises
    ValenceError naming the atoms that fit nothing.
    """
    neighbours: list[list[int]] = [[] for _ in elements]
    for i, j in bonds.tolist():
        neighbours[i].append(j)
        neighbours[j].append(i)
    found = _Kekule(elements, bonds, neighbours, positions_nm, ions or {})
    orders, charges, bad = found.orders, found.charges, found.bad
    valence = np.zeros(len(elements))
    np.add.at(valence, bonds.ravel(), np.repeat(orders, 2))
    doubtful = set(bad)
    for i, q in enumerate(charges.tolist()):
        usual = {s[:2] for s in _ANY.get(elements[i], {}).get(len(neighbours[i]), ())}
        if neighbours[i] and ((round(valence[i]), q) not in usual or (elements[i] == "N" and q < 0)):
            doubtful.add(i)
    if positions_nm is not None:
        cations = [i for i in np.flatnonzero((charges > 0) & (valence == 4)).tolist() if elements[i] == "N"]
        double = [k for k, order in enumerate(orders) if order > 1 and all(elements[i] == "C" for i in bonds[k])]
        doubted = [*(j for i in cations for j in neighbours[i]), *bonds[double].ravel().tolist()]
        if bent := bent_carbons(elements, neighbours, set(doubted) - set(trusted), positions_nm):
            raise ValenceError(bent)
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
        better = lewis_structure([elements[i] for i in atoms], own)
        if better is None and positions_nm is not None:  # with every carbon flat, one of them may be an ion
            better = lewis_structure([elements[i] for i in atoms], own, carbon_ions=True)
            if better is not None and _has_lone_carbon_ion(elements, neighbours, atoms, better[1]):
                better = None  # it may be an anion as well as a cation, or miss a hydrogen
        if better is None:
            raise ValenceError(sorted(molecule & set(bad)) or sorted(molecule & doubtful))
        checked = molecule - set(trusted)
        if positions_nm is not None and (bent := bent_carbons(elements, neighbours, checked, positions_nm)):
            raise ValenceError(bent)
        orders[rows], charges[atoms] = better
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
        arms = _arms(neighbours[i], i, positions_nm)
        if (len(arms) == 3 and abs(float(np.linalg.det(arms))) > _FLAT) or (
            len(arms) == 2 and float(arms[0] @ arms[1]) > _STRAIGHT
        ):
            bent.append(i)
    return bent


def _arms(near: Sequence[int], i: int, positions_nm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Unit vectors `(n, 3)` from an atom to its neighbours."""
    arms = positions_nm[list(near)] - positions_nm[i]
    return np.asarray(arms / np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-9))


def _has_lone_carbon_ion(
    elements: Sequence[str], neighbours: Sequence[Sequence[int]], atoms: Sequence[int], charges: npt.NDArray[np.int64]
) -> bool:
    """Whether a carbon is charged beside nothing but hydrogens and saturated carbons, as in CH3."""

    def is_saturated(j: int) -> bool:
        return elements[j] == "H" or (elements[j] == "C" and len(neighbours[j]) == 4)

    charged = (i for i, q in zip(atoms, charges.tolist(), strict=True) if q and elements[i] == "C")
    return any(all(is_saturated(j) for j in neighbours[i]) for i in charged)


class _Kekule:
    """One Kekulé structure by matching: `orders (n_bonds,)`, `charges (n_atoms,)`, `bad` atoms that fit nothing.
    `order` holds that of each bond (i, j), i < j, and `_open` what valence each atom has left, negative with too many
    bonds."""

    def __init__(
        self,
        elements: Sequence[str],
        bonds: npt.NDArray[np.int64],
        neighbours: list[list[int]],
        positions_nm: npt.NDArray[np.float64] | None,
        ions: Mapping[int, int],
    ) -> None:
        self._elements, self._neighbours, self._positions_nm = elements, neighbours, positions_nm
        self._ions = ions
        self.charges = np.zeros(len(elements), dtype=np.int64)
        self.order = {(min(i, j), max(i, j)): 1 for i, j in bonds.tolist()}
        self._open = [self._open_valence(i) for i in range(len(elements))]
        self.bad = [i for i, u in enumerate(self._open) if u < 0]
        if not self.bad:
            self._oxidise()
            self._pair()
            self._resolve()
            self.bad = [i for i, u in enumerate(self._open) if u > 0]
        self.orders = np.array([self.order[min(i, j), max(i, j)] for i, j in bonds.tolist()], dtype=np.float64)

    def _strengthen(self, i: int, j: int) -> None:
        self.order[min(i, j), max(i, j)] += 1

    def _open_valence(self, i: int) -> int:
        symbol, degree = self._elements[i], len(self._neighbours[i])
        if degree == 0 and (i in self._ions or symbol in _IONS):
            self.charges[i] = self._ions.get(i, _IONS.get(symbol, 0))
            return 0
        if symbol not in VALENCE:
            return -1
        if symbol in ("P", "S", "Se") and degree >= 3:
            return 0
        if (symbol == "N" and degree == 4) or (symbol == "O" and degree == 3):
            self.charges[i] = 1
            return 0
        if symbol == "B" and degree == 4:
            self.charges[i] = -1
            return 0
        return VALENCE[symbol] - degree

    def _oxidise(self) -> None:
        """Nitro groups and the oxides of P and S, whose centres have no open valence of their own."""
        for i, symbol in enumerate(self._elements):
            near = self._neighbours[i]
            ends = [j for j in near if self._elements[j] in ("O", "S") and len(self._neighbours[j]) == 1]
            degree = len(near)
            room = 0
            if symbol == "N" and degree == 3 and len(ends) >= 2:
                room, self.charges[i] = 1, 1
            elif symbol in ("O", "S", "Se") and len(ends) == degree == 2:  # ozone, SO2: neutral
                room, self.charges[i] = (1, 1) if symbol == "O" else (2, 0)
            elif symbol in ("S", "Se") and len(ends) == degree == 3 and self._is_flat(i):  # SO3; sulfite is no plane
                room = 3
            elif (symbol, degree) in (("P", 4), ("S", 3), ("Se", 3)):
                room = 1
            elif symbol in ("S", "Se") and degree == 4:
                room = 2
            for j in ends[:room]:
                self._strengthen(i, j)
                self._open[j] -= 1
            if not ends[:room] and ((symbol in ("S", "Se") and degree == 3) or (symbol == "P" and degree == 4)):
                self.charges[i] = 1  # sulfonium, phosphonium

    def _is_flat(self, i: int) -> bool:
        if self._positions_nm is None:
            return False
        return abs(float(np.linalg.det(_arms(self._neighbours[i], i, self._positions_nm)))) < _FLAT

    def _pair(self) -> None:
        """Double bonds between open valences, then triple ones."""
        while True:
            graph = nx.Graph()
            for i, j in self.order:
                if self._open[i] > 0 and self._open[j] > 0:
                    pair = frozenset((self._elements[i], self._elements[j]))
                    graph.add_edge(i, j, weight=_PREFERENCES.get(pair, 7 if "O" in pair else 5))
            pairs = nx.max_weight_matching(graph, maxcardinality=True)
            if not pairs:
                break
            for a, b in pairs:
                self._strengthen(a, b)
                self._open[a] -= 1
                self._open[b] -= 1

    def _resolve(self) -> None:
        """Give charges to what no double bond took."""
        for i, symbol in enumerate(self._elements):
            near = self._neighbours[i]
            if self._open[i] == 1 and symbol == "C":
                donors = [j for j in near if self._is_donor(j)]
                if donors:
                    donor = max(donors, key=lambda j: sum(self._elements[k] == "H" for k in self._neighbours[j]))
                    self._strengthen(i, donor)
                    self._open[i] -= 1
                    self.charges[donor] = 1
            elif self._open[i] > 0 and symbol in ("O", "S", "N") and near:
                self.charges[i] -= self._open[i]
                self._open[i] = 0

    def _is_donor(self, j: int) -> bool:
        saturated = len(self._neighbours[j]) == 3 and self._open[j] == 0
        return self._elements[j] == "N" and self.charges[j] == 0 and saturated
