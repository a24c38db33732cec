"""Velocities, forces and the cell of each frame: stored once, read by us, by MDTraj and by MDAnalysis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from systems.chemistry.distance_bonds import box_vectors, lengths_and_angles
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.companion_writer import pdb_text

N = 5
# A truncated octahedron's kind of cell: three lengths, three angles, all different.
LENGTHS, ANGLES = np.array([3.0, 3.5, 4.0]), np.array([70.0, 80.0, 100.0])


@pytest.fixture
def frames(alanine_dipeptide: Scene) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    shape = (N, alanine_dipeptide.n_atoms, 3)
    cell = box_vectors(LENGTHS * (1.0 + 0.01 * np.arange(N))[:, None], np.tile(ANGLES, (N, 1)))
    return {
        "positions": rng.normal(size=shape).astype(np.float32),
        "velocities": rng.normal(size=shape).astype(np.float32),
        "forces": (100 * rng.normal(size=shape)).astype(np.float32),
        "cell": cell,
        "time": 0.5 * (1 + np.arange(N)),
    }


@pytest.fixture
def periodic(alanine_dipeptide: Scene) -> Scene:
    return replace(alanine_dipeptide, cell_nm=box_vectors(LENGTHS[None], ANGLES[None])[0])


def test_box_vectors_are_reduced_and_come_back() -> None:
    cell = box_vectors(LENGTHS[None], ANGLES[None])
    lengths, angles = lengths_and_angles(cell)
    np.testing.assert_allclose(lengths[0], LENGTHS, rtol=1e-14)
    np.testing.assert_allclose(angles[0], ANGLES, rtol=1e-12)
    assert cell[0, 0, 1] == cell[0, 0, 2] == cell[0, 1, 2] == 0.0
    ca, cb, cg = np.cos(np.radians(ANGLES))
    volume = LENGTHS.prod() * np.sqrt(1 - ca**2 - cb**2 - cg**2 + 2 * ca * cb * cg)
    assert np.linalg.det(cell[0]) == pytest.approx(volume, rel=1e-12)
    # Angles in another order are another cell of the same volume.
    assert np.abs(box_vectors(LENGTHS[None], ANGLES[None, ::-1]) - cell).max() > 0.1


def write(path: Path, scene: Scene, frames: dict[str, np.ndarray], columns: tuple[str, ...] = ()) -> Path:
    with open_writer(path, scene, {"timestep_ps": 0.004, "save_every_ps": 0.5}, columns=columns) as writer:
        for part in (slice(0, 2), slice(2, N)):
            writer.append(
                frames["positions"][part],
                frames["time"][part],
                velocities_nm_ps=frames["velocities"][part] if "velocities" in columns else None,
                forces_kj_mol_nm=frames["forces"][part] if "forces" in columns else None,
                cell_nm=frames["cell"][part] if scene.cell_nm is not None else None,
            )
    return path


def test_every_reader_sees_the_same(periodic: Scene, frames: dict[str, np.ndarray], tmp_path: Path) -> None:
    import MDAnalysis
    import mdtraj

    path = write(tmp_path / "a.h5", periodic, frames, ("velocities", "forces"))
    with open_trajectory(path) as reader:
        np.testing.assert_array_equal(reader.read_velocities(), frames["velocities"])
        np.testing.assert_array_equal(reader.read_velocities(-2, None), frames["velocities"][-2:])
        np.testing.assert_array_equal(reader.read_forces(1, None, 2), frames["forces"][1::2])
        np.testing.assert_array_equal(reader.read_cells(), frames["cell"])
    with mdtraj.formats.HDF5TrajectoryFile(str(path)) as handle:
        read = handle.read()
    np.testing.assert_array_equal(read.velocities, frames["velocities"])
    trajectory = mdtraj.load(str(path))
    np.testing.assert_allclose(trajectory.unitcell_lengths, lengths_and_angles(frames["cell"])[0], rtol=1e-6)
    np.testing.assert_allclose(trajectory.unitcell_angles, np.tile(ANGLES, (N, 1)), rtol=1e-6)
    np.testing.assert_allclose(trajectory.unitcell_vectors, frames["cell"], atol=2e-6)
    scene_pdb = tmp_path / "a.pdb"
    scene_pdb.write_text(pdb_text(periodic))
    universe = MDAnalysis.Universe(str(scene_pdb), str(path), format="H5MD")
    for k, ts in enumerate(universe.trajectory):
        # Å, Å/ps and kJ/mol/Å
        np.testing.assert_allclose(ts.velocities, 10 * frames["velocities"][k], rtol=1e-6)
        np.testing.assert_allclose(ts.forces, 0.1 * frames["forces"][k], rtol=1e-6)
        np.testing.assert_allclose(ts.triclinic_dimensions, 10 * frames["cell"][k], atol=2e-4)
    universe.trajectory.close()


def test_links_take_no_space(alanine_dipeptide: Scene, frames: dict[str, np.ndarray], tmp_path: Path) -> None:
    path = write(tmp_path / "a.h5", alanine_dipeptide, frames, ("velocities",))
    with h5py.File(path) as file:
        assert file["velocities"] == file["particles/trajectory/velocity/value"]
        assert file["time"] == file["particles/trajectory/velocity/time"]
        assert "forces" not in file and "cell_lengths" not in file
        assert file["particles/trajectory/box"].attrs["boundary"].tolist() == [b"none"] * 3
    with open_trajectory(path) as reader:
        assert reader.read_forces() is None
        assert reader.read_cells() is None


def test_a_file_has_a_column_for_all_frames_or_none(
    alanine_dipeptide: Scene, periodic: Scene, frames: dict[str, np.ndarray], tmp_path: Path
) -> None:
    more = frames["positions"][:1], [9.0]
    path = write(tmp_path / "a.h5", alanine_dipeptide, frames, ("velocities",))
    with open_writer(path, alanine_dipeptide, {}, append=True) as writer:
        with pytest.raises(InputError, match="holds velocities"):
            writer.append(*more)
        with pytest.raises(InputError, match="velocities have shape"):
            writer.append(*more, velocities_nm_ps=frames["velocities"])
        with pytest.raises(InputError, match="no periodic cell"):
            writer.append(*more, velocities_nm_ps=frames["velocities"][:1], cell_nm=frames["cell"][:1])
        writer.truncate(1)
        assert writer.n_frames == 1
        writer.append(*more, velocities_nm_ps=frames["velocities"][2:3])
    with open_trajectory(path) as reader:
        np.testing.assert_array_equal(reader.read_velocities(), frames["velocities"][[0, 2]])
    bare = write(tmp_path / "b.h5", alanine_dipeptide, frames)
    with (
        open_writer(bare, alanine_dipeptide, {}, append=True) as writer,
        pytest.raises(InputError, match="started without forces"),
    ):
        writer.append(*more, forces_kj_mol_nm=frames["forces"][:1])
    with pytest.raises(InputError, match="no column 'charges'"):
        open_writer(tmp_path / "c.h5", alanine_dipeptide, {}, columns=["charges"])
    with pytest.raises(InputError, match=r"write an \.h5"):
        open_writer(tmp_path / "c.dcd", alanine_dipeptide, {}, columns=["velocities"])
    own = tmp_path / "own.h5"
    with open_writer(own, periodic, {}) as writer:
        writer.append(frames["positions"], frames["time"])
        with pytest.raises(InputError, match="with a volume"):
            writer.append(*more, cell_nm=np.zeros((1, 3, 3)))
    with open_trajectory(own) as reader:
        np.testing.assert_array_equal(reader.read_cells(), np.tile(periodic.cell_nm, (N, 1, 1)))


def test_a_dcd_carries_the_cell(periodic: Scene, frames: dict[str, np.ndarray], tmp_path: Path) -> None:
    import MDAnalysis
    import mdtraj

    path = write(tmp_path / "a.dcd", periodic, frames)
    with open_writer(path, periodic, {}, append=True) as writer:
        writer.truncate(4)
    with open_trajectory(path) as reader:
        np.testing.assert_allclose(reader.read_cells(), frames["cell"][:4], atol=1e-12)
        np.testing.assert_allclose(reader.read(), frames["positions"][:4], rtol=1e-6)
    trajectory = mdtraj.load(str(path), top=str(path.with_suffix(".pdb")))
    np.testing.assert_allclose(trajectory.unitcell_vectors, frames["cell"][:4], atol=2e-6)
    np.testing.assert_allclose(trajectory.xyz, frames["positions"][:4], rtol=1e-6)
    universe = MDAnalysis.Universe(str(path.with_suffix(".pdb")), str(path))
    for k, ts in enumerate(universe.trajectory):
        np.testing.assert_allclose(ts.dimensions[3:], ANGLES, rtol=1e-6)
        np.testing.assert_allclose(ts.dimensions[:3], 10 * LENGTHS * (1.0 + 0.01 * k), rtol=1e-6)
