"""Tripos MOL2 files: elements, bonds and positions from the file; bond orders and charges perceived from them.

Peptides among them (standard residues, which a force field of peptides describes) become records of atoms.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np

from systems.chemistry.bond_orders import bent_carbons, lewis_structure
from systems.chemistry.element_data import element_symbol, ion_symbol, is_lone_ion
from systems.chemistry.residues import canonical_heavy_name, template_for
from systems.errors import InputError, PreparationError, listed
from systems.prepare.records import AtomRecord, StructureFile, read_text
from systems.scene import ATOMIC_NUMBERS, neighbours_of

_TWO_LETTERS = re.compile(r"cl|br|si|se", re.IGNORECASE)
_FIRST_LETTERS = ("H", "B", "C", "N", "O", "F", "P", "S", "I")
# Metals whose symbols begin no type of an organic atom.
_METALS = ("Li", "Mg", "Al", "K", "Ti", "Mn", "Fe", "Zn", "Mo", "Ru", "Rh", "Pd", "Ag", "Pt", "Au")
_ORDERS = {"1": 1, "2": 2, "3": 3, "am": 1}
# How far a sum of partial charges may be from a whole number and still mean it, and from the total without a word.
_WHOLE = 0.05
_TOLERANCE = 0.2


@dataclass
class Mol2(StructureFile):
    """The first molecule of a MOL2 file: `orders` of the bonds i < j, where any are stated; `charge`: the sum of the
    partial charges, None where there are none."""

    orders: dict[tuple[int, int], int] = field(default_factory=dict)
    charge: float | None = None


def read_mol2(path: Path) -> Mol2:
    """Read the first molecule. Raises InputError for what is no MOL2, a record that cannot be read or no element."""
    text = read_text(path, "a molecule with coordinates")
    records = re.split(r"^@<TRIPOS>MOLECULE[^\n]*\n", text, flags=re.MULTILINE | re.IGNORECASE)[1:]
    sections = _sections(records[0] if records else "")
    atoms, bonds = sections.get("ATOM", []), sections.get("BOND", [])
    if not atoms:
        raise InputError(f"{path} has no @<TRIPOS>MOLECULE record, or no atoms in it; write it again as MOL2.")
    found = Mol2([])
    if len(records) > 1:
        found.notes.append(f"{len(records)} molecules in the file: the first is taken")
    index = {row[0]: k for k, row in enumerate(atoms)}
    for row in bonds:
        if len(row) < 4 or row[1] not in index or row[2] not in index or row[1] == row[2]:
            raise InputError(f"{path}: the bond record {' '.join(row)!r} joins no two atoms of the file.")
        i, j = sorted((index[row[1]], index[row[2]]))
        if row[3].lower() != "nc":
            found.orders[i, j] = _ORDERS.get(row[3].lower(), 0)
    found.conect = sorted(found.orders)
    bonded = {i for pair in found.conect for i in pair}
    for k, row in enumerate(atoms):
        symbol = element_of(row[5], row[1], alone=k not in bonded) if len(row) > 5 else None
        try:
            x, y, z = (float(value) for value in row[2:5])
        except ValueError:
            symbol = None
        if symbol is None or not np.isfinite([x, y, z]).all() or len(index) < len(atoms):
            raise InputError(
                f"{path}: the atom record {' '.join(row)!r} has no number of its own, no three coordinates or no "
                "recognisable element; write the file again."
            )
        number, residue = row[6] if len(row) > 6 else "1", row[7] if len(row) > 7 else "MOL"
        residue = residue.removesuffix(number) if len(residue) > 3 else residue  # LYS1
        found.atoms.append(AtomRecord(row[1], symbol, residue, "", number, (x, y, z), str(k + 1)))
    if not any(order > 1 for order in found.orders.values()) and "ar" not in {row[3].lower() for row in bonds}:
        found.orders = {}
    partial = [
        float(row[8]) for row in atoms if len(row) > 8 and re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", row[8], re.I)
    ]
    found.charge = sum(partial) if len(partial) == len(atoms) and any(partial) else None
    return found


def is_peptide(found: StructureFile) -> bool:
    """Whether a file has two or more standard residues, by their names and atoms."""
    standard = set()
    for atom in found.atoms:
        template = template_for(atom.residue_name)
        if template is None:
            continue
        if atom.element != "H" and canonical_heavy_name(template, atom.name) is None:
            return False
        standard.add(atom.residue_key)
    return len(standard) > 1


def element_of(atom_type: str, name: str, *, alone: bool = False) -> str | None:
    """Return the element of an atom by its type of SYBYL, Amber, GAFF, CGenFF or OPLS, else by its name, or None.

    `C.ar` and `Cl` are SYBYL's. Force fields begin a type with the element's letter (`c3`, `CT`, `2C`, `HGA1`), but for
    chlorine, bromine, silicon, selenium and metals; `opls_135` and `DU` say nothing. An atom without bonds is an ion
    where its name is one's.
    """
    head, dot, _ = atom_type.partition(".")
    ion = next((e for e in map(ion_symbol, (name, head)) if e is not None), None) if alone else None
    if ion is not None:
        return ion
    if dot and head.capitalize() in ATOMIC_NUMBERS:
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


def molecule_of(found: Mol2) -> Any:
    """Return the RDKit molecule (unsanitised, hydrogens explicit) with perceived orders and charges. Each molecule of a
    file is perceived by itself. Of structures that differ in their charge, that of the partial charges is chosen.
    Raises PreparationError where no Lewis structure fits, or the geometry says that hydrogens are missing."""
    from rdkit import Chem

    molecule = Chem.RWMol()
    for each in found.atoms:
        molecule.AddAtom(Chem.Atom(each.element))
    graph = nx.Graph(found.conect)
    graph.add_nodes_from(range(len(found.atoms)))
    parts = [sorted(part) for part in nx.connected_components(graph)]
    meant = found.charge if len(parts) == 1 else None
    total = 0
    for part in parts:
        if len(part) == 1 and is_lone_ion(found.atoms[part[0]].element):
            continue  # RDKit's own ions
        pairs = sorted((min(pair), max(pair)) for pair in graph.edges(part))
        orders, charges = _perceived(found, part, pairs, meant)
        for i, charge in zip(part, charges, strict=True):
            molecule.GetAtomWithIdx(i).SetFormalCharge(charge)
            molecule.GetAtomWithIdx(i).SetNoImplicit(True)
        for pair, order in zip(pairs, orders, strict=True):
            molecule.AddBond(*pair, Chem.BondType.values[order])
        total += sum(charges)
    if found.charge is not None and abs(found.charge - total) > _TOLERANCE:
        found.notes.append(
            f"its partial charges add up to {found.charge:+.2f}; its atoms and bonds to {total:+d}, which is taken"
        )
    conformer = Chem.Conformer(len(found.atoms))
    conformer.SetPositions(np.array([each.position_angstrom for each in found.atoms]))
    molecule.AddConformer(conformer)
    return molecule


def _perceived(
    found: Mol2, part: Sequence[int], pairs: Sequence[tuple[int, int]], charge: float | None
) -> tuple[list[int], list[int]]:
    """Return the orders of `pairs` and the charges of one molecule's atoms; `charge`: what its partial charges say."""
    rank = {i: k for k, i in enumerate(part)}
    local = np.array([[rank[i], rank[j]] for i, j in pairs], dtype=np.int64).reshape(-1, 2)
    elements = [found.atoms[i].element for i in part]
    stated = {(rank[i], rank[j]): found.orders[i, j] for i, j in pairs if found.orders.get((i, j))}
    solved = lewis_structure(elements, local, stated=stated)
    meant = None if charge is None or abs(charge - round(charge)) > _WHOLE else round(charge)
    if meant is not None and (solved is None or int(solved[1].sum()) != meant):
        other = lewis_structure(elements, local, stated=stated, total_charge=meant, carbon_ions=solved is None)
        solved = other or solved
    flat = range(len(part)) if solved is None else np.flatnonzero(solved[1] >= 0).tolist()
    x = np.array([found.atoms[i].position_angstrom for i in part]) / 10.0
    bent = bent_carbons(elements, neighbours_of(local, len(part)), flat, x)
    if bent or solved is None:
        why = (
            f"{listed([found.atoms[part[k]].name for k in bent])} lack hydrogens"
            if bent
            else "it has no valid Lewis structure"
        )
        raise PreparationError(f"{why}; give the molecule with all hydrogens, or as SDF.")
    return [round(order) for order in solved[0].tolist()], [int(q) for q in solved[1].tolist()]


def _sections(record: str) -> dict[str, list[list[str]]]:
    out: dict[str, list[list[str]]] = {}
    rows: list[list[str]] = []
    for line in record.replace("\\\n", " ").splitlines():
        if line.upper().startswith("@<TRIPOS>"):
            rows = out.setdefault(line[9:].strip().upper(), [])
        elif line.strip() and not line.startswith("#"):
            rows.append(line.split())
    return out
