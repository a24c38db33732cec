"""Molecules through RDKit: SMILES and MOL files as scenes, and a scene as an RDKit molecule."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.element_data import atomic_weight_da
from systems.errors import PreparationError, first_line
from systems.scene import Scene

RESIDUE_NAME = "MOL"


def scene_from_smiles(smiles: str, *, seed: int = 0) -> Scene:
    """Return the scene of a SMILES string: all hydrogens, charges as written, 3-D coordinates drawn with `seed`.

    Bond orders are those of one Kekulé structure. Stereo is the SMILES' own; what it leaves open is drawn and said in
    `provenance["repairs"]`. `provenance["multiplicity"]` is 1 + the number of unpaired electrons. Raises
    PreparationError for text that is no SMILES, several fragments, metals and elements without a model, and stereo
    that no geometry can have.
    """
    from systems.prepare.read.smiles import embed, parse_smiles

    notes: list[str] = []
    text = smiles.strip()
    parsed = parse_smiles(text, notes)
    try:
        molecule = embed(parsed, seed=seed, notes=notes)
    except PreparationError as error:
        raise PreparationError(f"SMILES {text!r}: {error}") from error
    provenance = {"source": "smiles", "smiles": text, "seed": seed, "repairs": notes}
    return scene_from_rdkit(molecule, name=text, provenance=provenance)


def scene_from_mol_file(path: str | Path) -> Scene:
    """Return the scene of the first molecule of an SDF, MOL or MOL2 file, at the file's positions.

    Missing hydrogens are added and a flat drawing is embedded, each said in `provenance["repairs"]`; stereo is read
    from the positions (from the wedges of a drawing). Raises InputError for a file that cannot be read,
    PreparationError for what `scene_from_smiles` refuses.
    """
    from systems.prepare.read.mol_file import read_molecule

    file = Path(path).expanduser()
    notes: list[str] = []
    try:
        molecule = read_molecule(file, notes)
        provenance = {
            "source": "file",
            "file": file.name,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "repairs": notes,
        }
        return scene_from_rdkit(molecule, name=file.name.removesuffix(".gz").rsplit(".", 1)[0], provenance=provenance)
    except PreparationError as error:
        raise PreparationError(f"{file}: {error}") from error


def scene_from_rdkit(molecule: Any, *, name: str, provenance: dict[str, Any]) -> Scene:
    """Return the scene of an RDKit molecule with all hydrogens and one conformer, in its atom order.

    One residue; atoms are called after their element and a number, C1, C2, ... Adds `multiplicity` to the provenance.
    """
    from rdkit import Chem

    drawn = Chem.Mol(molecule)
    Chem.Kekulize(drawn, clearAromaticFlags=True)
    atoms = list(drawn.GetAtoms())
    elements = tuple(atom.GetSymbol() for atom in atoms)
    bonds = [(*sorted((b.GetBeginAtomIdx(), b.GetEndAtomIdx())), b.GetBondTypeAsDouble()) for b in drawn.GetBonds()]
    bonds.sort()
    unpaired = sum(atom.GetNumRadicalElectrons() for atom in atoms)
    return Scene(
        name=name,
        atom_names=_unique_names(elements),
        elements=elements,
        residue_of_atom=np.zeros(len(atoms), dtype=np.int64),
        residue_names=(RESIDUE_NAME,),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([b[:2] for b in bonds], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([b[2] for b in bonds], dtype=np.float64),
        formal_charges=np.array([atom.GetFormalCharge() for atom in atoms], dtype=np.int64),
        masses_da=np.array([atomic_weight_da(e) for e in elements]),
        positions_nm=np.array(drawn.GetConformer().GetPositions(), dtype=np.float64) / 10.0,
        provenance=provenance | {"multiplicity": 1 + unpaired},
    )


def to_rdkit(scene: Scene) -> Any:
    """Return a sanitised `rdkit.Chem.Mol` in the scene's atom order: bond orders, formal charges, radicals, positions.

    Stereo (CIP labels included) is read from the positions; PDB names ride along. Raises PreparationError when the
    scene knows no bond orders or they fit no valence.
    """
    from rdkit import Chem
    from rdkit.Geometry import Point3D

    molecule = Chem.RWMol()
    orders = {
        1.0: Chem.BondType.SINGLE,
        1.5: Chem.BondType.AROMATIC,
        2.0: Chem.BondType.DOUBLE,
        3.0: Chem.BondType.TRIPLE,
        4.0: Chem.BondType.QUADRUPLE,
    }
    for i, (element, charge) in enumerate(zip(scene.elements, scene.formal_charges.tolist(), strict=True)):
        atom = Chem.Atom(element)
        atom.SetFormalCharge(charge)
        atom.SetNoImplicit(True)
        atom.SetMonomerInfo(_residue_info(scene, i))
        molecule.AddAtom(atom)
    for (i, j), order in zip(scene.bonds.tolist(), scene.bond_orders.tolist(), strict=True):
        if order not in orders:
            raise PreparationError(
                f"Scene {scene.name!r}: the order of the bond {scene.atom_names[i]} - {scene.atom_names[j]} is not "
                "known; give the molecule as SMILES or SDF."
            )
        molecule.AddBond(i, j, orders[order])
        if order == 1.5:
            molecule.GetAtomWithIdx(i).SetIsAromatic(True)
            molecule.GetAtomWithIdx(j).SetIsAromatic(True)
    conformer = Chem.Conformer(scene.n_atoms)
    for i, (x, y, z) in enumerate((scene.positions_nm * 10.0).tolist()):
        conformer.SetAtomPosition(i, Point3D(x, y, z))
    molecule.AddConformer(conformer, assignId=True)
    try:
        Chem.SanitizeMol(molecule)
    except (Chem.MolSanitizeException, ValueError) as error:
        raise PreparationError(f"Scene {scene.name!r} is no molecule RDKit accepts: {first_line(error)}.") from error
    Chem.AssignStereochemistryFrom3D(molecule)
    return molecule.GetMol()


def _unique_names(elements: tuple[str, ...]) -> tuple[str, ...]:
    count: dict[str, int] = {}
    names = []
    for element in elements:
        count[element] = count.get(element, 0) + 1
        names.append(f"{element.upper()}{count[element]}")
    return tuple(names)


def _residue_info(scene: Scene, i: int) -> Any:
    from rdkit import Chem

    residue = int(scene.residue_of_atom[i])
    number = "".join(c for c in scene.residue_ids[residue] if c.isdigit())
    info = Chem.AtomPDBResidueInfo(
        f"{scene.atom_names[i]:<4s}",
        residueName=scene.residue_names[residue],
        residueNumber=int(number or 1),
        chainId=scene.chain_of_residue[residue][:1],
    )
    return info
