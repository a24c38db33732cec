"""Validity flags: valid frames pass, and each flag has a wrong frame that it must catch, and only it."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from systems.chemistry.validity import (
    BOND_20_PERCENT,
    BOND_HALF_ANGSTROM,
    CHIRALITY,
    CLASH,
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


@pytest.fixture(scope="module")
def geometry(alanine_dipeptide: Scene) -> Geometry:
    return geometry_from_scene(alanine_dipeptide)


def scene_of(elements: str, bonds: list[tuple[int, int, float]], positions_nm: np.ndarray) -> Scene:
    n = len(elements)
    return Scene(
        name="made",
        atom_names=tuple(f"{e}{i + 1}" for i, e in enumerate(elements)),
        elements=tuple(elements),
        residue_of_atom=np.zeros(n, dtype=np.int64),
        residue_names=("LIG",),
        residue_ids=("1",),
        chain_of_residue=("A",),
        bonds=np.array([b[:2] for b in bonds], dtype=np.int64).reshape(-1, 2),
        bond_orders=np.array([b[2] for b in bonds], dtype=np.float64),
        formal_charges=np.zeros(n, dtype=np.int64),
        masses_da=np.full(n, 12.0),
        positions_nm=positions_nm,
    )


def benzene() -> Scene:
    angles = np.arange(6) * np.pi / 3
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=1)
    bonds = [(k, (k + 1) % 6, 1.5) for k in range(6)] + [(k, k + 6, 1.0) for k in range(6)]
    ordered = [(min(i, j), max(i, j), o) for i, j, o in bonds]
    return scene_of("CCCCCCHHHHHH", ordered, np.concatenate([0.14 * ring, 0.248 * ring]))


def difluoroethene() -> Scene:
    """Trans FHC=CHF, flat."""
    positions = np.array(
        [[-0.066, 0, 0], [0.066, 0, 0], [-0.135, 0.115, 0], [0.135, -0.115, 0], [-0.12, -0.094, 0], [0.12, 0.094, 0]]
    )
    bonds = [(0, 1, 2.0), (0, 2, 1.0), (1, 3, 1.0), (0, 4, 1.0), (1, 5, 1.0)]
    return scene_of("CCFFHH", bonds, positions)


def rotated(positions: np.ndarray, atoms: list[int], axis: tuple[int, int], angle: float) -> np.ndarray:
    """Turn `atoms` about the bond `axis`."""
    origin, end = positions[axis[0]], positions[axis[1]]
    k = (end - origin) / np.linalg.norm(end - origin)
    v = positions[atoms] - origin
    out = positions.copy()
    out[atoms] = origin + v * np.cos(angle) + np.cross(k, v) * np.sin(angle) + np.outer(v @ k, k) * (1 - np.cos(angle))
    return out


def beyond(scene: Scene, start: int, end: int) -> list[int]:
    """Atoms on the side of `end` of the bond from `start` to `end`."""
    from systems.chemistry.graph import bonded_graph

    graph = bonded_graph(scene)
    graph.remove_edge(start, end)
    import networkx as nx

    return sorted(nx.node_connected_component(graph, end))


# ---- valid frames --------------------------------------------------------------------------------------------------


def test_the_start_is_valid_however_it_lies(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    from scipy.spatial.transform import Rotation

    turns = Rotation.random(20, random_state=1).as_matrix()
    frames = alanine_dipeptide.positions_nm @ turns.transpose(0, 2, 1) + 3.0
    np.testing.assert_array_equal(check_frames(frames, geometry), np.zeros(20, dtype=np.uint16))
    assert check_frames(frames.astype(np.float32), geometry).dtype == np.uint16
    assert check_frames(frames[0], geometry).shape == (1,)
    assert check_frames(frames[:0], geometry).shape == (0,)


def test_every_frame_of_a_real_simulation_is_valid(shared_data: Path) -> None:
    from systems.trajectory.codec import open_trajectory

    folder = shared_data / "alanine-dipeptide"
    with open_trajectory(folder / "trajectory-1.dcd", top=folder / "ala2.pdb") as reader:
        reference, scene = reader.read(), reader.scene
    with open_trajectory(folder / "trajectory-2.dcd", top=folder / "ala2.pdb") as reader:
        other = reader.read()
    assert scene is not None
    measured = geometry_from_frames(scene, reference)
    assert measured.excluded == ()
    assert (len(measured.stereo_idx), len(measured.omega_idx), len(measured.bond_idx)) == (1, 2, 21)
    assert not check_frames(reference, measured).any()
    assert not check_frames(other, measured).any()  # a frame the geometry has not seen
    assert not check_frames(other, geometry_from_scene(scene.with_positions(reference[0]))).any()
    # and frames that are wrong by as much as a poor model's are found out
    noise = np.random.default_rng(0).normal(scale=0.02, size=other.shape)
    assert (check_frames(other + noise, measured) & BOND_20_PERCENT).astype(bool).mean() > 0.9


@pytest.mark.filterwarnings("ignore:.*header states 500 frames")
def test_a_protein_on_its_way_is_valid(shared_data: Path) -> None:
    """Adenylate kinase, 3,341 atoms, 98 frames of a transition."""
    from systems.trajectory.codec import open_trajectory

    folder = shared_data / "adk"
    with open_trajectory(folder / "adk_dims.dcd", top=folder / "adk_open.pdb") as reader:
        frames, scene = reader.read(stride=10), reader.scene
    assert scene is not None
    geometry = geometry_from_frames(scene, frames)
    assert (geometry.excluded, len(geometry.omega_idx)) == ((), 213)
    assert not check_frames(frames, geometry).any()
    frames[4, :, 0] *= -1.0
    frames[6, 100] = frames[6, 2000]
    flags = check_frames(frames, geometry)
    assert flags.nonzero()[0].tolist() == [4, 6]
    assert flags[4] == CHIRALITY
    assert flags[6] & CLASH


# ---- one wrong frame for each flag ---------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite(alanine_dipeptide: Scene, geometry: Geometry, bad: float) -> None:
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 3, axis=0)
    frames[1, 5, 2] = bad
    flags = check_frames(frames, geometry)
    assert flags[1] & NOT_FINITE
    assert flags[0] == flags[2] == 0


def stretched(scene: Scene, by_nm: float) -> np.ndarray:
    """The first bond that ends in one atom alone, longer by `by_nm`."""
    i, j = next((i, j) for i, j in scene.bonds.tolist() if beyond(scene, i, j) == [j])
    positions = scene.positions_nm.copy()
    step = positions[j] - positions[i]
    positions[j] += by_nm * step / np.linalg.norm(step)
    return positions


def test_bond_half_an_angstrom_off(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    at_051, at_049, at_015 = (stretched(alanine_dipeptide, d) for d in (0.051, 0.049, 0.015))
    flags = check_frames(np.stack([at_051, at_049, at_015]), geometry)
    assert flags.tolist() == [BOND_HALF_ANGSTROM | BOND_20_PERCENT, BOND_20_PERCENT, 0]
    assert (flags & INVALID).astype(bool).tolist() == [True, False, False]


def test_mirror_image(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    mirrored = alanine_dipeptide.positions_nm * np.array([1.0, 1.0, -1.0])
    assert check_frames(mirrored, geometry).tolist() == [CHIRALITY]


def test_stereocentre_pushed_through_its_neighbours(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    centre, a, b, c = geometry.stereo_idx[0]
    start = alanine_dipeptide.positions_nm
    plane = (start[a] + start[b] + start[c]) / 3.0
    out = (start[centre] - plane) / np.linalg.norm(start[centre] - plane)
    frames = np.repeat(start[None], 2, axis=0)
    frames[:, centre] = plane + np.array([[0.001], [-0.001]]) * out
    assert (check_frames(frames, geometry) & CHIRALITY).tolist() == [0, CHIRALITY]


def test_cis_peptide(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    """Either peptide bond turned over by half a turn; the bonds, angles and stereocentre stay."""
    assert len(geometry.omega_idx) == 2
    assert geometry.omega_sign.tolist() == [-1, -1]
    for _, carbon, nitrogen, _ in geometry.omega_idx.tolist():
        turned = beyond(alanine_dipeptide, carbon, nitrogen)
        start = alanine_dipeptide.positions_nm
        over = rotated(start, turned, (carbon, nitrogen), np.pi)
        assert (check_frames(over, geometry)[0] & ~np.uint16(CLASH)) == OMEGA
        twisted = rotated(start, turned, (carbon, nitrogen), np.deg2rad(40.0))
        assert check_frames(twisted, geometry)[0] & OMEGA == 0


def test_a_free_torsion_may_turn(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    from systems.chemistry.graph import backbone_torsions

    for key in ("phi", "psi"):
        _, b, c, _ = backbone_torsions(alanine_dipeptide)[key][0].tolist()
        for angle in (-0.4, 0.4):
            moved = rotated(alanine_dipeptide.positions_nm, beyond(alanine_dipeptide, b, c), (b, c), angle)
            assert check_frames(moved, geometry)[0] & (OMEGA | CHIRALITY | BOND_HALF_ANGSTROM) == 0


def test_clash(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    heavy = geometry.hydrogen[geometry.clash_idx].sum(axis=1) == 0
    i, j = geometry.clash_idx[heavy][0].tolist()
    with_h = geometry.hydrogen[geometry.clash_idx].sum(axis=1) == 1
    k, m = geometry.clash_idx[with_h][0].tolist()
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 4, axis=0)
    direction = np.array([1.0, 0.0, 0.0])
    for frame, (first, second, distance) in zip(
        frames, [(i, j, 0.199), (i, j, 0.201), (k, m, 0.099), (k, m, 0.101)], strict=True
    ):
        frame[second] = frame[first] + distance * direction
    only_pair = Geometry.from_dict(
        geometry.to_dict() | {"bond_idx": [], "bond_mean_nm": [], "bond_std_nm": [], "stereo_idx": [],
                              "stereo_sign": [], "omega_idx": [], "omega_sign": []}
    )  # fmt: skip
    near = np.argwhere(np.triu(np.ones((22, 22), dtype=bool), 1))
    for pair, part in (((i, j), slice(0, 2)), ((k, m), slice(2, 4))):
        others = [row for row in near.tolist() if row != sorted(pair)]
        alone = Geometry.from_dict(only_pair.to_dict() | {"near_idx": others})
        assert check_frames(frames[part], alone).tolist() == [CLASH, 0]
    assert check_frames(frames[0], geometry)[0] & CLASH


def test_neighbours_up_to_three_bonds_never_clash(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    from systems.chemistry.graph import exclusions

    pairs = {tuple(p) for p in geometry.clash_idx.tolist()}
    near = {tuple(p) for p in exclusions(alanine_dipeptide, depth=3).tolist()}
    assert not pairs & near
    assert len(pairs) + len(near) == 22 * 21 // 2


def test_double_bond_turned_over() -> None:
    scene = difluoroethene()
    geometry = geometry_from_scene(scene)
    assert len(geometry.omega_idx) == 1
    cis = rotated(scene.positions_nm, [3, 5], (0, 1), np.pi)
    assert check_frames(np.stack([scene.positions_nm, cis]), geometry).tolist() == [0, OMEGA]


def test_bent_ring() -> None:
    scene = benzene()
    geometry = geometry_from_scene(scene)
    assert len(geometry.ring_idx) == 6
    bent = scene.positions_nm.copy()
    bent[0, 2] += 0.12  # an envelope with its flap up by 1.2 Å
    rippled = scene.positions_nm.copy()
    rippled[0, 2] += 0.02
    assert [int(f) & RING for f in check_frames(np.stack([bent, rippled]), geometry)] == [RING, 0]


def test_a_puckered_ring_is_not_held_flat() -> None:
    scene = benzene()
    positions = scene.positions_nm.copy()
    positions[:6, 2] = 0.025 * np.array([1, -1, 1, -1, 1, -1])
    chair = scene_of("CCCCCC", [(k, k + 1, 1.0) for k in range(5)] + [(0, 5, 1.0)], positions[:6])
    assert len(geometry_from_scene(chair).ring_idx) == 0


# ---- the reference decides -----------------------------------------------------------------------------------------


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
    assert (geometry.clash_min_nm <= [0.14, 0.14, 0.24]).all()
    assert (geometry.clash_min_nm > [0.1, 0.1, 0.18]).all()
    i, j = geometry.clash_idx.T
    distance = np.linalg.norm(frames[:, i] - frames[:, j], axis=2)
    assert (distance.min(axis=0) >= geometry.clash_pair_min_nm / 0.8 - 1e-6).all()


def test_a_mirrored_reference_is_the_new_truth(alanine_dipeptide: Scene) -> None:
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
