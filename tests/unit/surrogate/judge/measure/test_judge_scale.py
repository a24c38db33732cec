"""Molecules of thousands of atoms, and what their few frames cannot carry: rows left out and named, never a crash."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.judge.comparison import compare
from surrogate.judge.measure import kinetics, msm
from surrogate.judge.measure.equal_atoms import evenly
from surrogate.judge.read.ensemble import load_ensemble
from surrogate.judge.rows.motion.relaxation_rows import speed_words


def test_more_torsions_than_frames_have_no_slowest_combination() -> None:
    rng = np.random.default_rng(0)
    few, many = rng.standard_normal((90, 50)), rng.standard_normal((90, 40))
    assert kinetics.fit_tica([few], 1) is None and msm.fit_projection([few], 1) is None
    assert kinetics.fit_tica([many], 1) is not None, "negative control"
    assert kinetics.fit_tica([np.empty((90, 0))], 1) is None


def test_states_that_cannot_be_lumped_give_no_model() -> None:
    """Two sets of states between which the counts allow no passage back and forth: PCCA finds no such sets."""
    rng = np.random.default_rng(1)
    features = np.repeat(rng.standard_normal((6, 3)), 30, axis=0) + 1e-6 * rng.standard_normal((180, 3))
    projection = msm.fit_projection([features], 1)
    assert projection is not None
    found = msm.fit_model(projection, [projection.project(features)], 1)
    assert found is None or found.n_states >= 2


def test_words_for_what_takes_no_time() -> None:
    assert speed_words("x relaxes", 3.0, 0.0) == "x relaxes in 3 ps, the reference within one frame"
    assert "within one frame" in speed_words("x relaxes", 0.0, 3.0)
    assert "does not move" in speed_words("x relaxes", math.nan, 3.0)


def test_evenly_chosen_items_cover_the_whole() -> None:
    assert evenly(list(range(10)), 20) == list(range(10))
    assert evenly(list(range(300)), 128) == list(range(0, 300, 3))
    assert evenly([], 5) == []


@pytest.mark.slow
def test_adenylate_kinase_is_judged(shared_data: Path) -> None:
    """3,341 atoms, 200 frames of a transition with noise: 214 residues share rows, TICA is left out and named."""
    folder = shared_data / "adk"
    with pytest.warns(UserWarning, match="header states"):
        whole = load_ensemble([folder / "adk_dims.dcd"], top=folder / "adk.psf", lag_ps=1.0)
    base = np.array(whole.segments[0])
    paths = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        at = np.clip(np.linspace(0, 97, 200) + rng.normal(0, 1, 200), 0, 97).round().astype(int)
        frames = base[at] + rng.normal(0, 0.004, (200, *base.shape[1:]))
        paths.append(replace(whole, segments=[frames.astype(np.float32)], label=f"path {seed}"))
    found = compare(paths[0], [paths[1]], paths[2]).judgements[0]
    assert found.status == "undecided" and "too few to judge by" in found.verdict
    assert len(found.rows) < 120 and found.row("joint_jsd").metric.endswith("mean of 16 residues")
    skipped = dict(found.skipped)
    assert skipped["TICA at a lag of 10 ps"] == kinetics.WITHOUT_TICA
    assert "share their rows" in skipped["φ given ψ's basin"]
