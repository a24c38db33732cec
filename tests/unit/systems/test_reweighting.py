"""Frames of one potential reweighted to another, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from systems.trajectory.codec import reweighting


def test_frames_of_a_wrong_spring_are_reweighted_to_the_right_one() -> None:
    rng, kt = np.random.default_rng(0), 8.31446261815324e-3 * 300.0
    x = rng.normal(size=20_000) * np.sqrt(kt / 100.0)  # in a spring of 100 kJ/mol/nm^2, the reference's is 150
    difference = 0.5 * 50.0 * x**2
    weight, effective = reweighting(difference, 300.0)
    assert weight.sum() == pytest.approx(1.0)
    assert (weight * x**2).sum() == pytest.approx(kt / 150.0, rel=0.03)
    # Negative control: as they are, the frames say otherwise.
    assert np.mean(x**2) > 1.4 * kt / 150.0
    assert 0.8 * len(x) < effective < 0.999 * len(x)
    assert reweighting(np.zeros(10), 300.0)[1] == pytest.approx(10.0)
