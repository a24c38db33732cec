"""OpenMM residue templates for residues that ff14SB lacks, from GAFF2 and AM1-BCC charges of the capped residue.

How a residue X and its neighbours are joined:

- Charges: AM1-BCC of X with its neighbours' ends (`cap`), found by `gaff` in its cache or computed there;
  what X's own atoms lack to a whole number is spread evenly over them.
- The backbone has ff14SB's types, and with them its terms: N, H, C and O of the amides that join X to its neighbours;
  where one sp3 carbon joins such an N to such a C, that carbon (CX), its hydrogens (H1) and its sp3 carbons (CT); NH3+
  and COO- of a chain's ends likewise. phi, psi and omega of X are so those of alanine in ff14SB.
- Every other atom has a type of its own, and every term with such an atom is the one that GAFF2 has in the capped
  residue. So are terms between backbone types that ff14SB lacks (the angle CT-CX-CT of aminoisobutyric acid).
- 1-4 interactions are scaled as in both force fields (1/1.2 and 1/2).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from md_reference.forces.small_molecules import gaff
from md_reference.forces.small_molecules.prmtop import load_openmm
from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.element_data import atomic_weight_da
from systems.errors import PreparationError
from systems.scene import FloatArray, IntArray, Scene

_VALENCE = {"C": 4, "N": 3, "O": 2, "S": 2, "P": 5}
_HYDROGEN_NM = 0.109
# Bonds beyond the residue that are kept: N-methyl amide after it, acetyl before it.
_REACH = 2


@dataclass(frozen=True)
class CappedResidue:
    """A residue cut out of its chain. `scene`: it with its ends; `atoms (n_atoms,)`: the chain's atom of each of its
    atoms, -1 for a hydrogen that closes a cut; `n_own`: how many of them, the first, are the residue's own.
    """

    scene: Scene
    atoms: IntArray
    n_own: int


def cap(scene: Scene, residue: int) -> CappedResidue:
    """Return a residue with the atoms up to two bonds beyond it, hydrogens closing the cuts.

    Inside a chain of amides that is ACE-X-NME. Raises PreparationError when it fits no Lewis structure.
    """
    near = scene.neighbours()
    kept = [i for i in range(scene.n_atoms) if scene.residue_of_atom[i] == residue]
    n_own = len(kept)
    for _ in range(_REACH):
        kept += sorted({j for i in kept for j in near[i]} - set(kept))
    where = {i: k for k, i in enumerate(kept)}
    positions = [scene.positions_nm[i] for i in kept]
    elements = [scene.elements[i] for i in kept]
    bonds = [(where[i], where[j]) for i, j in scene.bonds.tolist() if i in where and j in where]
    for i in kept:
        beyond = [j for j in near[i] if j not in where]
        inside = [j for j in near[i] if j in where]
        needed = _VALENCE.get(scene.elements[i], len(near[i])) - len(inside) if beyond else 0
        for direction in _directions(scene, i, beyond, inside)[:needed]:
            bonds.append((where[i], len(elements)))
            positions.append(scene.positions_nm[i] + _HYDROGEN_NM * direction)
            elements.append("H")
    n = len(elements)
    pairs = np.sort(np.array(bonds, dtype=np.int64).reshape(-1, 2), axis=1)
    label = f"{scene.residue_names[residue]} {scene.residue_ids[residue]}"
    try:
        orders, charges = perceive(elements, pairs)
    except ValenceError as error:
        raise PreparationError(f"{label} of scene {scene.name!r}, cut out of its chain, fits no valence.") from error
    capped = Scene(
        name=f"{label} of {scene.name} with its neighbours' ends",
        atom_names=tuple(f"{e}{k + 1}" for k, e in enumerate(elements)),
        elements=tuple(elements),
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=(scene.residue_names[residue],),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=pairs,
        bond_orders=orders,
        formal_charges=charges,
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=np.array(positions),
    )
    return CappedResidue(capped, np.array([*kept, *[-1] * (n - len(kept))], dtype=np.int64), n_own)


def _directions(scene: Scene, i: int, beyond: list[int], inside: list[int]) -> list[FloatArray]:
    """Unit vectors from atom i for up to three closing hydrogens: towards what was cut off, then away from the rest."""
    out = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in beyond]
    others = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in inside]
    while len(out) < 3:
        out.append(_unit(-np.sum([*out, *others], axis=0) + 0.3 * np.eye(3)[len(out)]))
    return out


def _unit(vector: Any) -> FloatArray:
    return np.asarray(vector, dtype=np.float64) / max(float(np.linalg.norm(vector)), 1e-9)


PROTEIN_FILE = "amber14/protein.ff14SB.xml"
_PREFIX = "protein-"
# What AM1-BCC leaves on the ends of a capped residue; more means that something else was charged.
_LARGEST_EXCESS_E = 0.3

Key = tuple[str, ...]


@dataclass(frozen=True)
class ResidueTemplate:
    """A template as OpenMM force field XML, and the charge (e) that was spread over its atoms."""

    name: str
    xml: str
    spread_e: float


def make_template(capped: CappedResidue, name: str) -> ResidueTemplate:
    """Return the template of a capped residue's own atoms, in their order.

    Raises PreparationError where GAFF2 or AM1-BCC cannot describe it.
    """
    from openmm import app

    scene = capped.scene
    system = load_openmm(gaff.parameters(scene)).createSystem(
        nonbondedMethod=app.NoCutoff, constraints=None, rigidWater=False, removeCMMotion=False
    )
    backbone = backbone_types(capped)
    types = [t or (f"{name}-{k}" if k < capped.n_own else None) for k, t in enumerate(backbone)]
    terms = _Terms.of(system)
    charges_e, spread_e = _own_charges(capped, terms)
    root = ElementTree.Element("ForceField")
    new = [k for k in range(capped.n_own) if backbone[k] is None]
    listed = ElementTree.SubElement(root, "AtomTypes")
    for k in new:
        row = {"name": str(types[k]), "class": str(types[k]), "element": scene.elements[k]}
        ElementTree.SubElement(listed, "Type", row, mass=repr(float(scene.masses_da[k])))
    residue = ElementTree.SubElement(ElementTree.SubElement(root, "Residues"), "Residue", name=name)
    for k in range(capped.n_own):
        ElementTree.SubElement(residue, "Atom", name=f"a{k}", type=str(types[k]), charge=repr(float(charges_e[k])))
    for i, j in scene.bonds.tolist():
        if max(i, j) < capped.n_own:
            ElementTree.SubElement(residue, "Bond", atomName1=f"a{i}", atomName2=f"a{j}")
        elif min(i, j) < capped.n_own:
            ElementTree.SubElement(residue, "ExternalBond", atomName=f"a{min(i, j)}")
    _add_bonded(root, scene, types, terms)
    nonbonded = ElementTree.SubElement(root, "NonbondedForce", coulomb14scale=repr(1 / 1.2), lj14scale="0.5")
    ElementTree.SubElement(nonbonded, "UseAttributeFromResidue", name="charge")
    for k in new:
        _, sigma_nm, epsilon = terms.particles[k]
        row = {"type": str(types[k]), "sigma": repr(sigma_nm), "epsilon": repr(epsilon)}
        ElementTree.SubElement(nonbonded, "Atom", row)
    return ResidueTemplate(name, ElementTree.tostring(root, encoding="unicode"), spread_e)


def backbone_types(capped: CappedResidue) -> list[str | None]:
    """Return ff14SB's type of each atom of the capped residue that has one, see the head of this file; else None."""
    scene, n_own = capped.scene, capped.n_own
    near = scene.neighbours()
    symbol = scene.elements
    types: list[str | None] = [None] * scene.n_atoms
    nitrogens, carbons = set(), set()

    def lone(i: int, element: str) -> list[int]:
        return [j for j in near[i] if symbol[j] == element and len(near[j]) == 1]

    for i, j in scene.bonds.tolist():
        c, n = (i, j) if symbol[i] == "C" else (j, i)
        if (c < n_own) != (n < n_own) and symbol[n] == "N" and lone(c, "O"):  # an amide towards a neighbour
            types[c], types[n] = "C", "N"
            if c < n_own:
                carbons.add(c)
                types[lone(c, "O")[0]] = "O"
            else:
                nitrogens.add(n)
                for h in lone(n, "H"):
                    types[h] = "H"
    for i in range(n_own):
        if symbol[i] == "C" and len(near[i]) == 3 and len(lone(i, "O")) == 2:
            carbons.add(i)
        if symbol[i] == "N" and len(near[i]) == 4 and len(lone(i, "H")) >= 2:
            nitrogens.add(i)
    for alpha in range(n_own):
        n = [j for j in near[alpha] if j in nitrogens]
        c = [j for j in near[alpha] if j in carbons]
        if (
            symbol[alpha] != "C"
            or len(near[alpha]) != 4
            or len(n) != 1
            or len(c) != 1
            or not {types[n[0]], types[c[0]]} - {None}
        ):
            continue
        types[alpha] = "CX"
        is_first = types[n[0]] is None
        if is_first:
            types[n[0]] = "N3"
            for h in lone(n[0], "H"):
                types[h] = "H"
        if types[c[0]] is None:
            types[c[0]] = "C"
            for o in lone(c[0], "O"):
                types[o] = "O2"
        for j in near[alpha]:
            if symbol[j] == "H":
                types[j] = "HP" if is_first else "H1"
            elif symbol[j] == "C" and len(near[j]) == 4 and types[j] is None:
                types[j] = "CT"
    return [None if t is None else _PREFIX + t for t in types]


@dataclass
class _Terms:
    """Interactions of a System by atoms, in OpenMM's units."""

    bonds: dict[tuple[int, ...], tuple[float, float]] = field(default_factory=dict)
    angles: dict[tuple[int, ...], tuple[float, float]] = field(default_factory=dict)
    torsions: dict[tuple[int, ...], list[tuple[int, float, float]]] = field(default_factory=dict)
    particles: list[tuple[float, float, float]] = field(default_factory=list)

    @staticmethod
    def of(system: Any) -> _Terms:
        import openmm

        out = _Terms()
        for force in system.getForces():
            if isinstance(force, openmm.HarmonicBondForce):
                for k in range(force.getNumBonds()):
                    *atoms, length, strength = force.getBondParameters(k)
                    out.bonds[tuple(atoms)] = (length._value, strength._value)
            elif isinstance(force, openmm.HarmonicAngleForce):
                for k in range(force.getNumAngles()):
                    *atoms, angle, strength = force.getAngleParameters(k)
                    out.angles[tuple(atoms)] = (angle._value, strength._value)
            elif isinstance(force, openmm.PeriodicTorsionForce):
                for k in range(force.getNumTorsions()):
                    *atoms, period, phase, strength = force.getTorsionParameters(k)
                    out.torsions.setdefault(tuple(atoms), []).append((period, phase._value, strength._value))
            elif isinstance(force, openmm.NonbondedForce):
                rows = (force.getParticleParameters(k) for k in range(force.getNumParticles()))
                out.particles = [(q._value, sigma._value, epsilon._value) for q, sigma, epsilon in rows]
        return out


def _own_charges(capped: CappedResidue, terms: _Terms) -> tuple[FloatArray, float]:
    """Return the charges of the residue's own atoms, whole in sum, and what had to be spread over them."""
    own = np.array([q for q, _, _ in terms.particles[: capped.n_own]])
    whole = int(capped.scene.formal_charges[: capped.n_own].sum())
    spread = whole - float(own.sum())
    if abs(spread) > _LARGEST_EXCESS_E:
        raise PreparationError(
            f"AM1-BCC puts {own.sum():+.2f} e on {capped.scene.name} instead of {whole:+d}; give all hydrogens, "
            "or leave the residue out."
        )
    return own + spread / capped.n_own, spread


def _add_bonded(root: Any, scene: Scene, types: list[str | None], terms: _Terms) -> None:
    """Add the bonded terms that ff14SB's tables do not hold, each once for its types."""
    tables = _protein_tables()
    bonds = ElementTree.SubElement(root, "HarmonicBondForce")
    angles = ElementTree.SubElement(root, "HarmonicAngleForce")
    torsions = ElementTree.SubElement(root, "PeriodicTorsionForce", ordering="amber")
    done: set[tuple[str, Key]] = set()

    def wanted(kind: str, atoms: tuple[int, ...]) -> Key | None:
        key = tuple(str(types[i]) for i in atoms)
        if any(types[i] is None for i in atoms) or {(kind, key), (kind, key[::-1])} & done or tables.holds(kind, key):
            return None
        done.add((kind, key))
        return key

    for atoms, (length_nm, strength) in terms.bonds.items():
        key = wanted("Bond", atoms)
        if key is not None:
            ElementTree.SubElement(bonds, "Bond", _typed(key), length=repr(length_nm), k=repr(strength))
    for atoms, (angle, strength) in terms.angles.items():
        key = wanted("Angle", atoms)
        if key is not None:
            ElementTree.SubElement(angles, "Angle", _typed(key), angle=repr(angle), k=repr(strength))
    near = scene.neighbours()
    proper = {atoms: rows for atoms, rows in terms.torsions.items() if _is_path(atoms, near)}
    for atoms in _paths(scene, near):
        key = wanted("Proper", atoms)
        if key is not None:  # without a term in GAFF2, one of zero: ff14SB's general terms must not step in
            rows = proper.get(atoms) or proper.get(atoms[::-1]) or [(1, 0.0, 0.0)]
            ElementTree.SubElement(torsions, "Proper", _typed(key), **_series(rows))
    for atoms in terms.torsions.keys() - proper.keys():
        # The central atom is Amber's third; a prmtop written backwards has it second.
        first, second, centre, last = atoms if set(atoms) - {atoms[2]} <= set(near[atoms[2]]) else atoms[::-1]
        key = wanted("Improper", (centre, first, second, last))
        if key is not None:
            ElementTree.SubElement(torsions, "Improper", _typed(key), **_series(terms.torsions[atoms]))


def _typed(key: Key) -> dict[str, str]:
    return {f"type{k + 1}": each for k, each in enumerate(key)}


def _series(rows: list[tuple[int, float, float]]) -> dict[str, str]:
    out: dict[str, str] = {}
    for k, (period, phase, strength) in enumerate(rows, start=1):
        out |= {f"periodicity{k}": str(period), f"phase{k}": repr(phase), f"k{k}": repr(strength)}
    return out


def _is_path(atoms: tuple[int, ...], near: list[list[int]]) -> bool:
    return all(b in near[a] for a, b in pairwise(atoms))


def _paths(scene: Scene, near: list[list[int]]) -> list[tuple[int, ...]]:
    """Return the torsions (i, j, k, l) of the bond graph, each once."""
    return [(i, j, k, m) for j, k in scene.bonds.tolist() for i in near[j] for m in near[k] if k != i != m and m != j]


@dataclass(frozen=True)
class _Tables:
    """The bonded terms of ff14SB by types; an empty string is any type."""

    rows: dict[str, frozenset[Key]]

    def holds(self, kind: str, key: Key) -> bool:
        """Whether ff14SB has a term for these types, all of which must be its own for that."""
        if not all(t.startswith(_PREFIX) for t in key):
            return False
        rows = self.rows[kind]
        if kind == "Improper":
            return any(_fits((key[0], *rest), rows) for rest in permutations(key[1:]))
        return _fits(key, rows) or _fits(key[::-1], rows)


def _fits(key: Key, rows: frozenset[Key]) -> bool:
    if key in rows:
        return True
    return len(key) == 4 and any(all(r in ("", t) for r, t in zip(row, key, strict=True)) for row in rows)


@cache
def _protein_tables() -> _Tables:
    from openmm import app

    root = ElementTree.parse(Path(app.__file__).parent / "data" / PROTEIN_FILE).getroot()
    rows: dict[str, frozenset[Key]] = {}
    for kind, count in (("Bond", 2), ("Angle", 3), ("Proper", 4), ("Improper", 4)):
        found = (e.attrib for e in root.iter(kind) if "type1" in e.attrib)
        rows[kind] = frozenset(tuple(e[f"type{k}"] for k in range(1, count + 1)) for e in found)
    return _Tables(rows)
