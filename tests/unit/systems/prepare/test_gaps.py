"""A chain that breaks: refused, or closed at both ends with caps that look as caps do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.geometry import torsion
from systems.chemistry.graph import backbone_torsions
from systems.errors import PreparationError
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.companion_writer import pdb_text


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
