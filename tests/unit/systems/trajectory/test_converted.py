"""Trajectories as MDTraj and MDAnalysis objects, equal to what these libraries read from the files."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from systems.errors import InputError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import (
    frame_weights,
    open_trajectory,
    open_writer,
    to_mdanalysis,
    to_mdtraj,
    write_weights,
)
from systems.trajectory.companion_writer import pdb_text


def write(path: Path, scene: Scene, times: np.ndarray) -> np.ndarray:
    """Write random frames and return them, `(n, n_atoms, 3)` nm."""
    frames = scene.positions_nm + np.random.default_rng(1).normal(scale=0.01, size=(len(times), scene.n_atoms, 3))
    with open_writer(path, scene, {}) as writer:
        writer.append(frames, times)
    return frames.astype(np.float32)


def test_objects_equal_what_the_libraries_read(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    import MDAnalysis
    import mdtraj

    path, times = tmp_path / "a.h5", 5.0 + 0.5 * np.arange(12)
    frames = write(path, alanine_dipeptide, times)
    ours, theirs = to_mdtraj(path), mdtraj.load(str(path))
    assert np.array_equal(ours.xyz, theirs.xyz) and np.array_equal(ours.time, times)
    for one, two in zip(ours.topology.atoms, theirs.topology.atoms, strict=True):
        assert (one.name, one.element, str(one.residue)) == (two.name, two.element, str(two.residue))
    pairs = [[(b.atom1.index, b.atom2.index, b.order) for b in t.topology.bonds] for t in (ours, theirs)]
    assert pairs[0] == pairs[1]
    assert ours.topology.n_bonds == 21 and ours.unitcell_lengths is None
    phi = mdtraj.compute_phi(ours)[1]
    np.testing.assert_array_equal(phi, mdtraj.compute_phi(theirs)[1])
    universe = to_mdanalysis(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other = MDAnalysis.Universe(str(write_pdb(tmp_path, alanine_dipeptide)), str(path), format="H5MD")
    assert [ts.time for ts in universe.trajectory] == pytest.approx(times.tolist(), abs=1e-9)
    for one, two, frame in zip(universe.trajectory, other.trajectory, frames, strict=True):
        np.testing.assert_allclose(one.positions, two.positions, rtol=0, atol=2e-6)
        np.testing.assert_allclose(one.positions, frame * 10.0, rtol=0, atol=2e-6)
    assert list(universe.atoms.names) == list(alanine_dipeptide.atom_names)
    assert list(universe.residues.resnames) == ["ACE", "ALA", "NME"]
    assert universe.atoms.masses == pytest.approx(alanine_dipeptide.masses_da)
    assert {tuple(sorted(b.indices)) for b in universe.bonds} == {tuple(b) for b in alanine_dipeptide.bonds.tolist()}
    assert universe.select_atoms("resname ALA and name CA").n_atoms == 1


def write_pdb(folder: Path, scene: Scene) -> Path:
    path = folder / "top.pdb"
    path.write_text(pdb_text(scene))
    return path


def test_ranges_and_open_readers(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    path = tmp_path / "a.dcd"
    frames = write(path, alanine_dipeptide, np.arange(1.0, 11.0))
    with open_trajectory(path) as reader:
        part = to_mdtraj(reader, start=2, stop=9, stride=3)
        assert np.array_equal(part.time, [3.0, 6.0, 9.0])
        np.testing.assert_allclose(part.xyz, frames[2:9:3], rtol=0, atol=2e-7)
        assert to_mdanalysis(reader, start=-4).trajectory[0].time == 7.0
    assert not np.array_equal(part.xyz[0], frames[3])


def test_a_cell_comes_along(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    cell = np.array([[3.0, 0.0, 0.0], [0.0, 3.5, 0.0], [1.0, 0.0, 4.0]])
    path = tmp_path / "a.h5"
    write(path, replace(alanine_dipeptide, cell_nm=cell), np.arange(1.0, 4.0))
    np.testing.assert_allclose(to_mdtraj(path).unitcell_vectors[1], cell, atol=1e-5)
    dimensions = to_mdanalysis(path).trajectory[1].dimensions
    np.testing.assert_allclose(dimensions[:3], [30.0, 35.0, np.sqrt(17.0) * 10.0], rtol=1e-6)
    assert dimensions[4] == pytest.approx(np.degrees(np.arctan2(4.0, 1.0)), rel=1e-6)


def test_uneven_times_are_refused_where_they_would_be_lost(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    path = tmp_path / "a.h5"
    write(path, alanine_dipeptide, np.array([1.0, 2.0, 4.0]))
    assert np.array_equal(to_mdtraj(path).time, [1.0, 2.0, 4.0])
    with pytest.raises(InputError, match="unevenly spaced"):
        to_mdanalysis(path)
    assert to_mdanalysis(path, stop=2).trajectory.n_frames == 2
    for step_ps, start_ps in ((0.1, 0.0), (2.0, 1e5), (0.7, 3e4)):  # as float32 has them, in other programs' files
        other = tmp_path / f"{step_ps}.h5"
        times = (start_ps + step_ps * np.arange(50)).astype(np.float32).astype(np.float64)
        write(other, alanine_dipeptide, times)
        assert to_mdanalysis(other).trajectory.dt == pytest.approx(step_ps, rel=1e-3)
    with pytest.raises(TrajectoryError):
        to_mdtraj(tmp_path / "none.h5")


@pytest.mark.parametrize("suffix", ["h5", "dcd"])
def test_weights_are_read_by_one_call(tmp_path: Path, alanine_dipeptide: Scene, suffix: str) -> None:
    import mdtraj

    path = tmp_path / f"a.{suffix}"
    write(path, alanine_dipeptide, 1.0 + np.arange(6))
    assert frame_weights(path).tolist() == [1.0] * 6
    for weights in (np.array([0.0, 1, 2, 1, 1, 1]), np.array([1.0, 0, 2, 1, 2, 0])):
        write_weights(path, weights)
        assert frame_weights(path).tolist() == weights.tolist()
    with pytest.raises(InputError, match="do not fit"):
        write_weights(path, np.ones(5))
    # Other readers, and ours, read on as before.
    assert to_mdtraj(path).n_frames == 6
    if suffix == "h5":
        assert mdtraj.load(str(path)).n_frames == 6
    with open_writer(path, alanine_dipeptide, {}, append=True) as writer:
        writer.append(alanine_dipeptide.positions_nm[None], np.array([7.0]))
    with pytest.raises(TrajectoryError, match="has grown"):
        frame_weights(path)
