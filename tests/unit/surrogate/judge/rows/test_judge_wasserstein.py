"""Wasserstein distances equal scipy's, see a shift and a width, and do not see a replicate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from surrogate.judge.comparison import compare
from surrogate.judge.measure.statistics import make_blocks
from surrogate.judge.read.ensemble import Ensemble
from surrogate.judge.rows.rows import Options
from surrogate.judge.rows.shape.wasserstein_rows import binned, wasserstein


def test_distances_equal_scipys() -> None:
    rng = np.random.default_rng(0)
    a = np.stack([rng.normal(1.0, 0.03, 3000), rng.normal(1.5, 0.03, 3000)], axis=1)
    b = np.stack([rng.normal(1.01, 0.03, 2000), rng.normal(1.5, 0.05, 2000)], axis=1)
    groups = [np.array([0]), np.array([1])]
    edges = np.stack([np.linspace(x.min(), x.max(), 401) for x in (np.concatenate([a, b])[:, g] for g in groups)])
    widths = edges[:, 1] - edges[:, 0]
    p, q = (binned([x], groups, edges, make_blocks([len(x)], 500)).sum(0) for x in (a, b))
    found = wasserstein(p, q, widths)
    for k in range(2):
        assert found[k] == pytest.approx(wasserstein_distance(a[:, k], b[:, k]), abs=widths[k])
    assert found[0] == pytest.approx(0.01, abs=0.002), "a shift, in its own unit"
    assert wasserstein(p, p, widths) == pytest.approx(np.zeros(2), abs=1e-12)


def test_values_outside_and_missing_ones() -> None:
    edges = np.array([[0.0, 1.0, 2.0]])
    segment = np.array([[-5.0], [0.5], [1.5], [9.0], [np.nan]])
    assert binned([segment], [np.array([0])], edges, make_blocks([5], 5)).sum(0).tolist() == [[2.0, 2.0]]


def test_long_bonds_and_wide_angles_are_rejected_and_a_replicate_is_not(
    trio: tuple[Ensemble, Ensemble, Ensemble],
) -> None:
    reference, candidate, replicate = (replace(e, segments=[e.segments[0][:4000]]) for e in trio)
    noisy = candidate.segments[0] + np.random.default_rng(0).normal(0, 0.003, candidate.segments[0].shape)
    swollen = candidate.segments[0] * np.float32(1.03)
    changed = [replace(candidate, segments=[f.astype(np.float32)]) for f in (candidate.segments[0], swollen, noisy)]
    options = Options(n_bootstrap=100, n_permutations=100, peptide_recipe=False)
    fair, long, wide = compare(reference, changed, replicate, options=options).judgements
    for key in ("bond_wasserstein", "angle_wasserstein"):
        assert fair.row(key).verdict == "agrees", key
    row = long.row("bond_wasserstein")
    assert row.verdict == "differs" and row.candidate.value == pytest.approx(0.03 * 1.25, rel=0.1)
    assert long.row("angle_wasserstein").verdict == "agrees", "angles are as they were"
    assert wide.row("angle_wasserstein").verdict == "differs"


def test_a_candidate_without_a_finite_frame_fails(trio: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    reference, candidate, replicate = (replace(e, segments=[e.segments[0][:200]]) for e in trio)
    gone = replace(candidate, segments=[np.full_like(candidate.segments[0], np.nan)])
    options = Options(n_bootstrap=50, n_permutations=50, peptide_recipe=False)
    found = compare(reference, [gone], replicate, options=options).judgements[0]
    assert found.row("bond_wasserstein").verdict == "fails" and found.status == "broken"
