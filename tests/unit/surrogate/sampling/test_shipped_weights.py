"""Shipped weights roll what they cover, and say what they do not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from command_line import run
from md_reference.forces.quantum import Potential
from surrogate.models.architecture import weights_path
from surrogate.sampling.simulation import LearnedForces
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.prepare.molecule import scene_from_smiles
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory


# In another order than the weights have.
@pytest.mark.parametrize(
    ("name", "smiles"),
    [("paracetamol-gfn2-xtb", "OC1=CC=C(NC(C)=O)C=C1"), ("alanine-dipeptide-gfn2-xtb", "CNC(=O)[C@H](C)NC(C)=O")],
)
def test_the_potential_has_the_forces_of_its_reference(name: str, smiles: str) -> None:
    pytest.importorskip("tblite")
    path = weights_path(name)
    assert path.stat().st_size < 2e6
    scene = scene_from_smiles(smiles)
    reference, learned = Potential(scene), LearnedForces(scene, path)
    rng, wrong, size = np.random.default_rng(0), [], []
    for _ in range(4):
        x = scene.positions_nm + 0.003 * rng.normal(size=scene.positions_nm.shape)
        forces = reference(x)[1]
        wrong.append(np.abs(learned(x)[1] - forces).mean())
        size.append(np.abs(forces).mean())
    # 8 and 9 kJ/mol/nm on MD at 300 K, 18 and 16 at 700 K (their cards).
    assert np.mean(wrong) < 60.0 < 0.1 * np.mean(size)


# Unseen pairs, each with the names and the order of atoms that one program writes.
CHARMM = {"H": "HN", "HB2": "HB1", "HB3": "HB2", "HG2": "HG1", "HG3": "HG2"}
CAPS = {
    "ACE": {"CH3": "CAY", "C": "CY", "O": "OY", "HH31": "HY1", "HH32": "HY2", "HH33": "HY3",
            "H1": "HY1", "H2": "HY2", "H3": "HY3"},
    "NME": {"N": "NT", "H": "HNT", "CH3": "CAT", "C": "CAT", "HH31": "HT1", "HH32": "HT2", "HH33": "HT3",
            "H1": "HT1", "H2": "HT2", "H3": "HT3"},
}  # fmt: skip
GROMACS = {"HB2": "HB1", "HB3": "HB2", "HG2": "HG1", "HG3": "HG2"}


def _charmm(residue: str, name: str) -> str:
    if residue in CAPS:
        return CAPS[residue][name]
    return "HG1" if (residue, name) == ("SER", "HG") else CHARMM.get(name, name)


def _gromacs(residue: str, name: str) -> str:
    return name if residue in CAPS or residue == "VAL" else GROMACS.get(name, name)


def _amber(residue: str, name: str) -> str:
    return name


def _free(named: Callable[[str, str], str], *ends: str) -> Callable[[str, str], str]:
    """The names that a program gives the hydrogens of LEU's ammonium and the oxygens of SER's carboxylate."""
    own = dict(zip([("LEU", "H"), ("LEU", "H2"), ("LEU", "H3"), ("SER", "O"), ("SER", "OXT")], ends, strict=True))
    return lambda residue, name: own.get((residue, name)) or named(residue, name)


def _pdb(scene: Scene, named: Callable[[str, str], str], *, capped_into: bool, hydrogens_last: bool) -> str:
    """`capped_into`: caps stand in their neighbours, as CHARMM has them; `hydrogens_last`: behind each residue's heavy
    atoms."""
    lines = []
    n = len(scene.residue_names)
    order = range(scene.n_atoms)
    if hydrogens_last:
        order = sorted(order, key=lambda i: (scene.residue_of_atom[i], scene.elements[i] == "H"))
    for serial, i in enumerate(order, 1):
        r = int(scene.residue_of_atom[i])
        name = named(scene.residue_names[r], scene.atom_names[i])
        written = min(max(r, 1), n - 2) if capped_into else r
        x, y, z = scene.positions_nm[i] * 10
        padded = name if len(name) == 4 else f" {name:<3s}"
        lines.append(
            f"ATOM  {serial:5d} {padded} {scene.residue_names[written]:>3s} A{written + 1:4d}    "
            f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00"
        )
    return "\n".join([*lines, "END", ""])


@pytest.mark.parametrize(
    ("sequence", "named", "capped_into", "hydrogens_last"),
    [
        ("ACE-LEU-SER-NME", _charmm, True, False),
        ("ACE-VAL-ASN-NME", _gromacs, False, True),
        ("ACE-PHE-GLY-NME", _amber, False, False),
        ("LEU-SER", _free(_charmm, "HT1", "HT2", "HT3", "OT1", "OT2"), False, False),
        ("LEU-SER", _free(_gromacs, "H1", "H2", "H3", "O1", "O2"), False, True),
    ],
)
def test_files_of_other_programs_roll_without_naming_weights(
    tmp_path: Path, sequence: str, named: Callable[[str, str], str], capped_into: bool, hydrogens_last: bool
) -> None:
    scene = build_peptide(sequence)
    path, out = tmp_path / "theirs.pdb", tmp_path / "out.h5"
    path.write_text(_pdb(scene, named, capped_into=capped_into, hydrogens_last=hydrogens_last))
    result = run("rollout", str(path), "--time", "3.2ns", "--save-every", "100ps", "-o", str(out))
    assert result.exit_code == 0, result.stderr
    said = " ".join((result.stdout + result.stderr).split())
    assert "peptides" in said and "not in their training set" in said
    with open_trajectory(out) as reader:
        assert reader.scene is not None and reader.n_frames == 32
        phi = torsion(reader.read().astype(np.float64), backbone_torsions(reader.scene)["phi"])
    moved = np.abs(np.angle(np.exp(1j * np.diff(phi, axis=0))))
    assert (moved.mean(axis=0) > 0.1).all(), "frames 100 ps apart are not one another's copies"


def test_alanine_dipeptide_keeps_the_weights_that_were_trained_on_it_alone() -> None:
    assert "alanine-dipeptide" in run("info", "alanine-dipeptide").stdout
    result = run("info", "peptides", "sequence:ACE-LEU-SER-NME")
    assert result.exit_code == 0
    assert "LEU" in result.stdout
