"""Scenes from files of other programs, broken files, sequences, the named_scenes."""

from __future__ import annotations

import gzip
import random
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from systems.chemistry.geometry import signed_volumes, superpose, torsion
from systems.chemistry.graph import backbone_torsions, match_atoms, molecule_key
from systems.errors import InputError, OutOfDomainError, PreparationError, SurromdError, UnknownNameError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
RESIDUES = [ALA2.residue_names[r] for r in ALA2.residue_of_atom]
NUMBERS = [int(ALA2.residue_ids[r]) for r in ALA2.residue_of_atom]

# Names of the library's 22 atoms in other programs' files.
STYLES = {
    "amber": " ".join(ALA2.atom_names),
    "old-amber": "HH31 CH3 HH32 HH33 C O N H CA HA CB HB1 HB2 HB3 C O N H CH3 HH31 HH32 HH33",
    "charmm": "HY1 CAY HY2 HY3 CY OY N HN CA HA CB HB1 HB2 HB3 C O NT HNT CAT HT1 HT2 HT3",
    "pdb-v2": "1HH3 CH3 2HH3 3HH3 C O N H CA HA CB 1HB 2HB 3HB C O N H CH3 1HH3 2HH3 3HH3",
    "obabel": "H C H H C O N H C H C H H H C O N H C H H H",
}
NAMES = {style: names.split() for style, names in STYLES.items()}


def _pdb(
    path: Path,
    positions_nm: np.ndarray = ALA2.positions_nm,
    *,
    names: Sequence[str] = ALA2.atom_names,
    elements: Sequence[str] = ALA2.elements,
    residues: Sequence[str] = RESIDUES,
    numbers: Sequence[int] = NUMBERS,
    order: Sequence[int] | None = None,
    write_element: bool = True,
    first_serial: int = 1,
    extra: str = "",
) -> Path:
    lines = []
    order = range(len(names)) if order is None else order
    for k, i in enumerate(order):
        name = names[i] if len(names[i]) == 4 else f" {names[i]}"
        x, y, z = positions_nm[i] * 10
        element = elements[i] if write_element else ""
        lines.append(
            f"ATOM  {first_serial + 3 * k:5d} {name:<4s} {residues[i]:>3s}  {numbers[i]:4d}    "
            f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {element:>2s}"
        )
    path.write_text("\n".join(lines) + f"\n{extra}END\n")
    return path


def _subset(keep: Callable[[int], bool]) -> list[int]:
    return [i for i in range(22) if keep(i)]


def _assert_is_ala2(scene: Scene, tolerance_nm: float = 1e-3) -> None:
    order = match_atoms(scene, ALA2)
    moved = superpose(scene.positions_nm[order], ALA2.positions_nm)
    assert np.abs(moved - ALA2.positions_nm).max() < tolerance_nm
    assert molecule_key(scene) == molecule_key(ALA2)


# ---- library ------------------------------------------------------------------------------------------------------


def test_library_alanine_dipeptide_is_l_trans_and_whole() -> None:
    assert "alanine-dipeptide" in named_scenes.names()
    assert "phi, psi" in named_scenes.entry("alanine-dipeptide").title
    assert (ALA2.formula, ALA2.n_atoms, len(ALA2.bonds)) == ("C6H12N2O2", 22, 21)
    assert ALA2.residue_names == ("ACE", "ALA", "NME")
    double = ALA2.bonds[ALA2.bond_orders == 2].tolist()
    assert [[ALA2.elements[i] for i in b] for b in double] == [["C", "O"], ["C", "O"]]
    assert ALA2.masses_da.sum() == pytest.approx(144.17, abs=0.01)
    assert (signed_volumes(ALA2.positions_nm, [[8, 6, 14, 10]]) > 0).all()
    omega = torsion(ALA2.positions_nm, backbone_torsions(ALA2)["omega"])
    assert np.abs(omega).min() > np.radians(175)
    assert prepare("alanine-dipeptide").topology_hash == ALA2.topology_hash


def test_library_scene_agrees_with_rdkit_that_it_is_s(tmp_path: Path) -> None:
    from rdkit import Chem

    (tmp_path / "a.pdb").write_text(pdb_text(ALA2))
    molecule = Chem.MolFromPDBFile(str(tmp_path / "a.pdb"), removeHs=False)
    Chem.AssignStereochemistryFrom3D(molecule)
    assert [c[1] for c in Chem.FindMolChiralCenters(molecule)] == ["S"]


def test_library_load_hands_out_independent_provenance() -> None:
    named_scenes.load("alanine-dipeptide").provenance["spoiled"] = True
    assert "spoiled" not in named_scenes.load("alanine-dipeptide").provenance


def test_unknown_name_gives_the_nearest_and_the_command() -> None:
    with pytest.raises(UnknownNameError, match=r"'alanine-dipeptide'\? `surromd systems`"):
        prepare("alanine-dipeptid")


# ---- files of other programs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("write_element", [True, False], ids=["elements", "no-elements"])
@pytest.mark.parametrize("style", list(NAMES))
def test_names_of_other_programs_are_kept_and_understood(tmp_path: Path, style: str, write_element: bool) -> None:
    scene = prepare(str(_pdb(tmp_path / "x.pdb", names=NAMES[style], write_element=write_element)))
    assert list(scene.atom_names) == NAMES[style]
    assert scene.elements == ALA2.elements
    assert scene.residue_names == ("ACE", "ALA", "NME")
    assert scene.positions_nm == pytest.approx(ALA2.positions_nm, abs=1e-9)
    assert {tuple(b) for b in scene.bonds.tolist()} == {tuple(b) for b in ALA2.bonds.tolist()}
    assert (scene.bond_orders == ALA2.bond_orders).all()
    _assert_is_ala2(scene)


@given(order=st.permutations(range(22)), style=st.sampled_from(["amber", "pdb-v2", "obabel"]))
@settings(max_examples=15, deadline=None)
def test_any_order_of_atoms_is_kept(tmp_path_factory: pytest.TempPathFactory, order: list[int], style: str) -> None:
    path = tmp_path_factory.mktemp("order") / "x.pdb"
    scene = prepare(str(_pdb(path, names=NAMES[style], order=order, first_serial=977)))
    assert list(scene.atom_names) == [NAMES[style][i] for i in order]
    assert scene.positions_nm == pytest.approx(ALA2.positions_nm[order], abs=1e-9)
    assert scene.provenance["repairs"] == [] or style == "obabel"
    scene.to_openmm_topology()
    _assert_is_ala2(scene)


def test_shuffled_residues_repeat_and_the_written_file_keeps_the_order(tmp_path: Path) -> None:
    order = [*range(0, 22, 2), *range(1, 22, 2)]
    scene = prepare(str(_pdb(tmp_path / "x.pdb", order=order)))
    assert scene.residue_names == ("ACE", "ALA", "NME", "ACE", "ALA", "NME")
    (tmp_path / "again.pdb").write_text(pdb_text(scene))
    again = prepare(str(tmp_path / "again.pdb"))
    assert again.topology_hash == prepare(str(tmp_path / "again.pdb")).topology_hash
    assert again.atom_names == scene.atom_names
    assert again.residue_of_atom.tolist() == scene.residue_of_atom.tolist()


@pytest.mark.parametrize("with_conect", [True, False], ids=["conect", "distances"])
def test_one_residue_unl_takes_bonds_from_conect_or_distance(tmp_path: Path, with_conect: bool) -> None:
    serial = [1 + 3 * i for i in range(22)]
    conect = "".join(f"CONECT{serial[i]:5d}{serial[j]:5d}\n" for i, j in ALA2.bonds.tolist()) if with_conect else ""
    path = _pdb(tmp_path / "x.pdb", names=NAMES["obabel"], residues=["UNL"] * 22, numbers=[1] * 22, extra=conect)
    scene = prepare(str(path))
    assert scene.residue_names == ("UNL",)
    assert scene.provenance["repairs"] == [f"UNL 1: bonds from {'CONECT records' if with_conect else 'distances'}"]
    _assert_is_ala2(scene)


def test_d_alanine_is_read_as_what_it_is(tmp_path: Path) -> None:
    scene = prepare(str(_pdb(tmp_path / "d.pdb", ALA2.positions_nm * [1, 1, -1])))
    assert molecule_key(scene) != molecule_key(ALA2)
    with pytest.raises(OutOfDomainError, match="enantiomer"):
        match_atoms(scene, ALA2)


def test_mmcif_and_gzip_read_like_pdb(tmp_path: Path) -> None:
    from openmm import app, unit

    cif = tmp_path / "x.cif"
    with cif.open("w") as out:
        app.PDBxFile.writeFile(ALA2.to_openmm_topology(), ALA2.positions_nm * unit.nanometer, out)
    scene = prepare(str(cif))
    assert scene.atom_names == ALA2.atom_names
    _assert_is_ala2(scene)
    packed = tmp_path / "x.pdb.gz"
    packed.write_bytes(gzip.compress(_pdb(tmp_path / "x.pdb").read_bytes()))
    assert prepare(str(packed)).topology_hash == prepare(str(tmp_path / "x.pdb")).topology_hash


# ---- repairs ------------------------------------------------------------------------------------------------------


def test_heavy_atoms_alone_get_their_hydrogens(tmp_path: Path) -> None:
    heavy = ALA2.heavy_idx.tolist()
    scene = prepare(str(_pdb(tmp_path / "x.pdb", order=heavy)))
    assert match_atoms(scene, ALA2).shape == (22,)
    assert scene.positions_nm[scene.heavy_idx] == pytest.approx(ALA2.positions_nm[heavy], abs=1e-9)
    assert scene.provenance["repairs"] == ["hydrogens placed on ACE 1, ALA 2, NME 3: 12"]
    assert prepare(str(tmp_path / "x.pdb")).positions_nm == pytest.approx(scene.positions_nm, abs=1e-9)


def test_d_alanine_without_hydrogens_stays_d(tmp_path: Path) -> None:
    path = _pdb(tmp_path / "d.pdb", ALA2.positions_nm * [1, 1, -1], order=ALA2.heavy_idx.tolist())
    with pytest.raises(OutOfDomainError, match="enantiomer"):
        match_atoms(prepare(str(path)), ALA2)


def test_missing_side_chain_atom_is_added_as_l_and_said(tmp_path: Path) -> None:
    kept = _subset(lambda i: i not in (10, 11, 12, 13))
    state = random.getstate()
    scene = prepare(str(_pdb(tmp_path / "x.pdb", order=kept, names=NAMES["old-amber"])))
    assert random.getstate() == state
    assert molecule_key(scene) == molecule_key(ALA2)
    assert scene.provenance["repairs"][0] == "ALA 2: added CB"
    order = match_atoms(scene, ALA2)
    untouched = [i for i in kept if i not in (7, 9)]  # the hydrogens of the incomplete residue are made anew
    assert scene.positions_nm[order][untouched] == pytest.approx(ALA2.positions_nm[untouched], abs=1e-9)


def test_shuffled_residues_are_repaired_in_chain_order(tmp_path: Path) -> None:
    heavy = list(reversed(ALA2.heavy_idx.tolist()))
    scene = prepare(str(_pdb(tmp_path / "x.pdb", order=heavy)))
    assert scene.residue_names == ("ACE", "ALA", "NME")
    assert molecule_key(scene) == molecule_key(ALA2)


def test_first_model_is_taken_and_water_left_out(tmp_path: Path) -> None:
    body = _pdb(tmp_path / "x.pdb").read_text().replace("END\n", "")
    water = (
        "HETATM  900  O   HOH A 101      20.000  20.000  20.000  1.00  0.00           O\n"
        "HETATM  901  O   HOH A 102      25.000  20.000  20.000  1.00  0.00           O\n"
    )
    path = tmp_path / "models.pdb"
    path.write_text(f"MODEL        1\n{body}{water}ENDMDL\nMODEL        2\n{body}ENDMDL\nEND\n")
    scene = prepare(str(path), drop_water=True)
    assert scene.provenance["repairs"] == ["2 models in the file: the first is taken", "2 water molecules left out"]
    _assert_is_ala2(scene)


# ---- refusals -----------------------------------------------------------------------------------------------------


def _refusal(path: Path) -> str:
    with pytest.raises(SurromdError) as caught:
        prepare(str(path))
    message = str(caught.value)
    assert "\n" not in message
    assert path.name in message
    return message


def test_unreadable_files_are_refused_in_one_line(tmp_path: Path) -> None:
    assert "does not exist" in _refusal(tmp_path / "missing.pdb")
    (tmp_path / "folder.pdb").mkdir()
    assert "directory" in _refusal(tmp_path / "folder.pdb")
    for name, data, expected in (
        ("empty.pdb", b"", "empty"),
        ("blank.pdb", b"\n \n", "empty"),
        ("binary.pdb", bytes(range(256)) * 20, "binary"),
        ("latin.pdb", bytes(range(128, 256)) * 20, "no ATOM"),
        ("prose.pdb", b"This is not a structure.\n", "no ATOM"),
        ("cut.pdb", _pdb(tmp_path / "x.pdb").read_bytes()[:200], "cut short"),
        ("broken.pdb.gz", gzip.compress(_pdb(tmp_path / "x.pdb").read_bytes())[:100], "gz"),
        ("headless.cif", b"data_x\nloop_\n_atom_site.id\n_atom_site.type_symbol\n1 C\n", "lacks"),
        ("cut.cif", b"data_x\n", "no ATOM"),
    ):
        (tmp_path / name).write_bytes(data)
        assert expected in _refusal(tmp_path / name), name
    (tmp_path / "x.sdf").write_text("")
    assert "is empty" in _refusal(tmp_path / "x.sdf")
    (tmp_path / "x.gro").write_text("")
    assert "suffix" in _refusal(tmp_path / "x.gro")
    (tmp_path / "x.txt").write_text("x")
    assert "suffix" in _refusal(tmp_path / "x.txt")


def test_impossible_coordinates_are_refused(tmp_path: Path) -> None:
    text = _pdb(tmp_path / "x.pdb").read_text()
    first = text.splitlines()[0]
    (tmp_path / "nan.pdb").write_text(text.replace(first, first[:30] + "     nan     nan     nan" + first[54:]))
    assert "not a number" in _refusal(tmp_path / "nan.pdb")
    (tmp_path / "star.pdb").write_text(text.replace(first, first[:30] + "********" * 3 + first[54:]))
    assert "three coordinates" in _refusal(tmp_path / "star.pdb")
    same = ALA2.positions_nm.copy()
    same[10] = same[8]
    assert "have the same coordinates" in _refusal(_pdb(tmp_path / "same.pdb", same))
    far = ALA2.positions_nm.copy()
    far[0] += 2.0
    assert "nearest heavy atom" in _refusal(_pdb(tmp_path / "far.pdb", far))


def test_structures_beyond_repair_are_refused(tmp_path: Path) -> None:
    no_backbone = _pdb(tmp_path / "ca.pdb", order=_subset(lambda i: i == 8))
    assert "backbone" in _refusal(no_backbone)
    ligand = _pdb(tmp_path / "lig.pdb", residues=["LIG"] * 22, numbers=[1] * 22, order=ALA2.heavy_idx.tolist())
    assert "no hydrogens" in _refusal(ligand)
    lost = _pdb(tmp_path / "lost.pdb", residues=["LIG"] * 22, numbers=[1] * 22, order=_subset(lambda i: i != 13))
    assert "no valid Lewis structure" in _refusal(lost)
    broken = ALA2.positions_nm.copy()
    broken[16:] += 0.5
    assert "OXT" in str(prepare(str(_pdb(tmp_path / "cap.pdb", broken[:16], order=range(16)))).provenance["repairs"])
    bare = _pdb(tmp_path / "bare.pdb", numbers=[*NUMBERS[:13], 9, *NUMBERS[14:]], order=_subset(lambda i: i != 12))
    assert "no standard residue" in _refusal(bare)
    huge = ALA2.positions_nm * 1.0
    huge[3] = 2e3
    assert "beyond" in _refusal(_pdb(tmp_path / "huge.pdb", huge))
    residues = ["ACE"] * 6 + ["ALA"] * 10
    gap = _pdb(
        tmp_path / "gap.pdb", np.concatenate([ALA2.positions_nm[:16], broken[6:16] + 1.0]),
        names=[*ALA2.atom_names[:16], *ALA2.atom_names[6:16]], elements=[*ALA2.elements[:16], *ALA2.elements[6:16]],
        residues=[*residues, *["ALA"] * 10], numbers=[*[1] * 6, *[2] * 10, *[5] * 10],
    )  # fmt: skip
    assert "chain breaks between ALA 2 and ALA 5" in _refusal(gap)


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(InputError, match="ph 20"):
        prepare("alanine-dipeptide", ph=20)
    with pytest.raises(InputError, match="SMILES"):
        prepare("smiles:")


def test_other_peoples_alanine_dipeptide(shared_data: Path) -> None:
    import mdtraj

    path = shared_data / "alanine-dipeptide" / "ala2.pdb"
    scene = prepare(str(path))
    assert scene.n_atoms == 22
    assert scene.atom_names[0] == "1HH3"
    assert scene.provenance["repairs"] == []
    order = match_atoms(scene, ALA2)
    frames = mdtraj.load(str(path.with_name("trajectory-0.dcd")), top=str(path), stride=100).xyz
    angles = torsion(frames, backbone_torsions(scene)["psi"])
    assert torsion(frames[:, order], backbone_torsions(ALA2)["psi"]) == pytest.approx(angles, abs=1e-5)
    methyls = [[1, 0, 2, 3], [10, 11, 12, 13], [18, 19, 20, 21]]
    inward = signed_volumes(frames[:, order], methyls)
    assert (np.sign(inward) == np.sign(signed_volumes(ALA2.positions_nm, methyls))).all()


def test_hard_files_prepare_or_are_refused_in_one_line(shared_data: Path) -> None:
    folder = shared_data / "hard-pdb"
    outcome = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "1osm.pdb.gz"):
        try:
            scene = prepare(str(path))
        except SurromdError as error:
            assert "\n" not in str(error)
            assert path.name in str(error)
            outcome[path.name] = 0
        else:
            scene.to_openmm_topology()
            outcome[path.name] = scene.n_atoms
    assert outcome == {
        "A6PA6_alpha.pdb": 137,
        "CONECT2TER.pdb": 0,
        "aaqaa.gro": 0,
        "ace.pdb": 17,
        "charges.pdb": 39,
        "conect_error.pdb": 17,
        "elements.pdb": 17,
        "empty.dcd": 0,
        "incomplete.pdb": 0,
        "maestro_aaqaa_capped.pdb": 173,
        "model_then_cryst.pdb": 0,
        "nma.pdb": 18,
        "unordered_res.pdb": 577,
        "varying_occ_tmp.pdb": 0,
    }
    notes = prepare(str(folder / "elements.pdb")).provenance["repairs"]
    assert "crystallisation agents and buffers left out (`keep_ligand=True` keeps them): 2 DMS" in notes
    with pytest.raises(PreparationError, match="DMS A101 has no hydrogens, which a ligand must bring"):
        prepare(str(folder / "elements.pdb"), keep_ligand=True)
