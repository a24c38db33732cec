"""Missing heavy atoms and hydrogens of residues that are known by name, added by PDBFixer and OpenMM, in the
protonation that the file shows or the pH decides, with side chains turned out of other atoms.
"""

from __future__ import annotations

import contextlib
import io
import random
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.resources import files
from itertools import permutations, product
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from systems.chemistry.element_data import covalent_radius_nm
from systems.chemistry.geometry import extend, torsion
from systems.chemistry.residues import component, hydrogens_of, template_for
from systems.errors import PreparationError, first_line, listed
from systems.prepare.bonding import links_of
from systems.prepare.records import AtomRecord, Bonding, Residue, ResidueKey, distance_angstrom
from systems.prepare.structure_text import pdb_atom, read_structure
from systems.scene import FloatArray, IntArray, neighbours_of

_C_OXT_ANGSTROM = 1.25
_HYDROGEN_ANGSTROM = {"C": 1.09, "N": 1.01, "O": 0.96, "S": 1.34}
_UNKNOWN = "XCC"
# Coordinates below -999.999 Å do not fit the columns of a PDB file.
_COLUMNS_ANGSTROM = 900.0
_CHAIN_LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"


def complete(
    atoms: Sequence[AtomRecord], bonding: Bonding, *, ph: float, metals: Sequence[AtomRecord] = ()
) -> tuple[list[AtomRecord], IntArray, list[str]]:
    """Return atoms, bonds and a summary of what was added to structures of residues that are all known by name.

    Heavy atoms of the file keep their positions; hydrogens of residues that had all of theirs keep them too, the others
    get new ones, in the protonation that the file shows or, where it shows none, the one that `metals` which stay
    beside the structure leave, else the usual one at `ph`. Names become the standard ones, residues stand in chain
    order. Raises PreparationError when PDBFixer cannot complete the
    structure.
    """
    from openmm import Platform, app, unit
    from pdbfixer import PDBFixer

    chains = _chains(bonding)
    residues = [r for chain in chains for r in chain]
    lowest = np.min([a.position_angstrom for a in atoms], axis=0)
    shift = np.where(lowest < -_COLUMNS_ANGSTROM, np.floor(lowest), 0.0)
    text = _heavy_atom_text([_moved(a, -shift) for a in atoms] if shift.any() else atoms, chains)
    neighbours = bonding.neighbours
    closed = {
        end.key
        for chain in chains
        for end in (chain[0], chain[-1])
        if (chain[-1].heavy.get("C", -1), chain[0].heavy.get("N", -1)) in bonding.peptide_bonds
    }
    holding = [_metals_of(residue, atoms, metals) for residue in residues]
    variants = [
        asked_hydrogens(residue, atoms, neighbours, ph=ph, in_cycle=residue.key in closed, holding=held)
        for residue, held in zip(residues, holding, strict=True)
    ]
    reference = Platform.getPlatformByName("Reference")
    try:
        with fixed_random_numbers():
            fixer = PDBFixer(pdbfile=io.StringIO(text), platform=reference)
            fixer.missingResidues = {}
            fixer.findMissingAtoms()
            _forget_linked(fixer, residues)
            fixer.addMissingAtoms(seed=1)
            _add_bonds(fixer.topology, residues, bonding.bonds)
            rebuilt = _without_overlaps(fixer, residues)
            modeller = app.Modeller(fixer.topology, fixer.positions)
            modeller.addHydrogens(pH=ph, variants=variants, platform=reference)
    except PreparationError:
        raise
    except Exception as error:  # PDBFixer and OpenMM raise bare Exceptions, KeyErrors and ValueErrors alike
        raise PreparationError(f"PDBFixer could not complete the structure ({first_line(error)}).") from error
    positions_nm = np.array(modeller.positions.value_in_unit(unit.nanometer), dtype=np.float64) + shift / 10.0
    records, bonds = records_from_openmm(modeller.topology, positions_nm, [r.key for r in residues])
    names = {(r.key, a) for r in residues for a in r.heavy}
    records = _with_usual_lengths(records, bonds, names)
    records = _keep_hydrogens(records, bonds, atoms, bonding)
    summary = _summary(residues, records, ph) + rebuilt
    for residue, variant, held in zip(residues, variants, holding, strict=True):
        if held and variant != variant_of(residue, atoms, neighbours) and isinstance(variant, str):
            bound, what = _BY_METAL[variant]
            summary.append(f"{residue.label}: {what}, because {bound} binds {held[bound]}")
    summary += protonation_summary([r.label for r in residues], [r.key for r in residues], variants, records, ph)
    if [a.name for a in records if a.element != "H"] != [a.name for a in atoms if a.element != "H"]:
        summary.append("atoms stand in the standard order under their standard names")
    return records, bonds, summary


def _forget_linked(fixer: Any, residues: Sequence[Residue]) -> None:
    """Take from PDBFixer's list what is not missing: a residue bonded to another one has lost an atom for it."""
    for residue, built in zip(residues, fixer.topology.residues(), strict=True):
        if "OXT" not in residue.missing:
            fixer.missingTerminals.pop(built, None)
        if built in fixer.missingAtoms:
            fixer.missingAtoms[built] = [a for a in fixer.missingAtoms[built] if a.name in residue.missing]


def _add_bonds(topology: Any, residues: Sequence[Residue], bonds: IntArray) -> None:
    """Add the bonds of heavy atoms that OpenMM does not know by the names of residues."""
    built = [{a.name: a for a in residue.atoms()} for residue in topology.residues()]
    place = {i: at[name] for r, at in zip(residues, built, strict=True) for name, i in r.heavy.items() if name in at}
    known = {frozenset((a, b)) for a, b in topology.bonds()}
    for i, j in bonds.tolist():
        if i in place and j in place and frozenset((place[i], place[j])) not in known:
            topology.addBond(place[i], place[j])


def _without_overlaps(fixer: Any, residues: Sequence[Residue]) -> list[str]:
    """Turn added side chains that stand in other atoms; return a line for each. Raises PreparationError."""
    from openmm import unit

    if not any(r.missing for r in residues):
        return []
    topology = fixer.topology
    elements = [a.element.symbol for a in topology.atoms()]
    positions_nm = np.array(fixer.positions.value_in_unit(unit.nanometer), dtype=np.float64)
    sites = [{a.name: a.index for a in residue.atoms()} for residue in topology.residues()]
    notes = resolve_side_chains(
        positions_nm,
        elements,
        [(a.index, b.index) for a, b in topology.bonds()],
        [
            (r.label, r.template.name, at, r.missing if r.template.is_amino_acid else ())
            for r, at in zip(residues, sites, strict=True)
            if r.template is not None
        ],
    )
    if notes:
        fixer.positions = positions_nm * unit.nanometer
    return notes


def records_from_openmm(
    topology: Any, positions_nm: FloatArray, keys: Sequence[ResidueKey]
) -> tuple[list[AtomRecord], IntArray]:
    """Return records and bonds of an OpenMM topology whose residues are `keys` (chain, number, name), in that order."""
    records = []
    for residue, (chain, number, name) in zip(topology.residues(), keys, strict=True):
        for atom in residue.atoms():
            x, y, z = (positions_nm[atom.index] * 10.0).tolist()
            records.append(
                AtomRecord(atom.name, atom.element.symbol, name, chain, number, (x, y, z), str(atom.index + 1))
            )
    bonds = {(min(a.index, b.index), max(a.index, b.index)) for a, b in topology.bonds()}
    return records, np.array(sorted(bonds), dtype=np.int64).reshape(-1, 2)


@contextlib.contextmanager
def fixed_random_numbers() -> Iterator[None]:
    """Make OpenMM's Modeller, which draws from Python's global generator, repeatable; then puts it back."""
    state = random.getstate()
    random.seed(1)
    try:
        yield
    finally:
        random.setstate(state)


def _chains(bonding: Bonding) -> list[list[Residue]]:
    """Residues as peptide bonds join them, from first to last, whatever their order in the file. A cycle is opened
    between residues that have no protonation to be settled, where it can be."""
    of_atom = {i: k for k, r in enumerate(bonding.residues) for i in r.atoms}
    following = {of_atom[c]: of_atom[n] for c, n in bonding.peptide_bonds}
    before = {n: c for c, n in following.items()}

    def burden(k: int) -> int:
        ends = (bonding.residues[k].template, bonding.residues[before.get(k, k)].template)
        return sum(t is not None and t.name in TITRATED for t in ends)

    starts = [k for k in range(len(bonding.residues)) if k not in before]
    chains: list[list[Residue]] = []
    seen: set[int] = set()
    for start in [*starts, *sorted(before, key=burden)]:
        chain, k = [], start
        while k >= 0 and k not in seen:
            seen.add(k)
            chain.append(bonding.residues[k])
            k = following.get(k, -1)
        if chain:
            chains.append(chain)
    return chains


def _moved(atom: AtomRecord, by_angstrom: FloatArray) -> AtomRecord:
    x, y, z = (np.array(atom.position_angstrom) + by_angstrom).tolist()
    return replace(atom, position_angstrom=(x, y, z))


def _heavy_atom_text(atoms: Sequence[AtomRecord], chains: Sequence[Sequence[Residue]]) -> str:
    lines: list[str] = []
    number = 0
    for k, chain in enumerate(chains):
        letter = _CHAIN_LETTERS[k % len(_CHAIN_LETTERS)]
        for residue in chain:
            number += 1
            # A component goes by a name that OpenMM knows nothing about, and therefore leaves alone.
            standard = template_for(residue.key[2])
            place = (_UNKNOWN if standard is None else standard.name, letter, str(number % 10000))
            name_of = {i: a for a, i in residue.heavy.items()}
            heavy = [(name_of.get(i, atoms[i].name), atoms[i].element.upper(), atoms[i].position_angstrom)
                     for i in residue.atoms if atoms[i].element != "H"]  # fmt: skip
            heavy += [(name, name[0], (x, y, z)) for name, (x, y, z) in _built(residue, atoms).items()]
            lines += [
                pdb_atom(len(lines) + n, name, element, *place, at) for n, (name, element, at) in enumerate(heavy)
            ]
        lines.append("TER")
    return "\n".join([*lines, "END", ""])


def _built(residue: Residue, atoms: Sequence[AtomRecord]) -> dict[str, list[float]]:
    """Positions in Å of a missing CB (of an L residue) and OXT, from the backbone. PDBFixer superposes its template on
    N, CA, C and O, which are nearly in one plane, and then and now comes out with a D residue; an OXT it adds may stand
    3 Å from its carbon."""
    heavy = {a: np.array(atoms[i].position_angstrom) for a, i in residue.heavy.items()}
    out: dict[str, list[float]] = {}
    if "CB" in residue.missing and {"N", "CA", "C"} <= set(heavy):
        b, d = heavy["CA"] - heavy["N"], heavy["C"] - heavy["CA"]
        # Ideal geometry: the coefficients of ProteinMPNN (Dauparas et al., Science 378, 49, 2022).
        out["CB"] = (-0.58273431 * np.cross(b, d) + 0.56802827 * b - 0.54067466 * d + heavy["CA"]).tolist()
    if "OXT" in residue.missing and {"CA", "C", "O"} <= set(heavy):
        away = sum((heavy["C"] - heavy[a]) / np.linalg.norm(heavy["C"] - heavy[a]) for a in ("CA", "O"))
        out["OXT"] = (heavy["C"] + _C_OXT_ANGSTROM * away / np.linalg.norm(away)).tolist()
    return out


def _with_usual_lengths(
    records: list[AtomRecord], bonds: IntArray, kept: set[tuple[ResidueKey, str]]
) -> list[AtomRecord]:
    """Put each added hydrogen at the usual distance from its atom (Modeller leaves some 10 % too much), and on a carbon
    with two other neighbours into their plane (beside residues that it does not know Modeller may not find it); refuse
    heavy atoms that were put nowhere near theirs. `kept`: residue and name of the atoms that the file had.
    """
    out = list(records)
    neighbours = neighbours_of(bonds, len(records))
    for i, j in bonds.tolist():
        if records[i].element == "H":
            i, j = j, i
        if {(records[k].residue_key, records[k].name) for k in (i, j)} <= kept:
            continue
        x, y = (np.array(records[k].position_angstrom) for k in (i, j))
        length = float(np.linalg.norm(y - x))
        usual = _HYDROGEN_ANGSTROM.get(records[i].element)
        if records[j].element == "H" and usual is not None and length > 0:
            away = (y - x) / length
            others = [np.array(records[k].position_angstrom) - x for k in neighbours[i] if records[k].element != "H"]
            if records[i].element == "C" and len(neighbours[i]) == 3 and len(others) == 2:
                away = -sum(arm / np.linalg.norm(arm) for arm in others)
                away = away / np.linalg.norm(away)
            x_new, y_new, z_new = (x + usual * away).tolist()
            out[j] = replace(records[j], position_angstrom=(x_new, y_new, z_new))
            continue
        expected = 10.0 * (covalent_radius_nm(records[i].element) + covalent_radius_nm(records[j].element))
        if not 0.75 * expected < length < 1.25 * expected:
            raise PreparationError(
                f"{records[i].label} and {records[j].label} came out {length:.2f} Å apart when missing "
                "atoms were added; give the residue with all its heavy atoms."
            )
    return out


def _keep_hydrogens(
    records: list[AtomRecord], bonds: IntArray, atoms: Sequence[AtomRecord], bonding: Bonding
) -> list[AtomRecord]:
    """Put the file's hydrogens back where a heavy atom has as many as before."""
    whole = {r.key: r for r in bonding.residues if r.heavy and not r.lacks_hydrogens}
    before, after = bonding.neighbours, neighbours_of(bonds, len(records))
    out = list(records)
    for parent, around in enumerate(after):
        residue = whole.get(records[parent].residue_key)
        kept = None if residue is None else residue.heavy.get(records[parent].name)
        new = [j for j in around if records[j].element == "H"]
        old = [] if kept is None else [j for j in before[kept] if atoms[j].element == "H"]
        if not new or len(old) != len(new):
            continue
        best = min(permutations(old), key=lambda order: sum(
            distance_angstrom(records[j], atoms[i]) ** 2 for j, i in zip(new, order, strict=True)))  # fmt: skip
        for j, i in zip(new, best, strict=True):
            out[j] = replace(records[j], position_angstrom=atoms[i].position_angstrom)
    return out


def _summary(residues: Sequence[Residue], records: Sequence[AtomRecord], ph: float) -> list[str]:
    notes = []
    for residue in residues:
        if residue.missing:
            end = " (the chain ends here, as a carboxylate)" if "OXT" in residue.missing else ""
            notes.append(f"{residue.label}: added {' '.join(residue.missing)}{end}")
    short = {r.key: r.label for r in residues if r.lacks_hydrogens}
    by_dictionary = [label for key, label in short.items() if template_for(key[2]) is None]
    if by_dictionary:
        notes.append(
            f"hydrogens added from the Chemical Component Dictionary, ionised as at pH {ph:g}: {listed(by_dictionary)}"
        )
    if short:
        n = sum(a.element == "H" and a.residue_key in short for a in records)
        notes.append(f"hydrogens placed on {listed(list(short.values()))}: {n}")
    return notes


# ---- protonation ----------------------------------------------------------------------------------------------------


# Hydrogens (in OpenMM's names) whose presence tells the protonation state.
TITRATED = {"ASP": ("HD2",), "GLU": ("HE2",), "LYS": ("HZ1", "HZ2", "HZ3"), "HIS": ("HD1", "HE2"), "CYS": ("HG",)}
_STATES = {
    ("ASP", (False,)): "ASP charged", ("ASP", (True,)): "ASP neutral (ASH)", ("GLU", (False,)): "GLU charged",
    ("GLU", (True,)): "GLU neutral (GLH)", ("LYS", (True, True, True)): "LYS charged",
    ("LYS", (False, True, True)): "LYS neutral (LYN)", ("LYS", (True, True, False)): "LYS neutral (LYN)",
    ("HIS", (True, True)): "HIS charged (HIP)", ("HIS", (True, False)): "HIS neutral (HID)",
    ("HIS", (False, True)): "HIS neutral (HIE)", ("CYS", (True,)): "CYS neutral",
}  # fmt: skip
# A variant of Modeller's by name, the hydrogens one by one with their heavy atoms, or None: what pH decides.
Asked = str | list[tuple[str, str]] | None
# What other programs say of the protonation by a residue's name.
_SAYS = {"HSD": "HID", "HISD": "HID", "HISA": "HID", "HSE": "HIE", "HISE": "HIE", "HISB": "HIE", "HSP": "HIP",
         "HISH": "HIP", "ASPP": "ASH", "ASPH": "ASH", "GLUP": "GLH", "GLUH": "GLH", "LSN": "LYN"}  # fmt: skip
# Farther than this from a metal an atom keeps its proton: bonds of metals to N and S are 1.9 to 2.6 Å long.
_COORDINATED_ANGSTROM = 2.8
# Of the variants that a metal leaves: the atom that binds it, and what becomes of the proton.
_BY_METAL = {"HIE": ("ND1", "proton placed on NE2"), "HID": ("NE2", "proton placed on ND1"), "CYX": ("SG", "thiolate")}
# Hydrogens that Modeller's own rules count rightly: peptide bonds, and sulfurs in disulfides.
_USUAL_LINKS = {"N": 1, "C": 1, "SG": 1}


def asked_hydrogens(
    residue: Residue,
    atoms: Sequence[AtomRecord],
    neighbours: Sequence[Sequence[int]],
    *,
    ph: float,
    in_cycle: bool,
    holding: Collection[str] = (),
) -> Asked:
    """Return what to ask of Modeller for a residue.

    Standard residues are left to its rules, in the protonation that the file shows, or that metals leave, which the
    atoms called `holding` bind. Components of the dictionary, and
    standard residues where those rules fail (an end of the chain that a bond closes, a side chain bonded to another
    residue), are asked for hydrogen by hydrogen: those of the file where it has all, else the dictionary's at this pH.
    Raises PreparationError for a residue of which nothing is known.
    """
    assert residue.template is not None
    links = links_of(residue, neighbours)
    is_standard = template_for(residue.key[2]) is not None
    if is_standard and not in_cycle and all(n <= _USUAL_LINKS.get(atom, 0) for atom, n in links.items()):
        return variant_of(residue, atoms, neighbours, holding)
    if not residue.lacks_hydrogens:
        return [
            (atoms[h].name, name) for name, i in residue.heavy.items() for h in neighbours[i] if atoms[h].element == "H"
        ]
    found = component(residue.template.name)
    if found is None:
        raise PreparationError(f"{residue.label} lacks hydrogens, and the dictionary does not hold it; give them.")
    return hydrogens_of(found, {*residue.heavy, *residue.missing}, links, ph=ph)


def variant_of(
    residue: Residue, atoms: Sequence[AtomRecord], neighbours: Sequence[Sequence[int]], holding: Collection[str] = ()
) -> str | None:
    """Return Modeller's name of the protonation that the residue's own hydrogens or name show, or a metal which the
    atoms called `holding` bind, or None."""
    name = residue.key[2].upper()
    if len(name) == 4 and name[0] in "NC" and template_for(name[1:]) is not None:  # Amber's terminal forms
        name = name[1:]
    named = _SAYS.get(name, name)
    if named in ("CYX", "CYS2", "CYS"):  # without its partner it is a cysteine like any other
        is_thiolate = "SG" in holding and residue.lacks_hydrogens
        return "CYX" if is_thiolate or "SG" in links_of(residue, neighbours) else None
    if named in ("HID", "HIE", "HIP", "ASH", "GLH", "LYN"):
        return named
    if named == "CYM":
        return "CYX"
    template = residue.template
    if template is None or template.name not in ("HIS", "ASP", "GLU", "LYS"):
        return None
    count = {a: sum(atoms[j].element == "H" for j in neighbours[i]) for a, i in residue.heavy.items()}
    if template.name == "HIS":
        by_metal = "HIE" if "ND1" in holding else "HID" if "NE2" in holding else None
        shown = {(1, 1): "HIP", (1, 0): "HID", (0, 1): "HIE"}
        return shown.get((count.get("ND1", 0), count.get("NE2", 0)), by_metal)
    if template.name == "LYS":
        return {2: "LYN", 3: "LYS"}.get(count.get("NZ", 0))
    ends = sum(count.get(a, 0) for a in ("OD1", "OD2", "OE1", "OE2"))
    if ends:
        return "ASH" if template.name == "ASP" else "GLH"
    return template.name if not residue.lacks_hydrogens else None


def _metals_of(residue: Residue, atoms: Sequence[AtomRecord], metals: Sequence[AtomRecord]) -> dict[str, str]:
    """The atoms of HIS and CYS that bind a metal in place of a proton, by name, and which metal: `ZN A900`."""
    found = {}
    for name, i in residue.heavy.items():
        for metal in metals if name in ("ND1", "NE2", "SG") else ():
            if distance_angstrom(atoms[i], metal) < _COORDINATED_ANGSTROM:
                found[name] = metal.label.removesuffix(f" {metal.name}")
    return found


def protonation_summary(
    labels: Sequence[str],
    keys: Sequence[ResidueKey],
    given: Sequence[Asked],
    records: Sequence[AtomRecord],
    ph: float,
) -> list[str]:
    """One line for each kind of protonation that `ph` decided, that is where `given` holds no variant."""
    hydrogens: dict[ResidueKey, set[str]] = {}
    for atom in records:
        if atom.element == "H":
            hydrogens.setdefault(atom.residue_key, set()).add(atom.name)
    states: dict[str, list[str]] = {}
    for label, key, variant in zip(labels, keys, given, strict=True):
        template = template_for(key[2])
        if variant is None and template is not None and template.name in TITRATED:
            marks = tuple(h in hydrogens.get(key, ()) for h in TITRATED[template.name])
            if state := _STATES.get((template.name, marks)):
                states.setdefault(state, []).append(label)
    return [f"protonation at pH {ph:g}: {state}: {listed(found)}" for state, found in sorted(states.items())]


# ---- side chains ----------------------------------------------------------------------------------------------------

# PDBFixer adds missing atoms in the shape of its template, and parts overlaps by a few steps of minimisation, which in
# crowded places ends in bonds of 2.7 Å or in atoms 2 Å apart. Here every torsion that the file leaves open is tried at
# its rotamers (60°, 180°, -60°; every 30° where a planar group turns: the centres of Dunbrack's library, Acta Cryst.
# D58, 1862 (2002)), and the conformer farthest from all other heavy atoms is taken.

_STAGGERED = (-60.0, 180.0, 60.0)
_PLANAR = tuple(float(k) for k in range(-180, 180, 30))
# The atom at the end of the last torsion that turns a planar group.
_PLANAR_AT = {"ASP": "CG", "ASN": "CG", "PHE": "CG", "TYR": "CG", "TRP": "CG", "HIS": "CG", "GLU": "CD", "GLN": "CD"}
_RIGID = frozenset(("NE", "CZ"))
_BACKBONE = frozenset(("N", "C", "O", "OXT"))
# Hydrogen bonds of heavy atoms start at 2.4 Å, contacts with carbon and sulfur at 3.0: nearer than the first an added
# atom is built again, nearer than the second nothing is left to part.
_NEAR_ANGSTROM, _NEAR_POLAR_ANGSTROM = 2.9, 2.4
_OVERLAP_ANGSTROM = 2.1


@lru_cache(maxsize=64)
def residue_shape(name: str) -> Mapping[str, FloatArray]:
    """Return the heavy atoms of PDBFixer's template of a residue, nm."""
    path = Path(str(files("pdbfixer") / "templates" / f"{name}.pdb"))
    return {a.name: np.array(a.position_angstrom) / 10.0 for a in read_structure(path).atoms if a.element != "H"}


def resolve_side_chains(
    positions_nm: FloatArray,
    elements: Sequence[str],
    bonds: Sequence[tuple[int, int]],
    residues: Sequence[tuple[str, str, dict[str, int], Sequence[str]]],
) -> list[str]:
    """Build added side chains that overlap again, in place; return a line for each. `positions_nm` `(n_atoms, 3)`,
    heavy atoms alone; `bonds` pairs of them; `residues`: label, standard name, atoms by name, and the names that were
    added. Raises PreparationError where an added atom stands in another in every rotamer."""
    graph = nx.Graph(bonds)
    graph.add_nodes_from(range(len(elements)))
    radii = np.array([covalent_radius_nm(e) for e in elements])
    polar = np.array([e in ("N", "O") for e in elements])
    notes = []
    for label, name, sites, added in residues:
        moved = [a for a in added if a in sites and a not in (*_BACKBONE, "CB")]
        if not moved:
            continue
        idx = np.array([sites[a] for a in moved])
        near = [sorted(nx.single_source_shortest_path_length(graph, int(i), cutoff=3)) for i in idx]

        def clearance(x: FloatArray, idx: IntArray = idx, near: list[list[int]] = near) -> tuple[float, float]:
            """The least distance of an added atom, and the least by which one exceeds what is called near, nm."""
            gap = np.linalg.norm(x[idx, None] - x[None], axis=2)
            for k, around in enumerate(near):
                gap[k, around] = np.inf
            limit = np.where(polar[idx, None] & polar[None], _NEAR_POLAR_ANGSTROM, _NEAR_ANGSTROM) / 10.0
            return float(gap.min()), float((gap - limit).min())

        joined = [(i, j) for i, j in bonds if i in idx or j in idx]
        ratio = [float(np.linalg.norm(positions_nm[i] - positions_nm[j]) / (radii[i] + radii[j])) for i, j in joined]
        off = any(not 0.75 < r < 1.25 for r in ratio)
        least, margin = (-np.inf, -np.inf) if off else clearance(positions_nm)
        if margin >= 0:
            continue
        best = positions_nm
        for trial in _conformers(name, {a: positions_nm[i] for a, i in sites.items() if a not in moved}, moved):
            x = positions_nm.copy()
            x[idx] = [trial[a] for a in moved]
            of_trial = clearance(x)
            if of_trial[1] > margin + 1e-6:
                best, (least, margin) = x, of_trial
        if off and best is positions_nm:
            continue  # its bonds are refused with their lengths
        if 10.0 * least < _OVERLAP_ANGSTROM:
            raise PreparationError(
                f"{label}: {' '.join(moved)}, which were missing, come out {10 * least:.2f} Å from another heavy atom "
                "in every rotamer; give the residue with all its heavy atoms, or make room for it."
            )
        if best is not positions_nm:
            positions_nm[:] = best
            notes.append(f"{label}: {' '.join(moved)} overlapped and were built again in the rotamer with most room")
    return notes


def _conformers(name: str, there: Mapping[str, FloatArray], moved: Sequence[str]) -> list[dict[str, FloatArray]]:
    """Positions in nm of the `moved` atoms of a residue in every combination of rotamers, `there` being its others;
    none of proline, whose ring leaves no choice, nor where what they hang on is missing."""
    shape = residue_shape(name)
    tree = _tree(name)
    if name == "PRO" or any(a not in shape or a not in tree for a in moved) or not {"N", "CA", "CB"} <= set(there):
        return []
    order = [a for a in tree if a in moved]
    turning = {frozenset(bond) for bond in nx.bridges(_skeleton(name))} - {_RIGID}
    axes: dict[tuple[str, str], tuple[str, str, tuple[float, ...]]] = {}
    for atom, (p, g, q) in tree.items():
        if (g, p) not in axes and frozenset((g, p)) in turning:
            fixed = next((b for b, (pb, _, _) in tree.items() if pb == p and b in there), None)
            if fixed is None:
                axes[g, p] = q, atom, _PLANAR if _PLANAR_AT.get(name) == p else _STAGGERED
            else:
                axes[g, p] = q, fixed, (_torsion_deg(there, q, g, p, fixed),)
    out = []
    for chosen in product(*(values for *_, values in axes.values())):
        turn = {(g, p): value - _torsion_deg(shape, q, g, p, d)
                for ((g, p), (q, d, _)), value in zip(axes.items(), chosen, strict=True)}  # fmt: skip
        placed = dict(there)
        for atom in order:
            p, g, q = tree[atom]
            length = float(np.linalg.norm(shape[atom] - shape[p]))
            u, v = shape[g] - shape[p], shape[atom] - shape[p]
            bend = float(np.degrees(np.arccos(np.dot(u, v) / np.linalg.norm(u) / np.linalg.norm(v))))
            value = _torsion_deg(shape, q, g, p, atom) + turn.get((g, p), 0.0)
            placed[atom] = extend(placed[q], placed[g], placed[p], length, bend, value)
        out.append({a: placed[a] for a in moved})
    return out


@lru_cache(maxsize=64)
def _skeleton(name: str) -> nx.Graph:
    template = template_for(name)
    return nx.Graph() if template is None else nx.Graph(template.bonds)


@lru_cache(maxsize=64)
def _tree(name: str) -> dict[str, tuple[str, str, str]]:
    """Of each side-chain atom beyond CB, nearest first, the three atoms that it hangs on: parent, grandparent, and
    that one's parent."""
    graph = _skeleton(name)
    if "CB" not in graph:
        return {}
    graph = graph.subgraph([a for a in graph if a not in _BACKBONE])
    parent = {"CA": "N", **{b: a for a, b in nx.bfs_edges(graph, "CA")}}
    return {a: (parent[a], parent[parent[a]], parent[parent[parent[a]]]) for a in parent if a not in ("CA", "CB")}


def _torsion_deg(shape: Mapping[str, FloatArray], *names: str) -> float:
    return float(np.degrees(torsion(np.array([shape[k] for k in names]), [[0, 1, 2, 3]])[0]))
