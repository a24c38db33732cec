"""mmCIF text as atom records: gemmi reads the syntax, and numbers are taken as strictly as those of PDB columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from systems.chemistry.distance_bonds import cell_of
from systems.chemistry.element_data import element_symbol
from systems.errors import InputError, first_line, listed
from systems.prepare.read.records import AtomRecord, StructureFile, coordinates

_NEEDED = ("Cartn_x", "Cartn_y", "Cartn_z", "label_atom_id")
_OPTIONAL = (
    "group_PDB", "id", "type_symbol", "label_alt_id", "label_comp_id", "label_asym_id", "label_seq_id",
    "auth_atom_id", "auth_comp_id", "auth_asym_id", "auth_seq_id", "pdbx_PDB_ins_code", "occupancy",
    "pdbx_PDB_model_num",
)  # fmt: skip
_UNCERTAINTY = re.compile(r"\(\d+\)$")
SYMMETRIC = "they lead to a symmetry copy"
# (chain, number with insertion code, residue name, atom name)
Address = tuple[str, str, str, str]


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


def read_mmcif(text: str, path: Path) -> StructureFile:
    """Return the first model of the first block that has atoms. Raises InputError for a row that cannot be read."""
    try:
        return _read_mmcif(text, path)
    except RuntimeError as error:  # gemmi's, of tables whose tags do not go together
        raise InputError(f"{path} is damaged ({first_line(error)}); fetch it again.") from error


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
        atom, where = _atom(item, number, path)
        if not atom.element:
            found.unknown[len(found.atoms)] = where
        strand, before = item.get("label_asym_id", ""), strand
        if found.atoms and strand != before:
            found.chain_ends.add(len(found.atoms) - 1)
        found.atoms.append(atom)
    if len(models) > 1:
        found.notes.append(f"{len(models)} models in the file: the first is taken")
    found.conect = sorted(addressed(_connections(blocks[0], found.notes), found.atoms, found.notes))
    found.cell_nm = _cell(blocks[0])
    return found


def addressed(ends: Iterable[Sequence[Address]], atoms: Sequence[AtomRecord], notes: list[str]) -> set[tuple[int, int]]:
    """Return the index pairs of atoms named by chain, residue and name; of alternates, those that go together.

    `notes` says for which of the bonds the file has no such two atoms.
    """
    index: dict[Address, list[int]] = {}
    for i, atom in enumerate(atoms):
        index.setdefault((*atom.residue_key, atom.name), []).append(i)
    pairs: set[tuple[int, int]] = set()
    absent = []
    for first, second in ends:
        those = {
            (min(i, j), max(i, j))
            for i in index.get(first, ())
            for j in index.get(second, ())
            if i != j and len({atoms[i].altloc, atoms[j].altloc} - {""}) < 2
        }
        pairs |= those
        absent += [] if those else [(first, second)]
    note_unmade(absent, "the file has no such two atoms together", notes)
    return pairs


def note_unmade(ends: Iterable[Sequence[Address]], reason: str, notes: list[str]) -> None:
    """Note records of bonds that make none."""
    names = [" - ".join(f"{name} {chain}{number} {atom}" for chain, number, name, atom in pair) for pair in ends]
    if names:
        notes.append(f"records of bonds not used, as {reason}: {listed(names)}")


def _atom(item: dict[str, str], number: int, path: Path) -> tuple[AtomRecord, str]:
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
        serial=item.get("id") or str(number),
        name=name,
        altloc=item.get("label_alt_id", ""),
        residue_name=residue_name,
        chain=item.get("auth_asym_id") or item.get("label_asym_id", ""),
        residue_id=(item.get("auth_seq_id") or item.get("label_seq_id") or "1") + item.get("pdbx_PDB_ins_code", ""),
        position_angstrom=position,
        occupancy=occupancy,
        element=symbol,
        hetero=hetero,
    )
    return atom, f"{path}, atom row {number}: {name!r} has no recognisable element; fill type_symbol."


def _cell(block: Any) -> Any:
    """Box vectors `(3, 3)` nm of `_cell`, or None."""
    tags = [*(f"length_{a}" for a in "abc"), *(f"angle_{a}" for a in ("alpha", "beta", "gamma"))]
    for row in block.find("_cell.", tags):
        try:
            return cell_of([float(_UNCERTAINTY.sub("", row.str(k))) for k in range(6)])
        except ValueError:
            return None
    return None


def _connections(block: Any, notes: list[str]) -> list[tuple[Address, Address]]:
    """Covalent bonds of `_struct_conn` within the asymmetric unit, by the authors' names."""
    tags = ["conn_type_id", "?ptnr1_symmetry", "?ptnr2_symmetry"]
    sides = [
        [
            f"ptnr{k}_auth_asym_id",
            f"ptnr{k}_auth_seq_id",
            f"?pdbx_ptnr{k}_PDB_ins_code",
            f"ptnr{k}_auth_comp_id",
            f"ptnr{k}_label_atom_id",
        ]
        for k in (1, 2)
    ]
    found: list[tuple[Address, Address]] = []
    elsewhere: list[tuple[Address, Address]] = []
    for row in block.find("_struct_conn.", [*tags, *sides[0], *sides[1]]):
        kind = row.str(0).lower()
        symmetry = [row.str(k) for k in (1, 2) if row.has(k)]
        if not kind.startswith(("covale", "disulf")):
            continue
        ends: list[Address] = []
        for start in (3, 8):
            insertion = row.str(start + 2) if row.has(start + 2) else ""
            ends.append((row.str(start), row.str(start + 1) + insertion, row.str(start + 3), row.str(start + 4)))
        (found if len(set(symmetry)) < 2 else elsewhere).append((ends[0], ends[1]))
    note_unmade(elsewhere, SYMMETRIC, notes)
    return found
