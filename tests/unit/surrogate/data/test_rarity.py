"""Rare windows are drawn more often and count less by exactly as much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from surrogate.data.frames import TrainingFrames, canonicalise, quantise
from surrogate.data.rarity import KIND_SHARE, rare_frames, rare_kinds, window_kinds, window_sampler
from surrogate.models.lam_slide.kinds import kinds_of_windows
from systems.errors import InputError
from systems.library.named_scenes import load

LENGTH = 8


@pytest.fixture(scope="module")
def frames() -> TrainingFrames:
    """4,000 frames of alanine dipeptide, twelve of them its mirror image, with phi and psi of the other sign."""
    scene = load("alanine-dipeptide")
    x = np.repeat(scene.positions_nm[None], 4000, axis=0)
    x += np.random.default_rng(0).normal(0.0, 0.002, x.shape)
    x[700:712] *= np.array([-1.0, 1.0, 1.0])
    return TrainingFrames(scene, quantise(canonicalise(x, scene)), np.array([0, 4000]), 1.0, True, {}, ())


def test_rare_frames_are_found(frames: TrainingFrames) -> None:
    rare = rare_frames(frames)
    assert rare.shape == (2, 4000)
    assert (np.flatnonzero(rare[0]) == np.arange(700, 712)).all()


def test_draws_are_more_and_weigh_less(frames: TrainingFrames) -> None:
    sampler = window_sampler(frames, LENGTH, 0.3)
    first, weight, kind = sampler.draw(40_000, torch.Generator().manual_seed(0))
    assert kind is None
    in_rare = ((first + LENGTH > 700) & (first < 712)).double()
    starts = frames.window_starts(LENGTH, validation=False)
    truth = float(((starts + LENGTH > 700) & (starts < 712)).mean())
    error = float((in_rare * weight).std()) / 200.0
    assert abs(float((in_rare * weight).mean()) - truth) < 4 * error
    assert error < 0.05 * truth  # tight enough to see a weight that is wrong by a fifth
    assert abs(float(weight.mean()) - 1.0) < 0.01
    # Negative control: without weights the rare windows would count twenty times too much.
    assert float(in_rare.mean()) > 20 * truth


def test_kinds_tell_a_visit_from_a_stay(frames: TrainingFrames) -> None:
    kinds = rare_kinds(frames, LENGTH)
    own = frames.window_starts(LENGTH, validation=False)
    of = window_kinds(frames, kinds, LENGTH)
    assert (np.flatnonzero(of) == np.arange(700 - LENGTH + 1, 712)).all()
    inside = np.arange(700, 712 - LENGTH + 1)
    stays = [place for place, kind in enumerate(kinds, start=1) if kind.visited is None]
    assert np.isin(of[inside], stays).all()
    assert not np.isin(np.delete(of, inside), stays).any()
    shares = np.array([(of[own] == k).mean() for k in range(len(kinds) + 1)])
    assert shares[0] > 0.98 and (shares[1:] <= KIND_SHARE).all()
    # A chunk that a model has drawn is told by the same rule.
    starts = np.arange(690, 715)
    windows = np.stack([frames.positions_nm(np.arange(k, k + LENGTH)) for k in starts])
    assert (kinds_of_windows(windows, kinds) == of[starts]).all()
    assert (kinds_of_windows(windows[:, ::-1], kinds) == of[starts]).all()


def test_kinds_are_drawn_more_often_and_keep_their_own_shares(frames: TrainingFrames) -> None:
    kinds = window_kinds(frames, rare_kinds(frames, LENGTH), LENGTH)
    sampler = window_sampler(frames, LENGTH, 0.3, kinds)
    first, weight, kind = sampler.draw(40_000, torch.Generator().manual_seed(0))
    assert kind is not None and torch.equal(kind, torch.from_numpy(kinds)[first])
    starts = frames.window_starts(LENGTH, validation=False)
    for k in np.unique(kinds[kinds > 0]):
        truth = float((kinds[starts] == k).mean())
        mine = (kind == k).double()
        assert float((mine * weight).mean()) == pytest.approx(truth, rel=0.1)
        assert float(mine.mean()) > 5 * truth  # the control: unweighted they are far too many
        counts = torch.bincount(first[kind == k])
        counts = counts[counts > 0].double()
        assert float(counts.max() / counts.min()) < 2.0, "within a kind, each window is as likely as the others"


def test_no_rare_draws_is_the_plain_draw(frames: TrainingFrames) -> None:
    sampler = window_sampler(frames, LENGTH, 0.0)
    first, weight, _ = sampler.draw(50, torch.Generator().manual_seed(3))
    starts = torch.from_numpy(frames.window_starts(LENGTH, validation=False))
    plain = starts[torch.randint(len(starts), (50,), generator=torch.Generator().manual_seed(3))]
    assert torch.equal(first, plain) and bool((weight == 1).all())


def test_what_cannot_be_told_is_refused(frames: TrainingFrames, harmonic_frames: TrainingFrames) -> None:
    with pytest.raises(InputError, match="less than 1"):
        window_sampler(frames, LENGTH, 1.0)
    rigid = replace(harmonic_frames, scene=load("benzene"), coordinates=np.zeros((800, 12, 3), dtype=np.int16))
    with pytest.raises(InputError, match="no rotatable torsion"):
        window_sampler(rigid, LENGTH, 0.3)
    with pytest.raises(InputError, match="shows no rare state"):
        rare_kinds(rigid, LENGTH)
