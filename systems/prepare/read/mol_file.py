"""MDL MOL, SDF and Tripos MOL2 files as RDKit molecules with all hydrogens and one 3-D conformer."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import refuse_long_bonds
from systems.chemistry.geometry import near_pairs
from systems.errors import InputError, PreparationError
from systems.prepare.read.mol2_file import Mol2, missing_hydrogens, molecule_of, read_mol2
from systems.prepare.read.records import read_text, suffix_of
from systems.prepare.read.smiles import drop_isotopes, embed, main_molecule, require, sanitise

SUFFIXES = (".sdf", ".sd", ".mol", ".mdl", ".mol2")


def read_molecule(path: Path, notes: list[str]) -> Any:
    """Return the first molecule of the file. Raises InputError or PreparationError; `notes` says what was changed."""
    from rdkit import Chem, rdBase

    text = read_text(path, "a molecule with coordinates")
    with rdBase.BlockLogs():
        if suffix_of(path) == ".mol2":
            return _read_mol2(text, path, notes)
        molecule = Chem.MolFromMolBlock(_first_mol_block(text, notes), sanitize=False, removeHs=False)
    if molecule is None:
        raise InputError(f"{path} holds no molecule that can be read as {suffix_of(path)[1:].upper()}; write it again.")
    return resolve_molecule(main_molecule(molecule, notes), notes)


def _read_mol2(text: str, path: Path, notes: list[str]) -> Any:
    """MOL2 with all hydrogens by its elements and bonds; without them by its types, if they are SYBYL's."""
    found = read_mol2(text, path, notes)
    if "H" in found.elements or "C" not in found.elements:
        molecule = molecule_of(found, notes) or _by_types(found)
    else:  # most often a file that leaves its hydrogens out
        molecule = _by_types(found) or molecule_of(found, notes)
    if molecule is None:
        raise missing_hydrogens(found)
    return resolve_molecule(main_molecule(molecule, notes), notes)


def _by_types(found: Mol2) -> Any | None:
    """RDKit's reading, where it finds the same elements (other programs' types are none) and hydrogens to add."""
    from rdkit import Chem

    molecule = Chem.MolFromMol2Block(found.block, sanitize=False, removeHs=False, cleanupSubstructures=True)
    if molecule is None or tuple(a.GetSymbol() for a in molecule.GetAtoms()) != found.elements:
        return None
    _draw_nitro(molecule)
    for atom in molecule.GetAtoms():
        atom.SetNoImplicit(False)  # its reader expects all hydrogens, and makes anions of hydroxyls and amines without
        is_anion = atom.GetFormalCharge() < 0 and all(a.GetFormalCharge() <= 0 for a in atom.GetNeighbors())
        if is_anion and "H" not in found.elements and atom.GetProp("_TriposAtomType") != "O.co2":
            atom.SetFormalCharge(0)
    try:
        sanitise(molecule)
    except PreparationError:
        return None
    return molecule if any(a.GetNumImplicitHs() for a in molecule.GetAtoms()) else None


def _draw_nitro(molecule: Any) -> None:
    """Give nitro groups of two single bonds (antechamber's) one double bond and their charges, in place."""
    from rdkit import Chem

    for atom in molecule.GetAtoms():
        ends = [b for b in atom.GetBonds() if b.GetOtherAtom(atom).GetSymbol() == "O"
                and b.GetOtherAtom(atom).GetDegree() == 1]  # fmt: skip
        if atom.GetSymbol() != "N" or len(ends) != 2 or any(b.GetBondType() != Chem.BondType.SINGLE for b in ends):
            continue
        ends[0].SetBondType(Chem.BondType.DOUBLE)
        for one, charge in ((atom, 1), (ends[0].GetOtherAtom(atom), 0), (ends[1].GetOtherAtom(atom), -1)):
            one.SetFormalCharge(charge)


def resolve_molecule(molecule: Any, notes: list[str]) -> Any:
    """Return an unsanitised molecule with all hydrogens, at its own positions if it has three-dimensional ones.

    Valences that are impossible as written are perceived anew, and said. Raises PreparationError for what is no
    molecule, or has atoms on one point.
    """
    require(molecule)
    try:
        sanitise(molecule)
    except PreparationError as error:
        repaired = _with_charges(molecule, notes) or _reperceived(molecule, notes)
        if repaired is None:
            raise error
        molecule = repaired
    drop_isotopes(molecule, notes)
    return _with_geometry(molecule, notes)


def _with_charges(molecule: Any, notes: list[str]) -> Any | None:
    """With the charge that nitrogen of four bonds, oxygen of three and boron of four have, where none is written."""
    from rdkit import Chem

    out = Chem.Mol(molecule)
    changed = []
    for atom in out.GetAtoms():
        valence = sum(bond.GetBondTypeAsDouble() for bond in atom.GetBonds())
        charge = {("N", 4): 1, ("O", 3): 1, ("B", 4): -1}.get((atom.GetSymbol(), valence))
        if charge is not None and not atom.GetFormalCharge():
            atom.SetFormalCharge(charge)
            changed.append(f"{atom.GetSymbol()}{atom.GetIdx() + 1} {charge:+d}")
    try:
        sanitise(out)
    except PreparationError:
        return None
    notes.append(f"charges that the file leaves out, from the number of bonds: {', '.join(changed)}")
    return out


def _reperceived(molecule: Any, notes: list[str]) -> Any | None:
    """With the bond orders and charges of its elements and bonds, all of whose hydrogens must be there, in space."""
    if not molecule.GetNumConformers() or not molecule.GetConformer().Is3D():
        return None
    elements = tuple(atom.GetSymbol() for atom in molecule.GetAtoms())
    rows = {
        tuple(sorted((b.GetBeginAtomIdx(), b.GetEndAtomIdx()))): b.GetBondTypeAsDouble() for b in molecule.GetBonds()
    }
    found = Mol2(
        names=elements,
        elements=elements,
        positions_nm=np.array(molecule.GetConformer().GetPositions()) / 10.0,
        bonds=np.array(sorted(rows), dtype=np.int64).reshape(-1, 2),
        orders={(i, j): round(order) for (i, j), order in rows.items() if order in (1, 2, 3)},
        charge=None,
        residues=(),
        block="",
    )
    out = molecule_of(found, [])
    if out is not None:
        try:
            sanitise(out)
        except PreparationError:
            return None
        total = sum(atom.GetFormalCharge() for atom in out.GetAtoms())
        notes.append(f"its valences are impossible as written: orders and charges perceived, total {total:+d}")
    return out


def _first_mol_block(text: str, notes: list[str]) -> str:
    records = [r for r in text.split("$$$$") if r.strip()]
    if len(records) > 1:
        notes.append(f"{len(records)} molecules in the file: the first is taken")
    return records[0] if records else ""


def _with_geometry(molecule: Any, notes: list[str]) -> Any:
    from rdkit import Chem

    n_atoms = molecule.GetNumAtoms()
    conformer = molecule.GetConformer() if molecule.GetNumConformers() else None
    if conformer is None or _is_drawing(molecule, conformer):
        if conformer is not None and n_atoms > 1:
            Chem.AssignChiralTypesFromBondDirs(molecule)
            Chem.DetectBondStereochemistry(molecule)
        Chem.AssignStereochemistry(molecule, cleanIt=True, force=True)
        out = Chem.AddHs(molecule)
        if out.GetNumAtoms() > n_atoms:
            notes.append(f"hydrogens added: {out.GetNumAtoms() - n_atoms}")
        notes.append("a flat drawing: 3-D coordinates embedded, stereo from its wedges")
        return embed(out, seed=0, notes=notes)
    for x, y, z in conformer.GetPositions().tolist():
        if not all(map(math.isfinite, (x, y, z))):
            raise PreparationError("a coordinate is not a number; write the file again.")
    out = Chem.AddHs(molecule, addCoords=True)
    if out.GetNumAtoms() > n_atoms:
        notes.append(f"hydrogens added: {out.GetNumAtoms() - n_atoms}")
    _refuse_coincident(out)
    _refuse_broken(out)
    Chem.AssignStereochemistryFrom3D(out)
    return out


def _is_drawing(molecule: Any, conformer: Any) -> bool:
    """Whether positions are none: the file says so, or all atoms are on one point, or in one plane that cannot be."""
    positions = conformer.GetPositions()
    if not conformer.Is3D():
        return True
    if len(positions) > 1 and float(abs(positions - positions[0]).max()) < 1e-6:
        return True
    return not positions[:, 2].any() and any(
        atom.GetSymbol() == "C" and atom.GetTotalDegree() == 4 and atom.GetDegree() > 2 for atom in molecule.GetAtoms()
    )


def _refuse_broken(molecule: Any) -> None:
    atoms = [atom.GetSymbol() for atom in molecule.GetAtoms()]
    bonds = np.array([(b.GetBeginAtomIdx(), b.GetEndAtomIdx()) for b in molecule.GetBonds()], dtype=np.int64)
    positions_nm = np.array(molecule.GetConformer().GetPositions()) / 10.0
    refuse_long_bonds(atoms, positions_nm, bonds, lambda i: f"{atoms[i]}{i + 1}")


def _refuse_coincident(molecule: Any) -> None:
    positions = np.array(molecule.GetConformer().GetPositions())
    pairs = near_pairs(positions, 0.3, "the molecule")
    if len(pairs):
        i, j = pairs[0].tolist()
        symbols = [molecule.GetAtomWithIdx(k).GetSymbol() for k in (i, j)]
        raise PreparationError(
            f"atoms {i + 1} ({symbols[0]}) and {j + 1} ({symbols[1]}) stand on one point; correct the coordinates."
        )
