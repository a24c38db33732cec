"""The peptide papers' recipe against scipy and deeptime called directly, on real frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import jensenshannon

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.measure import structure
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows import published_metrics
from surrogate.comparison.rows.rows import Options
from systems.scene import Scene


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
    table = dict(zip(published_metrics.TABLE, published_metrics.peptide_table(fit, reference, other), strict=True))

    def column(features: Features, name: str) -> np.ndarray:
        return np.concatenate([x[:, 0] for x in getattr(features, name)]).astype(float)

    edges = np.linspace(-np.pi, np.pi, 101)
    apart = [
        jensenshannon(*(np.histogram(column(f, name), bins=edges)[0] for f in (reference, other)))
        for name in ("phi", "psi")
    ]
    assert table["backbone torsions"] == pytest.approx(np.mean(apart), abs=1e-9)
    assert math.isnan(table["side-chain torsions"]) and table["all torsions"] == table["backbone torsions"]

    def features(f: Features) -> np.ndarray:
        phi, psi = column(f, "phi"), column(f, "psi")
        return np.stack([np.cos(phi), np.sin(phi), np.cos(psi), np.sin(psi)], axis=1)

    model = TICA(lagtime=100, scaling="kinetic_map").fit(features(reference)).fetch_model()
    p, q = (model.transform(features(f)) for f in (reference, other))
    low, high = np.minimum(p.min(0), q.min(0)), np.maximum(p.max(0), q.max(0))
    one = [np.histogram(x[:, 0], bins=100, range=(low[0], high[0]))[0] for x in (p, q)]
    assert table["TICA 0"] == pytest.approx(jensenshannon(*one), abs=0.004)
    two = [np.histogram2d(x[:, 0], x[:, 1], bins=50, range=list(zip(low[:2], high[:2])))[0].ravel() for x in (p, q)]
    assert table["TICA 0,1"] == pytest.approx(jensenshannon(*two), abs=0.01)
    assert 0 < table["MSM states"] < 0.3


def test_a_trajectory_has_no_distance_to_itself(real: tuple[Features, Features]) -> None:
    reference, other = real
    fit = published_metrics.fit_recipe(reference)
    assert fit is not None
    assert np.nan_to_num(published_metrics.peptide_table(fit, reference, reference)) == pytest.approx(
        np.zeros(6), abs=1e-7
    )
    shifted = Features(**{**vars(other), "psi": [x + np.float32(0.5) for x in other.psi]})
    wrong = published_metrics.peptide_table(fit, reference, shifted)
    right = published_metrics.peptide_table(fit, reference, other)
    assert (wrong[[0, 2, 3, 4]] > 1.5 * right[[0, 2, 3, 4]]).all(), "negative control"


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
        assert "a Markov state model of 12 clusters and 3 metastable states" in bars.caption
        return list(bars.to_dict()["lines"][1]["y"])

    monkeypatch.setattr(published_metrics, "fit_recipe", counted)
    quick = Options(n_bootstrap=30, n_permutations=20)
    reference, one, other, replicate = (simulate(80 + k, 1200) for k in range(4))
    shorter = replace(other, segments=[other.segments[0][:1100]])
    _, found, short = compare(reference, [one, other, shorter], replicate, options=quick).evaluations
    assert made == [1200, 1100]
    assert distances(found) == distances(compare(reference, [other], replicate, options=quick).evaluations[0])
    assert distances(found) != distances(short)
