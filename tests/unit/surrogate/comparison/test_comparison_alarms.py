"""The count of false alarms: disjoint pieces of different runs, and a run that is not like the others is counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from compare_alarms import (
    Alarms,
    count_alarms,
    count_intervals,
    cut,
    fair_input_sets,
    report,
    report_intervals,
)

from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows import kinetics_rows
from systems.errors import InputError


@pytest.fixture(scope="module")
def runs(simulate: Callable[..., Ensemble]) -> list[Ensemble]:
    return [simulate(70 + k, 700) for k in range(3)]


def test_pieces_are_whole_and_each_is_the_candidate_once(runs: list[Ensemble]) -> None:
    pieces = cut(runs, 200.0)
    assert [k for k, _ in pieces] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert all(p.n_frames == 200 for _, p in pieces)
    np.testing.assert_array_equal(pieces[4][1].segments[0], runs[1].segments[0][200:400])
    input_sets = list(fair_input_sets(pieces))
    assert [t[1].label for t in input_sets] == [p.label for _, p in pieces]
    run_of = {p.label: k for k, p in pieces}
    assert all(len({run_of[e.label] for e in inputs}) == 3 for inputs in input_sets)
    assert list(fair_input_sets(pieces[:6])) == [], "two runs give no third"


def test_a_run_that_is_not_like_the_others_is_an_alarm(runs: list[Ensemble]) -> None:
    fair = count_alarms(runs, 700.0)
    assert fair.n == 3 and fair.n_alarms == 0, report(fair)
    hot = runs[2].segments[0] + np.random.default_rng(0).normal(0, 0.004, runs[2].segments[0].shape)
    found = count_alarms([*runs[:2], replace(runs[2], segments=[hot.astype(np.float32)])], 700.0, most=3)
    assert found.n_alarms >= 1 and any(key.startswith("bond") for key in found.rows), report(found)
    with pytest.raises(InputError, match="Fewer than three runs"):
        count_alarms(runs[:2], 700.0)


def test_intervals_of_relaxation_times_are_counted(runs: list[Ensemble], monkeypatch: pytest.MonkeyPatch) -> None:
    """Six pieces, one psi each; negative control: intervals a tenth as wide hold less often."""
    found = count_intervals(runs, 350.0)
    assert found.n == 6 and found.n_held >= 5 and list(found.times_ps) == ["ALA 2"]
    assert "of 6 intervals hold" in report_intervals(found)
    made = kinetics_rows.estimate

    def narrow(value: float, draws: np.ndarray, n_blocks: int, *, log: bool = False) -> Estimate:
        whole = made(value, draws, n_blocks, log=log)
        return replace(whole, low=value - 0.1 * (value - whole.low), high=value + 0.1 * (whole.high - value))

    monkeypatch.setattr(kinetics_rows, "estimate", narrow)
    assert count_intervals(runs, 350.0).n_held < found.n_held


def test_the_share_is_tested_against_one_in_twenty() -> None:
    fine = Alarms(55, 2e4, {"indistinguishable": 52, "undecided": 1, "close": 1, "different": 1}, {"angle_jsd": 2}, 0)
    assert fine.n_alarms == 2 and fine.p_value() > 0.5
    assert fine.interval()[0] < 2 / 55 < fine.interval()[1]
    assert "2 false alarms (3.6 %" in report(fine)
    many = replace(fine, status={"indistinguishable": 45, "different": 10})
    assert many.p_value() < 1e-3
