"""The list of metrics: what each kind may do, and what a verdict makes of kind and time scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from surrogate.comparison.comparison import Evaluation, compare
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.metrics import METRICS, Metric
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import Line, LineChart
from surrogate.comparison.rows.rows import ComparisonInput, Kind, Measured, Options, Row, TimeScale

OPTIONS = Options(n_bootstrap=50, n_permutations=50, peptide_recipe=False)
# What a short comparison, or one by a reference that depends on its start, can test.
FAST = ("valid:", "copies", "bond_", "angle_", "temperature", "energy_", "chunk_step")


@pytest.fixture(scope="module")
def ensembles(simulate: Callable[..., Ensemble]) -> list[Ensemble]:
    return [simulate(k, 1_500) for k in (91, 92, 93)]


def evaluated(ensembles: list[Ensemble]) -> Evaluation:
    return compare(ensembles[0], [ensembles[1]], ensembles[2], options=OPTIONS).evaluations[0]


def test_every_row_has_the_kind_and_time_scale_of_its_metric(ensembles: list[Ensemble]) -> None:
    assert len({m.name for m in METRICS}) == len(METRICS)
    found = evaluated(ensembles)
    for row in found.rows:
        fast, within, step = (row.key.startswith(x) for x in (FAST, ("phi_given", "torsions_given"), "torsion_step"))
        expected = "fast" if fast else "within states" if within else "step" if step else "slow"
        assert row.time_scale == expected, row.key
        assert (row.kind == "validity") == (row.group == "validity"), row.key
        assert row.kind == "kinetics" or row.group != "kinetics", row.key
    assert {r.time_scale for r in found.rows} == {"fast", "within states", "step", "slow"}


def wrong_row(inputs: ComparisonInput) -> Measured:
    """A row that is far off and significant, and a chart."""
    x = inputs.reference.weights[0][:2]
    bad, good = Estimate(9.0, 8.9, 9.1, 0.05), Estimate(1.0, 0.9, 1.1, 0.05)
    row = Row(
        key="made_up",
        group="structure",
        metric="Made up",
        form="observable",
        reference=good,
        candidate=bad,
        replicate=good,
        p_value=1e-9,
        p_replicate=0.5,
        tolerance=0.1,
        tolerance_text="",
        statement="it is off",
    )
    return Measured([row], [LineChart("structure", "Made up", "", "x", "y", (Line("a", "other", x, x),))])


@pytest.mark.parametrize(
    ("kind", "time_scale", "n_frames", "seen"),
    [("distribution", "slow", 1_500, True), ("information", "slow", 1_500, False),
     ("distribution", "fast", 30, True), ("distribution", "slow", 30, False)],
)  # fmt: skip
def test_a_third_party_s_metric_counts_by_its_kind_and_time_scale(
    ensembles: list[Ensemble],
    monkeypatch: pytest.MonkeyPatch,
    kind: Kind,
    time_scale: TimeScale,
    n_frames: int,
    seen: bool,
) -> None:
    """What gives information alone never counts; in a comparison of one independent sample only what is fast does."""
    own = Metric("Made up", kind, time_scale, wrong_row)
    monkeypatch.setattr("surrogate.comparison.comparison.METRICS", (*METRICS[:1], own))
    three = [ensembles[0], replace(ensembles[1], segments=[ensembles[1].segments[0][:n_frames]]), ensembles[2]]
    found = evaluated(three)
    assert any(c.title == "Made up" for c in found.charts if isinstance(c, LineChart))
    assert ("it is off" in found.findings) == seen
    assert (found.status == "different") == seen, found.verdict


def test_what_was_not_tested_is_not_right_and_other_conditions_are_named(ensembles: list[Ensemble]) -> None:
    copied = compare(ensembles[0], [ensembles[0]], ensembles[2], options=OPTIONS).evaluations[0]
    assert copied.in_short[1].startswith("Right: nothing that could be tested."), copied.in_short
    hot = replace(ensembles[1], record={"temperature_k": 330.0}, label="hot")
    notes = compare(replace(ensembles[0], record={"temperature_k": 300.0}), [hot], ensembles[2], options=OPTIONS).notes
    assert any("hot was made at another temperature in K than the reference: 330.0, not 300.0" in n for n in notes)
    short = [replace(e, segments=[s[:300] for s in e.segments]) for e in ensembles]
    few = evaluated(short)
    right = few.in_short[1].partition("Not known")[0]
    assert "single structures" in right and "distributions" not in right, few.in_short
