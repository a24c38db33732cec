"""Geometry learned from reference frames: means, what is left out, records; large scenes; blocks and order."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from small_scenes import benzene, beyond, rotated, scene_of, stretched
from systems.chemistry.validity import (
    BOND_20_PERCENT,
    BOND_HALF_ANGSTROM,
    CHIRALITY,
    CLASH,
    CLASH_NM,
    INVALID,
    NOT_FINITE,
    OMEGA,
    RING,
    Geometry,
    check_frames,
    flag_names,
    geometry_from_frames,
    geometry_from_scene,
)
from systems.errors import InputError
from systems.scene import Scene


def wobbling(scene: Scene, n: int, sigma_nm: float = 0.002) -> np.ndarray:
    noise = np.random.default_rng(3).normal(scale=sigma_nm, size=(n, scene.n_atoms, 3))
    return (scene.positions_nm + noise).astype(np.float32)


def test_means_and_spreads_come_from_the_frames(alanine_dipeptide: Scene) -> None:
    frames = wobbling(alanine_dipeptide, 400)
    frames[7] = np.nan  # is not used
    geometry = geometry_from_frames(alanine_dipeptide, frames)
    good = np.delete(frames, 7, axis=0).astype(np.float64)
    i, j = alanine_dipeptide.bonds.T
    length = np.linalg.norm(good[:, i] - good[:, j], axis=2)
    np.testing.assert_allclose(geometry.bond_mean_nm, length.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(geometry.bond_std_nm, length.std(axis=0), rtol=1e-2)
    assert check_frames(frames, geometry).nonzero()[0].tolist() == [7]


def test_what_the_reference_changes_is_left_out_and_named(alanine_dipeptide: Scene) -> None:
    frames = wobbling(alanine_dipeptide, 1000)
    start = alanine_dipeptide.positions_nm
    plain = geometry_from_frames(alanine_dipeptide, frames)
    assert plain.excluded == ()
    _, carbon, nitrogen, _ = plain.omega_idx[0].tolist()
    frames[:100] = rotated(start, beyond(alanine_dipeptide, carbon, nitrogen), (carbon, nitrogen), np.pi)
    frames[100:150] *= np.array([1.0, 1.0, -1.0], dtype=np.float32)
    frames[150:160] = stretched(alanine_dipeptide, 0.1)
    geometry = geometry_from_frames(alanine_dipeptide, frames)
    assert len(geometry.stereo_idx) == 0
    assert len(geometry.omega_idx) == 1
    assert len(geometry.bond_idx) == 20
    assert len(geometry.excluded) == 3
    assert any("stereocentre CA" in line and "5 %" in line for line in geometry.excluded)
    assert any(line.startswith("bond ") and "1 %" in line for line in geometry.excluded)
    assert any("torsion" in line and "10 %" in line for line in geometry.excluded)
    flags = check_frames(frames, geometry)
    assert not (flags & (CHIRALITY | OMEGA | BOND_HALF_ANGSTROM)).any()


def test_one_stray_frame_in_a_thousand_changes_no_rule(alanine_dipeptide: Scene) -> None:
    frames = wobbling(alanine_dipeptide, 2000)
    frames[5] *= np.array([1.0, 1.0, -1.0], dtype=np.float32)
    geometry = geometry_from_frames(alanine_dipeptide, frames)
    assert geometry.excluded == ()
    assert check_frames(frames, geometry).nonzero()[0].tolist() == [5]


def test_clash_distances_from_frames(alanine_dipeptide: Scene) -> None:
    frames = wobbling(alanine_dipeptide, 50)
    geometry = geometry_from_frames(alanine_dipeptide, frames)
    assert (geometry.clash_min_nm <= CLASH_NM).all()
    assert (geometry.clash_min_nm > 0.75 * CLASH_NM).all()
    i, j = geometry.clash_idx.T
    distance = np.linalg.norm(frames[:, i] - frames[:, j], axis=2)
    assert (distance.min(axis=0) >= geometry.clash_pair_min_nm / 0.8 - 1e-6).all()


def test_a_mirrored_reference_is_the_new_reference(alanine_dipeptide: Scene) -> None:
    """Handedness is the reference's, not the scene's."""
    mirrored = wobbling(alanine_dipeptide, 20) * np.array([1.0, 1.0, -1.0], dtype=np.float32)
    geometry = geometry_from_frames(alanine_dipeptide, mirrored)
    assert not check_frames(mirrored, geometry).any()
    assert check_frames(alanine_dipeptide.positions_nm, geometry).tolist() == [CHIRALITY]


# ---- the rest ------------------------------------------------------------------------------------------------------


def test_json_round_trip(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    measured = geometry_from_frames(alanine_dipeptide, wobbling(alanine_dipeptide, 30))
    frames = wobbling(alanine_dipeptide, 200, 0.03)
    for before in (geometry, measured, geometry_from_scene(benzene())):
        after = Geometry.from_dict(json.loads(json.dumps(before.to_dict())))
        assert after.to_dict() == before.to_dict()
    np.testing.assert_array_equal(
        check_frames(frames, measured), check_frames(frames, Geometry.from_dict(measured.to_dict()))
    )
    for record in ({}, measured.to_dict() | {"more": 1}, measured.to_dict() | {"bond_idx": [1, 2, 3]}):
        with pytest.raises(InputError):
            Geometry.from_dict(record)


def test_frames_that_do_not_fit(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    with pytest.raises(InputError, match="22"):
        check_frames(np.zeros((3, 21, 3)), geometry)
    with pytest.raises(InputError, match="22"):
        geometry_from_frames(alanine_dipeptide, np.zeros((3, 21, 3)))
    with pytest.raises(InputError, match="finite"):
        geometry_from_frames(alanine_dipeptide, np.full((3, 22, 3), np.nan))


def test_scenes_with_little_in_them() -> None:
    one = scene_of("C", [], np.zeros((1, 3)))
    two = scene_of("HF", [(0, 1, 1.0)], np.array([[0.0, 0, 0], [0.092, 0, 0]]))
    for scene in (one, two):
        for geometry in (geometry_from_scene(scene), geometry_from_frames(scene, scene.positions_nm[None])):
            assert check_frames(scene.positions_nm, geometry).tolist() == [0]
    assert check_frames(np.array([[0.0, 0, 0], [0.15, 0, 0]]), geometry_from_scene(two))[0] & BOND_HALF_ANGSTROM


def test_names_of_flags() -> None:
    assert flag_names(0) == []
    assert flag_names(CLASH | OMEGA) == ["clash", "peptide or double bond turned over"]
    bits = [NOT_FINITE, BOND_HALF_ANGSTROM, BOND_20_PERCENT, CLASH, CHIRALITY, OMEGA, RING]
    assert bits == [1 << k for k in range(7)]
    assert sum(bits) & ~BOND_20_PERCENT == INVALID


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 40), sigma=st.floats(0.0, 0.1))
def test_blocks_and_order_make_no_difference(
    alanine_dipeptide: Scene, geometry: Geometry, seed: int, n: int, sigma: float
) -> None:
    noise = np.random.default_rng(seed).normal(scale=sigma, size=(n, 22, 3))
    frames = alanine_dipeptide.positions_nm + noise
    together = check_frames(frames, geometry)
    np.testing.assert_array_equal(together, [check_frames(f, geometry)[0] for f in frames])
    np.testing.assert_array_equal(together[::-1], check_frames(frames[::-1], geometry))


def test_large_scenes_give_the_same_clashes() -> None:
    """Above the limit neighbours are searched with a tree; below, all pairs are listed. Both agree."""
    from systems.chemistry import validity

    generator = np.random.default_rng(5)
    n = 300
    positions = generator.uniform(size=(n, 3)) * 2.0
    elements = "".join(generator.choice(["C", "H"], size=n))
    scene = scene_of(elements, [(k, k + 1, 1.0) for k in range(0, n, 2)], positions)
    geometry = geometry_from_scene(scene)
    frames = generator.uniform(size=(40, n, 3)) * generator.uniform(1.0, 8.0, size=(40, 1, 1))
    frames[3, 7] = np.nan
    tree = check_frames(frames, geometry) & CLASH
    limit = validity.MAX_PAIRS
    try:
        validity.MAX_PAIRS = n * n  # type: ignore[misc]
        listed = check_frames(frames, geometry) & CLASH
    finally:
        validity.MAX_PAIRS = limit  # type: ignore[misc]
    np.testing.assert_array_equal(tree, listed)
    assert 0 < (tree > 0).mean() < 1


def test_fast_enough(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    """A check must cost at most 5 % of a rollout (about 0.5 ms a frame): 20 µs is asked, 2 µs are usual."""
    frames = wobbling(alanine_dipeptide, 5000)
    check_frames(frames[:100], geometry)
    best = min(_timed(frames, geometry) for _ in range(3))
    assert best / len(frames) < 20e-6


def _timed(frames: np.ndarray, geometry: Geometry) -> float:
    start = time.perf_counter()
    check_frames(frames, geometry)
    return time.perf_counter() - start
