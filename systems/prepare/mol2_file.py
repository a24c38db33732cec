"""Tripos MOL2 files: elements, bonds and positions from the file; bond orders and charges perceived from them.

Peptides among them (standard residues, which a force field of peptides describes) become records of atoms.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from systems.chemistry.bond_orders import bent_carbons, lewis_structure
from systems.chemistry.distance_bonds import bonded_images, bonds_by_distance, cell_of, images_of_whole
from systems.chemistry.element_data import element_symbol, ion_symbol, is_element, is_lone_ion
from systems.chemistry.residues import canonical_heavy_name, template_for
from systems.errors import InputError, PreparationError
from systems.prepare.records import AtomRecord, StructureFile, read_text
from systems.scene import FloatArray, IntArray, neighbours_of

_TWO_LETTERS = re.compile(r"cl|br|si|se", re.IGNORECASE)
_FIRST_LETTERS = ("H", "B", "C", "N", "O", "F", "P", "S", "I")
# Metals whose symbols begin no type of an organic atom.
_METALS = ("Li", "Mg", "Al", "K", "Ti", "Mn", "Fe", "Zn", "Mo", "Ru", "Rh", "Pd", "Ag", "Pt", "Au")
_NO_TYPE = ("du", "lp", "any", "hal", "het", "hev")
_ORDERS = {"1": 1, "2": 2, "3": 3, "am": 1}
# How far a sum of partial charges may be from a whole number and still mean it, and from the total without a word.
_WHOLE = 0.05
_TOLERANCE = 0.2


@dataclass(frozen=True)
class Mol2:
    """The first molecule of a MOL2 file. `orders` holds those that are stated, for pairs i < j; `charge` the sum of the
    partial charges, None where there are none; `residues` the (number, name) of each atom; `block` the molecule as
    MOL2, for readers of SYBYL's types."""

    names: tuple[str, ...]
    elements: tuple[str, ...]
    positions_nm: FloatArray
    bonds: IntArray
    orders: dict[tuple[int, int], int]
    charge: float | None
    residues: tuple[tuple[str, str], ...]
    block: str


def read_mol2(text: str, path: Path, notes: list[str]) -> Mol2:
    """Read the first molecule. Raises InputError for what is no MOL2, a record that cannot be read or no element."""
    records = re.split(r"^@<TRIPOS>MOLECULE[^\n]*\n", text, flags=re.MULTILINE | re.IGNORECASE)[1:]
    if not records:
        raise InputError(f"{path} has no @<TRIPOS>MOLECULE record; write it again as MOL2.")
    if len(records) > 1:
        notes.append(f"{len(records)} molecules in the file: the first is taken")
    sections = _sections(records[0])
    atoms = sections.get("ATOM", [])
    if not atoms:
        raise InputError(f"{path} has no atoms in its first molecule; write it again as MOL2.")
    number_of: dict[str, int] = {}
    positions = []
    for k, row in enumerate(atoms):
        if len(row) < 6:
            raise InputError(f"{path}: the atom record {' '.join(row)!r} is cut short; write the file again.")
        number_of[row[0]] = k
        try:
            positions.append([float(value) for value in row[2:5]])
        except ValueError:
            raise InputError(f"{path}: the coordinates of atom {row[0]} ({row[1]}) are no numbers.") from None
    if len(number_of) < len(atoms):
        raise InputError(f"{path}: two atoms have one number; write the file again.")
    bonds, orders = _bonds(sections.get("BOND", []), number_of, path)
    alone = set(range(len(atoms))) - {i for pair in bonds for i in pair}
    elements = []
    for k, row in enumerate(atoms):
        symbol = element_of(row[5], row[1], alone=k in alone)
        if symbol is None:
            raise InputError(f"{path}: atom {row[0]} ({row[1]}, type {row[5]}) has no recognisable element.")
        elements.append(symbol)
    x = np.array(positions) / 10.0
    if not np.isfinite(x).all():
        raise InputError(f"{path}: a coordinate is not a number; write the file again.")
    cell = _cell(sections.get("CRYSIN", []))
    if cell is not None:
        images = images_of_whole(x, cell, np.array(sorted(bonds)) if bonds else bonded_images(elements, x, cell)[0])
        if images.any():
            x = x + images @ cell
            for row, (a, b, c) in zip(atoms, (10.0 * x).tolist(), strict=True):
                row[2:5] = [f"{a:.6f}", f"{b:.6f}", f"{c:.6f}"]
            notes.append(
                f"made whole by the periodic cell: {int(images.any(axis=1).sum())} atoms moved by cell vectors"
            )
    if not bonds and len(atoms) > 1:
        bonds = {(int(i), int(j)) for i, j in bonds_by_distance(elements, x)}
        notes.append("no bonds in the file: bonds from distances")
    is_typed = "ar" in {row[3].lower() for row in sections.get("BOND", []) if len(row) > 3}
    partial = [
        float(row[8]) for row in atoms if len(row) > 8 and re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", row[8], re.I)
    ]
    return Mol2(
        names=tuple(row[1] for row in atoms),
        elements=tuple(elements),
        positions_nm=x,
        bonds=np.array(sorted(bonds), dtype=np.int64).reshape(-1, 2),
        orders=orders if any(order > 1 for order in orders.values()) or is_typed else {},
        charge=sum(partial) if len(partial) == len(atoms) and any(partial) else None,
        residues=tuple((row[6] if len(row) > 6 else "1", row[7] if len(row) > 7 else "MOL") for row in atoms),
        block=_rewritten(atoms, sections.get("BOND", []), number_of),
    )


def element_of(atom_type: str, name: str, *, alone: bool = False) -> str | None:
    """Return the element of an atom by its type of SYBYL, Amber, GAFF, CGenFF or OPLS, else by its name, or None.

    `C.ar` and `Cl` are SYBYL's. Force fields begin a type with the element's letter (`c3`, `CT`, `2C`, `HGA1`), but for
    chlorine, bromine, silicon, selenium and metals; `opls_135` and `DU` say nothing. An atom without bonds is an ion
    where its name is one's.
    """
    head, dot, _ = atom_type.partition(".")
    if head.lower() in _NO_TYPE:
        return element_symbol(name, "LIG", "", hetero=True)
    ion = next((e for e in map(ion_symbol, (name, head)) if e is not None), None) if alone else None
    if ion is not None:
        return ion
    if dot and is_element(head.capitalize()):
        return head.capitalize()
    letters = head.lstrip("0123456789")
    if letters.isalpha() and letters.capitalize() in _METALS:
        return letters.capitalize()
    two = _TWO_LETTERS.match(letters)
    if two:
        return two[0].capitalize()
    if letters[:1].upper() in _FIRST_LETTERS and not letters.lower().startswith("opls"):
        return letters[0].upper()
    return element_symbol(name, "LIG", "", hetero=True)


def molecule_of(found: Mol2, notes: list[str]) -> Any | None:
    """Return the RDKit molecule (unsanitised, hydrogens explicit) with perceived orders and charges, or None.

    None where no Lewis structure fits or the geometry says that hydrogens are missing. Each molecule of a file is
    perceived by itself. Of structures that differ in their charge, that of the partial charges is chosen.
    """
    from rdkit import Chem

    graph = nx.Graph(found.bonds.tolist())
    graph.add_nodes_from(range(len(found.elements)))
    orders: dict[tuple[int, int], int] = {}
    charges: dict[int, int] = {}
    parts = [sorted(part) for part in nx.connected_components(graph)]
    for atoms in parts:
        if len(atoms) == 1 and is_lone_ion(found.elements[atoms[0]]):
            continue  # RDKit's own ions
        if not _perceive(found, graph, atoms, orders, charges, alone=len(parts) == 1):
            return None
    total = sum(charges.values())
    if found.charge is not None and abs(found.charge - total) > _TOLERANCE:
        notes.append(
            f"its partial charges add up to {found.charge:+.2f}; its atoms and bonds to {total:+d}, which is taken"
        )
    molecule = Chem.RWMol()
    for i, symbol in enumerate(found.elements):
        atom = Chem.Atom(symbol)
        atom.SetFormalCharge(charges.get(i, 0))
        atom.SetNoImplicit(i in charges)
        molecule.AddAtom(atom)
    for pair, order in orders.items():
        molecule.AddBond(*pair, Chem.BondType.values[order])
    add_conformer(molecule, (10.0 * found.positions_nm).tolist())
    return molecule


def add_conformer(molecule: Any, positions_angstrom: Sequence[Sequence[float]]) -> None:
    """Give an RDKit molecule these positions `(n_atoms, 3)`."""
    from rdkit import Chem

    conformer = Chem.Conformer(len(positions_angstrom))
    conformer.Set3D(True)
    for i, place in enumerate(positions_angstrom):
        conformer.SetAtomPosition(i, place)
    molecule.AddConformer(conformer, assignId=True)


def _perceive(
    found: Mol2,
    graph: nx.Graph,
    atoms: list[int],
    orders: dict[tuple[int, int], int],
    charges: dict[int, int],
    *,
    alone: bool,
) -> bool:
    """Add the orders and charges of one molecule of the file; False where nothing fits."""
    rank = {i: k for k, i in enumerate(atoms)}
    pairs = [(i, j) for i, j in found.bonds.tolist() if i in rank]
    local = np.array([[rank[i], rank[j]] for i, j in pairs], dtype=np.int64).reshape(-1, 2)
    elements = [found.elements[i] for i in atoms]
    stated = {(rank[i], rank[j]): order for (i, j), order in found.orders.items() if i in rank}
    meant = None
    if alone and found.charge is not None and abs(found.charge - round(found.charge)) <= _WHOLE:
        meant = round(found.charge)
    solved = lewis_structure(elements, local, stated=stated)
    if meant is not None and (solved is None or int(solved[1].sum()) != meant):
        solved = (
            lewis_structure(elements, local, stated=stated, total_charge=meant, carbon_ions=solved is None) or solved
        )
    if solved is None:
        return False
    neighbours = [sorted(rank[j] for j in graph[i]) for i in atoms]
    flat = {k for k, q in enumerate(solved[1].tolist()) if elements[k] == "C" and q >= 0}
    if not _is_drawing(found, graph) and bent_carbons(elements, neighbours, flat, found.positions_nm[atoms]):
        return False
    orders |= {pair: round(order) for pair, order in zip(pairs, solved[0].tolist(), strict=True)}
    charges |= {i: int(q) for i, q in zip(atoms, solved[1].tolist(), strict=True)}
    return True


def missing_hydrogens(found: Mol2) -> PreparationError:
    """Return the error for a molecule without a Lewis structure, naming the atoms whose geometry says why, if any."""
    n = len(found.elements)
    bent = bent_carbons(found.elements, neighbours_of(found.bonds, n), range(n), found.positions_nm)
    if bent:
        names = ", ".join(found.names[i] for i in bent[:4])
        return PreparationError(f"{names} lack hydrogens; give the molecule with all hydrogens, or as SDF.")
    return PreparationError("its bonds fit no valence; give the molecule with all hydrogens, or as SDF.")


def _is_drawing(found: Mol2, graph: nx.Graph) -> bool:
    """Whether all lies in the plane z = 0, atoms with four neighbours too: MOL2 has no word for a drawing."""
    flat = not found.positions_nm[:, 2].any()
    return flat and any(found.elements[i] == "C" and degree == 4 for i, degree in graph.degree())


def _sections(record: str) -> dict[str, list[list[str]]]:
    out: dict[str, list[list[str]]] = {}
    rows: list[list[str]] = []
    for line in record.replace("\\\n", " ").splitlines():
        if line.upper().startswith("@<TRIPOS>"):
            rows = out.setdefault(line[9:].strip().upper(), [])
        elif line.strip() and not line.startswith("#"):
            rows.append(line.split())
    return out


def _rewritten(atoms: list[list[str]], bonds: list[list[str]], number_of: dict[str, int]) -> str:
    """The molecule as its shortest file: other readers trust the counts of the header and the numbers of atoms."""
    head = ["@<TRIPOS>MOLECULE", "MOL", f"{len(atoms)} {len(bonds)} 0 0 0", "SMALL", "NO_CHARGES", ""]
    rows = [" ".join([str(k + 1), row[1], *row[2:6], "1", "MOL", "0.0"]) for k, row in enumerate(atoms)]
    joined = [f"{k + 1} {number_of[row[1]] + 1} {number_of[row[2]] + 1} {row[3]}" for k, row in enumerate(bonds)]
    return "\n".join([*head, "@<TRIPOS>ATOM", *rows, "@<TRIPOS>BOND", *joined, ""])


def _cell(rows: list[list[str]]) -> Any:
    """Box vectors `(3, 3)` nm of a CRYSIN record, or None."""
    try:
        return cell_of([float(value) for value in rows[0][:6]]) if rows else None
    except ValueError:
        return None


def _bonds(
    rows: list[list[str]], number_of: dict[str, int], path: Path
) -> tuple[set[tuple[int, int]], dict[tuple[int, int], int]]:
    bonds: set[tuple[int, int]] = set()
    orders: dict[tuple[int, int], int] = {}
    for row in rows:
        if len(row) < 4 or row[1] not in number_of or row[2] not in number_of or row[1] == row[2]:
            raise InputError(f"{path}: the bond record {' '.join(row)!r} joins no two atoms of the file.")
        kind = row[3].lower()
        if kind == "nc":
            continue
        i, j = sorted((number_of[row[1]], number_of[row[2]]))
        bonds.add((i, j))
        if kind in _ORDERS:
            orders[i, j] = _ORDERS[kind]
    return bonds, orders


# ---- peptides -------------------------------------------------------------------------------------------------------


def is_peptide_mol2(path: Path) -> bool:
    """Whether the first molecule of a MOL2 file has two or more standard residues, by their names and atoms."""
    try:
        found = read_mol2(read_text(path, "a molecule with coordinates"), path, [])
    except InputError:
        return False  # to be refused where it is read
    standard: set[tuple[str, str]] = set()
    for (number, written), name, element in zip(found.residues, found.names, found.elements, strict=True):
        template = template_for(_residue_name(number, written))
        if template is None:
            continue
        if element != "H" and canonical_heavy_name(template, name) is None:
            return False
        standard.add((number, written))
    return len(standard) > 1


def read_peptide_mol2(path: Path) -> StructureFile:
    """Return the atoms of a peptide's MOL2 file, in its order, and its bonds. Raises InputError; see `read_mol2`."""
    notes: list[str] = []
    found = read_mol2(read_text(path, "a molecule with coordinates"), path, notes)
    atoms = [
        AtomRecord(name, element, _residue_name(*residue), "", residue[0], (x, y, z), str(k))
        for k, (name, element, residue, (x, y, z)) in enumerate(
            zip(found.names, found.elements, found.residues, (10.0 * found.positions_nm).tolist(), strict=True), start=1
        )
    ]
    return StructureFile(atoms, conect=[(i, j) for i, j in found.bonds.tolist()], notes=notes)


def _residue_name(number: str, written: str) -> str:
    """`LYS` of substructure 1 called LYS1."""
    return written.removesuffix(number) if len(written) > 3 else written
