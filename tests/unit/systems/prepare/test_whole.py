"""Molecules that a periodic cell cuts are made whole or refused, and never of another chirality."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.distance_bonds import cell_of
from systems.chemistry.graph import molecule_key
from systems.errors import PreparationError, SurromdError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.structure_text import read_structure
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
ETHANOL = named_scenes.load("ethanol")
# Å and degrees; the second is a truncated octahedron.
CUBIC = (20.0, 20.0, 20.0, 90.0, 90.0, 90.0)
SKEWED = (22.0, 22.0, 22.0, 70.5288, 109.4712, 70.5288)


def _wrapped(scene: Scene, numbers: tuple[float, ...], offset: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Scene:
    """The scene with each atom moved into the cell by itself."""
    cell = cell_of(numbers)
    assert cell is not None
    x = scene.positions_nm - scene.positions_nm.mean(axis=0) + np.array(offset) @ cell
    return scene.with_positions(x - np.floor(x @ np.linalg.inv(cell)) @ cell)


def _pdb(path: Path, scene: Scene, numbers: tuple[float, ...] | None, *, heavy: bool = False) -> str:
    lines = [line for line in pdb_text(scene).splitlines() if line[:6] in ("ATOM  ", "HETATM", "CONECT")]
    if heavy:
        lines = [line for line in lines if line.startswith(("ATOM", "HETATM")) and line[76:78].strip() != "H"]
    a, b, c, *angles = numbers or CUBIC
    cell = f"CRYST1{a:9.3f}{b:9.3f}{c:9.3f}" + "".join(f"{x:7.2f}" for x in angles) + " P 1           1"
    path.write_text("\n".join([*([cell] if numbers else []), *lines, "END", ""]))
    return str(path)


def _cif(path: Path, scene: Scene, numbers: tuple[float, ...]) -> str:
    tags = ["length_a", "length_b", "length_c", "angle_alpha", "angle_beta", "angle_gamma"]
    lines = ["data_x", *(f"_cell.{tag} {x}(2)" for tag, x in zip(tags, numbers, strict=True)), "loop_"]
    columns = (
        "id",
        "type_symbol",
        "label_atom_id",
        "label_comp_id",
        "label_asym_id",
        "label_seq_id",
        "label_alt_id",
        "Cartn_x",
    )
    lines += [f"_atom_site.{tag}" for tag in (*columns, "Cartn_y", "Cartn_z")]
    for i, (x, y, z) in enumerate((10 * scene.positions_nm).round(3).tolist()):
        residue = int(scene.residue_of_atom[i])
        name = scene.residue_names[residue]
        lines.append(f"{i + 1} {scene.elements[i]} {scene.atom_names[i]} {name} A {residue + 1} . {x} {y} {z}")
    path.write_text("\n".join([*lines, ""]))
    return str(path)


def _mol2(path: Path, scene: Scene) -> str:
    x = 10 * scene.positions_nm
    rows = [
        f"{i + 1} {scene.atom_names[i]} {x[i, 0]:.4f} {x[i, 1]:.4f} {x[i, 2]:.4f} {e} 1 LIG 0.0"
        for i, e in enumerate(scene.elements)
    ]
    bonds = [f"{k + 1} {i + 1} {j + 1} 1" for k, (i, j) in enumerate(scene.bonds.tolist())]
    head = ["@<TRIPOS>MOLECULE", "x", f"{len(rows)} {len(bonds)} 1", "SMALL", "NO_CHARGES", "", "@<TRIPOS>ATOM"]
    path.write_text("\n".join([*head, *rows, "@<TRIPOS>BOND", *bonds, ""]))
    return str(path)


def _longest_nm(scene: Scene) -> float:
    return float(np.linalg.norm(np.diff(scene.positions_nm[scene.bonds], axis=1), axis=-1).max())


def _notes(scene: Scene) -> str:
    return " | ".join(scene.provenance["repairs"])


@pytest.mark.parametrize("numbers", [CUBIC, SKEWED], ids=["cubic", "octahedron"])
def test_a_peptide_is_made_whole_by_its_cell_wherever_it_is_cut(tmp_path: Path, numbers: tuple[float, ...]) -> None:
    n_cut = 0
    for offset in product((0.0, 0.1, 0.5), repeat=3):
        split = _wrapped(ALA2, numbers, offset)
        broken = _longest_nm(split) > 0.2
        n_cut += broken
        for write in (_pdb, _cif):
            scene = prepare(write(tmp_path / f"x{'.pdb' if write is _pdb else '.cif'}", split, numbers))
            assert _longest_nm(scene) < 0.16 and molecule_key(scene) == molecule_key(ALA2)
            assert ("made whole by the periodic cell" in _notes(scene)) == broken
            assert "D-residues" not in _notes(scene)
            if not broken:  # not an atom is moved that need not be
                assert scene.positions_nm == pytest.approx(split.positions_nm, abs=1e-4)
    assert n_cut > 5


def test_heavy_atoms_are_made_whole_before_hydrogens_are_added(tmp_path: Path) -> None:
    split = _wrapped(ALA2, CUBIC)
    scene = prepare(_pdb(tmp_path / "x.pdb", split, CUBIC, heavy=True))
    assert _longest_nm(scene) < 0.17 and molecule_key(scene) == molecule_key(ALA2)
    assert _notes(scene).index("made whole") < _notes(scene).index("hydrogens placed")


def test_molecules_without_templates_are_made_whole_too(tmp_path: Path) -> None:
    split = _wrapped(ETHANOL, CUBIC)
    assert _longest_nm(split) > 1.0
    scene = prepare(_pdb(tmp_path / "x.pdb", split, CUBIC))
    assert molecule_key(scene) == molecule_key(ETHANOL) and _longest_nm(scene) < 0.16
    assert "made whole by the periodic cell" in _notes(scene)


def test_what_stays_broken_is_refused_with_its_bond_and_length(tmp_path: Path) -> None:
    peptide, molecule = _wrapped(ALA2, CUBIC, (0.0, 0.0, 0.1)), _wrapped(ETHANOL, CUBIC)
    files = [
        _pdb(tmp_path / "none.pdb", peptide, None),
        _pdb(tmp_path / "placeholder.pdb", peptide, (1.0, 1.0, 1.0, 90.0, 90.0, 90.0)),
        _pdb(tmp_path / "wrong.pdb", peptide, (31.0, 31.0, 31.0, 90.0, 90.0, 90.0)),
        _pdb(tmp_path / "heavy.pdb", peptide, None, heavy=True),
        _pdb(tmp_path / "conect.pdb", molecule, None),
        _mol2(tmp_path / "none.mol2", molecule),
    ]
    for path in files:
        with pytest.raises(SurromdError, match=r"the bond .* - .* is \d+\.\d\d Å long.*make it whole") as caught:
            prepare(path)
        assert "\n" not in str(caught.value) and path in str(caught.value)


def test_a_bond_of_a_template_has_a_length(tmp_path: Path) -> None:
    x = ALA2.positions_nm.copy()
    side = [ALA2.atom_names.index(name) for name in ("CB", "HB1", "HB2", "HB3")]
    arm = x[side[0]] - x[ALA2.atom_names.index("CA")]
    for stretch_nm, fine in ((0.03, True), (0.06, False)):
        moved = x.copy()
        moved[side] += stretch_nm * arm / np.linalg.norm(arm)
        path = _pdb(tmp_path / "x.pdb", ALA2.with_positions(moved), None)
        if fine:
            prepare(path)
        else:
            with pytest.raises(PreparationError, match=r"the bond ALA A?2 CA - ALA A?2 CB is 2\.1\d Å long"):
                prepare(path)


def test_what_stands_beside_a_cut_molecule_comes_along_and_whole_ones_stay(tmp_path: Path) -> None:
    split = _wrapped(ALA2, CUBIC)
    path = Path(_pdb(tmp_path / "x.pdb", split, CUBIC))
    carbonyl = split.positions_nm[ALA2.atom_names.index("O")] * 10
    water = np.mod(carbonyl + [2.8, 0.0, 0.0], 20.0)
    line = "HETATM  900  O   HOH A 101    " + "".join(f"{v:8.3f}" for v in water) + "  1.00  0.00           O\n"
    path.write_text(path.read_text().replace("END\n", line + "END\n"))
    scene = prepare(str(path), keep_water=True)
    oxygen = scene.positions_nm[ALA2.n_atoms]
    assert np.linalg.norm(oxygen - scene.positions_nm[ALA2.atom_names.index("O")]) == pytest.approx(0.28, abs=1e-3)
    # Two whole molecules in a cell that is not theirs: a contact of images is no bond.
    close = replace(ALA2, positions_nm=ALA2.positions_nm - ALA2.positions_nm.min(axis=0))
    size = 10 * float(np.ptp(close.positions_nm[:, 0])) + 1.5
    scene = prepare(_pdb(tmp_path / "y.pdb", close, (size, 30.0, 30.0, 90.0, 90.0, 90.0)))
    assert scene.positions_nm == pytest.approx(close.positions_nm, abs=1e-4) and "made whole" not in _notes(scene)


@pytest.mark.parametrize(
    "numbers",
    [
        (1, 1, 1, 90, 90, 90),
        (0, 0, 0, 0, 0, 0),
        (20, 20, 20, 90, 90, 180),
        (20, 20, 20, 30, 30, 170),
        (20, 20, 5, 90, 90, 90),
    ],
)
def test_placeholders_and_impossible_cells_are_none(numbers: tuple[float, ...]) -> None:
    assert cell_of(numbers) is None and cell_of([]) is None
    assert cell_of(CUBIC) == pytest.approx(np.diag([2.0, 2.0, 2.0]))


@pytest.mark.parametrize("name", ["p2_split_p375_heavy.pdb", "p2_split_m300.pdb"])
def test_the_reported_peptides_are_whole_and_l(shared_data: Path, tmp_path: Path, name: str) -> None:
    path = shared_data / "reports" / name
    if not path.exists():
        pytest.skip(f"no {path.name} among the shared data")
    scene = prepare(str(path))
    assert _longest_nm(scene) < 0.2 and "made whole by the periodic cell" in _notes(scene)
    assert "D-residues" not in _notes(scene)
    assert molecule_key(scene) == molecule_key(prepare("sequence:ACE-SER-LYS-NME"))
    bare = tmp_path / name
    bare.write_text("".join(line for line in path.read_text().splitlines(True) if not line.startswith("CRYST1")))
    assert read_structure(bare).cell_nm is None
    with pytest.raises(PreparationError, match=r"Å long|Å from the nearest|chain breaks"):
        prepare(str(bare))
