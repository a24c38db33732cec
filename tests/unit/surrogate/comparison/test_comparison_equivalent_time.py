"""How much MD a candidate is worth: on true MD of known length the answer is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from surrogate.comparison.comparison import Evaluation, Summary, compare, cost_ratio
from surrogate.comparison.equivalent_time import (
    EquivalentTime,
    Measure,
    distance_to_reference,
    equivalent_time_by,
    errors_by_length,
    even_blocks,
    headline,
)
from surrogate.comparison.measure import distributions
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import Options
from systems.units import format_time_ps

N_BLOCKS, PER_BLOCK = 128, 20


def draw_counts(p: np.ndarray, n_blocks: int, rng: np.random.Generator) -> np.ndarray:
    return rng.multinomial(PER_BLOCK, p, size=n_blocks).astype(float)


def squared(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(distributions.divergence(a, b[None]))


def measured(candidate: np.ndarray, rng: np.random.Generator, p: np.ndarray) -> EquivalentTime:
    sums = (draw_counts(p, N_BLOCKS, rng), candidate, draw_counts(p, N_BLOCKS, rng))
    found = equivalent_time_by(Measure("x", "distribution", "x", sums, squared), 1000.0 * N_BLOCKS)
    assert found is not None
    return found


def summary(label: str, total_ns: float, wall_s: float) -> Summary:
    total_ps = 1000.0 * total_ns
    return Summary(label, (), None, None, 1, round(total_ps), 1.0, total_ps, {}, wall_s, 86_400 * total_ns / wall_s, {})


STATES = np.full(30, 1 / 30)


@pytest.mark.parametrize("n_blocks", [8, 32])
def test_a_true_sample_is_equivalent_to_its_own_length(n_blocks: int) -> None:
    """Blocks stand for 1 ns each. The mean over trials is within 15 %; the intervals hold it as often as stated."""
    rng = np.random.default_rng(n_blocks)
    found = [measured(draw_counts(STATES, n_blocks, rng), rng, STATES) for _ in range(60)]
    ref = 1000.0 * n_blocks
    assert float(np.exp(np.mean([math.log(w.equivalent_ps / ref) for w in found]))) == pytest.approx(1.0, abs=0.15)
    covered = sum((w.low_ps or 0) <= ref <= (w.high_ps or math.inf) for w in found)
    assert covered >= 54, "95 % of 60 intervals should hold the reference; fewer than 54 is chance once in 200 times"
    widths = [w.high_ps / w.low_ps for w in found if w.low_ps and w.high_ps]
    assert np.median(widths) < 6


def test_a_biased_sample_is_equivalent_to_the_length_of_its_bias_however_long_it_is() -> None:
    """Divergence eps^2 / 8 of the bias; MD of l frames has (30 - 1) / (8 l). Equal at l = 29 / eps^2."""
    rng = np.random.default_rng(0)
    eps = 0.3
    tilted = STATES * (1 + eps * np.where(np.arange(30) % 2, 1, -1))
    found = measured(rng.multinomial(200_000, tilted, size=20).astype(float), rng, STATES)
    frames = 29 / eps**2
    assert found.equivalent_ps / 1000 == pytest.approx(frames / PER_BLOCK, rel=0.2)
    assert not found.bound and found.low_ps and found.high_ps
    assert found.low_ps < found.equivalent_ps < found.high_ps


def test_what_is_better_or_worse_than_all_md_at_hand_says_so() -> None:
    rng = np.random.default_rng(1)
    good = measured(rng.multinomial(100_000, STATES, size=20).astype(float), rng, STATES)
    assert good.bound == "at least" and good.high_ps is None
    assert good.in_words().startswith("at least 130 ns")
    stuck = np.zeros((20, 30))
    stuck[:, 0] = 100.0
    bad = measured(stuck, rng, STATES)
    assert bad.bound == "less than" and bad.in_words() == "less than 1 ns"


def test_rising_errors_are_made_monotone() -> None:
    rng = np.random.default_rng(2)
    found = measured(draw_counts(STATES, 64, rng), rng, STATES)
    assert list(found.lengths_ps) == [1000.0 * 2**k for k in range(8)]
    assert found.error_at(0.1) == pytest.approx(math.sqrt(29 / 8 / PER_BLOCK * (1 / 12.8 + 1 / 128)), rel=0.15)
    assert found.error_at(0.01) > found.error_at(0.1) > found.error_at(1.0)


def test_parts_of_a_candidate_err_as_md_of_their_length_does_and_a_bias_stays() -> None:
    rng = np.random.default_rng(4)
    references = draw_counts(STATES, N_BLOCKS, rng), draw_counts(STATES, N_BLOCKS, rng)
    tilted = STATES * (1 + 0.5 * np.where(np.arange(30) % 2, 1, -1))
    found = {}
    for name, states in (("fair", STATES), ("biased", tilted)):
        measure = Measure(
            "x", "distribution", "x", (references[0], draw_counts(states, 64, rng), references[1]), squared
        )
        lengths, errors = errors_by_length(measure, 64_000.0)
        whole = distance_to_reference(measure)
        assert lengths.tolist() == [1000.0 * 2**k for k in range(7)]
        assert errors[-1] == pytest.approx(whole.value, rel=1e-12) and whole.low < whole.value < whole.high
        found[name] = errors
    n_frames = PER_BLOCK * 2.0 ** np.arange(3, 7)
    expected = np.sqrt(29 / 8 * (1 / n_frames + 1 / (PER_BLOCK * N_BLOCKS)))
    np.testing.assert_allclose(found["fair"][3:], expected, rtol=0.12)
    # Divergence eps^2 / 8 of the bias, which no length takes away.
    np.testing.assert_allclose(found["biased"][3:], np.sqrt(expected**2 + 0.25 / 8), rtol=0.12)


def test_even_blocks_cover_every_frame_once() -> None:
    for lengths in ([1000], [300, 7, 693], [128] * 5):
        blocks = even_blocks(lengths, 16)
        seen = [np.zeros(n, dtype=int) for n in lengths]
        sizes = np.zeros(16, dtype=int)
        for piece in blocks.pieces:
            seen[piece.segment][piece.start : piece.stop] += 1
            sizes[piece.block] += piece.stop - piece.start
        assert all((s == 1).all() for s in seen)
        assert sizes.max() - sizes.min() <= 1


@pytest.fixture(scope="module")
def evaluated(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> Evaluation:
    reference, candidate, replicate = inputs
    reference = replace(reference, record=reference.record | {"cost": {"wall_s": 1000.0}})
    shorter = replace(candidate, segments=[candidate.segments[0][:1500]], record={"cost": {"wall_s": 1.0}})
    return compare(reference, [shorter], replicate, options=Options(peptide_recipe=False)).evaluations[0]


def test_the_verdict_says_what_the_trajectory_is_equivalent_to_and_costs(evaluated: Evaluation) -> None:
    by = {w.key: w for w in evaluated.equivalent_time}
    assert list(by) == ["joint_jsd", "psi_correlation"]
    for equivalent_time in by.values():
        assert equivalent_time.low_ps is None or equivalent_time.low_ps < 1500
        assert equivalent_time.high_ps is None or equivalent_time.high_ps > 1500
    assert by["joint_jsd"].equivalent_ps == pytest.approx(1500, rel=0.4)
    assert (
        evaluated.equivalent_time_words.startswith("Equivalent MD time 1.")
        and evaluated.equivalent_time_words in evaluated.verdict
    )
    # 12 ns of reference cost 1000 s, so 1.5 ns cost 125 times the candidate's 1 s.
    share = float(evaluated.equivalent_time_words.split("at 1/")[1].split(" of")[0])
    assert share == pytest.approx(by["joint_jsd"].equivalent_ps / 12_000 * 1000, rel=0.05)


def test_wrong_kinetics_are_equivalent_to_little_where_the_map_is_right(
    inputs: tuple[Ensemble, Ensemble, Ensemble],
) -> None:
    """Negative control: shuffled frames keep the map's equivalent time and lose that of the kinetics."""
    reference, candidate, replicate = inputs
    frames = candidate.segments[0].copy()
    np.random.default_rng(0).shuffle(frames)
    found = compare(
        reference, [replace(candidate, segments=[frames])], replicate, options=Options(peptide_recipe=False)
    ).evaluations[0]
    by = {w.key: w for w in found.equivalent_time}
    assert by["joint_jsd"].equivalent_ps > 4_000
    assert by["psi_correlation"].equivalent_ps < 400


def test_the_headline_without_costs_or_measures() -> None:
    rng = np.random.default_rng(3)
    found = measured(draw_counts(STATES, 32, rng), rng, STATES)
    assert "cost" not in headline([found], lambda _: None, 1e3)
    assert "at 1/900 of its cost" in headline([found], lambda _: 901.0, 1e3)
    assert "at 67 % of its cost" in headline([found], lambda _: 1.5, 1e3)
    assert "at 2 times its cost" in headline([found], lambda _: 0.5, 1e3)
    assert headline([], lambda _: None, 1e3) == ""


def test_a_candidate_longer_than_the_md_at_hand_is_charged_for_the_part_that_is_equivalent() -> None:
    """As good as MD and sixteen times as long: about a sixteenth is equivalent to all the MD there is, and costs so
    much."""
    rng = np.random.default_rng(11)
    alike = measured(draw_counts(STATES, 16 * N_BLOCKS, rng), rng, STATES)
    assert alike.bound == "at least"
    assert 1 / 64 < alike.share < 1 / 4
    rolled, md = summary("candidate", 16.0 * N_BLOCKS, 8.0), summary("reference", 1.0 * N_BLOCKS, 40.0)
    ratio = cost_ratio(alike.equivalent_ps, alike.share, rolled, md)
    assert ratio == pytest.approx(40.0 / (8.0 * alike.share))
    said = headline([alike], lambda _: ratio, rolled.total_ps)
    part = format_time_ps(float(f"{rolled.total_ps * alike.share:.2g}"))
    assert f"of its cost for the {part} of it that this takes" in said
    # Negative control: what is not worth all MD is charged for whole.
    assert measured(draw_counts(STATES, 8, rng), rng, STATES).share == 1.0


def test_short_trajectories_have_no_equivalent_time(simulate: Callable[..., Ensemble]) -> None:
    evaluation = compare(
        simulate(31, 60), [simulate(32, 60)], simulate(33, 60), options=Options(peptide_recipe=False)
    ).evaluations[0]
    assert evaluation.equivalent_time == () and evaluation.equivalent_time_words == ""
