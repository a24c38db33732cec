"""Scene from a structure file: atoms chosen, bonds found, missing atoms added, geometry checked, repairs noted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np

from systems.chemistry.element_data import is_metal
from systems.chemistry.geometry import near_pairs
from systems.chemistry.residues import canonical_heavy_name, template_for
from systems.errors import PreparationError, counted, listed
from systems.options import Preparation
from systems.prepare.bonding import find_bonds, links_residues
from systems.prepare.checks import check_contacts, close_gaps, handedness, made_whole, refuse_changed, say_inverted
from systems.prepare.heterogens import complete_waters, ligand_atoms, resolve_ligands, resolve_solvent
from systems.prepare.mol2_file import read_mol2
from systems.prepare.records import (
    AtomRecord,
    Bonding,
    Residue,
    StructureFile,
    by_residue,
    file_name_and_provenance,
    scene_from_records,
    standardise,
    suffix_of,
)
from systems.prepare.structure_text import is_mmcif, read_structure, structure_text
from systems.scene import IntArray, Scene

# Of a standard residue's atoms in any protonation, bonds to hydrogen among them.
_MOST_BONDS = {"C": 4, "N": 4, "O": 2, "S": 2}
_COMPLETE_WITHOUT_HYDROGEN = {"C", "F", "Cl", "Br", "I", "O", "N", "S"}


def prepare_file(path: Path, options: Preparation) -> Scene:
    """Return the scene of a PDB or mmCIF file, or of a MOL2 file of standard residues: atoms chosen, bonds found,
    missing atoms added, geometry checked."""
    if is_mmcif(path) and "_atom_site." not in (text := structure_text(path)) and "_chem_comp_atom." in text:
        from systems.prepare.molecule import scene_from_component

        return scene_from_component(text, path)
    found = read_mol2(path) if suffix_of(path) == ".mol2" else read_structure(path)
    repairs = list(found.notes)
    try:
        atoms, bonds = _prepared(found, options, repairs)
        scene = scene_from_records(atoms, bonds, **file_name_and_provenance(path, repairs, ph=options.ph))
        _refuse_long_multiple_bonds(scene)
        return scene
    except PreparationError as error:
        raise PreparationError(f"{path}: {error}") from error


def _prepared(found: StructureFile, options: Preparation, repairs: list[str]) -> tuple[list[AtomRecord], IntArray]:
    """Return the atoms and bonds that are simulated; `repairs` says what was added, chosen or left out."""
    found = made_whole(found, repairs)
    kept = _choose_alternates(found, repairs)
    kept, wet = resolve_solvent(
        found.atoms, kept, keep_water=options.keep_water, keep_ions=options.keep_ligand, notes=repairs
    )
    structure = found.only(kept)
    structure.atoms = standardise(structure.atoms, repairs)
    bonding = find_bonds(structure.atoms, structure.conect)
    if bonding.unmade:
        repairs.append(f"bonds stated in the file but not used: {listed(bonding.unmade)}")
    ligands = ligand_atoms(structure.atoms, bonding)
    beside = resolve_ligands(
        structure.atoms, ligands, keep=options.keep_ligand, drop=options.drop_ligand, notes=repairs
    )
    others = structure.only(beside)
    if ligands:
        structure = structure.without(ligands)
        bonding = find_bonds(structure.atoms, structure.conect)
    caps = close_gaps(structure, bonding, cap_breaks=options.cap_breaks, notes=repairs)
    if caps:
        structure.atoms = [*structure.atoms, *caps]
        bonding = find_bonds(structure.atoms, structure.conect)
    repairs += bonding.notes
    atoms, bonds = list(structure.atoms), bonding.bonds
    known = [(r, r.template.name) for r in bonding.residues if r.template is not None]
    hands = handedness((r.label, name, {a: atoms[i] for a, i in r.heavy.items()}) for r, name in known)
    if bonding.is_complete:
        _refuse_bare_skeletons(bonding.residues, atoms)
    else:
        _refuse_beyond_repair(bonding, atoms)
        from systems.prepare.repair import complete

        atoms, bonds, summary = complete(
            atoms, bonding, ph=options.ph, metals=[a for a in others.atoms if is_metal(a.element)]
        )
        repairs += summary
        now = by_residue(atoms)
        before = hands
        hands = handedness((r.label, name, {atoms[i].name: atoms[i] for i in now.get(r.key, ())}) for r, name in known)
        refuse_changed(before, hands)
    n_bonds = np.bincount(bonds.ravel(), minlength=len(atoms)).tolist()
    if any(n > _MOST_BONDS.get(a.element, n) for a, n in zip(atoms, n_bonds, strict=True)):
        _refuse_surplus_hydrogens(bonding, structure.atoms)
    say_inverted(hands, repairs)
    if beside:
        others_bonding = find_bonds(others.atoms, others.conect)
        bonds = np.concatenate([bonds, others_bonding.bonds + len(atoms)])
        atoms = [*atoms, *others.atoms]
        repairs += others_bonding.notes
    if wet:
        waters, water_bonds = complete_waters([found.atoms[i] for i in wet], atoms, repairs)
        bonds = np.concatenate([bonds, water_bonds + len(atoms)])
        atoms = [*atoms, *waters]
    repairs += check_contacts(atoms, bonds)
    return atoms, bonds


def _choose_alternates(found: StructureFile, repairs: list[str]) -> list[int]:
    """Indices of the atoms that stay: of alternate locations the most occupied, one label for all that is bonded.
    Labels that most of the bonded residues have go first. A stated bond holds for the alternate that stays: `conect` of
    `found` is changed to that."""
    twice = {(*a.residue_key, a.name) for a in found.atoms if a.altloc}  # beside a label, a blank is another one
    found.atoms = [
        replace(a, altloc="-") if not a.altloc and (*a.residue_key, a.name) in twice else a for a in found.atoms
    ]
    atoms = found.atoms
    labelled = [i for i, a in enumerate(atoms) if a.altloc]
    if not labelled:
        return list(range(len(atoms)))
    place = [a.residue_key[:2] for a in atoms]
    occupancy: dict[tuple[str, str], dict[str, list[float]]] = {}
    for i in labelled:
        occupancy.setdefault(place[i], {}).setdefault(atoms[i].altloc, []).append(atoms[i].occupancy)
    groups = nx.Graph((place[i], place[j]) for i, j in _bonds_of_alternates(found, labelled))
    groups.add_nodes_from(occupancy)
    chosen: dict[tuple[str, str], str] = {}
    for group in nx.connected_components(groups):
        rank = {}
        for label in {label for each in group for label in occupancy[each]}:
            having = [occupancy[each][label] for each in group if label in occupancy[each]]
            rank[label] = len(having), round(float(np.concatenate(having).mean()), 4), -ord(label[0])
        order = sorted(rank, key=lambda label: rank[label], reverse=True)
        chosen |= {each: next(label for label in order if label in occupancy[each]) for each in group}
    kept = [i for i, a in enumerate(atoms) if not a.altloc or chosen[place[i]] == a.altloc]
    instead = {(*atoms[i].residue_key, atoms[i].name): i for i in kept if atoms[i].altloc}
    stays = [instead.get((*a.residue_key, a.name), i) if a.altloc else i for i, a in enumerate(atoms)]
    found.conect = sorted({(min(p), max(p)) for p in ((stays[i], stays[j]) for i, j in found.conect) if p[0] != p[1]})
    if len(kept) < len(atoms):
        together = ", one label for what is bonded" if groups.number_of_edges() else ""
        labels = listed([f"{''.join(each)}:{chosen[each]}" for each in occupancy])
        repairs.append(
            f"alternate locations in {counted(len(chosen), 'residue')}: the most occupied kept ({labels}){together}, "
            f"{counted(len(atoms) - len(kept), 'atom')} left out"
        )
    return kept


def _bonds_of_alternates(found: StructureFile, labelled: Sequence[int]) -> list[tuple[int, int]]:
    """Bonds between alternates of two residues: those that are stated, and those that link polymers."""
    atoms = found.atoms
    x = np.array([atoms[i].position_angstrom for i in labelled]) / 10.0
    near = [(labelled[a], labelled[b], float(np.linalg.norm(x[a] - x[b]))) for a, b in near_pairs(x, 0.25).tolist()]
    linked = [
        (i, j) for i, j, d in near if atoms[i].altloc == atoms[j].altloc and links_residues(atoms[i], atoms[j], d)
    ]
    return [(i, j) for i, j in (*found.conect, *linked) if atoms[i].altloc and atoms[j].altloc]


def _refuse_beyond_repair(bonding: Bonding, atoms: Sequence[AtomRecord]) -> None:
    for residue in bonding.residues:
        if residue.template is None or not residue.heavy:
            template, names = residue.template, [atoms[i].name for i in residue.atoms if atoms[i].element != "H"]
            if template and (foreign := [a for a in names if canonical_heavy_name(template, a) is None]):
                raise PreparationError(
                    f"{residue.label} has atoms that no {template.name} has ({listed(foreign)}); rename or delete them."
                )
            short = next(r for r in bonding.residues if r.missing or r.lacks_hydrogens)
            raise PreparationError(
                f"{short.label} lacks atoms that cannot be added beside {residue.label}, which is no standard residue; "
                "give the structure with all atoms and hydrogens."
            )
        essential = [a for a in ("N", "CA", "C") if a in residue.template.heavy and a in residue.missing]
        built = [a for a in residue.missing if a != "OXT"]
        if essential or (built and template_for(residue.key[2]) is None):
            instead = ", or leave its phosphate out" if "OP3" in built else ""
            raise PreparationError(
                f"{residue.label} lacks {' '.join(built)}; missing atoms can be built only in standard residues with a "
                f"complete backbone: add all its heavy atoms{instead}."
            )


def _refuse_surplus_hydrogens(bonding: Bonding, atoms: Sequence[AtomRecord]) -> None:
    """Of standard residues: more hydrogens on an atom than any protonation has, its own or another residue's."""
    neighbours = bonding.neighbours
    for residue in bonding.residues:
        for name, i in residue.heavy.items() if template_for(residue.key[2]) is not None else ():
            hydrogens = [atoms[j] for j in neighbours[i] if atoms[j].element == "H"]
            surplus = len(neighbours[i]) - _MOST_BONDS.get(atoms[i].element, len(neighbours[i]))
            if hydrogens and surplus > 0:
                names = " ".join(h.name if h.residue_key == residue.key else f"and {h.label}" for h in hydrogens)
                raise PreparationError(
                    f"{residue.label} {name} has {counted(len(hydrogens), 'hydrogen')} ({names}), {surplus} too many; "
                    "remove what it cannot have, or all hydrogens, which are then placed anew."
                )


def _refuse_bare_skeletons(residues: Sequence[Residue], atoms: Sequence[AtomRecord]) -> None:
    """A molecule without any hydrogen is most often a file without hydrogens, and would get absurd double bonds."""
    for residue in residues:
        symbols = {atoms[i].element for i in residue.atoms}
        if residue.heavy or "C" not in symbols or "H" in symbols or len(residue.atoms) <= 3:
            continue
        if not {"F", "Cl", "Br", "I"} & symbols or not symbols <= _COMPLETE_WITHOUT_HYDROGEN:
            raise PreparationError(
                f"{residue.label} has no hydrogens and is no standard amino acid; add them first (for instance "
                "`obabel in.pdb -O out.pdb -h`)."
            )


def _refuse_long_multiple_bonds(scene: Scene) -> None:
    """Two carbons that each lack a hydrogen look like a double bond, methanol without any like C≡O; lengths tell."""
    i, j = scene.bonds.T
    length = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=1)
    carbons = (np.array(scene.elements)[scene.bonds] == "C").all(axis=1)
    double = (scene.bond_orders >= 2) & carbons & (length > 0.150)
    for k in np.flatnonzero(double | ((scene.bond_orders >= 3) & (length > 0.130))):
        a, b = (f"{scene.residue_names[scene.residue_of_atom[m]]} {scene.atom_names[m]}" for m in scene.bonds[k])
        raise PreparationError(
            f"{a} and {b} lack hydrogens (a {'triple' if scene.bond_orders[k] >= 3 else 'double'} bond of "
            f"{length[k] * 10:.2f} Å is none); give the structure with all hydrogens."
        )
