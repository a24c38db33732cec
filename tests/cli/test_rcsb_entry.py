"""A rollout of an NMR entry as the Protein Data Bank serves it: every record, several models, its own names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from command_line import run
from systems.chemistry.graph import molecule_key
from systems.library import named_scenes
from systems.library.named_scenes import prepare

ALA2 = named_scenes.load("alanine-dipeptide")
# The order and the names of the Protein Data Bank: heavy atoms of a residue first.
ORDER = [4, 5, 1, 0, 2, 3, 6, 8, 14, 15, 10, 7, 9, 11, 12, 13, 16, 18, 17, 19, 20, 21]
NAMES = ["C", "O", "CH3", "H1", "H2", "H3", "N", "CA", "C", "O", "CB", "H", "HA", "HB1", "HB2", "HB3",
         "N", "C", "H", "H1", "H2", "H3"]  # fmt: skip
TAIL = """\
CONECT    1    2    3    7
CONECT    3    1    4    5    6
CONECT    9   17
CONECT   17    9   18   19
CONECT   18   17   20   21   22
MASTER      102    0    2    0    0    0    1    6   44    1   10    1
END
"""
HEAD = """\
HEADER    DE NOVO PROTEIN                         22-NOV-26   9XYZ
TITLE     SOLUTION NMR STRUCTURE OF A CAPPED ALANINE
COMPND    MOL_ID: 1;
COMPND   2 MOLECULE: ACE-ALA-NME;
COMPND   3 CHAIN: A;
COMPND   4 ENGINEERED: YES
SOURCE    MOL_ID: 1;
SOURCE   2 SYNTHETIC: YES
KEYWDS    CAPPED PEPTIDE
EXPDTA    SOLUTION NMR
NUMMDL    2
AUTHOR    A.N.ONYMOUS
REVDAT   1   22-NOV-26 9XYZ    0
JRNL        AUTH   A.N.ONYMOUS
REMARK   2
REMARK   2 RESOLUTION. NOT APPLICABLE.
REMARK 465
REMARK 465   M RES C SSSEQI
REMARK 500   1 ALA A   2      -12.34   56.78     1.00000   2.00000   3.00000
DBREF  9XYZ A    1     3  PDB    9XYZ     9XYZ             1      3
SEQRES   1 A    3  ACE ALA NME
HET    ACE  A   1       6
HET    NME  A   3       6
HETNAM     ACE ACETYL GROUP
HETNAM     NME METHYLAMINE
FORMUL   1  ACE    C2 H4 O
FORMUL   1  NME    C H5 N
LINK         C   ACE A   1                 N   ALA A   2     1555   1555  1.33
LINK         C   ALA A   2                 N   NME A   3     1555   1555  1.33
SITE     1 AC1  2 ALA A   2  NME A   3
CRYST1    1.000    1.000    1.000  90.00  90.00  90.00 P 1           1
ORIGX1      1.000000  0.000000  0.000000        0.00000
ORIGX2      0.000000  1.000000  0.000000        0.00000
ORIGX3      0.000000  0.000000  1.000000        0.00000
SCALE1      1.000000  0.000000  0.000000        0.00000
SCALE2      0.000000  1.000000  0.000000        0.00000
SCALE3      0.000000  0.000000  1.000000        0.00000
"""


def _models() -> list[np.ndarray]:
    """Positions `(22, 3)` in Å of two models in the order of the Protein Data Bank."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    x = ALA2.positions_nm[ORDER] * 10
    return [x + 12.0, x @ turn]


def nmr_entry() -> str:
    """The entry as a PDB file, 80 columns wide."""
    lines = HEAD.splitlines()
    residues = [int(ALA2.residue_of_atom[i]) for i in ORDER]
    for number, x in enumerate(_models(), start=1):
        lines.append(f"MODEL     {number:4d}")
        for k, (i, residue) in enumerate(zip(ORDER, residues, strict=True)):
            record = "ATOM  " if residue == 1 else "HETATM"
            place = "".join(f"{value:8.3f}" for value in x[k])
            name = f"{ALA2.residue_names[residue]} A{residue + 1:4d}"
            lines.append(
                f"{record}{k + 1:5d}  {NAMES[k]:<3s} {name}    {place}  1.00  0.00          {ALA2.elements[i]:>2s}"
            )
        lines += [f"TER   {23:5d}      NME A   3", "ENDMDL"]
    return "\n".join(f"{line:<80s}" for line in [*lines, *TAIL.splitlines()]) + "\n"


def test_an_nmr_entry_is_rolled_out_as_downloaded(tmp_path: Path) -> None:
    path, out = tmp_path / "9xyz.pdb", tmp_path / "out.dcd"
    path.write_text(nmr_entry())
    scene = prepare(str(path))
    assert molecule_key(scene) == molecule_key(ALA2)
    assert scene.provenance["repairs"] == ["2 models in the file: the first is taken"]
    assert scene.positions_nm * 10 == pytest.approx(_models()[0], abs=6e-4)
    result = run("rollout", str(path), "--weights", "alanine-dipeptide", "--time", "1ns", "-o", str(out), "--seed", "1")
    assert result.exit_code == 0, result.stderr
    assert "2 models in the file: the first is taken" in result.stderr

    import mdtraj

    trajectory = mdtraj.load(str(out), top=str(tmp_path / "out.pdb"))
    assert [a.name for a in trajectory.topology.atoms] == list(scene.atom_names)
    assert trajectory.n_frames >= 100
    reach = np.linalg.norm(trajectory.xyz[:, scene.bonds[:, 0]] - trajectory.xyz[:, scene.bonds[:, 1]], axis=-1)
    assert np.abs(reach - reach.mean(axis=0)).max() < 0.05


def test_the_same_entry_as_mmcif(tmp_path: Path) -> None:
    import gemmi

    path = tmp_path / "9xyz.cif"
    path.write_text(gemmi.read_pdb_string(nmr_entry()).make_mmcif_document().as_string())
    scene = prepare(str(path))
    assert molecule_key(scene) == molecule_key(ALA2)
    assert scene.provenance["repairs"] == ["2 models in the file: the first is taken"]
    assert scene.positions_nm * 10 == pytest.approx(_models()[0], abs=6e-4)
