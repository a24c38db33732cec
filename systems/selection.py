"""Part of a scene, by number or in MDTraj's selection language, and a scene with its atoms in another order."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from systems.errors import InputError, first_line
from systems.scene import IntArray, Scene


def select_atoms(scene: Scene, text: str) -> IntArray:
    """Return the atoms `(k,)`, ascending, that a selection in MDTraj's language means, such as 'backbone or name CB'.

    Raises InputError when it cannot be read or means no atom.
    """
    try:
        found = np.asarray(scene.to_mdtraj_topology().select(text), dtype=np.int64)
    except InputError:
        raise
    except Exception as error:  # the parser raises what its own libraries raise
        raise InputError(
            f"the selection {text!r} cannot be read ({first_line(error)}); write it as MDTraj does, such as "
            "'name CA or name CB'."
        ) from error
    if not len(found):
        raise InputError(f"the selection {text!r} means no atom of {scene.name}.")
    return np.unique(found)


def part_of(scene: Scene, atoms: IntArray) -> Scene:
    """Return the scene of some atoms (ascending), with their bonds and residues, without a cell's other contents."""
    where = {int(i): k for k, i in enumerate(atoms)}
    rows = [k for k, (i, j) in enumerate(scene.bonds.tolist()) if i in where and j in where]
    residues = list(dict.fromkeys(int(scene.residue_of_atom[i]) for i in atoms))
    rank = {r: k for k, r in enumerate(residues)}
    return replace(
        scene,
        atom_names=tuple(scene.atom_names[i] for i in atoms),
        elements=tuple(scene.elements[i] for i in atoms),
        residue_of_atom=np.array([rank[int(scene.residue_of_atom[i])] for i in atoms], dtype=np.int64),
        residue_names=tuple(scene.residue_names[r] for r in residues),
        residue_ids=tuple(scene.residue_ids[r] for r in residues),
        chain_of_residue=tuple(scene.chain_of_residue[r] for r in residues),
        bonds=np.array([[where[int(i)] for i in scene.bonds[k]] for k in rows], dtype=np.int64).reshape(-1, 2),
        bond_orders=scene.bond_orders[rows],
        formal_charges=scene.formal_charges[atoms],
        masses_da=scene.masses_da[atoms],
        positions_nm=scene.positions_nm[atoms],
    )


def reordered(scene: Scene, order: IntArray) -> Scene:
    """Return the scene whose atom k is this one's atom order[k]; bonds and residues keep their places."""
    where = np.argsort(order)
    return replace(
        scene,
        atom_names=tuple(scene.atom_names[i] for i in order),
        elements=tuple(scene.elements[i] for i in order),
        residue_of_atom=scene.residue_of_atom[order],
        bonds=np.sort(where[scene.bonds], axis=1),
        formal_charges=scene.formal_charges[order],
        masses_da=scene.masses_da[order],
        positions_nm=scene.positions_nm[order],
    )
