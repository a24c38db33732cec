"""Files of the chemical component dictionary: a molecule with bond orders and charges, read by gemmi."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from systems.errors import InputError, PreparationError, first_line
from systems.prepare.molecule import RESIDUE_NAME, scene_from_rdkit
from systems.prepare.read.mmcif_file import read_blocks
from systems.prepare.read.mol_file import settle_molecule
from systems.prepare.read.salts import main_molecule
from systems.scene import Scene

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
            settled = settle_molecule(molecule, notes)
        except PreparationError as error:
            raise PreparationError(f"{path}: {error}") from error
    name = (block.find_value("_chem_comp.id") or block.name or "component").strip("'\"")
    scene = scene_from_rdkit(
        settled,
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
