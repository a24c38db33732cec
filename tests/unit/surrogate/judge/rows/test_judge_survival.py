"""Kaplan-Meier against scipy, and in the report of a trajectory that breaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surrogate.judge.comparison import compare
from surrogate.judge.read.ensemble import Ensemble
from surrogate.judge.rows.charts import LineChart
from surrogate.judge.rows.motion.survival import survival
from surrogate.judge.rows.rows import Options


def test_survival_equals_scipys_with_censored_replicas() -> None:
    from scipy import stats

    rng = np.random.default_rng(0)
    times, ends = rng.exponential(50.0, 40).round(), rng.uniform(20.0, 90.0, 40).round() + 0.5
    failures = [float(t) if t < e else None for t, e in zip(times, ends)]
    found = survival(list(ends), failures)
    censored = stats.CensoredData.right_censored(np.minimum(times, ends), times >= ends)
    theirs = stats.ecdf(censored).sf
    for t in (1.0, 10.0, 33.0, 60.0):
        ours = found.share[np.searchsorted(found.time_ps, t, side="right") - 1]
        assert ours == pytest.approx(float(theirs.evaluate(t)), abs=1e-12)
    band = theirs.confidence_interval(0.95, method="log-log")
    at = 33.0
    k = np.searchsorted(found.time_ps, at, side="right") - 1
    assert found.low[k] == pytest.approx(float(band.low.evaluate(at)), abs=1e-6)
    assert found.high[k] == pytest.approx(float(band.high.evaluate(at)), abs=1e-6)


def test_nobody_fails_and_everybody_fails() -> None:
    whole = survival([10.0, 10.0], [None, None])
    assert whole.share.tolist() == [1.0, 1.0] and whole.median_ps() is None and whole.n_failed == 0
    gone = survival([10.0, 10.0], [2.0, 4.0])
    assert gone.share[-1] == 0.0 and gone.median_ps() == 2.0


def test_the_curve_of_a_candidate_whose_replicas_break(trio: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    reference, candidate, replicate = trio
    frames = candidate.segments[0].copy()[:4000].reshape(4, 1000, *candidate.segments[0].shape[1:])
    frames[0, 100] *= 5.0
    frames[2, 700:] *= 5.0
    short = [replace(e, segments=[e.segments[0][:4000]]) for e in (reference, replicate)]
    fair, broken = compare(
        short[0],
        [replace(candidate, segments=[candidate.segments[0][:4000]]), replace(candidate, segments=list(frames))],
        short[1],
        options=Options(peptide_recipe=False),
    ).judgements
    title = "Survival: segments without an invalid frame so far"
    chart = next(c for c in broken.curves.charts if isinstance(c, LineChart) and c.title == title)
    assert "candidate: 2 of 4 segments meet an invalid frame, the first after 100 ps" in chart.caption
    assert chart.lines[1].y[-1] == pytest.approx(0.5)
    assert chart.lines[0].y[-1] == 1.0
    if fair.faults[0].n_invalid + fair.faults[1].n_invalid == 0:
        assert "Survival of replicas" in dict(fair.skipped)
