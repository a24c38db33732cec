"""mmCIF files as the Protein Data Bank writes them: author numbering, alternates, models, waters, ligands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.graph import molecule_key
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.structure_text import read_structure

ALA2 = named_scenes.load("alanine-dipeptide")
COLUMNS = (
    "group_PDB id type_symbol label_atom_id label_alt_id label_comp_id label_asym_id label_entity_id label_seq_id",
    "pdbx_PDB_ins_code Cartn_x Cartn_y Cartn_z occupancy B_iso_or_equiv pdbx_formal_charge auth_seq_id auth_comp_id",
    "auth_asym_id auth_atom_id pdbx_PDB_model_num",
)


def _row(
    serial: int,
    name: str,
    residue: str,
    number: str,
    at: tuple[float, float, float],
    element: str,
    *,
    alt: str = ".",
    insertion: str = "?",
    occupancy: float = 1.0,
    group: str = "ATOM",
    model: int = 1,
) -> str:
    place = " ".join(f"{x:.3f}" for x in at)
    return (
        f"{group} {serial} {element} {name} {alt} {residue} A 1 7 {insertion} {place} {occupancy:.2f} "
        f"20.0 ? {number} {residue} X {name} {model}"
    )


def _peptide(model: int = 1, shift: float = 0.0) -> list[str]:
    rows = []
    for i, (name, element) in enumerate(zip(ALA2.atom_names, ALA2.elements, strict=True)):
        residue = int(ALA2.residue_of_atom[i])
        x, y, z = ALA2.positions_nm[i] * 10 + shift
        rows.append(
            _row(i + 1, name, ALA2.residue_names[residue], str(100 + residue), (x, y, z), element,
                 insertion="B" if residue == 1 else "?", model=model)
        )  # fmt: skip
    return rows


def _write(path: Path, rows: list[str]) -> str:
    head = ["data_TEST", "_entry.id TEST", "loop_", *(f"_atom_site.{c}" for c in " ".join(COLUMNS).split())]
    tail = ["#", "loop_", "_atom_type.symbol", "C", "H", ""]
    path.write_text("\n".join([*head, *rows, *tail]))
    return str(path)


def test_author_numbers_models_and_insertion_codes(tmp_path: Path) -> None:
    scene = prepare(_write(tmp_path / "x.cif", [*_peptide(), *_peptide(model=2, shift=1.0)]))
    assert scene.residue_ids == ("100", "101B", "102")
    assert set(scene.chain_of_residue) == {"X"}
    assert scene.provenance["repairs"] == ["2 models in the file: the first is taken"]
    assert scene.positions_nm == pytest.approx(ALA2.positions_nm, abs=1e-4)
    assert molecule_key(scene) == molecule_key(ALA2)


def test_waters_ligands_and_alternates_as_in_pdb_files(tmp_path: Path) -> None:
    rows = _peptide()
    x, y, z = ALA2.positions_nm[5] * 10
    oxygen = ALA2.atom_names[5]
    rows[5] = _row(6, oxygen, "ACE", "100", (x, y, z), "O", alt="A", occupancy=0.4)
    rows.append(_row(30, oxygen, "ACE", "100", (x + 0.1, y, z), "O", alt="B", occupancy=0.6))
    rows.append(_row(31, "O", "HOH", "301", (30, 30, 30), "O", group="HETATM"))
    rows.append(_row(32, "ZN", "ZN", "302", (30, 30, 36), "ZN", group="HETATM"))
    path = _write(tmp_path / "x.cif", rows)
    assert prepare(path).provenance["repairs"][1:] == ["1 water molecule and free ion ZN left out"]
    x, y, z = ALA2.positions_nm[5] * 10 + (0.0, 0.0, 2.9)
    rows[-1] = _row(32, "ZN", "ZN", "302", (x, y, z), "ZN", group="HETATM")
    bound = _write(tmp_path / "bound.cif", rows)
    with pytest.raises(PreparationError, match=r"ZN X302; add `keep_ligand"):
        prepare(bound)
    scene = prepare(path, keep_ligand=True)
    assert scene.provenance["repairs"][:1] == [
        "alternate locations in 1 residue: the most occupied kept (X100:B), 1 atom left out"
    ]
    assert (scene.n_atoms, scene.elements[-1], int(scene.formal_charges[-1])) == (23, "Zn", 2)


def test_coordinates_beyond_the_columns_of_a_pdb_file(tmp_path: Path) -> None:
    rows = [row for row in _peptide(shift=-2000.0) if row.split()[2] != "H"]
    scene = prepare(_write(tmp_path / "x.cif", rows))
    heavy = [i for i, e in enumerate(scene.elements) if e != "H"]
    expected = [p for p, e in zip(ALA2.positions_nm, ALA2.elements, strict=True) if e != "H"]
    assert scene.n_atoms == 22 and scene.positions_nm[heavy] + 200.0 == pytest.approx(np.array(expected), abs=1e-3)


def test_the_formal_charge_of_an_ion_is_read(tmp_path: Path) -> None:
    ion = _row(99, "CU", "CU", "9", (30.0, 30.0, 30.0), "CU", group="HETATM").replace("20.0 ? 9", "20.0 1 9")
    assert prepare(_write(tmp_path / "x.cif", [*_peptide(), ion]), keep_ligand=True).formal_charges[-1] == 1


def test_a_cut_file_is_refused(tmp_path: Path) -> None:
    rows = _peptide()
    rows[-1] = rows[-1][:40]
    with pytest.raises(InputError, match="the file is cut"):
        prepare(_write(tmp_path / "x.cif", rows))


COMPONENT = """data_TFA
_chem_comp.id TFA
loop_
_chem_comp_atom.comp_id
_chem_comp_atom.atom_id
_chem_comp_atom.type_symbol
_chem_comp_atom.charge
_chem_comp_atom.model_Cartn_x
_chem_comp_atom.model_Cartn_y
_chem_comp_atom.model_Cartn_z
_chem_comp_atom.pdbx_model_Cartn_x_ideal
_chem_comp_atom.pdbx_model_Cartn_y_ideal
_chem_comp_atom.pdbx_model_Cartn_z_ideal
TFA "C1'" C  0 ? ? ? 0.00 0.00 0.00
TFA O1    O  0 ? ? ? 1.21 0.00 0.00
TFA O2    O -1 ? ? ? -0.62 1.10 0.00
TFA H1    H  0 ? ? ? -0.60
-0.92 0.00
#
loop_
_chem_comp_bond.atom_id_1
_chem_comp_bond.atom_id_2
_chem_comp_bond.value_order
"C1'" O1 DOUB
"C1'" O2 SING
"C1'" H1 SING
"""


def test_a_component_of_the_dictionary_is_a_molecule(tmp_path: Path) -> None:
    path = tmp_path / "TFA.cif"
    path.write_text(COMPONENT)
    scene = prepare(str(path))
    assert (scene.name, scene.atom_names, scene.residue_names) == ("TFA", ("C1'", "O1", "O2", "H1"), ("TFA",))
    assert scene.formal_charges.tolist() == [0, 0, -1, 0] and scene.bond_orders.tolist() == [2.0, 1.0, 1.0]
    assert scene.positions_nm[3].tolist() == pytest.approx([-0.06, -0.092, 0.0])
    path.write_text(COMPONENT.replace("DOUB", "deloc"))
    with pytest.raises(InputError, match="bonds of type 'deloc', which do not fix a Lewis structure"):
        prepare(str(path))
    for wrong, match in (("DOUB", "QUUX"), ("H1    H ", "H1    Qq"), (" 0.00 0.00 0.00", " 0.00 0.00")):
        path.write_text(COMPONENT.replace(wrong, match))
        with pytest.raises(InputError, match=r"TFA.cif"):
            prepare(str(path))


def test_rows_wrapped_over_lines_uncertainties_and_links(tmp_path: Path) -> None:
    rows = [row.replace(" ", "\n", 1) if i % 3 else row for i, row in enumerate(_peptide())]
    rows[2] = rows[2].replace(" 1.00 20.0", "(4) 1.00 20.0")
    assert prepare(_write(tmp_path / "x.cif", rows)).positions_nm == pytest.approx(ALA2.positions_nm, abs=1e-4)
    for number in ("1_0.5", "0x1", "?", "1,5"):
        wrong = [*rows[:5], rows[5].replace(rows[5].split()[10], number), *rows[6:]]
        with pytest.raises(InputError, match=r"atom 6 \(O\) has a position that is not a number"):
            prepare(_write(tmp_path / "x.cif", wrong))


def test_faults_beside_the_atoms_do_no_harm_and_those_among_them_do(tmp_path: Path) -> None:
    path = tmp_path / "x.cif"
    text = Path(_write(path, _peptide())).read_text()
    beside = "data_TEST\n_entry.id OTHER\n_citation.title 'Übersicht'\n_cell.length_a"
    path.write_text(text.replace("data_TEST", beside) + "data_TEST\nloop_\n_e.f\n_e.g\n")
    assert molecule_key(prepare(str(path))) == molecule_key(ALA2)
    for old, new in (("_atom_site.Cartn_y", "_atom_site.Cartn_x"), ("_atom_site.id", "_atom_sine.id")):
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=r"x.cif"):
            prepare(str(path))


def test_a_stated_link_holds_for_the_alternate_that_stays(tmp_path: Path) -> None:
    link = (
        "loop_ _struct_conn.id _struct_conn.conn_type_id _struct_conn.ptnr1_auth_asym_id "
        "_struct_conn.ptnr1_auth_seq_id _struct_conn.ptnr1_label_comp_id _struct_conn.ptnr1_label_atom_id "
        "_struct_conn.ptnr2_auth_asym_id "
        "_struct_conn.ptnr2_auth_seq_id _struct_conn.ptnr2_label_comp_id _struct_conn.ptnr2_label_atom_id "
        "_struct_conn.ptnr2_symmetry 1 covale X 101 ALA CB X 301 LIG C1 ? 2 metalc X 101 ALA O X 301 LIG C1 ?"
    )
    rows = [row.replace(" B ", " ? ") for row in _peptide()]
    beta = ALA2.positions_nm[ALA2.atom_names.index("CB")] * 10
    for alt, occupancy, shift in (("A", 0.3, 1.6), ("B", 0.7, 1.5)):
        rows.append(
            _row(40, "C1", "LIG", "301", (beta[0], beta[1], beta[2] + shift), "C", alt=alt, occupancy=occupancy)
        )
    path = Path(_write(tmp_path / "x.cif", rows))
    path.write_text(path.read_text() + link)
    cb = ALA2.atom_names.index("CB")
    assert read_structure(path).conect == [(cb, 22), (cb, 23)]


def test_the_cif_of_a_crystal_is_refused_as_such(tmp_path: Path) -> None:
    path = tmp_path / "x.cif"
    path.write_text("data_x\nloop_\n_atom_site_label\n_atom_site_fract_x\nC1 0.1\n")
    with pytest.raises(InputError, match="the CIF of a crystal, in fractions of its cell, has none"):
        prepare(str(path))
