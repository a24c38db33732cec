"""Scene from a structure file: atoms chosen, bonds found, missing atoms added, geometry checked, repairs noted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import networkx as nx
import numpy as np

from systems.chemistry.geometry import near_pairs
from systems.chemistry.residues import template_for
from systems.errors import PreparationError, listed
from systems.options import Preparation
from systems.prepare.bonding import find_bonds, links_residues
from systems.prepare.checks import (
    caps_of,
    check_contacts,
    find_gaps,
    handedness,
    made_whole,
    refuse_changed,
    refuse_gaps,
    say_inverted,
)
from systems.prepare.heterogens import (
    agent_atoms,
    complete_waters,
    ligand_atoms,
    refuse_bare_ligands,
    resolve_ligands,
    resolve_solvent,
)
from systems.prepare.mol2_file import read_mol2
from systems.prepare.records import (
    D_RESIDUES,
    AtomRecord,
    Bonding,
    Residue,
    StructureFile,
    by_residue,
    distance_angstrom,
    file_name_and_provenance,
    scene_from_records,
    standardise,
    suffix_of,
)
from systems.prepare.structure_text import is_component, is_mmcif, read_structure, structure_text
from systems.scene import IntArray, Scene

# Of a standard residue's atoms in any protonation, bonds to hydrogen among them.
_MOST_BONDS = {"C": 4, "N": 4, "O": 2, "S": 2}
_COMPLETE_WITHOUT_HYDROGEN = {"C", "F", "Cl", "Br", "I", "O", "N", "S"}


def prepare_file(path: Path, options: Preparation) -> Scene:
    """Return the scene of a PDB or mmCIF file, or of a MOL2 file of standard residues."""
    if is_mmcif(path) and is_component(text := structure_text(path)):
        from systems.prepare.molecule import scene_from_component

        return scene_from_component(text, path)
    try:
        return _prepare_file(path, options)
    except PreparationError as error:
        if str(path) in str(error):
            raise
        raise PreparationError(f"{path}: {error}") from error


def _prepare_file(path: Path, options: Preparation) -> Scene:
    found = read_mol2(path) if suffix_of(path) == ".mol2" else read_structure(path)
    found = made_whole(found)
    repairs = list(found.notes)
    kept = _choose_alternates(found, repairs)
    kept, wet = resolve_solvent(
        found.atoms, kept, keep_water=options.keep_water, keep_ions=options.keep_ligand, notes=repairs
    )
    structure = found.only(kept)
    structure.atoms = standardise(structure.atoms, repairs)
    bonding = find_bonds(structure.atoms, structure.conect, structure.chain_ends)
    if bonding.unmade:
        repairs.append(f"stated bonds that are not made: {listed(bonding.unmade)}")
    ligands = ligand_atoms(structure.atoms, bonding)
    if not (options.keep_ligand or options.drop_ligand):
        agents = agent_atoms(structure.atoms, ligands, repairs)
        if agents:
            structure = structure.without(agents)
            bonding = find_bonds(structure.atoms, structure.conect, structure.chain_ends)
            ligands = ligand_atoms(structure.atoms, bonding)
    if ligands:
        stays = resolve_ligands(
            structure.atoms, ligands, keep=options.keep_ligand, drop=options.drop_ligand, notes=repairs
        )
        rest = structure.without(ligands)
        if stays:
            refuse_bare_ligands(structure.atoms, ligands)
            others = structure.only(ligands)
            others_bonding = find_bonds(others.atoms, others.conect)
        structure, bonding = rest, find_bonds(rest.atoms, rest.conect, rest.chain_ends)
    gaps = find_gaps(bonding, structure.chain_ends)
    if gaps and options.cap_breaks:
        caps = caps_of(gaps, structure.atoms, repairs)
        structure.atoms = [*structure.atoms, *caps]
        bonding = find_bonds(structure.atoms, structure.conect, structure.chain_ends)
    refuse_gaps([] if options.cap_breaks else gaps, structure.atoms)
    repairs += bonding.notes
    repairs += _disulfides(bonding, structure.atoms)
    atoms, bonds = list(structure.atoms), bonding.bonds
    known = [(r, r.template.name) for r in bonding.residues if r.template is not None]
    before = handedness((r.key, name, {a: atoms[i] for a, i in r.heavy.items()}) for r, name in known)
    clashes = _clashing_hydrogens(atoms, bonds)
    if not bonding.is_complete:
        _refuse_beyond_repair(bonding, atoms)
        from systems.prepare.repair import complete

        atoms, bonds, summary = complete(atoms, bonding, ph=options.ph)
        repairs += summary
        now = by_residue(atoms)
        hands = handedness((r.key, name, {atoms[i].name: atoms[i] for i in now.get(r.key, ())}) for r, name in known)
        refuse_changed(before, hands)
    else:
        hands = before
        _refuse_bare_skeletons(bonding.residues, atoms)
    if clashes and _overfull(atoms, bonds):
        raise clashes[0]
    if bonding.is_complete:
        _refuse_surplus_hydrogens(bonding, atoms)
    say_inverted(hands, repairs)
    if ligands and stays:
        bonds = np.concatenate([bonds, others_bonding.bonds + len(atoms)])
        atoms = [*atoms, *others.atoms]
        repairs += others_bonding.notes
    if wet:
        waters, water_bonds = complete_waters([found.atoms[i] for i in wet], atoms, repairs)
        bonds = np.concatenate([bonds, water_bonds + len(atoms)])
        atoms = [*atoms, *waters]
    repairs += check_contacts(atoms, bonds)
    scene = scene_from_records(
        atoms,
        bonds,
        **file_name_and_provenance(path, repairs, ph=options.ph),
    )
    _refuse_long_double_bonds(scene)
    return scene


def _disulfides(bonding: Bonding, atoms: Sequence[AtomRecord]) -> list[str]:
    sulfur = {r.heavy["SG"]: r for r in bonding.residues if "SG" in r.heavy}
    return [
        f"disulfide bond {sulfur[i].label} - {sulfur[j].label} ({distance_angstrom(atoms[i], atoms[j]):.2f} Å)"
        for i, j in bonding.bonds.tolist()
        if i in sulfur and j in sulfur
    ]


def _choose_alternates(found: StructureFile, repairs: list[str]) -> list[int]:
    """Indices of the atoms that stay: of alternate locations the most occupied, one label for all that is bonded.

    Labels that most of the bonded residues have go first. A stated bond holds for the alternate that stays: `conect` of
    `found` is changed to that.
    """
    atoms = found.atoms
    labelled = [i for i, a in enumerate(atoms) if a.altloc]
    if not labelled:
        return list(range(len(atoms)))
    groups = nx.Graph()
    occupancy: dict[tuple[str, str], dict[str, list[float]]] = {}
    for i in labelled:
        groups.add_node(atoms[i].residue_key[:2])
        occupancy.setdefault(atoms[i].residue_key[:2], {}).setdefault(atoms[i].altloc, []).append(atoms[i].occupancy)
    groups.add_edges_from(
        (atoms[i].residue_key[:2], atoms[j].residue_key[:2]) for i, j in _bonds_of_alternates(found, labelled)
    )
    chosen: dict[tuple[str, str], str] = {}
    for group in nx.connected_components(groups):
        of_label: dict[str, list[list[float]]] = {}
        for place in group:
            for label, values in occupancy[place].items():
                of_label.setdefault(label, []).append(values)

        def rank(label: str, of_label: dict[str, list[list[float]]] = of_label) -> tuple[int, float, int]:
            values = np.concatenate(of_label[label])
            return len(of_label[label]), round(float(values.mean()), 4), -ord(label[0])

        order = sorted(of_label, key=rank, reverse=True)
        chosen |= {place: next(label for label in order if label in occupancy[place]) for place in group}
    chosen = {place: chosen[place] for place in occupancy}
    kept = [i for i, a in enumerate(atoms) if not a.altloc or chosen[a.residue_key[:2]] == a.altloc]
    instead = {(*atoms[i].residue_key, atoms[i].name): i for i in kept if atoms[i].altloc}
    stays = [instead.get((*a.residue_key, a.name), i) if a.altloc else i for i, a in enumerate(atoms)]
    found.conect = sorted({(min(p), max(p)) for p in ((stays[i], stays[j]) for i, j in found.conect) if p[0] != p[1]})
    if len(kept) < len(atoms):
        together = ", one label for what is bonded" if groups.number_of_edges() else ""
        labels = listed([f"{''.join(place)}:{label}" for place, label in chosen.items()])
        repairs.append(
            f"alternate locations in {len(chosen)} residues: the most occupied kept ({labels}){together}, "
            f"{len(atoms) - len(kept)} atoms left out"
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
        if all(atoms[i].element == "H" for i in residue.atoms):
            raise PreparationError(f"{residue.label} has only hydrogens; give its other atoms, or number it correctly.")
        if residue.template is None or not residue.heavy:
            short = next(r for r in bonding.residues if r.missing or r.lacks_hydrogens)
            raise PreparationError(
                f"{short.label} lacks atoms that cannot be added beside {residue.label}"
                f"{_handed(residue)}, which is no standard residue; give the structure with all atoms "
                "and hydrogens."
            )
        essential = [a for a in ("N", "CA", "C") if a in residue.template.heavy and a in residue.missing]
        if essential:
            raise PreparationError(
                f"{residue.label} has only {' '.join(residue.heavy)} of its heavy atoms; "
                "give a structure with at least the whole backbone."
            )
        built = [a for a in residue.missing if a != "OXT"]
        if built and template_for(residue.key[2]) is None:
            instead = ", or leave its phosphate out" if "OP3" in built else ""
            raise PreparationError(
                f"{residue.label}{_handed(residue)} lacks {' '.join(built)}; atoms are built for "
                f"standard residues alone: add all its heavy atoms{instead}."
            )


def _handed(residue: Residue) -> str:
    """What a residue that is no template is, with a leading comma, where it is a D-residue."""
    name = D_RESIDUES.get(residue.key[2].upper())
    return f", D-{name.lower()}" if name else ""


def _overfull(atoms: Sequence[AtomRecord], bonds: IntArray) -> set[int]:
    """Return the atoms with more bonds than their element can have."""
    n_bonds = np.bincount(bonds.ravel(), minlength=len(atoms)).tolist()
    return {i for i, n in enumerate(n_bonds) if n > _MOST_BONDS.get(atoms[i].element, n)}


def _clashing_hydrogens(atoms: Sequence[AtomRecord], bonds: IntArray) -> list[PreparationError]:
    """Say which hydrogens of one residue stand at an atom of another that has all it can have: to be raised where
    placing hydrogens anew does not part them."""
    overfull = _overfull(atoms, bonds)
    both = (*bonds.tolist(), *bonds[:, ::-1].tolist()) if overfull else ()
    clashes = [(atoms[i], atoms[j]) for i, j in both if j in overfull and atoms[i].element == "H"]
    return [
        PreparationError(
            f"{first.label} and {second.label} are {distance_angstrom(first, second):.2f} Å apart, and no bond can "
            "join them: the atoms clash; model them again, or take all hydrogens out, which are then placed anew."
        )
        for first, second in clashes
        if first.residue_key != second.residue_key
    ]


def _refuse_surplus_hydrogens(bonding: Bonding, atoms: Sequence[AtomRecord]) -> None:
    """Of standard residues: more hydrogens on an atom than any protonation has."""
    neighbours = bonding.neighbours
    for residue in bonding.residues:
        for name, i in residue.heavy.items() if template_for(residue.key[2]) is not None else ():
            hydrogens = [atoms[j].name for j in neighbours[i] if atoms[j].element == "H"]
            surplus = len(neighbours[i]) - _MOST_BONDS.get(atoms[i].element, len(neighbours[i]))
            if hydrogens and surplus > 0:
                raise PreparationError(
                    f"{residue.label} {name} has {len(hydrogens)} hydrogens ({' '.join(hydrogens)}), {surplus} too "
                    "many; remove what it cannot have, or all hydrogens, which are then placed anew."
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


def _refuse_long_double_bonds(scene: Scene) -> None:
    """Two carbons that each lack a hydrogen look like a double bond, methanol without any like C≡O; lengths tell."""
    for (i, j), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        if order >= 3 or (order >= 2 and scene.elements[i] == scene.elements[j] == "C"):
            length = float(np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j]))
            if length > (0.150 if order < 3 else 0.130):
                a, b = (f"{scene.residue_names[scene.residue_of_atom[k]]} {scene.atom_names[k]}" for k in (i, j))
                raise PreparationError(
                    f"{a} and {b} lack hydrogens (a {'double' if order < 3 else 'triple'} bond of {length * 10:.2f} Å "
                    "is none); give the structure with all hydrogens."
                )
