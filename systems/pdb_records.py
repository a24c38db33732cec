"""PDB and mmCIF text as atom records, read by this file alone: order and names of the file survive."""

from __future__ import annotations

import gzip
import math
import re
from dataclasses import dataclass, field
from pathlib import Path

from systems.element_data import element_symbol
from systems.errors import InputError
from systems.hybrid36 import decode

_PDB_SUFFIXES = (".pdb", ".ent")
_CIF_SUFFIXES = (".cif", ".mmcif")
_FARTHEST_ANGSTROM = 9_999.0
# Narrower than float(), which also takes 1_0.5, tabs and the digits of other alphabets.
_COORDINATE = re.compile(r" *[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)? *|\s*[-+]?(nan|inf)\w*\s*", re.ASCII | re.IGNORECASE)
# Records whose columns 31-54 may hold three numbers without being an atom.
_NOT_ATOMS = ("ANISOU", "SIGATM", "SIGUIJ", "REMARK", "HETSYN", "HELIX ", "SHEET ", "CRYST1", "MASTER")


@dataclass(frozen=True)
class AtomRecord:
    """One ATOM or HETATM record; positions in Å as the file has them."""

    serial: str
    name: str
    altloc: str
    residue_name: str
    chain: str
    residue_id: str
    position_angstrom: tuple[float, float, float]
    occupancy: float
    element: str
    hetero: bool

    @property
    def residue_key(self) -> tuple[str, str, str]:
        """(chain, residue number with insertion code, residue name)."""
        return self.chain, self.residue_id, self.residue_name


@dataclass
class StructureFile:
    """The first model of a structure file: records in the file's order, CONECT pairs, and what was passed over.

    `chain_ends` holds the atoms that a TER record follows.
    """

    atoms: list[AtomRecord]
    conect: list[tuple[int, int]] = field(default_factory=list)
    chain_ends: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)


def read_structure(path: Path) -> StructureFile:
    """Read a PDB or mmCIF file, gzipped or not.

    Raises InputError (one line: the file, what is wrong, what to do) for a missing file, a directory, a suffix that is
    neither, bytes that are no text, a record that cannot be read, no atoms, or positions that are not finite.
    """
    text = _read_text(path)
    suffix = _suffix(path)
    found = _read_cif(text, path) if suffix in _CIF_SUFFIXES else _read_pdb(text, path)
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
    return found


def _suffix(path: Path) -> str:
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def _read_text(path: Path) -> str:
    known = ", ".join((*_PDB_SUFFIXES, *_CIF_SUFFIXES))
    if path.is_dir():
        raise InputError(f"{path} is a directory; give a structure file ({known}).")
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path, or name a library system (`surromd systems`).")
    if _suffix(path) not in (*_PDB_SUFFIXES, *_CIF_SUFFIXES):
        raise InputError(f"{path} has suffix {path.suffix!r}; structures are read from {known}, also gzipped.")
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
    except (OSError, EOFError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); check the file and its permissions.") from error
    except Exception as error:  # zlib.error has no common base with the others
        raise InputError(f"{path} is a damaged gzip file ({error}); fetch it again.") from error
    if not data.strip():
        raise InputError(f"{path} is empty; give a PDB or mmCIF file with coordinates.")
    if b"\0" in data:
        raise InputError(f"{path} is a binary file, not PDB or mmCIF text; give the structure as text.")
    return data.decode("utf-8", errors="replace")


def _read_pdb(text: str, path: Path) -> StructureFile:
    found = StructureFile([])
    index_of: dict[str, int] = {}
    repeated: set[str] = set()
    conect_lines: list[str] = []
    ended = False
    n_models = 0
    for number, line in enumerate(text.splitlines(), start=1):
        record = line[:6]
        if record == "MODEL " or line.rstrip() == "MODEL":
            n_models += 1
            ended = ended or bool(found.atoms)
        elif record == "ENDMDL":
            ended = bool(found.atoms)
        elif record in ("ATOM  ", "HETATM") and not ended:
            atom = _pdb_atom(line, number, path)
            if atom.serial in index_of:
                repeated.add(atom.serial)
            index_of[atom.serial] = len(found.atoms)
            found.atoms.append(atom)
        elif record.startswith("TER") and found.atoms and not ended:
            found.chain_ends.add(len(found.atoms) - 1)
        elif record == "CONECT":
            conect_lines.append(line)
        elif record not in _NOT_ATOMS and not ended and _coordinates(line) is not None and len(line) > 66:
            raise InputError(
                f"{path}, line {number}: {record!r} is no record of the PDB format, but the line looks like an atom; "
                "write ATOM or HETATM there, or take the line out."
            )
    if n_models > 1:
        found.notes.append(f"{n_models} models in the file: the first is taken")
    _resolve_conect(found, conect_lines, index_of, repeated)
    return found


def _pdb_atom(line: str, number: int, path: Path) -> AtomRecord:
    if len(line) < 54:
        raise InputError(f"{path}, line {number}: the atom record is cut short; fetch or write the file again.")
    position = _coordinates(line)
    if position is None:
        raise InputError(
            f"{path}, line {number}: columns 31-54 hold {line[30:54]!r}, not three coordinates; "
            "write the file again as standard PDB."
        )
    name_field = line[12:16]
    residue_name = line[17:21].strip()  # four letters where a program needs them (TIP3), the standard leaves one blank
    symbol = element_symbol(name_field, residue_name, line[76:78].strip(), hetero=line.startswith("HETATM"))
    if symbol is None:
        raise InputError(
            f"{path}, line {number}: atom {name_field.strip()!r} of {residue_name} has no recognisable element; "
            "fill columns 77-78."
        )
    try:
        occupancy = float(line[54:60])
    except ValueError:
        occupancy = 1.0
    return AtomRecord(
        serial=line[6:11].strip(),
        name=name_field.strip() or symbol,
        altloc=line[16].strip(),
        residue_name=residue_name or "UNL",
        chain=line[21].strip(),
        residue_id=_residue_id(line[22:26], line[26:27]),
        position_angstrom=position,
        occupancy=occupancy,
        element=symbol,
        hetero=line.startswith("HETATM"),
    )


def _coordinates(line: str) -> tuple[float, float, float] | None:
    fields = [line[k : k + 8] for k in (30, 38, 46)]
    if not all(_COORDINATE.fullmatch(field) for field in fields):
        return None
    x, y, z = (float(field) for field in fields)
    return x, y, z


def _residue_id(number: str, insertion: str) -> str:
    """`181A`: the number, decimal where the file has it in hybrid-36, and the insertion code."""
    text = number.strip() or "1"
    value = decode(number, 4)
    return (text if value is None or text.lstrip("-").isdigit() else str(value)) + insertion.strip()


def _resolve_conect(found: StructureFile, lines: list[str], index_of: dict[str, int], repeated: set[str]) -> None:
    """Turn CONECT serials into index pairs; what names no atom is passed over and said."""
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
    if ignored:
        found.notes.append(f"{ignored} CONECT entries name no single atom of the file and are ignored")
    found.conect = sorted(pairs)


_CIF_TOKEN = re.compile(r"'(?:[^']|'(?=\S))*'|\"(?:[^\"]|\"(?=\S))*\"|\S+")


def _read_cif(text: str, path: Path) -> StructureFile:
    columns: list[str] = []
    rows: list[list[str]] = []
    state = "seek"
    for line in text.splitlines():
        bare = line.strip()
        if state == "seek" and bare.lower() == "loop_":
            state = "head"
        elif state == "head":
            if bare.lower().startswith("_atom_site."):
                columns.append(bare.split()[0].split(".")[1].lower())
            elif columns and not bare.startswith("_"):
                state = "rows"
            elif bare.lower() != "loop_":
                state = "seek" if not columns else state
        if state == "rows":
            if not bare or bare[0] in "#_" or bare.lower() == "loop_" or bare.lower().startswith("data_"):
                break
            rows.append([_unquote(t) for t in _CIF_TOKEN.findall(bare)])
    found = StructureFile([])
    needed = {"cartn_x", "cartn_y", "cartn_z", "label_atom_id"}
    if columns and not needed <= set(columns):
        raise InputError(f"{path}: its _atom_site loop lacks {', '.join(sorted(needed - set(columns)))}.")
    models: list[str] = []
    for number, row in enumerate(rows, start=1):
        if len(row) != len(columns):
            raise InputError(
                f"{path}, atom row {number}: {len(row)} values for {len(columns)} columns; the file is cut."
            )
        item = dict(zip(columns, row, strict=True))
        model = item.get("pdbx_pdb_model_num", "1")
        if model not in models:
            models.append(model)
        if model == models[0]:
            found.atoms.append(_cif_atom(item, number, path))
    if len(models) > 1:
        found.notes.append(f"{len(models)} models in the file: the first is taken")
    return found


def _unquote(token: str) -> str:
    return token[1:-1] if len(token) > 1 and token[0] == token[-1] and token[0] in "'\"" else token


def _cif_atom(item: dict[str, str], number: int, path: Path) -> AtomRecord:
    def value(*keys: str) -> str:
        for key in keys:
            if item.get(key, "?") not in ("?", "."):
                return item[key]
        return ""

    try:
        x, y, z = (float(item[f"cartn_{axis}"]) for axis in "xyz")
        occupancy = float(value("occupancy") or 1.0)
    except ValueError:
        raise InputError(f"{path}, atom row {number}: a coordinate or the occupancy is not a number.") from None
    name = value("auth_atom_id", "label_atom_id")
    residue_name = value("auth_comp_id", "label_comp_id") or "UNL"
    hetero = value("group_pdb") == "HETATM"
    symbol = element_symbol(name, residue_name, value("type_symbol"), hetero=hetero)
    if symbol is None:
        raise InputError(f"{path}, atom row {number}: {name!r} has no recognisable element; fill type_symbol.")
    return AtomRecord(
        serial=value("id") or str(number),
        name=name,
        altloc=value("label_alt_id"),
        residue_name=residue_name,
        chain=value("auth_asym_id", "label_asym_id"),
        residue_id=(value("auth_seq_id", "label_seq_id") or "1") + value("pdbx_pdb_ins_code"),
        position_angstrom=(x, y, z),
        occupancy=occupancy,
        element=symbol,
        hetero=hetero,
    )
