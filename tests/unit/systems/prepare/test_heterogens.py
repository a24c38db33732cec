"""Waters and ions of a structure file: told by their elements, left out with a word, kept for explicit solvent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.element_data import element_symbol, ion_symbol
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.bonding import find_bonds
from systems.prepare.heterogens import is_water
from systems.prepare.records import AtomRecord
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
PEPTIDE = "".join(f"{line}\n" for line in pdb_text(ALA2).splitlines() if line.startswith("ATOM"))


def _atom(name: str, residue: str, number: int, at: tuple[float, float, float], element: str) -> AtomRecord:
    return AtomRecord(name, element, residue, "W", str(number), at)


def _line(serial: int, name: str, residue: str, number: int, at: tuple[float, float, float], element: str = "") -> str:
    x, y, z = at
    return (
        f"HETATM{serial:5d} {name:^4s} {residue:4s}W{number:4d}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00"
        f"          {element:>2s}\n"
    )


def _water(number: int, at: tuple[float, float, float], residue: str = "HOH") -> str:
    x, y, z = at
    return (
        _line(900, "O", residue, number, at, "O")
        + _line(901, "H1", residue, number, (x + 0.96, y, z), "H")
        + _line(902, "H2", residue, number, (x - 0.24, y + 0.93, z), "H")
    )


def _write(path: Path, *parts: str) -> str:
    path.write_text("".join(parts) + "END\n")
    return str(path)


@pytest.mark.parametrize(
    ("names", "residue", "elements", "is_one"),
    [
        ("O H1 H2", "HOH", "OHH", True),
        ("OW HW1 HW2", "SOL", "OHH", True),
        ("O1 H1 H2", "LIG", "OHH", False),
        ("O", "TIP3", "O", True),
        ("O", "XYZ", "O", False),
        ("O H1 H2 H3", "HOH", "OHHH", False),  # hydronium
        ("O H", "OH", "OH", False),
        ("C O H1", "SOL", "COH", False),
        ("H1 H2", "TIP3", "HH", True),  # a file that is cut
        ("H1 H2", "LIG", "HH", False),
    ],
)
def test_water_is_told_by_its_elements(names: str, residue: str, elements: str, is_one: bool) -> None:
    places = [(0.0, 0.0, 0.0), (0.96, 0.0, 0.0), (-0.24, 0.93, 0.0), (-0.24, -0.93, 0.0)]
    atoms = [_atom(n, residue, 1, at, e) for n, at, e in zip(names.split(), places, elements, strict=False)]
    assert is_water(atoms) is is_one


def test_a_phenol_called_sol_stays(shared_data: Path, tmp_path: Path) -> None:
    phenol = prepare("smiles:Oc1ccccc1")
    lines = [
        _line(k + 1, name, "SOL", 1, tuple(10 * phenol.positions_nm[k]), phenol.elements[k])
        for k, name in enumerate(phenol.atom_names)
    ]
    scene = prepare(_write(tmp_path / "sol.pdb", *lines, _water(7, (30, 30, 30), "SOL")))
    assert scene.formula == "C6H6O"
    assert scene.provenance["repairs"][0] == "1 water molecule left out"


@pytest.mark.parametrize(
    ("name", "element"),
    [("SOD", "Na"), ("CLA", "Cl"), ("POT", "K"), ("Na+", "Na"), ("NA", "Na"), ("CL-", "Cl"), ("K+", "K"), ("MG", "Mg"),
     ("ZN", "Zn"), ("CA", "Ca"), ("CAL", "Ca"), ("ZN2", "Zn"), ("MG2+", "Mg"), ("LIT", "Li"), ("CES", "Cs"),
     ("C", None), ("O", None), ("HOH", None), ("ALA", None), ("CO2", "Co")],
)  # fmt: skip
def test_ions_under_the_names_of_other_programs(name: str, element: str | None) -> None:
    assert ion_symbol(name) == element
    if element is not None:
        for column in ("", name[0]):  # no element column, and one that was guessed from the first letter
            assert element_symbol(f"{name:<4s}", name, column) == element


def test_names_alone_make_no_ion_of_an_alpha_carbon() -> None:
    assert element_symbol(" CA ", "ALA", "") == "C"
    assert element_symbol(" C  ", "CO2", "") == "C"
    assert element_symbol("CA  ", "CA", "") == "Ca"


def test_free_ions_go_with_the_water_and_bound_ones_ask(tmp_path: Path) -> None:
    far = [_line(910 + k, name, name, 10 + k, (30, 30, 30 + 5 * k)) for k, name in enumerate(("SOD", "SOD", "CLA"))]
    scene = prepare(_write(tmp_path / "x.pdb", PEPTIDE, _water(1, (25, 25, 25)), *far))
    assert scene.provenance["repairs"] == ["1 water molecule and free ions 2 SOD, CLA left out"]
    assert scene.topology_hash == ALA2.topology_hash
    oxygen = 10 * ALA2.positions_nm[5]
    for gap, asks in ((2.5, True), (3.5, False)):
        x, y, z = oxygen + (0.0, 0.0, gap)
        path = _write(tmp_path / "y.pdb", PEPTIDE, _line(910, "SOD", "SOD", 10, (x, y, z)))
        if asks:
            with pytest.raises(InputError, match="SOD W10; add `keep_ligand"):
                prepare(path)
            kept = prepare(path, keep_ligand=True)
            assert (kept.elements[-1], len(kept.bonds)) == ("Na", len(ALA2.bonds))
        else:
            assert prepare(path).n_atoms == 22


def test_an_ion_is_bonded_to_nothing_by_distance_or_conect() -> None:
    atoms = [_atom("O", "LIG", 1, (0, 0, 0), "O"), _atom("C", "LIG", 1, (1.2, 0, 0), "C"),
             _atom("NA", "NA", 2, (0, 2.2, 0), "Na")]  # fmt: skip
    assert find_bonds(atoms, []).bonds.tolist() == [[0, 1]]
    found = find_bonds(atoms, [(0, 1), (0, 2)])
    assert found.bonds.tolist() == [[0, 1]]
    assert any("ions coordinate" in note for note in found.notes)


def test_ions_under_one_number_are_ions_each(tmp_path: Path) -> None:
    x, y, z = 10 * ALA2.positions_nm[5] + (0.0, 0.0, 2.5)
    near, far = _line(910, "SOD", "SOD", 10, (x, y, z)), _line(911, "SOD", "SOD", 10, (x, y, z + 30.0))
    with pytest.raises(InputError, match="SOD W10; add `keep_ligand"):
        prepare(_write(tmp_path / "x.pdb", PEPTIDE, near, far))
    scene = prepare(_write(tmp_path / "y.pdb", PEPTIDE, far, far.replace("911", "912").replace(" 10 ", " 10 ")))
    assert scene.n_atoms == 22
    generic = _line(910, "NA", "ION", 10, (x, y, z + 30.0)).replace("HETATM", "ATOM  ")
    assert prepare(_write(tmp_path / "z.pdb", PEPTIDE, generic)).provenance["repairs"] == ["free ion ION left out"]


def test_waters_alone_are_the_scene(tmp_path: Path) -> None:
    scene = prepare(_write(tmp_path / "w.pdb", _water(1, (0, 0, 0)), _water(2, (5, 0, 0))))
    assert (scene.formula, scene.n_atoms) == ("H4O2", 6)


def test_kept_waters_are_completed_beside_the_peptide(tmp_path: Path) -> None:
    bare = _line(950, "O", "HOH", 3, (24, 25, 27.8), "O")
    path = _write(tmp_path / "x.pdb", _water(1, (25, 25, 25)), PEPTIDE, bare)
    scene = prepare(path, keep_water=True)
    assert scene.provenance["repairs"][-1] == "2 water molecules kept, hydrogens placed on 1"
    assert scene.elements[22:] == ("O", "H", "H") * 2
    assert scene.bonds[-4:].tolist() == [[22, 23], [22, 24], [25, 26], [25, 27]]
    new = 10 * scene.positions_nm[25:]
    assert np.linalg.norm(new[1:] - new[0], axis=1) == pytest.approx([0.9572] * 2, abs=1e-4)
    others = np.delete(10 * scene.positions_nm, [26, 27], axis=0)
    gaps = np.linalg.norm(new[1:, None] - others[None], axis=2)
    assert np.sort(gaps, axis=1)[:, 1].min() > 1.5  # but for its own oxygen
    with pytest.raises(InputError, match="exclude each other"):
        prepare(path, keep_water=True, drop_water=True)


CUT = _line(920, "H1", "TIP3", 7, (9.0, 9.0, 9.0), "H")
GLYCEROL = [("C1", "C", (0.0, 0.0, 0.0)), ("O1", "O", (-0.7, 1.2, 0.0)), ("C2", "C", (1.5, 0.0, 0.0)),
            ("O2", "O", (2.0, -0.7, 1.2)), ("C3", "C", (2.1, 1.4, 0.0)), ("O3", "O", (3.5, 1.4, 0.0))]  # fmt: skip


def _charmm_order() -> str:
    """Three waters as CHARMM sorts them by atom, one of them split by the cell, and half of a fourth."""
    places = [(25.0, 25.0, 5.0 * k) for k in range(3)]
    waters = [_water(k + 1, at, "TIP3").splitlines(keepends=True) for k, at in enumerate(places)]
    waters[1][1] = _line(901, "H1", "TIP3", 2, (-25.0, 25.0, 5.0), "H")
    return "".join(water[part] for part in range(3) for water in waters) + CUT


def test_waters_in_any_order_and_halves_of_waters_are_left_out(tmp_path: Path) -> None:
    scene = prepare(_write(tmp_path / "x.pdb", PEPTIDE, _charmm_order()))
    assert scene.provenance["repairs"] == ["3 water molecules and 1 hydrogen of waters without oxygen left out"]
    assert scene.topology_hash == ALA2.topology_hash
    stray = CUT.replace("TIP3", "LIG ")
    with pytest.raises(PreparationError, match="H1"):  # control: under another name it is no water's
        prepare(_write(tmp_path / "y.pdb", PEPTIDE, stray))


def test_waters_in_any_order_are_whole_when_they_are_kept(tmp_path: Path) -> None:
    scene = prepare(_write(tmp_path / "x.pdb", PEPTIDE, _charmm_order()), keep_water=True)
    assert scene.n_atoms == 22 + 9 and "hydrogens placed on 1" in " | ".join(scene.provenance["repairs"])
    i, j = scene.bonds.T
    assert np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=1).max() < 0.2


def _glycerol(residue: str, *, n_atoms: int = 6) -> str:
    return "".join(
        _line(930 + k, name, residue, 50, (20.0 + x, 20.0 + y, 20.0 + z), element)
        for k, (name, element, (x, y, z)) in enumerate(GLYCEROL[:n_atoms])
    )


def test_crystallisation_agents_are_left_out_with_a_line(tmp_path: Path) -> None:
    path = _write(tmp_path / "x.pdb", PEPTIDE, _glycerol("GOL"))
    scene = prepare(path)
    assert scene.provenance["repairs"] == [
        "crystallisation agents and buffers left out (`keep_ligand=True` keeps them): GOL"
    ]
    assert scene.topology_hash == ALA2.topology_hash
    with pytest.raises(PreparationError, match="GOL W50 has no hydrogens"):  # kept where it is asked for
        prepare(path, keep_ligand=True)
    dropped = prepare(path, drop_ligand=True).provenance["repairs"]
    assert dropped == ["left out, as asked (`drop_ligand=True`): GOL W50"]


@pytest.mark.parametrize(("residue", "n_atoms"), [("LIG", 6), ("GOL", 5)])
def test_other_molecules_and_parts_under_an_agents_name_still_ask(tmp_path: Path, residue: str, n_atoms: int) -> None:
    with pytest.raises(PreparationError, match=f"it holds {residue} W50"):
        prepare(_write(tmp_path / "x.pdb", PEPTIDE, _glycerol(residue, n_atoms=n_atoms)))


def test_an_agent_alone_is_the_molecule(tmp_path: Path) -> None:
    full = prepare("smiles:CS(=O)C")
    lines = [
        _line(k + 1, name, "DMS", 1, tuple(10 * full.positions_nm[k]), full.elements[k])
        for k, name in enumerate(full.atom_names)
    ]
    assert prepare(_write(tmp_path / "x.pdb", *lines)).formula == "C2H6OS"


def test_one_hydrogen_too_many_is_said_so(tmp_path: Path, shared_data: Path) -> None:
    lines = (shared_data / "reports" / "n_fourH.pdb").read_text().splitlines(keepends=True)
    with pytest.raises(PreparationError, match=r"ALA A1 N has 4 hydrogens \(H1 H H2 H3\), 1 too many"):
        prepare(_write(tmp_path / "x.pdb", *lines[:-1]))
    without = [line for line in lines[:-1] if line[12:16].strip() != "H" or "ALA" not in line]
    assert prepare(_write(tmp_path / "y.pdb", *without)).formal_charges.sum() == 0, "control: NH3+ and COO-"
