"""Validity flags: valid frames pass, and each flag has a wrong frame that it must catch, and only it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from small_scenes import benzene, beyond, difluoroethene, rotated, scene_of, stretched
from systems.chemistry.validity import (
    BOND_20_PERCENT,
    BOND_HALF_ANGSTROM,
    CHIRALITY,
    CLASH,
    CONTACT_CLASSES,
    INVALID,
    NOT_FINITE,
    OMEGA,
    RING,
    Geometry,
    check_frames,
    contact_classes,
    geometry_from_frames,
    geometry_from_scene,
)
from systems.library.named_scenes import prepare
from systems.scene import Scene

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


def test_contact_classes() -> None:
    """Methanol's hydroxyl hydrogen is one that makes hydrogen bonds, its others are not."""
    scene = prepare("smiles:CO")
    classes = [CONTACT_CLASSES[k] for k in contact_classes(scene)]
    of_hydrogen = sorted(c for c, e in zip(classes, scene.elements, strict=True) if e == "H")
    assert of_hydrogen == ["hydrogen of C"] * 3 + ["hydrogen of N, O or S"]
    assert [c for c in classes if "hydrogen" not in c] == [e for e in scene.elements if e != "H"]


def test_clash(alanine_dipeptide: Scene, geometry: Geometry) -> None:
    names = list(alanine_dipeptide.atom_names)
    # The nearest that a methyl hydrogen may come to an oxygen is no hydrogen bond.
    oxygen = names.index("O")
    pairs = {tuple(p) for p in geometry.clash_idx.tolist()}
    far = next(i for i in range(22) if alanine_dipeptide.elements[i] == "C" and (oxygen, i) in pairs)
    hydrogen = next(i for i in range(22) if geometry.contact_class[i] == 1 and (oxygen, i) in pairs)
    (i, j), (k, m) = (oxygen, far), (oxygen, hydrogen)
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 4, axis=0)
    direction = np.array([1.0, 0.0, 0.0])
    for frame, (first, second, distance) in zip(
        frames, [(i, j, 0.205), (i, j, 0.207), (k, m, 0.163), (k, m, 0.165)], strict=True
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
