"""Clean-up of atom records: duplicates and virtual sites left out, repeated residue numbers told apart."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from systems.chemistry.residues import is_water_name, template_for
from systems.errors import InputError, listed
from systems.prepare.read.records import AtomRecord, StructureFile

# Massless sites of water models (MW, M, EP, OM, LP1), lone pairs (LPOA) and dummy masses (MCH3, MN1): no elements.
_SITE = re.compile(r"M(W\d?|\d*|N\d|C[BH]\d?|TRP\d?)|EPW?\d?|[LV]P?S?\d|L[PL]\w*|OM|VS\w*|IW")
_SITE_ANGSTROM = 0.85
_DRUDE_ANGSTROM = 0.5
_SAME_ANGSTROM = 0.0015
_TELLING_NAMES = {"CA", "CH3", "CAY"}


def settle(found: StructureFile, path: Path) -> StructureFile:
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
