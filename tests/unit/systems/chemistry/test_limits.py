"""Limits of a reference: quiet on frames like its own, and each check catches its own fault."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from systems.chemistry.validity import ANGLE, DRIFT, JUMP, PLANARITY, STILL, Limits, check_limits, limits_from_frames
from systems.errors import InputError
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

HA, CH3, C, O_, N, CA, HB = 2, 1, 4, 5, 6, 8, 11  # atoms of the library's ACE-ALA-NME


def vibrate(scene: Scene, n_frames: int, seed: int) -> np.ndarray:
    """Frames that vibrate about the library geometry by 0.004 nm and remember each other a little."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(n_frames, scene.n_atoms, 3))
    for t in range(1, n_frames):
        noise[t] = 0.8 * noise[t - 1] + 0.6 * noise[t]
    frames: np.ndarray = scene.positions_nm + 0.004 * noise
    return frames


@pytest.fixture(scope="module")
def limits(alanine_dipeptide: Scene) -> Limits:
    frames = vibrate(alanine_dipeptide, 4000, seed=0)
    return limits_from_frames(alanine_dipeptide, frames[:-1], frames[1:])


def check(frames: np.ndarray, limits: Limits) -> np.ndarray:
    return check_limits(frames[1:], limits, frames[:-1])


def rotated(x: np.ndarray, atoms: list[int], about: tuple[int, int], degrees: float) -> np.ndarray:
    """Turn atoms about an axis through the first of `about` that is perpendicular to the bond of the two."""
    origin, towards = x[about[0]], x[about[1]] - x[about[0]]
    axis = np.cross(towards, x[atoms[0]] - origin)
    return turned(x, atoms, origin, axis, degrees)


def turned(x: np.ndarray, atoms: list[int], origin: np.ndarray, axis: np.ndarray, degrees: float) -> np.ndarray:
    u, a = axis / np.linalg.norm(axis), np.deg2rad(degrees)
    k = np.array([[0, -u[2], u[1]], [u[2], 0, -u[0]], [-u[1], u[0], 0]])
    out = x.copy()
    out[atoms] = origin + (x[atoms] - origin) @ (np.eye(3) + np.sin(a) * k + (1 - np.cos(a)) * k @ k).T
    return out


def test_atoms_of_this_file(alanine_dipeptide: Scene) -> None:
    names = [alanine_dipeptide.atom_names[k] for k in (CH3, C, O_, N, CA)]
    assert names == ["CH3", "C", "O", "N", "CA"]
    assert alanine_dipeptide.elements[HA] == alanine_dipeptide.elements[HB] == "H"


def test_other_frames_of_the_same_motion_pass(limits: Limits, alanine_dipeptide: Scene) -> None:
    assert not check(vibrate(alanine_dipeptide, 20_000, seed=1), limits).any()
    # Negative control: a motion three times as wide is noticed.
    wide = alanine_dipeptide.positions_nm + 3 * (vibrate(alanine_dipeptide, 500, 2) - alanine_dipeptide.positions_nm)
    assert (check(wide, limits) & ANGLE).any()


def test_limits_are_one_and_a_half_times_the_reach_of_the_reference(alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    frames = np.stack([x, rotated(x, [HA], (CH3, C), 4.0), rotated(x, [HA], (CH3, C), -4.0)])
    found = limits_from_frames(alanine_dipeptide, frames, frames[[1, 2, 0]])
    row = next(k for k, (a, b, c) in enumerate(found.angle_idx.tolist()) if b == CH3 and {a, c} == {HA, C})
    a, b, c = (x[k] for k in found.angle_idx[row])
    angle = np.arccos((a - b) @ (c - b) / np.linalg.norm(a - b) / np.linalg.norm(c - b))
    assert found.angle_max_rad[row] == pytest.approx(angle + np.deg2rad(6.0), abs=1e-6)
    assert found.angle_min_rad[row] == pytest.approx(angle - np.deg2rad(6.0), abs=1e-6)


def test_an_angle_too_far_is_caught_and_nothing_else(limits: Limits, alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    for degrees, caught in ((5.0, False), (40.0, True), (-40.0, True)):
        bent = rotated(x, [HA], (CH3, C), degrees)
        assert np.linalg.norm(bent[HA] - x[CH3]) == pytest.approx(np.linalg.norm(x[HA] - x[CH3]), abs=1e-9)
        assert check(np.stack([x, bent]), limits).tolist() == [ANGLE if caught else 0]


def test_a_carbonyl_out_of_its_plane_is_caught(limits: Limits, alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    assert {C, N} <= set(limits.flat_idx[:, 0].tolist()), "carbonyl carbon and amide nitrogen are flat"
    assert CA not in limits.flat_idx[:, 0], "an sp3 carbon is not"
    normal = np.cross(x[CH3] - x[C], x[N] - x[C])
    bent = turned(x, [O_], x[C], np.cross(x[O_] - x[C], normal), 35.0)
    assert check(np.stack([x, bent]), limits)[0] & PLANARITY
    assert not check(np.stack([x, turned(x, [O_], x[C], np.cross(x[O_] - x[C], normal), 3.0)]), limits)[0] & PLANARITY


def test_jumps_are_measured_free_of_the_pose_and_drift_is_told_apart(limits: Limits, alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    graph_side = list(range(6, 22))  # all beyond the bond C-N
    flipped = turned(x, graph_side, x[C], x[N] - x[C], 120.0)
    assert check(np.stack([x, flipped]), limits)[0] & JUMP
    spun = turned(x, list(range(22)), x.mean(axis=0), np.array([1.0, 2.0, 3.0]), 70.0)
    assert not check(np.stack([x, spun]), limits)[0] & JUMP, "turning as a whole is no jump"
    far = check(np.stack([x, x + 0.2]), limits)
    assert far.tolist() == [DRIFT | STILL], "of the whole: nothing in it has moved"
    assert check(np.stack([x, x + 1e-4]), limits).tolist() == [STILL]
    assert check_limits(flipped[None], limits, flipped[None]).tolist() == [0], "a frame without one before is its own"


def test_a_frame_that_is_not_finite_is_beyond_every_limit(limits: Limits, alanine_dipeptide: Scene) -> None:
    x = alanine_dipeptide.positions_nm
    hole = np.full_like(x, np.nan)
    flags = check(np.stack([x, hole, x]), limits)
    assert flags[0] == ANGLE | PLANARITY | JUMP | DRIFT
    assert flags[1] == JUMP | DRIFT, "and so is the step away from it"


def test_limits_survive_json_exactly(limits: Limits, alanine_dipeptide: Scene) -> None:
    again = Limits.from_dict(json.loads(json.dumps(limits.to_dict())))
    frames = vibrate(alanine_dipeptide, 300, seed=5) + 0.004 * np.random.default_rng(0).normal(size=(300, 22, 3))
    flags = check(frames, limits)
    assert flags.any()
    assert np.array_equal(check(frames, again), flags)
    with pytest.raises(InputError, match="angle_idx is missing"):
        Limits.from_dict({"jump_max_nm": 1.0})
    with pytest.raises(InputError, match="malformed"):
        Limits.from_dict({**limits.to_dict(), "jump_idx": "x"})
    with pytest.raises(InputError, match="do not fit"):
        limits_from_frames(alanine_dipeptide, frames, frames[1:])


def test_molecules_too_small_for_angles_or_jumps_have_none() -> None:
    from systems.prepare.molecule import scene_from_smiles

    scene = scene_from_smiles("[HH]")
    frames = np.repeat(scene.positions_nm[None], 5, axis=0)
    found = limits_from_frames(scene, frames, frames)
    assert len(found.angle_idx) == len(found.flat_idx) == 0
    assert check_limits(frames, found, frames).tolist() == [0] * 5


def test_other_peoples_md_passes_the_limits_of_its_own_replicas(shared_data: Path) -> None:
    """Seven published runs of 10 ns: limits from four (every second frame), checked on the other three."""
    folder = shared_data / "alanine-dipeptide"
    frames = []
    for k in range(7):
        with open_trajectory(folder / f"trajectory-{k}.dcd", top=folder / "ala2.pdb") as reader:
            frames.append(reader.read())
            scene = reader.scene
    assert scene is not None
    first = np.concatenate([x[:-1:2] for x in frames[:4]])
    limits = limits_from_frames(scene, first, np.concatenate([x[1::2] for x in frames[:4]]))
    centred = [x - x[:, np.unique(limits.jump_idx)].mean(axis=1, keepdims=True) for x in frames[4:]]
    flags = np.concatenate([check(x, limits) for x in centred])
    assert len(flags) > 29_000
    assert np.count_nonzero(flags) <= 2


def test_a_molecule_that_stands_still_is_caught(alanine_dipeptide: Scene, limits: Limits) -> None:
    frames = vibrate(alanine_dipeptide, 500, seed=7)
    assert 0.0 < limits.jump_min_nm < limits.jump_max_nm / 3.0
    centre = frames[:1]
    trembling = centre + 1e-3 * (frames - frames.mean(axis=0))
    assert (check_limits(trembling[1:], limits, trembling[:-1]) & STILL).all()
    assert not (check_limits(frames[1:], limits, frames[:-1]) & STILL).any()
    drifting = centre + np.linspace(0.0, 1e-4, len(frames))[:, None, None]
    assert (check_limits(drifting[1:], limits, drifting[:-1]) & STILL).all(), "as a whole is not enough"
    older = Limits.from_dict({k: v for k, v in limits.to_dict().items() if k != "jump_min_nm"})
    assert older.jump_min_nm == 0.0 and not check_limits(trembling[1:], older, trembling[:-1]).any()
