"""Torsions against MDTraj, superposition against SciPy."""

from __future__ import annotations

from pathlib import Path
from time import process_time

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from systems.chemistry.geometry import near_pairs, signed_volumes, superpose, superposition, torsion
from systems.chemistry.graph import backbone_torsions
from systems.errors import InputError
from systems.scene import Scene


def _rotated_copies(template: np.ndarray, n: int, noise: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turn = Rotation.random(n, random_state=seed).as_matrix()
    moved = np.einsum("nij,aj->nai", turn, template) + rng.normal(size=(n, 1, 3)) * 5.0
    return moved + rng.normal(size=moved.shape) * noise


def _rmsd(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.sqrt(((a - b) ** 2).sum(-1).mean(-1))


def test_torsion_has_the_iupac_sign() -> None:
    # Looking along b-c, d is turned clockwise from a by 60 degrees: positive.
    turn = np.radians(60)
    frame = np.array([[1.0, 0, 0], [0, 0, 0], [0, 0, 1.0], [np.cos(turn), np.sin(turn), 1.0]])
    assert np.degrees(torsion(frame, [[0, 1, 2, 3]])) == pytest.approx([60.0])
    assert np.degrees(torsion(frame * [1, 1, -1], [[0, 1, 2, 3]])) == pytest.approx([-60.0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_torsion_equals_mdtraj(alanine_dipeptide: Scene, dtype: type) -> None:
    import mdtraj

    rng = np.random.default_rng(0)
    frames = (alanine_dipeptide.positions_nm + rng.normal(size=(300, 22, 3)) * 0.05).astype(dtype)
    topology = alanine_dipeptide.to_mdtraj_topology()
    trajectory = mdtraj.Trajectory(frames, topology)
    found = backbone_torsions(alanine_dipeptide)
    for key, compute in (("phi", mdtraj.compute_phi), ("psi", mdtraj.compute_psi)):
        quads, expected = compute(trajectory)
        assert found[key].tolist() == quads.tolist()
        angles = torsion(frames, found[key])
        assert angles.dtype == dtype
        assert np.abs(np.angle(np.exp(1j * (angles - expected)))).max() < 1e-4


def test_torsion_equals_mdtraj_on_recorded_frames(shared_data: Path) -> None:
    import mdtraj

    trajectory = mdtraj.load(str(shared_data / "mdtraj" / "ala2.h5"))
    quads, expected = mdtraj.compute_psi(trajectory)
    angles = torsion(trajectory.xyz, quads)
    assert np.abs(np.angle(np.exp(1j * (angles - expected)))).max() < 1e-4
    assert np.abs(np.angle(np.exp(1j * (angles + expected)))).max() > 0.5  # the other sign would show


def test_torsion_takes_one_frame_and_no_torsions(alanine_dipeptide: Scene) -> None:
    assert torsion(alanine_dipeptide.positions_nm, [[4, 6, 8, 14]]).shape == (1,)
    assert torsion(alanine_dipeptide.positions_nm[None], np.empty((0, 4))).shape == (1, 0)
    with pytest.raises(InputError, match="n_frames, n_atoms, 3"):
        torsion(np.zeros((2, 2)), [[0, 1, 0, 1]])


def test_signed_volume_tells_the_mirror_image(alanine_dipeptide: Scene) -> None:
    quad = [[8, 6, 14, 10]]  # CA: N, C, CB of an L residue
    assert signed_volumes(alanine_dipeptide.positions_nm, quad)[0] > 0
    assert signed_volumes(alanine_dipeptide.positions_nm * [1, 1, -1], quad)[0] < 0


@pytest.mark.parametrize("noise", [0.0, 0.02, 0.3])
def test_superposition_is_the_best_rotation(alanine_dipeptide: Scene, noise: float) -> None:
    template = alanine_dipeptide.positions_nm
    idx = alanine_dipeptide.heavy_idx
    frames = _rotated_copies(template, 50, noise)
    rotation, translation = superposition(frames, template, idx=idx)
    centre = template[idx].mean(axis=0)
    for x, r in zip(frames[:, idx], rotation, strict=True):
        expected, _ = Rotation.align_vectors(template[idx] - centre, x - x.mean(axis=0))
        assert r == pytest.approx(expected.as_matrix(), abs=1e-9)
    assert superpose(frames, template, idx=idx) == pytest.approx(
        np.einsum("nij,naj->nai", rotation, frames) + translation[:, None], abs=1e-12
    )


def test_superpose_never_reflects(alanine_dipeptide: Scene) -> None:
    template = alanine_dipeptide.positions_nm
    frames = _rotated_copies(template * [1, 1, -1], 100, 0.0)
    rotation, _ = superposition(frames, template)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert _rmsd(superpose(frames, template), template).min() > 0.05
    assert _rmsd(superpose(frames * [1, 1, -1], template), template).max() < 1e-9


@pytest.mark.parametrize("flatten", [[1, 1, 0], [1, 0, 0], [0, 0, 0]], ids=["planar", "linear", "point"])
def test_superpose_handles_degenerate_shapes(alanine_dipeptide: Scene, flatten: list[int]) -> None:
    template = alanine_dipeptide.positions_nm * flatten
    frames = _rotated_copies(template, 200, 0.0)
    rotation, _ = superposition(frames, template)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert _rmsd(superpose(frames, template), template).max() < 1e-7


def test_superpose_keeps_dtype_inputs_and_shape(alanine_dipeptide: Scene) -> None:
    template = alanine_dipeptide.positions_nm
    frames = _rotated_copies(template, 3, 0.01).astype(np.float32)
    before = frames.copy()
    assert superpose(frames, template).dtype == np.float32
    assert superpose(frames[0], template).shape == (22, 3)
    assert (frames == before).all()
    bad = frames.copy()
    bad[1] = np.nan
    moved = superpose(bad, template)
    assert np.isnan(moved[1]).all()
    assert np.isfinite(moved[[0, 2]]).all()


def test_superposition_refuses_what_does_not_fit(alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    with pytest.raises(InputError, match="22 atoms"):
        superpose(x, x[:5])
    with pytest.raises(InputError, match="no atom"):
        superpose(x, x, idx=[])


def test_superposition_is_fast(alanine_dipeptide: Scene) -> None:
    template = alanine_dipeptide.positions_nm[alanine_dipeptide.heavy_idx]
    frames = _rotated_copies(template, 50_000, 0.02).astype(np.float32)
    start = process_time()
    superposition(frames, template)
    assert len(frames) / (process_time() - start) > 30_000  # of processor time; about 500,000 a second


@pytest.mark.parametrize("n_points", [0, 1, 200, 301])
def test_near_pairs_are_those_of_a_tree_however_they_are_found(n_points: int) -> None:
    points = np.random.default_rng(n_points).uniform(size=(n_points, 3))
    expected = sorted(cKDTree(points).query_pairs(0.2)) if n_points else []
    assert [tuple(pair) for pair in near_pairs(points, 0.2).tolist()] == expected
