"""ADE and FDE of atoms that fly straight, exactly; who is paired and who is not; and the charts of a comparison."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surrogate.comparison.comparison import compare
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import LineChart
from surrogate.comparison.rows.published_metrics import find_pairs, forecast_charts, forecasts
from surrogate.comparison.rows.rows import Options
from systems.scene import Scene

N_PAIRS, N_FRAMES, N_GIVEN = 4, 30, 2
SPEED = 0.01


def flight(scene: Scene, factor: float = 1.0, label: str = "reference", seed: int = 0) -> Ensemble:
    """Each atom flies straight at `SPEED` nm a frame in its own direction, from frame `N_GIVEN` on `factor` as fast."""
    rng = np.random.default_rng(seed)
    segments = []
    for _ in range(N_PAIRS):
        way = rng.standard_normal((scene.n_atoms, 3))
        way *= SPEED / np.linalg.norm(way, axis=1, keepdims=True)
        at = np.arange(N_FRAMES, dtype=np.float64)
        at[N_GIVEN:] = at[N_GIVEN - 1] + factor * (at[N_GIVEN:] - at[N_GIVEN - 1])
        segments.append((scene.positions_nm + at[:, None, None] * way).astype(np.float32))
    return Ensemble(label, segments, 0.5, scene)


@pytest.mark.parametrize("turned", [False, True])
def test_errors_of_straight_flight_are_exact(alanine_dipeptide: Scene, turned: bool) -> None:
    ref, slow = flight(alanine_dipeptide), flight(alanine_dipeptide, 0.9)
    if turned:
        turn = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).as_matrix()
        slow = replace(slow, segments=[(s @ turn.T + 0.7).astype(np.float32) for s in slow.segments])
    pairs = find_pairs(ref, slow)
    assert pairs is not None and pairs.n_given == N_GIVEN and len(pairs.ref) == N_PAIRS
    own, frozen, straight = forecasts(pairs)
    ahead = np.arange(1, N_FRAMES - N_GIVEN + 1)
    assert own.final() == pytest.approx(10 * 0.1 * SPEED * ahead, rel=1e-3, abs=2e-4)
    assert frozen.final() == pytest.approx(10 * SPEED * ahead, rel=1e-4)
    assert straight.final() == pytest.approx(np.zeros(len(ahead)), abs=1e-3)
    assert frozen.average() == pytest.approx(10 * SPEED * (ahead + 1) / 2, rel=1e-4)
    assert own.role == "candidate" and {frozen.role, straight.role} == {"other"}


def test_what_starts_elsewhere_is_no_forecast(alanine_dipeptide: Scene) -> None:
    ref = flight(alanine_dipeptide)
    mirrored = replace(ref, segments=[s * np.array([-1, 1, 1], dtype=np.float32) for s in ref.segments])
    moved = [np.array(s) for s in ref.segments]
    moved[0][:, 3] += 0.01
    broken = [np.full_like(s, np.nan) for s in ref.segments]
    for other in (mirrored, replace(ref, segments=moved), replace(ref, segments=broken), ref):
        assert find_pairs(ref, other) is None
        found = forecast_charts(SimpleNamespace(trajectories=(ref, other, None)))  # type: ignore[arg-type]
        assert not found.charts and found.skipped[0][0].startswith("Forecast error")


def test_frames_that_are_not_finite_are_infinitely_far(alanine_dipeptide: Scene) -> None:
    ref, slow = flight(alanine_dipeptide), flight(alanine_dipeptide, 0.9)
    slow.segments[1][20] = np.nan
    pairs = find_pairs(ref, slow)
    assert pairs is not None
    own = forecasts(pairs)[0]
    assert np.isposinf(own.final()[18]) and np.isfinite(own.final()[:18]).all()


def test_a_comparison_shows_the_replicate_and_the_baselines(simulate: Callable[..., Ensemble]) -> None:
    reference, candidate, replicate = (simulate(80 + k, 120, 4) for k in range(3))

    def started(other: Ensemble) -> Ensemble:
        parts = zip(reference.segments, other.segments, strict=True)
        return replace(other, segments=[np.concatenate([a[:2], np.asarray(b[2:])]) for a, b in parts])

    options = Options(n_bootstrap=50, n_permutations=50, peptide_recipe=False)
    paired = compare(reference, [started(candidate), candidate], started(replicate), options=options).evaluations
    charts = {c.title: c for c in paired[0].charts if isinstance(c, LineChart) and c.section == "forecast"}
    assert set(charts) == {"Forecast error at a time (FDE)", "Forecast error up to a time (ADE)"}
    (final,) = (c for t, c in charts.items() if "FDE" in t)
    assert [line.name for line in final.lines] == ["candidate", "frozen frame", "constant velocity", "replicate"]
    assert "4 pairs over 28 ps after 2 shared frames" in final.caption
    ours, _, straight, theirs = (np.nanmean(line.y) for line in final.lines)
    assert ours == pytest.approx(theirs, rel=0.5) and straight > ours
    assert not any(c.section == "forecast" for c in paired[1].charts)
    assert any(what.startswith("Forecast error") for what, _ in paired[1].skipped)
