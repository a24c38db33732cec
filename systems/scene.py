"""Scene: one molecule or system as plain arrays, from which every library's own object is made on demand; parts of a
scene, and a scene with its atoms in another order."""

from __future__ import annotations

import functools
import hashlib
import json
import weakref
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import numpy.typing as npt

from systems.errors import InputError, first_line
from systems.files.schema import built

_SYMBOLS = """
H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr Rb Sr Y Zr Nb Mo Tc Ru
Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi Po At
Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og
"""

ATOMIC_NUMBERS: dict[str, int] = {symbol: number for number, symbol in enumerate(_SYMBOLS.split(), start=1)}

# A particle of a model system, which is no chemical element; MDTraj's symbol of a virtual site, atomic number 0.
PARTICLE = "VS"


FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Scene:
    """A molecular system: topology, starting positions and where they came from.

    Per atom `(n_atoms,)`, bonds `(n_bonds, 2)` with i < j, positions `(n_atoms, 3)` in nm, masses in dalton, formal
    charges in elementary charges. `bond_orders`: 1, 1.5, 2, 3, or 0 where the source does not say. `residue_of_atom`
    indexes `residue_names`, `residue_ids` and `chain_of_residue`. `cell_nm`: reduced box vectors `(3, 3)` of a periodic
    system. `interactions`: the law of a model system as JSON-able values with a key `kind`, else None.
    """

    name: str
    atom_names: tuple[str, ...]
    elements: tuple[str, ...]
    residue_of_atom: IntArray
    residue_names: tuple[str, ...]
    residue_ids: tuple[str, ...]
    chain_of_residue: tuple[str, ...]
    bonds: Annotated[IntArray, (-1, 2)]
    bond_orders: FloatArray
    formal_charges: IntArray
    masses_da: FloatArray
    positions_nm: FloatArray
    provenance: dict[str, Any] = field(default_factory=dict)
    cell_nm: FloatArray | None = None
    interactions: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        n = len(self.elements)
        per_atom = (self.atom_names, self.residue_of_atom, self.formal_charges, self.masses_da, self.positions_nm)
        if any(len(a) != n for a in per_atom):
            raise InputError(f"Scene {self.name!r}: per-atom arrays differ in length from its {n} elements.")
        if self.positions_nm.shape != (n, 3):
            raise InputError(f"Scene {self.name!r}: positions have shape {self.positions_nm.shape}, not ({n}, 3).")
        n_residues = len(self.residue_names)
        if {len(self.residue_ids), len(self.chain_of_residue)} != {n_residues} or (
            n and not 0 <= self.residue_of_atom.min() <= self.residue_of_atom.max() < n_residues
        ):
            raise InputError(f"Scene {self.name!r}: residues differ in number, or an atom is in none of them.")
        if len(self.bonds) != len(self.bond_orders):
            raise InputError(f"Scene {self.name!r}: {len(self.bonds)} bonds but {len(self.bond_orders)} bond orders.")
        if len(self.bonds) and (self.bonds.min() < 0 or self.bonds.max() >= n):
            raise InputError(f"Scene {self.name!r}: a bond names an atom outside 0..{n - 1}.")
        for array in (self.residue_of_atom, self.bonds, self.bond_orders, self.formal_charges, self.masses_da,
                      self.positions_nm):  # fmt: skip
            array.setflags(write=False)
        if self.cell_nm is not None:
            if self.cell_nm.shape != (3, 3):
                raise InputError(f"Scene {self.name!r}: cell_nm has shape {self.cell_nm.shape}, not (3, 3).")
            self.cell_nm.setflags(write=False)

    @property
    def n_atoms(self) -> int:
        return len(self.elements)

    @property
    def heavy_idx(self) -> IntArray:
        """Indices of atoms that are not hydrogen, `(n_heavy,)`."""
        return np.array([i for i, e in enumerate(self.elements) if e != "H"], dtype=np.int64)

    def neighbours(self) -> list[list[int]]:
        """Return of each atom the atoms that it is bonded to, ascending."""
        return neighbours_of(self.bonds, self.n_atoms)

    @functools.cached_property
    def topology_hash(self) -> str:
        """Hash of the ordered topology, names included, positions left out."""
        record = self.to_dict()
        for key in ("positions_nm", "provenance", "name", "masses_da", "cell_nm"):
            record.pop(key, None)
        return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def formula(self) -> str:
        """Hill-order formula, for people: C6H12N2O2; `5 particles` where there are no elements."""
        if self.elements and set(self.elements) == {PARTICLE}:
            return f"{self.n_atoms} particle{'s' if self.n_atoms > 1 else ''}"
        counts = {e: self.elements.count(e) for e in set(self.elements)}
        order: list[str] = [e for e in ("C", "H") if e in counts and "C" in counts]
        order += sorted(e for e in counts if e not in order)
        return "".join(f"{e}{counts[e] if counts[e] > 1 else ''}" for e in order)

    def with_positions(self, positions_nm: npt.ArrayLike) -> Scene:
        """Return the same scene at other positions `(n_atoms, 3)` nm."""
        return replace(self, positions_nm=np.array(positions_nm, dtype=np.float64))

    def to_dict(self) -> dict[str, Any]:
        """Return plain lists and strings that `from_dict` and JSON take back exactly; what is None is left out."""
        out = {key: value for key, value in asdict(self).items() if value is not None}
        for key, value in out.items():
            if isinstance(value, np.ndarray):
                out[key] = value.tolist()
            elif isinstance(value, tuple):
                out[key] = list(value)
        return out

    @staticmethod
    def from_dict(record: dict[str, Any]) -> Scene:
        """Rebuild a scene from `to_dict`. Raises ValueError for what is none (systems.files.schema)."""
        return built(Scene, record)

    # ---- other libraries' objects, each made here and nowhere else -------------------------------------------------

    def to_openmm_topology(self) -> Any:
        """Return an `openmm.app.Topology` with the same atom order, bonds included."""
        from openmm import app

        topology = app.Topology()
        chains: dict[str, Any] = {}
        residues = []
        for name, resid, chain_id in zip(self.residue_names, self.residue_ids, self.chain_of_residue, strict=True):
            if chain_id not in chains:
                chains[chain_id] = topology.addChain(chain_id)
            residues.append(topology.addResidue(name, chains[chain_id], resid))
        atoms = []
        for name, symbol, res in zip(self.atom_names, self.elements, self.residue_of_atom, strict=True):
            try:
                element = None if symbol == PARTICLE else app.Element.getBySymbol(symbol)
                atoms.append(topology.addAtom(name, element, residues[res]))
            except KeyError:
                raise InputError(f"Scene {self.name!r}: atom {name} is of no element, but {symbol!r}.") from None
            except ValueError:  # as OpenMM found it
                break
        if [a.index for a in topology.atoms()] != list(range(self.n_atoms)):
            raise InputError(f"Scene {self.name!r}: atoms of one residue or chain are not contiguous.")
        for (i, j), order in zip(self.bonds.tolist(), self.bond_orders.tolist(), strict=True):
            topology.addBond(atoms[i], atoms[j], order=round(order) or None)
        return topology

    def to_mdtraj_topology(self) -> Any:
        """Return an `mdtraj.Topology` with the same atom order, bonds included."""
        import mdtraj

        return mdtraj.Topology.from_openmm(self.to_openmm_topology())


def neighbours_of(bonds: IntArray, n_atoms: int) -> list[list[int]]:
    """Return of each atom the atoms that it is bonded to, ascending; bonds are `(n_bonds, 2)`."""
    near: list[list[int]] = [[] for _ in range(n_atoms)]
    for i, j in bonds.tolist():
        near[i].append(j)
        near[j].append(i)
    return [sorted(around) for around in near]


def once_per_scene(function: Callable[Concatenate[Scene, P], T]) -> Callable[Concatenate[Scene, P], T]:
    """Return `function` so that it computes what it says of a Scene, which never changes, once for as long as that
    object lives. All callers share the result: arrays are made read-only here, graphs are to be frozen. Further
    arguments must be hashable."""
    known: weakref.WeakKeyDictionary[Scene, dict[Any, T]] = weakref.WeakKeyDictionary()

    @functools.wraps(function)
    def once(scene: Scene, /, *args: P.args, **kwargs: P.kwargs) -> T:
        results = known.setdefault(scene, {})
        key = (args, *sorted(kwargs.items()))
        if key not in results:
            made = function(scene, *args, **kwargs)
            if isinstance(made, np.ndarray):
                made.setflags(write=False)
            results[key] = made
        return results[key]

    return once


# ---- parts of a scene -----------------------------------------------------------------------------------------------


def select_atoms(scene: Scene, text: str) -> IntArray:
    """Return the atoms `(k,)`, ascending, that a selection in MDTraj's language means, such as 'backbone or name CB'.
    Raises InputError when it cannot be read or means no atom."""
    try:
        found = np.asarray(scene.to_mdtraj_topology().select(text), dtype=np.int64)
    except InputError:
        raise
    except Exception as error:  # the parser raises what its own libraries raise
        raise InputError(
            f"the selection {text!r} cannot be read ({first_line(error)}); write it as MDTraj does, such as "
            "'name CA or name CB'."
        ) from error
    if not len(found):
        raise InputError(f"the selection {text!r} means no atom of {scene.name}.")
    return np.unique(found)


def part_of(scene: Scene, atoms: IntArray) -> Scene:
    """Return the scene of some atoms (ascending), with their bonds and residues, without a cell's other contents."""
    where = {int(i): k for k, i in enumerate(atoms)}
    rows = [k for k, (i, j) in enumerate(scene.bonds.tolist()) if i in where and j in where]
    residues = list(dict.fromkeys(int(scene.residue_of_atom[i]) for i in atoms))
    rank = {r: k for k, r in enumerate(residues)}
    return replace(
        scene,
        atom_names=tuple(scene.atom_names[i] for i in atoms),
        elements=tuple(scene.elements[i] for i in atoms),
        residue_of_atom=np.array([rank[int(scene.residue_of_atom[i])] for i in atoms], dtype=np.int64),
        residue_names=tuple(scene.residue_names[r] for r in residues),
        residue_ids=tuple(scene.residue_ids[r] for r in residues),
        chain_of_residue=tuple(scene.chain_of_residue[r] for r in residues),
        bonds=np.array([[where[int(i)] for i in scene.bonds[k]] for k in rows], dtype=np.int64).reshape(-1, 2),
        bond_orders=scene.bond_orders[rows],
        formal_charges=scene.formal_charges[atoms],
        masses_da=scene.masses_da[atoms],
        positions_nm=scene.positions_nm[atoms],
    )


def reordered(scene: Scene, order: IntArray) -> Scene:
    """Return the scene whose atom k is this one's atom order[k]; bonds and residues keep their places."""
    where = np.argsort(order)
    return replace(
        scene,
        atom_names=tuple(scene.atom_names[i] for i in order),
        elements=tuple(scene.elements[i] for i in order),
        residue_of_atom=scene.residue_of_atom[order],
        bonds=np.sort(where[scene.bonds], axis=1),
        formal_charges=scene.formal_charges[order],
        masses_da=scene.masses_da[order],
        positions_nm=scene.positions_nm[order],
    )
