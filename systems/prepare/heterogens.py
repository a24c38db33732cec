"""Waters, ions and ligands beside the peptide of a structure file: kept or left out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import networkx as nx
import numpy as np

from systems.chemistry.residues import is_water_name, template_for
from systems.errors import PreparationError, listed
from systems.prepare.bonding import are_ions
from systems.prepare.records import AtomRecord, Bonding, ResidueKey, by_residue
from systems.scene import FloatArray, IntArray

WATER_BOND_ANGSTROM = 1.3
_OH_ANGSTROM = 0.9572
_HALF_HOH = np.radians(104.52 / 2)
_SEEN_ANGSTROM = 3.5
_DIRECTIONS = 64


def complete_waters(
    waters: Sequence[AtomRecord], others: Sequence[AtomRecord], notes: list[str]
) -> tuple[list[AtomRecord], IntArray]:
    """Return the waters as oxygen and two hydrogens each, in the file's order, and their bonds `(n_bonds, 2)`.

    A hydrogen belongs to the nearest oxygen, within 1.3 Å. Oxygens without their two are given new ones, turned away
    from what stands near (of `others` and the waters); `notes` says to how many.
    """
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
    notes.append(
        f"{n} water molecule{'s' if n > 1 else ''} kept" + (f", hydrogens placed on {len(bare)}" if bare else "")
    )
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
# Nearer than waters come to each other, farther than a bond between oxygens.
_PEROXIDE_ANGSTROM = 1.8
# What crystals are grown from and frozen in, and what peptides are delivered as salts of: component and heavy atoms.
_AGENTS = {
    "1PE": "C10O6", "ACN": "C3O", "ACT": "C2O2", "ACY": "C2O2", "AZI": "N3", "BCT": "CO3", "BME": "C2OS",
    "BTB": "C8NO5", "CAC": "AsC2O2", "CCN": "C2N", "CIT": "C6O7", "CO3": "CO3", "DIO": "C4O2", "DMF": "C3NO",
    "DMS": "C2OS", "DTT": "C4O2S2", "EDO": "C2O2", "EOH": "C2O", "EPE": "C8N2O4S", "FLC": "C6O7", "FMT": "CO2",
    "GOL": "C3O3", "IMD": "C3N2", "IPA": "C3O", "MES": "C6NO4S", "MLI": "C3O4", "MOH": "CO", "MPD": "C6O2",
    "MRD": "C6O2", "NH4": "N", "NO3": "NO3", "P6G": "C12O7", "PEG": "C4O3", "PG4": "C8O5", "PGE": "C6O4",
    "PGO": "C3O2", "PO4": "O4P", "SCN": "CNS", "SO4": "O4S", "TFA": "C2F3O2", "TLA": "C4O6", "TRS": "C4NO3",
}  # fmt: skip


def is_water(atoms: Sequence[AtomRecord]) -> bool:
    """Whether the atoms of a residue are one or more waters: told by elements and distances, never by name alone.

    Each oxygen has two hydrogens of its own within 1.3 Å. Under one of water's names also what is left of waters that
    are cut or split by a cell: oxygens apart from each other with two hydrogens each at most, and hydrogens alone.
    """
    oxygens = [a.position_angstrom for a in atoms if a.element == "O"]
    hydrogens = [a.position_angstrom for a in atoms if a.element == "H"]
    if len(oxygens) + len(hydrogens) < len(atoms):
        return False
    if is_water_name(atoms[0].residue_name):
        if len(oxygens) < 2 or len(hydrogens) > 2 * len(oxygens):  # of a box of water, each has one
            return not oxygens or len(hydrogens) <= 2
        from scipy.spatial import cKDTree

        return not cKDTree(oxygens).query_pairs(_PEROXIDE_ANGSTROM)
    if len(hydrogens) < 2 * len(oxygens) or not oxygens:
        return False
    if len(oxygens) == 1:
        return len(hydrogens) == 2 and all(math.dist(oxygens[0], h) < WATER_BOND_ANGSTROM for h in hydrogens)
    from scipy.spatial import cKDTree

    gaps, owners = cKDTree(oxygens).query(hydrogens)
    return bool((gaps < WATER_BOND_ANGSTROM).all()) and bool((np.bincount(owners, minlength=len(oxygens)) == 2).all())


def resolve_solvent(
    atoms: Sequence[AtomRecord], kept: Sequence[int], *, keep_water: bool, keep_ions: bool, notes: list[str]
) -> tuple[list[int], list[int]]:
    """Return the indices that stay, and those of waters to be kept beside them; `notes` says what is left out.

    Left out are waters unless `keep_water`, and free ions unless `keep_ions`: monatomic, no N, O or S of anything else
    within 3 Å. Of a file that holds nothing else, all stays.
    """
    runs = [list(run) for _, run in groupby(kept, key=lambda i: atoms[i].residue_key)]
    runs = [run for run in runs if not is_water_name(atoms[run[0]].residue_name)]
    named: dict[ResidueKey, list[int]] = {}  # all oxygens may stand before all hydrogens
    for i in kept:
        if is_water_name(atoms[i].residue_name):
            named.setdefault(atoms[i].residue_key, []).append(i)
    runs += named.values()
    water = [run for run in runs if is_water([atoms[i] for i in run])]
    ions = [[i] for run in runs if are_ions([atoms[i] for i in run]) for i in run]
    wet = {i for run in water for i in run}
    cut = {i for run in water if not any(atoms[i].element == "O" for i in run) for i in run}
    apart = wet | {i for run in ions for i in run}
    solute = [i for i in kept if i not in apart]
    if not solute:
        return list(kept), []
    n_waters = sum(atoms[i].element == "O" for i in wet)
    waters = [f"{n_waters} water molecule{'s' if n_waters > 1 else ''}"] if n_waters and not keep_water else []
    free = set() if keep_ions else _free(atoms, [run[0] for run in ions], solute)
    count = Counter(atoms[i].residue_name for i in kept if i in free)
    names = listed([f"{n} {name}" if n > 1 else name for name, n in count.items()])
    halves = [f"{len(cut)} hydrogen{'s' if len(cut) > 1 else ''} of waters without oxygen"] if cut else []
    gone = [*waters, *halves, *([f"free ion{'s' if len(free) > 1 else ''} {names}"] if free else [])]
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


def agent_atoms(atoms: Sequence[AtomRecord], ligands: Sequence[int], notes: list[str]) -> list[int]:
    """Indices of those ligands that are agents of crystallisation, buffers and counter-ions, by name and by elements;
    `notes` says which are left out."""
    found, names = [], []
    for _, run in sorted(by_residue([atoms[i] for i in ligands]).items()):
        members = [ligands[k] for k in run]
        count = Counter(atoms[i].element for i in members if atoms[i].element != "H")
        heavy = "".join(f"{e}{n if n > 1 else ''}" for e, n in sorted(count.items()))
        if _AGENTS.get(atoms[members[0]].residue_name.upper()) == heavy:
            found += members
            names.append(atoms[members[0]].residue_name)
    if found:
        said = listed([f"{n} {name}" if n > 1 else name for name, n in Counter(names).items()])
        notes.append(f"crystallisation agents and buffers left out (`keep_ligand=True` keeps them): {said}")
    return sorted(found)


def resolve_ligands(
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
            f"beside the peptide it holds {names}; add `keep_ligand=True` to simulate them, too, or `drop_ligand=True` "
            "to leave them out."
        )
    notes.append(f"left out, as asked (`drop_ligand=True`): {names}")
    return False


def refuse_bare_ligands(atoms: Sequence[AtomRecord], ligands: Sequence[int]) -> None:
    """A ligand with carbon and no hydrogen is one whose hydrogens the file leaves out. Raises PreparationError."""
    for (chain, number, name), members in by_residue([atoms[i] for i in ligands]).items():
        elements = {atoms[ligands[k]].element for k in members}
        if ("C" in elements and "H" not in elements) or (elements == {"O"} and template_for(name) is None):
            raise PreparationError(
                f"{name} {chain}{number} has no hydrogens, which a ligand must bring; add them (its SDF from the "
                "Protein Data Bank has them), or leave it out with `drop_ligand=True`."
            )
