"""Chains with residues that ff14SB lacks: the others keep ff14SB, these get templates from GAFF2 and AM1-BCC charges.

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

import io
from dataclasses import dataclass
from functools import cache
from itertools import pairwise, permutations
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from md_reference.forces import gaff
from md_reference.forces.mixture import permuted, regroup, terms_of
from md_reference.forces.spec import CHAIN_FILES, PROTEIN_FILES, ForceFieldSpec, force_field_of, unmatched_residues
from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.element_data import atomic_weight_da
from systems.errors import PreparationError, first_line
from systems.scene import FloatArray, IntArray, Scene

_VALENCE = {"C": 4, "N": 3, "O": 2, "S": 2, "P": 5}
_HYDROGEN_NM = 0.109
# Bonds beyond the residue that are kept: N-methyl amide after it, acetyl before it.
_REACH = 2


_PREFIX = "protein-"
# What AM1-BCC leaves on the ends of a capped residue; more means that something else was charged.
_LARGEST_EXCESS_E = 0.3

Key = tuple[str, ...]
# Terms of a System by kind and atoms, in OpenMM's units.
Terms = dict[str, dict[tuple[int, ...], list[tuple[Any, ...]]]]


@dataclass(frozen=True)
class Chain:
    """One molecule in residues (`scene`, whose atom k was atom `order[k]`), those without a template in `unknown`."""

    scene: Scene
    order: IntArray
    unknown: tuple[int, ...]

    @property
    def lacking(self) -> list[str]:
        """The residues without a template, for messages."""
        return [f"{self.scene.residue_names[r]} {self.scene.residue_ids[r]}" for r in self.unknown]


def find_chain(scene: Scene) -> Chain | None:
    """Return a molecule of which ff14SB covers some amino acids, divided into residues; None where it covers none."""
    regrouped, order = regroup(scene)
    unknown = unmatched_residues(regrouped, force_field_of(CHAIN_FILES))
    known = set(range(len(regrouped.residue_names))) - set(unknown)
    if not unknown or not any(_is_amino_acid(regrouped, r) for r in known):
        return None
    return Chain(regrouped, order, tuple(unknown))


def build_chain(chain: Chain, spec: ForceFieldSpec) -> Any:
    """Return the `openmm.System`, in vacuum, of a molecule in which `find_chain` finds a chain; particles in its order.
    Raises PreparationError where GAFF2 or AM1-BCC cannot describe a residue, or a term is left without parameters."""
    from openmm import app

    scene = chain.scene
    named = {r: f"{scene.residue_names[r]}-{r + 1}" for r in chain.unknown}
    made = [make_template(*cap(scene, r), name) for r, name in named.items()]
    topology = scene.to_openmm_topology()
    try:
        system = app.ForceField(*CHAIN_FILES, *map(io.StringIO, made)).createSystem(
            topology,
            residueTemplates={r: named[r.index] for r in topology.residues() if r.index in named},
            nonbondedMethod=app.NoCutoff,
            rigidWater=False,
            **spec.openmm_settings(),
        )
    except Exception as error:  # OpenMM raises KeyError, ValueError and bare Exception here
        raise PreparationError(
            f"scene {scene.name!r} cannot be joined from its residues: {first_line(error)}."
        ) from error
    _refuse_loose_atoms(scene, system)
    return permuted(system, chain.order)


def _is_amino_acid(scene: Scene, residue: int) -> bool:
    """Whether a residue (of a regrouped scene) is more than a cap: nitrogen and a carbonyl on one carbon of it."""
    near, symbol = scene.neighbours(), scene.elements
    atoms = np.flatnonzero(scene.residue_of_atom == residue).tolist()
    return any(
        symbol[a] == "C"
        and any(symbol[n] == "N" for n in near[a])
        and any(symbol[c] == "C" and any(symbol[o] == "O" and len(near[o]) == 1 for o in near[c]) for c in near[a])
        and {c for c in near[a] if symbol[c] == "C"} & set(atoms)
        for a in atoms
    )


def _refuse_loose_atoms(scene: Scene, system: Any) -> None:
    """Raise PreparationError for a bond or an angle of the graph that no force acts on: OpenMM passes over such."""
    held = {tuple(system.getConstraintParameters(k)[:2]) for k in range(system.getNumConstraints())}
    held |= {atoms for force in system.getForces() for _, atoms, _ in terms_of(force)}
    held |= {atoms[::-1] for atoms in held}
    near = scene.neighbours()
    paths = [(i, j, k) for j in range(scene.n_atoms) for i in near[j] for k in near[j] if i < k]
    loose = [term for term in [*map(tuple, scene.bonds.tolist()), *paths] if term not in held]
    if loose:
        names = [
            "-".join(f"{scene.residue_names[scene.residue_of_atom[i]]} {scene.atom_names[i]}" for i in t)
            for t in loose[:3]
        ]
        raise PreparationError(
            f"scene {scene.name!r}: no parameters for {len(loose)} bonds or angles ({'; '.join(names)}); "
            "use `level='gfn2-xtb'`, or a structure without that residue."
        )


# ---- a residue cut out of its chain ----------------------------------------------------------------------------------


def cap(scene: Scene, residue: int) -> tuple[Scene, int]:
    """Return a residue with the atoms up to two bonds beyond it, hydrogens closing the cuts, and how many atoms are its
    own: the first ones. Inside a chain of amides that is ACE-X-NME. Raises PreparationError when it fits no Lewis
    structure."""
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
    return capped, n_own


def _directions(scene: Scene, i: int, beyond: list[int], inside: list[int]) -> list[FloatArray]:
    """Unit vectors from atom i for up to three closing hydrogens: towards what was cut off, then away from the rest."""
    out = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in beyond]
    others = [_unit(scene.positions_nm[j] - scene.positions_nm[i]) for j in inside]
    while len(out) < 3:
        out.append(_unit(-np.sum([*out, *others], axis=0) + 0.3 * np.eye(3)[len(out)]))
    return out


def _unit(vector: Any) -> FloatArray:
    return np.asarray(vector, dtype=np.float64) / max(float(np.linalg.norm(vector)), 1e-9)


# ---- templates -------------------------------------------------------------------------------------------------------


def make_template(scene: Scene, n_own: int, name: str) -> str:
    """Return the template of a capped residue's own atoms, the first `n_own`, as XML of an OpenMM force field. Raises
    PreparationError where GAFF2 or AM1-BCC cannot describe it."""
    from openmm import app

    vacuum = {"nonbondedMethod": app.NoCutoff, "constraints": None, "rigidWater": False, "removeCMMotion": False}
    system = gaff.entry(scene).system(scene, **vacuum)
    backbone = backbone_types(scene, n_own)
    types = [t or (f"{name}-{k}" if k < n_own else None) for k, t in enumerate(backbone)]
    terms, particles = _terms(system)
    charges_e = _own_charges(scene, n_own, particles)
    root = ElementTree.Element("ForceField")
    new = [k for k in range(n_own) if backbone[k] is None]
    listed = ElementTree.SubElement(root, "AtomTypes")
    for k in new:
        row = {"name": str(types[k]), "class": str(types[k]), "element": scene.elements[k]}
        ElementTree.SubElement(listed, "Type", row, mass=repr(float(scene.masses_da[k])))
    residue = ElementTree.SubElement(ElementTree.SubElement(root, "Residues"), "Residue", name=name)
    for k in range(n_own):
        ElementTree.SubElement(residue, "Atom", name=f"a{k}", type=str(types[k]), charge=repr(float(charges_e[k])))
    for i, j in scene.bonds.tolist():
        if max(i, j) < n_own:
            ElementTree.SubElement(residue, "Bond", atomName1=f"a{i}", atomName2=f"a{j}")
        elif min(i, j) < n_own:
            ElementTree.SubElement(residue, "ExternalBond", atomName=f"a{min(i, j)}")
    _add_bonded(root, scene, types, terms)
    nonbonded = ElementTree.SubElement(root, "NonbondedForce", coulomb14scale=repr(1 / 1.2), lj14scale="0.5")
    ElementTree.SubElement(nonbonded, "UseAttributeFromResidue", name="charge")
    for k in new:
        _, sigma_nm, epsilon = particles[k]
        row = {"type": str(types[k]), "sigma": repr(sigma_nm), "epsilon": repr(epsilon)}
        ElementTree.SubElement(nonbonded, "Atom", row)
    return ElementTree.tostring(root, encoding="unicode")


def backbone_types(scene: Scene, n_own: int) -> list[str | None]:
    """Return ff14SB's type of each atom of a capped residue that has one, see the head of this file; else None."""
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
        is_sp3 = symbol[alpha] == "C" and len(near[alpha]) == 4
        if not (is_sp3 and len(n) == len(c) == 1 and {types[n[0]], types[c[0]]} - {None}):
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


def _terms(system: Any) -> tuple[Terms, list[tuple[float, ...]]]:
    """Return the interactions of a System by atoms, and each particle's charge, sigma and epsilon; OpenMM's units."""
    terms: Terms = {"Bond": {}, "Angle": {}, "Torsion": {}}
    particles: list[tuple[float, ...]] = []
    for force in system.getForces():
        for kind, atoms, values in terms_of(force):
            terms[kind].setdefault(atoms, []).append(tuple(getattr(v, "_value", v) for v in values))
        if type(force).__name__ == "NonbondedForce":
            rows = (force.getParticleParameters(k) for k in range(force.getNumParticles()))
            particles = [tuple(v._value for v in row) for row in rows]
    return terms, particles


def _own_charges(scene: Scene, n_own: int, particles: list[tuple[float, ...]]) -> FloatArray:
    """Return the charges of the residue's own atoms, whole in sum."""
    own = np.array([q for q, _, _ in particles[:n_own]])
    whole = int(scene.formal_charges[:n_own].sum())
    spread = whole - float(own.sum())
    if abs(spread) > _LARGEST_EXCESS_E:
        raise PreparationError(
            f"AM1-BCC puts {own.sum():+.2f} e on {scene.name} instead of {whole:+d}; give all hydrogens, "
            "or leave the residue out."
        )
    return np.asarray(own + spread / n_own)


def _add_bonded(root: Any, scene: Scene, types: list[str | None], terms: Terms) -> None:
    """Add the bonded terms that ff14SB's tables do not hold, each once for its types."""
    tables = {
        "Bond": ElementTree.SubElement(root, "HarmonicBondForce"),
        "Angle": ElementTree.SubElement(root, "HarmonicAngleForce"),
        "Torsion": ElementTree.SubElement(root, "PeriodicTorsionForce", ordering="amber"),
    }
    done: set[tuple[str, Key]] = set()

    def add(tag: str, atoms: tuple[int, ...], values: dict[str, str]) -> None:
        key = tuple(str(types[i]) for i in atoms)
        if any(types[i] is None for i in atoms) or {(tag, key), (tag, key[::-1])} & done or _in_protein(tag, key):
            return
        done.add((tag, key))
        named = {f"type{k + 1}": each for k, each in enumerate(key)}
        ElementTree.SubElement(tables[tag if tag in tables else "Torsion"], tag, named | values)

    for tag, rest in (("Bond", "length"), ("Angle", "angle")):
        for atoms, rows in terms[tag].items():
            add(tag, atoms, {rest: repr(rows[-1][0]), "k": repr(rows[-1][1])})
    near = scene.neighbours()
    proper = {a: rows for a, rows in terms["Torsion"].items() if all(j in near[i] for i, j in pairwise(a))}
    for j, k in scene.bonds.tolist():
        for atoms in [(i, j, k, m) for i in near[j] for m in near[k] if k != i != m and m != j]:
            # Without a term in GAFF2, one of zero: ff14SB's general terms must not step in.
            add("Proper", atoms, _series(proper.get(atoms) or proper.get(atoms[::-1]) or [(1, 0.0, 0.0)]))
    for atoms in terms["Torsion"].keys() - proper.keys():
        # The central atom is Amber's third; a prmtop written backwards has it second.
        first, second, centre, last = atoms if set(atoms) - {atoms[2]} <= set(near[atoms[2]]) else atoms[::-1]
        add("Improper", (centre, first, second, last), _series(terms["Torsion"][atoms]))


def _series(rows: list[tuple[Any, ...]]) -> dict[str, str]:
    out: dict[str, str] = {}
    for k, (period, phase, strength) in enumerate(rows, start=1):
        out |= {f"periodicity{k}": str(period), f"phase{k}": repr(phase), f"k{k}": repr(strength)}
    return out


def _in_protein(tag: str, key: Key) -> bool:
    """Whether ff14SB has a term for these types, all of which must be its own for that."""
    if not all(t.startswith(_PREFIX) for t in key):
        return False
    orders = [(key[0], *rest) for rest in permutations(key[1:])] if tag == "Improper" else [key, key[::-1]]
    return any(
        all(r in ("", t) for r, t in zip(row, order, strict=True)) for row in _protein_terms()[tag] for order in orders
    )


@cache
def _protein_terms() -> dict[str, frozenset[Key]]:
    """Return the types of ff14SB's bonded terms; an empty string is any type."""
    from openmm import app

    root = ElementTree.parse(Path(app.__file__).parent / "data" / PROTEIN_FILES["ff14SB"]).getroot()
    rows: dict[str, frozenset[Key]] = {}
    for kind, count in (("Bond", 2), ("Angle", 3), ("Proper", 4), ("Improper", 4)):
        found = (e.attrib for e in root.iter(kind) if "type1" in e.attrib)
        rows[kind] = frozenset(tuple(e[f"type{k}"] for k in range(1, count + 1)) for e in found)
    return rows
