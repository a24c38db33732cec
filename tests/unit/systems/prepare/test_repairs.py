"""The summary of repairs: what stands beside the peptide, residues under other names, numbers, handedness."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.geometry import signed_volumes, torsion
from systems.chemistry.graph import backbone_torsions, molecule_key
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.bonding import find_bonds
from systems.prepare.checks import handedness, refuse_changed, say_inverted
from systems.prepare.heterogens import ligand_atoms
from systems.prepare.records import AtomRecord, standardise
from systems.prepare.repair import _with_usual_lengths, complete, protonation_summary
from systems.prepare.structure_text import decode, encode, read_structure
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
WATER = "HETATM  900  O   HOH A 101      20.000  20.000  20.000  1.00  0.00           O\n"
METHANE = (
    "HETATM  910  C1  LIG A 201      30.000  20.000  20.000  1.00  0.00           C\n"
    "HETATM  911  H1  LIG A 201      30.629  20.629  20.629  1.00  0.00           H\n"
    "HETATM  912  H2  LIG A 201      29.371  19.371  20.629  1.00  0.00           H\n"
    "HETATM  913  H3  LIG A 201      29.371  20.629  19.371  1.00  0.00           H\n"
    "HETATM  914  H4  LIG A 201      30.629  19.371  19.371  1.00  0.00           H\n"
)
CHLORIDE = "HETATM  920 CL    CL A 301      30.000  30.000  20.000  1.00  0.00          CL\n"


def _peptide(drop: tuple[str, ...] = ()) -> str:
    lines = [ln for ln in pdb_text(ALA2).splitlines() if ln.startswith("ATOM")]
    return "\n".join(ln for ln in lines if ln[12:16].strip() not in drop) + "\n"


def _write(path: Path, *parts: str) -> str:
    path.write_text("".join(parts) + "END\n")
    return str(path)


def _record(name: str, residue: str, number: str, x: float, y: float, z: float, element: str) -> AtomRecord:
    return AtomRecord(name, element, residue, "A", number, (x, y, z))


def test_what_stands_beside_the_peptide_is_refused_kept_or_dropped_as_told(tmp_path: Path) -> None:
    path = _write(tmp_path / "x.pdb", _peptide(), METHANE, CHLORIDE, WATER)
    with pytest.raises(PreparationError, match=r"LIG A201; add `keep_ligand.* or `drop_ligand") as caught:
        prepare(path)
    assert "\n" not in str(caught.value) and "x.pdb" in str(caught.value)
    with pytest.raises(InputError, match="exclude each other"):
        prepare(path, keep_ligand=True, drop_ligand=True)
    bare = prepare(path, drop_ligand=True)
    assert bare.provenance["repairs"] == [
        "1 water molecule and free ion CL left out",
        "left out, as asked (`drop_ligand=True`): LIG A201",
    ]
    assert molecule_key(bare) == molecule_key(ALA2)
    kept = prepare(path, keep_ligand=True)
    assert "kept beside the peptide: LIG A201, CL A301" in kept.provenance["repairs"]
    assert kept.residue_names == ("ACE", "ALA", "NME", "LIG", "CL")
    assert kept.positions_nm[:22] == pytest.approx(bare.positions_nm)
    assert int(kept.formal_charges.sum()) == -1
    kept.to_openmm_topology()


def test_a_kept_ligand_stays_while_the_peptide_is_completed(tmp_path: Path) -> None:
    methyl = ("HB1", "HB2", "HB3")
    scene = prepare(_write(tmp_path / "x.pdb", METHANE, _peptide(drop=methyl)), keep_ligand=True)
    assert scene.formula == "C7H16N2O2"
    ligand = [i for i, r in enumerate(scene.residue_of_atom) if scene.residue_names[r] == "LIG"]
    assert scene.positions_nm[ligand[0]] == pytest.approx([3.0, 2.0, 2.0])
    assert scene.bonds[np.isin(scene.bonds, ligand).any(axis=1)].tolist() == [[22, k] for k in (23, 24, 25, 26)]
    bare = METHANE.splitlines(keepends=True)[0]
    with pytest.raises(PreparationError, match=r"LIG A201 has no hydrogens.*`drop_ligand"):
        prepare(_write(tmp_path / "y.pdb", _peptide(), bare), keep_ligand=True)


def test_a_file_without_peptide_is_the_molecule_itself(tmp_path: Path) -> None:
    assert prepare(_write(tmp_path / "x.pdb", METHANE)).formula == "CH4"


def test_bonded_foreign_residues_are_no_ligands() -> None:
    atoms = [
        _record("N", "GLY", "1", 0.0, 0.0, 0.0, "N"), _record("CA", "GLY", "1", 1.46, 0.0, 0.0, "C"),
        _record("C1", "XXX", "2", -0.7, 1.2, 0.0, "C"), _record("O1", "YYY", "3", 9.0, 0.0, 0.0, "O"),
    ]  # fmt: skip
    assert ligand_atoms(atoms, find_bonds(atoms, [])) == [3]


def test_selenomethionine_becomes_methionine_and_is_said() -> None:
    atoms = [_record("SE", "MSE", "7", 0, 0, 0, "Se"), _record("CE", "MSE", "7", 1.9, 0, 0, "C")]
    notes: list[str] = []
    out = standardise(atoms, notes)
    assert [(a.name, a.element, a.residue_name) for a in out] == [("SD", "S", "MET"), ("CE", "C", "MET")]
    assert notes == ["selenomethionine made methionine (SE to SD): A7"]


def test_caps_that_charmm_writes_into_their_neighbours_are_set_apart(tmp_path: Path) -> None:
    names = "HY1 CAY HY2 HY3 CY OY N HN CA HA CB HB1 HB2 HB3 C O NT HNT CAT HT1 HT2 HT3".split()  # noqa: SIM905
    lines = []
    for line, name in zip(_peptide().splitlines(), names, strict=True):
        padded = name if len(name) == 4 else f" {name:<3s}"
        lines.append(f"{line[:12]}{padded} ALA A   1 {line[27:]}\n")
    scene = prepare(_write(tmp_path / "x.pdb", *lines))
    assert scene.residue_names == ("ACE", "ALA", "NME")
    assert molecule_key(scene) == molecule_key(ALA2)
    assert scene.provenance["repairs"] == [
        "ALA A1: CAY CY OY set apart as the cap ACE",
        "ALA A1: NT CAT set apart as the cap NME",
    ]


def test_a_missing_cb_is_built_l_whatever_psi(shared_data: Path) -> None:
    scene = prepare(str(shared_data / "hard-pdb" / "capping" / "nma.pdb"))  # PDBFixer alone makes this D-alanine
    index = {n: i for i, n in enumerate(scene.atom_names[:11])}
    heavy = {a: _record(a, "ALA", "1", *(scene.positions_nm[index[a]] * 10), a[0]) for a in ("N", "CA", "C", "CB")}
    assert handedness([("ALA A1", "ALA", heavy)]) == {("ALA A1", "CA"): 1}


def test_added_atoms_stand_at_their_usual_distances(tmp_path: Path) -> None:
    heavy = ("CH3", "C", "O", "N", "CA", "CB")  # ACE and ALA without hydrogens: OXT has to be added, too
    lines = [ln for ln in _peptide().splitlines() if ln[17:20] != "NME" and ln[12:16].strip() in heavy]
    scene = prepare(_write(tmp_path / "x.pdb", "\n".join(lines) + "\n"))
    names = scene.atom_names
    length = {
        (names[i], names[j]): float(np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j]))
        for i, j in scene.bonds.tolist()
    }
    assert length["C", "OXT"] == pytest.approx(0.125, abs=1e-4)
    assert length["N", "H"] == pytest.approx(0.101, abs=1e-4)
    assert [length["CB", f"HB{k}"] for k in (1, 2, 3)] == pytest.approx([0.109] * 3, abs=1e-4)
    at = {
        n: scene.positions_nm[i] for i, n in enumerate(names) if scene.residue_names[scene.residue_of_atom[i]] == "ALA"
    }
    flat = signed_volumes(np.array([at[a] for a in ("C", "CA", "O", "OXT")]), [[0, 1, 2, 3]])
    assert abs(float(flat[0])) < 2e-5


def test_atoms_put_nowhere_near_theirs_are_refused() -> None:
    """PDBFixer 1.12 put the OXT of a free proline 3.1 Å from its carbon."""
    key = ("A", "1", "PRO")
    for x, fits in ((1.25, True), (3.1, False)):
        atoms = [_record("C", "PRO", "1", 0, 0, 0, "C"), _record("OXT", "PRO", "1", x, 0, 0, "O")]
        bonds = np.array([[0, 1]])
        assert _with_usual_lengths(atoms, bonds, {(key, "C"), (key, "OXT")}) == atoms
        if fits:
            assert _with_usual_lengths(atoms, bonds, {(key, "C")}) == atoms
        else:
            with pytest.raises(PreparationError, match=r"PRO A1 C and PRO A1 OXT came out 3.10 Å apart"):
                _with_usual_lengths(atoms, bonds, {(key, "C")})


def test_inverted_centres_are_seen_said_and_refused() -> None:
    index = {n: i for i, n in enumerate(ALA2.atom_names) if ALA2.residue_of_atom[i] == 1}

    def at(mirror: float) -> dict[str, AtomRecord]:
        x = ALA2.positions_nm * [1, 1, mirror] * 10
        return {a: _record(a, "ALA", "2", *x[index[a]], a[0]) for a in ("N", "CA", "C", "CB")}

    natural, inverted = (handedness([("ALA 2", "ALA", at(m))]) for m in (1.0, -1.0))
    assert (natural, inverted) == ({("ALA 2", "CA"): 1}, {("ALA 2", "CA"): -1})
    notes: list[str] = []
    say_inverted(inverted, notes)
    assert notes == ["D-residues, as the file has them: ALA 2"]
    refuse_changed(natural, natural)
    refuse_changed(inverted, inverted)
    for before, after in ((natural, inverted), (inverted, natural), ({}, inverted)):
        with pytest.raises(PreparationError, match="CA came out inverted"):
            refuse_changed(before, after)


def test_protonation_is_chosen_by_ph_and_said(tmp_path: Path) -> None:
    scene = prepare("sequence:ACE-ASP-HIS-NME", ph=2.0)
    assert scene.provenance["repairs"] == [
        "protonation at pH 2: ASP neutral (ASH): ASP 2",
        "protonation at pH 2: HIS charged (HIP): HIS 3",
    ]
    heavy = [i for i, e in enumerate(scene.elements) if e != "H"]
    text = "".join(pdb_text(scene).splitlines(keepends=True)[1 + i] for i in heavy)
    at_seven = prepare(_write(tmp_path / "x.pdb", text)).provenance["repairs"]
    assert "protonation at pH 7: ASP charged: ASP A2" in at_seven
    assert protonation_summary(["ASP 2"], [("A", "2", "ASP")], ["ASH"], [], 7.0) == []


def test_disulfides_are_said(tmp_path: Path) -> None:
    single = prepare("sequence:ACE-CYS-NME")
    index = {n: i for i, n in enumerate(single.atom_names)}
    sulfur, hydrogen = single.positions_nm[index["SG"]], single.positions_nm[index["HG"]]
    axis = (hydrogen - sulfur) / np.linalg.norm(hydrogen - sulfur)
    keep = [i for i in range(single.n_atoms) if i != index["HG"]]
    turned = 2 * (sulfur + 0.1025 * axis) - single.positions_nm  # inversion makes the second one D
    lines = pdb_text(single).splitlines(keepends=True)[1 : single.n_atoms + 1]
    second = []
    for i in keep:
        x, y, z = turned[i] * 10
        second.append(f"{lines[i][:21]}B{lines[i][22:30]}{x:8.3f}{y:8.3f}{z:8.3f}{lines[i][54:]}")
    scene = prepare(_write(tmp_path / "x.pdb", *(lines[i] for i in keep), *second))
    assert scene.provenance["repairs"] == [
        "disulfide bond CYS A2 - CYS B2 (2.05 Å)",
        "D-residues, as the file has them: CYS B2",
    ]


def test_hybrid_36_numbers() -> None:
    for number, width, text in (
        (9999, 4, "9999"), (10000, 4, "A000"), (10035, 4, "A00Z"), (10036, 4, "A010"), (1223055, 4, "ZZZZ"),
        (1223056, 4, "a000"), (99999, 5, "99999"), (100000, 5, "A0000"), (43770016, 5, "a0000"), (-999, 4, "-999"),
    ):  # fmt: skip
        assert decode(text, width) == number
        assert encode(number, width) == text
    assert decode("A0", 4) is None and decode("a0B0", 4) is None and decode("****", 4) is None
    assert encode(10**9, 4) is None and encode(-1000, 4) is None


def test_insertion_codes_and_hybrid_36_survive_the_way_through(tmp_path: Path) -> None:
    serials = ["99999", *(f"A000{digit}" for digit in "0123456789A"), *map(str, range(2, 12))]
    renamed = {"A   1 ": "AA000 ", "A   2 ": "AA001B", "A   3 ": "AA002 "}
    lines = []
    for serial, line in zip(serials, _peptide().splitlines(), strict=True):
        number = line[21:27].replace(line[21], "A", 1)
        lines.append(f"ATOM  {serial:>5}{line[11:21]}{renamed[number]}{line[27:]}\n")
    lines.append(f"CONECT{serials[0]:>5}{serials[1]:>5}\n")
    scene = prepare(_write(tmp_path / "x.pdb", *lines))
    assert scene.residue_ids == ("10000", "10001B", "10002")
    assert scene.provenance["repairs"] == []
    (tmp_path / "again.pdb").write_text(pdb_text(scene))
    assert " A   A000 " not in (tmp_path / "again.pdb").read_text()
    assert [a.residue_id for a in read_structure(tmp_path / "again.pdb").atoms][:22:10] == ["10000", "10001B", "10002"]
    assert prepare(str(tmp_path / "again.pdb")).topology_hash == scene.topology_hash


def test_completion_never_turns_a_residue_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Negative control of the check around `complete`: a repair that mirrors what it returns is refused."""
    import systems.prepare.repair

    def mirrored(atoms, bonding, **settings):
        records, bonds, summary = complete(atoms, bonding, **settings)
        flip = [replace(a, position_angstrom=(*a.position_angstrom[:2], -a.position_angstrom[2])) for a in records]
        return flip, bonds, summary

    path = _write(tmp_path / "x.pdb", _peptide(drop=("HB1", "HB2", "HB3")))
    prepare(path)
    monkeypatch.setattr(systems.prepare.repair, "complete", mirrored)
    with pytest.raises(PreparationError, match=r"ALA A?2: CA came out inverted"):
        prepare(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [("SdFS", "a lower-case letter among them is a D-residue"), ("ACE-D-ALA-NME", "'D'"), ("ACE-DAL-NME", "'DAL'")],
)
def test_d_residues_in_sequences_are_refused(text: str, said: str) -> None:
    with pytest.raises(PreparationError, match=said):
        prepare(f"sequence:{text}")


# ---- charges that no file states ----------------------------------------------------------------------------------


def _molecule_pdb(path: Path, name: str, elements: str, positions_angstrom: list[tuple[float, float, float]]) -> str:
    """A file of one residue, its first atom bonded to all others."""
    rows = [
        f"HETATM{k:5d}  {element}{k:<2d} {name} A   1    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00           {element}\n"
        for k, (element, (x, y, z)) in enumerate(zip(elements, positions_angstrom, strict=True), 1)
    ]
    bonds = [f"CONECT    1{k:5d}\n" for k in range(2, len(elements) + 1)]
    return _write(path, *rows, *bonds)


BENT = [(0.0, 0.0, 0.363), (1.238, 0.0, -0.363), (-1.238, 0.0, -0.363)]
FLAT = [(0.0, 0.0, 0.0), (1.43, 0.0, 0.0), (-0.715, 1.238, 0.0), (-0.715, -1.238, 0.0)]
PYRAMID = [(0.0, 0.0, 0.55), *((x, y, 0.0) for x, y, _ in FLAT[1:])]


@pytest.mark.parametrize(
    ("elements", "positions", "charges", "orders"),
    [
        ("SOO", BENT, [0, 0, 0], [2, 2]),
        ("OOO", BENT, [-1, 0, 1], [1, 2]),
        ("SOOO", FLAT, [0, 0, 0, 0], [2, 2, 2]),
        ("SOOO", PYRAMID, [-1, -1, 0, 0], [1, 1, 2]),
        ("NOO", BENT, [-1, 0, 0], [1, 2]),
    ],
    ids=["sulfur dioxide", "ozone", "sulfur trioxide", "sulfite", "nitrite"],
)
def test_a_neutral_structure_is_preferred_where_one_fits(
    tmp_path: Path, elements: str, positions: list[tuple[float, float, float]], charges: list[int], orders: list[int]
) -> None:
    scene = prepare(_molecule_pdb(tmp_path / "x.pdb", "UNX", elements, positions))
    assert sorted(scene.formal_charges.tolist()) == charges
    assert sorted(scene.bond_orders.tolist()) == orders
    said = [line for line in scene.provenance["repairs"] if line.startswith("charges that no file states")]
    assert len(said) == any(charges) and all(line.count("-1") == charges.count(-1) for line in said)


def test_a_carbon_that_may_be_either_ion_is_refused(tmp_path: Path) -> None:
    flat = [(0.76 * x, 0.76 * y, z) for x, y, z in FLAT]
    with pytest.raises(PreparationError, match="all hydrogens"):
        prepare(_molecule_pdb(tmp_path / "x.pdb", "UNX", "CHHH", flat))
    assert prepare(_molecule_pdb(tmp_path / "y.pdb", "UNX", "BHHH", flat)).formal_charges.tolist() == [0] * 4


def _cysteines(path: Path, name: str, *, hydrogens: bool) -> str:
    scene = prepare("ACE-CYS-NME")
    kept = [
        line.replace("CYS", name)
        for line in pdb_text(scene).splitlines()
        if line.startswith("ATOM") and line[12:16].strip() != "HG" and (hydrogens or line[76:78].strip() != "H")
    ]
    return _write(path, "\n".join(kept) + "\n")


@pytest.mark.parametrize("hydrogens", [True, False])
def test_a_cysteine_named_as_bonded_without_its_partner_is_neutral(tmp_path: Path, hydrogens: bool) -> None:
    scene = prepare(_cysteines(tmp_path / "x.pdb", "CYX", hydrogens=hydrogens))
    assert not scene.formal_charges.any()
    assert "protonation at pH 7: CYS neutral: CYX A2" in scene.provenance["repairs"]
    # A thiolate that the file names is one, and a basic pH makes one and says so.
    named = prepare(_cysteines(tmp_path / "y.pdb", "CYM", hydrogens=hydrogens))
    assert named.formal_charges.sum() == -1
    basic = prepare(str(tmp_path / "x.pdb"), ph=11.0)
    assert basic.formal_charges.sum() == -1
    assert any(
        line.startswith("charges that no file states") and "SG -1" in line for line in basic.provenance["repairs"]
    )


@pytest.mark.parametrize("lost", [("OG",), ("CB",), ("CB", "OG")])
def test_missing_atoms_are_added_although_their_hydrogens_are_there(tmp_path: Path, lost: tuple[str, ...]) -> None:
    whole = prepare("sequence:ACE-SER-NME")
    lines = [line for line in pdb_text(whole).splitlines(keepends=True) if line.startswith("ATOM")]
    heavy = [line for line in lines if line[17:20] != "SER" or line[12:16].strip() not in lost]
    scene = prepare(_write(tmp_path / "x.pdb", *heavy))
    assert molecule_key(scene) == molecule_key(whole)
    notes = " | ".join(scene.provenance["repairs"])
    assert (
        "hydrogens removed because their heavy atoms are missing: SER A2 H" in notes
        and f"added {' '.join(lost)}" in notes
    )
    far = [line[:30] + f"{float(line[30:38]) + 5.0:8.3f}" + line[38:] if line[12:16].strip() == "HG" else line
           for line in lines]  # fmt: skip
    with pytest.raises(PreparationError, match="Hydrogen SER A2 HG is"):  # control: nothing is missing
        prepare(_write(tmp_path / "y.pdb", *far))


def test_a_missing_carbonyl_oxygen_breaks_no_chain_and_other_names_are_said(tmp_path: Path) -> None:
    whole = prepare("sequence:ACE-SER-NME")
    lines = [ln for ln in pdb_text(whole).splitlines(keepends=True) if ln.startswith("ATOM") and ln[77] != "H"]
    scene = prepare(_write(tmp_path / "x.pdb", *(ln for ln in lines if ln[12:20] != " O   SER")))
    assert molecule_key(scene) == molecule_key(whole) and "SER A2: added O" in scene.provenance["repairs"]
    with pytest.raises(PreparationError, match=r"SER A2 has atoms that no SER has \(OX9\); rename or delete them"):
        prepare(_write(tmp_path / "y.pdb", *(ln.replace(" OG ", " OX9") for ln in lines)))


def test_a_hydrogen_at_anothers_methyl_is_a_clash(tmp_path: Path) -> None:
    names = list(zip((ALA2.residue_names[r] for r in ALA2.residue_of_atom), ALA2.atom_names, strict=True))
    moved, methyl = names.index(("NME", "H1")), names.index(("ACE", "CH3"))
    beside, own = ALA2.positions_nm[methyl], ALA2.positions_nm[names.index(("ACE", "C"))]
    x = ALA2.positions_nm.copy()
    x[moved] = beside + 0.1 * (beside - own) / np.linalg.norm(beside - own)
    path = tmp_path / "clash.pdb"
    path.write_text(pdb_text(ALA2.with_positions(x)))
    with pytest.raises(PreparationError, match=r"ACE A1 CH3 has 4 hydrogens \(.* and NME A3 H1\), 1 too many"):
        prepare(str(path))
    path.write_text(pdb_text(ALA2))
    assert prepare(str(path)).provenance["repairs"] == []


# ---- breaks of the chain ---------------------------------------------------------------------------------------------


def _without(scene: Scene, numbers: tuple[str, ...], folder: Path, *, hydrogens: bool = True) -> str:
    lines = [
        line
        for line in pdb_text(scene).splitlines()
        if line.startswith("ATOM") and line[22:26].strip() not in numbers and (hydrogens or line[76:78].strip() != "H")
    ]
    path = folder / "gap.pdb"
    path.write_text("\n".join([*lines, "END"]))
    return str(path)


@pytest.mark.parametrize(("sequence", "hydrogens"), [
    ("ACE-ALA-LYS-GLY-SER-ALA-GLU-NME", True), ("ACE-ALA-LYS-GLY-SER-ALA-GLU-NME", False),
    ("AKGSPE", True), ("AKGSPE", False),
])  # fmt: skip
def test_a_break_is_closed_with_caps(tmp_path: Path, sequence: str, hydrogens: bool) -> None:
    whole = prepare(f"sequence:{sequence}")
    gone = ("4", "5") if sequence.startswith("ACE") else ("3", "4")
    path = _without(whole, gone, tmp_path, hydrogens=hydrogens)
    with pytest.raises(PreparationError, match=r"the chain breaks between .* \(C and N are .* Å apart\).*`cap_breaks"):
        prepare(path)
    scene = prepare(path, cap_breaks=True)
    before, after = int(gone[0]) - 1, int(gone[-1]) + 1
    names = list(zip(scene.residue_names, scene.residue_ids, strict=True))
    assert ("NME", str(before + 1)) in names and ("ACE", str(after - 1)) in names
    assert any(line.startswith("caps added where the chain breaks") for line in scene.provenance["repairs"])
    heavy = {
        (whole.residue_ids[whole.residue_of_atom[i]], whole.atom_names[i]): whole.positions_nm[i]
        for i in whole.heavy_idx
    }
    kept = [
        (scene.positions_nm[i], heavy[key])
        for i in scene.heavy_idx
        if (key := (scene.residue_ids[scene.residue_of_atom[i]], scene.atom_names[i])) in heavy and key[0] not in gone
    ]
    assert len(kept) > 20 and np.abs(np.array([a - b for a, b in kept])).max() < 1e-4
    bonds = np.linalg.norm(scene.positions_nm[scene.bonds[:, 0]] - scene.positions_nm[scene.bonds[:, 1]], axis=1)
    assert bonds.min() > 0.09 and bonds.max() < 0.16
    omega = backbone_torsions(scene)["omega"]
    assert (np.abs(torsion(scene.positions_nm, omega)) > np.radians(150)).all()
    assert int(scene.formal_charges.sum()) == int(whole.formal_charges.sum())
