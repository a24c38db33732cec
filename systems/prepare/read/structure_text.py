"""PDB and mmCIF files, read as atom records: order and names of the file survive."""

from __future__ import annotations

import math
from pathlib import Path

from systems.errors import InputError
from systems.prepare.read.file_text import read_text, suffix_of
from systems.prepare.read.mmcif_file import read_mmcif
from systems.prepare.read.pdb_columns import read_pdb
from systems.prepare.read.record_sorting import settle
from systems.prepare.read.records import StructureFile

_PDB_SUFFIXES = (".pdb", ".ent")
_CIF_SUFFIXES = (".cif", ".mmcif")
_FARTHEST_ANGSTROM = 9_999.0


def read_structure(path: Path) -> StructureFile:
    """Read a PDB or mmCIF file, gzipped or not.

    Raises InputError (one line: the file, what is wrong, what to do) for a missing file, a directory, a suffix that is
    neither, bytes that are no text, a record that cannot be read, no atoms, or positions that are not finite.
    """
    text = structure_text(path)
    if is_mmcif(path):
        found = read_mmcif(text, path)
    else:
        found = read_pdb(text, path)
    if not found.atoms and "_atom_site_fract_x" in text.lower():
        raise InputError(f"{path} is the CIF of a crystal, in fractions of its cell; give one molecule as SDF or PDB.")
    if not found.atoms:
        raise InputError(f"{path} holds no ATOM or HETATM record; give a PDB or mmCIF file with coordinates.")
    for atom in found.atoms:
        if not all(math.isfinite(x) for x in atom.position_angstrom):
            raise InputError(
                f"{path}: atom {atom.serial} ({atom.name}) has a position that is not a number; "
                "write the structure again from the program that made it."
            )
        if any(abs(x) > _FARTHEST_ANGSTROM for x in atom.position_angstrom):
            raise InputError(
                f"{path}: atom {atom.serial} ({atom.name}) lies beyond {_FARTHEST_ANGSTROM:,.0f} Å; "
                "centre the structure, or correct the coordinate."
            )
    return settle(found, path)


def is_mmcif(path: Path) -> bool:
    """Whether the suffix is one of mmCIF's."""
    return suffix_of(path) in _CIF_SUFFIXES


def structure_text(path: Path) -> str:
    """Return the text of a PDB or mmCIF file. Raises InputError for what is none."""
    known = ", ".join((*_PDB_SUFFIXES, *_CIF_SUFFIXES))
    if path.is_file() and suffix_of(path) not in (*_PDB_SUFFIXES, *_CIF_SUFFIXES):
        raise InputError(f"{path} has suffix {path.suffix!r}; structures are read from {known}, also gzipped.")
    return read_text(path, f"a structure with coordinates ({known})")
