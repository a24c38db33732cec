"""Molecules through RDKit: SMILES and MOL files to scenes and back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drug_like_smiles import Case, cases, what_is_wrong
from rdkit import Chem, rdBase
from rdkit.Chem import rdDepictor, rdDistGeom
from rdkit_of_scene import to_rdkit

from small_scenes import n_unpaired_electrons
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.molecule import compare_stereo, scene_from_mol_file, scene_from_smiles, stereo_labels
from systems.scene import Scene

ACCEPTED = [c for c in cases() if not c.refusal]
REFUSED = [c for c in cases() if c.refusal]
PEPTIDE_LIKE = "C[C@H]([NH3+])C(=O)N/C=C/c1ccccc1"


def _canonical(molecule: Any) -> str:
    with rdBase.BlockLogs():
        return Chem.MolToSmiles(Chem.RemoveHs(molecule))


def _hill_counts(formula: str) -> list[tuple[str, str]]:
    import re

    return sorted(re.findall(r"([A-Z][a-z]?)(\d*)", formula))


# ---- the list of fifty --------------------------------------------------------------------------------------------


def test_the_list_has_fifty_varied_molecules() -> None:
    assert len(cases()) == len({c.name for c in cases()}) == len({c.smiles for c in cases()}) == 50
    kinds = {c.kind for c in cases()}
    assert {"charged", "zwitterion", "halogen", "sulfur", "phosphorus", "macrocycle", "stereo"} <= kinds
    assert {"radical", "salt", "metal", "element"} <= kinds


@pytest.mark.parametrize("case", ACCEPTED, ids=lambda c: c.name)
def test_each_is_prepared_as_it_is_known(case: Case) -> None:
    scene = prepare(f"smiles:{case.smiles}")
    assert _hill_counts(scene.formula) == _hill_counts(case.formula)
    assert int(scene.formal_charges.sum()) == case.charge
    assert (scene.provenance["multiplicity"], n_unpaired_electrons(scene)) == (case.multiplicity, case.multiplicity - 1)
    given = Chem.AddHs(Chem.MolFromSmiles(case.smiles))
    asked, drawn = stereo_labels(given), stereo_labels(to_rdkit(scene))
    assert "".join(sorted(asked.values())) == case.stereo
    assert {k: drawn.get(k) for k in asked} == asked
    said = [line for line in scene.provenance["repairs"] if "not specified in the input" in line]
    assert len(said) == len(set(drawn) - set(asked))
    assert [a.GetFormalCharge() for a in given.GetAtoms()] == scene.formal_charges.tolist()
    assert len(set(scene.atom_names)) == scene.n_atoms and max(map(len, scene.atom_names)) <= 4
    assert set(scene.residue_names) == {"MOL"}


@pytest.mark.parametrize("case", REFUSED, ids=lambda c: c.name)
def test_each_refusal_names_its_reason_in_one_line(case: Case) -> None:
    with pytest.raises(PreparationError) as caught:
        prepare(f"smiles:{case.smiles}")
    assert case.refusal in str(caught.value)
    assert case.smiles in str(caught.value) and "\n" not in str(caught.value)


# ---- SMILES -------------------------------------------------------------------------------------------------------


def test_one_seed_gives_one_geometry_and_another_seed_another() -> None:
    first, again, other = (scene_from_smiles("CCCCO", seed=s) for s in (3, 3, 4))
    assert (first.positions_nm == again.positions_nm).all()
    assert np.abs(first.positions_nm - other.positions_nm).max() > 1e-3
    assert molecule_key(first) == molecule_key(other)


def test_enantiomers_keep_their_hands() -> None:
    left, right = (scene_from_smiles(s) for s in ("N[C@@H](C)C(=O)O", "N[C@H](C)C(=O)O"))
    assert (list(stereo_labels(to_rdkit(left)).values()), list(stereo_labels(to_rdkit(right)).values())) == (
        ["S"],
        ["R"],
    )
    mirrored = left.with_positions(left.positions_nm * [1, 1, -1])
    assert stereo_labels(to_rdkit(mirrored)) == stereo_labels(to_rdkit(right))


def test_changed_stereo_is_refused() -> None:
    left, right = (to_rdkit(scene_from_smiles(s)) for s in ("N[C@@H](C)C(=O)O", "N[C@H](C)C(=O)O"))
    assert compare_stereo(left, left) == []
    with pytest.raises(PreparationError, match="stereocentre C1 is S in the input and R in 3-D"):
        compare_stereo(left, right)
    trans, cis = (to_rdkit(scene_from_smiles(s)) for s in ("C/C=C/C", r"C/C=C\C"))
    with pytest.raises(PreparationError, match="double bond C2=C3 is E in the input and Z in 3-D"):
        compare_stereo(trans, cis)


def test_what_is_left_out_is_said() -> None:
    assert scene_from_smiles("[2H]CO").provenance["repairs"] == [
        "isotope labels (2H) left out: all atoms have natural masses"
    ]


@pytest.mark.parametrize(
    ("smiles", "expected"),
    [
        ("", "no atoms"),
        ("C1CC", "cannot be read"),
        ("c1cncc1", "kekulize"),
        ("C(C)(C)(C)(C)C", "valence"),
        ("CC>>CO", "cannot be read"),
        ("*CC", "wildcard"),
        ("C~C", "the bond C1 - C2 has no order"),
        ("[Na+]", "metals"),
        ("[Ar]", "it holds Ar"),
        ("C" * 1200, "embedded up to 999"),
        ("CC1(C)[C@@H]2CC[C@]1(C)C(=O)C2", "no 3-D geometry"),
    ],
)
def test_impossible_smiles_are_refused_in_one_line(smiles: str, expected: str) -> None:
    with pytest.raises(PreparationError, match=expected) as caught:
        prepare(f"smiles:{smiles}")
    assert "\n" not in str(caught.value)


# ---- to RDKit and back --------------------------------------------------------------------------------------------


def test_to_rdkit_is_exact_for_bonds_charges_and_aromaticity() -> None:
    for smiles in (
        PEPTIDE_LIKE,
        "c1ccc2[nH]ccc2c1",
        "C[S@](=O)c1ccncc1",
        "[O-][n+]1ccccc1",
        "CP(=O)([O-])[O-]",
        "[C-]#[O+]",
    ):
        scene = scene_from_smiles(smiles)
        back = to_rdkit(scene)
        assert _canonical(back) == Chem.CanonSmiles(smiles)
        assert back.GetConformer().GetPositions() == pytest.approx(scene.positions_nm * 10)
        assert [a.GetPDBResidueInfo().GetName().strip() for a in back.GetAtoms()] == list(scene.atom_names)


def test_to_rdkit_reads_a_peptide() -> None:
    scene = named_scenes.load("alanine-dipeptide")
    assert _canonical(to_rdkit(scene)) == Chem.CanonSmiles("CC(=O)N[C@@H](C)C(=O)NC")


def test_to_rdkit_refuses_what_it_cannot_know() -> None:
    scene = scene_from_smiles("CC")
    with pytest.raises(PreparationError, match="order of the bond C1 - C2 is not known"):
        to_rdkit(replace(scene, bond_orders=np.zeros(7)))
    with pytest.raises(PreparationError, match="no molecule RDKit accepts"):
        to_rdkit(replace(scene, bond_orders=np.full(7, 3.0)))


# ---- MOL files ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def molecule() -> Any:
    return to_rdkit(scene_from_smiles(PEPTIDE_LIKE))


def _flat(whole: Any) -> str:
    drawing = Chem.MolFromSmiles(PEPTIDE_LIKE)
    rdDepictor.Compute2DCoords(drawing)
    Chem.WedgeMolBonds(drawing, drawing.GetConformer())
    return Chem.MolToMolBlock(drawing)


@pytest.mark.parametrize(
    ("suffix", "write", "notes"),
    [
        ("mol", Chem.MolToMolBlock, []),
        ("sdf", lambda m: Chem.MolToV3KMolBlock(m) + "$$$$\n", []),
        ("sdf", lambda m: (Chem.MolToMolBlock(m) + "$$$$\n") * 2, ["2 molecules in the file: the first is taken"]),
        ("mol", lambda m: Chem.MolToMolBlock(Chem.RemoveHs(m)), ["hydrogens added: 15"]),
        (
            "mol",
            _flat,
            ["hydrogens added: 15", "2-D structure: 3-D coordinates generated, stereochemistry from the wedge bonds"],
        ),
    ],
    ids=["mol", "v3000", "two", "no-hydrogens", "flat"],
)
def test_mol_files_keep_stereo_and_charge(
    tmp_path: Path, molecule: Any, suffix: str, write: Callable[[Any], str], notes: list[str]
) -> None:
    path = tmp_path / f"x.{suffix}"
    path.write_text(write(molecule))
    scene = prepare(str(path))
    assert scene.provenance["repairs"] == notes
    assert (scene.formula, int(scene.formal_charges.sum())) == ("C11H15N2O", 1)
    assert _canonical(to_rdkit(scene)) == Chem.CanonSmiles(PEPTIDE_LIKE)
    if not notes:
        assert scene.positions_nm * 10 == pytest.approx(molecule.GetConformer().GetPositions(), abs=1e-3)


MOL2 = """@<TRIPOS>MOLECULE
methylammonium
 8 7 1
SMALL
{kind}
@<TRIPOS>ATOM
1 C1  0.0000  0.0000  0.0000 C.3 1 MOL {c}
2 N1  1.4900  0.0000  0.0000 N.4 1 MOL {n}
3 H1 -0.3600  1.0300  0.0000 H 1 MOL {h}
4 H2 -0.3600 -0.5100  0.8900 H 1 MOL {h}
5 H3 -0.3600 -0.5100 -0.8900 H 1 MOL {h}
6 H4  1.8300 -0.9600  0.0000 H 1 MOL {h}
7 H5  1.8300  0.4800  0.8300 H 1 MOL {h}
8 H6  1.8300  0.4800 -0.8300 H 1 MOL {h}
@<TRIPOS>BOND
1 1 2 1
2 1 3 1
3 1 4 1
4 1 5 1
5 2 6 1
6 2 7 1
7 2 8 1
"""


def test_mol2_charges_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "x.mol2"
    path.write_text(MOL2.format(kind="USER_CHARGES", c=-0.2, n=-0.3, h=0.25))
    assert int(scene_from_mol_file(path).formal_charges.sum()) == 1
    path.write_text(MOL2.format(kind="NO_CHARGES", c=0, n=0, h=0))
    assert int(scene_from_mol_file(path).formal_charges.sum()) == 1
    path.write_text(MOL2.format(kind="USER_CHARGES", c=-0.2, n=-1.3, h=0.25))
    scene = scene_from_mol_file(path)  # a column that is off by one has no say, and is said to be
    assert int(scene.formal_charges.sum()) == 1
    assert scene.provenance["repairs"] == [
        "its partial charges add up to +0.00; its atoms and bonds to +1, which is taken"
    ]


def test_broken_mol_files_are_refused_in_one_line(tmp_path: Path, molecule: Any) -> None:
    block = Chem.MolToMolBlock(molecule)
    lines = block.splitlines()
    at = 4 + molecule.GetNumAtoms()
    untyped = {
        k: "\n".join([*lines[:at], f"{lines[at][:6]}{k:3d}{lines[at][9:]}", *lines[at + 1 :]]) for k in (0, 5, 8)
    }
    twice = [*lines[:5], lines[4][:30] + lines[5][30:], *lines[6:]]
    for name, text, expected in (
        ("empty.sdf", "", "is empty"),
        ("prose.mol", "This is not\na molecule.\n", "no molecule that can be read"),
        ("cut.mol", block[: len(block) // 2], "no molecule that can be read"),
        ("x.mol2", block, "no @<TRIPOS>MOLECULE"),
        ("twice.mol", "\n".join(twice), "have the same coordinates"),
        *((f"type{k}.mol", text, "the bond C1 - .* has no order") for k, text in untyped.items()),
        ("mixture.mol", Chem.MolToMolBlock(Chem.MolFromSmiles("CCO.c1ccccc1")), "2 fragments"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match=expected) as caught:
            prepare(str(tmp_path / name))
        assert name in str(caught.value) and "\n" not in str(caught.value)
    for missing in (str(tmp_path / "missing.sdf"), "F/C=C/F", "CCO.CCN"):
        with pytest.raises(InputError, match=r"does not exist; .* a molecule is given as smiles:\.\.\., a peptide"):
            prepare(missing)


# ---- the comparison of the benchmark ---------------------------------------------------------------------------------


def test_the_benchmark_sees_what_a_run_may_lose() -> None:
    scene: Scene = scene_from_smiles("F[C@H](Cl)/C=C/C")
    x = scene.positions_nm
    assert what_is_wrong(scene, x) == ""
    stretched = x.copy()
    stretched[0] += 0.5 * (x[0] - x[1])
    assert what_is_wrong(scene, stretched) == "the bond F1-C1 broke"
    assert "was" in what_is_wrong(scene, x * [1, 1, -1])
    assert what_is_wrong(scene, np.full_like(x, np.nan)) == "positions are not finite"


# ---- salts and what files leave out ----------------------------------------------------------------------------------


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


def test_charges_that_a_file_leaves_out_are_asked_for(tmp_path: Path) -> None:
    molecule = Chem.AddHs(Chem.MolFromSmiles("C[N+](C)(C)CCO"))
    rdDistGeom.EmbedMolecule(molecule, randomSeed=1)
    lines = Chem.MolToMolBlock(molecule).splitlines()
    (tmp_path / "x.sdf").write_text("\n".join(lines))
    assert int(prepare(str(tmp_path / "x.sdf")).formal_charges.sum()) == 1
    (tmp_path / "x.sdf").write_text("\n".join(line for line in lines if not line.startswith("M  CHG")))
    with pytest.raises(PreparationError, match=r"RDKit rejects it: .* valence .* .is a formal charge missing"):
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


def test_a_methylene_group_that_is_embedded_flat_is_embedded_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """RDKit leaves this one with its two neighbours in a line."""
    fenoldopam = "smiles:Oc1ccc(C2CNCCc3c2cc(O)c(O)c3Cl)cc1"

    def widest() -> float:
        x = prepare(fenoldopam).positions_nm
        a, b = x[5] - x[6], x[7] - x[6]
        return float(np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))

    assert 105.0 < widest() < 120.0
    monkeypatch.setattr("systems.prepare.molecule._ATTEMPTS", 1)
    assert widest() > 170.0, "control"


@pytest.mark.parametrize("smiles", ["C1CCCC1", "CC1CCCC1"])
def test_cyclopentane_is_embedded_although_rdkit_s_torsions_of_small_rings_fail_on_it(smiles: str) -> None:
    scene = scene_from_smiles(smiles)
    lengths = np.linalg.norm(np.diff(scene.positions_nm[scene.bonds], axis=1)[:, 0], axis=1)
    assert lengths.min() > 0.10 and lengths.max() < 0.16
