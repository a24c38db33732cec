"""Peptides from a sequence."""

from __future__ import annotations

import numpy as np
import pytest

from systems.chemistry.geometry import signed_volumes, torsion
from systems.chemistry.graph import backbone_torsions, match_atoms, molecule_key, stereocentres
from systems.errors import PreparationError
from systems.library import named_scenes
from systems.library.named_scenes import prepare
from systems.prepare.peptide import parse_sequence

ALA2 = named_scenes.load("alanine-dipeptide")


def test_sequence_gives_the_library_molecule() -> None:
    scene = prepare("sequence:ACE-ALA-NME")
    assert scene.name == "ACE-ALA-NME"
    assert molecule_key(scene) == molecule_key(ALA2)
    assert match_atoms(scene, ALA2).shape == (22,)
    assert prepare("sequence:ace-ala-nme").positions_nm == pytest.approx(scene.positions_nm)


@pytest.mark.parametrize("text", ["SDFS", "ACE-PRO-HIS-TRP-NME", "ACDEFGHIKLMNPQRSTVWY"])
def test_sequences_are_l_and_trans(text: str) -> None:
    scene = prepare(f"sequence:{text}")
    omega = torsion(scene.positions_nm, backbone_torsions(scene)["omega"])
    assert np.abs(omega).min() > np.radians(160)
    index = {(r, n): i for i, (r, n) in enumerate(zip(scene.residue_of_atom.tolist(), scene.atom_names, strict=True))}
    rows = [
        [index[r, a] for a in ("CA", "N", "C", "CB")] for r in range(len(scene.residue_names)) if (r, "CB") in index
    ]
    assert (signed_volumes(scene.positions_nm, rows) > 0).all()
    side_chain_centres = sum(n in ("THR", "ILE") for n in scene.residue_names)
    assert len(stereocentres(scene)) == len(rows) + side_chain_centres


def test_sequence_protonation_follows_names_and_ph() -> None:
    charge = {
        text: int(prepare(f"sequence:{text}", ph=ph).formal_charges.sum())
        for text, ph in (("ACE-HIP-NME", 7), ("ACE-HIE-NME", 7), ("ACE-GLU-NME", 7), ("ACE-GLH-NME", 7))
    }
    assert charge == {"ACE-HIP-NME": 1, "ACE-HIE-NME": 0, "ACE-GLU-NME": -1, "ACE-GLH-NME": 0}
    assert int(prepare("sequence:ACE-GLU-NME", ph=2).formal_charges.sum()) == 0


def test_sequence_text_is_parsed_or_refused_in_one_line() -> None:
    assert parse_sequence("SDFS") == ["SER", "ASP", "PHE", "SER"]
    assert parse_sequence("ALA") == ["ALA"]
    assert parse_sequence("ace-ALA-nma") == ["ACE", "ALA", "NME"]
    for text, expected in (
        ("ACE-ALX-NME", "unknown residue 'ALX'"),
        ("SDBS", "'B'"),
        ("ALA-ACE-ALA", "alone or inside"),
        ("", "write capitals"),
        ("ACE", "alone or inside"),
        ("A" * 500, "up to 200"),
        ("A", r"a single amino acid; cap it \(ACE-ALA-NME\)"),
        ("ALA--ALA", "unknown residue ''"),
    ):
        with pytest.raises(PreparationError, match=expected) as caught:
            prepare(f"sequence:{text}")
        assert "\n" not in str(caught.value)
    notes = [prepare(f"sequence:{text}").provenance["repairs"] for text in ("AG", "ag")]
    assert [any("read as L-residues" in note for note in some) for some in notes] == [False, True]
