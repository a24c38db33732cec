"""Alternate locations: one label for what is bonded together; records of bonds that make none are said."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from systems.errors import PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text

ALA2 = named_scenes.load("alanine-dipeptide")
SSBOND = "SSBOND   1 CYS A    2    CYS B    2                          1555   1555  2.05\n"


@pytest.fixture(scope="module")
def disulfide() -> list[str]:
    """Two ACE-CYS-NME, chains A and B, sulfurs at 2.05 Å, without hydrogens."""
    single = prepare("sequence:ACE-CYS-NME")
    index = {n: i for i, n in enumerate(single.atom_names)}
    sulfur, hydrogen = single.positions_nm[index["SG"]], single.positions_nm[index["HG"]]
    axis = (hydrogen - sulfur) / np.linalg.norm(hydrogen - sulfur)
    turned = 2 * (sulfur + 0.1025 * axis) - single.positions_nm
    lines = [ln for ln in pdb_text(single).splitlines(keepends=True) if ln.startswith("ATOM")]
    heavy = [i for i, e in enumerate(single.elements) if e != "H"]
    second = [f"{lines[i][:21]}B{lines[i][22:]}" for i in heavy]
    return [lines[i] for i in heavy] + [
        _at(line, tuple((10 * turned[i]).tolist())) for line, i in zip(second, heavy, strict=True)
    ]


def _at(line: str, x: Sequence[float]) -> str:
    return f"{line[:30]}{x[0]:8.3f}{x[1]:8.3f}{x[2]:8.3f}{line[54:]}"


def _split(line: str, shares: Sequence[float], shift: float, labels: str = "AB") -> list[str]:
    """The atom twice: where it is, and shifted by `shift` Å along x, with these occupancies."""
    x = [float(line[k : k + 8]) for k in (30, 38, 46)]
    return [
        f"{_at(line, (x[0] + k * shift, *x[1:]))[:16]}{label}{_at(line, (x[0] + k * shift, *x[1:]))[17:54]}"
        f"{share:6.2f}{line[60:]}"
        for k, (label, share) in enumerate(zip(labels, shares, strict=True))
    ]


def _sulfurs(lines: Sequence[str], first: Sequence[float], second: Sequence[float], labels: str = "AB") -> list[str]:
    """Alternates of both sulfurs: label A bonded, label B aside of it, bonded too."""
    out = []
    for line in lines:
        if line[12:16].strip() == "SG":
            in_first = line[21] == "A"
            out += _split(line, first if in_first else second, 0.3, "AB" if in_first else labels)
        else:
            out.append(line)
    return out


def _prepared(path: Path, *parts: Sequence[str] | str) -> tuple[Scene, str]:
    path.write_text("".join("".join(part) for part in parts) + "END\n")
    scene = prepare(str(path))
    return scene, " | ".join(scene.provenance["repairs"])


@pytest.mark.parametrize("record", [SSBOND, ""], ids=["ssbond", "distance"])
@pytest.mark.parametrize(
    ("first", "second", "label"),
    [((0.55, 0.45), (0.45, 0.55), "A"), ((0.6, 0.4), (0.3, 0.7), "B"), ((0.7, 0.3), (0.4, 0.6), "A")],
)
def test_bonded_cysteines_have_one_label(
    tmp_path: Path, disulfide: list[str], record: str, first: tuple[float, ...], second: tuple[float, ...], label: str
) -> None:
    _, notes = _prepared(tmp_path / "x.pdb", record, _sulfurs(disulfide, first, second))
    assert f"(A2:{label}, B2:{label}), one label for what is bonded, 2 atoms left out" in notes
    assert "disulfide bond CYS A2 - CYS B2 (2.05 Å)" in notes and "CYS neutral" not in notes


def test_residues_that_are_not_bonded_choose_by_themselves(tmp_path: Path, disulfide: list[str]) -> None:
    far = [
        line if line[21] == "A" else _at(line, [float(line[k : k + 8]) + 20 for k in (30, 38, 46)])
        for line in disulfide
    ]
    _, notes = _prepared(tmp_path / "x.pdb", _sulfurs(far, (0.55, 0.45), (0.45, 0.55)))
    assert "(A2:A, B2:B), 2 atoms left out" in notes and "disulfide" not in notes


def test_a_conect_record_of_one_alternate_holds_for_the_other(tmp_path: Path) -> None:
    """Serial numbers name the alternates A; the alternates B stay."""
    lines = []
    for k in range(2):
        head = f"LI{k} A 20{k}    {20 + 1.54 * k:8.3f}{20.0:8.3f}"
        for n, (label, share, z) in enumerate((("A", 0.3, 20.0), ("B", 0.7, 20.4))):
            serial = 10 * (k + 1) + n
            lines.append(f"HETATM{serial:5d}  C1 {label}{head}{z:8.3f}{share:6.2f}  0.00           C\n")
        for h, angle in enumerate(np.radians([0, 120, 240]) + k * np.pi / 3):
            x, y, z = 20 + 1.54 * k + 0.363 * (2 * k - 1), 20 + 1.028 * np.cos(angle), 20.4 + 1.028 * np.sin(angle)
            place = f"LI{k} A 20{k}    {x:8.3f}{y:8.3f}{z:8.3f}"
            lines.append(f"HETATM{40 + 5 * k + h:5d}  H{h + 1}  {place}  1.00  0.00           H\n")
    conect = "CONECT   10   20\n"
    scene, notes = _prepared(tmp_path / "x.pdb", lines, conect)
    assert scene.formula == "C2H6" and len(scene.bonds) == 7
    assert "(A200:B, A201:B), one label for what is bonded" in notes and "not used" not in notes
    with pytest.raises(PreparationError, match="no valid Lewis structure"):  # without the record there is no bond
        _prepared(tmp_path / "y.pdb", lines)


def test_a_blank_beside_a_label_is_another_alternate(tmp_path: Path, disulfide: list[str]) -> None:
    lines = [ln for line in disulfide for ln in (_split(line, (0.3, 0.7), 0.3, " B") if "SG" in line else [line])]
    scene, notes = _prepared(tmp_path / "x.pdb", lines)
    assert "(A2:B, B2:B), one label for what is bonded, 2 atoms left out" in notes
    assert scene.elements.count("S") == 2


def test_a_peptide_bond_joins_alternates_of_one_label(tmp_path: Path) -> None:
    text = [ln for ln in pdb_text(ALA2).splitlines(keepends=True) if ln.startswith("ATOM")]
    carbonyl = [(3 if ln[17:20] == "NME" else 2, ln[12:16].strip()) for ln in text]
    lines = []
    for (residue, name), line in zip(carbonyl, text, strict=True):
        if line[17:20] == "ALA" and name in ("C", "O"):
            lines += _split(line, (0.6, 0.4), 0.3)
        elif residue == 3 and name in ("N", "H"):
            lines += _split(line, (0.2, 0.8), 0.3)
        else:
            lines.append(line)
    _, notes = _prepared(tmp_path / "x.pdb", lines)
    assert "2:B" in notes and "3:B" in notes and "one label for what is bonded" in notes
    assert ":A" not in notes


def test_records_of_bonds_that_are_not_made_are_said(tmp_path: Path, disulfide: list[str]) -> None:
    _, notes = _prepared(tmp_path / "a.pdb", SSBOND, disulfide)
    assert "not used" not in notes
    far = [
        line if line[21] == "A" else _at(line, [float(line[k : k + 8]) + 20 for k in (30, 38, 46)])
        for line in disulfide
    ]
    _, notes = _prepared(tmp_path / "b.pdb", SSBOND, far)
    assert "bonds stated in the file but not used: CYS A2 SG - CYS B2 SG (3" in notes
    _, notes = _prepared(tmp_path / "c.pdb", SSBOND.replace("B    2", "B    9"), far)
    assert "no such two atoms together: CYS A2 SG - CYS B9 SG" in notes
    _, notes = _prepared(tmp_path / "d.pdb", SSBOND.replace("1555   1555", "1555   2655"), far)
    assert "records of bonds not used, as they lead to a symmetry copy" in notes
    # Alternates that never stand together are no two atoms that a record can mean.
    ab = _sulfurs(far, (0.6, 0.4), (0.6, 0.4), labels="CD")
    _, notes = _prepared(tmp_path / "e.pdb", SSBOND, ab)
    assert "no such two atoms together: CYS A2 SG - CYS B2 SG" in notes


def test_the_reported_disulfide_is_kept(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "reports" / "p5_ss_altloc_ssbond.pdb"
    if not path.exists():
        pytest.skip(f"no {path.name} among the shared data")
    scene, notes = _prepared(tmp_path / "x.pdb", path.read_text())
    assert "(A2:A, A6:A), one label for what is bonded, 2 atoms left out" in notes
    assert "disulfide bond CYS A2 - CYS A6" in notes and scene.n_atoms == 64
