"""What stands beside the peptide in a structure file: waters, ions and ligands, kept or left out as the user says."""

from __future__ import annotations

from collections.abc import Sequence

import networkx as nx

from systems.bonding import Bonding
from systems.errors import PreparationError
from systems.modified_residues import listed
from systems.pdb_records import AtomRecord
from systems.residues import is_water, template_for


def settle_waters(atoms: Sequence[AtomRecord], kept: list[int], drop: bool, notes: list[str]) -> list[int]:
    """Indices that stay: all where there is nothing but water, none of the waters where `drop`.

    Raises PreparationError for waters beside something else that nobody said to drop.
    """
    dry = [i for i in kept if not is_water(atoms[i].residue_name)]
    if not dry or len(dry) == len(kept):
        return kept
    n = len({(atoms[i].chain, atoms[i].residue_id) for i in kept if is_water(atoms[i].residue_name)})
    waters = f"{n} water molecule{'s' if n > 1 else ''}"
    if not drop:
        raise PreparationError(
            f"it holds {waters}; add --drop-water to leave them out (a solvent model takes their place)."
        )
    notes.append(f"{waters} left out")
    return dry


def ligand_atoms(atoms: Sequence[AtomRecord], bonding: Bonding) -> list[int]:
    """Indices of atoms in molecules without any standard residue, beside at least one; none where all are such."""
    standard = {i for r in bonding.residues if r.template is not None for i in r.atoms}
    if not standard:
        return []
    graph = nx.Graph(bonding.bonds.tolist())
    graph.add_nodes_from(range(len(atoms)))
    found: set[int] = set()
    for component in nx.connected_components(graph):
        if not component & standard:
            found |= component
    for residue in bonding.residues:  # a hydrogen-less or oddly bonded ligand can fall apart: whole residues only
        if not set(residue.atoms) <= found:
            found -= set(residue.atoms)
    return sorted(found)


def settle_ligands(
    atoms: Sequence[AtomRecord], ligands: Sequence[int], *, keep: bool, drop: bool, notes: list[str]
) -> bool:
    """Whether the ligands stay. Raises PreparationError when neither keeping nor dropping was asked for."""
    if not ligands:
        return True
    residues = list(dict.fromkeys(atoms[i].residue_key for i in ligands))
    names = listed([f"{name} {chain}{number}" for chain, number, name in residues])
    if keep:
        notes.append(f"kept beside the peptide: {names}")
        return True
    if not drop:
        raise PreparationError(
            f"beside the peptide it holds {names}; add --keep-ligand to simulate them, too, or --drop-ligand to leave "
            "them out."
        )
    notes.append(f"left out, as asked (--drop-ligand): {names}")
    return False


def refuse_bare_ligands(atoms: Sequence[AtomRecord], ligands: Sequence[int]) -> None:
    """A ligand with carbon and no hydrogen is one whose hydrogens the file leaves out. Raises PreparationError."""
    by_residue: dict[tuple[str, str, str], set[str]] = {}
    for i in ligands:
        by_residue.setdefault(atoms[i].residue_key, set()).add(atoms[i].element)
    for (chain, number, name), elements in by_residue.items():
        if ("C" in elements and "H" not in elements) or (elements == {"O"} and template_for(name) is None):
            raise PreparationError(
                f"{name} {chain}{number} has no hydrogens, which a ligand must bring; add them (its SDF from the "
                "Protein Data Bank has them), or leave it out with --drop-ligand."
            )
