"""The comparison with published trajectories: on series with known basins and times, and on two short real runs."""

from __future__ import annotations

import json
import math
from pathlib import Path

import external_reference as bench
import numpy as np
import pytest

from systems.errors import InputError
from systems.scene import FloatArray


def two_basins(seed: int, *, share_alpha: float = 0.5, stay: float = 0.98, n: int = 10_000) -> FloatArray:
    """A two-state chain in psi (rad) with wells at -25 and 155 degrees: correlation time 1 / (1 - stay) frames."""
    rng = np.random.default_rng(seed)
    state = np.empty(n, dtype=bool)
    state[0] = rng.random() < share_alpha
    renew = rng.random(n) > stay
    fresh = rng.random(n) < share_alpha
    for k in range(1, n):
        state[k] = fresh[k] if renew[k] else state[k - 1]
    psi = np.radians(np.where(state, -25.0, 155.0) + 25.0 * rng.normal(size=n))
    return (psi + np.pi) % (2 * np.pi) - np.pi


@pytest.fixture(scope="module")
def theirs() -> list[FloatArray]:
    return [two_basins(k) for k in range(7)]


def test_boundaries_lie_between_the_wells(theirs: list[FloatArray]) -> None:
    low, high = (math.degrees(x) for x in bench.basin_boundaries(theirs))
    assert low == pytest.approx(-115.0, abs=15.0)
    assert high == pytest.approx(65.0, abs=15.0)


def test_one_basin_is_refused() -> None:
    with pytest.raises(InputError, match="one basin"):
        bench.basin_boundaries([np.random.default_rng(0).normal(2.6, 0.3, size=5000)])


def test_occupancy_and_time_of_a_known_chain(theirs: list[FloatArray]) -> None:
    found = bench.summarise(theirs, 1.0, bench.basin_boundaries(theirs))
    assert found["beta"].mean + found["alphaR"].mean == pytest.approx(1.0)
    assert abs(found["alphaR"].mean - 0.5) < 4 * found["alphaR"].error
    assert 0.005 < found["alphaR"].error < 0.05
    assert found["psi in alphaR"].mean == pytest.approx(-25.0, abs=1.5)
    assert found["psi in beta"].mean == pytest.approx(155.0, abs=1.5)
    assert found["psi in beta"].error < 0.5
    # cos psi is the state plus noise within the wells, which halves no more than a tenth of the correlation.
    assert found["relaxation"].mean == pytest.approx(50.0, rel=0.25)


@pytest.mark.parametrize(
    ("change", "wrong"),
    [({}, set()), ({"share_alpha": 0.65}, {"beta", "alphaR"}), ({"stay": 0.995}, {"relaxation"})],
    ids=["same", "other occupancy", "slower"],
)
def test_what_agrees_and_what_does_not(theirs: list[FloatArray], change: dict[str, float], wrong: set[str]) -> None:
    alpha = bench.basin_boundaries(theirs)
    ours = [two_basins(100 + k, **change) for k in range(10)]
    a, b = bench.summarise(ours, 1.0, alpha), bench.summarise(theirs, 1.0, alpha)
    found = {key for key in a if not bench.difference(key, "", a[key], b[key]).agrees}
    assert wrong <= found
    if not wrong:
        assert not found


def test_one_trajectory_has_no_error_bar_and_agrees_with_nothing(theirs: list[FloatArray]) -> None:
    alpha = bench.basin_boundaries(theirs)
    alone, others = bench.summarise(theirs[:1], 1.0, alpha), bench.summarise(theirs, 1.0, alpha)
    assert not bench.difference("beta", "", alone["beta"], others["beta"]).agrees


@pytest.mark.slow
def test_two_short_runs_end_to_end(shared_data: Path, tmp_path: Path) -> None:
    data = shared_data / "alanine-dipeptide"
    bench.run_ours(tmp_path, n_runs=2, time_ps=50.0, workers=2, quiet=True)
    before = {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()}
    bench.run_ours(tmp_path, n_runs=2, time_ps=50.0, workers=2, quiet=True)
    assert {p.name: p.stat().st_mtime_ns for p in tmp_path.iterdir()} == before
    result = bench.compare_with_published(data, tmp_path, n_runs=2, time_ps=50.0)
    assert json.loads((tmp_path / "comparison_2.json").read_text()) == result
    assert result["ours"] == ["seed200.h5", "seed201.h5"]
    assert result["n_frames_theirs"][:2] == [9999, 10000]
    assert "against 7 published" in bench.table(result)
    with pytest.raises(InputError, match="0 complete"):
        bench.compare_with_published(data, tmp_path / "elsewhere", n_runs=2, time_ps=50.0)
