"""Autocorrelation, its integral, TICA and the Markov state model against brute force, processes of known answers, and
deeptime."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import lfilter

from surrogate.comparison.comparison import compare
from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.statistics import Blocks, make_blocks
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import Options


def ar1(a: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """A stationary AR(1) process of unit variance: correlation a^t."""
    kicks = rng.standard_normal(n) * math.sqrt(1 - a * a)
    kicks[0] = rng.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -a], kicks))


def brute_force(segments: list[np.ndarray], lag: int) -> float:
    every = np.concatenate(segments)
    mean = np.nanmean(every)
    pairs = [(x - mean) * (y - mean) for s in segments for x, y in zip(s[: len(s) - lag], s[lag:])]
    return float(np.nanmean(pairs) / np.nanmean((every - mean) ** 2))


def test_fft_equals_brute_force_over_segments_of_unequal_length() -> None:
    rng = np.random.default_rng(0)
    segments = [ar1(0.8, n, rng) + shift for n, shift in ((300, 0.0), (77, 1.0), (150, -1.0))]
    blocks = make_blocks([len(s) for s in segments], 40)
    found = kinetics.autocorrelation(kinetics.lag_sums(segments, blocks, 60))
    assert found == pytest.approx([brute_force(segments, lag) for lag in range(60)], abs=1e-9)


def test_frames_that_are_not_finite_drop_out_of_their_pairs_alone() -> None:
    rng = np.random.default_rng(1)
    x = ar1(0.9, 400, rng)
    x[[3, 77, 200]] = np.nan
    found = kinetics.autocorrelation(kinetics.lag_sums([x], make_blocks([400], 50), 30))
    assert found == pytest.approx([brute_force([x], lag) for lag in range(30)], abs=1e-9)


def test_no_pair_crosses_a_segment() -> None:
    """Negative control: two constant segments; joined they would decorrelate, apart they never change."""
    segments = [np.full(50, -1.0), np.full(50, 1.0)]
    sums = kinetics.lag_sums(segments, make_blocks([50, 50], 10), 30)
    assert sums.n.sum(0).tolist() == [2 * (50 - lag) for lag in range(30)]
    assert kinetics.autocorrelation(sums) == pytest.approx(np.ones(30))
    joined = kinetics.autocorrelation(kinetics.lag_sums([np.concatenate(segments)], make_blocks([100], 10), 30))
    assert joined[-1] < 0.7


def test_block_weights_of_one_give_the_whole() -> None:
    x = ar1(0.7, 1000, np.random.default_rng(2))
    sums = kinetics.lag_sums([x], make_blocks([1000], 100), 20)
    whole = kinetics.autocorrelation(sums)
    assert kinetics.autocorrelation(sums, np.ones((2, 10))) == pytest.approx(np.stack([whole, whole]))


@pytest.mark.parametrize("a", [0.0, 0.5, 0.9, 0.98])
def test_integral_of_the_exact_ar1_curve(a: float) -> None:
    curve = a ** np.arange(4000.0)
    assert kinetics.correlation_time(curve) == pytest.approx((1 + a) / (2 * (1 - a)), rel=1e-6)


def test_integral_stops_at_the_interpolated_zero() -> None:
    # Trapezoid 1 -> 0.5, then the triangle from 0.5 to its zero half a frame on; the later bump must not count.
    curve = np.array([1.0, 0.5, -0.5, 0.9, 0.9])
    assert kinetics.correlation_time(curve) == pytest.approx(0.75 + 0.125)
    assert kinetics.correlation_time(np.stack([curve, curve])) == pytest.approx([0.875, 0.875])


def test_integral_of_a_dead_series_is_not_a_number() -> None:
    lag, time = kinetics.zero_crossing([np.full(100, 0.3)])
    assert math.isnan(time) and lag >= 1


@pytest.mark.parametrize("a", [0.5, 0.95])
def test_time_of_a_sampled_ar1_process(a: float) -> None:
    rng = np.random.default_rng(3)
    exact = (1 + a) / (2 * (1 - a))
    times = [kinetics.zero_crossing([ar1(a, 40_000, rng), ar1(a, 40_000, rng)])[1] for _ in range(5)]
    assert np.mean(times) == pytest.approx(exact, rel=0.1)


def test_shuffled_frames_have_no_memory() -> None:
    """Negative control."""
    rng = np.random.default_rng(4)
    x = ar1(0.95, 20_000, rng)
    rng.shuffle(x)
    assert kinetics.zero_crossing([x])[1] < 1.0


def mixed_features(rng: np.random.Generator, n: int) -> np.ndarray:
    """A slow and a fast AR(1) process, rotated into each other, and a constant."""
    slow, fast = ar1(0.98, n, rng), 3.0 * ar1(0.3, n, rng)
    return np.stack([slow + fast, slow - fast, np.zeros(n)], axis=1)


def test_tica_finds_the_slow_process_and_its_timescale() -> None:
    rng = np.random.default_rng(5)
    segments = [mixed_features(rng, 30_000) for _ in range(3)]
    model = kinetics.fit_projection(segments, 5, 1)
    assert model is not None
    assert float(kinetics.timescale(model.eigenvalues[0], 5.0)) == pytest.approx(-1 / math.log(0.98), rel=0.1)
    projected = model.project(segments[0])[:, 0]
    slow = segments[0][:, 0] + segments[0][:, 1]
    assert abs(np.corrcoef(projected, slow)[0, 1]) > 0.99


def test_tica_skips_what_is_not_finite_and_refuses_what_does_not_move() -> None:
    rng = np.random.default_rng(7)
    features = mixed_features(rng, 6000)
    broken = features.copy()
    broken[3000] = np.nan
    with_gap, without = (kinetics.fit_projection(x, 5, 1) for x in ([broken], [features[:3000], features[3001:]]))
    assert with_gap is not None and without is not None
    assert with_gap.eigenvalues[0] == pytest.approx(without.eigenvalues[0], abs=1e-12)
    assert np.isnan(with_gap.project(broken)[3000, 0])
    assert kinetics.fit_projection([np.ones((500, 4))], 5) is None


def test_timescale_of_limits() -> None:
    found = kinetics.timescale([-0.2, 0.0, math.exp(-0.5), np.nan], 10.0)
    assert found[:3].tolist() == pytest.approx([0.0, 0.0, 20.0])
    assert math.isnan(found[3])


def test_whole_blocks_are_segments() -> None:
    assert [p.block for p in Blocks.whole([3, 4]).pieces] == [0, 1]


# Reversible: detailed balance with populations 0.6, 0.3, 0.1.
CHAIN = np.array([[0.94, 0.05, 0.01], [0.10, 0.88, 0.02], [0.06, 0.06, 0.88]])
POPULATIONS = np.array([0.6, 0.3, 0.1])


def walk(n: int, rng: np.random.Generator) -> np.ndarray:
    cumulative, out, state = CHAIN.cumsum(1), np.empty(n, dtype=np.int64), 0
    for t, u in enumerate(rng.random(n)):
        state = int(np.searchsorted(cumulative[state], u))
        out[t] = state
    return out


def test_the_chain_is_what_it_is_said_to_be() -> None:
    flux = POPULATIONS[:, None] * CHAIN
    assert flux == pytest.approx(flux.T)
    assert flux.sum(0) == pytest.approx(POPULATIONS)


def test_exact_counts_give_the_exact_spectrum() -> None:
    """Counts in proportion to the flux: eigenvalues to rounding, at this lag and at seven lags."""
    for power in (1, 7):
        flux = POPULATIONS[:, None] * np.linalg.matrix_power(CHAIN, power)
        exact = np.sort(np.linalg.eigvals(CHAIN).real)[::-1][1:] ** power
        values, functions = kinetics.slow_functions(1e6 * flux, 2)
        assert values == pytest.approx(exact, abs=1e-12)
        for value, function in zip(values, functions, strict=True):
            found = kinetics.function_eigenvalue(1e6 * flux.reshape(1, 9), function)
            assert float(found) == pytest.approx(value, abs=1e-12)
            assert POPULATIONS @ function == pytest.approx(0, abs=1e-12), "orthogonal to the constant"


def test_counts_equal_deeptimes_and_cross_no_gap() -> None:
    from deeptime.markov import TransitionCountEstimator

    rng = np.random.default_rng(0)
    labels = [walk(500, rng), walk(300, rng)]
    labels[0][100] = -1
    blocks = make_blocks([500, 300], 60)
    ours = kinetics.block_transitions(labels, blocks, 3, 4).sum(0).reshape(3, 3)
    brute = np.zeros((3, 3))
    for series in labels:
        for a, b in zip(series[:-4], series[4:]):
            if a >= 0 and b >= 0:
                brute[a, b] += 1
    assert (ours == brute).all()
    theirs = TransitionCountEstimator(lagtime=4, count_mode="sliding").fit([labels[1].astype(np.int32)]).fetch_model()
    alone = kinetics.block_transitions([labels[1]], make_blocks([300], 60), 3, 4).sum(0).reshape(3, 3)
    assert (alone == theirs.count_matrix).all()
    occupancy = kinetics.state_counts(labels, blocks, 3).sum(0)
    assert occupancy[3] == 1 and occupancy.sum() == 800


def test_model_of_a_chain_seen_through_noise() -> None:
    """States are points in a plane with correlated noise: clustering and PCCA must find them, timescales be exact."""
    rng = np.random.default_rng(2)
    segments, hidden = [], []
    for n in (30_000, 20_000):
        state = walk(n, rng)
        noise = lfilter([0.1], [1, -0.3], rng.standard_normal((n, 2)), axis=0)
        segments.append(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])[state] + noise)
        hidden.append(state)
    segments[0][77] = np.nan
    projection = kinetics.fit_projection(segments, 2)
    assert projection is not None
    coordinates = [projection.project(x) for x in segments]
    model = kinetics.fit_model(coordinates, 2)
    assert model is not None and model.n_states == 3
    exact = -1 / np.log(np.sort(np.linalg.eigvals(CHAIN).real)[::-1][1:])
    assert model.timescales[:2] == pytest.approx(exact, rel=0.12)
    macro = model.lump(model.assign(coordinates))
    assert macro[0][77] == -1
    ok = np.concatenate(macro) >= 0
    assert (np.concatenate(macro)[ok] == np.concatenate(hidden)[ok]).mean() > 0.99, "states in order of population"
    assert 0.5 * exact[0] < kinetics.timescale(projection.eigenvalues, 2)[0] < exact[0], (
        "a linear function of noisy features can only decay faster"
    )


QUICK = Options(peptide_recipe=False)


def test_rows_pass_a_replicate_and_reject_a_wrong_time_axis(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    from dataclasses import replace

    reference, candidate, replicate = inputs
    shuffled = candidate.segments[0].copy()
    np.random.default_rng(0).shuffle(shuffled)
    fair, wrong = compare(
        reference, [candidate, replace(candidate, segments=[shuffled])], replicate, options=QUICK
    ).evaluations
    for key in ("msm_jsd", "transition_jsd", "msm_timescale:1"):
        assert fair.row(key).verdict in ("agrees", "undecided"), key
    assert wrong.row("msm_jsd").verdict == "agrees"
    assert wrong.row("transition_jsd").verdict == "differs"
    assert wrong.row("msm_timescale:1").verdict == "differs"
    titles = [getattr(chart, "title", "") for chart in fair.charts]
    assert "Implied timescales" in titles


def phi_of(ensemble: Ensemble) -> np.ndarray:
    from systems.chemistry.geometry import torsion
    from systems.chemistry.graph import backbone_torsions

    return torsion(ensemble.segments[0][:], backbone_torsions(ensemble.scene)["phi"])[:, 0]


def test_a_process_into_a_state_that_is_never_held_is_not_timed(
    inputs: tuple[Ensemble, Ensemble, Ensemble], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The toy's left-handed state (phi > 0) is cut out of the candidate, or of the replicate."""
    from dataclasses import replace

    reference, candidate, replicate = inputs
    monkeypatch.setattr(kinetics, "TICA_LAG_PS", 2.0)
    keep = phi_of(candidate) < 0
    keep[[np.argmin(keep), len(keep) - 1 - np.argmin(keep[::-1])]] = True  # two frames that stray are no visit
    blind = replace(candidate, segments=[candidate.segments[0][:][keep]])
    fair, wrong = compare(reference, [candidate, blind], replicate, options=QUICK).evaluations
    timed = {row.key for row in fair.rows if row.key.startswith("msm_timescale")}
    assert len(timed) >= 2
    assert not any(what.startswith("Implied timescale") for what, _ in fair.skipped)
    left_out = [(what, why) for what, why in wrong.skipped if what.startswith("Implied timescale")]
    kept = {row.key for row in wrong.rows if row.key.startswith("msm_timescale")}
    assert len(left_out) + len(kept) == len(timed) and left_out and kept, (
        "the process between the others is still timed"
    )
    assert "the candidate never stays in state" in left_out[0][1] and "φ 6" in left_out[0][1]
    # What it lacks is not forgiven: the populations say so.
    assert wrong.row("msm_jsd").verdict == "differs"

    def drawn(evaluation, role: str) -> int:  # type: ignore[no-untyped-def]
        chart = next(c for c in evaluation.charts if getattr(c, "title", "") == "Implied timescales")
        assert ("never stays in state" in chart.caption) == (evaluation is not fair)
        return sum(line.role == role for line in chart.lines)

    assert drawn(wrong, "candidate") == len(timed) - 1 == drawn(fair, "candidate") - 1

    lame = replace(replicate, segments=[replicate.segments[0][:][phi_of(replicate) < 0]])
    (other,) = compare(reference, [candidate], lame, options=QUICK).evaluations
    gone = [row for row in other.rows if row.key.startswith("msm_timescale") and not np.isfinite(row.replicate.value)]
    assert len(gone) == len(left_out) and all(np.isfinite(row.candidate.value) for row in gone)
    assert all(row.verdict in ("agrees", "undecided") for row in gone)
