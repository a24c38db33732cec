"""Atom records and bonds put together as a Scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from systems.chemistry.bond_orders import ValenceError, perceive
from systems.chemistry.element_data import atomic_weight_da
from systems.chemistry.residues import component, template_for
from systems.errors import PreparationError, listed
from systems.prepare.read.records import AtomRecord
from systems.prepare.read.structure_text import read_structure
from systems.scene import Scene


def scene_from_file(path: Path, *, name: str, provenance: dict[str, Any]) -> Scene:
    """Read a complete structure whose CONECT records hold every bond. Raises InputError or PreparationError."""
    found = read_structure(path)
    bonds = np.array(found.conect, dtype=np.int64).reshape(-1, 2)
    return scene_from_records(found.atoms, bonds, name=name, provenance=provenance)


def scene_from_records(
    atoms: Sequence[AtomRecord], bonds: npt.NDArray[np.int64], *, name: str, provenance: dict[str, Any]
) -> Scene:
    """Return the scene of these atoms in their order, bonds `(n_bonds, 2)`; orders and charges are perceived.

    A residue is a run of atoms with one chain, number and name: a file that mixes residues has some of them repeat.
    Raises PreparationError when the connectivity fits no Lewis structure.
    """
    elements = [a.element for a in atoms]
    bonds = np.sort(bonds.reshape(-1, 2), axis=1)
    bonds = bonds[np.lexsort((bonds[:, 1], bonds[:, 0]))]
    positions_nm = np.array([a.position_angstrom for a in atoms], dtype=np.float64).reshape(-1, 3) / 10.0
    try:
        known = [i for i, a in enumerate(atoms) if _is_known(a)]
        orders, charges = perceive(elements, bonds, positions_nm, trusted=known)
    except ValenceError as error:
        faulty = ", ".join(atom_label(atoms[i]) for i in error.atoms[:4])
        more = f" and {len(error.atoms) - 4} more" if len(error.atoms) > 4 else ""
        raise PreparationError(
            f"the bonds of {faulty}{more} fit no valence; give the structure with all hydrogens, "
            "and with CONECT records if its geometry is unusual."
        ) from error
    if "repairs" in provenance and (said := _perceived_charges(atoms, bonds, charges)):
        provenance = provenance | {"repairs": [*provenance["repairs"], said]}
    residue_of_atom, keys = residue_runs(atoms)
    return Scene(
        name=name,
        atom_names=tuple(a.name for a in atoms),
        elements=tuple(elements),
        residue_of_atom=residue_of_atom,
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


def _perceived_charges(
    atoms: Sequence[AtomRecord], bonds: npt.NDArray[np.int64], charges: npt.NDArray[np.int64]
) -> str:
    """A line about charges that follow from bonds alone: of atoms of unknown residues, and of thiolates not named so;
    monatomic ions are theirs by name."""
    bonded = set(bonds.ravel().tolist())
    found = [
        f"{atom_label(atom)} {q:+d}"
        for i, (atom, q) in enumerate(zip(atoms, charges.tolist(), strict=True))
        if q and i in bonded and (not _is_known(atom) or (atom.element == "S" and atom.residue_name != "CYM"))
    ]
    return f"charges that no file states, by bonds and hydrogens: {listed(found)}" if found else ""


def _is_known(atom: AtomRecord) -> bool:
    """Whether an atom is one of a residue that is known by its name, and has therefore its hydrogens."""
    if template_for(atom.residue_name) is not None:
        return True
    found = component(atom.residue_name)
    return found is not None and atom.name in found.heavy


def atom_label(atom: AtomRecord) -> str:
    """`ALA 2 CB`, for messages."""
    return f"{atom.residue_name} {atom.chain}{atom.residue_id} {atom.name}"


def residue_runs(atoms: Sequence[AtomRecord]) -> tuple[npt.NDArray[np.int64], list[tuple[str, str, str]]]:
    """Return the run that each atom stands in, `(n_atoms,)`, and (chain, number, name) of each run."""
    keys: list[tuple[str, str, str]] = []
    of_atom = []
    for atom in atoms:
        if not keys or keys[-1] != atom.residue_key:
            keys.append(atom.residue_key)
        of_atom.append(len(keys) - 1)
    return np.array(of_atom, dtype=np.int64), keys


def _chain_runs(chains: list[str]) -> tuple[str, ...]:
    """Number a chain that comes back after another one (A, B, A -> A, B, A:2): chains are contiguous in a Scene."""
    out: list[str] = []
    runs: dict[str, int] = {}
    for k, chain in enumerate(chains):
        if k == 0 or chains[k - 1] != chain:
            runs[chain] = runs.get(chain, 0) + 1
        out.append(chain if runs[chain] == 1 else f"{chain}:{runs[chain]}")
    return tuple(out)
