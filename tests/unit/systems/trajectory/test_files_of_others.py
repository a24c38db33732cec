"""Every format that `compare` reads, with files that other programs than its reader wrote (the manual's table).

Files of GROMACS, LAMMPS, DL_POLY, GROMOS, HOOMD-blue, Tinker and others are MDAnalysisTests' (`pip install
MDAnalysisTests gsd pytng pandas`; what is lacking is skipped); cpptraj and OpenMM write theirs here.
"""

from __future__ import annotations

import bz2
import gzip
import shutil
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from format_table import tried_with
from systems.errors import SurromdError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory
from systems.trajectory.companion_writer import pdb_text
from systems.trajectory.foreign_scenes import FORMATS, format_of

# Program, file, its name here, topology, frames, atoms, time between frames (ps; None: not stated), edge a of the cell
# (nm; None: no cell).
Row = tuple[str, str, str, str, int, int, float | None, float | None]
STORED: tuple[Row, ...] = (
    ("GROMACS", "argon_npt_compressed.tng", "", "argon_npt_compressed.gro.gz", 101, 1000, 10.0, 3.601),
    ("GROMACS", "two_water_gro_multiframe.gro", "", "", 2, 6, None, 10.0),
    ("GROMACS", "xyz_random_walk.xtc", "", "", 100, 100, 1.0, None),
    ("GROMACS", "cobrotoxin.trr", "", "", 3, 19_385, 50.0, 5.2763),
    ("HOOMD-blue", "example_bonds.gsd", "", "carbons", 3, 490, None, 1.0),
    ("HOOMD-blue", "C12x64.xml.bz2", "c.hoomdxml", "", 1, 769, None, 300.0),
    ("DL_POLY", "dlpoly/HISTORY", "HISTORY", "", 3, 216, None, 1.868),
    ("DL_POLY", "dlpoly/CONFIG", "CONFIG", "", 1, 216, None, 1.870),
    ("GROMOS11", "gromos11/gromos11_traj_vac_1.trc.gz", "a.trc", "", 3, 73, 20.0, None),
    ("IBIsCO", "trzfile.trz", "", "carbons", 6, 8184, 0.01, 5.542),
    ("pyh5md", "cobrotoxin.h5md", "", "", 3, 19_385, 50.0, 5.2763),
    ("PDB2PQR", "1A2C.pqr", "", "", 1, 5313, None, None),
    ("Tinker", "coordinates/test.txyz", "", "", 1, 9, None, None),
    ("Tinker", "coordinates/new_hexane.arc", "", "", 3, 6, None, 3.886),
    ("LAMMPS", "lammps/mass_q_elem.lammpstrj", "a.lammpsdump", "", 1, 30, None, 3.9),
    ("LAMMPS", "lammps/mass_q_elem.lammpstrj", "a.lammpstrj", "carbons", 1, 30, None, 3.9),
    ("the PDB", "4x8u.pdbx", "", "", 1, 60, None, None),
    ("the PDB", "nmr_neopetrosiamide.pdb", "", "", 24, 392, None, None),
    ("ParmEd", "Amber/parmed_ala2_solv.rst7", "", "Amber/parmed_ala2_solv.parm7", 1, 3026, None, 3.713),
    ("cpptraj", "Amber/ache.mdcrd", "", "Amber/ache.prmtop", 11, 252, None, None),
    ("NAMD", "adk_gbis_tmd-fast1_NAMD.dcd", "", "", 100, 3341, 0.01, None),
    ("CHARMM", "tip125_tric_C36.dcd", "", "tip125_tric_C36.psf", 10, 375, 1.0, 3.5446),
)
CPPTRAJ = {"nc": "netcdf", "mdcrd": "crd", "dcd": "dcd", "xtc": "xtc", "trr": "trr", "xyz": "xyz", "pdb": "pdb",
           "mol2": "mol2 onlyframes 1", "rst7": "restart onlyframes 1", "ncrst": "ncrestart onlyframes 1"}  # fmt: skip
N = 10


def _needs(path: Path) -> None:
    for suffix, package in ((".gsd", "gsd"), (".tng", "pytng"), (".mol2", "pandas")):
        if path.suffix == suffix:
            pytest.importorskip(package)


def _stored(name: str, as_name: str, folder: Path) -> Path:
    data = Path(pytest.importorskip("MDAnalysisTests").__file__).parent / "data"
    path = data / name
    if not as_name and not name.endswith(".bz2"):
        return path
    out = folder / as_name
    unpacked = {".gz": gzip.decompress, ".bz2": bz2.decompress}.get(path.suffix, bytes)
    out.write_bytes(unpacked(path.read_bytes()))
    return out


@pytest.mark.parametrize("row", STORED, ids=[f"{r[0]}-{r[2] or Path(r[1]).name}" for r in STORED])
def test_files_that_other_programs_wrote(row: Row, tmp_path: Path) -> None:
    program, name, as_name, top, n_frames, n_atoms, lag, edge = row
    path = _stored(name, as_name, tmp_path)
    _needs(path)
    assert program in tried_with(format_of(path).name) or program == "the PDB"
    topology = None
    if top == "carbons":
        atom = "HETATM{:5d}  C   UNK A{:4d}    {:8.3f}{:8.3f}{:8.3f}  1.00  0.00           C\n"
        topology = tmp_path / "carbons.pdb"
        at = [(5.0 * (k % 50), 5.0 * (k // 50 % 50), 5.0 * (k // 2500)) for k in range(n_atoms)]
        topology.write_text("".join(atom.format(k + 1, k + 1, *x) for k, x in enumerate(at)) + "END\n")
    elif top:
        topology = _stored(top, "", tmp_path)
    with open_trajectory(path, top=topology) as reader:
        assert (reader.n_frames, reader.n_atoms) == (n_frames, n_atoms)
        assert reader.times_known is (lag is not None)
        if lag is not None and n_frames > 1:
            assert np.diff(reader.time_ps) == pytest.approx(np.full(n_frames - 1, lag), rel=1e-3)
        cells = reader.read_cells(0, 1)
        assert (cells is None) is (edge is None)
        if cells is not None:
            assert float(np.linalg.norm(cells[0], axis=1)[0]) == pytest.approx(edge, rel=1e-3)
        x = reader.read()
        assert x.shape == (n_frames, n_atoms, 3) and np.isfinite(x).all()
        np.testing.assert_array_equal(reader.read(n_frames - 1), x[-1:])
    other = _by_mdanalysis(path, n_atoms)
    if other is not None:
        # MDAnalysis puts the corner of LAMMPS' cell at zero.
        assert x[0] - x[0, 0] == pytest.approx(other - other[0], abs=2e-5 * max(1.0, float(np.abs(other).max())))


def _by_mdanalysis(path: Path, n_atoms: int) -> Any:
    """The first frame by the other library, nm; None where it does not read the format."""
    mda = pytest.importorskip("MDAnalysis")
    if path.suffix in (".hoomdxml", ".arc", ".pdbx", ".pdb", ".mdcrd", ".rst7"):
        return None
    kind = {".lammpstrj": "LAMMPSDUMP"}.get(path.suffix, format_of(path).mda)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = mda.coordinates.core.get_reader_for(str(path), format=kind)(str(path), n_atoms=n_atoms)
        return np.array(reader[0].positions) * 0.1


def _cpptraj() -> str | None:
    """AmberTools' own, beside this Python or on the PATH."""
    return shutil.which("cpptraj", path=str(Path(sys.executable).parent)) or shutil.which("cpptraj")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, alanine_dipeptide: Scene) -> tuple[Path, np.ndarray]:
    """A folder with one trajectory in the formats that cpptraj writes, and its frames in nm."""
    mdtraj, program = pytest.importorskip("mdtraj"), _cpptraj()
    if program is None:
        pytest.skip("cpptraj is not installed")
    folder = tmp_path_factory.mktemp("cpptraj")
    noise = 0.002 * np.random.default_rng(0).standard_normal((N, 22, 3))
    frames = np.asarray(alanine_dipeptide.positions_nm + noise, dtype=np.float32)
    mdtraj.Trajectory(frames, alanine_dipeptide.to_mdtraj_topology()).save_dcd(str(folder / "in.dcd"))
    (folder / "top.pdb").write_text(pdb_text(alanine_dipeptide))
    lines = ["parm top.pdb", "trajin in.dcd", *(f"trajout a.{s} {kind}" for s, kind in CPPTRAJ.items()), "run", ""]
    (folder / "a.in").write_text("\n".join(lines))
    subprocess.run([str(program), "-i", "a.in"], cwd=folder, check=True, capture_output=True)
    return folder, frames


@pytest.mark.parametrize("suffix", CPPTRAJ)
def test_files_of_cpptraj(made: tuple[Path, np.ndarray], suffix: str) -> None:
    folder, frames = made
    path = folder / f"a.{suffix}"
    _needs(path)
    assert "cpptraj" in tried_with(format_of(path).name)
    n = 1 if "onlyframes" in CPPTRAJ[suffix] else N
    with open_trajectory(path, top=folder / "top.pdb") as reader:
        assert reader.n_frames == n
        assert reader.read() == pytest.approx(frames[:n], abs=6e-4 if suffix == "xtc" else 6e-5)
        assert reader.scene is not None and len(reader.scene.bonds) == 21
        assert reader.read_cells(0, 1) is None
    with pytest.raises(SurromdError) as caught:  # negative control: half a file
        half = folder / f"half.{suffix}"
        half.write_bytes(path.read_bytes()[: path.stat().st_size // 2 + 5])
        with open_trajectory(half, top=folder / "top.pdb") as reader:
            assert reader.n_frames < n, "half of a file is not the whole"
            raise SurromdError("fewer frames")
    assert "\n" not in str(caught.value)


def test_mol2_of_many_frames_is_refused(tmp_path: Path) -> None:
    """MDTraj reads the first molecule and says nothing of the others."""
    text = "@<TRIPOS>MOLECULE\nx\n 1 0\nSMALL\nNO_CHARGES\n\n@<TRIPOS>ATOM\n 1 C 0.0 0.0 0.0 C.3 1 X 0.0\n"
    (tmp_path / "a.mol2").write_text(3 * text)
    with pytest.raises(SurromdError, match=r"a\.mol2 holds 3 molecules, of which MDTraj reads the first"):
        open_trajectory(tmp_path / "a.mol2")


def test_files_of_openmm(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    """Its reporters of PDB, PDBx, DCD and XTC, and the XML of a state."""
    import openmm
    from openmm import app, unit

    topology, system = alanine_dipeptide.to_openmm_topology(), openmm.System()
    for mass in alanine_dipeptide.masses_da:
        system.addParticle(float(mass))
    simulation = app.Simulation(topology, system, openmm.VerletIntegrator(0.002),
                                openmm.Platform.getPlatformByName("Reference"))  # fmt: skip
    simulation.context.setPositions(alanine_dipeptide.positions_nm)
    simulation.context.setVelocitiesToTemperature(30.0, 1)
    (tmp_path / "top.pdb").write_text(pdb_text(alanine_dipeptide))
    simulation.reporters = [
        app.PDBReporter(str(tmp_path / "a.pdb"), 5),
        app.PDBxReporter(str(tmp_path / "a.pdbx"), 5),
        app.DCDReporter(str(tmp_path / "a.dcd"), 5),
        app.XTCReporter(str(tmp_path / "a.xtc"), 5),
    ]
    simulation.step(15)
    simulation.reporters = []
    simulation.saveState(str(tmp_path / "a.xml"))
    state = simulation.context.getState(positions=True).getPositions(asNumpy=True).value_in_unit(unit.nanometer)
    for name, n, timed in (("a.pdb", 3, False), ("a.pdbx", 3, False), ("a.dcd", 3, True), ("a.xtc", 3, True),
                           ("a.xml", 1, False)):  # fmt: skip
        assert "OpenMM" in tried_with(format_of(tmp_path / name).name)
        with open_trajectory(tmp_path / name, top=tmp_path / "top.pdb") as reader:
            assert reader.n_frames == n, name
            assert reader.read(n - 1)[0] == pytest.approx(np.array(state), abs=6e-4), name
            assert reader.times_known is timed
            if timed:
                assert np.diff(reader.time_ps) == pytest.approx([0.01, 0.01], rel=1e-3)


def test_every_line_of_the_table_names_a_program_that_is_tried_here() -> None:
    """Two formats are MDTraj's alone: nobody else's file of Desmond's or of MSMBuilder's could be had."""
    alone = {f.name for f in FORMATS if tried_with(f.name).endswith(" alone")}
    assert alone == {"Desmond", "MSMBuilder LH5"}
    of_rows = {format_of(Path(as_name or name)).name for _, name, as_name, *_ in STORED}
    of_cpptraj = {format_of(Path(f"a.{s}")).name for s in CPPTRAJ}
    of_openmm = {format_of(Path(f"a.{s}")).name for s in ("pdb", "pdbx", "dcd", "xtc", "xml")}
    elsewhere = {"surromd's and MDTraj's HDF5", "ASE"}  # test_foreign_files, test_stated_or_made_up
    assert {f.name for f in FORMATS} - alone == of_rows | of_cpptraj | of_openmm | elsewhere


def test_virtual_sites_in_a_topology_are_left_alone(tmp_path: Path) -> None:
    """TIP4P: the fourth site has no element and no bond."""
    atom = "HETATM{:5d}  {:<3s} HOH A   1    {:8.3f}{:8.3f}{:8.3f}  1.00  0.00          {:>2s}\n"
    rows = (("O", 0, 0, 0, "O"), ("H1", 0.957, 0, 0, "H"), ("H2", -0.24, 0.927, 0, "H"), ("M", 0.1, 0.12, 0, "VS"))
    text = "".join(atom.format(k + 1, *row) for k, row in enumerate(rows))
    (tmp_path / "w.pdb").write_text(text.replace("VS\n", "  \n") + "END\n")
    mdtraj = pytest.importorskip("mdtraj")
    x = np.array([[r[1:4] for r in rows]] * 3, dtype=np.float32) / 10
    shutil.copyfile(tmp_path / "w.pdb", tmp_path / "top.pdb")
    mdtraj.Trajectory(x, mdtraj.load(str(tmp_path / "top.pdb")).topology).save_dcd(str(tmp_path / "a.dcd"))
    with open_trajectory(tmp_path / "a.dcd", top=tmp_path / "top.pdb") as reader:
        assert reader.scene is not None and reader.scene.elements == ("O", "H", "H", "VS")
        assert reader.scene.bonds.tolist() == [[0, 1], [0, 2]]
