"""Which atoms of a file are which atoms of the reference: the whole molecule in any order, or what both have of it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from systems.errors import OutOfDomainError
from systems.scene import Scene

IntArray = npt.NDArray[np.int64]

_FLAT = 0.45
_PSEUDO_BOND_NM = 0.11
_BACKBONE = ("N", "CA", "C", "O")


class Match(NamedTuple):
    """Atom `order[k]` of the file is atom `kept[k]` of the template; `how` says by what they were matched."""

    order: IntArray
    kept: IntArray
    how: str


def solute_atoms(scene: Scene) -> IntArray:
    """Return the atoms that are evaluated: all but water and single ions, where anything else is left."""
    import networkx as nx

    from systems.chemistry.graph import bonded_graph
    from systems.chemistry.residues import is_water_name

    kept: list[int] = []
    largest = 0
    for component in nx.connected_components(bonded_graph(scene)):
        atoms = sorted(component)
        elements = sorted(scene.elements[i] for i in atoms)
        named_water = is_water_name(scene.residue_names[int(scene.residue_of_atom[atoms[0]])])
        if len(atoms) > 1 and elements != ["H", "H", "O"] and not (named_water and set(elements) <= {"H", "O"}):
            kept += atoms
            largest = max(largest, sum(e != "H" for e in elements))
    # A trace of single atoms without bonds is a molecule all the same.
    return np.array(sorted(kept), dtype=np.int64) if largest > 1 else np.arange(scene.n_atoms)


def match_scenes(scene: Scene, template: Scene) -> Match:
    """Match a file's `scene` to the `template`: by the bonded graph when both hold one molecule, else what both have.

    Atoms that only one of them holds (water, hydrogens, side chains that were not saved) are left out: first by names
    and residues, then heavy atoms by the bonded graph with handedness, then the backbone, then alpha carbons in order.
    Raises OutOfDomainError when they are different molecules.
    """
    from systems.chemistry.graph import match_atoms
    from systems.scene import part_of

    everything = np.arange(template.n_atoms)
    if scene.topology_hash == template.topology_hash:
        return Match(everything, everything, "")
    own = solute_atoms(scene)
    solute = scene if len(own) == scene.n_atoms else part_of(scene, own)
    try:
        return Match(own[match_atoms(solute, template)], everything, "the bond graph")
    except OutOfDomainError as error:
        if sorted(solute.elements) == sorted(template.elements):
            raise
        found = _by_names(solute, template) or _by_heavy_graph(solute, template) or _by_backbone(solute, template)
        if found is None:
            raise OutOfDomainError(f"{error} Nor is one of them a part of the other.") from error
    rank = np.argsort(found.kept)
    return Match(own[found.order[rank]], found.kept[rank], found.how)


def _by_names(scene: Scene, template: Scene) -> Match | None:
    """Atoms of equal name in residues of equal name and number; None unless one side's heavy atoms are all found.

    The bonds among the atoms found must be the same, so that equal names in different molecules do not match.
    """
    ours, theirs = _named(scene), _named(template)
    if ours is None or theirs is None:
        return None
    both = [(ours[key], theirs[key]) for key in ours if key in theirs]
    if any(scene.elements[i] != template.elements[k] for i, k in both):
        return None
    order, kept = (np.array([pair[side] for pair in both], dtype=np.int64) for side in (0, 1))
    n_heavy = sum(scene.elements[i] != "H" for i in order.tolist())
    if n_heavy < 3 or n_heavy < min(len(scene.heavy_idx), len(template.heavy_idx)):
        return None
    if _bonds_among(scene, order) != _bonds_among(template, kept):
        return None
    return Match(order, kept, "names and residues")


def _named(scene: Scene) -> dict[tuple[str, str, str], int] | None:
    residue = scene.residue_of_atom.tolist()
    keys = [
        (scene.residue_ids[r], scene.residue_names[r], name) for r, name in zip(residue, scene.atom_names, strict=True)
    ]
    return {key: i for i, key in enumerate(keys)} if len(set(keys)) == len(keys) else None


def _bonds_among(scene: Scene, atoms: IntArray) -> set[tuple[int, int]]:
    place = {int(atom): k for k, atom in enumerate(atoms)}
    return {
        (min(place[i], place[j]), max(place[i], place[j])) for i, j in scene.bonds.tolist() if i in place and j in place
    }


def _by_heavy_graph(scene: Scene, template: Scene) -> Match | None:
    return _by_graph(scene, scene.heavy_idx, template, template.heavy_idx, "the bond graph of the heavy atoms")


def _by_backbone(scene: Scene, template: Scene) -> Match | None:
    """N, CA, C, O of every residue, or CA alone, by graph and then by the order and names of residues."""
    for names in (_BACKBONE, _BACKBONE[:3]):
        ours, theirs = _called(scene, names), _called(template, names)
        if len(ours) == scene.n_atoms or len(theirs) == template.n_atoms:
            found = _by_graph(scene, ours, template, theirs, "the bond graph of the backbone")
            if found is not None:
                return found
    ours, theirs = _called(scene, ("CA",)), _called(template, ("CA",))
    if (len(ours) == scene.n_atoms or len(theirs) == template.n_atoms) and len(ours) == len(theirs) > 2:
        residues = [[s.residue_names[int(s.residue_of_atom[i])] for i in atoms] for s, atoms in
                    ((scene, ours), (template, theirs))]  # fmt: skip
        if residues[0] == residues[1]:
            return Match(ours, theirs, "the sequence of alpha carbons")
    return None


def _called(scene: Scene, names: tuple[str, ...]) -> IntArray:
    return np.array([i for i, name in enumerate(scene.atom_names) if name in names], dtype=np.int64)


def _by_graph(scene: Scene, ours: IntArray, template: Scene, theirs: IntArray, how: str) -> Match | None:
    from systems.chemistry.graph import match_atoms
    from systems.scene import part_of

    if len(ours) != len(theirs) or len(ours) < 3:
        return None
    parts = [_with_pseudo_hydrogens(part_of(s, atoms)) for s, atoms in ((scene, ours), (template, theirs))]
    try:
        order = match_atoms(*parts)[: len(theirs)]
    except OutOfDomainError:
        return None
    return Match(ours[order], theirs, how)


def _with_pseudo_hydrogens(scene: Scene) -> Scene:
    """Add a hydrogen to every atom with three neighbours that is not flat, so that its handedness can be compared."""
    x = scene.positions_nm
    centres, places = [], []
    for i, around in enumerate(scene.neighbours()):
        if len(around) != 3:
            continue
        arms = x[around] - x[i]
        arms /= np.maximum(np.linalg.norm(arms, axis=1, keepdims=True), 1e-9)
        if abs(float(np.linalg.det(arms))) > _FLAT:
            away = -arms.sum(axis=0)
            centres.append(i)
            places.append(x[i] + _PSEUDO_BOND_NM * away / np.linalg.norm(away))
    n, k = scene.n_atoms, len(centres)
    added = np.array([[i, n + m] for m, i in enumerate(centres)], dtype=np.int64).reshape(-1, 2)
    return replace(
        scene,
        atom_names=(*scene.atom_names, *("H",) * k),
        elements=(*scene.elements, *("H",) * k),
        residue_of_atom=np.concatenate([scene.residue_of_atom, scene.residue_of_atom[centres]]),
        bonds=np.concatenate([scene.bonds.reshape(-1, 2), added]),
        bond_orders=np.concatenate([np.zeros(len(scene.bonds)), np.zeros(k)]),
        formal_charges=np.zeros(n + k, dtype=np.int64),
        masses_da=np.concatenate([scene.masses_da, np.ones(k)]),
        positions_nm=np.concatenate([x, np.array(places).reshape(-1, 3)]),
    )
