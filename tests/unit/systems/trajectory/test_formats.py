"""Trajectories of other programs: every format by MDTraj or MDAnalysis gives the same frames, times and bonds."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest

from systems.chemistry.distance_bonds import bonds_by_distance
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, TrajectoryError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

mdtraj = pytest.importorskip("mdtraj")
mda = pytest.importorskip("MDAnalysis")

N = 12
TIMES = 5.0 + 2.5 * np.arange(N)


@pytest.fixture(scope="module")
def frames(alanine_dipeptide: Scene) -> np.ndarray:
    noise = 0.002 * np.random.default_rng(0).standard_normal((N, 22, 3))
    return np.asarray(alanine_dipeptide.positions_nm + noise, dtype=np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, alanine_dipeptide: Scene, frames: np.ndarray) -> Path:
    """One trajectory in many formats, as MDTraj and MDAnalysis write them."""
    path = tmp_path_factory.mktemp("formats")
    made = mdtraj.Trajectory(frames, alanine_dipeptide.to_mdtraj_topology(), time=TIMES)
    made[0].save_pdb(str(path / "top.pdb"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for suffix in ("xtc", "trr", "nc", "dcd", "pdb", "xyz", "gro", "mdcrd"):
            made.save(str(path / f"a.{suffix}"))
        universe = mda.Universe(str(path / "top.pdb"), str(path / "a.trr"))
        with mda.Writer(str(path / "b.h5md"), n_atoms=22) as writer:
            for _ in universe.trajectory:
                writer.write(universe.atoms)
    with h5py.File(path / "b.h5md") as whole, h5py.File(path / "b.h5", "w") as copy:
        for part in whole:
            whole.copy(part, copy)
    return path


@pytest.mark.parametrize(
    ("name", "accuracy_nm", "has_times"),
    [("a.xtc", 6e-4, True), ("a.trr", 1e-6, True), ("a.nc", 1e-6, True), ("a.dcd", 1e-6, False),
     ("a.pdb", 6e-5, False), ("a.xyz", 6e-5, False), ("a.gro", 6e-4, True), ("a.mdcrd", 6e-5, False),
     ("b.h5md", 1e-6, True), ("b.h5", 1e-6, True)],
)  # fmt: skip
def test_every_format_gives_the_same_frames(
    folder: Path, frames: np.ndarray, alanine_dipeptide: Scene, name: str, accuracy_nm: float, has_times: bool
) -> None:
    with open_trajectory(folder / name, top=folder / "top.pdb") as reader:
        assert reader.read() == pytest.approx(frames, abs=accuracy_nm)
        assert np.array_equal(reader.read(3, 9, 2), reader.read()[3:9:2])
        assert reader.times_known is has_times
        if has_times:
            assert reader.time_ps == pytest.approx(TIMES, abs=1e-4)
        assert reader.scene is not None
        assert reader.scene.elements == alanine_dipeptide.elements
        assert np.array_equal(reader.scene.bonds, alanine_dipeptide.bonds)
        assert reader.scene.positions_nm == pytest.approx(frames[0], abs=max(accuracy_nm, 6e-5))
        assert reader.record == {} and reader.flags is None


def test_an_xyz_file_is_its_own_topology(folder: Path, alanine_dipeptide: Scene) -> None:
    """CA in capitals is an alpha carbon, not calcium; bonds come from distances, orders from valence."""
    with open_trajectory(folder / "a.xyz") as reader:
        assert reader.scene is not None
        assert reader.scene.elements == alanine_dipeptide.elements
        assert np.array_equal(reader.scene.bonds, alanine_dipeptide.bonds)
        assert molecule_key(reader.scene) == molecule_key(alanine_dipeptide)


def test_formats_without_topology_say_so(folder: Path, tmp_path: Path) -> None:
    with open_trajectory(folder / "a.nc") as reader:
        assert reader.scene is None and reader.n_frames == N
    with pytest.raises(TrajectoryError, match=r"a\.mdcrd cannot be read: .*`top"):
        open_trajectory(folder / "a.mdcrd")


def test_an_ase_trajectory(frames: np.ndarray, tmp_path: Path, alanine_dipeptide: Scene) -> None:
    """Positions in Å, no times; the file's elements, bonds by distance. What ase cannot read is refused."""
    ase = pytest.importorskip("ase")
    from ase.io.trajectory import Trajectory

    with Trajectory(str(tmp_path / "x.traj"), "w") as out:
        for x in frames:
            out.write(ase.Atoms(alanine_dipeptide.elements, positions=10.0 * x))
    with open_trajectory(tmp_path / "x.traj") as reader:
        assert reader.read() == pytest.approx(frames, abs=1e-6) and not reader.times_known
        assert np.array_equal(reader.read(3, 9, 2), reader.read()[3:9:2])
        assert reader.read_cells() is None
        assert reader.scene is not None and molecule_key(reader.scene) == molecule_key(alanine_dipeptide)
    (tmp_path / "bad.traj").write_bytes(b"- of Ulm")
    with pytest.raises(TrajectoryError, match=r"bad\.traj cannot be read by ase"):
        open_trajectory(tmp_path / "bad.traj")


def test_an_ase_trajectory_without_ase_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.traj").write_bytes(b"- of Ulm")
    monkeypatch.setitem(sys.modules, "ase.io.trajectory", None)
    with pytest.raises(TrajectoryError, match=r"pip install ase.*ase convert"):
        open_trajectory(tmp_path / "x.traj")


def test_a_topology_of_other_atoms_is_refused(folder: Path, tmp_path: Path) -> None:
    smaller = mdtraj.load(str(folder / "top.pdb"))
    smaller.atom_slice(range(10)).save_pdb(str(tmp_path / "small.pdb"))
    for name in ("a.xtc", "a.dcd", "b.h5md"):
        with pytest.raises(InputError, match=r"small\.pdb has 10 atoms"):
            open_trajectory(folder / name, top=tmp_path / "small.pdb")


def test_bonds_by_distance() -> None:
    water_and_argon = np.array([[0, 0, 0], [0.096, 0, 0], [-0.024, 0.093, 0], [0.4, 0, 0]])
    assert bonds_by_distance(["O", "H", "H", "Ar"], water_and_argon).tolist() == [[0, 1], [0, 2]]
    close_hydrogens = np.array([[0, 0, 0], [0.07, 0, 0], [0.15, 0, 0]])
    assert bonds_by_distance(["C", "H", "C"], close_hydrogens).tolist() == [[0, 1], [0, 2]], "H belongs to the nearest"


def test_cells_are_read(tmp_path: Path, alanine_dipeptide: Scene, frames: np.ndarray) -> None:
    box = np.array([[3.0, 0, 0], [0.0, 2.0, 0], [0.5, 0.3, 4.0]])
    made = mdtraj.Trajectory(frames, alanine_dipeptide.to_mdtraj_topology(), time=TIMES)
    made.unitcell_vectors = np.repeat(box[None], N, axis=0)
    for suffix in ("xtc", "nc"):
        path = tmp_path / f"c.{suffix}"
        made.save(str(path))
        with open_trajectory(path) as reader:
            cells = reader.read_cells(2, 8, 3)
            assert cells is not None and cells == pytest.approx(np.repeat(box[None], 2, axis=0), abs=2e-4)


def test_a_psf_is_a_topology(shared_data: Path) -> None:
    """CHARMM's adenylate kinase: 3,341 atoms, bonds from the PSF, positions from the first frame."""
    adk = shared_data / "adk"
    with open_trajectory(adk / "adk_dims.dcd", top=adk / "adk.psf") as reader:
        assert reader.scene is not None
        universe = mda.Universe(str(adk / "adk.psf"), str(adk / "adk_dims.dcd"))
        assert len(reader.scene.bonds) == len(universe.bonds)
        assert reader.scene.positions_nm == pytest.approx(0.1 * universe.atoms.positions, abs=1e-5)
        assert reader.times_known and reader.time_ps[1] - reader.time_ps[0] == pytest.approx(1.0, rel=1e-4)
