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
    found = _Kekule(elements, bonds, neighbours, positions_nm)
    orders, charges, bad = found.orders, found.charges, found.bad
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
        better = lewis_structure([elements[i] for i in atoms], own)
        if better is None and positions_nm is not None:  # with every carbon flat, one of them may be an ion
            better = lewis_structure([elements[i] for i in atoms], own, carbon_ions=True)
            if better is not None and _has_lone_carbon_ion(elements, neighbours, atoms, better[1]):
                better = None  # it may be an anion as well as a cation, or miss a hydrogen
        if better is None:
            raise ValenceError(sorted(molecule & set(bad)) or sorted(molecule & doubtful))
        if positions_nm is not None:
            _refuse_bent(elements, neighbours, molecule - set(trusted), positions_nm)
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


def _refuse_bent(
    elements: Sequence[str],
    neighbours: Sequence[Sequence[int]],
    atoms: Collection[int],
    positions_nm: npt.NDArray[np.float64],
) -> None:
    bent = bent_carbons(elements, neighbours, atoms, positions_nm)
    if bent:
        raise ValenceError(bent)


class _Kekule:
    """One Kekulé structure by matching: `orders (n_bonds,)`, `charges (n_atoms,)`, `bad` atoms that fit nothing.

    While it is made, `order` holds that of each bond (i, j), i < j, and `_open` what valence each atom has left, below
    zero where it has too many bonds.
    """

    def __init__(
        self,
        elements: Sequence[str],
        bonds: npt.NDArray[np.int64],
        neighbours: list[list[int]],
        positions_nm: npt.NDArray[np.float64] | None,
    ) -> None:
        self._elements, self._neighbours, self._positions_nm = elements, neighbours, positions_nm
        self.charges = np.zeros(len(elements), dtype=np.int64)
        self.order = {(min(i, j), max(i, j)): 1 for i, j in bonds.tolist()}
        self._open = [self._open_valence(i) for i in range(len(elements))]
        self.bad = [i for i, u in enumerate(self._open) if u < 0]
        if not self.bad:
            self._oxidise()
            self._pair()
            self._settle()
            self.bad = [i for i, u in enumerate(self._open) if u > 0]
        self.orders = np.array([self.order[min(i, j), max(i, j)] for i, j in bonds.tolist()], dtype=np.float64)

    def _strengthen(self, i: int, j: int) -> None:
        self.order[min(i, j), max(i, j)] += 1

    def _open_valence(self, i: int) -> int:
        symbol, degree = self._elements[i], len(self._neighbours[i])
        if degree == 0 and symbol in _IONS:
            self.charges[i] = _IONS[symbol]
            return 0
        if symbol not in _VALENCE:
            return -1
        if symbol in ("P", "S", "Se") and degree >= 3:
            return 0
        if (symbol == "N" and degree == 4) or (symbol == "O" and degree == 3):
            self.charges[i] = 1
            return 0
        if symbol == "B" and degree == 4:
            self.charges[i] = -1
            return 0
        return _VALENCE[symbol] - degree

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
                    graph.add_edge(i, j, weight=_preference(self._elements[i], self._elements[j]))
            pairs = nx.max_weight_matching(graph, maxcardinality=True)
            if not pairs:
                break
            for a, b in pairs:
                self._strengthen(a, b)
                self._open[a] -= 1
                self._open[b] -= 1

    def _settle(self) -> None:
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


def _preference(one: str, other: str) -> int:
    pair = {one, other}
    if pair == {"C", "O"}:
        return 9
    if "O" in pair:
        return 7
    if pair == {"C", "N"}:
        return 6
    if pair == {"C", "S"}:
        return 4
    return 5
