"""Molecules for the tests of systems: from SMILES, reordered, mirrored."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from systems import scene as scenes
from systems.scene import Scene


def _from_smiles(smiles: str, seed: int = 1) -> Scene:
    from rdkit import Chem
    from rdkit.Chem import AllChem

    molecule = Chem.AddHs(Chem.MolFromSmiles(smiles))
    assert AllChem.EmbedMolecule(molecule, randomSeed=seed) == 0
    Chem.Kekulize(molecule)
    bonds = [sorted((b.GetBeginAtomIdx(), b.GetEndAtomIdx())) for b in molecule.GetBonds()]
    atoms = list(molecule.GetAtoms())
    return Scene(
        name=smiles,
        atom_names=tuple(f"X{i}" for i in range(len(atoms))),
        elements=tuple(a.GetSymbol() for a in atoms),
        residue_of_atom=np.zeros(len(atoms), dtype=np.int64),
        residue_names=("UNL",),
        residue_ids=("1",),
        chain_of_residue=("",),
        bonds=np.array(bonds, dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([b.GetBondTypeAsDouble() for b in molecule.GetBonds()]),
        formal_charges=np.array([a.GetFormalCharge() for a in atoms], dtype=np.int64),
        masses_da=np.array([a.GetMass() for a in atoms]),
        positions_nm=molecule.GetConformer().GetPositions() / 10.0,
    )


@pytest.fixture(scope="session")
def from_smiles() -> Callable[..., Scene]:
    """`from_smiles(smiles, seed=1)`: an embedded molecule with all hydrogens."""
    return _from_smiles


@pytest.fixture(scope="session")
def reordered() -> Callable[..., Scene]:
    """`reordered(scene, order)`: atom k of the result is atom order[k] of the scene."""
    return scenes.reordered


@pytest.fixture(scope="session")
def mirrored() -> Callable[[Scene], Scene]:
    """The mirror image of a scene."""
    return lambda scene: scene.with_positions(scene.positions_nm * [1.0, 1.0, -1.0])
