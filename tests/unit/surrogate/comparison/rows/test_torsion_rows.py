"""Rare states, counted by visits and evaluated as free energies: models that miss are caught."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from surrogate.comparison import comparison
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS
from surrogate.comparison.measure.statistics import make_blocks
from surrogate.comparison.measure.structure import Features, backbone
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.rows import ComparisonInput, Options, make_sample
from surrogate.comparison.rows.torsion_rows import Visits, free_energy_row, visits_of, visits_p, without_positive_phi
from systems.scene import Scene

Simulate = Callable[..., Ensemble]
# The published recipe takes half of the time here, and no verdict rests on it.
compare = partial(comparison.compare, options=Options(peptide_recipe=False))


def entered(per_frame: float) -> np.ndarray:
    """The toy's chain with phi > 0 entered so often, and left after 50 frames on average."""
    chain = np.array([[0.88, 0.12, 0.0], [0.17, 0.83, 0.0], [0.01, 0.01, 0.98]])
    chain[:2, 2] = per_frame
    chain[0, 0] -= per_frame
    chain[1, 1] -= per_frame
    return chain


def test_visits_begin_in_the_core_and_end_in_the_other() -> None:
    degrees = [-80, -5, 5, -60, 10, 60, 5, -10, 70, -15, -90, -170, 175, -80, 50]
    found = visits_of([np.radians(degrees), np.radians([55.0, 60.0]), np.radians([-60.0, 15.0])])
    assert found == Visits(visits=3, inside=8, n_frames=19)


def test_visits_are_compared_by_the_lengths_of_their_trajectories() -> None:
    assert visits_p(Visits(0, 0, 1000), Visits(8, 90, 1000)) == pytest.approx(2 * 0.5**8)
    assert visits_p(Visits(2, 0, 1000), Visits(8, 90, 4000)) == pytest.approx(1.0)
    assert math.isnan(visits_p(Visits(0, 0, 1000), Visits(0, 0, 1000)))


def test_maps_lose_the_bins_of_positive_phi_alone() -> None:
    phi, psi = np.radians([-100.0, -3.0, 3.0, 170.0, np.nan]), np.radians([10.0, -170.0, 20.0, 20.0, 0.0])
    wide = TORSION_BINS.n_total
    counts = np.bincount(TORSION_BINS.index(phi), minlength=wide)[None]
    left = without_positive_phi(counts, TORSION_BINS.n)
    assert left.sum() == 3 and counts.sum() == 5
    wide = RAMACHANDRAN_BINS.n_total
    joint = RAMACHANDRAN_BINS.index(phi) * wide + RAMACHANDRAN_BINS.index(psi)
    counts = np.bincount(joint, minlength=wide**2)[None]
    left = without_positive_phi(counts, RAMACHANDRAN_BINS.n)
    assert np.flatnonzero(left).tolist() == sorted(joint[[0, 1, 4]].tolist())


def test_runs_of_one_simulation_agree_however_often_they_met_a_rare_state(simulate: Simulate) -> None:
    seldom = entered(4e-4)
    runs = [simulate(seed, 6000, transitions=seldom) for seed in range(6)]
    met = set()
    for k in range(0, 6, 3):
        found = compare(runs[k], [runs[k + 1]], runs[k + 2]).evaluations[0]
        row = found.row("free_energy:φ > 0")
        assert row.verdict in ("agrees", "undecided"), row.statement
        assert row.candidate.low < math.log(49) < row.candidate.high, "4e-4 * 50 of the time"
        assert not [r.key for r in found.rows if r.verdict == "differs"], found.findings
        assert found.row("joint_jsd").metric == "Distance of the φ/ψ map (φ < 0 only), ALA 2"
        assert found.row("phi_jsd").metric == "Distance of φ (φ < 0 only), ALA 2"
        met.add(row.candidate.value)
    assert len(met) == 2


@pytest.mark.parametrize(("per_frame", "said"), [(0.008, "visited"), (0.0, "never visited")])
def test_a_state_met_much_too_often_or_never_is_named(simulate: Simulate, per_frame: float, said: str) -> None:
    seldom = entered(8e-4)
    reference, replicate = simulate(1, 5000, transitions=seldom), simulate(2, 5000, transitions=seldom)
    wrong = simulate(3, 40_000, transitions=entered(per_frame))
    found = compare(reference, [wrong], replicate).evaluations[0]
    assert found.row("free_energy:φ > 0").verdict == "differs"
    assert any(f.startswith("free energy of φ > 0, ALA 2") and f"({said}" in f for f in found.findings), found.findings


def test_half_a_visit_is_no_longer_than_what_never_saw_one(alanine_dipeptide: Scene) -> None:
    """One visit of 1200 frames in the reference: a candidate of 500 frames without any is no more often there."""

    def run(n: int, visited: int = 0) -> Features:
        phi = np.where(np.arange(n) < visited, 1.0, -1.3)[:, None].astype(np.float32)
        none = [np.empty((n, 0), dtype=np.float32)]
        return Features("x", 1.0, [phi], [phi], none, [np.zeros(n, dtype=np.uint16)], None)

    samples = [make_sample(f, make_blocks(f.segment_lengths, 100), Options(), k, 500)
               for k, f in enumerate((run(8000, 1200), run(500), run(8000)))]  # fmt: skip
    inputs = ComparisonInput(alanine_dipeptide, backbone(alanine_dipeptide), None, *samples, Options())  # type: ignore[arg-type]
    row = free_energy_row(inputs, 0, "ALA 2")
    assert 0.0 < row.candidate.value < row.replicate.value  # type: ignore[union-attr]
    assert row.replicate.value == pytest.approx(math.log(8000 / 600))  # type: ignore[union-attr]


@pytest.mark.parametrize("state", [1, 2])
def test_a_candidate_in_another_state_is_not_broken(simulate: Simulate, state: int) -> None:
    """Reference and replicate stay in β, the candidate in α or left-handed: no step to compare, and no fault."""
    stays = [np.eye(3)[[k] * 3] for k in (0, state)]
    three = [simulate(k, 1000, transitions=stays[k == 2]) for k in (1, 2, 3)]
    found = compare(three[0], [three[1]], three[2]).evaluations[0]
    assert found.status == "undecided" and not [r.key for r in found.rows if r.verdict == "fails"], found.verdict
    assert dict(found.skipped)["Steps of torsions from frame to frame"] == "the three trajectories share no state"
    assert "of ψ ALA 2 than the reference" in found.verdict or "φ ALA 2, ψ ALA 2 than" in found.verdict
    assert "never enters it either" in found.verdict and " 0 times" not in found.verdict


def test_a_state_met_often_keeps_its_share_and_its_place_in_the_map(simulate: Simulate) -> None:
    found = compare(simulate(1), [simulate(2)], simulate(3)).evaluations[0]
    assert found.row("population:φ > 0").unit == "%"
    assert found.row("joint_jsd").metric == "Distance of the φ/ψ map, ALA 2"
