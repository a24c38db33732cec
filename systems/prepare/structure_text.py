"""PDB and mmCIF files, read as atom records: order and names of the file survive.

PDB text is read column by column and strictly; gemmi reads what the header says of bonds, and the syntax of mmCIF. It
reads ATOM records, too, and is not used for them: it takes `**.***` and blanks for 0, joins the parts of a residue that
stand apart, and cuts residue names at three letters (TIP3 becomes TIP of chain 3). Duplicates and virtual sites are
left out, repeated residue numbers told apart.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from systems.chemistry.distance_bonds import cell_of
from systems.chemistry.element_data import element_symbol, repeats_name
from systems.chemistry.residues import is_water_name, template_for
from systems.errors import InputError, first_line, listed
from systems.prepare.records import (
    AtomRecord,
    ResidueKey,
    StructureFile,
    by_residue,
    coordinates,
    distance_angstrom,
    read_text,
    suffix_of,
)
from systems.scene import FloatArray

_PDB_SUFFIXES = (".pdb", ".ent")
_CIF_SUFFIXES = (".cif", ".mmcif")
_FARTHEST_ANGSTROM = 9_999.0
_DIGITS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"
_SYMMETRIC = "they lead to a symmetry copy"
# (chain, number with insertion code, residue name, atom name)
Address = tuple[str, str, str, str]


def read_structure(path: Path) -> StructureFile:
    """Read a PDB or mmCIF file, gzipped or not.

    Raises InputError (one line: the file, what is wrong, what to do) for a missing file, a directory, a suffix that is
    neither, bytes that are no text, a record that cannot be read, no atoms, or positions that are not finite.
    """
    text = structure_text(path)
    if is_mmcif(path):
        try:
            found = _read_mmcif(text, path)
        except RuntimeError as error:  # gemmi's, of tables whose tags do not go together
            raise InputError(f"{path} is damaged ({first_line(error)}); fetch it again.") from error
    else:
        found = _read_pdb(text, path)
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
    return _cleaned(found)


def is_mmcif(path: Path) -> bool:
    """Whether the suffix is one of mmCIF's."""
    return suffix_of(path) in _CIF_SUFFIXES


def structure_text(path: Path) -> str:
    """Return the text of a PDB or mmCIF file. Raises InputError for what is none."""
    known = ", ".join((*_PDB_SUFFIXES, *_CIF_SUFFIXES))
    if path.is_file() and suffix_of(path) not in (*_PDB_SUFFIXES, *_CIF_SUFFIXES):
        raise InputError(f"{path} has suffix {path.suffix!r}; structures are read from {known}, also gzipped.")
    return read_text(path, f"a structure with coordinates ({known})")


# ---- bonds that headers state ---------------------------------------------------------------------------------------


def _addressed(
    ends: Iterable[Sequence[Address]], elsewhere: Iterable[Sequence[Address]], found: StructureFile
) -> set[tuple[int, int]]:
    """Return the index pairs of atoms named by chain, residue and name; of alternates, those that go together.

    Notes say for which of the bonds the file has no such two atoms, and which lead `elsewhere`.
    """
    index: dict[Address, list[int]] = {}
    for i, atom in enumerate(found.atoms):
        index.setdefault((*atom.residue_key, atom.name), []).append(i)
    pairs: set[tuple[int, int]] = set()
    absent = []
    for first, second in ends:
        those = {
            (min(i, j), max(i, j))
            for i in index.get(first, ())
            for j in index.get(second, ())
            if i != j and len({found.atoms[i].altloc, found.atoms[j].altloc} - {""}) < 2
        }
        pairs |= those
        absent += [] if those else [(first, second)]
    for unused, reason in ((elsewhere, _SYMMETRIC), (absent, "the file has no such two atoms together")):
        names = [" - ".join(f"{name} {chain}{n} {atom}" for chain, n, name, atom in pair) for pair in unused]
        if names:
            found.notes.append(f"records of bonds not used, as {reason}: {listed(names)}")
    return pairs


def _links(header: list[str], found: StructureFile) -> set[tuple[int, int]]:
    """Return the index pairs of LINK and SSBOND records that join atoms of the same asymmetric unit."""
    if not header:
        return set()
    import gemmi

    structure = gemmi.read_pdb_string("\n".join(header) + "\n")
    ends = {
        tuple(
            (p.chain_name, str(p.res_id.seqid), p.res_id.name, p.atom_name) for p in (link.partner1, link.partner2)
        ): (link.asu == gemmi.Asu.Different)
        for link in structure.connections
        if link.type in (gemmi.ConnectionType.Covale, gemmi.ConnectionType.Disulf)
    }
    return _addressed([p for p, away in ends.items() if not away], [p for p, away in ends.items() if away], found)


def _connections(block: Any, found: StructureFile) -> set[tuple[int, int]]:
    """Return the index pairs of covalent bonds of `_struct_conn`, by the authors' names."""
    names = ("auth_asym_id", "auth_seq_id", "auth_comp_id", "label_atom_id")
    tags = [f"ptnr{k}_{name}" for k in (1, 2) for name in names]
    optional = [tag for k in (1, 2) for tag in (f"?pdbx_ptnr{k}_PDB_ins_code", f"?ptnr{k}_symmetry")]
    here: list[Sequence[Address]] = []
    elsewhere: list[Sequence[Address]] = []
    for row in block.find("_struct_conn.", ["conn_type_id", *tags, *optional]):
        if not row.str(0).lower().startswith(("covale", "disulf")):
            continue
        ends: list[Address] = []
        for start, insertion in ((1, 9), (5, 11)):
            chain, number, name, atom = (row.str(start + k) for k in range(4))
            ends.append((chain, number + (row.str(insertion) if row.has(insertion) else ""), name, atom))
        symmetry = {row.str(k) for k in (10, 12) if row.has(k)}
        (here if len(symmetry) < 2 else elsewhere).append(ends)
    return _addressed(here, elsewhere, found)


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


def _read_pdb(text: str, path: Path) -> StructureFile:
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
            atom, where = _pdb_atom(line, number, path)
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
            found.cell_nm = _cell([line[a:b] for a, b in ((6, 15), (15, 24), (24, 33), (33, 40), (40, 47), (47, 54))])
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
    found.conect = sorted(pairs | _links(header, found))
    return found


def _fields(line: str) -> list[str]:
    return [line[k : k + 8] for k in (30, 38, 46)]


def _cell(fields: Sequence[str]) -> FloatArray | None:
    """Box vectors `(3, 3)` nm of lengths in Å and angles in degrees, or None."""
    try:
        return cell_of([float(_UNCERTAINTY.sub("", field)) for field in fields])
    except ValueError:
        return None


def _pdb_atom(line: str, number: int, path: Path) -> tuple[AtomRecord, str]:
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
        name_field.strip() or symbol, symbol, residue_name or "UNL", line[21].strip(),
        _residue_id(line[22:26], line[26:27]), position, occupancy=occupancy, altloc=line[16].strip(), hetero=hetero,
        serial=(line[6:11] if line[5] == " " or hetero else line[5:11]).strip(),
    )  # fmt: skip
    return atom, (
        f"{path}, line {number}: atom {name_field.strip()!r} of {residue_name} has no recognisable element; "
        "fill columns 77-78."
    )


def _residue_id(number: str, insertion: str) -> str:
    """`181A`: the number, decimal where the file has it in hybrid-36, and the insertion code."""
    text = number.strip() or "1"
    value = decode(number, 4)
    return (text if value is None or text.lstrip("-").isdigit() else str(value)) + insertion.strip()


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


_NEEDED = ("Cartn_x", "Cartn_y", "Cartn_z", "label_atom_id")
_OPTIONAL = (
    "group_PDB", "id", "type_symbol", "label_alt_id", "label_comp_id", "label_asym_id", "label_seq_id",
    "auth_atom_id", "auth_comp_id", "auth_asym_id", "auth_seq_id", "pdbx_PDB_ins_code", "occupancy",
    "pdbx_PDB_model_num",
)  # fmt: skip
_ANGLES = ("alpha", "beta", "gamma")
_UNCERTAINTY = re.compile(r"\(\d+\)$")


def read_blocks(text: str, path: Path) -> Any:
    """Return the `gemmi.cif.Document` of a file. Raises InputError where the syntax is broken.

    What other programs get wrong beside the atoms (a tag twice, one without a value, letters beyond ASCII in a title)
    does no harm.
    """
    from gemmi import cif

    if not text.isascii():
        if any(not line.isascii() for line in text.splitlines() if line.startswith(("ATOM", "HETATM"))):
            raise InputError(f"{path}: a row of atoms has letters beyond ASCII; the file is damaged, fetch it again.")
        text = text.encode("ascii", "replace").decode()
    try:
        return cif.read_string(text, check_level=0)
    except (ValueError, RuntimeError) as error:
        reason = first_line(error).removeprefix("string:")
        raise InputError(f"{path} is no whole CIF ({reason}); the file is cut or damaged, fetch it again.") from error


def is_component(text: str) -> bool:
    """Whether mmCIF text defines a component and holds no structure."""
    return "_chem_comp_atom." in text and "_atom_site." not in text


def _read_mmcif(text: str, path: Path) -> StructureFile:
    found = StructureFile([])
    blocks = [b for b in read_blocks(text, path) if b.find_mmcif_category("_atom_site.")]
    if not blocks:
        return found
    if len(blocks) > 1:
        found.notes.append(f"{len(blocks)} structures in the file: the first is taken")
    given = [tag.split(".", 1)[-1].lower() for tag in blocks[0].find_mmcif_category("_atom_site.").tags]
    if len(set(given)) < len(given):
        raise InputError(f"{path}: its _atom_site loop has a column twice; the file is damaged, fetch it again.")
    missing = [tag for tag in _NEEDED if tag.lower() not in given]
    if missing:
        raise InputError(f"{path}: its _atom_site loop lacks {', '.join(sorted(t.lower() for t in missing))}.")
    table = blocks[0].find("_atom_site.", [*_NEEDED, *(f"?{tag}" for tag in _OPTIONAL)])
    models: list[str] = []
    strand = ""
    tags = [*_NEEDED, *_OPTIONAL]
    column = tags.index("pdbx_PDB_model_num")
    for number, row in enumerate(table, start=1):
        model = row.str(column) if row.has(column) else "1"
        if model not in models:
            models.append(model)
        if model != models[0]:
            continue
        item = {tag: row.str(k) for k, tag in enumerate(tags) if row.has(k) and row[k] not in ("?", ".")}
        atom, where = _cif_atom(item, number, path)
        if not atom.element:
            found.unknown[len(found.atoms)] = where
        strand, before = item.get("label_asym_id", ""), strand
        if found.atoms and strand != before:
            found.chain_ends.add(len(found.atoms) - 1)
        found.atoms.append(atom)
    if len(models) > 1:
        found.notes.append(f"{len(models)} models in the file: the first is taken")
    found.conect = sorted(_connections(blocks[0], found))
    for row in blocks[0].find("_cell.", [f"length_{a}" for a in "abc"] + [f"angle_{a}" for a in _ANGLES]):
        found.cell_nm = _cell([row.str(k) for k in range(6)])
        break
    return found


def _cif_atom(item: dict[str, str], number: int, path: Path) -> tuple[AtomRecord, str]:
    """Return the record, and what to say of it if its element stays unknown."""
    position = coordinates([_UNCERTAINTY.sub("", item.get(f"Cartn_{axis}", "")) for axis in "xyz"])
    if position is None:
        raise InputError(f"{path}, atom row {number}: a coordinate is not a number; fetch or write the file again.")
    try:
        occupancy = float(_UNCERTAINTY.sub("", item.get("occupancy", "1")))
    except ValueError:
        raise InputError(f"{path}, atom row {number}: the occupancy is not a number.") from None
    name = item.get("auth_atom_id") or item.get("label_atom_id", "")
    residue_name = item.get("auth_comp_id") or item.get("label_comp_id") or "UNL"
    hetero = item.get("group_PDB") == "HETATM"
    symbol = element_symbol(name, residue_name, item.get("type_symbol", ""), hetero=hetero) or ""
    atom = AtomRecord(
        name, symbol, residue_name, item.get("auth_asym_id") or item.get("label_asym_id", ""),
        (item.get("auth_seq_id") or item.get("label_seq_id") or "1") + item.get("pdbx_PDB_ins_code", ""), position,
        item.get("id") or str(number), item.get("label_alt_id", ""), occupancy, hetero,
    )  # fmt: skip
    return atom, f"{path}, atom row {number}: {name!r} has no recognisable element; fill type_symbol."


# ---- clean-up -------------------------------------------------------------------------------------------------------


# Massless sites of water models (MW, M, EP, OM, LP1), lone pairs (LPOA) and dummy masses (MCH3, MN1): no elements.
_SITE = re.compile(r"M(W\d?|\d*|N\d|C[BH]\d?|TRP\d?)|EPW?\d?|[LV]P?S?\d|L[PL]\w*|OM|VS\w*|IW")
_SITE_ANGSTROM = 0.85
_DRUDE_ANGSTROM = 0.5
_SAME_ANGSTROM = 0.0015
_TELLING_NAMES = {"CA", "CH3", "CAY"}


def _cleaned(found: StructureFile) -> StructureFile:
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
    found = found.without(gone)
    found.atoms = _told_apart(found.atoms, found.chain_ends, found.notes)
    return found


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
    found = set()
    for members in by_residue(atoms).values():
        for i in members:
            name = atoms[i].name.upper()
            may_be_drude = name.startswith("D") and i in unknown
            if i in gone or not (may_be_drude or _SITE.fullmatch(name)):
                continue
            others = [j for j in members if j != i and j not in unknown]
            if may_be_drude:
                others = [j for j in others if name[1:] == atoms[j].name.upper()]
            near = min((distance_angstrom(atoms[i], atoms[j]) for j in others), default=math.inf)
            if near < (_DRUDE_ANGSTROM if may_be_drude else _SITE_ANGSTROM) or (
                others and i in unknown and not may_be_drude
            ):
                found.add(i)
    return found


def _told_apart(atoms: Sequence[AtomRecord], chain_ends: set[int], notes: list[str]) -> list[AtomRecord]:
    """Give a molecule that has the chain letter and the numbers of one before a chain of its own (A, then A:2).

    Programs without chain letters number each molecule from 1, and all start again after 9,999.
    """
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
