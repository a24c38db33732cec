"""Molecules through RDKit: SMILES and MOL files as scenes, and a scene as an RDKit molecule.

Files of the chemical component dictionary have bond orders and charges, too; gemmi reads them.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from systems.chemistry.element_data import atomic_weight_da
from systems.errors import InputError, PreparationError, first_line
from systems.prepare.read.mmcif_file import read_blocks
from systems.prepare.read.mol_file import resolve_molecule
from systems.prepare.read.smiles import main_molecule
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


# ---- files of the chemical component dictionary ---------------------------------------------------------------------


_IDEAL = ("pdbx_model_Cartn_x_ideal", "pdbx_model_Cartn_y_ideal", "pdbx_model_Cartn_z_ideal")
_MODEL = ("model_Cartn_x", "model_Cartn_y", "model_Cartn_z")
_PLAIN = ("x", "y", "z")
_ORDERS = {"sing": 1, "single": 1, "doub": 2, "double": 2, "trip": 3, "triple": 3, "quad": 4, "arom": 12,
           "aromatic": 12, "delo": 12, "deloc": 12}  # fmt: skip
_AROMATIC = 12


def scene_from_component(text: str, path: Path) -> Scene:
    """Return the scene of the first component of a file, all of its atoms under their names, at its ideal positions.

    Where these are missing the positions of the model that the component was taken from are, then drawn ones. Raises
    InputError for atoms or bonds that cannot be read, PreparationError for what is no molecule.
    """
    from rdkit import rdBase

    notes: list[str] = []
    blocks = [b for b in read_blocks(text, path) if b.find_mmcif_category("_chem_comp_atom.")]
    if len(blocks) > 1:
        notes.append(f"{len(blocks)} components in the file: the first is taken")
    block = blocks[0]
    with rdBase.BlockLogs():
        try:
            molecule, names = _molecule(block, path, notes)
        except RuntimeError as error:  # gemmi's, of tables whose tags do not go together
            raise InputError(f"{path} is damaged ({first_line(error)}); fetch it again.") from error
        try:
            if main_molecule(molecule, []).GetNumAtoms() < molecule.GetNumAtoms():
                raise PreparationError("it is a salt of several molecules; give one of them.")
            resolved = resolve_molecule(molecule, notes)
        except PreparationError as error:
            raise PreparationError(f"{path}: {error}") from error
    name = (block.find_value("_chem_comp.id") or block.name or "component").strip("'\"")
    scene = scene_from_rdkit(
        resolved,
        name=name,
        provenance={
            "source": "file",
            "file": path.name,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "repairs": notes,
        },
    )
    return replace(
        scene,
        atom_names=(*names, *scene.atom_names[len(names) :]),
        residue_names=(name if len(name) <= 5 else RESIDUE_NAME,),
    )


def _molecule(block: Any, path: Path, notes: list[str]) -> tuple[Any, list[str]]:
    """Return the RDKit molecule of a component, unsanitised, and the names of its atoms."""
    from rdkit import Chem

    where = f"{path}, component {block.name}"
    tags = [f"?{tag}" for tag in (*_IDEAL, *_MODEL, *_PLAIN)]
    rows = block.find("_chem_comp_atom.", ["atom_id", "type_symbol", "?charge", *tags])
    molecule = Chem.RWMol()
    index: dict[str, int] = {}
    positions: dict[tuple[str, ...], list[tuple[float, ...]]] = {_IDEAL: [], _MODEL: [], _PLAIN: []}
    for row in rows:
        name, symbol = row.str(0), row.str(1).capitalize()
        try:
            atom = Chem.Atom("H" if symbol == "D" else symbol)
            atom.SetFormalCharge(round(float(row.str(2))) if row.has(2) and row.str(2) else 0)
        except (RuntimeError, ValueError):
            raise InputError(f"{where}: atom {name!r} has no element or no charge that can be read.") from None
        atom.SetNoImplicit(True)
        if name in index:
            raise InputError(f"{where}: two atoms are called {name!r}; fetch the file again.")
        index[name] = molecule.AddAtom(atom)
        for k, kind in enumerate(positions):
            values = [row.str(3 + 3 * k + axis) if row.has(3 + 3 * k + axis) else "" for axis in range(3)]
            if all(values):
                try:
                    positions[kind].append(tuple(float(v) for v in values))
                except ValueError:
                    raise InputError(f"{where}: a coordinate of {name!r} is not a number.") from None
    if not index:
        raise InputError(f"{where} lacks atom_id or type_symbol; fetch the file again, or give the component as SDF.")
    for row in block.find("_chem_comp_bond.", ["atom_id_1", "atom_id_2", "?value_order", "?type"]):
        order = next((row.str(k).lower() for k in (2, 3) if row.has(k) and row.str(k)), "sing")
        try:
            ends = index[row.str(0)], index[row.str(1)]
            molecule.AddBond(*ends, Chem.BondType.values[_ORDERS[order]])
        except (KeyError, RuntimeError):
            raise InputError(f"{where}: the bond {row.str(0)} - {row.str(1)} ({order}) cannot be read.") from None
        for i in ends if _ORDERS[order] == _AROMATIC else ():
            molecule.GetAtomWithIdx(i).SetIsAromatic(True)
    whole = [found for found in positions.values() if len(found) == len(index)]
    if not whole:
        notes.append("no whole set of positions in the file")
    else:
        conformer = Chem.Conformer(len(index))
        conformer.Set3D(True)
        for i, place in enumerate(whole[0]):
            conformer.SetAtomPosition(i, place)
        molecule.AddConformer(conformer, assignId=True)
    return molecule, list(index)
