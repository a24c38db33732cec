"""Rare states, counted by visits and evaluated as free energies, and frames that guards changed: models that miss are
caught, and runs of one simulation are not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from surrogate.comparison import comparison
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.comparison.rows.rows import Options
from surrogate.comparison.rows.torsion_rows import Visits, visits_of, visits_p, without_positive_phi
from systems.scene import Scene
from systems.trajectory.codec import open_writer

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
        assert "at φ < 0" in found.row("joint_jsd").metric and "at φ < 0" in found.row("phi_jsd").metric
        met.add(row.candidate.value)
    assert len(met) == 2


@pytest.mark.parametrize(("per_frame", "said"), [(0.008, "visited"), (0.0, "never visited")])
def test_a_state_met_much_too_often_or_never_is_named(simulate: Simulate, per_frame: float, said: str) -> None:
    seldom = entered(8e-4)
    reference, replicate = simulate(1, 5000, transitions=seldom), simulate(2, 5000, transitions=seldom)
    wrong = simulate(3, 40_000, transitions=entered(per_frame))
    found = compare(reference, [wrong], replicate).evaluations[0]
    assert found.row("free_energy:φ > 0").verdict == "differs"
    assert any(f"φ > 0 of ALA 2 is {said}" in f for f in found.findings), found.findings


def test_a_state_met_often_keeps_its_share_and_its_place_in_the_map(simulate: Simulate) -> None:
    found = compare(simulate(1), [simulate(2)], simulate(3)).evaluations[0]
    assert found.row("population:φ > 0").unit == "%"
    assert found.row("joint_jsd").metric == "Joint φ/ψ distance, ALA 2"


RECORD = {"temperature_k": 300.0, "interventions": {"guard": "fallback", "chunks": 100, "chunks_caught": 7,
          "frames": {"MD after a failure": 30}, "bias": ["a mixture"]}}  # fmt: skip
QUICK = Options(n_bootstrap=60, n_permutations=100, peptide_recipe=False)
compare_quickly = partial(comparison.compare, options=QUICK)


def test_the_column_and_the_summary_are_read(tmp_path: Path, alanine_dipeptide: Scene) -> None:
    paths = [tmp_path / f"r{k}.h5" for k in range(2)]
    frames = np.repeat(alanine_dipeptide.positions_nm[None], 40, axis=0)
    marks = np.zeros(40)
    marks[30:33] = 3
    for path in paths:
        with open_writer(path, alanine_dipeptide, RECORD) as writer:
            writer.append(frames, np.arange(40) + 1.0, scalars={"intervention": marks})
    found = load_ensemble(paths)
    assert found.changed is not None and [c.sum() for c in found.changed] == [3, 3]
    assert np.flatnonzero(found.changed[0]).tolist() == [30, 31, 32]
    assert [c.sum() for c in found.strided(2).changed or []] == [2, 2]
    (note,) = (n for n in found.notes if "guard" in n)
    assert "stepped in in 14 of 200 chunks" in note and "60 MD after a failure" in note and "a mixture" in note
    plain = tmp_path / "plain.h5"
    with open_writer(plain, alanine_dipeptide, {"temperature_k": 300.0}) as writer:
        writer.append(frames, np.arange(40) + 1.0)
    assert load_ensemble([plain]).changed is None
    assert not [n for n in load_ensemble([plain]).notes if "guard" in n]


def test_distances_without_changed_frames_stand_beside_those_with(inputs: tuple[Ensemble, Ensemble, Ensemble]) -> None:
    """A tenth of the candidate is frozen in one conformation, as by repeated repair; left out, it is as the rest is."""
    reference, candidate, replicate = inputs
    changed = [np.arange(len(s)) % 10 == 0 for s in candidate.segments]
    frozen = []
    for frames, gone in zip(candidate.segments, changed, strict=True):
        copy = np.array(frames[:])
        copy[gone] = copy[0]
        frozen.append(copy)
    touched = replace(candidate, segments=frozen, changed=changed)
    rows = {row.key: row for row in compare_quickly(reference, [touched], replicate).evaluations[0].rows}
    (key,) = (k for k in rows if k.startswith("joint_jsd_unchanged"))
    with_all, without = rows[key.replace("_unchanged", "")].candidate.value, rows[key].candidate.value
    clean = {r.key: r for r in compare_quickly(reference, [candidate], replicate).evaluations[0].rows}
    assert key not in clean
    assert without == pytest.approx(clean[key.replace("_unchanged", "")].candidate.value, rel=0.15)
    assert with_all > 1.5 * without, "the bias shows"
    assert "10 % that guards changed" in rows[key].metric


def test_nothing_or_nearly_everything_changed_is_said_and_skipped(
    inputs: tuple[Ensemble, Ensemble, Ensemble],
) -> None:
    reference, candidate, replicate = inputs
    for value, said in ((False, "changed no frame"), (True, "100 %")):
        marked = replace(candidate, changed=[np.full(len(s), value) for s in candidate.segments])
        evaluation = compare_quickly(reference, [marked], replicate).evaluations[0]
        assert not [row for row in evaluation.rows if "unchanged" in row.key]
        assert [why for what, why in evaluation.skipped if "guards changed" in what and said in why]
