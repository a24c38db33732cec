"""The library: what it lists, that each entry is the molecule its name says, and scenes made from names on demand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from systems.chemistry.geometry import signed_volumes, torsion
from systems.chemistry.graph import backbone_torsions, match_atoms, molecule_key
from systems.chemistry.validity import check_frames, geometry_from_scene
from systems.errors import UnknownNameError
from systems.library import named_scenes
from systems.library.named_scenes import ENTRIES, PROTOCOLS, find_protocol, prepare

MD17 = {"aspirin": ("C9H8O4", 21), "benzene": ("C6H6", 12), "ethanol": ("C2H6O", 9), "malonaldehyde": ("C3H4O2", 9),
        "naphthalene": ("C10H8", 18), "salicylic-acid": ("C7H6O3", 16), "toluene": ("C7H8", 15),
        "uracil": ("C4H4N2O2", 12)}  # fmt: skip
# Atoms and charge of ACE-X-NME: the residue's own atoms plus the 12 of the caps.
AMINO_ACIDS = {
    "ALA": (22, 0), "ARG": (36, 1), "ASN": (26, 0), "ASP": (24, -1), "CYS": (23, 0), "GLN": (29, 0), "GLU": (27, -1),
    "GLY": (19, 0), "HID": (29, 0), "HIE": (29, 0), "HIP": (30, 1), "ILE": (31, 0), "LEU": (31, 0), "LYS": (34, 1),
    "MET": (29, 0), "PHE": (32, 0), "PRO": (26, 0), "SER": (23, 0), "THR": (26, 0), "TRP": (36, 0), "TYR": (33, 0),
    "VAL": (28, 0),
}  # fmt: skip
PEPTIDES = {"alanine-dipeptide": (22, 0), "ac-ala3-nhme": (42, 0), "chignolin": (138, -2), "cln025": (166, -2)}
STRUCTURES = [name for name, entry in ENTRIES.items() if entry.smiles or entry.sequence]


def test_the_groups_hold_every_name_once() -> None:
    listed = [name for members in named_scenes.groups().values() for name in members]
    assert sorted(listed) == named_scenes.names()
    sizes = {group: len(members) for group, members in named_scenes.groups().items()}
    assert sizes == {"peptides": 4, "capped amino acids": 22, "MD17 molecules": 8, "analytic systems": 2}


@pytest.mark.parametrize("name", MD17)
def test_molecules_are_what_their_smiles_says(name: str) -> None:
    from rdkit import Chem
    from rdkit.Chem.rdMolDescriptors import CalcMolFormula
    from rdkit_of_scene import to_rdkit

    from systems.prepare.molecule import scene_from_smiles

    scene = named_scenes.load(name)
    formula, n_atoms = MD17[name]
    smiles = ENTRIES[name].smiles
    assert (scene.formula, scene.n_atoms) == (formula, n_atoms)
    assert CalcMolFormula(Chem.AddHs(Chem.MolFromSmiles(smiles))) == formula
    from_smiles = scene_from_smiles(smiles)
    np.testing.assert_array_equal(match_atoms(scene, from_smiles), np.arange(n_atoms))
    assert molecule_key(scene) == molecule_key(from_smiles)
    back = Chem.MolToSmiles(Chem.RemoveHs(to_rdkit(scene)))
    assert back == Chem.CanonSmiles(smiles)


def test_malonaldehyde_is_the_dialdehyde_of_md17() -> None:
    scene = named_scenes.load("malonaldehyde")
    n_hydrogens = [
        sum(scene.elements[i + j - k] == "H" for i, j in scene.bonds.tolist() if k in (i, j)) for k in range(3)
    ]
    assert scene.elements == ("C", "C", "C", "O", "O", "H", "H", "H", "H")
    assert n_hydrogens == [1, 2, 1]
    assert not any(scene.elements[i] == "O" and scene.elements[j] == "H" for i, j in scene.bonds.tolist())


def test_ethanol_has_the_atom_order_of_the_published_data(shared_data) -> None:
    path = shared_data / "md17-ethanol" / "md17_ethanol_first1600.npz"
    if not path.exists():
        pytest.skip("no MD17 ethanol")
    data = np.load(path)
    scene = named_scenes.load("ethanol")
    symbols = {1: "H", 6: "C", 8: "O"}
    assert scene.elements == tuple(symbols[int(z)] for z in data["z"])
    frames = data["R"] / 10.0
    assert not check_frames(frames, geometry_from_scene(scene)).any()
    # Negative control: with two atoms exchanged the bonds no longer fit.
    exchanged = frames[:, [0, 2, 1, *range(3, 9)]]
    assert check_frames(exchanged, geometry_from_scene(scene)).all()


@pytest.mark.parametrize("code", AMINO_ACIDS)
def test_capped_amino_acids_have_their_atoms_charge_and_handedness(code: str) -> None:
    scene = named_scenes.load(f"ACE-{code}-NME")
    assert (scene.n_atoms, int(scene.formal_charges.sum())) == AMINO_ACIDS[code]
    torsions = backbone_torsions(scene)
    assert [len(torsions[key]) for key in ("phi", "psi", "omega")] == [1, 1, 2]
    assert (np.abs(torsion(scene.positions_nm, torsions["omega"])) > np.radians(150.0)).all()
    if code != "GLY":
        index = {name: i for i, name in enumerate(scene.atom_names) if scene.residue_of_atom[i] == 1}
        row = [index[name] for name in ("CA", "N", "C", "CB")]
        assert signed_volumes(scene.positions_nm, [row])[0] > 0


def test_the_three_histidines_differ_in_their_hydrogens() -> None:
    found = {code: {n for n, r in zip(scene.atom_names, scene.residue_of_atom, strict=True) if r == 1}
             for code in ("HID", "HIE", "HIP") for scene in [named_scenes.load(f"ACE-{code}-NME")]}  # fmt: skip
    assert found["HIP"] - found["HID"] == {"HE2"}
    assert found["HIP"] - found["HIE"] == {"HD1"}


@pytest.mark.parametrize("name", PEPTIDES)
def test_peptides_have_their_atoms_and_charge(name: str) -> None:
    scene = named_scenes.load(name)
    assert (scene.n_atoms, int(scene.formal_charges.sum())) == PEPTIDES[name]


def test_chignolins_are_told_apart_and_extended() -> None:
    for name, ends in (("chignolin", ("GLY", "GLY")), ("cln025", ("TYR", "TYR"))):
        scene = named_scenes.load(name)
        assert len(scene.residue_names) == 10
        assert (scene.residue_names[0], scene.residue_names[-1]) == ends
        ca = [i for i, n in enumerate(scene.atom_names) if n == "CA"]
        # Folded, the ends meet within 0.7 nm.
        assert np.linalg.norm(scene.positions_nm[ca[0]] - scene.positions_nm[ca[-1]]) > 2.0
        assert "not folded" in named_scenes.entry(name).title


@pytest.mark.parametrize("name", STRUCTURES)
def test_starting_structures_are_valid(name: str) -> None:
    scene = named_scenes.load(name)
    assert check_frames(scene.positions_nm, geometry_from_scene(scene))[0] == 0
    assert scene.provenance["library_name"] == name
    assert len(set(zip(scene.residue_of_atom.tolist(), scene.atom_names, strict=True))) == scene.n_atoms


# ---- on demand -----------------------------------------------------------------------------------------------------


def test_capped_dipeptides_are_made_from_their_name() -> None:
    scene = prepare("ACE-SER-GLY-NME")
    assert scene.residue_names == ("ACE", "SER", "GLY", "NME")
    assert scene.name == scene.provenance["library_name"] == "ACE-SER-GLY-NME"
    assert named_scenes.entry("ACE-SER-GLY-NME").protocols == ()


def test_tetrapeptides_are_made_from_one_letter_code() -> None:
    scene = prepare("SDFS")
    assert scene.residue_names == ("SER", "ASP", "PHE", "SER")
    assert int(scene.formal_charges.sum()) == -1
    assert named_scenes.entry("SDFS").protocols == named_scenes.entry("SER-ASP-PHE-SER").protocols == ("mdgen",)


@pytest.mark.parametrize("name", ["n-body-charged", "harmonic-oscillator:1",
                                  "SDF", "SDFX", "ACE-XXX-NME", "aspirine", "alanine dipeptide"])  # fmt: skip
def test_other_names_are_refused_in_one_line(name: str) -> None:
    assert not named_scenes.knows(name)
    with pytest.raises(UnknownNameError) as caught:
        named_scenes.load(name)
    assert "\n" not in str(caught.value)


def test_a_near_miss_is_told() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'aspirin'"):
        named_scenes.load("aspirine")


# ---- protocols -----------------------------------------------------------------------------------------------------


def test_protocols_name_settings_that_runs_have() -> None:
    from md_reference.forces.spec import ForceFieldSpec
    from md_reference.run.simulate import MDConfig

    known = {f.name for c in (MDConfig, ForceFieldSpec) for f in dataclasses.fields(c)} | {"ensemble"}
    for name in named_scenes.names():
        own = named_scenes.entry(name).own_settings
        assert set(own) <= known, name
        # Settings of its own has what no other name can ask for.
        is_model = named_scenes.load(name).interactions is not None
        assert bool(own) == is_model == bool(named_scenes.entry(name).source), name
        assert all(find_protocol(each) for each in named_scenes.entry(name).protocols)
    for protocol in PROTOCOLS.values():
        assert set(protocol.settings) <= known, protocol.name
        assert protocol.source


def test_the_md17_protocol_is_the_published_one() -> None:
    assert all(named_scenes.entry(name).protocols == ("md17",) for name in MD17)
    settings = find_protocol("md17").settings
    published = {"temperature_k": 500.0, "timestep_ps": 0.0005, "save_every_ps": 0.005}
    assert {key: settings[key] for key in published} == published
    assert settings["hydrogen_mass_da"] is None
    assert settings["constrain_hydrogens"] is False


def test_an_unknown_protocol_is_refused_with_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match=r"known: md17, md22, mdgen, fast-folders\. Did you mean 'md17'\?"):
        find_protocol("MD17")
