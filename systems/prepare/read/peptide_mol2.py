"""Peptides in MOL2 files: standard residues, which a force field of peptides describes, as records of atoms."""

from __future__ import annotations

from pathlib import Path

from systems.chemistry.residues import canonical_heavy_name, template_for
from systems.errors import InputError
from systems.prepare.read.file_text import read_text
from systems.prepare.read.mol2_file import Mol2, read_mol2
from systems.prepare.read.records import AtomRecord, StructureFile


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
    found: Mol2 = read_mol2(read_text(path, "a molecule with coordinates"), path, notes)
    atoms = [
        AtomRecord(
            serial=str(k + 1),
            name=found.names[k],
            altloc="",
            residue_name=_residue_name(*found.residues[k]),
            chain="",
            residue_id=found.residues[k][0],
            position_angstrom=(x, y, z),
            occupancy=1.0,
            element=found.elements[k],
            hetero=False,
        )
        for k, (x, y, z) in enumerate((10.0 * found.positions_nm).tolist())
    ]
    return StructureFile(atoms, conect=[(i, j) for i, j in found.bonds.tolist()], notes=notes)


def _residue_name(number: str, written: str) -> str:
    """`LYS` of substructure 1 called LYS1."""
    return written.removesuffix(number) if len(written) > 3 else written
