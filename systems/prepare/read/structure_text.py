"""PDB and mmCIF files, read as atom records: order and names of the file survive.

PDB text is read column by column and strictly; gemmi reads what the header says of bonds. It reads ATOM records, too,
and is not used for them: it takes `**.***` and blanks for 0, joins the parts of a residue that stand apart, and cuts
residue names at three letters (TIP3 becomes TIP of chain 3). Duplicates and virtual sites are left out, repeated
residue numbers told apart.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.distance_bonds import cell_of
from systems.chemistry.element_data import element_symbol, repeats_name
from systems.chemistry.residues import is_water_name, template_for
from systems.errors import InputError, listed
from systems.prepare.read.mmcif_file import read_mmcif
from systems.prepare.read.records import AtomRecord, StructureFile, coordinates, read_text, suffix_of

_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"


def decode(field: str, width: int) -> int | None:
    """Return the number in a field of `width` columns, or None where it is neither decimal nor hybrid-36.

    Source: Grosse-Kunstleve et al., cci.lbl.gov/hybrid_36.
    """
    text = field.strip()
    if text.lstrip("-").isdigit():
        return int(text)
    if len(text) != width or not text[0].isalpha() or not text.isascii() or not text.isalnum():
        return None
    lower = text[0].islower()
    if any(c.isalpha() and c.islower() != lower for c in text):
        return None
    start = 10**width + (26 * 36 ** (width - 1) if lower else 0)
    return start + int(text, 36) - 10 * 36 ** (width - 1)


def encode(number: int, width: int) -> str | None:
    """Return `number` in `width` columns, decimal where it fits, or None beyond hybrid-36."""
    if 10**width > number > -(10 ** (width - 1)):
        return f"{number:{width}d}"
    value = number - 10**width
    block = 26 * 36 ** (width - 1)
    if not 0 <= value < 2 * block:
        return None
    lower = value >= block
    value = value % block + 10 * 36 ** (width - 1)
    text = ""
    while value:
        value, digit = divmod(value, 36)
        text = _DIGITS[digit] + text
    return text.lower() if lower else text


# ---- columns of PDB files -------------------------------------------------------------------------------------------


# All records of the PDB format, version 3.3 and before, and those that other programs add.
_RECORDS = frozenset((
    "HEADER", "OBSLTE", "TITLE", "SPLIT", "CAVEAT", "COMPND", "SOURCE", "KEYWDS", "EXPDTA", "NUMMDL", "MDLTYP",
    "AUTHOR", "REVDAT", "SPRSDE", "JRNL", "REMARK", "FTNOTE", "DBREF", "DBREF1", "DBREF2", "SEQADV", "SEQRES", "MODRES",
    "HET", "HETNAM", "HETSYN", "FORMUL", "HELIX", "SHEET", "TURN", "SSBOND", "LINK", "LINKR", "HYDBND", "SLTBRG",
    "CISPEP", "SITE", "CRYST1", "ORIGX1", "ORIGX2", "ORIGX3", "SCALE1", "SCALE2", "SCALE3", "MTRIX1", "MTRIX2",
    "MTRIX3", "TVECT", "MODEL", "ATOM", "ANISOU", "SIGATM", "SIGUIJ", "TER", "HETATM", "ENDMDL", "CONECT", "MASTER",
    "END", "USER",
))  # fmt: skip
# An atom under a misspelt record, and no table of energies: %8.3f three times, blanks before.
_WRITTEN = re.compile(r" *-?\d+\.\d{3}", re.ASCII)


def read_pdb(text: str, path: Path) -> StructureFile:
    """Return the first model of the first structure. Raises InputError for an atom record that is not in columns."""
    found = StructureFile([])
    index_of: dict[str, int] = {}
    repeated: set[str] = set()
    conect_lines: list[str] = []
    header: list[str] = []
    model_ended = structure_ended = False
    n_models = n_beyond = n_misread = 0
    segment = ""
    for number, line in enumerate(text.splitlines(), start=1):
        record = line[:6]
        word = record.rstrip()
        is_atom = record in ("ATOM  ", "HETATM") or (record[:5] == "ATOM " and record[5:].isdigit())
        if structure_ended:
            n_beyond += is_atom
            if word == "CONECT" and not n_beyond:
                conect_lines.append(line)
        elif word == "END":
            structure_ended = bool(found.atoms)
        elif word == "MODEL":
            n_models += 1
            model_ended = model_ended or bool(found.atoms)
        elif record == "ENDMDL":
            model_ended = bool(found.atoms)
        elif is_atom and not model_ended:
            atom, where = _atom(line, number, path)
            if atom.serial in index_of:
                repeated.add(atom.serial)
            index_of[atom.serial] = len(found.atoms)
            n_misread += repeats_name(atom.name, atom.residue_name, line[76:78].strip().capitalize())
            if not atom.element:
                found.unknown[len(found.atoms)] = where
            named = line[72:76].strip()  # CHARMM's segment, where there is no chain; other programs put numbers there
            segment, before = named if not atom.chain and named[:1].isalpha() else "", segment
            if found.atoms and segment != before:
                found.chain_ends.add(len(found.atoms) - 1)
            found.atoms.append(atom)
        elif word[:3] == "TER" and not model_ended and found.atoms:
            found.chain_ends.add(len(found.atoms) - 1)
        elif word == "CONECT":
            conect_lines.append(line)
        elif word in ("LINK", "LINKR", "SSBOND"):
            header.append(line)
        elif word == "CRYST1" and found.cell_nm is None:
            found.cell_nm = _cell(line)
        elif (
            word not in _RECORDS
            and not is_atom
            and not model_ended
            and len(line) > 66
            and not line[27:30].strip()
            and all(_WRITTEN.fullmatch(field) for field in _fields(line))
        ):
            raise InputError(
                f"{path}, line {number}: {record!r} is no record of the PDB format, but the line looks like an atom; "
                "write ATOM or HETATM there, or take the line out."
            )
    if n_misread:
        found.notes.append(f"{n_misread} atoms whose element column repeats the atom's name: elements taken from names")
    if n_models > 1:
        found.notes.append(f"{n_models} models in the file: the first is taken")
    if n_beyond:
        found.notes.append(f"{n_beyond} atoms after END left out: they are another structure")
    pairs, ignored = _conect(conect_lines, index_of, repeated)
    if ignored:
        found.notes.append(f"{ignored} CONECT entries name no single atom of the file and are ignored")
    found.conect = sorted(pairs | _links(header, found.atoms, found.notes))
    return found


def _fields(line: str) -> list[str]:
    return [line[k : k + 8] for k in (30, 38, 46)]


def _cell(line: str) -> Any:
    fields = [line[a:b] for a, b in ((6, 15), (15, 24), (24, 33), (33, 40), (40, 47), (47, 54))]
    try:
        return cell_of([float(field) for field in fields])
    except ValueError:
        return None


def _atom(line: str, number: int, path: Path) -> tuple[AtomRecord, str]:
    """Return the record, and what to say of it if its element stays unknown."""
    if len(line) < 54:
        raise InputError(f"{path}, line {number}: the atom record is cut short; fetch or write the file again.")
    position = coordinates(_fields(line))
    if position is None:
        raise InputError(
            f"{path}, line {number}: columns 31-54 hold {line[30:54]!r}, not three coordinates; "
            "write the file again as standard PDB."
        )
    name_field = line[12:16]
    residue_name = line[17:21].strip()  # four letters where a program needs them (TIP3), the standard leaves one blank
    hetero = line.startswith("HETATM")
    symbol = element_symbol(name_field, residue_name, line[76:78].strip(), hetero=hetero) or ""
    try:
        occupancy = float(line[54:60])
    except ValueError:
        occupancy = 1.0
    atom = AtomRecord(
        serial=(line[6:11] if line[5] == " " or hetero else line[5:11]).strip(),
        name=name_field.strip() or symbol,
        altloc=line[16].strip(),
        residue_name=residue_name or "UNL",
        chain=line[21].strip(),
        residue_id=_residue_id(line[22:26], line[26:27]),
        position_angstrom=position,
        occupancy=occupancy,
        element=symbol,
        hetero=hetero,
    )
    return atom, (
        f"{path}, line {number}: atom {name_field.strip()!r} of {residue_name} has no recognisable element; "
        "fill columns 77-78."
    )


def _residue_id(number: str, insertion: str) -> str:
    """`181A`: the number, decimal where the file has it in hybrid-36, and the insertion code."""
    text = number.strip() or "1"
    value = decode(number, 4)
    return (text if value is None or text.lstrip("-").isdigit() else str(value)) + insertion.strip()


def _conect(lines: list[str], index_of: dict[str, int], repeated: set[str]) -> tuple[set[tuple[int, int]], int]:
    """Return the index pairs of CONECT records, and how many entries name no single atom."""
    pairs: set[tuple[int, int]] = set()
    ignored = 0
    for line in lines:
        serials = [line[k : k + 5].strip() for k in range(6, 31, 5)]
        first = index_of.get(serials[0])
        for serial in filter(None, serials[1:]):
            other = index_of.get(serial)
            if first is None or other is None or first == other or {serial, serials[0]} & repeated:
                ignored += 1
            else:
                pairs.add((min(first, other), max(first, other)))
    return pairs, ignored


def _links(header: list[str], atoms: list[AtomRecord], notes: list[str]) -> set[tuple[int, int]]:
    """Return the index pairs of LINK and SSBOND records that join atoms of the same asymmetric unit."""
    if not header:
        return set()
    import gemmi

    from systems.prepare.read.mmcif_file import SYMMETRIC, addressed, note_unmade

    structure = gemmi.read_pdb_string("\n".join(header) + "\n")
    ends = {
        tuple(
            (p.chain_name, str(p.res_id.seqid), p.res_id.name, p.atom_name) for p in (link.partner1, link.partner2)
        ): (link.asu == gemmi.Asu.Different)
        for link in structure.connections
        if link.type in (gemmi.ConnectionType.Covale, gemmi.ConnectionType.Disulf)
    }
    note_unmade([pair for pair, elsewhere in ends.items() if elsewhere], SYMMETRIC, notes)
    return addressed([pair for pair, elsewhere in ends.items() if not elsewhere], atoms, notes)


# ---- clean-up -------------------------------------------------------------------------------------------------------


# Massless sites of water models (MW, M, EP, OM, LP1), lone pairs (LPOA) and dummy masses (MCH3, MN1): no elements.
_SITE = re.compile(r"M(W\d?|\d*|N\d|C[BH]\d?|TRP\d?)|EPW?\d?|[LV]P?S?\d|L[PL]\w*|OM|VS\w*|IW")
_SITE_ANGSTROM = 0.85
_DRUDE_ANGSTROM = 0.5
_SAME_ANGSTROM = 0.0015
_TELLING_NAMES = {"CA", "CH3", "CAY"}


def resolve_settings(found: StructureFile, path: Path) -> StructureFile:
    """Return the file without atoms written twice, Drude particles and virtual sites, each said; residues that repeat
    under one number are told apart by their chains.

    Raises InputError for an atom whose element is not known.
    """
    gone = _repeated(found.atoms)
    if gone:
        found.notes.append(
            f"{len(gone)} atom{'s' if len(gone) > 1 else ''} written twice on one point: one of each left out"
        )
    sites = _sites(found.atoms, set(found.unknown), gone)
    if sites:
        names = listed(sorted({found.atoms[i].name for i in sites}))
        found.notes.append(f"{len(sites)} virtual sites and Drude particles left out: {names}")
    gone |= sites
    for i, where in found.unknown.items():
        if i not in gone:
            raise InputError(where)
    found.unknown = {}
    if gone:
        _leave_out(found, gone)
    found.atoms = _told_apart(found.atoms, found.chain_ends, found.notes)
    return found


def _leave_out(found: StructureFile, gone: set[int]) -> None:
    kept = [i for i in range(len(found.atoms)) if i not in gone]
    new = {old: k for k, old in enumerate(kept)}
    found.conect = [(new[i], new[j]) for i, j in found.conect if i in new and j in new]
    before = np.cumsum([i in new for i in range(len(found.atoms))]) - 1
    found.chain_ends = {int(before[i]) for i in found.chain_ends if before[i] >= 0}
    found.atoms = [found.atoms[i] for i in kept]


def _repeated(atoms: Sequence[AtomRecord]) -> set[int]:
    """Atoms of the same residue, name and position as one before."""
    first: dict[tuple[object, ...], tuple[float, float, float]] = {}
    out = set()
    for i, atom in enumerate(atoms):
        key = (*atom.residue_key, atom.name, atom.altloc, atom.element)
        here = atom.position_angstrom
        if key not in first:
            first[key] = here
        elif max(abs(a - b) for a, b in zip(first[key], here, strict=True)) < _SAME_ANGSTROM:
            out.add(i)
    return out


def _sites(atoms: Sequence[AtomRecord], unknown: set[int], gone: set[int]) -> set[int]:
    """Virtual sites, by their names where they have no element, else by a distance that no bond has; Drude particles,
    called D and the name of the atom they stand on."""
    candidates: dict[tuple[str, str, str], list[int]] = {}
    for i, atom in enumerate(atoms):
        name = atom.name.upper()
        if i not in gone and (_SITE.fullmatch(name) or (name[0] == "D" and i in unknown)):
            candidates.setdefault(atom.residue_key, []).append(i)
    if not candidates:
        return set()
    members: dict[tuple[str, str, str], list[int]] = {}
    for i, atom in enumerate(atoms):
        if atom.residue_key in candidates and i not in unknown:
            members.setdefault(atom.residue_key, []).append(i)
    found = set()
    for key, those in candidates.items():
        for i in those:
            name = atoms[i].name.upper()
            others = [
                j for j in members.get(key, ()) if j != i and (name[0] != "D" or name[1:] == atoms[j].name.upper())
            ]
            if not others:
                continue
            here = np.array([atoms[j].position_angstrom for j in others])
            near = float(np.linalg.norm(here - np.array(atoms[i].position_angstrom), axis=1).min())
            is_drude = name[0] == "D" and near < _DRUDE_ANGSTROM
            if is_drude or (name[0] != "D" and (i in unknown or near < _SITE_ANGSTROM)):
                found.add(i)
    return found


def _told_apart(atoms: Sequence[AtomRecord], chain_ends: set[int], notes: list[str]) -> list[AtomRecord]:
    """Give a molecule that has the chain letter and the numbers of one before a chain of its own (A, then A:2).

    Programs without chain letters number each molecule from 1, and all start again after 9,999.
    """
    copies: dict[str, int] = {}
    seen: dict[tuple[str, str, str], set[str]] = {}
    names_at: dict[tuple[str, str], str] = {}
    out = list(atoms)
    for start, stop in _runs(atoms, chain_ends):
        first = atoms[start]
        key, place = first.residue_key, (first.chain, first.residue_id)
        names = {a.name for a in atoms[start:stop] if a.element != "H" and not a.altloc}
        again = bool(names & seen.get(key, set()))
        peptide = template_for(first.residue_name) is not None
        if start - 1 not in chain_ends and not is_water_name(first.residue_name):
            # Other residues may come in parts, and Open Babel calls every carbon C.
            again = again and peptide and bool(_TELLING_NAMES & seen[key])
        elif peptide and start - 1 in chain_ends and not first.altloc:
            again = again or names_at.get(place, first.residue_name) != first.residue_name
        if again:
            copies[first.chain] = copies.get(first.chain, 0) + 1
            seen = {k: v for k, v in seen.items() if k[0] != first.chain}
            names_at = {k: v for k, v in names_at.items() if k[0] != first.chain}
        seen.setdefault(key, set()).update(names)
        if peptide:
            names_at.setdefault(place, first.residue_name)
        if copies.get(first.chain):
            chain = f"{first.chain}:{copies[first.chain] + 1}"
            out[start:stop] = [replace(a, chain=chain) for a in atoms[start:stop]]
    peptides = {a.chain for a in out if ":" in a.chain and template_for(a.residue_name) is not None}
    if peptides:
        notes.append(f"residue numbers come again: {listed(sorted(peptides))} are chains of their own")
    return out


def _runs(atoms: Sequence[AtomRecord], chain_ends: set[int]) -> Iterator[tuple[int, int]]:
    """Atoms of one residue without a TER among them; of waters under one number, one at a time."""
    start = 0
    for i in range(1, len(atoms)):
        begins = atoms[i].residue_key != atoms[start].residue_key or i - 1 in chain_ends
        next_water = is_water_name(atoms[i].residue_name) and atoms[i].name == atoms[start].name and not atoms[i].altloc
        if begins or next_water:
            yield start, i
            start = i
    yield start, len(atoms)


# ---- files ----------------------------------------------------------------------------------------------------------


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
    return resolve_settings(found, path)


def is_mmcif(path: Path) -> bool:
    """Whether the suffix is one of mmCIF's."""
    return suffix_of(path) in _CIF_SUFFIXES


def structure_text(path: Path) -> str:
    """Return the text of a PDB or mmCIF file. Raises InputError for what is none."""
    known = ", ".join((*_PDB_SUFFIXES, *_CIF_SUFFIXES))
    if path.is_file() and suffix_of(path) not in (*_PDB_SUFFIXES, *_CIF_SUFFIXES):
        raise InputError(f"{path} has suffix {path.suffix!r}; structures are read from {known}, also gzipped.")
    return read_text(path, f"a structure with coordinates ({known})")
