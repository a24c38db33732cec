"""PDB and mmCIF files, read as atom records: order and names of the file survive.

gemmi reads mmCIF, and what the header of a PDB file says of bonds and the cell. Atoms of PDB text are read column by
column and strictly: gemmi takes `**.***` and blanks for 0, joins the parts of a residue that stand apart, and cuts
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
from systems.errors import InputError, counted, first_line, listed
from systems.prepare.records import (
    AtomRecord,
    ResidueKey,
    StructureFile,
    by_residue,
    distance_angstrom,
    read_text,
    suffix_of,
)

_PDB_SUFFIXES = (".pdb", ".ent")
_CIF_SUFFIXES = (".cif", ".mmcif")
_FARTHEST_ANGSTROM = 9_999.0


def read_structure(path: Path) -> StructureFile:
    """Read a PDB or mmCIF file, gzipped or not. Raises InputError (one line: the file, what is wrong, what to do) for a
    missing file, a directory, a suffix that is neither, bytes that are no text, a record that cannot be read, no atoms,
    or positions that are not finite."""
    text = structure_text(path)
    found = _read_mmcif(text, path) if is_mmcif(path) else _read_pdb(text, path)
    if not found.atoms:
        raise InputError(
            f"{path} holds no ATOM or HETATM record (the CIF of a crystal, in fractions of its cell, has none); give a "
            "PDB or mmCIF file with coordinates."
        )
    for atom in found.atoms:
        if not all(abs(x) <= _FARTHEST_ANGSTROM for x in atom.position_angstrom):
            raise InputError(
                f"{path}: atom {atom.serial} ({atom.name}) has a position that is not a number, or lies beyond "
                f"{_FARTHEST_ANGSTROM:,.0f} Å; correct the coordinate, or centre the structure."
            )
    return _cleaned(found, path)


def is_mmcif(path: Path) -> bool:
    """Whether the suffix is one of mmCIF's."""
    return suffix_of(path) in _CIF_SUFFIXES


def structure_text(path: Path) -> str:
    """Return the text of a PDB or mmCIF file. Raises InputError for what is none."""
    known = ", ".join((*_PDB_SUFFIXES, *_CIF_SUFFIXES))
    if path.is_file() and suffix_of(path) not in (*_PDB_SUFFIXES, *_CIF_SUFFIXES):
        raise InputError(
            f"{path} has suffix {path.suffix!r}; structures are read from {known} (also gzipped), molecules from "
            ".sdf, .mol and .mol2."
        )
    return read_text(path, f"a structure with coordinates ({known})")


def _add_header(structure: Any, found: StructureFile) -> None:
    """Add the cell and the covalent bonds of a `gemmi.Structure`; of alternates, those that go together are bonded. A
    note says which of the bonds lead to a symmetry copy, or to atoms that the file does not have."""
    import gemmi

    found.cell_nm = cell_of(structure.cell.parameters)
    index: dict[tuple[str, str, str, str], list[int]] = {}
    for i, atom in enumerate(found.atoms):
        index.setdefault((*atom.residue_key, atom.name), []).append(i)
    pairs = set(found.conect)
    unused = []
    for link in structure.connections:
        if link.type not in (gemmi.ConnectionType.Covale, gemmi.ConnectionType.Disulf):
            continue
        ends = [(p.chain_name, str(p.res_id.seqid), p.res_id.name, p.atom_name) for p in (link.partner1, link.partner2)]
        those = {
            (min(i, j), max(i, j))
            for i in index.get(ends[0], ())
            for j in index.get(ends[1], ())
            if i != j and len({found.atoms[i].altloc, found.atoms[j].altloc} - {""}) < 2
        }
        if those and link.asu != gemmi.Asu.Different:
            pairs |= those
        else:
            unused.append(" - ".join(f"{residue} {chain}{number} {atom}" for chain, number, residue, atom in ends))
    found.conect = sorted(pairs)
    if unused:
        found.notes.append(
            "records of bonds not used, as they lead to a symmetry copy, or the file has no such two atoms together: "
            f"{listed(list(dict.fromkeys(unused)))}"
        )


# ---- columns of PDB files -------------------------------------------------------------------------------------------


def _read_pdb(text: str, path: Path) -> StructureFile:
    """Return the first model of the first structure. Raises InputError for an atom record that is not in columns."""
    found = StructureFile([])
    index_of: dict[str, int] = {}
    repeated: set[str] = set()
    conect_lines: list[str] = []
    header: list[str] = []
    model_ended = structure_ended = False
    n_models = n_beyond = n_misread = n_unasked = 0
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
        elif is_atom and model_ended:
            n_unasked += n_models < 2
        elif is_atom:
            atom = _pdb_atom(line, number, path)
            if atom.serial in index_of:
                repeated.add(atom.serial)
            index_of[atom.serial] = len(found.atoms)
            n_misread += repeats_name(atom.name, atom.residue_name, line[76:78].strip().capitalize())
            named = line[72:76].strip()  # CHARMM's segment, where there is no chain; other programs put numbers there
            segment, before = named if not atom.chain and named[:1].isalpha() else "", segment
            if found.atoms and segment != before:
                found.chain_ends.add(len(found.atoms) - 1)
            found.atoms.append(atom)
        elif word[:3] == "TER" and not model_ended and found.atoms:
            found.chain_ends.add(len(found.atoms) - 1)
        elif word == "CONECT":
            conect_lines.append(line)
        elif word in ("LINK", "LINKR", "SSBOND", "CRYST1"):
            header.append(line)
    if n_misread:
        found.notes.append(
            f"{counted(n_misread, 'atom')} whose element column repeats the atom's name: elements taken from names"
        )
    if n_models > 1:
        found.notes.append(f"{n_models} models in the file: the first is taken")
    elif n_unasked:
        found.notes.append(f"{counted(n_unasked, 'atom')} after ENDMDL left out, of another model")
    if n_beyond:
        found.notes.append(f"{counted(n_beyond, 'atom')} after END left out, of another structure")
    pairs, ignored = _conect(conect_lines, index_of, repeated)
    if ignored:
        found.notes.append(f"CONECT entries ignored, as they name no single atom of the file: {ignored}")
    found.conect = sorted(pairs)
    if header:
        import gemmi

        _add_header(gemmi.read_pdb_string("\n".join([*header, ""])), found)
    return found


# Narrower than float(), which also takes 1_0.5, tabs and the digits of other alphabets.
_COORDINATE = re.compile(r" *[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)? *|\s*[-+]?(nan|inf)\w*\s*", re.ASCII | re.IGNORECASE)


def _pdb_atom(line: str, number: int, path: Path) -> AtomRecord:
    fields = [line[k : k + 8] for k in (30, 38, 46)]
    if len(line) < 54 or not all(_COORDINATE.fullmatch(text) for text in fields):
        raise InputError(
            f"{path}, line {number}: columns 31-54 hold {line[30:54]!r}, not three coordinates; the file is cut short, "
            "or no standard PDB: write it again."
        )
    x, y, z = (float(text) for text in fields)
    name_field = line[12:16]
    # Column 21, blank in the standard, may hold the fourth letter of a name (TIP3), or the first of two of a chain.
    residue_name, chain = line[17:21].strip(), line[21].strip()
    if chain and not _is_usual(residue_name) and _is_usual(line[17:20].strip()):
        residue_name, chain = line[17:20].strip(), line[20:22].strip()
    hetero = line.startswith("HETATM")
    symbol = element_symbol(name_field, residue_name, line[76:78].strip(), hetero=hetero) or ""
    number_read = decode(line[22:26], 4)
    residue_id = (line[22:26].strip() or "1") if number_read is None else str(number_read)
    try:
        occupancy = float(line[54:60])
    except ValueError:
        occupancy = 1.0
    return AtomRecord(
        name_field.strip() or symbol, symbol, residue_name or "UNL", chain,
        residue_id + line[26:27].strip(), (x, y, z), occupancy=occupancy, altloc=line[16].strip(),
        charge=_charge(line[78:80]),
        serial=(line[6:11] if line[5] == " " or hetero else line[5:11]).strip(),
    )  # fmt: skip


def _is_usual(residue_name: str) -> bool:
    return is_water_name(residue_name) or template_for(residue_name) is not None


def _charge(field: str) -> int | None:
    """Return the charge in columns 79-80 (`2+`, or as some programs write it, `+2`); None for 0 and what is none."""
    found = re.fullmatch(r"(\d)([+-])|([+-])(\d)", field)
    return int((found[2] or found[3]) + (found[1] or found[4])) or None if found else None


def decode(field: str, width: int) -> int | None:
    """Return the number in a field of `width` columns, or None where it is neither decimal nor hybrid-36. Source:
    Grosse-Kunstleve et al., cci.lbl.gov/hybrid_36."""
    text = field.strip()
    if text.lstrip("-").isdigit():
        return int(text)
    if not (len(text) == width and text.isascii() and text.isalnum() and text[0].isalpha()):
        return None
    if text not in (text.lower(), text.upper()):
        return None
    return int(text, 36) + 10**width + (16 if text.islower() else -10) * 36 ** (width - 1)


def encode(number: int, width: int) -> str | None:
    """Return `number` in `width` columns, decimal where it fits, or None beyond hybrid-36."""
    if 10**width > number > -(10 ** (width - 1)):
        return f"{number:{width}d}"
    value = number - 10**width
    block = 26 * 36 ** (width - 1)
    if not 0 <= value < 2 * block:
        return None
    text = np.base_repr(value % block + 10 * 36 ** (width - 1), 36)
    return text if value < block else text.lower()


def pdb_atom(
    serial: int, name: str, element: str, residue: str, chain: str, number: str, position_angstrom: Sequence[float],
    insertion: str = " ",
) -> str:  # fmt: skip
    """Return an ATOM record; five digits of the serial are kept, three letters of the residue's name."""
    padded = name[:4] if len(name) >= 4 or len(element) == 2 else f" {name}"
    x, y, z = position_angstrom
    return (
        f"ATOM  {serial % 100000:5d} {padded:<4s} {residue[:3]:>3s} {chain}{number[-4:]:>4s}{insertion}   "
        f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {element:>2s}"
    )


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


# ---- mmCIF ----------------------------------------------------------------------------------------------------------


def read_blocks(text: str, path: Path, category: str) -> list[Any]:
    """Return the `gemmi.cif.Block`s of a file that have a category. Raises InputError where the syntax is broken. What
    other programs get wrong beside the atoms (a tag twice, one without a value, letters beyond ASCII in a title) does
    no harm."""
    from gemmi import cif

    try:
        document = cif.read_string(text.encode("ascii", "replace").decode(), check_level=0)
        return [block for block in document if block.find_mmcif_category(category)]
    except (ValueError, RuntimeError) as error:
        reason = first_line(error).removeprefix("string:")
        raise InputError(
            f"{path} is not a complete CIF file ({reason}); the file is cut or damaged, fetch it again."
        ) from error


def _read_mmcif(text: str, path: Path) -> StructureFile:
    import gemmi

    found = StructureFile([])
    blocks = read_blocks(text, path, "_atom_site.")
    if not blocks:
        return found
    try:
        structure = gemmi.make_structure_from_block(blocks[0])
    except RuntimeError:  # of tables whose tags do not go together
        structure = gemmi.Structure()
    models = list(structure)
    if not models:
        raise InputError(
            f"{path}: its _atom_site loop is damaged, or lacks one of id, type_symbol, label_alt_id, label_asym_id and "
            "Cartn_x, y, z; fetch or write the file again."
        )
    for things, of in (("structures", blocks), ("models", models)):
        if len(of) > 1:
            found.notes.append(f"{len(of)} {things} in the file: the first is taken")
    rows = [(a, residue, chain.name) for chain in models[0] for residue in chain for a in residue]
    rows.sort(key=lambda row: row[0].serial)  # gemmi joins what the file has of one residue
    for k, (a, residue, chain) in enumerate(rows):
        hetero, written = residue.het_flag == "H", "" if a.element.name == "X" else a.element.name
        symbol = element_symbol(a.name, residue.name, written, hetero=hetero) or ""
        place = residue.name or "UNL", chain, str(residue.seqid)
        x, y, z = a.pos.tolist()
        found.atoms.append(
            AtomRecord(a.name, symbol, *place, (x, y, z), str(a.serial), a.altloc.strip("\0"), a.occ, a.charge or None)
        )
        if k and residue.subchain != rows[k - 1][1].subchain:
            found.chain_ends.add(k - 1)
    _add_header(structure, found)
    return found


# ---- clean-up -------------------------------------------------------------------------------------------------------


# Massless sites of water models (MW, M, EP, OM, LP1), lone pairs (LPOA) and dummy masses (MCH3, MN1): no elements.
_SITE = re.compile(r"M(W\d?|\d*|N\d|C[BH]\d?|TRP\d?)|EPW?\d?|[LV]P?S?\d|L[PL]\w*|OM|VS\w*|IW")
_SITE_ANGSTROM = 0.85
_DRUDE_ANGSTROM = 0.5
_SAME_ANGSTROM = 0.0015
_TELLING_NAMES = {"CA", "CH3", "CAY"}


def _cleaned(found: StructureFile, path: Path) -> StructureFile:
    """Return the file without atoms written twice, Drude particles and virtual sites, each said; residues that repeat
    under one number are told apart by their chains. Raises InputError for an atom whose element is not known."""
    gone = _repeated(found.atoms)
    if gone:
        found.notes.append(f"{counted(len(gone), 'atom')} written twice at the same coordinates: one of each left out")
    sites = _sites(found.atoms, gone)
    if sites:
        names = listed(sorted({found.atoms[i].name for i in sites}))
        found.notes.append(f"virtual sites and Drude particles left out ({len(sites)}): {names}")
    gone |= sites
    found = found.without(gone)
    for atom in found.atoms:
        if not atom.element:
            raise InputError(
                f"{path}: atom {atom.serial} ({atom.label}) has no recognisable element; write it into columns 77-78 "
                "(mmCIF: type_symbol)."
            )
    found.atoms = _told_apart(found.atoms, found.chain_ends, found.notes)
    return found


def _repeated(atoms: Sequence[AtomRecord]) -> set[int]:
    """Atoms of the same residue, name and position as one before."""
    first: dict[tuple[object, ...], AtomRecord] = {}
    out = set()
    for i, atom in enumerate(atoms):
        before = first.setdefault((*atom.residue_key, atom.name, atom.altloc, atom.element), atom)
        if before is not atom and distance_angstrom(before, atom) < _SAME_ANGSTROM:
            out.add(i)
    return out


def _sites(atoms: Sequence[AtomRecord], gone: set[int]) -> set[int]:
    """Virtual sites, by their names where they have no element, else by a distance that no bond has; Drude particles,
    called D and the name of the atom they stand on."""
    found = set()
    for members in by_residue(atoms).values():
        real = [j for j in members if atoms[j].element]
        for i in members:
            name, is_unknown = atoms[i].name.upper(), not atoms[i].element
            if is_unknown and name.startswith("D"):
                others, reach = [j for j in real if name[1:] == atoms[j].name.upper()], _DRUDE_ANGSTROM
            elif _SITE.fullmatch(name):
                others, reach = [j for j in real if j != i], math.inf if is_unknown else _SITE_ANGSTROM
            else:
                continue
            if i not in gone and any(distance_angstrom(atoms[i], atoms[j]) < reach for j in others):
                found.add(i)
    return found


def _told_apart(atoms: Sequence[AtomRecord], chain_ends: set[int], notes: list[str]) -> list[AtomRecord]:
    """Give a molecule that has the chain letter and the numbers of one before a chain of its own (A, then A:2).
    Programs without chain letters number each molecule from 1, and all start again after 9,999."""
    copies: dict[str, int] = {}
    seen: dict[ResidueKey, set[str]] = {}
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
        notes.append(f"residue numbers repeat: treated as separate chains {listed(sorted(peptides))}")
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
