"""MOL2 under the atom types of many programs: elements and bonds are the file's, orders and charges perceived."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from small_scenes import n_unpaired_electrons
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.mol2_file import element_of
from systems.prepare.molecule import scene_from_mol_file, scene_from_smiles
from systems.scene import Scene

SYBYL = {"C": "C.3", "N": "N.3", "O": "O.3", "S": "S.3", "P": "P.3"}
GAFF = {"C": "c3", "N": "n", "O": "oh", "H": "hc", "S": "ss", "Cl": "cl", "Br": "br"}
AMBER = {"C": "CT", "N": "N2", "O": "O2", "H": "HC"}
CGENFF = {"C": "CG2R61", "N": "NG2S1", "O": "OG311", "H": "HGA1", "Cl": "CLGR1", "Br": "BRGR1", "S": "SG2D1"}
OPLS = dict.fromkeys(("C", "N", "O", "H", "S", "Cl", "Br"), "opls_135")


def _mol2(
    scene: Scene,
    types: dict[str, str],
    *,
    charges: Sequence[float] | None = None,
    order: str = "1",
    without: Sequence[int] = (),
    flat: bool = False,
) -> str:
    kept = [i for i in range(scene.n_atoms) if i not in without]
    new = {i: k + 1 for k, i in enumerate(kept)}
    x = 10.0 * scene.positions_nm * ([1.0, 1.0, 0.0] if flat else [1.0, 1.0, 1.0])
    atoms = [
        f"{new[i]:7d} {scene.atom_names[i]:6s} {x[i, 0]:9.4f} {x[i, 1]:9.4f} {x[i, 2]:9.4f} "
        f"{types.get(scene.elements[i], scene.elements[i]):7s} 1 LIG {0.0 if charges is None else charges[i]:9.4f}"
        for i in kept
    ]
    rows = [(*pair, str(round(o))) for pair, o in zip(scene.bonds.tolist(), scene.bond_orders, strict=True)]
    rows = [row for row in rows if row[0] in new and row[1] in new]
    bonds = [f"{k + 1:6d} {new[i]:5d} {new[j]:5d} {order or own}" for k, (i, j, own) in enumerate(rows)]
    kind = "NO_CHARGES" if charges is None else "USER_CHARGES"
    head = ["# written by a test", "@<TRIPOS>MOLECULE", "LIG", f"{len(kept)} {len(bonds)} 1", "SMALL", kind, ""]
    return "\n".join([*head, "@<TRIPOS>ATOM", *atoms, "@<TRIPOS>BOND", *bonds, "@<TRIPOS>SUBSTRUCTURE", "1 LIG 1", ""])


def _read(path: Path, text: str) -> Scene:
    file = path / "x.mol2"
    file.write_text(text)
    return scene_from_mol_file(file)


@pytest.mark.parametrize("types", [SYBYL, GAFF, AMBER, CGENFF, OPLS], ids=["sybyl", "gaff", "amber", "cgenff", "opls"])
@pytest.mark.parametrize("order", ["1", "ar", "un"])
def test_types_and_orders_of_any_program_give_the_molecule(tmp_path: Path, types: dict[str, str], order: str) -> None:
    for smiles in ("CC(=O)Oc1ccccc1C(=O)[O-]", "NC(=[NH2+])c1ccccc1", "C[C@H](N)C(=O)NCC#N", "Clc1cc(Br)c[nH+]c1"):
        known = scene_from_smiles(smiles)
        if types is AMBER and "Cl" in smiles:
            continue
        scene = _read(tmp_path, _mol2(known, types, order=order))
        assert molecule_key(scene) == molecule_key(known), smiles
        assert scene.provenance["repairs"] == []
        assert scene.positions_nm == pytest.approx(known.positions_nm, abs=1e-4)


@pytest.mark.parametrize(
    ("atom_type", "name", "element"),
    [("CL", "CL1", "Cl"), ("Cl", "X", "Cl"), ("C.cat", "X", "C"), ("N.pl3", "X", "N"), ("2C", "CB", "C"),
     ("c1", "Q", "C"), ("CA", "CA", "C"), ("NA", "N1", "N"), ("CO", "C5", "C"), ("na", "NA1", "N"), ("os", "OS", "O"),
     ("HO", "HO1", "H"), ("H.spc", "H1", "H"), ("p5", "PA", "P"), ("Zn", "ZN", "Zn"), ("FE", "FE", "Fe"),
     ("Si", "SI1", "Si"), ("opls_800", "C12", "C"), ("DU", "S1", "S"), ("Du", "Du1", None), ("LP", "LP1", None)],
)  # fmt: skip
def test_an_element_is_its_type_s_first_letter_unless_it_has_two(
    atom_type: str, name: str, element: str | None
) -> None:
    assert element_of(atom_type, name) == element


def test_atoms_alone_are_ions_by_name() -> None:
    assert [element_of(t, n, alone=True) for t, n in (("IP", "Na+"), ("NA", "NA"), ("CA", "CA"), ("IM", "Cl-"))] == [
        "Na", "Na", "Ca", "Cl",
    ]  # fmt: skip


def test_partial_charges_decide_where_elements_and_bonds_leave_it_open(tmp_path: Path) -> None:
    paraquat = scene_from_smiles("C[n+]1ccc(cc1)-c1cc[n+](C)cc1")
    shared = np.full(paraquat.n_atoms, 2.0 / paraquat.n_atoms)
    scene = _read(tmp_path, _mol2(paraquat, GAFF, charges=shared.tolist()))
    assert int(scene.formal_charges.sum()) == 2
    assert scene.provenance["repairs"] == []
    # Reduced, it has the same atoms and bonds.
    assert int(_read(tmp_path, _mol2(paraquat, GAFF)).formal_charges.sum()) == 0
    # No column makes a molecule of what is none: one electron more or less is said and not taken.
    scene = _read(tmp_path, _mol2(paraquat, GAFF, charges=(shared / 2).tolist()))
    assert int(scene.formal_charges.sum()) == 0
    assert "add up to +1.00" in scene.provenance["repairs"][0]


def test_a_carbocation_is_taken_on_the_word_of_its_charges_alone(tmp_path: Path) -> None:
    trityl = scene_from_smiles("[C+](c1ccccc1)(c1ccccc1)c1ccccc1")
    text = _mol2(trityl, GAFF, charges=[1.0 / trityl.n_atoms] * trityl.n_atoms)
    assert int(_read(tmp_path, text).formal_charges.sum()) == 1
    with pytest.raises(PreparationError, match="no valid Lewis structure"):
        _read(tmp_path, _mol2(trityl, GAFF))


@pytest.mark.parametrize("types", [SYBYL, GAFF], ids=["sybyl", "gaff"])
def test_missing_hydrogens_are_asked_for(tmp_path: Path, types: dict[str, str]) -> None:
    known = scene_from_smiles("CCO")
    hydrogens = [i for i, e in enumerate(known.elements) if e == "H"]
    # One of a carbon; without that of the oxygen it is ethoxide.
    for without in (hydrogens, *([h] for h in hydrogens[:-1])):
        with pytest.raises(PreparationError, match="give the molecule with all hydrogens"):
            _read(tmp_path, _mol2(known, types, without=without))


@pytest.mark.parametrize("smiles", ["[O-]N=O", "FC(F)(F)F", "O=C=O", "[O-][N+](=O)[O-]", "ClC(Cl)(Cl)Cl"])
def test_molecules_without_hydrogens_are_whole(tmp_path: Path, smiles: str) -> None:
    known = scene_from_smiles(smiles)
    scene = _read(tmp_path, _mol2(known, {"C": "C.2", "O": "O.2", "N": "N.2"}, order=""))
    assert (scene.formula, int(scene.formal_charges.sum())) == (known.formula, int(known.formal_charges.sum()))
    assert n_unpaired_electrons(scene) == 0


def test_a_drawing_is_embedded(tmp_path: Path) -> None:
    scene = _read(tmp_path, _mol2(scene_from_smiles("CCO"), SYBYL, flat=True))
    assert np.abs(scene.positions_nm[:, 2]).max() > 0.01
    assert "2-D structure" in scene.provenance["repairs"][0]


def test_broken_records_are_named(tmp_path: Path) -> None:
    good = _mol2(scene_from_smiles("CCO"), SYBYL)
    for old, new, said in (
        ("     1     1     2 1", "     1     1    99 1", "joins no two atoms"),
        ("C.3     1 LIG", "Du", "no recognisable element"),
        (" C1 ", " C1  nan ", "no three coordinates"),
        ("@<TRIPOS>ATOM", "@<TRIPOS>OTHER", "no atoms"),
    ):
        text = good.replace(old, new, 1).replace("      1 C1 ", "      1 Xx " if new == "Du" else "      1 C1 ")
        with pytest.raises(InputError, match=said):
            _read(tmp_path, text)


def _peptide(residue: str = "{name}{number}") -> str:
    scene = named_scenes.load("alanine-dipeptide")
    lines = _mol2(scene, AMBER).splitlines()
    first = lines.index("@<TRIPOS>ATOM") + 1
    for i in range(scene.n_atoms):
        number = int(scene.residue_of_atom[i]) + 1
        name = residue.format(name=scene.residue_names[number - 1], number=number)
        lines[first + i] = lines[first + i].replace("1 LIG", f"{number} {name}")
    return "\n".join(lines)


def test_a_peptide_keeps_its_residues_and_is_one_for_its_force_field(tmp_path: Path) -> None:
    known = named_scenes.load("alanine-dipeptide")
    for residue in ("{name}{number}", "{name}"):
        path = tmp_path / "x.mol2"
        path.write_text(_peptide(residue))
        scene = prepare(str(path))
        assert scene.residue_names == ("ACE", "ALA", "NME")
        assert (scene.atom_names, molecule_key(scene)) == (known.atom_names, molecule_key(known))
        assert scene.provenance["repairs"] == []
    path.write_text(_peptide("LIG"))
    scene = prepare(str(path))
    assert (scene.residue_names, molecule_key(scene)) == (("MOL",), molecule_key(known))
