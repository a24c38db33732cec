"""Atom records: what a structure file says of each atom, in the order and under the names of the file; residues."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from systems.chemistry.residues import ResidueTemplate, template_for
from systems.errors import InputError, listed
from systems.files.outside import content


def suffix_of(path: Path) -> str:
    """Return the suffix in lower case, that of the packed file where it ends in .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def read_text(path: Path, wanted: str) -> str:
    """Return the text of a file. Raises InputError, which asks for what is `wanted`, where it holds none."""
    if path.is_dir():
        raise InputError(f"{path} is a directory; give the file of {wanted}.")
    if not path.exists():
        raise InputError(f"{path} does not exist; check the path, or name a library system (`surromd systems`).")
    try:
        data = content(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); check the file and its permissions.") from error
    if not data.strip():
        raise InputError(f"{path} is empty; give {wanted}.")
    if b"\0" in data:
        raise InputError(f"{path} is a binary file, no text; give {wanted}.")
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n")


# ---- atoms ----------------------------------------------------------------------------------------------------------


# Narrower than float(), which also takes 1_0.5, tabs and the digits of other alphabets.
_COORDINATE = re.compile(r" *[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)? *|\s*[-+]?(nan|inf)\w*\s*", re.ASCII | re.IGNORECASE)


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
    """The first model of a structure file: records in the file's order, the bonds it states, and what was passed over.

    `conect` holds the pairs of CONECT, LINK and SSBOND records (`_struct_conn` in mmCIF), `chain_ends` the atoms that a
    TER record follows, or with which a chain of mmCIF ends. An atom whose element is not known has the element "", and
    `unknown` says where it stands. `cell_nm`: box vectors `(3, 3)` of a periodic cell, None where the file has none.
    """

    atoms: list[AtomRecord]
    conect: list[tuple[int, int]] = field(default_factory=list)
    chain_ends: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    unknown: dict[int, str] = field(default_factory=dict)
    cell_nm: npt.NDArray[np.float64] | None = None


def coordinates(fields: Sequence[str]) -> tuple[float, float, float] | None:
    """Return three coordinates written as plain decimal numbers, or None where one is written otherwise."""
    if not all(_COORDINATE.fullmatch(text) for text in fields):
        return None
    x, y, z = (float(text) for text in fields)
    return x, y, z


# ---- residues and their bonds, as `systems.prepare.bonding` finds them ----------------------------------------------


@dataclass
class Residue:
    """All atoms of one residue, wherever they stand in the file. `heavy` is empty when the names fit no template."""

    key: tuple[str, str, str]
    atoms: list[int]
    template: ResidueTemplate | None
    heavy: dict[str, int] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    lacks_hydrogens: bool = False

    @property
    def label(self) -> str:
        return f"{self.key[2]} {self.key[0]}{self.key[1]}"


@dataclass
class Bonding:
    """Bonds `(n_bonds, 2)`, the residues in the order of the file, and a summary of where bonds came from.

    `peptide_bonds` are the pairs (C, N) that join standard residues, `unmade` the bonds that the file states and that
    are none.
    """

    bonds: npt.NDArray[np.int64]
    residues: list[Residue]
    notes: list[str]
    peptide_bonds: set[tuple[int, int]]
    unmade: list[str] = field(default_factory=list)

    @property
    def neighbours(self) -> list[list[int]]:
        """Of each atom the atoms that it is bonded to."""
        near: list[list[int]] = [[] for _ in range(sum(len(r.atoms) for r in self.residues))]
        for i, j in self.bonds.tolist():
            near[i].append(j)
            near[j].append(i)
        return near

    @property
    def is_complete(self) -> bool:
        """Whether no residue that is known by its name lacks an atom."""
        return not any(r.missing or r.lacks_hydrogens for r in self.residues)


# ---- modified residues ----------------------------------------------------------------------------------------------


D_RESIDUES = {
    "DAL": "ALA", "DAR": "ARG", "DSG": "ASN", "DAS": "ASP", "DCY": "CYS", "DGN": "GLN", "DGL": "GLU", "DHI": "HIS",
    "DIL": "ILE", "DLE": "LEU", "DLY": "LYS", "MED": "MET", "DPN": "PHE", "DPR": "PRO", "DSN": "SER", "DTH": "THR",
    "DTR": "TRP", "DTY": "TYR", "DVA": "VAL",
}  # fmt: skip
_MODIFIED = {
    "SEP": "phosphoserine", "TPO": "phosphothreonine", "PTR": "phosphotyrosine", "HYP": "hydroxyproline",
    "NLE": "norleucine", "CSO": "oxidised cysteine", "CME": "modified cysteine", "KCX": "carbamylated lysine",
    "MLY": "dimethyllysine", "M3L": "trimethyllysine", "ALY": "acetyllysine", "PCA": "pyroglutamate",
    "SEC": "selenocysteine", "CSE": "selenocysteine", "AIB": "aminoisobutyric acid", "ORN": "ornithine",
    "FME": "formylmethionine", "TYS": "sulfotyrosine", "LLP": "lysine with pyridoxal phosphate",
}  # fmt: skip
_CAP_BOND_ANGSTROM = 1.3
# The patches ACE and CT3 of CHARMM write caps into the first and the last residue.
_PATCHES = {"ACE": ("CAY", "CY", "OY"), "NME": ("NT", "CAT")}


def describe_residue(name: str) -> str:
    """Return what a residue that is no template is, with a leading comma, or an empty string."""
    upper = name.upper()
    if upper in D_RESIDUES:
        return f", D-{D_RESIDUES[upper].lower()}"
    return f", {_MODIFIED[upper]}" if upper in _MODIFIED else ""


def standardise(atoms: Sequence[AtomRecord], notes: list[str]) -> list[AtomRecord]:
    """Return the atoms with selenomethionine as methionine and CHARMM's patched caps as residues ACE and NME.

    Order and positions stay; `notes` names each residue that changed.
    """
    return _caps_apart(_methionines(atoms, notes), notes)


def _methionines(atoms: Sequence[AtomRecord], notes: list[str]) -> list[AtomRecord]:
    out = []
    changed: dict[tuple[str, str], None] = {}
    for atom in atoms:
        if atom.residue_name.upper() != "MSE":
            out.append(atom)
            continue
        changed[atom.chain, atom.residue_id] = None
        is_selenium = atom.element == "Se"
        out.append(
            replace(
                atom,
                residue_name="MET",
                name="SD" if is_selenium else atom.name,
                element="S" if is_selenium else atom.element,
                hetero=False,
            )
        )
    if changed:
        notes.append(f"selenomethionine made methionine (SE to SD): {listed([f'{c}{r}' for c, r in changed])}")
    return out


def _caps_apart(atoms: list[AtomRecord], notes: list[str]) -> list[AtomRecord]:
    groups: dict[tuple[str, str, str], list[int]] = {}
    for i, atom in enumerate(atoms):
        groups.setdefault(atom.residue_key, []).append(i)
    out = list(atoms)
    for (chain, number, name), members in groups.items():
        template = template_for(name)
        if template is None or not template.is_amino_acid:
            continue
        index = {atoms[i].name.upper(): i for i in members}
        for cap, heavy in _PATCHES.items():
            if not set(heavy) <= set(index):
                continue
            core = [index[a] for a in heavy]
            for i in members:
                if i in core or (atoms[i].element == "H" and _is_near(atoms, i, core)):
                    out[i] = replace(atoms[i], residue_name=cap)
            notes.append(f"{name} {chain}{number}: {' '.join(heavy)} set apart as the cap {cap}")
    return out


def _is_near(atoms: Sequence[AtomRecord], i: int, others: Sequence[int]) -> bool:
    gaps = [np.subtract(atoms[i].position_angstrom, atoms[j].position_angstrom) for j in others]
    return bool(np.linalg.norm(gaps, axis=1).min() < _CAP_BOND_ANGSTROM)
