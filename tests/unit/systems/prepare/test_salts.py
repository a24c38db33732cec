"""Drugs with their counterions are the drug, said; mixtures are refused; charges that a file leaves out are found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rdkit import Chem
from rdkit.Chem import rdDistGeom
from rdkit_of_scene import to_rdkit

from systems.errors import PreparationError
from systems.library.named_scenes import prepare


@pytest.mark.parametrize(
    ("smiles", "kept", "left_out"),
    [
        ("Cl.CNCCC(Oc1ccc(cc1)C(F)(F)F)c1ccccc1", "CNCCC(Oc1ccc(C(F)(F)F)cc1)c1ccccc1", "Cl"),
        ("[Na+].[O-]C(=O)Cc1ccccc1Nc1c(Cl)cccc1Cl", "O=C([O-])Cc1ccccc1Nc1c(Cl)cccc1Cl", "[Na+]"),
        ("CS(=O)(=O)O.NCc1ccccc1", "NCc1ccccc1", "CS(=O)(=O)O"),
        ("OS(=O)(=O)O.NCc1ccccc1.NCc1ccccc1", "NCc1ccccc1", "O=S(=O)(O)O, NCc1ccccc1"),
        ("O.O.NCc1ccccc1.OC(=O)/C=C\\C(=O)O", "NCc1ccccc1", "2 O, O=C(O)/C=C\\C(=O)O"),
        ("[Ca+2].CC(=O)[O-].CC(=O)[O-]", "CC(=O)[O-]", "[Ca+2], CC(=O)[O-]"),
        ("[NH4+].OC(=O)CCC(=O)[O-]", "O=C([O-])CCC(=O)O", "[NH4+]"),
    ],
)
def test_a_salt_is_its_drug_and_what_is_left_out_is_said(smiles: str, kept: str, left_out: str) -> None:
    scene = prepare(f"smiles:{smiles}")
    found = Chem.MolToSmiles(Chem.RemoveHs(to_rdkit(scene)), isomericSmiles=False)
    assert Chem.CanonSmiles(found) == Chem.CanonSmiles(kept)
    note = next(line for line in scene.provenance["repairs"] if line.startswith("a salt"))
    assert note.endswith(f"left out: {left_out}")


@pytest.mark.parametrize(
    "smiles",
    ["CCO.c1ccccc1", "CCO.CCO", "[Na+].[Cl-]", "O.O", "C[N+](C)(C)CCO.OC(=O)c1ccccc1[O-]",
     "[CH-]1C=CC=C1.[CH-]1C=CC=C1.[Fe+2]", "[NH4+].[NH4+].[O-]S(=O)(=O)[O-]"],
)  # fmt: skip
def test_mixtures_are_refused(smiles: str) -> None:
    with pytest.raises(PreparationError, match="a salt or a mixture; give one molecule"):
        prepare(f"smiles:{smiles}")


def test_a_salt_in_a_file_keeps_the_positions_of_its_drug(tmp_path: Path) -> None:
    molecule = Chem.AddHs(Chem.MolFromSmiles("[Na+].CC(=O)[O-]"))
    rdDistGeom.EmbedMolecule(molecule, randomSeed=1)
    (tmp_path / "x.sdf").write_text(Chem.MolToMolBlock(molecule))
    scene = prepare(str(tmp_path / "x.sdf"))
    assert (scene.formula, int(scene.formal_charges.sum())) == ("C2H3O2", -1)
    assert scene.positions_nm == pytest.approx(np.array(molecule.GetConformer().GetPositions())[1:] / 10, abs=1e-4)


def test_charges_that_a_file_leaves_out_are_found_and_said(tmp_path: Path) -> None:
    for smiles, charge, note in (
        ("C[N+](C)(C)CCO", 1, "charges that the file leaves out, from the number of bonds: N2 +1"),
        ("c1cc[nH+]cc1", 1, "charges that the file leaves out, from the number of bonds: N4 +1"),
    ):
        molecule = Chem.AddHs(Chem.MolFromSmiles(smiles))
        rdDistGeom.EmbedMolecule(molecule, randomSeed=1)
        lines = Chem.MolToMolBlock(molecule, kekulize=True).splitlines()
        (tmp_path / "x.sdf").write_text("\n".join(line for line in lines if not line.startswith("M  CHG")))
        scene = prepare(str(tmp_path / "x.sdf"))
        assert int(scene.formal_charges.sum()) == charge
        assert scene.provenance["repairs"] == [note]
    wrong = Chem.RWMol(Chem.MolFromSmiles("CC(C)(C)C"))
    wrong.GetBondBetweenAtoms(0, 1).SetBondType(Chem.BondType.DOUBLE)
    (tmp_path / "x.sdf").write_text(Chem.MolToMolBlock(wrong, kekulize=False))
    with pytest.raises(PreparationError, match="no possible molecule"):
        prepare(str(tmp_path / "x.sdf"))


def test_deuterium_v3000_and_several_records_are_read(tmp_path: Path) -> None:
    molecule = Chem.AddHs(Chem.MolFromSmiles("[2H]C([2H])([2H])S(C)=O"))
    rdDistGeom.EmbedMolecule(molecule, randomSeed=1)
    for block in (Chem.MolToMolBlock(molecule), Chem.MolToV3KMolBlock(molecule)):
        (tmp_path / "x.sdf").write_text(f"{block}$$$$\r\n{block}$$$$\n")
        scene = prepare(str(tmp_path / "x.sdf"))
        assert scene.formula == "C2H6OS"
        assert scene.provenance["repairs"] == [
            "2 molecules in the file: the first is taken",
            "isotope labels (2H) left out: all atoms have natural masses",
        ]
    text = Chem.MolToMolBlock(Chem.AddHs(Chem.MolFromSmiles("CO")))
    (tmp_path / "x.sdf").write_text(text.replace(" H  ", " D  ", 1))
    assert prepare(str(tmp_path / "x.sdf")).formula == "CH4O"


def test_a_file_that_calls_its_drawing_three_dimensional_is_embedded(tmp_path: Path) -> None:
    molecule = Chem.AddHs(Chem.MolFromSmiles("CC(C)O"))
    rdDistGeom.EmbedMolecule(molecule, randomSeed=1)
    for i in range(molecule.GetNumAtoms()):
        x, y, _ = molecule.GetConformer().GetAtomPosition(i)
        molecule.GetConformer().SetAtomPosition(i, (x, y, 0.0))
    (tmp_path / "x.sdf").write_text(Chem.MolToMolBlock(molecule).replace("          2D", "          3D", 1))
    scene = prepare(str(tmp_path / "x.sdf"))
    assert np.abs(scene.positions_nm[:, 2]).max() > 0.01
    flat = Chem.AddHs(Chem.MolFromSmiles("c1ccccc1"))
    rdDistGeom.EmbedMolecule(flat, randomSeed=1)
    block = Chem.MolToMolBlock(flat)
    (tmp_path / "y.sdf").write_text(block)
    assert prepare(str(tmp_path / "y.sdf")).provenance["repairs"] == []
