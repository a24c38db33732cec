"""Modified residues: selenomethionine, CHARMM's caps, names of D- and modified amino acids."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from systems.chemistry.residues import template_for
from systems.errors import listed
from systems.prepare.read.records import AtomRecord

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
