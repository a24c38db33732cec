"""A wrong time between frames, another temperature, torsions that have lost each other: each in its row, with a fair
trajectory beside it that the row must leave alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison.comparison import Evaluation, compare, summary_of
from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.slow_motion import longest_correlation, rarely_crossed
from surrogate.comparison.measure.statistics import (
    block_length,
    bootstrap_weights,
    estimate,
    make_blocks,
    permutation_p,
)
from surrogate.comparison.measure.structure import Features, backbone
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows import kinetics_rows
from surrogate.comparison.rows.rows import Options
from systems.scene import Scene

OPTIONS = Options(peptide_recipe=False)


@pytest.fixture(scope="module")
def runs(shared_data: Path) -> list[Ensemble]:
    folder = shared_data / "alanine-dipeptide"
    return [load_ensemble([folder / f"trajectory-{k}.dcd"], top=folder / "ala2.pdb", lag_ps=1.0) for k in (1, 2, 3)]


def like(run: Ensemble, frames: np.ndarray, label: str) -> Ensemble:
    return replace(run, segments=[np.ascontiguousarray(frames)], label=label)


@pytest.fixture(scope="module")
def evaluated(runs: list[Ensemble]) -> dict[str, Evaluation]:
    frames = np.array(runs[1].segments[0])
    n = len(frames)
    candidates = [
        runs[1],
        like(runs[1], frames[::2], "every second"),
        like(runs[1], frames[::5], "every fifth"),
        like(runs[1], frames[np.arange(n) % 5 != 4], "fifth dropped"),
        like(runs[1], np.repeat(frames, 2, axis=0)[:n], "doubled"),
    ]
    found = compare(runs[0], candidates, runs[2], options=OPTIONS).evaluations
    return {j.summary.label: j for j in found}


def test_a_fair_replicate_steps_as_the_reference_does(evaluated: dict[str, Evaluation], runs: list[Ensemble]) -> None:
    fair = evaluated[runs[1].label]
    assert fair.status in ("indistinguishable", "undecided") and not fair.findings, fair.verdict
    for key in ("torsion_step", "temperature", "phi_given_psi"):
        assert fair.row(key).verdict == "agrees", key


@pytest.mark.parametrize(
    ("label", "degrees"),
    [("every second", 23.2), ("every fifth", 29.5), ("fifth dropped", 19.9), ("doubled", 13.0)],
)
def test_a_wrong_time_between_frames_is_seen(evaluated: dict[str, Evaluation], label: str, degrees: float) -> None:
    row = evaluated[label].row("torsion_step")
    assert row.verdict == "differs" and evaluated[label].status == "different"
    assert row.candidate.value == pytest.approx(degrees, rel=0.05)
    assert "from frame to frame" in evaluated[label].verdict


def test_phi_shifted_against_psi_is_seen_within_the_basins(runs: list[Ensemble]) -> None:
    """Phi and psi of different times: each alone is right, their maps together are not."""
    from surrogate.comparison.measure import structure

    three = runs
    baseline = structure.Baseline.of(three[0])
    measured = [baseline.measure(e) for e in three]
    shifted = replace(measured[1], phi=[np.roll(measured[1].phi[0], 5_000, axis=0)])
    for features, expected in ((measured[1], ("agrees",)), (shifted, ("differs",))):
        assert _within(three[0], measured, features)["phi_given_psi:ALA 2"] in expected


def _within(reference: Ensemble, measured: list[Features], candidate: Features) -> dict[str, str]:
    from surrogate.comparison import comparison, verdict
    from surrogate.comparison.convergence import convergence_of
    from surrogate.comparison.measure import structure
    from surrogate.comparison.rows.torsion_rows import within_rows

    baseline = structure.Baseline.of(reference, probing=False)
    summary = summary_of(reference)
    found = convergence_of([measured[0], measured[2]], baseline.torsions)
    options = replace(OPTIONS, n_permutations=3800)  # what a comparison of one residue takes
    common = reference.scene, baseline.torsions, baseline.geometry, measured[0], measured[2], options, 300.0, summary
    setting = comparison._Setting(*common, {}, (measured[0], measured[2]), found)
    inputs = comparison._equal_terms(setting, candidate)[0]
    return {r.key: r.verdict for r in verdict.evaluated_rows(within_rows(inputs).rows)}


def test_a_reference_that_starts_in_one_state_breaks_no_short_candidate(simulate: Callable[..., Ensemble]) -> None:
    """Its first frames, as many as the candidate has, are all in psi's beta basin: the other basin has no distance at
    equal length, and none is made up."""
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions

    three = [simulate(k, n) for k, n in ((41, 4_000), (42, 300), (43, 4_000))]
    frames = three[0].segments[0][:]
    beta = np.abs(torsion(frames, np.asarray(backbone_torsions(three[0].scene)["psi"][:1]))[:, 0]) > 2.0
    ordered = np.concatenate([frames[beta][:600], frames[~beta], frames[beta][600:]])
    found = compare(like(three[0], ordered, "ordered"), [three[1]], three[2], options=OPTIONS).evaluations[0]
    row = found.row("phi_given_psi")
    assert np.isfinite(row.candidate.value) and row.verdict != "fails" and found.status != "broken", found.verdict


def hopping(seed: int, *, far: bool = False, stride: int = 1) -> Features:
    """Phi and psi that hop between beta and alpha and shiver; `far`: one long visit to phi > 0, where they shiver twice
    as much; `stride`: one frame in so many."""
    from scipy.signal import lfilter

    n, rng = 10_000, np.random.default_rng(seed)
    alpha = np.cumsum(rng.random(n * stride) < 0.02) % 2
    centre = np.radians(np.where(alpha[:, None] == 1, [-70.0, 100.0], [-75.0, 150.0]))
    shiver = 0.15 * lfilter([1.0], [1.0, -0.6], rng.standard_normal((n * stride, 2)), axis=0)
    if far:
        centre[4_000:6_000], shiver[4_000:6_000] = np.radians([60.0, 40.0]), 2.0 * shiver[4_000:6_000]
    angles = np.arctan2(np.sin(centre + shiver), np.cos(centre + shiver)).astype(np.float32)[::stride]
    none = [np.empty((n, 0), dtype=np.float32)]
    return Features("x", 1.0, [angles[:, :1]], [angles[:, 1:]], none, [np.zeros(n, np.uint16)], None)


@pytest.mark.parametrize("visitor", [0, 1, 2])
def test_a_state_that_one_run_alone_has_met_is_no_wrong_time(
    visitor: int, alanine_dipeptide: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps are larger there, in the reference, the candidate or the replicate; every second frame is still seen."""
    from surrogate.comparison import verdict
    from surrogate.comparison.measure.structure import backbone
    from surrogate.comparison.rows import torsion_rows
    from surrogate.comparison.rows.rows import ComparisonInput, make_sample

    def word(candidate: Features) -> str:
        three = [hopping(1, far=visitor == 0), candidate, hopping(3, far=visitor == 2)]
        blocks = make_blocks([10_000], 1_000)
        samples = [make_sample(f, blocks, OPTIONS, k, 10_000) for k, f in enumerate(three)]
        torsions = backbone(alanine_dipeptide)
        inputs = ComparisonInput(alanine_dipeptide, torsions, None, *samples, OPTIONS)  # type: ignore[arg-type]
        evaluated = verdict.evaluated_rows(torsion_rows.step_rows(inputs).rows)
        return next(r.verdict for r in evaluated if r.key == "torsion_step")

    assert word(hopping(2, far=visitor == 1)) == "agrees"
    assert word(hopping(2, far=visitor == 1, stride=2)) == "differs"
    if visitor == 1:
        together = [[np.zeros(10_000, dtype=np.int64)] for _ in range(3)]
        monkeypatch.setattr(torsion_rows, "_states_apart", lambda inputs: together)
        assert word(hopping(2, far=True)) == "differs", "negative control: the far state not told apart"


def test_within_states_few_samples_blame_nobody_where_the_replicate_differs_too() -> None:
    """Below twenty samples a fast row stands, unless reference and replicate differ by it themselves."""
    from surrogate.comparison import verdict
    from surrogate.comparison.measure.statistics import Estimate
    from surrogate.comparison.rows.rows import Row, TimeScale

    def row(time_scale: TimeScale, p_replicate: float) -> Row:
        one = Estimate(1.0, 0.9, 1.1, 0.05)
        return Row(key="x", group="kinetics", metric="x", form="observable", reference=one, candidate=one,
                   replicate=one, p_value=1e-6, p_replicate=p_replicate, tolerance=0.2, tolerance_text="", statement="",
                   time_scale=time_scale)  # fmt: skip

    rows = [row("step", 0.5), row("step", 1e-5), row("within states", 0.5), row("within states", 1e-5),
            row("fast", 1e-5), row("slow", 0.5)]  # fmt: skip
    kept = [np.isfinite(r.p_value) for r in verdict.untested(rows)]
    assert kept == [True, False, True, False, True, False]
    kept = [np.isfinite(r.p_value) for r in verdict.untested(rows, start=True)]
    assert kept == [True, False, False, False, True, False], "what moves within a state depends on the start"


def test_blocks_of_one_kind_are_exchanged_with_their_like() -> None:
    """Two kinds of blocks, unequally many on each side: without the kinds the sides look different."""
    rng = np.random.default_rng(0)
    kinds = np.array([0] * 18 + [1] * 2 + [0] * 6 + [1] * 14)
    counts = np.where(kinds[:, None] == 0, [90.0, 10.0], [10.0, 90.0]) + rng.integers(0, 9, (40, 2))

    def apart(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return np.abs(p[:, 0] / p.sum(1) - q[:, 0] / q.sum(1))

    assert permutation_p(counts[:20], counts[20:], apart, rng, 500) < 0.01
    assert permutation_p(counts[:20], counts[20:], apart, rng, 500, kinds) > 0.05


def test_heat_shows_in_the_temperature_and_not_in_a_fair_run(simulate: Callable[..., Ensemble]) -> None:
    three = [simulate(k, 6_000) for k in (41, 42, 43)]
    frames = three[1].segments[0]
    warm = frames + np.random.default_rng(5).normal(0, 0.002 * np.sqrt(50 / 300), frames.shape)
    fair, hot = compare(
        three[0], [three[1], like(three[1], warm.astype(np.float32), "350 K")], three[2], options=OPTIONS
    ).evaluations
    for found, word, kelvin in ((fair, "agrees", 300), (hot, "differs", 350)):
        row = found.row("temperature")
        assert row.verdict == word and row.candidate.value == pytest.approx(kelvin, abs=6)
    assert any("vibrations" in x for x in hot.findings) and not any("vibrations" in x for x in fair.findings)


def torsion_features(*angles: np.ndarray) -> Features:
    """One further torsion and nothing else, a segment each."""
    none = [np.empty((len(a), 0), dtype=np.float32) for a in angles]
    flags = [np.zeros(len(a), dtype=np.uint16) for a in angles]
    return Features("x", 1.0, [a[:, None].astype(np.float32) for a in angles], none, none, flags, None)


def two_states(seed: int, n: int, dwell: float, start: int | None = None) -> np.ndarray:
    rng = np.random.default_rng(seed)
    state = (np.cumsum(rng.random(n) < 1 / dwell) + (rng.integers(2) if start is None else start)) % 2
    return np.where(state == 1, 1.0, -1.2) + 0.2 * rng.standard_normal(n)


def test_the_slowest_motion_is_found_whatever_the_molecule() -> None:
    fast = longest_correlation(torsion_features(two_states(0, 20_000, 2.0)))
    slow = longest_correlation(torsion_features(two_states(0, 20_000, 200.0)))
    assert fast < 5 and slow == pytest.approx(100, rel=0.5), "two states of a mean stay of 200 frames: 100 frames"
    stuck = longest_correlation(*(torsion_features(two_states(k, 2_000, 1e9, k)) for k in (0, 1)))
    assert stuck > 500, "two runs that stay apart have not sampled what lies between"


def seldom_visited(rng: np.random.Generator, n: int, stays: tuple[float, float], noise: float) -> np.ndarray:
    """Two states 0 and 1 with these mean stays (frames), seen through noise."""
    out, at = np.empty(n), 0
    state = int(rng.random() < stays[1] / sum(stays))
    while at < n:
        length = int(rng.geometric(1 / stays[state]))
        out[at : at + length] = state
        at, state = at + length, 1 - state
    return out + noise * rng.standard_normal(n)


def test_intervals_of_relaxation_times_hold_what_they_say() -> None:
    """Some fifteen visits to a rare state: 95 % of the intervals hold the known time, and without the widening
    (negative control) fewer than 92 % do."""
    rng, stays, n, noise, n_trials = np.random.default_rng(3), (300.0, 30.0), 5_000, 0.05, 100
    share = stays[1] / sum(stays)
    variance = share * (1 - share)
    a = 1 - 1 / stays[0] - 1 / stays[1]
    ref = 0.5 + a / (1 - a) * variance / (variance + noise**2)
    held, plain = 0, 0
    for _ in range(n_trials):
        series = [seldom_visited(rng, n, stays, noise)]
        crossing, time = kinetics.zero_crossing(series)
        blocks = make_blocks([n], block_length(n, time))
        weights = bootstrap_weights(blocks.n_blocks, 200, rng)
        sums = kinetics.lag_sums(series, blocks, 3 * crossing + 2)
        draws = kinetics.correlation_time(kinetics.autocorrelation(sums, weights))
        wide = kinetics_rows._widened(draws, blocks.n_blocks, crossing, series)
        for k, d in enumerate((wide, draws)):
            found = estimate(time, d, blocks.n_blocks, log=True)
            inside = found.low <= ref <= found.high
            held, plain = held + (inside and k == 0), plain + (inside and k == 1)
    assert held >= 95, "of 100"
    assert plain < 92, "negative control: the bootstrap alone holds it less often"


def test_states_that_no_run_passes_between_are_told_from_a_wrong_population(alanine_dipeptide: Scene) -> None:
    def run(start: int, dwell: float = 1e9, seed: int = 0) -> Features:
        return torsion_features(two_states(seed, 4_000, dwell, start))

    assert rarely_crossed((run(0), run(0, seed=1)), run(1, seed=2), backbone(alanine_dipeptide)) == ["φ ALA 2"]
    assert not rarely_crossed((run(0), run(0, seed=1)), run(0, seed=2)), "the same state"
    assert not rarely_crossed((run(0, 50.0), run(0, 50.0, 1)), run(1, seed=2)), "a state is missing"
    assert not rarely_crossed((run(0), run(0, seed=1)), run(1, 50.0, 2)), "wrong populations"
