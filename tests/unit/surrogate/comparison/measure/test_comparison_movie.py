"""The viewer's movie: the frames asked for, unchanged but for a rigid motion, and small."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surrogate.comparison.measure import movie
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble
from systems.chemistry import validity
from systems.chemistry.geometry import signed_volumes


def features_of(ensemble: Ensemble) -> Features:
    nothing = [np.zeros((n, 0), dtype=np.float32) for n in ensemble.segment_lengths]
    flags = [np.arange(n, dtype=np.uint16) % 7 for n in ensemble.segment_lengths]
    return Features(ensemble.label, ensemble.lag_ps, nothing, nothing, nothing, flags, ensemble.chunk_idx)


@pytest.fixture
def pair(simulate: Callable[..., Ensemble]) -> tuple[Ensemble, Ensemble]:
    """Two runs of 600 frames, the second in three segments and in chunks."""
    candidate = simulate(42, 600, 3)
    chunks = [np.repeat(np.arange(20, dtype=np.int32), 10) for _ in range(3)]
    return simulate(41, 600), replace(candidate, chunk_idx=chunks)


def made(reference: Ensemble, candidate: Ensemble, n_frames: int = 600) -> movie.Movie:
    return movie.make_movie(reference, candidate, features_of(reference), features_of(candidate), n_frames)


def decoded(text: str, n_frames: int, scale: float) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<i2").reshape(n_frames, -1, 3) * scale


def distances(frames: np.ndarray) -> np.ndarray:
    return np.linalg.norm(frames[:, :, None] - frames[:, None], axis=-1)


def test_frames_are_those_of_the_files_moved_rigidly(pair: tuple[Ensemble, Ensemble]) -> None:
    reference, candidate = pair
    record: dict[str, Any] = json.loads(json.dumps(made(reference, candidate).to_dict()))
    names = [clip["name"] for clip in record["clips"]]
    assert names == ["whole length", "frame by frame"]
    for clip in record["clips"]:
        n = len(clip["time"])
        idx = np.rint(np.array(clip["time"]) / 1.0).astype(int) - 1
        assert idx[0] == 0 and n == movie.MAX_FRAMES
        for who, ensemble in zip(("reference", "candidate"), pair, strict=True):
            ref = np.concatenate(list(ensemble.segments))[idx].astype(np.float64)
            shown = decoded(clip[who], n, record["scale"])
            # Half a unit of rounding in each of six coordinates: at most sqrt(3) units of length.
            np.testing.assert_allclose(distances(shown), distances(ref), rtol=0, atol=1.75 * record["scale"])
            quad = np.array([[8, 6, 10, 14]])
            assert (np.sign(signed_volumes(shown, quad)) == np.sign(signed_volumes(ref, quad))).all()
            assert clip[f"{who}Flags"] == np.concatenate(features_of(ensemble).flags)[idx].tolist()
        assert clip["chunk"] == np.concatenate(list(candidate.chunk_idx or []))[idx].tolist()
    assert record["clips"][0]["time"][-1] == 600.0
    assert record["clips"][1]["time"] == [float(t) for t in range(1, movie.MAX_FRAMES + 1)]
    assert record["scale"] < 2e-4


def test_superposed_frames_lie_on_each_other(pair: tuple[Ensemble, Ensemble]) -> None:
    reference, _ = pair
    rng = np.random.default_rng(0)
    frames = np.repeat(np.concatenate(list(reference.segments))[:1], 600, axis=0)
    rotations = np.linalg.qr(rng.standard_normal((600, 3, 3)))[0]
    rotations[np.linalg.det(rotations) < 0] *= -1
    turned = (frames @ rotations + rng.standard_normal((600, 1, 3))).astype(np.float32)
    result = made(replace(reference, segments=[frames]), replace(reference, segments=[turned]))
    clip = result.clips[0]
    np.testing.assert_allclose(clip.candidate, clip.reference, atol=2)
    # The longest axis lies across the picture, the shortest towards the viewer.
    spread = clip.reference[0].astype(float).std(axis=0)
    assert spread[0] > spread[1] > spread[2]
    assert np.abs(decoded(base64.b64encode(clip.reference.tobytes()).decode(), 240, result.scale_nm)).max() < 1.0


def test_broken_frames_are_marked_and_exploded_ones_cut_off(pair: tuple[Ensemble, Ensemble]) -> None:
    reference, candidate = pair
    segments = [s.copy() for s in candidate.segments]
    segments[0][3, 5] = np.nan
    segments[0][4] = 1e30
    segments[0][5, 7] += 1e5
    clip = made(reference, replace(candidate, segments=segments)).clips[1]
    assert (clip.candidate[[3, 4]] == movie.NOT_FINITE).all()
    others = np.delete(clip.candidate, [3, 4], axis=0)
    assert (others != movie.NOT_FINITE).all() and np.abs(others[3]).max() == 32767
    assert (clip.reference != movie.NOT_FINITE).all()


def test_a_reference_that_begins_broken_still_gives_a_picture(pair: tuple[Ensemble, Ensemble]) -> None:
    reference, candidate = pair
    frames = reference.segments[0].copy()
    frames[0] = np.nan
    clip = made(replace(reference, segments=[frames]), candidate).clips[1]
    assert (clip.reference[0] == movie.NOT_FINITE).all() and (clip.reference[1:] != movie.NOT_FINITE).all()


def test_large_molecules_lose_hydrogens_and_frames(
    pair: tuple[Ensemble, Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(movie, "HYDROGENS_UP_TO", 10)
    monkeypatch.setattr(movie, "MAX_NUMBERS", 900)
    result = made(*pair)
    assert result.hydrogens_left_out and set(result.elements) == {"C", "N", "O"}
    assert len(result.elements) == 10 and len(result.bonds) == 9
    assert result.clips[0].reference.shape == (30, 10, 3)
    elements = [pair[0].scene.elements[a] for a in range(22) if pair[0].scene.elements[a] != "H"]
    assert list(result.elements) == elements


def test_faults_are_named_by_their_bits(pair: tuple[Ensemble, Ensemble]) -> None:
    faults = made(*pair).to_dict()["faults"]
    assert faults[str(validity.CLASH)] == "clash"
    raised = validity.INVALID | validity.BOND_20_PERCENT
    assert {bit for bit in range(16) if raised >> bit & 1} <= {int(bit).bit_length() - 1 for bit in faults}
    assert all(faults.values())


def test_frames_are_picked_through_segments(pair: tuple[Ensemble, Ensemble]) -> None:
    _, candidate = pair
    everything = np.concatenate(list(candidate.segments))
    for idx in (np.arange(190, 215), np.array([0, 199, 200, 201, 400, 599]), np.array([250])):
        np.testing.assert_array_equal(movie.pick_frames(candidate.segments, idx), everything[idx])
