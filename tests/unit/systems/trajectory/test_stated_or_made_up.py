"""What a file states is used, what its reader makes up is not: format by format, with files of other programs."""

from __future__ import annotations

import gzip
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest

from format_table import format_rows
from systems.chemistry.distance_bonds import bonds_by_distance
from systems.chemistry.graph import molecule_key
from systems.errors import InputError, TrajectoryError
from systems.scene import Scene
from systems.trajectory import foreign_readers
from systems.trajectory.codec import open_trajectory
from systems.trajectory.companion_writer import pdb_text
from systems.trajectory.dcd_file import AKMA_PS, cells_of_blocks
from systems.trajectory.foreign_scenes import EVERY, FORMATS, NONE, OTHER, format_of

mdtraj = pytest.importorskip("mdtraj")
mda = pytest.importorskip("MDAnalysis")
scipy_io = pytest.importorskip("scipy.io")

N = 6
TIMES = 5.0 + 2.5 * np.arange(N)
BOX = np.diag([2.0, 2.2, 2.4])


@pytest.fixture(scope="module")
def frames(alanine_dipeptide: Scene) -> np.ndarray:
    noise = 0.002 * np.random.default_rng(0).standard_normal((N, 22, 3))
    return np.asarray(alanine_dipeptide.positions_nm + noise, dtype=np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, alanine_dipeptide: Scene, frames: np.ndarray) -> Path:
    """One periodic trajectory as MDTraj, MDAnalysis and OpenMM write it."""
    path = tmp_path_factory.mktemp("stated")
    (path / "top.pdb").write_text(pdb_text(alanine_dipeptide))
    made = mdtraj.Trajectory(frames, alanine_dipeptide.to_mdtraj_topology(), time=TIMES)
    made.unitcell_vectors = np.repeat(BOX[None], N, axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for suffix in ("xtc", "trr", "nc", "dcd", "pdb", "xyz", "gro", "mdcrd", "h5", "lammpstrj"):
            made.save(str(path / f"mdtraj.{suffix}"))
        universe = mda.Universe(str(path / "top.pdb"), str(path / "mdtraj.trr"))
        for suffix in ("h5md", "xyz", "trz", "nc"):
            with mda.Writer(str(path / f"mda.{suffix}"), n_atoms=22) as writer:
                for _ in universe.trajectory:
                    writer.write(universe.atoms)
    with h5py.File(path / "mda.h5md") as whole, h5py.File(path / "mda.h5", "w") as copy:
        for part in whole:
            whole.copy(part, copy)
    from openmm import app, unit

    topology, edges = app.PDBFile(str(path / "top.pdb")).topology, BOX * unit.nanometer
    step = {"dt": 0.5 * unit.picosecond, "firstStep": 10, "interval": 5}
    xtc = app.XTCFile(str(path / "openmm.xtc"), topology, **step)
    with (path / "openmm.dcd").open("wb") as file:
        dcd = app.DCDFile(file, topology, **step)
        for x in frames:
            for one in (dcd, xtc):
                one.writeModel(x * unit.nanometer, periodicBoxVectors=edges)
    return path


@pytest.mark.parametrize(
    "name",
    ["mdtraj.xtc", "mdtraj.trr", "mdtraj.nc", "mdtraj.dcd", "mdtraj.pdb", "mdtraj.xyz", "mdtraj.gro", "mdtraj.mdcrd",
     "mdtraj.h5", "mdtraj.lammpstrj", "mda.h5md", "mda.xyz", "mda.trz", "mda.nc", "openmm.dcd", "openmm.xtc"],
)  # fmt: skip
def test_readers_go_by_the_table(folder: Path, frames: np.ndarray, alanine_dipeptide: Scene, name: str) -> None:
    line = format_of(folder / name)
    with open_trajectory(folder / name, top=folder / "top.pdb") as reader:
        assert reader.read() == pytest.approx(frames, abs=6e-4)
        assert np.array_equal(reader.read(1, 5, 2), reader.read()[1:5:2])
        assert reader.scene is not None and reader.record == {} and reader.flags is None
        assert reader.scene.elements == alanine_dipeptide.elements
        assert np.array_equal(reader.scene.bonds, alanine_dipeptide.bonds)
        if line.times == EVERY:
            assert reader.times_known
        if line.times == NONE:
            assert not reader.times_known
        if reader.times_known:
            assert reader.time_ps == pytest.approx(TIMES, abs=1e-4)
        assert any("unit of length" in note for note in reader.notes) is bool(line.unit_taken)
        cells = reader.read_cells(0, 1)
        if format_rows()[line.name]["cell"] == EVERY:
            assert cells is not None and cells[0] == pytest.approx(BOX, abs=2e-3)
    if line.names_atoms:
        with open_trajectory(folder / name) as reader:
            assert reader.scene is not None and len(reader.scene.bonds) == 21


def test_the_manual_s_table_is_the_one_that_readers_go_by() -> None:
    from mdtraj.formats.registry import FormatRegistry

    suffixes = [s for f in FORMATS for s in f.suffixes]
    assert len(suffixes) == len(set(suffixes))
    assert all(format_of(Path(f"a{s}")) is not OTHER for s in FormatRegistry.loaders)
    assert format_of(Path("a.unheard")) is OTHER
    rows = format_rows()
    assert list(rows) == [f.name for f in (*FORMATS, OTHER)]
    for each in FORMATS:
        row = rows[each.name]
        assert row["format"].endswith(f"({', '.join(f'`{s}`' for s in each.suffixes)})")
        assert (row["read by"], row["times"]) == (each.reader, each.times)
        assert (row["atoms"] != NONE) is each.names_atoms and each.unit_taken in row["unit of length"]


def test_times_of_a_gro_file_count_only_where_every_title_states_one(folder: Path, tmp_path: Path) -> None:
    text = (folder / "mdtraj.gro").read_text()
    assert text.count("t= 7.5") == 1
    (tmp_path / "a.gro").write_text(text.replace(", t= 7.5", ""))
    with open_trajectory(tmp_path / "a.gro") as reader:
        assert not reader.times_known
    with open_trajectory(folder / "mdtraj.gro") as reader:
        assert reader.times_known


def test_times_that_nobody_stated_are_said(folder: Path, tmp_path: Path, frames: np.ndarray) -> None:
    made = mdtraj.load(str(folder / "mdtraj.pdb"))  # times 0, 1, 2, ... ps of MDTraj's own
    made.save(str(tmp_path / "a.xtc"))
    with open_trajectory(tmp_path / "a.xtc") as reader:
        assert any("none were given" in note for note in reader.notes)
    with open_trajectory(folder / "mdtraj.xtc") as reader:
        assert not reader.notes


def test_a_lammps_dump_states_no_time_step(tmp_path: Path, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    """MDAnalysis multiplies steps by 1 ps of its own; atoms come in any order, with their numbers."""
    rng, lines = np.random.default_rng(1), []
    for k, x in enumerate(frames):
        lines += ["ITEM: TIMESTEP", str(250 * k), "ITEM: NUMBER OF ATOMS", "22", "ITEM: BOX BOUNDS pp pp pp"]
        lines += ["0 40.0"] * 3 + ["ITEM: ATOMS id type element x y z"]
        for i in rng.permutation(22):
            xyz = " ".join(f"{10 * c + 20:.5f}" for c in x[i])
            lines.append(f"{i + 1} 1 {alanine_dipeptide.elements[i]} {xyz}")
    path = tmp_path / "a.lammpsdump"
    path.write_text("\n".join(lines) + "\n")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with open_trajectory(path) as reader:
            assert not reader.times_known
            read = reader.read()
    assert read - read.mean(1, keepdims=True) == pytest.approx(frames - frames.mean(1, keepdims=True), abs=1e-5)


def test_trr_frames_without_positions_are_left_out(tmp_path: Path, frames: np.ndarray) -> None:
    """GROMACS writes frames of velocities alone (nstvout < nstxout); MDTraj gives uninitialised memory for them."""
    from MDAnalysis.lib.formats.libmdaxdr import TRRFile

    box = 10.0 * np.eye(3, dtype=np.float32)
    path = tmp_path / "a.trr"
    with TRRFile(str(path), "w") as out:
        for k, x in enumerate(frames):
            out.write(None if k % 3 == 1 else x.copy(), x.copy(), None, box, k, 2.0 * k, 0.0, 22)
    has = np.arange(N) % 3 != 1
    with open_trajectory(path) as reader:
        assert reader.n_frames == has.sum() and reader.read() == pytest.approx(frames[has], abs=1e-6)
        assert reader.read(1, 4, 2) == pytest.approx(frames[has][1:4:2], abs=1e-6)
        assert np.array_equal(reader.time_ps, 2.0 * np.flatnonzero(has))
        assert reader.notes == (f"frames without positions, left out: {(~has).sum()}.",)
    with TRRFile(str(tmp_path / "whole.trr"), "w") as out:
        for k, x in enumerate(frames):
            out.write(x.copy(), x.copy(), None, box, k, 2.0 * k, 0.0, 22)
    with open_trajectory(tmp_path / "whole.trr") as reader:
        assert reader.n_frames == N and not reader.notes
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(TrajectoryError, match=r"cut short|cannot be read"):
        open_trajectory(path)
    with TRRFile(str(tmp_path / "none.trr"), "w") as out:
        out.write(None, frames[0].copy(), None, box, 0, 0.0, 0.0, 22)
    with pytest.raises(InputError, match="holds no positions"):
        open_trajectory(tmp_path / "none.trr")


def test_netcdf_is_read_in_its_convention_alone(tmp_path: Path, frames: np.ndarray) -> None:
    path = tmp_path / "a.nc"
    write_netcdf(path, 10.0 * frames, TIMES, b"angstrom", b"picosecond", None)
    with open_trajectory(path) as reader:
        assert reader.read() == pytest.approx(frames, abs=1e-5)
        assert reader.time_ps == pytest.approx(TIMES, rel=1e-5)
        cells = reader.read_cells()
        assert cells is not None and cells[0] == pytest.approx(2.0 * np.eye(3), abs=1e-5)
    for length, time, scale in ((b"nanometer", b"picosecond", None), (b"angstrom", b"femtosecond", None),
                                (b"angstrom", b"picosecond", 10.0)):  # fmt: skip
        write_netcdf(path, frames, TIMES, length, time, scale)
        with pytest.raises(TrajectoryError, match=r"is scaled or in"):
            open_trajectory(path)


def write_netcdf(path: Path, x: np.ndarray, times: np.ndarray, length: bytes, time: bytes, scale: float | None) -> None:
    """Write Amber's convention with SciPy; positions and times are in the units named, the cell is 2 nm wide in Å."""
    with scipy_io.netcdf_file(str(path), "w", version=2) as file:
        file.Conventions, file.ConventionVersion, file.program, file.programVersion = b"AMBER", b"1.0", b"x", b"1"
        for name, n in (("frame", None), ("spatial", 3), ("atom", 22), ("cell_spatial", 3), ("cell_angular", 3)):
            file.createDimension(name, n)
        values = (("time", ("frame",), times, time), ("coordinates", ("frame", "atom", "spatial"), x, length),
                  ("cell_lengths", ("frame", "cell_spatial"), np.full((N, 3), 20.0), b"angstrom"),
                  ("cell_angles", ("frame", "cell_angular"), np.full((N, 3), 90.0), b"degree"))  # fmt: skip
        for name, dimensions, data, unit in values:
            variable = file.createVariable(name, "f4", dimensions)
            variable[:] = data
            variable.units = unit
            if name == "coordinates" and scale is not None:
                variable.scale_factor = np.float32(scale)


def test_hdf5_in_other_units_is_refused(folder: Path, tmp_path: Path, frames: np.ndarray) -> None:
    with open_trajectory(folder / "mdtraj.h5") as reader:
        assert reader.read() == pytest.approx(frames, abs=1e-5)
        assert reader.time_ps == pytest.approx(TIMES, rel=1e-5)
        cells = reader.read_cells(0, 1)
        assert cells is not None and cells[0] == pytest.approx(BOX, abs=1e-5)
    for name, unit in (("coordinates", b"angstroms"), ("cell_lengths", b"angstroms"), ("time", b"fortnights")):
        path = tmp_path / "a.h5"
        path.write_bytes((folder / "mdtraj.h5").read_bytes())
        with h5py.File(path, "r+") as file:
            file[name].attrs["units"] = np.bytes_(unit)
        with pytest.raises(TrajectoryError, match=f"{name} are in '{unit.decode()}'"):
            open_trajectory(path)


def test_h5md_with_a_fixed_cell_and_without_units(folder: Path, tmp_path: Path, frames: np.ndarray) -> None:
    path = tmp_path / "a.h5md"
    path.write_bytes((folder / "mda.h5md").read_bytes())
    with h5py.File(path, "r+") as file:
        (group,) = file["particles"].values()
        del group["box/edges"]
        group["box/edges"] = np.diag(10.0 * BOX)
        group["box/edges"].attrs["unit"] = "Angstrom"
    for one in (path, folder / "mda.h5md", folder / "mda.h5"):
        with open_trajectory(one, top=folder / "top.pdb") as reader:
            assert reader.read(1, 5, 2) == pytest.approx(frames[1:5:2], abs=1e-6)
            assert reader.times_known and reader.time_ps == pytest.approx(TIMES)
            cells = reader.read_cells(0, 2)
            assert cells is not None and cells == pytest.approx(np.repeat(BOX[None], 2, axis=0), abs=1e-6)
            assert not reader.notes
    with h5py.File(path, "r+") as file:
        (group,) = file["particles"].values()
        del group["position/time"]
        group["position/time"] = 2.5
        group["position/time"].attrs["unit"] = "ps"
    with open_trajectory(path) as reader:
        assert not reader.times_known
    with h5py.File(path, "r+") as file:
        (group,) = file["particles"].values()
        del group["position/value"].attrs["unit"]
    with pytest.raises(TrajectoryError, match="value states no known unit"):
        open_trajectory(path)


def test_an_xyz_file_is_its_own_topology(folder: Path, alanine_dipeptide: Scene) -> None:
    """CA in capitals is an alpha carbon, not calcium; bonds come from distances, orders from valence."""
    with open_trajectory(folder / "mdtraj.xyz") as reader:
        assert reader.scene is not None
        assert reader.scene.elements == alanine_dipeptide.elements
        assert np.array_equal(reader.scene.bonds, alanine_dipeptide.bonds)
        assert molecule_key(reader.scene) == molecule_key(alanine_dipeptide)


def test_formats_without_topology_say_so(folder: Path) -> None:
    with open_trajectory(folder / "mdtraj.nc") as reader:
        assert reader.scene is None and reader.n_frames == N
    with pytest.raises(TrajectoryError, match=r"mdtraj\.mdcrd cannot be read: .*`top"):
        open_trajectory(folder / "mdtraj.mdcrd")


def test_an_ase_trajectory_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.traj").write_bytes(b"- of Ulm")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "ase.io.trajectory", None)
        with pytest.raises(TrajectoryError, match=r"pip install ase.*ase convert"):
            open_trajectory(tmp_path / "x.traj")
    pytest.importorskip("ase")
    with pytest.raises(TrajectoryError, match=r"x\.traj cannot be read by ase"):
        open_trajectory(tmp_path / "x.traj")


def test_a_topology_of_other_atoms_is_refused(folder: Path, tmp_path: Path) -> None:
    smaller = mdtraj.load(str(folder / "top.pdb"))
    smaller.atom_slice(range(10)).save_pdb(str(tmp_path / "small.pdb"))
    for name in ("mdtraj.xtc", "mdtraj.dcd", "mda.h5md"):
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


def test_a_cell_of_zeros_is_none(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    zeros = "CRYST1    0.000    0.000    0.000  90.00  90.00  90.00 P 1           1\n"
    (tmp_path / "a.pdb").write_text(zeros + pdb_text(alanine_dipeptide))
    with open_trajectory(tmp_path / "a.pdb") as reader:
        assert reader.read_cells() is None


def test_cells_are_read_block_by_block(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spans: list[int] = []
    stored = foreign_readers.StreamReader._stored

    def counting(self: foreign_readers.StreamReader, start: int, stop: int) -> list[object]:
        spans.append(stop - start)
        return stored(self, start, stop)

    monkeypatch.setattr(foreign_readers, "_PASS_FRAMES", 2)
    monkeypatch.setattr(foreign_readers.StreamReader, "_stored", counting)
    for suffix in ("xtc", "trr", "nc"):
        with open_trajectory(folder / f"mdtraj.{suffix}") as reader:
            cells = reader.read_cells(1, N, 2)
            assert cells is not None and cells == pytest.approx(np.repeat(BOX[None], N // 2, axis=0), abs=2e-4)
    assert max(spans) <= 2 < N


def test_a_psf_is_a_topology(shared_data: Path) -> None:
    """CHARMM's adenylate kinase: 3,341 atoms, bonds from the PSF, positions from the first frame."""
    adk = shared_data / "adk"
    with open_trajectory(adk / "adk_dims.dcd", top=adk / "adk.psf") as reader:
        assert reader.scene is not None
        universe = mda.Universe(str(adk / "adk.psf"), str(adk / "adk_dims.dcd"))
        assert len(reader.scene.bonds) == len(universe.bonds)
        assert reader.scene.positions_nm == pytest.approx(0.1 * universe.atoms.positions, abs=1e-5)
        assert reader.times_known and reader.time_ps[1] - reader.time_ps[0] == pytest.approx(1.0, rel=1e-4)


def test_hdf5_topologies_without_bonds(folder: Path, tmp_path: Path) -> None:
    made = mdtraj.load(str(folder / "mdtraj.h5"))
    made.topology._bonds = []
    made.save(str(tmp_path / "a.h5"))
    with open_trajectory(tmp_path / "a.h5") as reader:
        assert reader.scene is not None and len(reader.scene.bonds) == 21
        assert any("21 bonds that its topology lacks" in note for note in reader.notes)
    with open_trajectory(tmp_path / "a.h5", top=folder / "top.pdb") as reader:
        assert reader.scene is not None and len(reader.scene.bonds) == 21 and not reader.notes
    with open_trajectory(folder / "mdtraj.h5", top=folder / "top.pdb") as reader:
        assert [note for note in reader.notes if "is not used" in note]
    with open_trajectory(folder / "mdtraj.h5") as reader:
        assert not reader.notes
    small = mdtraj.load(str(folder / "top.pdb")).atom_slice(range(10))
    small.save_pdb(str(tmp_path / "small.pdb"))
    with pytest.raises(InputError, match="holds other atoms"):
        open_trajectory(tmp_path / "a.h5", top=tmp_path / "small.pdb")


def relabelled_dcd(source: Path, into: Path, title: bytes, step: float, every: int) -> Path:
    """Copy a DCD of MDTraj's with another title, time step (as its program writes it) and steps between frames."""
    data = bytearray(source.read_bytes())
    length = int.from_bytes(data[92:96], "little")
    data[100 : 96 + length] = title.ljust(length - 4)[: length - 4]
    data[44:48] = np.array([step], "<f4").tobytes()
    data[16:20] = np.array([every], "<i4").tobytes()
    into.write_bytes(data)
    return into


def test_the_time_step_of_lammps_is_not_used(folder: Path, tmp_path: Path) -> None:
    source, path = folder / "mdtraj.dcd", tmp_path / "a.dcd"
    with open_trajectory(relabelled_dcd(source, path, b"Written by LAMMPS", 2.0, 250)) as reader:
        assert not reader.times_known and any("written by LAMMPS" in note for note in reader.notes)
    with open_trajectory(relabelled_dcd(source, path, b"Written by somebody", 2.0, 250)) as reader:
        assert np.diff(reader.time_ps) == pytest.approx(500 * AKMA_PS, rel=1e-5) and not reader.notes


def test_the_cell_of_charmm_is_a_shape_matrix_and_that_of_namd_holds_cosines() -> None:
    octahedron = np.full((3, 3), -1.0 / 3.0) + np.eye(3) * 4.0 / 3.0  # a a . a b / (a b) of a truncated octahedron
    values, vectors = np.linalg.eigh(octahedron)
    shape = 22.0 * (vectors * np.sqrt(values)) @ vectors.T
    charmm = blocks([shape[0, 0], shape[0, 1], shape[1, 1], shape[0, 2], shape[1, 2], shape[2, 2]])
    namd, degrees = (
        blocks([22.0, -1 / 3, 22.0, -1 / 3, -1 / 3, 22.0]),
        blocks([22.0, 109.4712206] * 2 + [109.4712206, 22.0]),
    )
    degrees = blocks([22.0, 109.4712206, 22.0, 109.4712206, 109.4712206, 22.0])
    for given, version in ((charmm, 40), (charmm, 24), (namd, 24), (degrees, 24), (degrees, 40)):
        cell = cells_of_blocks(given, "<", version)
        assert cell is not None
        assert cell[0] @ cell[0].T == pytest.approx(2.2**2 * octahedron, abs=1e-6)
    assert cells_of_blocks(charmm, "<", 40)[0] == pytest.approx(0.1 * shape)  # type: ignore[index]
    cube = cells_of_blocks(blocks([30.0, 0.0, 30.0, 0.0, 0.0, 30.0]), "<", 40)
    assert cube is not None and cube[0] == pytest.approx(3.0 * np.eye(3))
    near = cells_of_blocks(blocks([30.0, 0.5, 30.0, 0.0, 0.0, 30.0]), "<", 40)
    assert near is not None and near[0, 0, 1] == pytest.approx(0.05), "no cosine of 60 degrees"
    assert cells_of_blocks(blocks([0.0] * 6), "<", 40) is None
    with pytest.raises(ValueError, match="neither angles"):
        cells_of_blocks(blocks([30.0, 170.0, 30.0, 170.0, 170.0, 30.0]), "<", 24)


def blocks(numbers: list[float]) -> np.ndarray:
    """Return one unit-cell block `(1, 14)` of six numbers."""
    out = np.full((1, 14), 48, dtype="<i4")
    out[0, 1:13] = np.array(numbers, "<f8").view("<i4")
    return out


def test_extended_xyz_of_ase_is_whole(tmp_path: Path, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    """A wrapped molecule: the same cell and bonds from extended XYZ as from an ASE trajectory; columns in any order."""
    ase = pytest.importorskip("ase")
    from ase.io import write
    from ase.io.trajectory import Trajectory

    atoms = [ase.Atoms(alanine_dipeptide.elements, positions=10.0 * x, cell=10.0 * BOX, pbc=True) for x in frames]
    for one in atoms:
        one.positions -= one.positions.mean(0)
        one.wrap()
    write(str(tmp_path / "a.xyz"), atoms, format="extxyz")
    write(str(tmp_path / "b.extxyz"), atoms, format="extxyz", columns=["positions", "symbols"])
    with Trajectory(str(tmp_path / "a.traj"), "w") as out:
        for one in atoms:
            out.write(one)
    for name in ("a.xyz", "b.extxyz", "a.traj"):
        with open_trajectory(tmp_path / name) as reader:
            cells = reader.read_cells()
            assert cells is not None and cells == pytest.approx(np.repeat(BOX[None], N, axis=0))
            assert reader.read() == pytest.approx(np.stack([0.1 * a.positions for a in atoms]), abs=1e-6)
            assert reader.scene is not None
            assert np.array_equal(reader.scene.bonds, alanine_dipeptide.bonds), "bonds across the cell"
    for one in atoms:
        one.pbc = False
    write(str(tmp_path / "c.xyz"), atoms, format="extxyz")
    with open_trajectory(tmp_path / "c.xyz") as reader:
        assert reader.read_cells() is None and reader.scene is not None
        assert len(reader.scene.bonds) < 21, "nothing says that it was wrapped"


@pytest.mark.parametrize("suffix", ["pdb", "gro", "xyz"])
def test_frames_in_another_order_are_refused(folder: Path, tmp_path: Path, suffix: str) -> None:
    path, order = tmp_path / f"a.{suffix}", np.random.default_rng(3).permutation(22)
    lines = (folder / f"mdtraj.{suffix}").read_text().splitlines()
    firsts = {"pdb": "MODEL", "gro": "", "xyz": "22"}[suffix]
    starts = [k for k, line in enumerate(lines) if line.startswith(firsts) and (suffix != "gro" or k % 25 == 0)]
    first = starts[3] + {"pdb": 1, "gro": 2, "xyz": 2}[suffix]
    atoms = lines[first : first + 22]
    lines[first : first + 22] = [atoms[k] for k in order]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(TrajectoryError, match="frame 3 lists other atoms than the first, or in another order"):
        open_trajectory(path)
    with open_trajectory(folder / f"mdtraj.{suffix}") as reader:
        assert reader.n_frames == N


def test_models_of_mmcif_in_another_order(folder: Path, tmp_path: Path, frames: np.ndarray) -> None:
    """As OpenMM writes them; with the second model's atoms shuffled MDTraj refuses them itself."""
    from openmm import app, unit

    path, topology = tmp_path / "a.cif", app.PDBFile(str(folder / "top.pdb")).topology
    with path.open("w") as file:
        app.PDBxFile.writeHeader(topology, file)
        for k, x in enumerate(frames):
            app.PDBxFile.writeModel(topology, x * unit.nanometer, file, modelIndex=k + 1)
    with open_trajectory(path) as reader:
        assert reader.read() == pytest.approx(frames, abs=6e-5) and not reader.notes
    lines = path.read_text().splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith(("ATOM", "HETATM"))) + 22
    lines[first : first + 22] = lines[first : first + 22][::-1]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(TrajectoryError, match="does not match the order of atoms"):
        open_trajectory(path)


def test_elements_of_ase_that_change_are_refused(tmp_path: Path, frames: np.ndarray, alanine_dipeptide: Scene) -> None:
    ase = pytest.importorskip("ase")
    from ase.io.trajectory import Trajectory

    symbols = list(alanine_dipeptide.elements)
    for name, later in (("same", symbols), ("moved", symbols[::-1])):
        with Trajectory(str(tmp_path / f"{name}.traj"), "w") as out:
            for k, x in enumerate(frames):
                out.write(ase.Atoms(later if k > 2 else symbols, positions=10.0 * x))
    with open_trajectory(tmp_path / "same.traj") as reader:
        assert reader.read() == pytest.approx(frames, abs=1e-6) and not reader.times_known
        assert reader.scene is not None and molecule_key(reader.scene) == molecule_key(alanine_dipeptide)
    with pytest.raises(TrajectoryError, match="frame 3 lists other"):
        open_trajectory(tmp_path / "moved.traj")


@pytest.mark.parametrize("suffix", ["xtc", "trr", "nc", "dcd", "pdb", "h5"])
def test_folders_outside_ascii(folder: Path, tmp_path: Path, frames: np.ndarray, suffix: str) -> None:
    """MDTraj's XTC and TRR take paths of ASCII alone."""
    other = tmp_path / "Zúñiga" / f"é.{suffix}"
    other.parent.mkdir()
    other.write_bytes((folder / f"mdtraj.{suffix}").read_bytes())
    with open_trajectory(other, top=folder / "top.pdb") as reader:
        assert reader.read() == pytest.approx(frames, abs=6e-4)
    if suffix == "xtc":
        with pytest.raises(UnicodeEncodeError):
            mdtraj.open(str(other))
        other.write_bytes(b"no frames")
        with pytest.raises(TrajectoryError, match=r"é\.xtc cannot be read"):
            open_trajectory(other)


@pytest.mark.parametrize("damage", ["cut", "zeros"])
def test_a_damaged_compressed_xyz_file_is_one_line(tmp_path: Path, damage: str) -> None:
    rows = np.random.default_rng(0).random((300, 22, 3))
    lines = (["22", "x", *("C {:.5f} {:.5f} {:.5f}".format(*atom) for atom in frame)] for frame in rows)
    text = "".join(f"{line}\n" for frame in lines for line in frame)
    whole = gzip.compress(text.encode())
    path = tmp_path / "a.xyz.gz"
    path.write_bytes(whole[: len(whole) // 2] if damage == "cut" else whole[:300] + bytes(200) + whole[500:])
    with pytest.raises(TrajectoryError, match="is damaged or cut short in frame"):
        open_trajectory(path)
    path.write_bytes(whole)
    with open_trajectory(path) as reader:
        assert reader.n_frames == 300
