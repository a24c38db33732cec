"""Effective samples: forgetting too fast earns nothing, rare motions do not count, the front and the break-even."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surrogate.bench.cost_error.effective_page import effective_lines
from surrogate.bench.cost_error.effective_samples import (
    break_even,
    effective_row,
    pareto_front,
    samples_per_second,
    slowest_torsion,
    training_cost,
)
from surrogate.models.architecture import weights_path
from surrogate.models.weights import load_weights


def test_forgetting_too_fast_earns_nothing_and_too_slowly_costs() -> None:
    right = samples_per_second(2.0, 25.0, 25.0)
    assert right == pytest.approx(1e3 / 2.0 / 50.0)
    assert samples_per_second(2.0, 5.0, 25.0) == right
    assert samples_per_second(2.0, 50.0, 25.0) == pytest.approx(right / 2)
    assert samples_per_second(2.0, None, 25.0) is None and samples_per_second(2.0, float("nan"), 25.0) is None
    md = {"slowest": {"tau_ps": 25.0}, "cost": [
        {"way": way, "cpu_s_per_ns": {"mean": cost}} for way, cost in (("ours", 32.0), ("ours", 8.0), ("simd", 0.5))
    ]}  # fmt: skip
    row: dict[str, Any] = {"cpu_s_per_ns": {"mean": 2.0}}
    assert effective_row(row, 20.0, md)["effective_over_md"] == pytest.approx(4.0), "of the fastest MD"
    assert effective_row(row, 20.0, md | {"slowest": None}) == {}


def test_the_slowest_torsion_is_one_whose_time_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    taus = [4.0, 25.0, 900.0]

    class Value:
        def __init__(self, value: float) -> None:
            self.value = value

    class Fake:
        class features:
            total_ps = 10_000.0

    names = [("ψ", ""), ("", "χ of 3"), ("φ", "")]
    monkeypatch.setattr(
        "surrogate.bench.cost_error.effective_samples.turning", lambda f: [(s, label, []) for s, label in names]
    )
    monkeypatch.setattr(
        "surrogate.bench.cost_error.effective_samples.relaxation_of", lambda sample, k: (Value(0.0), Value(taus[k]))
    )
    found = slowest_torsion([Fake(), Fake()])  # type: ignore[list-item]
    assert found is not None and found["name"] == "cos χ of 3" and found["samples"] == pytest.approx(20_000 / 50)
    assert slowest_torsion([Fake()] * 40)["name"] == "cos φ", "with 222 of it at hand"  # type: ignore[list-item,index]
    taus[:] = [np.nan, 0.0, 900.0]
    assert slowest_torsion([Fake()]) is None  # type: ignore[list-item]


def test_the_front_holds_what_nothing_beats() -> None:
    points = [(1.0, 0.1), (10.0, 0.2), (5.0, 0.3), (20.0, 0.5), (10.0, 0.25), (0.5, 0.1)]
    assert pareto_front(points) == [3, 1, 0]
    assert pareto_front([]) == []


def test_a_training_pays_after_as_many_samples_as_it_saves_seconds() -> None:
    # A sample takes MD 0.5 s and the surrogate 0.1 s: 0.4 s saved each.
    assert break_even(400.0, 10.0, 2.0) == pytest.approx(1000.0)
    assert break_even(400.0, 2.0, 2.0) is None and break_even(400.0, None, 2.0) is None


def test_all_trainings_and_all_frames_that_weights_saw_are_counted_once() -> None:
    weights = load_weights(weights_path("alanine-dipeptide"))
    cost = training_cost(weights, 8.0)
    assert cost["training_s"] == pytest.approx(720.7 + 2448.1)
    assert cost["reference_ns"] == pytest.approx(960.0), "32 runs of 30 ns"
    assert cost["reference_s"] == pytest.approx(960.0 * 8.0)
    potential = load_weights(weights_path("paracetamol-gfn2-xtb"))
    assert training_cost(potential, 8.0)["training_s"] == pytest.approx(2088.8)
    unknown = training_cost(replace(weights, provenance={}), 8.0)
    assert unknown["training_s"] is None and unknown["reference_ns"] == 0.0


def test_a_page_leaves_broken_molecules_out_of_the_front() -> None:
    md = {
        "slowest": {"torsion": 0, "name": "cos ψ", "tau_ps": 25.0, "samples": 4000.0},
        "cost": [{"label": "OpenMM, 4 fs", "way": "ours", "cpu_s_per_ns": {"mean": 8.0}}],
        "lengths_ps": [1e3, 1e5], "errors": [0.3, 0.05], "replicate_baseline": 0.05, "length_ps": 1e5,
    }  # fmt: skip
    row = {
        "weights": "w", "label": "fitted 4", "effective_per_s": 50.0, "jsd": {"value": 0.1}, "first_chunks_s": 2.0,
        "valid_half_angstrom_%": {"value": 99.9}, "before": {"training_s": 100.0, "reference_s": 50.0},
    }  # fmt: skip
    torn = row | {"label": "euler 2", "effective_per_s": 500.0, "valid_half_angstrom_%": {"value": 60.0}}
    result = {"md": md, "rows": [row, torn], "config": {"time_ps": 1e5}}
    text = "\n".join(effective_lines(result, 99.0))
    assert "| w, fitted 4 |" in text and "euler 2" not in text and "training (100 s)" in text
    assert "not counted" in "\n".join(effective_lines({**result, "md": {**md, "slowest": None}}, 99.0))
