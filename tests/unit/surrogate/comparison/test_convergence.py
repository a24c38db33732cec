"""A reference that is tested before it tests: sets that have forgotten their start pass, others are found."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from compare_starts import SETTINGS, TORSIONS, Setting, evaluated, make_set

from surrogate.comparison import convergence
from surrogate.comparison.comparison import _start_notes
from surrogate.comparison.convergence import convergence_of, explain
from surrogate.comparison.measure.torsions import find_wells
from surrogate.comparison.read.ensemble import load_ensemble

LONG = Setting("long", 32, 40.0)
DRIFTING = Setting("one start", 32, 3.0, "one")


@pytest.mark.parametrize("setting", [s for s in SETTINGS if s.must], ids=lambda s: s.name)
def test_sets_that_have_forgotten_their_start_pass(setting: Setting) -> None:
    """One in twenty may be called unconverged; three of eight are chance once in 170 times."""
    assert sum(not evaluated(setting, seed).converged for seed in range(100, 108)) <= 2


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (Setting("drift", 32, 4.0, "one"), "drifts: "),
        (Setting("short", 32, 2.0), "relaxes in"),
        (Setting("stuck", 32, 40.0, stuck=1), "a replica stays in ψ THR 2"),
        (Setting("never", 32, 40.0, never=True), "began in it, and never entered or left"),
        (Setting("few", 1, 4.0), "times in all, too few|relaxes in"),
    ],
    ids=lambda x: getattr(x, "name", ""),
)
def test_sets_that_depend_on_their_start_are_found(setting: Setting, said: str) -> None:
    import re

    found = [evaluated(setting, seed) for seed in range(200, 204)]
    assert sum(not f.converged for f in found) >= 3
    assert any(re.search(said, reason) for f in found for reason in f.reasons)
    assert all(f.remedy for f in found if not f.converged)


def test_two_halves_of_one_set_share_its_start_and_are_found() -> None:
    """Halves agree with each other, as a replicate would: only time tells."""
    whole = make_set(DRIFTING, 1)
    n = whole.n_frames // 2
    halves = [whole.frames(0, n), whole.frames(n, 2 * n)]
    shares = [np.mean(np.concatenate(list(h.psi))[:, 0] > 1.0) for h in halves]
    assert abs(shares[0] - shares[1]) < 0.15
    assert not convergence_of(halves, TORSIONS).converged


def test_a_candidate_that_depends_on_its_start_is_said_to() -> None:
    one = Setting("one run", 1, 40.0)
    sets = [make_set(setting, 4, label=setting.name) for setting in (LONG, DRIFTING, one)]
    (said,) = _start_notes(sets, TORSIONS, seed=0)
    assert said.startswith("one start itself is 32 replicas of 1.8 ns, not converged")


def test_length_is_that_of_replicas_and_what_would_tell_is_longer_ones() -> None:
    found = evaluated(DRIFTING, 3)
    assert found.length == "32 replicas of 1.8 ns" and "57.6" not in found.verdict
    assert found.needed_ps is not None and found.needed_ps > 5 * found.slowest_ps
    blind = evaluated(Setting("never", 8, 10.0, never=True), 3)
    assert blind.needed_ps is None and "began on either side of ψ THR 2, and none crossed" in blind.remedy
    none = convergence_of([make_set(DRIFTING, 3).frames(0, 10)], TORSIONS)
    assert none.verdict == "too short to test: no replica has 16 frames." and "longer replicas" in none.remedy
    # Few crossings of an only run leave it open what other starts would give.
    few = evaluated(Setting("few", 1, 4.0), 203)
    assert "starts spread" in few.remedy and "crossed" not in few.remedy


def test_what_drifts_explains_a_candidate_ahead_of_it_and_none_behind() -> None:
    """The start is at 0 % of the second state; MD is on its way to 70 %."""
    reference = make_set(DRIFTING, 1)
    found = convergence_of([reference], TORSIONS)
    ahead = explain([reference], make_set(LONG, 2), TORSIONS, found)
    assert ahead.why and not ahead.excess
    behind = explain([reference], make_set(LONG, 2, shares=(0.05, 0.5)), TORSIONS, found)
    assert any(x.state.torsion == "ψ THR 2" for x in behind.excess)
    assert all(x.row().p_value < 1e-3 and x.row().statement for x in behind.excess)


def test_a_converged_reference_explains_nothing() -> None:
    reference = make_set(LONG, 1)
    found = convergence_of([reference], TORSIONS)
    assert found.converged
    assert explain([reference], make_set(LONG, 2, shares=(0.3, 0.5)), TORSIONS, found).why == ()


def test_a_state_that_the_reference_could_not_have_met_is_undecided_and_one_it_must_have_met_is_not() -> None:
    reference = make_set(LONG, 1)
    phi = [np.where(x > 0, -1.4, x) for x in reference.phi]
    without = dataclasses.replace(reference, phi=phi)
    found = convergence_of([without], TORSIONS)
    rng = np.random.default_rng(0)

    def candidate(entries: int) -> object:
        """One of its runs holds phi > 0 for a third of all time, entered so many times."""
        made = [x.copy() for x in phi]
        for k in range(10):
            n = len(made[k])
            for part in np.array_split(np.arange(n), entries):
                made[k][part[len(part) // 4 :], 0] = 1.0 + 0.2 * rng.standard_normal(len(part[len(part) // 4 :]))
        return dataclasses.replace(reference, phi=made)

    assert found.converged
    rare, often = (explain([without], candidate(n), TORSIONS, found) for n in (1, 20))  # type: ignore[arg-type]
    stays = dataclasses.replace(reference, phi=[np.full_like(x, 1.0) for x in phi])
    (line, *_) = explain([without], stays, TORSIONS, found).why
    assert "100 % of the candidate" in line and "which began in it, never enters it either" in line
    assert any("never entered" in line for line in rare.why)
    assert often.why == ()


def test_wells_are_peaks_that_a_minimum_parts() -> None:
    rng = np.random.default_rng(1)
    two = np.concatenate([rng.normal(-1.0, 0.2, 900), rng.normal(2.5, 0.2, 100)])
    found = find_wells([two])
    assert len(found.names) == 2
    assert np.mean(found.assign([two])[0] == found.assign([np.array([2.5])])[0][0]) == pytest.approx(0.1, abs=0.01)
    assert len(find_wells([rng.normal(3.1, 0.4, 500)]).names) == 1
    gone = np.array([2.5, np.nan, 2.5])
    assert found.labels([gone])[0][1] == -1 and found.assign([gone])[0][1] >= 0
    three = np.concatenate([rng.normal(np.radians(c), 0.2, 500) for c in (-60.0, 60.0, 178.0)])
    assert len(find_wells([np.arctan2(np.sin(three), np.cos(three))]).names) == 3


def test_real_runs_of_alanine_dipeptide_pass_and_their_beginnings_do_not(shared_data: Path) -> None:
    folder = shared_data / "alanine-dipeptide"
    files = [folder / f"trajectory-{k}.dcd" for k in (1, 2, 3, 4)]
    runs = load_ensemble(files, top=folder / "ala2.pdb", lag_ps=1.0)
    assert convergence.tested_reference([runs]).converged
    begun = dataclasses.replace(runs, segments=[s[:300] for s in runs.segments])
    assert not convergence.tested_reference([begun]).converged


@pytest.mark.parametrize("n", [1, 2])
def test_of_one_run_it_is_said_that_states_may_lack(n: int) -> None:
    found = dataclasses.replace(evaluated(LONG, 0), converged=True, n_replicas=n)
    assert "no sign" in found.verdict and ("never entered" in found.verdict) == (n == 1)
