"""What RCSB, CHARMM, GROMACS, VMD and others write into PDB files, and what becomes of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.element_data import element_symbol
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.checks import check_contacts
from systems.prepare.records import AtomRecord
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
ROWS = [
    line
    for line in (Path(named_scenes.__file__).parent / "data" / "alanine-dipeptide.pdb").read_text().splitlines()
    if line.startswith("ATOM")
]
WATER = (
    "HETATM  901  OW  SOL   101      20.000  20.000  20.000  1.00  0.00",
    "HETATM  902  HW1 SOL   101      20.957  20.000  20.000  1.00  0.00",
    "HETATM  903  HW2 SOL   101      19.760  20.927  20.000  1.00  0.00",
    "HETATM  904  MW  SOL   101      20.100  20.130  20.000  1.00  0.00",
)
MATRICES = [
    f"{name}{k}    {''.join(f'{float(j == k):10.6f}' for j in (1, 2, 3))}        0.00000                         "
    for name in ("ORIGX", "SCALE", "MTRIX")
    for k in (1, 2, 3)
]


def shifted(lines: list[str], by: float) -> list[str]:
    return [f"{line[:30]}{float(line[30:38]) + by:8.3f}{line[38:]}" for line in lines]


def read(folder: Path, lines: list[str], **switches: bool) -> Scene:
    path = folder / "x.pdb"
    path.write_text("\n".join(lines) + "\n")
    return prepare(str(path), **switches)


def said(scene: Scene) -> str:
    return " | ".join(scene.provenance["repairs"])


def test_matrices_of_the_header_are_no_atoms(tmp_path: Path) -> None:
    scene = read(tmp_path, [*MATRICES, *ROWS, "END"])
    assert (scene.n_atoms, said(scene)) == (22, "")
    assert molecule_key(scene) == molecule_key(ALA2)


def test_end_ends_a_structure(tmp_path: Path) -> None:
    scene = read(tmp_path, [*ROWS, "END", *shifted(ROWS, 0.2), "END"])
    assert said(scene) == "22 atoms after END left out, of another structure"
    assert scene.positions_nm == pytest.approx(ALA2.positions_nm, abs=1e-4)
    conect = [f"CONECT{i + 1:5d}{j + 1:5d}" for i, j in ALA2.bonds.tolist()]
    ligand = [line.replace(line[17:20], "LIG").replace("A   " + line[25], "A   1") for line in ROWS]
    scene = read(tmp_path, [*ligand, "END", *conect])
    assert said(scene) == "LIG A1: bonds from CONECT records"


def test_models_without_their_first_line_are_said(tmp_path: Path) -> None:
    scene = read(tmp_path, [*ROWS, "ENDMDL", *shifted(ROWS, 0.2), "ENDMDL", "END"])
    assert said(scene) == "22 atoms after ENDMDL left out, of another model"
    numbered = ["MODEL        1", *ROWS, "ENDMDL", "MODEL        2", *shifted(ROWS, 0.2), "ENDMDL", "END"]
    assert said(read(tmp_path, numbered)) == "2 models in the file: the first is taken"


def test_chains_of_two_letters_are_read(tmp_path: Path) -> None:
    water = WATER[0].replace("SOL  ", "HOHAB")
    scene = read(tmp_path, [*(f"{line[:20]}AB{line[22:]}" for line in ROWS), water])
    assert set(scene.chain_of_residue) == {"AB"} and said(scene) == "1 water molecule left out"


def test_an_atom_written_twice_is_one(tmp_path: Path) -> None:
    scene = read(tmp_path, [*ROWS[:9], ROWS[8][:60], *ROWS[9:]])
    assert (scene.n_atoms, said(scene)) == (22, "1 atom written twice at the same coordinates: one of each left out")
    other = ROWS[8][:12] + " CB " + ROWS[8][16:]
    with pytest.raises(PreparationError, match="have the same coordinates"):
        read(tmp_path, [*ROWS[:9], other, *ROWS[9:]])


def test_molecules_numbered_alike_are_chains_of_their_own(tmp_path: Path) -> None:
    plain = [line[:21] + " " + line[22:] for line in ROWS]
    for between in ([], ["TER"]):
        scene = read(tmp_path, [*plain, *between, *shifted(plain, 20.0)])
        assert scene.residue_names == ("ACE", "ALA", "NME") * 2
        assert scene.chain_of_residue == ("", "", "", ":2", ":2", ":2")
        assert said(scene) == "residue numbers repeat: treated as separate chains :2"
        assert len(scene.bonds) == 2 * len(ALA2.bonds)


def test_virtual_sites_and_drude_particles_are_left_out(tmp_path: Path) -> None:
    scene = read(tmp_path, [*ROWS, *WATER], drop_water=True)
    assert said(scene) == "virtual sites and Drude particles left out (1): MW | 1 water molecule left out"
    drude = [f"{line[:12]} D{line[13:15].strip():<2s}{line[16:66]}" for line in ROWS if line[12:15] in (" N ", " CA")]
    lone = f"{ROWS[4][:12]} LPA{ROWS[4][16:30]}{float(ROWS[4][30:38]) + 0.3:8.3f}{ROWS[4][38:66]}"
    scene = read(tmp_path, [*ROWS, *drude, lone])
    assert scene.n_atoms == 22 and said(scene).startswith(
        f"virtual sites and Drude particles left out ({len(drude) + 1})"
    )
    far = drude[0][:30] + "  50.000" + drude[0][38:]
    with pytest.raises(InputError, match="no recognisable element"):
        read(tmp_path, [*ROWS, far])


def test_numbers_beyond_five_figures_and_a_byte_order_mark(tmp_path: Path) -> None:
    wide = [f"ATOM {100_000 + k:6d}{line[11:]}" for k, line in enumerate(ROWS)]
    scene = read(tmp_path, ["\ufeffREMARK", *wide])
    assert (scene.n_atoms, said(scene)) == (22, "")
    assert np.abs(scene.positions_nm - ALA2.positions_nm).max() < 1e-4


def test_bonds_between_residues_are_those_of_polymers_or_stated(tmp_path: Path) -> None:
    """A carbon of a ligand 1.7 Å from a side chain is a contact; a CONECT record makes it a bond."""
    record = "HETATM  9{:02d}  {:<3s} LIG A 101    {:8.3f}{:8.3f}{:8.3f}  1.00  0.00           {}"
    beta = np.array([float(ROWS[10][k : k + 8]) for k in (30, 38, 46)])
    away = beta - ALA2.positions_nm[8] * 10
    away /= np.linalg.norm(away)
    side = np.cross(away, [0.0, 0.0, 1.0])
    places = [beta + 1.75 * away, beta + 2.85 * away, beta + 1.75 * away + 1.1 * side, beta + 1.75 * away - 1.1 * side]
    names = ("C1", "H1", "H2", "H3")
    ligand = [record.format(k, n, *p, n[0]) for k, (n, p) in enumerate(zip(names, places, strict=True))]
    with pytest.raises(PreparationError, match="LIG A101"):
        read(tmp_path, [*ROWS, *ligand])
    scene = read(tmp_path, [*ROWS, *ligand, "END"], drop_ligand=True)
    assert (scene.n_atoms, "left out" in said(scene)) == (22, True)


def test_an_element_column_that_repeats_the_name_is_no_metal(tmp_path: Path) -> None:
    lines = [line[:76] + "CA" if line[12:16] == " CA " else line for line in ROWS]
    scene = read(tmp_path, lines)
    assert "Ca" not in scene.elements and "element column repeats the atom's name" in said(scene)


@pytest.mark.parametrize(("gap", "elements", "expected"), [
    (1.6, "CO", ""), (1.4, "CO", "minimisation"), (0.85, "CO", "minimisation"), (1.0, "CH", "minimisation"),
    (0.2, "CO", "minimisation"), (0.8, "HH", "minimisation"), (0.05, "CO", "refused"), (0.0, "HH", "refused"),
])  # fmt: skip
def test_atoms_in_one_place_are_refused_and_close_ones_said(gap: float, elements: str, expected: str) -> None:
    atoms = [AtomRecord(e, e, "LIG", "A", str(k), (k * gap, 0.0, 0.0)) for k, e in enumerate(elements)]
    if expected == "refused":
        with pytest.raises(PreparationError, match=f"{gap:.2f} Å apart.*have the same place"):
            check_contacts(atoms, np.empty((0, 2), dtype=np.int64))
    else:
        assert expected in " ".join(check_contacts(atoms, np.empty((0, 2), dtype=np.int64)))
    assert check_contacts(atoms, np.array([[0, 1]])) == []


@pytest.mark.parametrize("left_out", [(), ("H",), ("H", "LINK", "CONECT")], ids=["whole", "heavy", "heavy-unlinked"])
def test_a_lactam_keeps_what_it_lost(shared_data: Path, tmp_path: Path, left_out: tuple[str, ...]) -> None:
    """2N0N: lysine 5 and glutamate 9 are an amide; neither an oxygen nor a charge is added to it."""
    path = shared_data / "structures" / "rcsb_pdb__biopython__2n0n_M1.pdb"
    if not path.exists():
        pytest.skip("no 2N0N there")
    lines = [
        line
        for line in path.read_text().splitlines()
        if line[:6].strip() not in left_out
        and ("H" not in left_out or line[:4] == "LINK" or line[76:78].strip() != "H")
    ]
    scene = read(tmp_path, lines)
    at = {(scene.residue_ids[scene.residue_of_atom[i]], name): i for i, name in enumerate(scene.atom_names)}
    for key, expected in ((("9", "CD"), ["CG", "NZ", "OE1"]), (("5", "NZ"), ["CD", "CE", "H"])):
        around = [j for bond in scene.bonds.tolist() if at[key] in bond for j in bond if j != at[key]]
        assert sorted(scene.atom_names[j][: 1 if scene.elements[j] == "H" else 4] for j in around) == expected
    charged = dict(zip(at, scene.formal_charges.tolist(), strict=True))
    assert charged["5", "NZ"] == charged["9", "OE1"] == 0
    assert ("side chains bonded by distance" in said(scene)) == ("LINK" in left_out)
    assert scene.n_atoms == (182 if left_out else 183)  # histidine 1 is charged in the file


@pytest.mark.parametrize(("name", "residue", "hetero", "symbol"), [
    ("CL1 ", "00T", False, "Cl"), (" CL ", "LIG", True, "Cl"), ("BR  ", "ABC", False, "Br"), (" CL ", "ALA", True, "C"),
    (" CLP", "ABC", False, "C"), (" CA ", "ALA", True, "C"), ("SE  ", "MSE", True, "Se"), (" NA ", "HEM", True, "N"),
    ("NAAB", "LIG", True, "N"), ("NA  ", "LIG", True, "Na"), ("NA1 ", "DRG", False, "Na"), ("CLAA", "LIG", True, "Cl"),
])  # fmt: skip
def test_elements_by_names_where_the_column_is_empty(name: str, residue: str, hetero: bool, symbol: str) -> None:
    assert element_symbol(name, residue, "", hetero=hetero) == symbol


def test_methanol_without_hydrogens_is_no_carbon_monoxide(tmp_path: Path) -> None:
    lines = ["HETATM{:5d}  {:<3s} MOH A   1    {:8.3f}   0.000   0.000  1.00  0.00           {}".format(*row)
             for row in ((1, "C", 0.0, "C"), (2, "O", 1.41, "O"))]  # fmt: skip
    with pytest.raises(PreparationError, match=r"lack hydrogens \(a triple bond of 1.41 Å is none\)"):
        read(tmp_path, lines)
    assert read(tmp_path, [lines[0], lines[1].replace("1.410", "1.130")]).n_atoms == 2


def test_segments_end_chains_and_numbers_in_their_columns_do_not(tmp_path: Path) -> None:
    bare = [f"{line[:21]} {line[22:66]:<50s}" for line in ROWS]
    scene = read(tmp_path, [f"{line}{k:4d}" for k, line in enumerate(bare)])
    assert said(scene) == ""
    other = [line[:22] + f"{int(line[22:26]) + 3:4d}" + line[26:] for line in shifted(bare, 30.0)]
    residues = [line for line in [*bare, *other] if line[17:20] == "ALA"]
    with pytest.raises(PreparationError, match="the chain breaks"):
        read(tmp_path, residues)
    segments = [f"{line}{'PROA' if k < len(residues) // 2 else 'PROB'}" for k, line in enumerate(residues)]
    assert "ALA 2: added OXT" in said(read(tmp_path, segments))


def test_a_table_of_energies_after_the_atoms_is_no_atoms(tmp_path: Path) -> None:
    """Rosetta's: 200 lines of numbers without a format, some of which stand where coordinates would."""
    rng = np.random.default_rng(0)
    table = [f"ALA_{k} " + " ".join(f"{x:.5g}" for x in rng.normal(0, 3, 20)) for k in range(200)]
    assert said(read(tmp_path, [*ROWS, "TER", "#BEGIN_POSE_ENERGIES_TABLE x.pdb", *table])) == ""


@pytest.mark.parametrize(
    ("name", "residue", "column", "element"),
    [(" W1 ", "POM", "W", "W"), ("IR1 ", "IRI", "IR", "Ir"), ("HO  ", "HO3", "HO", "Ho"), (" U  ", "IUM", "U", "U"),
     # a program that fills the column with the first letters of names
     (" HO2", "LIG", "HO", "H"), (" CM ", "LIG", "CM", "Cm"), (" CM1", "LIG", "CM", "C"), (" NO1", "LIG", "NO", "N"),
     ("MW  ", "SOL", "", None), (" W  ", "W", "", None)],
)  # fmt: skip
def test_every_element_is_legal_in_its_column_and_only_the_usual_ones_in_names(name, residue, column, element) -> None:
    assert element_symbol(name, residue, column, hetero=True) == element


def test_an_unusual_metal_is_no_reason_to_refuse_a_file(tmp_path: Path) -> None:
    lines = pdb_text(ALA2).splitlines()
    tungsten = "HETATM   99  W   W       9      50.000  50.000  50.000  1.00  0.00           W  "
    path = tmp_path / "a.pdb"
    path.write_text("\n".join([*lines[: ALA2.n_atoms + 1], "TER", tungsten, "END", ""]))
    scene = prepare(str(path))
    assert molecule_key(scene) == molecule_key(ALA2)


@pytest.mark.parametrize("number", ["   1_0.50", "  \t0.500", "  ١.٥٠0 ", "  0x1p1 ", "        "])
def test_numbers_of_other_notations_are_refused(tmp_path: Path, number: str) -> None:
    line = ROWS[0][:30] + f"{number:8s}"[:8] + ROWS[0][38:]
    with pytest.raises(InputError, match=r"line 1: columns 31-54"):
        read(tmp_path, [line, *ROWS[1:]])


def test_plain_notations_are_read(tmp_path: Path) -> None:
    x = float(ROWS[0][30:38])
    for text in (f"{x:8.3f}", f"{x:<8.3f}", f"{x:+8.3f}", f"{x:8.1e}"):
        read(tmp_path, [ROWS[0][:30] + text + ROWS[0][38:], *ROWS[1:]])
