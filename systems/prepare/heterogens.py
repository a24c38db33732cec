"""Waters, ions and ligands beside the peptide of a structure file: kept or left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import networkx as nx
import numpy as np

from systems.chemistry.residues import NAMES, is_water_name, template_for
from systems.errors import PreparationError, counted, listed
from systems.prepare.bonding import are_ions
from systems.prepare.records import AtomRecord, Bonding, by_residue
from systems.scene import FloatArray, IntArray

WATER_BOND_ANGSTROM = 1.3
_OH_ANGSTROM = 0.9572
_HALF_HOH = np.radians(104.52 / 2)
_SEEN_ANGSTROM = 3.5
_DIRECTIONS = 64


def complete_waters(
    waters: Sequence[AtomRecord], others: Sequence[AtomRecord], notes: list[str]
) -> tuple[list[AtomRecord], IntArray]:
    """Return the waters as oxygen and two hydrogens each, in the file's order, and their bonds `(n_bonds, 2)`. A
    hydrogen belongs to the nearest oxygen, within 1.3 Å. Oxygens without their two are given new ones, turned away from
    what stands near (of `others` and the waters); `notes` says to how many."""
    from scipy.spatial import cKDTree

    oxygens = [a for a in waters if a.element == "O"]
    places = np.array([a.position_angstrom for a in oxygens])
    own: list[list[AtomRecord]] = [[] for _ in oxygens]
    tree = cKDTree(places)
    for atom in waters:
        if atom.element == "H":
            gap, k = tree.query(atom.position_angstrom)
            if gap < WATER_BOND_ANGSTROM:
                own[int(k)].append(atom)
    bare = [k for k, hydrogens in enumerate(own) if len(hydrogens) != 2]
    around = np.array([a.position_angstrom for a in [*others, *waters]])
    crowd = cKDTree(around)
    rng = np.random.default_rng(0)
    for k in bare:
        near = around[crowd.query_ball_point(places[k], _SEEN_ANGSTROM)]
        pair = _freest(places[k], near, rng)
        own[k] = [
            replace(oxygens[k], serial="", name=name, element="H", position_angstrom=(x, y, z))
            for name, (x, y, z) in zip(("H1", "H2"), pair.tolist(), strict=True)
        ]
        around = np.concatenate([around, pair])
    n = len(oxygens)
    notes.append(f"{counted(n, 'water molecule')} kept" + (f", hydrogens placed on {len(bare)}" if bare else ""))
    records = [a for oxygen, hydrogens in zip(oxygens, own, strict=True) for a in (oxygen, *hydrogens)]
    first = 3 * np.arange(n)
    bonds = np.stack([np.stack([first, first + k], axis=1) for k in (1, 2)], axis=1).reshape(-1, 2)
    return records, bonds


def _freest(oxygen: FloatArray, near: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return two hydrogens `(2, 3)` Å of a water, of many directions those whose nearest neighbour is farthest."""
    axes = rng.normal(size=(_DIRECTIONS, 2, 3))
    along = axes[:, 0] / np.linalg.norm(axes[:, 0], axis=1, keepdims=True)
    across = axes[:, 1] - (axes[:, 1] * along).sum(axis=1, keepdims=True) * along
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    side = np.stack([across, -across], axis=1) * np.sin(_HALF_HOH)
    pairs: FloatArray = oxygen + _OH_ANGSTROM * (along[:, None] * np.cos(_HALF_HOH) + side)
    others = near[np.linalg.norm(near - oxygen, axis=1) > _OH_ANGSTROM / 2]
    gaps = np.linalg.norm(pairs[:, :, None] - others[None, None], axis=3).min(axis=(1, 2), initial=np.inf)
    return pairs[int(gaps.argmax())]


# ---- kept or left out -----------------------------------------------------------------------------------------------


_BOUND_ANGSTROM = 3.0


def is_water(atoms: Sequence[AtomRecord]) -> bool:
    """Whether the atoms of a residue are water, by its name and elements: oxygens with two hydrogens each at most, and
    what a cell has left of them, hydrogens alone."""
    oxygens, hydrogens = (sum(a.element == e for a in atoms) for e in "OH")
    whole = oxygens + hydrogens == len(atoms) and hydrogens <= 2 * max(oxygens, 1)
    return whole and is_water_name(atoms[0].residue_name)


def resolve_solvent(
    atoms: Sequence[AtomRecord], kept: Sequence[int], *, keep_water: bool, keep_ions: bool, notes: list[str]
) -> tuple[list[int], list[int]]:
    """Return the indices that stay, and those of waters to be kept beside them; `notes` says what is left out. Left out
    are waters unless `keep_water`, and free ions unless `keep_ions`: monatomic, no N, O or S of anything else within 3
    Å. Of a file that holds nothing else, all stays."""
    # All oxygens of waters may stand before all hydrogens.
    runs = [[kept[k] for k in members] for members in by_residue([atoms[i] for i in kept]).values()]
    water = [run for run in runs if is_water([atoms[i] for i in run])]
    ions = [i for run in runs if are_ions([atoms[i] for i in run]) for i in run]
    wet = {i for run in water for i in run}
    cut = {i for run in water if not any(atoms[i].element == "O" for i in run) for i in run}
    apart = wet.union(ions)
    solute = [i for i in kept if i not in apart]
    if not solute:
        return list(kept), []
    n_waters = sum(atoms[i].element == "O" for i in wet)
    free = set() if keep_ions else _free(atoms, ions, solute)
    count = Counter(atoms[i].residue_name for i in kept if i in free)
    names = listed([f"{n} {name}" if n > 1 else name for name, n in count.items()])
    gone = [
        *([counted(n_waters, "water molecule")] if n_waters and not keep_water else []),
        *([f"{counted(len(cut), 'hydrogen')} of waters without oxygen"] if cut else []),
        *([f"free ion{'s' if len(free) > 1 else ''} {names}"] if free else []),
    ]
    if gone:
        notes.append(f"{' and '.join(gone)} left out")
    return [i for i in kept if i not in wet and i not in free], sorted(wet - cut) if keep_water else []


def _free(atoms: Sequence[AtomRecord], ions: Sequence[int], solute: Sequence[int]) -> set[int]:
    """Those of the ions that no N, O or S of the solute holds."""
    donors = [atoms[i].position_angstrom for i in solute if atoms[i].element in ("N", "O", "S")]
    if not ions or not donors:
        return set(ions)
    from scipy.spatial import cKDTree

    gap, _ = cKDTree(np.array(donors)).query(np.array([atoms[i].position_angstrom for i in ions]))
    return {i for i, d in zip(ions, gap.tolist(), strict=True) if d > _BOUND_ANGSTROM}


def ligand_atoms(atoms: Sequence[AtomRecord], bonding: Bonding) -> list[int]:
    """Indices of atoms in molecules without any standard residue, beside at least one; none where all are such."""
    chains = [r for r in bonding.residues if r.template is not None and not r.template.is_saccharide]
    standard = {i for r in chains for i in r.atoms}
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


def resolve_ligands(
    atoms: Sequence[AtomRecord], ligands: Sequence[int], *, keep: bool, drop: bool, notes: list[str]
) -> list[int]:
    """Return which of the ligands stay; `notes` says which do, and which are left out. Agents of crystallisation,
    buffers and counter-ions, known by name and elements, are left out unless `keep`. Raises PreparationError for other
    ligands where neither keeping nor dropping was asked for, and for kept ones without hydrogens."""
    residues = {key: [ligands[k] for k in run] for key, run in by_residue([atoms[i] for i in ligands]).items()}
    if not (keep or drop):
        agents = {key for key, members in residues.items() if _is_agent(key[2], [atoms[i].element for i in members])}
        if agents:
            count = Counter(name for _, _, name in sorted(agents))
            said = listed([f"{n} {name}" if n > 1 else name for name, n in count.items()])
            notes.append(f"crystallisation agents and buffers left out (`keep_ligand=True` keeps them): {said}")
        residues = {key: members for key, members in residues.items() if key not in agents}
    if not residues:
        return []
    names = listed([f"{name} {chain}{number}" for chain, number, name in residues])
    if drop:
        notes.append(f"left out, as asked (`drop_ligand=True`): {names}")
        return []
    if not keep:
        raise PreparationError(
            f"beside the peptide it holds {names}; add `keep_ligand=True` to simulate them, too, or `drop_ligand=True` "
            "to leave them out."
        )
    notes.append(f"kept beside the peptide: {names}")
    for (chain, number, name), members in residues.items():
        elements = {atoms[i].element for i in members}
        if ("C" in elements and "H" not in elements) or (elements == {"O"} and template_for(name) is None):
            raise PreparationError(
                f"{name} {chain}{number} has no hydrogens, which a ligand must bring; add them (its SDF from the "
                "Protein Data Bank has them), or leave it out with `drop_ligand=True`."
            )
    return sorted(i for members in residues.values() for i in members)


def _is_agent(name: str, elements: Sequence[str]) -> bool:
    count = Counter(e for e in elements if e != "H")
    return NAMES["agents"].get(name.upper()) == "".join(f"{e}{n if n > 1 else ''}" for e, n in sorted(count.items()))
