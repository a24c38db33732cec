"""Charges of ions and atoms that a file states, and protonation by a residue's name or by the metal that it binds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.errors import PreparationError
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text


def _heavy(sequence: str, old: str, new: str) -> tuple[Scene, list[str]]:
    scene = prepare(f"sequence:{sequence}")
    lines = [f"{line[:17]}{line[17:21].replace(old, new):4s}"[:21] + line[21:] for line in pdb_text(scene).splitlines()
             if line.startswith("ATOM") and line[76:78].strip() != "H"]  # fmt: skip
    return scene, lines


def _ion(residue: str, element: str, at: tuple[float, ...] = (30.0, 30.0, 30.0), charge: str = "") -> str:
    x, y, z = at
    return (
        f"HETATM  900 {element:<4s} {residue:>3s} A 900    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          "
        f"{element:>2s}{charge}"
    )


def _read(path: Path, *lines: str) -> Scene:
    path.write_text("\n".join(lines) + "\nEND\n")
    return prepare(str(path), keep_ligand=True)


@pytest.mark.parametrize(
    ("residue", "atom", "beside", "reach", "hydrogens", "said"),
    [
        ("HIS", "ND1", ("CG", "CE1"), 2.05, {"HE2"}, "HIS A2: proton placed on NE2, because ND1 binds ZN A900"),
        ("HIS", "NE2", ("CD2", "CE1"), 2.05, {"HD1"}, "HIS A2: proton placed on ND1, because NE2 binds ZN A900"),
        ("HIS", "ND1", ("CG", "CE1"), 3.5, {"HD1"}, "protonation at pH 7: HIS neutral (HID): HIS A2"),
        ("CYS", "SG", ("CB",), 2.33, set(), "CYS A2: thiolate, because SG binds ZN A900"),
    ],
)
def test_a_metal_takes_the_place_of_a_proton(
    tmp_path: Path, residue: str, atom: str, beside: tuple[str, ...], reach: float, hydrogens: set[str], said: str
) -> None:
    whole, lines = _heavy(f"ACE-{residue.replace('HIS', 'HIE')}-NME", "HIE", "HIS")
    x = dict(zip(whole.atom_names, 10 * whole.positions_nm, strict=True))
    arms = [x[atom] - x[b] for b in beside]
    away = np.sum([arm / np.linalg.norm(arm) for arm in arms], axis=0)
    scene = _read(tmp_path / "x.pdb", *lines, "TER", _ion("ZN", "ZN", x[atom] + reach * away / np.linalg.norm(away)))
    assert said in scene.provenance["repairs"]
    assert {"HD1", "HE2", "HG"} & set(scene.atom_names) == hydrogens
    assert int(scene.formal_charges.sum()) == (1 if residue == "CYS" else 2)


@pytest.mark.parametrize(
    ("residue", "name", "hydrogens"),
    [("HIE", "HISD", {"HD1"}), ("HIE", "HISB", {"HE2"}), ("HIE", "HISH", {"HD1", "HE2"}),
     ("HIE", "CHIP", {"HD1", "HE2"}), ("ASP", "ASPH", {"HD2"}), ("GLU", "GLUH", {"HE2"})],
)  # fmt: skip
def test_names_of_other_programs_state_the_protonation(
    tmp_path: Path, residue: str, name: str, hydrogens: set[str]
) -> None:
    scene = _read(tmp_path / "x.pdb", *_heavy(f"ACE-{residue}-NME", residue, name)[1])
    assert {"HD1", "HD2", "HE2"} & set(scene.atom_names) - ({"HD2"} if residue == "HIE" else set()) == hydrogens
    assert not any("protonation at" in line for line in scene.provenance["repairs"])


@pytest.mark.parametrize(
    ("residue", "element", "stated", "charge"),
    [("CU1", "CU", "", 1), ("CU", "CU", "1+", 1), ("CU", "CU", "", 2), ("FE", "FE", "", 3), ("FE2", "FE", "", 2),
     ("3CO", "CO", "", 3), ("MN3", "MN", "", 3), ("AG", "AG", "+1", 1), ("ZN", "ZN", "", 2)],
)  # fmt: skip
def test_an_ion_has_the_charge_that_is_stated_else_that_of_its_name(
    tmp_path: Path, residue: str, element: str, stated: str, charge: int
) -> None:
    _, lines = _heavy("ACE-ALA-NME", "", "")
    assert _read(tmp_path / "x.pdb", *lines, "TER", _ion(residue, element, charge=stated)).formal_charges[-1] == charge


def test_a_lone_atom_of_unknown_charge_is_asked_about(tmp_path: Path) -> None:
    _, lines = _heavy("ACE-ALA-NME", "", "")
    with pytest.raises(PreparationError, match="no charge is known for the lone atom AG A900 AG; state it in columns"):
        _read(tmp_path / "x.pdb", *lines, "TER", _ion("AG", "AG"))


@pytest.mark.parametrize(
    ("stated", "said"),
    [("", ["charges that no file states, by bonds and hydrogens: LIG A1 N +1"]),
     ("1+", []),
     ("1-", ["charges stated in the file but not used, as bonds and hydrogens give others: "
             "LIG A1 (-1 stated, +1 used)"])],
)  # fmt: skip
def test_charges_that_the_file_states_are_not_said_to_be_ours(tmp_path: Path, stated: str, said: list[str]) -> None:
    places = 0.59 * np.array([(0, 0, 0), (1, 1, 1), (-1, -1, 1), (-1, 1, -1), (1, -1, -1)])
    names = ("N", "H1", "H2", "H3", "H4")
    rows = [f"HETATM{k:5d}  {name:<3s} LIG A   1    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {name[0]:>2s}"
            for k, (name, (x, y, z)) in enumerate(zip(names, places, strict=True), 1)]  # fmt: skip
    scene = _read(tmp_path / "x.pdb", rows[0] + stated, *rows[1:])
    assert scene.formal_charges.tolist() == [1, 0, 0, 0, 0]
    assert [line for line in scene.provenance["repairs"] if line.startswith("charges")] == said
