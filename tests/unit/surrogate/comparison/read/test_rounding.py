"""The resolution of files: rounded coordinates are compared rounded alike, and a wrong width is still a wrong width."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison.comparison import Comparison, Evaluation, compare
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.read.stored_frames import angle_variance, length_error_nm, rounded
from surrogate.comparison.rows.rows import Options
from systems.trajectory.companion_writer import pdb_text

OPTIONS = Options(peptide_recipe=False, n_bootstrap=100, n_permutations=300)
N = 3_000
Runs = tuple[Ensemble, Ensemble, Ensemble]


@pytest.fixture(scope="module")
def runs(simulate: Callable[..., Ensemble]) -> Runs:
    """Reference, candidate and replicate; bonds to hydrogen are held at their lengths, as by constraints."""
    made = []
    for seed in (71, 72, 73):
        run = simulate(seed, N)
        frames, scene = np.array(run.segments[0]), run.scene
        for i, j in scene.bonds.tolist():
            parent, hydrogen = (i, j) if scene.elements[j] == "H" else (j, i)
            if scene.elements[hydrogen] == "H":
                arm = frames[:, hydrogen] - frames[:, parent]
                arm /= np.linalg.norm(arm, axis=1, keepdims=True)
                length = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j])
                frames[:, hydrogen] = frames[:, parent] + length * arm
        made.append(replace(run, segments=[frames]))
    return made[0], made[1], made[2]


def test_a_bond_that_breaks_and_a_frame_that_is_not_finite_leave_the_temperature(
    simulate: Callable[..., Ensemble],
) -> None:
    three = [simulate(k, 400) for k in (1, 2, 3)]
    for run in three:
        run.segments[0][::50, 0] += 0.1  # a hydrogen that hops, in 2 % of frames
    three[0].segments[0][7] = np.nan
    found = compare(*([replace(e, grids_nm=(1e-3,))] if e is three[1] else replace(e, grids_nm=(1e-3,))
                      for e in three), options=OPTIONS)  # fmt: skip
    assert any("bond H1-CH3" in n for n in found.notes)
    assert found.evaluations[0].row("temperature").candidate.value == pytest.approx(300.0, abs=60.0)


def as_xtc(run: Ensemble, folder: Path, decimals: int, frames: np.ndarray | None = None) -> Ensemble:
    """The run as MDAnalysis writes it: `decimals` of a nanometre."""
    mda = pytest.importorskip("MDAnalysis")
    folder.mkdir(exist_ok=True)
    (folder / "top.pdb").write_text(pdb_text(run.scene))
    path = folder / f"p{decimals}.xtc"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        universe = mda.Universe(str(folder / "top.pdb"))
        with mda.Writer(str(path), n_atoms=run.scene.n_atoms, precision=decimals) as writer:
            for k, x in enumerate(run.segments[0] if frames is None else frames):
                universe.atoms.positions = 10.0 * x
                universe.trajectory.ts.time = float(k)
                writer.write(universe.atoms)
    return load_ensemble([path], top=folder / "top.pdb", template=run.scene, lag_ps=run.lag_ps)


def evaluated(runs: Runs, candidate: Ensemble) -> tuple[Evaluation, Comparison]:
    found = compare(runs[0], [candidate], runs[2], options=OPTIONS)
    return found.evaluations[0], found


def notes(found: Comparison) -> list[str]:
    return [n for n in found.notes if "rounded to" in n]


@pytest.mark.parametrize(("decimals", "angstrom"), [(3, "0.01 Å"), (2, "0.1 Å")])
def test_rounded_frames_of_the_same_md_are_evaluated_as_the_frames_are(
    runs: Runs, tmp_path: Path, decimals: int, angstrom: str
) -> None:
    as_it_is, of_floats = evaluated(runs, runs[1])
    found, whole = evaluated(runs, as_xtc(runs[1], tmp_path, decimals))
    assert found.status == as_it_is.status == "indistinguishable", (found.verdict, as_it_is.verdict)
    assert not found.findings
    assert notes(of_floats) == [] and len(notes(whole)) == 1 and f"rounded to {angstrom}" in notes(whole)[0]
    width = found.row("bond_width:constrained bonds")
    assert width.verdict == "agrees"
    assert width.candidate.value == pytest.approx(10.0 * length_error_nm(10.0**-decimals), rel=0.1)


def test_without_that_the_rounding_is_called_a_wrong(runs: Runs, tmp_path: Path) -> None:
    """Negative control: the same file whose rounding is not known is said to vibrate as if hotter."""
    coarse = replace(as_xtc(runs[1], tmp_path, 2), grids_nm=())
    found, whole = evaluated(runs, coarse)
    assert not notes(whole) and found.status in ("different", "broken")
    assert found.row("temperature").candidate.value > 400.0


@pytest.mark.parametrize("decimals", [3, 2])
def test_a_really_wrong_spread_of_bonds_is_found_in_a_rounded_file(runs: Runs, tmp_path: Path, decimals: int) -> None:
    """Noise of 2 pm more on every coordinate: twice the variance, 600 K."""
    frames = runs[1].segments[0][:] + 0.002 * np.random.default_rng(5).standard_normal((N, 22, 3)).astype(np.float32)
    found, _ = evaluated(runs, as_xtc(runs[1], tmp_path, decimals, frames))
    assert found.status in ("different", "broken"), found.verdict
    assert found.row("bond_width:flexible bonds").verdict == "differs"


def test_what_rounding_hides_is_left_out_with_the_reason(runs: Runs, tmp_path: Path) -> None:
    """Of bonds and angles narrower than the rounding makes them no temperature is told."""
    stiff = [replace(r, segments=[r.scene.positions_nm.astype(np.float32) + 0.25 * (
        r.segments[0][:] - r.segments[0][:].mean(axis=0)) * 0.1 + 0.37 * np.random.default_rng(k).random((N, 1, 3))
        .astype(np.float32)]) for k, r in enumerate(runs)]  # fmt: skip
    found, _ = evaluated((stiff[0], stiff[1], stiff[2]), stiff[1].on_grid(0.01))
    assert "temperature" not in {r.key for r in found.rows}
    assert any("the rounding of the files hides" in why for _, why in found.skipped)


def test_the_grid_is_seen_in_any_format(runs: Runs, tmp_path: Path) -> None:
    """PDB, GRO, XYZ, and HDF5 and DCD that were made of an XTC file; a DCD of floats is on none."""
    mdtraj = pytest.importorskip("mdtraj")
    frames = runs[1].segments[0][:20]
    topology = runs[1].scene.to_mdtraj_topology()
    (tmp_path / "top.pdb").write_text(pdb_text(runs[1].scene))
    expected = {"a.pdb": 1e-4, "a.gro": 1e-3, "a.dcd": 0.0, "b.h5": 1e-2, "b.dcd": 1e-2, "a.xtc": 1e-3, "a.xyz": 1e-4}
    for name, grid in expected.items():
        x = rounded(frames, 0.01) if name[0] == "b" else frames
        mdtraj.Trajectory(x, topology, time=np.arange(20.0)).save(str(tmp_path / name))
        read = load_ensemble([tmp_path / name], top=tmp_path / "top.pdb", template=runs[1].scene, lag_ps=1.0)
        assert read.grid_nm == pytest.approx(grid, rel=1e-5), name


def test_frames_left_in_their_file_are_rounded_as_they_are_read(runs: Runs, tmp_path: Path) -> None:
    mdtraj = pytest.importorskip("mdtraj")
    frames = runs[1].segments[0][:50]
    mdtraj.Trajectory(frames, runs[1].scene.to_mdtraj_topology()).save(str(tmp_path / "a.dcd"))
    stored = load_ensemble([tmp_path / "a.dcd"], template=runs[1].scene, lag_ps=1.0, in_memory_bytes=0).on_grid(0.01)
    expected = rounded(mdtraj.load(str(tmp_path / "a.dcd"), top=runs[1].scene.to_mdtraj_topology()).xyz, 0.01)
    for segment in (stored, stored.on_grid(0.001), stored.strided(1)):
        np.testing.assert_array_equal(segment.segments[0][:], expected)
    np.testing.assert_array_equal(stored.strided(3).segments[0][:], expected[::3])


def test_variances_of_rounding_are_what_rounding_does() -> None:
    """Two arms of 0.11 and 0.15 nm at 112°, turned and shifted at random, rounded to 0.01 nm."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.standard_normal((20_000, 3, 3)))[0]
    bend = np.radians(112.0)
    x = np.array([[0.11, 0.0, 0.0], [0.0, 0.0, 0.0], [0.15 * np.cos(bend), 0.15 * np.sin(bend), 0.0]])
    frames = rounded(np.einsum("ai,nij->naj", x, turn) + rng.random((20_000, 1, 3)), 0.01).astype(np.float64)
    lengths = np.linalg.norm(frames[:, 0] - frames[:, 1], axis=1)
    assert lengths.std() == pytest.approx(length_error_nm(0.01), rel=0.03)
    arms = frames[:, [0, 2]] - frames[:, 1:2]
    arms /= np.linalg.norm(arms, axis=2, keepdims=True)
    found = np.arccos((arms[:, 0] * arms[:, 1]).sum(axis=1))
    assert found.var() == pytest.approx(float(angle_variance(0.11, 0.15, bend, 0.01)), rel=0.05)
