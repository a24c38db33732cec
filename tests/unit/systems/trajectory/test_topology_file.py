"""NAME.pdb beside every trajectory: the order of its own atoms, never another program's file, never in the way."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.verbs.inputs import check_outputs
from systems.errors import SimulationError, TrajectoryError
from systems.library.named_scenes import prepare
from systems.scene import Scene, reordered
from systems.trajectory.checkpoint import locked_outputs
from systems.trajectory.codec import WRITTEN, open_trajectory, open_writer
from systems.trajectory.companion_writer import pdb_text

SUFFIXES = (".h5", ".dcd")


def write(path: Path, scene: Scene, n: int = 3, **keywords: bool) -> np.ndarray:
    frames = (scene.positions_nm + 0.01 * np.arange(1, n + 1)[:, None, None]).astype(np.float32)
    with open_writer(path, scene, {}, **keywords) as writer:
        first = writer.n_frames
        writer.append(frames, first + np.arange(1.0, n + 1))
    return frames


def longest_bond_angstrom(path: Path, top: Path) -> float:
    """As MDAnalysis sees it, with the bonds of the PDB file."""
    import MDAnalysis

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        how = {} if path.suffix == ".dcd" else {"format": "H5MD"}
        universe = MDAnalysis.Universe(str(top), str(path), **how)
        return float(universe.bonds.values().max())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_pdb_beside_a_trajectory_has_its_order(tmp_path: Path, alanine_dipeptide: Scene, suffix: str) -> None:
    """The line of the quickstart; and the negative control: the PDB of another trajectory shows bonds of many Å."""
    shuffled = reordered(alanine_dipeptide, np.random.default_rng(0).permutation(alanine_dipeptide.n_atoms))
    write(tmp_path / f"ref{suffix}", alanine_dipeptide)
    write(tmp_path / f"out{suffix}", shuffled)
    for name in ("ref", "out"):
        assert longest_bond_angstrom(tmp_path / f"{name}{suffix}", tmp_path / f"{name}.pdb") < 1.6
    assert longest_bond_angstrom(tmp_path / f"ref{suffix}", tmp_path / "out.pdb") > 4.0


def test_the_pdb_of_another_molecule_is_not_replaced(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    write(tmp_path / "a.h5", alanine_dipeptide)
    before = (tmp_path / "a.pdb").read_bytes()
    with pytest.raises(TrajectoryError, match=r"a\.pdb is the topology of a\.h5, of other atoms"):
        write(tmp_path / "a.xtc", prepare("smiles:CCO"))
    assert (tmp_path / "a.pdb").read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == [
        "a.h5",
        "a.pdb",
    ]
    moved = alanine_dipeptide.with_positions(alanine_dipeptide.positions_nm + 0.1)
    write(tmp_path / "a.xtc", moved)
    write(tmp_path / "b.h5", prepare("smiles:CCO"))
    write(tmp_path / "b.h5", alanine_dipeptide, overwrite=True)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_another_program_s_pdb_is_never_replaced(tmp_path: Path, alanine_dipeptide: Scene, suffix: str) -> None:
    path, pdb = tmp_path / f"mine{suffix}", tmp_path / "mine.pdb"
    pdb.write_text(pdb_text(alanine_dipeptide).replace("surromd", "something"))
    before = pdb.read_bytes()
    for overwrite in (False, True):
        with pytest.raises(TrajectoryError, match=r"mine\.pdb is not ours"):
            write(path, alanine_dipeptide, overwrite=overwrite)
        with pytest.raises(TrajectoryError, match=r"mine\.pdb is not ours"):
            check_outputs([path], WRITTEN, overwrite=overwrite)
    assert pdb.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["mine.pdb"]


def test_files_without_a_pdb_are_read_and_gone_on_with(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    """Those of earlier versions: nothing needs it, and it is made when they are written to."""
    path, pdb = tmp_path / "old.h5", tmp_path / "old.pdb"
    frames = write(path, alanine_dipeptide)
    pdb.unlink()
    with open_trajectory(path) as reader:
        assert reader.scene is not None and np.array_equal(reader.read(), frames)
    assert not pdb.exists()
    pdb.write_text("another's")
    write(path, alanine_dipeptide, append=True)
    assert pdb.read_text() == "another's"
    pdb.unlink()
    write(path, alanine_dipeptide, append=True)
    assert pdb.read_text() == pdb_text(alanine_dipeptide)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_run_that_fails_before_its_first_frame_leaves_nothing(
    tmp_path: Path, alanine_dipeptide: Scene, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"
    with pytest.raises(SimulationError), locked_outputs([path], may_exist=False):
        with open_writer(path, alanine_dipeptide, {}, locked=True):
            assert (tmp_path / "a.pdb").exists()
        raise SimulationError("no frame")
    assert list(tmp_path.iterdir()) == []


def test_more_atoms_than_the_format_holds_have_none(tmp_path: Path) -> None:
    n = 100_000
    scene = Scene(
        name="many", atom_names=("AR",) * n, elements=("Ar",) * n, residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=("ARG",), residue_ids=("1",), chain_of_residue=("A",), bonds=np.empty((0, 2), dtype=np.int64),
        bond_orders=np.empty(0), positions_nm=np.zeros((n, 3)), masses_da=np.ones(n),
        formal_charges=np.zeros(n, dtype=np.int64), provenance={},
    )  # fmt: skip
    write(tmp_path / "many.h5", scene, n=1)
    assert [p.name for p in tmp_path.iterdir()] == ["many.h5"]


def test_a_scene_far_from_the_origin_fits_its_columns(alanine_dipeptide: Scene) -> None:
    far = replace(alanine_dipeptide, positions_nm=alanine_dipeptide.positions_nm + 5000.0)
    lines = [line for line in pdb_text(far).splitlines() if line.startswith("ATOM")]
    found = np.array([[float(line[at : at + 8]) for at in (30, 38, 46)] for line in lines])
    centred = 10.0 * (alanine_dipeptide.positions_nm - alanine_dipeptide.positions_nm.mean(axis=0))
    np.testing.assert_allclose(found, centred, atol=2e-3)
