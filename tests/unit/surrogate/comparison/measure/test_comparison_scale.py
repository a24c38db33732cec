"""Molecules of thousands of atoms, and what their few frames cannot carry: rows left out and named, never a crash."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compare_speed import noisy_path

from surrogate.comparison.comparison import compare
from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.structure import evenly
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.rows import Options, Quantity


def test_more_torsions_than_frames_have_no_slowest_combination() -> None:
    rng = np.random.default_rng(0)
    few, many = rng.standard_normal((90, 50)), rng.standard_normal((90, 40))
    assert kinetics.fit_projection([few], 1) is None
    assert kinetics.fit_projection([many], 1) is not None, "negative control"
    assert kinetics.fit_projection([np.empty((90, 0))], 1) is None
    assert kinetics.fit_projection([1e-5 * many], 1) is None, "varies by no more than rounding"


def test_states_that_cannot_be_lumped_give_no_model(monkeypatch: pytest.MonkeyPatch) -> None:
    """PCCA fails on transition matrices whose slow eigenvectors span no simplex; the row is then left out and named."""
    from deeptime.markov.msm import MarkovStateModel

    rng = np.random.default_rng(1)
    three = [np.cumsum(rng.standard_normal((2_000, 3)), axis=0) % 7.0 for _ in range(2)]
    projection = kinetics.fit_projection(three, 1)
    assert projection is not None
    coordinates = [projection.project(x) for x in three]
    assert kinetics.fit_model(coordinates, 1) is not None, "negative control"
    for error in (RuntimeError, ValueError, np.linalg.LinAlgError):

        def fail(self: MarkovStateModel, n: int, error: type[Exception] = error) -> None:
            raise error("no simplex")

        monkeypatch.setattr(MarkovStateModel, "pcca", fail)
        assert kinetics.fit_model(coordinates, 1) is None


def test_states_without_a_way_back_give_no_model() -> None:
    """Frames that walk through six places once each: no two are connected both ways, and nothing is lumped."""
    rng = np.random.default_rng(1)
    places = np.repeat(10.0 * rng.standard_normal((6, 3)), 60, axis=0) + 1e-3 * rng.standard_normal((360, 3))
    projection = kinetics.fit_projection([places], 1)
    assert projection is not None
    assert kinetics.fit_model([projection.project(places)], 1, n_micro=6) is None
    there_and_back = [places, places[::-1].copy()]
    assert kinetics.fit_model([projection.project(x) for x in there_and_back], 1, n_micro=6) is not None


def test_a_comparison_whose_states_cannot_be_lumped_names_what_is_left_out(
    simulate: Callable[..., Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    from deeptime.markov.msm import MarkovStateModel

    three = [simulate(k, 1_500) for k in (41, 42, 43)]
    options = Options(peptide_recipe=False)
    whole = compare(three[0], [three[1]], three[2], options=options).evaluations[0]
    assert any(r.key.startswith("msm") for r in whole.rows), "negative control"

    def fail(self: MarkovStateModel, n: int) -> None:
        raise ValueError("no simplex")

    monkeypatch.setattr(MarkovStateModel, "pcca", fail)
    found = compare(three[0], [three[1]], three[2], options=options).evaluations[0]
    assert not any(r.key.startswith("msm") for r in found.rows)
    assert dict(found.skipped)["Markov state model at a lag of 10 ps"] == (
        "the reference visits too few states, or none that hold together"
    )


def test_words_for_a_deviation() -> None:
    time = Quantity("x", "kinetics", "Relaxation time of x", "ps", 0.2, relative=True)
    assert time.deviation(3.0, 0.0) == "relaxation time of x: 3 ps instead of 0 ps"
    assert time.deviation(3.0, 3.001) == "relaxation time of x: 3 ps instead of 3.001 ps", "as many digits as it takes"
    assert time.deviation(math.nan, 3.0) == "relaxation time of x: it does not move"
    shift = Quantity("x", "structure", "Largest shift", "°", 1.0, hint="; a hint")
    assert shift.deviation(math.nan, 2.0) == "largest shift: not defined"
    assert shift.deviation(1.0, 2.0, "N-CA-C") == "largest shift, N-CA-C: 1° instead of 2°; a hint"


def test_evenly_chosen_items_cover_the_whole() -> None:
    assert evenly(list(range(10)), 20) == list(range(10))
    assert evenly(list(range(300)), 128) == list(range(0, 300, 3))
    assert evenly([], 5) == []


@pytest.mark.slow
def test_adenylate_kinase_is_evaluated(shared_data: Path) -> None:
    """3,341 atoms, 200 frames of a transition with noise: 214 residues share rows, TICA is left out and named."""
    folder = shared_data / "adk"
    with pytest.warns(UserWarning, match="header states"):
        whole = load_ensemble([folder / "adk_dims.dcd"], top=folder / "adk.psf", lag_ps=1.0)
    base = np.array(whole.segments[0])
    paths = [replace(whole, segments=[noisy_path(base, seed)], label=f"path {seed}") for seed in range(3)]
    found = compare(paths[0], [paths[1]], paths[2]).evaluations[0]
    assert found.status == "undecided" and "(20 are needed)" in found.verdict
    assert len(found.rows) < 120 and found.row("joint_jsd").metric.endswith("mean of 16 residues")
    skipped = dict(found.skipped)
    assert skipped["TICA at a lag of 10 ps"] == kinetics.WITHOUT_TICA
    assert "share their rows" in skipped["φ given ψ's basin"]
