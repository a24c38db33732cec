"""Added side chains that overlap are built again in another rotamer, or refused where none has room."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.geometry import superposition, torsion
from systems.chemistry.residues import ONE_LETTER, template_for
from systems.errors import PreparationError
from systems.library.named_scenes import prepare
from systems.prepare import repair
from systems.prepare.repair import _conformers, _tree, residue_shape, resolve_side_chains


@pytest.mark.parametrize("name", [n for n in ONE_LETTER.values() if n not in ("GLY", "ALA", "PRO")])
def test_every_conformer_has_the_template_s_bonds_and_torsions_at_rotamers(name: str) -> None:
    shape, moved, template = residue_shape(name), list(_tree(name)), template_for(name)
    assert template is not None
    found = _conformers(name, {a: x for a, x in shape.items() if a not in moved}, moved)
    assert len(found) >= 3 and len({tuple(np.round(np.ravel(list(c.values())), 4)) for c in found}) == len(found)
    for conformer in found:
        at = {**shape, **conformer}
        for a, b in template.bonds:
            assert np.linalg.norm(at[a] - at[b]) == pytest.approx(np.linalg.norm(shape[a] - shape[b]), abs=1e-6)
        first = np.degrees(torsion(np.array([at[k] for k in ("N", "CA", "CB", moved[0])]), [[0, 1, 2, 3]])[0])
        assert min(abs(first - x) for x in (-180, -60, 60, 180)) == pytest.approx(0, abs=0.01) or name in (
            "ASP", "ASN", "PHE", "TYR", "TRP", "HIS")  # fmt: skip


def _lysine(walls: np.ndarray) -> tuple[np.ndarray, list[str], list[tuple[int, int]], dict[str, int]]:
    """A lysine whose side chain was added, and lone carbons (nm) around it."""
    shape, template = residue_shape("LYS"), template_for("LYS")
    assert template is not None
    sites = {a: k for k, a in enumerate(template.heavy)}
    positions = np.array([*(shape[a] for a in template.heavy), *walls])
    return positions, [a[0] for a in template.heavy] + ["C"] * len(walls), [
        (sites[a], sites[b]) for a, b in template.bonds], sites  # fmt: skip


ADDED = ["CG", "CD", "CE", "NZ"]


def test_an_added_side_chain_that_stands_in_another_atom_takes_another_rotamer() -> None:
    shape = residue_shape("LYS")
    x, elements, bonds, sites = _lysine(np.array([shape["CE"] + [0.05, 0.1, 0.0]]))
    before = x.copy()
    notes = resolve_side_chains(x, elements, bonds, [("LYS A1", "LYS", sites, ADDED)])
    assert notes == ["LYS A1: CG CD CE NZ overlapped and were built again in the rotamer with most room"]
    kept = [i for a, i in sites.items() if a not in ADDED] + [9]
    np.testing.assert_array_equal(x[kept], before[kept])
    assert np.linalg.norm(x[[sites[a] for a in ADDED]] - x[9], axis=1).min() > 0.29
    for a, b in bonds:
        assert np.linalg.norm(x[a] - x[b]) == pytest.approx(np.linalg.norm(before[a] - before[b]), abs=1e-6)


def test_bonds_of_2_67_angstrom_are_built_again() -> None:
    """PDBFixer's way out of an overlap; nothing else is in the way."""
    x, elements, bonds, sites = _lysine(np.empty((0, 3)))
    x[sites["NZ"]] += (x[sites["NZ"]] - x[sites["CE"]]) * (2.67 / 1.49 - 1.0)
    assert resolve_side_chains(x, elements, bonds, [("LYS A1", "LYS", sites, ADDED)])
    assert np.linalg.norm(x[sites["NZ"]] - x[sites["CE"]]) == pytest.approx(0.149, abs=2e-3)


def test_where_there_is_room_nothing_is_touched_and_where_there_is_none_it_is_refused() -> None:
    """Negative controls: a wall of carbons on a grid of 2 Å leaves no rotamer."""
    shape = residue_shape("LYS")
    x, elements, bonds, sites = _lysine(np.array([shape["CE"] + [3.0, 0.0, 0.0]]))
    before = x.copy()
    assert resolve_side_chains(x, elements, bonds, [("LYS A1", "LYS", sites, ADDED)]) == []
    np.testing.assert_array_equal(x, before)
    grid = np.stack(np.meshgrid(*[np.arange(-0.8, 0.81, 0.2)] * 3), axis=-1).reshape(-1, 3) + shape["CB"]
    there = np.array([shape[a] for a in ("N", "CA", "C", "O", "CB")])
    wall = grid[np.linalg.norm(grid[:, None] - there, axis=2).min(axis=1) > 0.2]
    x, elements, bonds, sites = _lysine(wall)
    with pytest.raises(PreparationError, match=r"LYS A1: CG CD CE NZ, .* in every rotamer"):
        resolve_side_chains(x, elements, bonds, [("LYS A1", "LYS", sites, ADDED)])


def test_what_the_file_has_of_a_side_chain_stays() -> None:
    """CG is there: chi1 is the file's, and only what lies beyond is turned."""
    shape = residue_shape("LYS")
    found = _conformers("LYS", {a: x for a, x in shape.items() if a not in ADDED[1:]}, ADDED[1:])
    assert len(found) == 27
    assert _conformers("PRO", {a: x for a, x in residue_shape("PRO").items() if a != "CG"}, ["CG"]) == []


def _chain(scene: object, chain: str, x_nm: np.ndarray, keep: object) -> str:
    from systems.scene import Scene

    assert isinstance(scene, Scene) and callable(keep)
    out = ""
    for i, name in enumerate(scene.atom_names):
        residue = scene.residue_names[int(scene.residue_of_atom[i])]
        if scene.elements[i] != "H" and keep(residue, name):
            x, y, z = 10.0 * x_nm[i]
            out += f"ATOM  {i + 1:5d}  {name:<3s} {residue:>3s} {chain}{int(scene.residue_of_atom[i]) + 1:4d}    "
            out += f"{x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00          {scene.elements[i]:>2s}\n"
    return out + "TER\n"


def test_a_file_with_a_neighbour_where_the_side_chain_would_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lysine, alanine = prepare("sequence:ACE-LYS-NME"), prepare("sequence:ACE-ALA-NME")
    backbone = {"N", "CA", "C", "O", "CB", "CH3"}
    text = _chain(lysine, "A", lysine.positions_nm, lambda r, a: a in backbone)
    (tmp_path / "alone.pdb").write_text(text + "END\n")
    alone = prepare(str(tmp_path / "alone.pdb"))
    put = {n: alone.positions_nm[i] for i, n in enumerate(alone.atom_names)}
    # The neighbour's methyl carbon 1.2 Å beyond CE, the rest of it pointing away from the lysine.
    away = (put["CE"] - put["CB"]) / np.linalg.norm(put["CE"] - put["CB"])
    at = alanine.positions_nm
    cb, ca = (at[list(alanine.atom_names).index(a)] for a in ("CB", "CA"))
    side = np.cross(away, [0.3, 0.5, 0.8])
    here = np.array([[cb, ca, cb + np.cross(ca - cb, [0.0, 0.1, 0.2])]])
    turn, _ = superposition(here - cb, np.array([np.zeros(3), 0.15 * away, 0.05 * side]))
    moved = (at - cb) @ np.asarray(turn[0]).T + put["CE"] + 0.12 * away
    (tmp_path / "both.pdb").write_text(text + _chain(alanine, "B", moved, lambda r, a: True) + "END\n")

    def nearest() -> tuple[float, str]:
        scene = prepare(str(tmp_path / "both.pdb"))
        heavy = [i for i in scene.heavy_idx.tolist() if scene.residue_of_atom[i] == 1]
        others = [i for i in scene.heavy_idx.tolist() if scene.residue_of_atom[i] > 2]
        gaps = np.linalg.norm(scene.positions_nm[heavy][:, None] - scene.positions_nm[others], axis=2)
        return float(gaps.min()), " | ".join(scene.provenance["repairs"])

    gap, notes = nearest()
    monkeypatch.setattr(repair, "_without_overlaps", lambda *_: [])
    before, unsaid = nearest()
    assert gap > 0.28 and "built again in the rotamer" in notes
    assert before < 0.25 and "rotamer" not in unsaid
