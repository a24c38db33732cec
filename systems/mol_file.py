"""MDL MOL, SDF and Tripos MOL2 files as RDKit molecules with all hydrogens and one 3-D conformer."""

from __future__ import annotations

import gzip
import math
from pathlib import Path
from typing import Any

from systems.embedding import drop_isotopes, embed, require, sanitise
from systems.errors import InputError, PreparationError

SUFFIXES = (".sdf", ".sd", ".mol", ".mdl", ".mol2")
_CHARGE_TOLERANCE = 0.2


def read_molecule(path: Path, notes: list[str]) -> Any:
    """Return the first molecule of the file. Raises InputError or PreparationError; `notes` says what was changed."""
    from rdkit import Chem, rdBase

    molecule: Any
    text = _text(path)
    suffix = suffix_of(path)
    with rdBase.BlockLogs():
        if suffix == ".mol2":
            block = _first_mol2(text, path, notes)
            molecule = Chem.MolFromMol2Block(block, sanitize=False, removeHs=False, cleanupSubstructures=True)
        else:
            block = _first_mol_block(text, notes)
            molecule = Chem.MolFromMolBlock(block, sanitize=False, removeHs=False)
    if molecule is None:
        hint = " with SYBYL atom types" if suffix == ".mol2" else ""
        raise InputError(f"{path} holds no molecule that can be read as {suffix[1:].upper()}; write it again{hint}.")
    settled = settle_molecule(molecule, notes)
    if suffix == ".mol2":
        _check_charge(block, molecule)
    return settled


def settle_molecule(molecule: Any, notes: list[str]) -> Any:
    """Return an unsanitised molecule with all hydrogens, at its own positions if it has three-dimensional ones.

    Raises PreparationError for what is no molecule, or has atoms on one point.
    """
    require(molecule)
    sanitise(molecule)
    drop_isotopes(molecule, notes)
    return _with_geometry(molecule, notes)


def suffix_of(path: Path) -> str:
    """Suffix in lower case, that of the packed file where it ends in .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _text(path: Path) -> str:
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path.")
    if path.is_dir():
        raise InputError(f"{path} is a directory; give a structure file.")
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
    except (OSError, EOFError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); check the file.") from error
    if not data.strip():
        raise InputError(f"{path} is empty; give a molecule with coordinates.")
    return data.decode("utf-8", errors="replace").replace("\r\n", "\n")


def _first_mol_block(text: str, notes: list[str]) -> str:
    records = [r for r in text.split("$$$$") if r.strip()]
    if len(records) > 1:
        notes.append(f"{len(records)} molecules in the file: the first is taken")
    return records[0] if records else ""


def _first_mol2(text: str, path: Path, notes: list[str]) -> str:
    records = text.split("@<TRIPOS>MOLECULE")[1:]
    if not records:
        raise InputError(f"{path} has no @<TRIPOS>MOLECULE record; write it again as MOL2.")
    if len(records) > 1:
        notes.append(f"{len(records)} molecules in the file: the first is taken")
    return "@<TRIPOS>MOLECULE" + records[0]


def _check_charge(block: str, molecule: Any) -> None:
    """MOL2 has no formal charges: those that RDKit infers must add up to the partial charges of the file, if any."""
    lines = block.splitlines()
    if any(line.strip().upper() == "NO_CHARGES" for line in lines[:6]):
        return
    partial: list[float] = []
    inside = False
    for line in lines:
        if line.startswith("@<TRIPOS>"):
            inside = line.startswith("@<TRIPOS>ATOM")
        elif inside and len(fields := line.split()) >= 9:
            partial.append(float(fields[8]))
    formal = sum(a.GetFormalCharge() for a in molecule.GetAtoms())
    total = sum(partial)
    if any(partial) and abs(total - formal) > _CHARGE_TOLERANCE:
        raise PreparationError(
            f"its partial charges add up to {total:+.2f}, the charges its atom types imply to {formal:+d}; "
            "give the molecule as SDF, which states formal charges."
        )


def _with_geometry(molecule: Any, notes: list[str]) -> Any:
    from rdkit import Chem

    n_atoms = molecule.GetNumAtoms()
    conformer = molecule.GetConformer() if molecule.GetNumConformers() else None
    if conformer is None or not conformer.Is3D() or _is_unplaced(conformer, n_atoms):
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
    Chem.AssignStereochemistryFrom3D(out)
    return out


def _is_unplaced(conformer: Any, n_atoms: int) -> bool:
    """Whether a file calls 3-D what has no depth, or has all atoms on one point."""
    positions = conformer.GetPositions()
    return n_atoms > 1 and float(abs(positions - positions[0]).max()) < 1e-6


def _refuse_coincident(molecule: Any) -> None:
    import numpy as np
    from scipy.spatial import cKDTree

    positions = np.array(molecule.GetConformer().GetPositions())
    pairs = cKDTree(positions).query_pairs(0.3)
    if pairs:
        i, j = sorted(pairs)[0]
        symbols = [molecule.GetAtomWithIdx(k).GetSymbol() for k in (i, j)]
        raise PreparationError(
            f"atoms {i + 1} ({symbols[0]}) and {j + 1} ({symbols[1]}) stand on one point; correct the coordinates."
        )
