"""PDB text as atom records, column by column and strictly; gemmi reads what the header says of bonds.

gemmi reads ATOM records, too, and is not used for them: it takes `**.***` and blanks for 0, joins the parts of a
residue that stand apart, and cuts residue names at three letters (TIP3 becomes TIP of chain 3).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from systems.chemistry.cell_images import cell_of
from systems.chemistry.element_data import element_symbol, repeats_name
from systems.errors import InputError
from systems.prepare.read.hybrid36 import decode
from systems.prepare.read.records import AtomRecord, StructureFile, coordinates

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
