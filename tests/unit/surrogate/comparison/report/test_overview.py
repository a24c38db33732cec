"""Figures of a comparison and of MD's answer for notebooks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surrogate.comparison.comparison import compare
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.report.figures import answer_overview, weighted_maps


def test_a_comparison_draws_reference_replicate_and_candidates(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    reference, other, rolled = inputs
    found = compare(reference, [rolled, other], other)
    axes = found.plot().axes
    titles = [a.get_title() for a in axes if a.get_title()]
    label = titles[0].partition(", ")[2]
    assert titles == [f"{name}, {label}" for name in ("reference", "replicate", rolled.label, other.label)]
    images = [np.ma.filled(np.ma.asarray(a.images[0].get_array()), -1.0) for a in axes if a.get_title()]
    assert not np.array_equal(images[0], images[2]) and np.array_equal(images[1], images[3]), (
        "the replicate is evaluated too"
    )


def test_weights_shape_the_maps_of_the_answer() -> None:
    deep, flat = np.full((36, 36), 30.0), np.zeros((36, 36))
    deep[5, 7] = 0.0
    one, other = weighted_maps({"ALA 2": deep, "GLY 3": flat})
    assert "ALA 2" in one.caption and one.svg.startswith("<svg") and one.svg != other.svg


def test_an_answer_without_states_is_an_empty_figure(simulate: Callable[..., Ensemble]) -> None:
    assert len(answer_overview("methane", {}).axes) == 1
