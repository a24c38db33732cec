"""Numbers of published papers: ADE and FDE of atoms that fly straight, exactly; the peptide papers' recipe against
scipy and deeptime called directly, on real frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.distance import jensenshannon
from scipy.spatial.transform import Rotation

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.measure import structure
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows import published_metrics
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


@pytest.fixture(scope="module")
def real(shared_data: Path, alanine_dipeptide: Scene) -> tuple[Features, Features]:
    folder = shared_data / "alanine-dipeptide"

    def load(number: int) -> Ensemble:
        files = [folder / f"trajectory-{number}.dcd"]
        return load_ensemble(files, template=alanine_dipeptide, top=folder / "ala2.pdb", lag_ps=1.0)

    first, second = load(1), load(2)
    baseline = structure.Baseline.of(first, probing=False)
    found = [baseline.measure(e) for e in (first, second)]
    return found[0], found[1]


def test_the_table_equals_scipy_and_deeptime(real: tuple[Features, Features]) -> None:
    from deeptime.decomposition import TICA

    reference, other = real
    fit = published_metrics.fit_recipe(reference)
    assert fit is not None and fit.model is not None
    table = published_metrics.peptide_table(fit, reference, other)

    def column(features: Features, name: str) -> np.ndarray:
        return np.concatenate([x[:, 0] for x in getattr(features, name)]).astype(float)

    edges = np.linspace(-np.pi, np.pi, 101)
    apart = [
        jensenshannon(*(np.histogram(column(f, name), bins=edges)[0] for f in (reference, other)))
        for name in ("phi", "psi")
    ]
    assert table.backbone == pytest.approx(np.mean(apart), abs=1e-9)
    assert math.isnan(table.side_chain) and table.all_torsions == table.backbone

    def features(f: Features) -> np.ndarray:
        phi, psi = column(f, "phi"), column(f, "psi")
        return np.stack([np.cos(phi), np.sin(phi), np.cos(psi), np.sin(psi)], axis=1)

    model = TICA(lagtime=100, scaling="kinetic_map").fit(features(reference)).fetch_model()
    p, q = (model.transform(features(f)) for f in (reference, other))
    low, high = np.minimum(p.min(0), q.min(0)), np.maximum(p.max(0), q.max(0))
    one = [np.histogram(x[:, 0], bins=100, range=(low[0], high[0]))[0] for x in (p, q)]
    assert table.tica_0 == pytest.approx(jensenshannon(*one), abs=0.004)
    two = [np.histogram2d(x[:, 0], x[:, 1], bins=50, range=list(zip(low[:2], high[:2])))[0].ravel() for x in (p, q)]
    assert table.tica_01 == pytest.approx(jensenshannon(*two), abs=0.01)
    assert 0 < table.msm < 0.3


def test_a_trajectory_has_no_distance_to_itself(real: tuple[Features, Features]) -> None:
    reference, other = real
    fit = published_metrics.fit_recipe(reference)
    assert fit is not None
    assert np.nan_to_num(published_metrics.peptide_table(fit, reference, reference).values()) == pytest.approx(
        np.zeros(6), abs=1e-7
    )
    shifted = Features(**{**vars(other), "psi": [x + np.float32(0.5) for x in other.psi]})
    wrong = published_metrics.peptide_table(fit, reference, shifted)
    right = published_metrics.peptide_table(fit, reference, other)
    assert (wrong.values()[[0, 2, 3, 4]] > 1.5 * right.values()[[0, 2, 3, 4]]).all(), "negative control"


def test_candidates_of_one_length_share_what_is_fitted_on_the_reference(
    simulate: Callable[..., Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []
    fit_recipe = published_metrics.fit_recipe

    def counted(reference: Features) -> published_metrics.Fit | None:
        made.append(reference.n_frames)
        return fit_recipe(reference, n_clusters=12, n_states=3)

    def distances(evaluation: Evaluation) -> list[float]:
        (bars,) = (c for c in evaluation.charts if getattr(c, "title", "") == "By the peptide papers' recipe")
        return list(bars.to_dict()["candidate"])

    monkeypatch.setattr(published_metrics, "fit_recipe", counted)
    quick = Options(n_bootstrap=30, n_permutations=20)
    reference, one, other, replicate = (simulate(80 + k, 1200) for k in range(4))
    shorter = replace(other, segments=[other.segments[0][:1100]])
    _, found, short = compare(reference, [one, other, shorter], replicate, options=quick).evaluations
    assert made == [1200, 1100]
    assert distances(found) == distances(compare(reference, [other], replicate, options=quick).evaluations[0])
    assert distances(found) != distances(short)


def test_decorrelation_of_a_torsion_that_diffuses_about_a_mean() -> None:
    """A Gaussian angle of variance s^2 and correlation c: exactly (exp(s^2 c) - 1) / (exp(s^2) - 1)."""
    rng = np.random.default_rng(0)
    a, s = 0.95, 0.7
    kicks = rng.standard_normal((2, 200_000)) * math.sqrt(1 - a * a)
    angles = [1.0 + s * x for x in lfilter([1.0], [1.0, -a], kicks, axis=1)]
    found = published_metrics.decorrelation(angles, 60)
    exact = (np.exp(s**2 * a ** np.arange(60.0)) - 1) / (np.exp(s**2) - 1)
    assert found[0] == pytest.approx(1.0)
    assert found == pytest.approx(exact, abs=0.02)
    assert np.isnan(published_metrics.decorrelation([np.full(100, 0.3)], 5)).all()
