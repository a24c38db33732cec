"""Atom records: what a structure file says of each atom, in the order and under the names of the file; residues; and
records with bonds put together as a Scene.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.bond_orders import VALENCE, ValenceError, perceive
from systems.chemistry.element_data import atomic_weight_da, is_lone_ion
from systems.chemistry.residues import NAMES, ResidueTemplate, component, template_for
from systems.errors import InputError, PreparationError, listed
from systems.files.outside import content
from systems.scene import FloatArray, IntArray, Scene, neighbours_of

# Chain, residue number with insertion code, residue name.
ResidueKey = tuple[str, str, str]


def suffix_of(path: Path) -> str:
    """Return the suffix in lower case, that of the packed file where it ends in .gz."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] == ".gz":
        suffixes.pop()
    return suffixes[-1] if suffixes else ""


def read_text(path: Path, wanted: str) -> str:
    """Return the text of a file. Raises InputError, which asks for what is `wanted`, where it holds none."""
    if not path.exists():
        raise InputError(
            f"{path} does not exist; check the path, or name a library system (`surromd systems`); a molecule is given "
            "as smiles:..., a peptide as sequence:..."
        )
    try:
        data = content(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read ({error}); check the file and its permissions.") from error
    if not data.strip() or b"\0" in data:
        raise InputError(f"{path} is {'a binary file, no text' if data.strip() else 'empty'}; give {wanted}.")
    return data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n")


def file_name_and_provenance(path: Path, repairs: list[str], **more: Any) -> dict[str, Any]:
    """Return the name of a scene from a file, and what it says of where it is from."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    provenance = {"source": "file", "file": path.name, "sha256": digest, **more, "repairs": repairs}
    return {"name": path.name.removesuffix(".gz").rsplit(".", 1)[0], "provenance": provenance}


# ---- atoms ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AtomRecord:
    """One ATOM or HETATM record; positions in Å as the file has them. `charge`: the formal charge that the file states
    of the atom, None where it states none or 0."""

    name: str
    element: str
    residue_name: str
    chain: str
    residue_id: str
    position_angstrom: tuple[float, float, float]
    serial: str = ""
    altloc: str = ""
    occupancy: float = 1.0
    charge: int | None = None

    @property
    def residue_key(self) -> ResidueKey:
        return self.chain, self.residue_id, self.residue_name

    @property
    def label(self) -> str:
        """`ALA A2 CB`, for messages."""
        return f"{self.residue_name} {self.chain}{self.residue_id} {self.name}"


def distance_angstrom(first: AtomRecord, second: AtomRecord) -> float:
    """Return how far apart two atoms are, Å."""
    return math.dist(first.position_angstrom, second.position_angstrom)


def by_residue(atoms: Sequence[AtomRecord]) -> dict[ResidueKey, list[int]]:
    """Return the indices of each residue's atoms, wherever they stand."""
    groups: dict[ResidueKey, list[int]] = {}
    for i, atom in enumerate(atoms):
        groups.setdefault(atom.residue_key, []).append(i)
    return groups


@dataclass
class StructureFile:
    """The first model of a structure file: records in the file's order, the bonds it states, and what was passed over.

    `conect` holds the pairs of CONECT, LINK and SSBOND records (`_struct_conn` in mmCIF), `chain_ends` the atoms that a
    TER record follows, or with which a chain of mmCIF ends. An atom whose element is not known has the element "".
    `cell_nm`: box vectors `(3, 3)` of a periodic cell, None where the file has none.
    """

    atoms: list[AtomRecord]
    conect: list[tuple[int, int]] = field(default_factory=list)
    chain_ends: set[int] = field(default_factory=set)
    notes: list[str] = field(default_factory=list)
    cell_nm: FloatArray | None = None

    def only(self, kept: Sequence[int]) -> StructureFile:
        """Return some of the atoms, ascending; a chain ends with the last of them before its end."""
        new = {old: k for k, old in enumerate(kept)}
        ends = {int(k) - 1 for k in np.searchsorted(kept, sorted(self.chain_ends), side="right")} - {-1}
        conect = [(new[i], new[j]) for i, j in self.conect if i in new and j in new]
        return replace(self, atoms=[self.atoms[i] for i in kept], conect=conect, chain_ends=ends)

    def without(self, left_out: Sequence[int] | set[int]) -> StructureFile:
        """Return all atoms but these."""
        gone = set(left_out)
        return self.only([i for i in range(len(self.atoms)) if i not in gone])


# ---- residues and their bonds, as `systems.prepare.bonding` finds them ----------------------------------------------


@dataclass
class Residue:
    """All atoms of one residue, wherever they stand in the file. `heavy` is empty when the names fit no template."""

    key: ResidueKey
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
    are none."""

    bonds: IntArray
    residues: list[Residue]
    notes: list[str]
    peptide_bonds: set[tuple[int, int]]
    unmade: list[str] = field(default_factory=list)

    @property
    def neighbours(self) -> list[list[int]]:
        """Of each atom the atoms that it is bonded to."""
        return neighbours_of(self.bonds, sum(len(r.atoms) for r in self.residues))

    @property
    def is_complete(self) -> bool:
        """Whether no residue that is known by its name lacks an atom."""
        return not any(r.missing or r.lacks_hydrogens for r in self.residues)


# ---- modified residues ----------------------------------------------------------------------------------------------


_CAP_BOND_ANGSTROM = 1.3
# The patches ACE and CT3 of CHARMM write caps into the first and the last residue.
_PATCHES = {"ACE": ("CAY", "CY", "OY"), "NME": ("NT", "CAT")}


def standardise(atoms: Sequence[AtomRecord], notes: list[str]) -> list[AtomRecord]:
    """Return the atoms with selenomethionine as methionine and CHARMM's patched caps as residues ACE and NME. Order and
    positions stay; `notes` names each residue that changed."""
    out = list(atoms)
    changed = []
    for i, atom in enumerate(atoms):
        if atom.residue_name.upper() == "MSE":
            changed.append(f"{atom.chain}{atom.residue_id}")
            name, element = ("SD", "S") if atom.element == "Se" else (atom.name, atom.element)
            out[i] = replace(atom, residue_name="MET", name=name, element=element)
    if changed:
        notes.append(f"selenomethionine made methionine (SE to SD): {listed(list(dict.fromkeys(changed)))}")
    for (chain, number, name), members in by_residue(out).items():
        template = template_for(name)
        if template is None or not template.is_amino_acid:
            continue
        index = {out[i].name.upper(): i for i in members}
        for cap, heavy in _PATCHES.items():
            if not set(heavy) <= set(index):
                continue
            core = [index[a] for a in heavy]
            for i in members:
                near = min(distance_angstrom(out[i], out[j]) for j in core) < _CAP_BOND_ANGSTROM
                if i in core or (out[i].element == "H" and near):
                    out[i] = replace(out[i], residue_name=cap)
            notes.append(f"{name} {chain}{number}: {' '.join(heavy)} set apart as the cap {cap}")
    return out


# ---- scenes ---------------------------------------------------------------------------------------------------------


def scene_from_records(atoms: Sequence[AtomRecord], bonds: IntArray, *, name: str, provenance: dict[str, Any]) -> Scene:
    """Return the scene of these atoms in their order, bonds `(n_bonds, 2)`; orders and charges are perceived. A residue
    is a run of atoms with one chain, number and name: a file that mixes residues has some of them repeat. Raises
    PreparationError when the connectivity fits no Lewis structure."""
    elements = [a.element for a in atoms]
    bonds = np.sort(bonds.reshape(-1, 2), axis=1)
    bonds = bonds[np.lexsort((bonds[:, 1], bonds[:, 0]))]
    positions_nm = np.array([a.position_angstrom for a in atoms], dtype=np.float64).reshape(-1, 3) / 10.0
    try:
        known = [i for i, a in enumerate(atoms) if _is_known(a)]
        orders, charges = perceive(elements, bonds, positions_nm, trusted=known, ions=_ion_charges(atoms, bonds))
    except ValenceError as error:
        first = atoms[error.atoms[0]]
        if first.element not in VALENCE and error.atoms[0] not in bonds:
            raise PreparationError(
                f"no charge is known for the lone atom {first.label}; state it in columns 79-80 of its record (mmCIF: "
                "pdbx_formal_charge), or leave it out with `drop_ligand=True`."
            ) from error
        raise PreparationError(
            f"no valid Lewis structure for {listed([atoms[i].label for i in error.atoms], 4)}; give the structure with "
            "all hydrogens, and with CONECT records if its geometry is unusual."
        ) from error
    if "repairs" in provenance:
        provenance = provenance | {"repairs": [*provenance["repairs"], *_charge_notes(atoms, bonds, charges)]}
    keys: list[ResidueKey] = []
    residue_of_atom = []
    for atom in atoms:
        if not keys or keys[-1] != atom.residue_key:
            keys.append(atom.residue_key)
        residue_of_atom.append(len(keys) - 1)
    return Scene(
        name=name,
        atom_names=tuple(a.name for a in atoms),
        elements=tuple(elements),
        residue_of_atom=np.array(residue_of_atom, dtype=np.int64),
        residue_names=tuple(k[2] for k in keys),
        residue_ids=tuple(k[1] for k in keys),
        chain_of_residue=_chain_runs([k[0] for k in keys]),
        bonds=bonds,
        bond_orders=orders,
        formal_charges=charges,
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=positions_nm,
        provenance=provenance,
    )


def _ion_charges(atoms: Sequence[AtomRecord], bonds: IntArray) -> dict[int, int]:
    """The charges of monatomic ions that the file states, or that their names do."""
    bonded = set(bonds.ravel().tolist())
    lone = {i: a for i, a in enumerate(atoms) if i not in bonded and is_lone_ion(a.element)}
    found = {i: a.charge or NAMES["ion_charges"].get(a.residue_name.upper()) for i, a in lone.items()}
    return {i: q for i, q in found.items() if q}


def _charge_notes(atoms: Sequence[AtomRecord], bonds: IntArray, charges: IntArray) -> list[str]:
    """Lines about charges that follow from bonds alone: of atoms of unknown residues, and of thiolates not named so;
    and of unknown residues whose atoms the file gives another sum of charges (of a standard one some files state the
    side chain's alone). Monatomic ions are theirs by name."""
    bonded = set(bonds.ravel().tolist())
    found, other = [], []
    for (chain, number, name), members in by_residue(atoms).items():
        stated, total = sum(atoms[i].charge or 0 for i in members), int(charges[members].sum())
        if any(atoms[i].charge for i in members):
            if stated != total and not _is_known(atoms[members[0]]):
                other.append(f"{name} {chain}{number} ({stated:+d} stated, {total:+d} used)")
            continue
        found += [
            f"{atoms[i].label} {charges[i]:+d}"
            for i in members
            if charges[i] and i in bonded and (not _is_known(atoms[i]) or (atoms[i].element == "S" and name != "CYM"))
        ]
    lines = (("charges that no file states, by bonds and hydrogens", found),
             ("charges stated in the file but not used, as bonds and hydrogens give others", other))  # fmt: skip
    return [f"{line}: {listed(of)}" for line, of in lines if of]


def _is_known(atom: AtomRecord) -> bool:
    """Whether an atom is one of a residue that is known by its name, and has therefore its hydrogens."""
    if template_for(atom.residue_name) is not None:
        return True
    found = component(atom.residue_name)
    return found is not None and atom.name in found.heavy


def _chain_runs(chains: list[str]) -> tuple[str, ...]:
    """Number a chain that comes back after another one (A, B, A -> A, B, A:2): chains are contiguous in a Scene."""
    out: list[str] = []
    runs: dict[str, int] = {}
    for k, chain in enumerate(chains):
        if k == 0 or chains[k - 1] != chain:
            runs[chain] = runs.get(chain, 0) + 1
        out.append(chain if runs[chain] == 1 else f"{chain}:{runs[chain]}")
    return tuple(out)
