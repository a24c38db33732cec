"""A scene as an RDKit molecule, to ask RDKit what it makes of it."""

from __future__ import annotations

from typing import Any

from systems.errors import PreparationError, first_line
from systems.scene import Scene


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
