"""Energies by a function that is handed in: what a wrong one changes, and what is not evaluated without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import Histogram
from surrogate.comparison.rows.rows import Options
from surrogate.comparison.rows.validity_rows import measure_energies
from systems.scene import Scene

QUICK = Options(n_bootstrap=100, n_permutations=100, peptide_recipe=False)


@pytest.fixture(scope="module")
def inputs(simulate: Callable[..., Ensemble]) -> tuple[Ensemble, Ensemble, Ensemble]:
    return simulate(61, 1_500), simulate(62, 1_500, 3), simulate(63, 1_500)


def springs(scene: Scene) -> Callable[[np.ndarray], float]:
    """kJ/mol of harmonic bonds about the library's lengths: the toy's 2 pm of noise weigh 0.8 kJ/mol a bond."""
    i, j = scene.bonds.T
    rest = np.linalg.norm(scene.positions_nm[i] - scene.positions_nm[j], axis=1)
    return lambda x: float(1e5 * ((np.linalg.norm(x[i] - x[j], axis=1) - rest) ** 2).sum())


def evaluated(inputs: tuple[Ensemble, Ensemble, Ensemble], frames: list[np.ndarray], scene: Scene) -> Evaluation:
    reference, candidate, replicate = inputs
    changed = replace(candidate, segments=[f.astype(np.float32) for f in frames])
    found = compare(reference, [changed], replicate, options=QUICK, energy_fn=springs(scene))
    return found.evaluations[0]


def test_every_kth_frame_is_measured_and_infinity_is_kept(simulate: Callable[..., Ensemble]) -> None:
    ensemble = simulate(64, 90, 2)
    frames = [np.array(s) for s in ensemble.segments]
    frames[1][0, 3] = np.nan
    calls: list[float] = []

    def energy(x: np.ndarray) -> float:
        calls.append(float(x[0, 0]))
        return float(x[0, 0]) if len(calls) > 1 else np.nan

    first, second = measure_energies(replace(ensemble, segments=frames), energy, 30)
    assert np.flatnonzero(~np.isnan(first)).tolist() == list(range(0, 45, 3))
    assert np.isposinf(first[0]) and np.isposinf(second[0]), "no number, and a frame that is not finite"
    assert first[3] == pytest.approx(frames[0][3, 0, 0]) and second[6] == pytest.approx(frames[1][6, 0, 0])
    assert len(calls) == 29, "the broken frame is not handed over"


def test_an_equal_ensemble_agrees_and_a_strained_one_does_not(
    inputs: tuple[Ensemble, Ensemble, Ensemble], alanine_dipeptide: Scene
) -> None:
    frames = [np.array(s, dtype=np.float64) for s in inputs[1].segments]
    fair = evaluated(inputs, frames, alanine_dipeptide)
    for key in ("energy_mean", "energy_high"):
        assert fair.row(key).verdict in ("agrees", "undecided"), key
    expected = 0.5 * 2 * 1e5 * len(alanine_dipeptide.bonds) * 2 * 0.002**2
    assert fair.row("energy_mean").reference.value == pytest.approx(expected, rel=0.05)  # type: ignore[union-attr]
    assert fair.row("energy_high").reference.value == pytest.approx(1.0, abs=0.2)  # type: ignore[union-attr]
    noise = np.random.default_rng(0).normal(0.0, 0.001, frames[0].shape)
    strained = evaluated(inputs, [f + noise for f in frames], alanine_dipeptide)
    row = strained.row("energy_mean")
    assert row.verdict == "differs"
    assert row.candidate.value / row.reference.value == pytest.approx(1.25, rel=0.05)  # type: ignore[union-attr]
    assert "kJ/mol instead of" in row.statement
    frames[2][249] *= 40.0
    exploded = evaluated(inputs, frames, alanine_dipeptide)
    limit = 2 * fair.row("energy_mean").reference.value  # type: ignore[union-attr]
    assert exploded.row("energy_mean").candidate.value < limit, "one frame does not drown the others"
    (chart,) = (c for c in exploded.charts if isinstance(c, Histogram) and c.label == "Potential energy")
    assert chart.outside[1] == pytest.approx(1 / 501, rel=0.01) and chart.outside[0] == 0.0


def test_without_a_function_it_is_skipped(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    reference, candidate, replicate = inputs
    found = compare(reference, [candidate], replicate, options=QUICK).evaluations[0]
    assert dict(found.skipped)["Potential energy"] == "no energy function was given"
    assert not any(row.key.startswith("energy") for row in found.rows)
