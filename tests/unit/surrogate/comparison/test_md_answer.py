"""What MD's answer says of alanine dipeptide that jumps between α, β and left-handed as we have it jump."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from surrogate.comparison import convergence, markov
from surrogate.comparison import md_answer as told
from surrogate.comparison.answer import MODEL_ERROR, Answer
from surrogate.comparison.markov import equilibrium, with_prior
from surrogate.comparison.md_answer import frames_over_states, md_answer
from surrogate.comparison.measure.torsions import find_torsions
from surrogate.comparison.pooled import raked
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.report.figures import answer_overview
from systems.chemistry.graph import backbone_torsions, bonded_graph, turned
from systems.errors import InputError
from systems.library.named_scenes import prepare
from systems.prepare.peptide import build_peptide
from systems.prepare.ring_conformers import ring_conformers

SCENE = build_peptide("ACE-ALA-NME")
STATES = {"α": (-70.0, -40.0), "β": (-80.0, 140.0), "left-handed": (55.0, 40.0)}
POPULATIONS = np.array([0.6, 0.3, 0.1])
MATRIX = np.array([[0.99, 0.01, 0.0], [0.02, 0.97, 0.01], [0.0, 0.03, 0.97]])
FORMS = 40


@pytest.fixture(scope="module")
def forms() -> np.ndarray:
    """Frames `(3, FORMS, n_atoms, 3)` of each state, thermally spread."""
    rng = np.random.default_rng(0)
    graph, found = bonded_graph(SCENE), backbone_torsions(SCENE)
    out = np.empty((3, FORMS, SCENE.n_atoms, 3), dtype=np.float32)
    for s, centre in enumerate(STATES.values()):
        for k in range(FORMS):
            x = SCENE.positions_nm
            for quad, angle in zip((found["phi"][0], found["psi"][0]), centre, strict=True):
                now = _angle(x, quad)
                x = turned(x, quad.tolist(), math.radians(angle + rng.normal(0, 12.0)) - now, graph)
            out[s, k] = x
    return out


def _angle(x: np.ndarray, quad: np.ndarray) -> float:
    from systems.chemistry.geometry import torsion

    return float(torsion(x[None], quad[None])[0, 0])


def jumps(matrix: np.ndarray, starts: list[int], n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    state, cumulative = np.array(starts), matrix.cumsum(1)
    out = np.empty((len(starts), n), dtype=np.int64)
    for t in range(n):
        out[:, t] = state
        state = (rng.random(len(starts))[:, None] > cumulative[state]).sum(1)
    return out


def ensemble(forms: np.ndarray, states: np.ndarray, seed: int = 0) -> Ensemble:
    rng = np.random.default_rng(seed)
    return Ensemble("MD", [forms[row, rng.integers(FORMS, size=len(row))] for row in states], 1.0, SCENE)


def drawn(forms: np.ndarray, populations: np.ndarray, seed: int = 5) -> Ensemble:
    """A surrogate's rollout with these populations."""
    rng = np.random.default_rng(seed)
    return ensemble(forms, rng.choice(3, p=populations, size=(8, 500)), seed)


def test_a_surrogate_with_wrong_populations_leaves_the_answer_md_s(forms: np.ndarray) -> None:
    wrong = np.array([0.05, 0.15, 0.8])
    starts = np.random.default_rng(1).choice(3, p=wrong, size=32)
    md = ensemble(forms, jumps(MATRIX, starts.tolist(), 250, 2))
    answer = md_answer(md, 300.0, surrogate=drawn(forms, wrong))
    for state, right in zip(answer.states, POPULATIONS, strict=True):
        assert abs(state.share - right) < 3.0 * state.error + 0.01, state
        assert state.error < 0.2 and state.differs
    assert not answer.missing and answer.holds
    assert "differ" in answer.on_surrogate
    energy = next(s for s in answer.states if s.state == "left-handed")
    assert energy.free_energy_kj_mol == pytest.approx(2.494 * math.log(6.0), abs=3.0 * (energy.free_energy_error or 0))
    json.dumps(answer.to_dict(), allow_nan=False)


def test_a_right_surrogate_agrees(forms: np.ndarray) -> None:
    md = ensemble(forms, jumps(MATRIX, [0, 0, 1, 2] * 8, 400, 3))
    answer = md_answer(md, 300.0, surrogate=drawn(forms, POPULATIONS))
    assert "agree" in answer.on_surrogate and len(answer.states) == 3


def test_a_state_that_the_surrogate_misses_is_found_where_md_goes_there(forms: np.ndarray) -> None:
    md = ensemble(forms, jumps(MATRIX, [0, 1] * 16, 300, 4))
    answer = md_answer(md, 300.0, surrogate=drawn(forms, np.array([0.7, 0.3, 0.0])))
    left = next(s for s in answer.states if s.state == "left-handed")
    assert left.n_begun == 0 and left.differs and abs(left.share - 0.1) < 3.0 * left.error + 0.01


def test_a_state_that_the_surrogate_invents_is_left_and_weighs_nothing(forms: np.ndarray) -> None:
    matrix = np.array([[0.99, 0.01, 0.0], [0.02, 0.98, 0.0], [0.05, 0.0, 0.95]])
    md = ensemble(forms, jumps(matrix, [2] * 24 + [0] * 8, 300, 5))
    answer = md_answer(md, 300.0, surrogate=drawn(forms, np.array([0.2, 0.2, 0.6])))
    left = next(s for s in answer.states if s.state == "left-handed")
    assert left.share == 0.0 and not left.missing and left.differs
    right = {s.state: s for s in answer.states}
    assert abs(right["α"].share - 2 / 3) < 3.0 * right["α"].error + 0.01


def test_a_state_that_no_md_leaves_is_missing_not_invented(forms: np.ndarray) -> None:
    matrix = np.array([[0.99, 0.01, 0.0], [0.02, 0.98, 0.0], [0.0, 0.0, 1.0]])
    md = ensemble(forms, jumps(matrix, [0, 1, 2, 2] * 8, 300, 6))
    answer = md_answer(md, 300.0, surrogate=drawn(forms, POPULATIONS))
    left = next(s for s in answer.states if s.state == "left-handed" and s.torsion.startswith("ALA"))
    told = " ".join(answer.missing)
    assert "not connected" in told and "ALA" in told
    # Whichever side holds more frames has the weights; the other has none, and says so.
    assert bool(left.missing) != all(s.missing for s in answer.states if s.state != "left-handed")
    assert sum(float(w.sum()) for w in answer.weights) == pytest.approx(32 * 300)


def test_a_rare_state_that_md_hardly_visited_is_named_and_the_others_are_given(forms: np.ndarray) -> None:
    matrix = np.array([[0.98, 0.02, 0.0], [0.03, 0.9695, 0.0005], [0.0, 0.008, 0.992]])
    answer = md_answer(ensemble(forms, jumps(matrix, [0, 1] * 8 + [2], 1000, 8)), 300.0)
    assert len(answer.missing) == 1 and answer.is_sure
    assert answer.missing[0].startswith("hardly known: ALA 2 left-handed, entered and left ")
    assert answer.in_short[0] == "Use MD's answer, except for states that few or no transitions connect."
    left = next(s for s in answer.states if s.state == "left-handed")
    assert left.error > 0.4 * left.share and max(s.error for s in answer.states) < 0.1


SLOW = np.array([[0.998, 0.002, 0.0], [0.004, 0.993, 0.003], [0.0, 0.009, 0.991]])


def rolled(forms: np.ndarray, matrix: np.ndarray, n: int = 2000, seed: int = 9) -> Ensemble:
    return ensemble(forms, jumps(matrix, [0, 0, 0, 0, 1, 1, 2, 2], n, seed), seed)


def off(answer: Answer) -> float:
    """The root mean square error of α, β and left-handed."""
    return float(np.sqrt(np.mean([(s.share - p) ** 2 for s, p in zip(answer.states, POPULATIONS, strict=True)])))


def test_short_md_and_a_surrogate_together_err_less_than_either(forms: np.ndarray) -> None:
    """MD sees a dozen crossings in all; the surrogate is off by 10 %, at other rates."""
    model = np.array([[0.996, 0.004, 0.0], [0.0053, 0.9887, 0.006], [0.0, 0.02, 0.98]])  # 0.50, 0.38, 0.12
    own = rolled(forms, model)
    errors = []
    for seed in range(4):
        md = ensemble(forms, jumps(SLOW, [0, 1, 2, 1] * 4, 150, 20 + seed), seed)
        alone, joint = md_answer(md, 300.0), md_answer(md, 300.0, surrogate=own)
        assert joint.is_joint and not alone.is_joint
        errors.append((off(alone), off(joint)))
        for s, p in zip(joint.states, POPULATIONS, strict=True):
            assert abs(s.share - p) < 3.0 * s.error + 0.05 and s.error < 0.25
            assert s.by_md == pytest.approx(next((a.share, a.error) for a in alone.states if a.state == s.state))
        weights, states = np.concatenate(joint.weights), np.concatenate([_states(x) for x in md.segments])
        shares = np.bincount(states, weights, minlength=3) / weights.sum()
        assert shares == pytest.approx([s.share for s in joint.states], abs=0.02), "frames weigh as the states do"
    alone, joint = np.sqrt(np.mean(np.square(errors), axis=0))
    assert joint < 0.6 * alone and joint < 0.09


@pytest.mark.parametrize(("factor", "together"), [(2.0, False), (0.5, True)])
def test_md_answers_alone_where_a_surrogate_would_make_its_errors_larger(
    forms: np.ndarray, monkeypatch: pytest.MonkeyPatch, factor: float, together: bool
) -> None:
    def joint(answer: Answer, *rest: object) -> Answer:
        states = tuple(
            dataclasses.replace(s, md_share=s.share, md_error=s.error, error=factor * s.error) for s in answer.states
        )
        return dataclasses.replace(answer, states=states)

    monkeypatch.setattr(told, "_joint", joint)
    md = ensemble(forms, jumps(MATRIX, [0, 1, 2, 1] * 4, 150, 3))
    found = md_answer(md, 300.0, surrogate=rolled(forms, MATRIX))
    assert found.is_sure and not found.missing and found.is_joint == together


UMBRELLA = np.array([[0.96, 0.04, 0.0], [0.04, 0.92, 0.04], [0.0, 0.04, 0.96]])  # a third each


def under_umbrella(forms: np.ndarray, n: int, seed: int) -> Ensemble:
    """MD under a potential that makes all states alike likely, which are POPULATIONS without it."""
    states = jumps(UMBRELLA, [0, 1, 2, 1] * 4, n, seed)
    differences = -8.314462618e-3 * 300.0 * np.log(POPULATIONS)
    return dataclasses.replace(ensemble(forms, states, seed), differences_kj_mol=[differences[row] for row in states])


def test_md_under_an_umbrella_tells_populations_without_it(forms: np.ndarray) -> None:
    md = under_umbrella(forms, 2000, 1)
    answer = md_answer(md, 300.0)
    assert answer.under_umbrella and answer.is_sure and not answer.relaxation_ps
    assert [s.share for s in answer.states] == pytest.approx(POPULATIONS, abs=0.03)
    assert answer.in_short[0].startswith("Use MD's answer") and "relaxation times" not in answer.in_short[1]
    assert "MD under an umbrella potential of torsions is 16 replicas" in answer.in_short[2]
    assert md_answer(md, 300.0, surrogate=drawn(forms, np.array([0.3, 0.3, 0.4]))).to_dict()["populations_by"] == "MD"
    unweighted = md_answer(dataclasses.replace(md, differences_kj_mol=None), 300.0)
    assert abs(unweighted.states[0].share - 0.6) > 0.2, "negative control"


def test_few_of_it_and_a_surrogate_are_pooled_by_their_errors(forms: np.ndarray) -> None:
    own = drawn(forms, np.array([0.5, 0.38, 0.12]))
    errors = []
    for seed in range(6):
        md = under_umbrella(forms, 20, 30 + seed)
        alone, both = md_answer(md, 300.0), md_answer(md, 300.0, surrogate=own)
        assert both.is_joint and both.under_umbrella and not alone.is_joint
        errors.append((off(alone), off(both)))
        for s, a in zip(both.states, alone.states, strict=True):
            rolled_error, (share, own_error) = math.hypot(MODEL_ERROR, s.surrogate_error or 0.0), s.by_md
            assert s.error == pytest.approx((own_error**-2 + rolled_error**-2) ** -0.5)
            assert share == a.share and own_error >= a.error
        assert sum(s.share for s in both.states) == pytest.approx(1.0)
        weights, states = np.concatenate(both.weights), np.concatenate([_states(x) for x in md.segments])
        shares = np.bincount(states, weights, minlength=3) / weights.sum()
        assert shares == pytest.approx([s.share for s in both.states], abs=1e-3), "frames weigh as the states do"
    alone, both = np.sqrt(np.mean(np.square(errors), axis=0))
    assert both < 0.9 * alone


def test_a_state_that_md_never_crosses_into_has_the_error_of_that(forms: np.ndarray) -> None:
    """Half of the replicas stay in α, half in β; one crosses once."""
    rows = np.repeat([[0], [1]] * 8, 60, axis=1)
    rows[0, 30:] = 1
    md = ensemble(forms, rows)
    md = dataclasses.replace(md, differences_kj_mol=[np.zeros(60) for _ in rows])
    own = drawn(forms, np.array([0.5, 0.5, 0.0]))
    both = md_answer(md, 300.0, surrogate=own)
    first = both.states[0]
    assert both.is_joint and first.by_md[1] > 0.3 and abs(first.share - 0.5) < 0.1


def test_frames_are_weighted_to_the_shares_of_every_torsion() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.integers(2, size=(3, 500)), rng.integers(3, size=(3, 500))
    other[0, :5] = -1
    weights = raked(
        list(rng.random((3, 500))), [(list(one), np.array([0.7, 0.3])), (list(other), np.array([0.2, 0.5, 0.3]))]
    )
    every, known = np.concatenate(weights), other.ravel() >= 0
    assert np.bincount(one.ravel(), every) / every.sum() == pytest.approx([0.7, 0.3], abs=2e-3)
    found = np.bincount(other.ravel()[known], every[known])
    assert found / found.sum() == pytest.approx([0.2, 0.5, 0.3], abs=2e-3)
    unseen = raked([np.ones(10)], [([np.zeros(10, dtype=int)], np.array([0.5, 0.5]))])
    assert unseen[0] == pytest.approx(np.ones(10)), "a state without frames gets none"


def _states(frames: np.ndarray) -> np.ndarray:
    from systems.chemistry.geometry import torsion

    found = backbone_torsions(SCENE)
    phi, psi = (torsion(frames, found[name][:1])[:, 0] for name in ("phi", "psi"))
    return np.where(phi > 0, 2, np.where((psi > math.radians(-120)) & (psi < math.radians(80)), 0, 1))


def test_a_surrogate_counts_for_less_the_more_md_has_seen(forms: np.ndarray) -> None:
    """Counts of a rollout are worth a dozen crossings, however long it is."""
    model = np.array([[0.99, 0.01, 0.0], [0.01, 0.98, 0.01], [0.0, 0.01, 0.99]])  # a third each
    of_rollout, matrix = jumps(model, [0, 1, 2, 1] * 2, 4000, 1), SLOW
    shares = []
    for n in (100, 1000, 10_000):
        md = list(jumps(matrix, [0, 1, 2, 1] * 4, n, 2))
        alone = equilibrium(md)
        longer = with_prior(alone, md, list(of_rollout), crossings=12.5).populations
        twice = with_prior(alone, md, [*of_rollout, *of_rollout], crossings=12.5).populations
        assert longer == pytest.approx(twice, abs=0.02)
        whole = with_prior(alone, md, list(of_rollout), crossings=1e9).populations
        shares.append((longer[2] - alone.populations[2], whole[2]))
    assert abs(shares[2][0]) < 0.01 < abs(shares[0][0]), "what MD sees often is MD's"
    assert shares[1][1] > 0.2, "negative control: counted whole the rollout outweighs MD"


def test_where_md_connects_nothing_the_surrogate_alone_connects(forms: np.ndarray) -> None:
    md = ensemble(forms, np.repeat([[0], [0], [1], [2]] * 4, 60, axis=1))
    alone, joint = (md_answer(md, 300.0, surrogate=s) for s in (None, rolled(forms, MATRIX)))
    assert alone.in_short[0].startswith("Do not use")
    assert alone.missing == tuple(f"not connected: ALA 2 {state} was only begun in (4 of 16 replicas)"
                                  for state in ("β", "left-handed"))  # fmt: skip
    assert len(answer_overview("x", joint.to_dict()).axes[0].get_yticks()) == 3
    assert joint.is_joint and joint.missing and "For 3 states" in joint.in_short[1]
    for s, p in zip(joint.states, POPULATIONS, strict=True):
        assert abs(s.share - p) < 3.0 * s.error + 0.05 and s.is_known
    assert "; MD not connected" in " ".join(text for _, text in joint.table())


def test_what_a_rollout_saw_once_does_not_make_all_of_it_count() -> None:
    """A state entered once in a long rollout that is wrong about the others: MD sees these often and is right."""
    model = np.array([[0.95, 0.05, 0.0], [0.02, 0.979999, 0.000001], [0.0, 0.0005, 0.9995]])
    of_rollout = list(jumps(model, [0, 1] * 4, 6000, 4))
    of_rollout[0][-300:-100] = 2
    md = list(jumps(np.array([[0.98, 0.02, 0.0], [0.05, 0.95, 0.0], [0.0, 0.0, 1.0]]), [0, 1] * 8, 300, 5))
    found = with_prior(equilibrium(md, lag=1), md, of_rollout, crossings=12.5)
    assert abs(found.populations[0] - 5 / 7) < 3.0 * found.draws.std(0)[0] < 0.3
    assert found.populations[0] > 0.6, "the rollout says 2 / 7"


def test_a_draw_that_is_not_found_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a draw without populations it would be an error of a third of every share."""
    md, of_rollout = (list(jumps(SLOW, [0, 1, 2, 1] * 4, n, 2)) for n in (400, 2000))
    alone, fits, calls = equilibrium(md), markov._fits, iter(range(1000))
    monkeypatch.setattr(markov, "_fits", lambda *a: [None if next(calls) % 5 == 4 else found for found in fits(*a)])
    found = with_prior(alone, md, of_rollout, crossings=12.5)
    assert len(found.draws) == len(found.resampled) == 40
    assert found.draws.sum(1) == pytest.approx(1.0)
    monkeypatch.setattr(markov, "_fits", lambda counts, *_: [None] * len(counts))
    with pytest.raises(InputError, match="no reversible Markov model"):
        with_prior(alone, md, of_rollout, crossings=12.5)


def test_a_visit_that_md_has_not_ended_is_no_trap(forms: np.ndarray) -> None:
    """One replica enters the last state at its end; nothing but a rollout that hardly counts would have it leave."""
    md = list(jumps(np.array([[0.95, 0.05, 0.0], [0.05, 0.95, 0.0], [0.0, 0.0, 1.0]]), [0, 1] * 8, 400, 3))
    md[0][-3:] = 2
    of_rollout = list(jumps(np.array([[0.9, 0.09, 0.01], [0.1, 0.9, 0.0], [0.5, 0.0, 0.5]]), [0, 1, 2, 0], 2000, 4))
    found = with_prior(equilibrium(md, lag=1), md, of_rollout, crossings=0.01)
    assert 0.0 < found.populations[2] < 0.002


def test_a_rollout_is_reweighted_by_the_energies_of_its_reference(forms: np.ndarray) -> None:
    """The rollout jumps by MATRIX; its reference has the left-handed state 4.98 kJ/mol lower, two kT."""
    states = jumps(MATRIX, [0, 0, 1, 2] * 8, 400, 3)
    lower = np.where(states == 2, 2.0, 0.0)
    asked = np.random.default_rng(4).random(states.shape) < 0.3
    factors = [*np.where(asked, np.exp(lower), np.nan)]
    right = POPULATIONS * np.exp([0.0, 0.0, 2.0])
    right /= right.sum()
    answer = md_answer(ensemble(forms, states), 300.0, surrogate=ensemble(forms, states), factors=factors)
    n, effective = answer.energies
    assert n == asked.sum() and effective == pytest.approx(
        np.exp(lower[asked]).sum() ** 2 / np.exp(2 * lower[asked]).sum()
    )
    for state, share in zip(answer.states, right, strict=True):
        assert abs(state.share - share) < 3.0 * state.error + 0.01 and state.error < 0.08
    left = answer.states[2]
    assert (
        left.differs and left.surrogate == pytest.approx(0.1, abs=0.06) and "the reweighted ones" in answer.on_surrogate
    )
    # Weights of frames are those of the states; frames that were not asked weigh nothing.
    weights = np.array(answer.weights)
    assert not weights[~asked].any() and weights.mean() == pytest.approx(1.0)
    share = np.bincount(states.ravel(), weights.ravel(), minlength=3) / weights.sum()
    assert share == pytest.approx([s.share for s in answer.states], abs=0.01)
    wrong = md_answer(ensemble(forms, states), 300.0, factors=[1.0 / f for f in factors])
    assert not any(s.share > 0.05 for s in wrong.states if s.state == "left-handed"), "negative control: the sign"
    few = [np.where(np.arange(400) < 1, f, np.nan) for f in np.exp(lower)]
    short = md_answer(ensemble(forms, states), 300.0, factors=few)
    assert not short.holds and "of 32 frames are effective: a longer `budget`" in " ".join(short.missing)
    rare = np.where(np.random.default_rng(5).random(states.shape) < 0.003, 1e4, 1.0)
    poor = md_answer(ensemble(forms, states), 300.0, factors=[*np.where(asked, rare, np.nan)])
    assert not poor.holds and "give one of this molecule" in " ".join(poor.missing)


def test_all_frames_tell_by_how_much_those_that_were_asked_are_off(
    forms: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    states = jumps(np.full((3, 3), 1 / 3), [0, 1, 2, 0] * 8, 400, 3)
    lower = np.where(states == 2, 0.5, 0.0)
    right = np.exp([0.0, 0.0, 0.5]) / np.exp([0.0, 0.0, 0.5]).sum()

    def answers(n: int) -> np.ndarray:
        """Shares and errors `(n, 2, 3)` by one frame of a hundred, always another one."""
        found = []
        for seed in range(n):
            asked = np.random.default_rng(seed).random(states.shape) < 0.01
            answer = md_answer(ensemble(forms, states), 300.0, factors=[*np.where(asked, np.exp(lower), np.nan)])
            found.append([[s.share for s in answer.states], [s.error for s in answer.states]])
        return np.array(found)

    off, stated = np.swapaxes(answers(6) - [right, np.zeros(3)], 0, 1)
    monkeypatch.setattr(
        told, "_reweighted_shares", lambda found, micro, labels, f, every: found.shares(micro, labels, 3, f)
    )
    plain, plain_stated = np.swapaxes(answers(6) - [right, np.zeros(3)], 0, 1)
    assert np.sqrt(np.square(off).mean()) < 0.6 * np.sqrt(np.square(plain).mean())
    assert stated.mean() < 0.6 * plain_stated.mean(), "negative control: weights of asked frames alone"
    assert 0.5 < np.sqrt(np.square(off).mean()) / stated.mean() < 1.7


def test_a_replica_of_one_frame_counts_as_one_frame(forms: np.ndarray) -> None:
    md = ensemble(forms, jumps(MATRIX, [0, 1, 2, 0] * 4, 300, 3))
    answer = md_answer(dataclasses.replace(md, segments=[md.segments[0][:1], *md.segments[1:]]), 300.0)
    assert [len(w) for w in answer.weights] == [1, *[300] * 15] and answer.n_replicas == 16
    assert off(answer) < 0.1


def test_weights_make_plain_histograms_right(forms: np.ndarray) -> None:
    states = jumps(MATRIX, [2] * 32, 250, 7)
    answer = md_answer(ensemble(forms, states), 300.0)
    weights = np.concatenate(answer.weights)
    share = np.bincount(states.ravel(), weights, minlength=3) / weights.sum()
    plain = np.bincount(states.ravel(), minlength=3) / states.size
    assert np.abs(share - POPULATIONS).max() < np.abs(plain - POPULATIONS).max()
    (grid,) = answer.maps.values()
    assert grid.shape == (36, 36) and grid.min() == 0.0


# Butane's anti, gauche+ and gauche-, of populations 5/8 and twice 3/16.
GAUCHE = np.array([[0.94, 0.03, 0.03], [0.1, 0.9, 0.0], [0.1, 0.0, 0.9]])


def butane(centres: tuple[float, ...], states: np.ndarray, smiles: str = "CCCC") -> Ensemble:
    """Butane, or another molecule with one torsion, which is about the centre, in degrees, of each state."""
    scene = prepare(f"smiles:{smiles}")
    graph, rng = bonded_graph(scene), np.random.default_rng(0)
    (quad,) = (t.quad for t in find_torsions(scene) if t.kind == "rotatable")
    forms = np.array([[turned(scene.positions_nm, list(quad), math.radians(c + rng.normal(0, 12.0))
                              - _angle(scene.positions_nm, np.array(quad)), graph) for _ in range(FORMS)]
                      for c in centres], dtype=np.float32)  # fmt: skip
    return Ensemble("MD", [forms[row, rng.integers(FORMS, size=len(row))] for row in states], 1.0, scene)


def test_wells_of_a_further_torsion_are_states_with_their_shares() -> None:
    """Butane's torsion: anti and both gauche, of known shares, named by their mean angles; one well is no state."""
    states = jumps(GAUCHE, [0, 1, 2, 0] * 4, 300, 8)
    answer = md_answer(butane((180.0, 65.0, -65.0), states), 300.0)
    found = {s.state: s for s in answer.states}
    named = {int(name.removesuffix("°")): s for name, s in found.items()}
    assert len(found) == 3 and all(min(abs(abs(k) - c) for c in (180, 65)) < 8 for k in named)
    for k, state in named.items():
        right = 0.625 if abs(k) > 120 else 0.1875
        assert abs(state.share - right) < 3.0 * state.error + 0.03, (k, state)
    assert not md_answer(butane((180.0, 180.0, 180.0), states), 300.0).states, "negative control"


def test_a_molecule_that_is_its_own_mirror_image_has_either_hand_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    # All begin on one side, and few get to the other.
    states = jumps(GAUCHE, [1] * 12, 40, 3)
    md = butane((180.0, 65.0, -65.0), states)

    def hands(answer: Answer) -> tuple[float, float]:
        found = {int(s.state.removesuffix("°")): s.share for s in answer.states}
        return next(s for k, s in found.items() if 0 < k < 120), next(s for k, s in found.items() if -120 < k < 0)

    answer = md_answer(md, 300.0)
    plus, minus = hands(answer)
    assert (
        plus == pytest.approx(minus, abs=0.01)
        and answer.has_images
        and "each with its mirror image" in answer.in_short[2]
    )
    for s in answer.states:
        right = 0.1875 if abs(int(s.state.removesuffix("°"))) < 120 else 0.625
        assert abs(s.share - right) < 3.0 * s.error
    assert answer.n_replicas == len(answer.weights) == 12 and all(s.n_replicas <= 12 for s in answer.states)
    assert np.mean(np.concatenate(answer.weights)) == pytest.approx(1.0)
    # Frames of MD have these shares by their weights, whichever side they are on.
    side = np.average(states.ravel() == 1, weights=np.concatenate(answer.weights))
    assert side == pytest.approx(plus, abs=0.02) and (states == 1).mean() > 0.3
    # Twice as many replicas would have less of an error: each is drawn with its image.
    anti = next(s for s in answer.states if abs(int(s.state[:-1])) > 120)
    twice = md_answer(butane((180.0, 65.0, -65.0), np.concatenate([states, jumps(GAUCHE, [1] * 12, 40, 9)])), 300.0)
    assert anti.error > next(s for s in twice.states if abs(int(s.state[:-1])) > 120).error
    monkeypatch.setattr(told, "_is_its_mirror_image", lambda scene: False)
    plus, minus = hands(control := md_answer(md, 300.0))
    assert abs(plus - minus) > 0.1 and not control.has_images, "negative control"


def test_states_that_no_transitions_connect_are_named_each() -> None:
    """Anti is only begun in; images of replicas are no replicas."""
    rng = np.random.default_rng(0)
    turns = 1 + np.cumsum(rng.random((8, 200)) < 0.1, axis=1) % 2
    answer = md_answer(butane((180.0, 65.0, -65.0), np.concatenate([np.zeros((4, 200), dtype=int), turns])), 300.0)
    assert answer.has_images and len(answer.missing) == 1
    assert "180° was only begun in (4 of 12 replicas)" in answer.missing[0]


def test_states_of_a_folded_torsion_are_named_in_its_own_degrees() -> None:
    """Of biphenyl, whose rings look the same after half a turn."""
    md = butane((45.0, -45.0), jumps(np.array([[0.95, 0.05], [0.05, 0.95]]), [0, 1], 400, 3), "c1ccccc1-c1ccccc1")
    names = [s.name.replace("°", "").split(" to ") for s in convergence.tested_reference([md]).states if s.name]
    assert len(names) == 2
    for low, high in names:
        assert (float(high) - float(low)) % 180.0 == pytest.approx(90.0, abs=10.0)
    assert sorted(int(s.state[:-1]) for s in md_answer(md, 300.0).states) == pytest.approx([-45, 45], abs=6)


def test_the_hand_is_that_of_what_turns_most_slowly() -> None:
    """By a torsion that turns quickly, the side of a slow one beside another would be forgotten with every turn."""
    flip = lambda p, seed: jumps(np.array([[1 - p, p], [p, 1 - p]]), [0, 1] * 4, 400, seed)  # noqa: E731
    fast, slow = 2.0 * flip(0.3, 1) - 1.0, 2.0 * flip(0.01, 2) - 1.0
    angles = [np.stack([1.57 * f, 0.8 * s], 1) for f, s in zip(fast, slow, strict=True)]
    hands = told._hands(angles, 10.0)
    assert hands is not None
    alike = float(np.mean([h == (s < 0) for h, s in zip(hands, slow, strict=True)]))
    assert min(alike, 1.0 - alike) < 0.01
    assert told._hands([np.abs(a) for a in angles], 10.0) is None, "negative control: never on the other side"


def test_a_hand_that_md_never_changes_is_not_the_other() -> None:
    """An axis that does not turn: its mirror image is another molecule, whatever its atoms say."""
    states = jumps(np.array([[0.9, 0.1], [0.1, 0.9]]), [0, 1] * 6, 60, 3)
    answer = md_answer(butane((60.0, 120.0), states), 300.0)
    assert not answer.has_images and not answer.missing
    assert sorted(int(s.state[:-1]) > 0 for s in answer.states) == [True, True]


@pytest.mark.parametrize(
    ("smiles", "is_own_image"),
    [
        ("CCN(CC)CC(=O)Nc1c(C)cccc1C", True),  # its amine turns inside out
        ("C1CCCCC1", True),
        ("CC(C)CC", False),  # isopropyl's methyls have names
        ("CC[NH+](CC)CC", False),
        ("CS(=O)C", False),
        ("CCS(=O)(=O)CC", False),
        ("C[C@H](O)CC", False),
    ],
)
def test_what_keeps_its_hand_atom_by_atom(smiles: str, is_own_image: bool) -> None:
    assert told._is_its_mirror_image(prepare(f"smiles:{smiles}")) is is_own_image


def chairs(n_turned: int, smiles: str = "CC1CCCCC1") -> Ensemble:
    """Twelve replicas of methylcyclohexane, so many of them in the other chair than the rest."""
    scene, rng = prepare(f"smiles:{smiles}"), np.random.default_rng(2)
    forms = ring_conformers(scene)
    x = np.stack([forms[int(k < n_turned)] for k in range(12)])[:, None].repeat(60, axis=1)
    return Ensemble("MD", list((x + rng.normal(0, 0.004, x.shape)).astype(np.float32)), 1.0, scene)


def test_a_chair_that_never_turns_over_is_not_connected() -> None:
    answer = md_answer(chairs(4), 300.0)
    assert len(answer.states) == 2 and all(s.torsion.startswith("ring") for s in answer.states)
    assert "not connected: ring" in answer.missing[0] and "4 of 12 replicas" in answer.missing[0]
    assert answer.in_short[0] == "Do not use MD's populations yet." and not answer.is_sure
    assert "0.0" not in answer.in_short[1], "what one state is alone with is known to no error"
    assert md_answer(chairs(0), 300.0).is_sure, "control"


def test_chairs_that_are_mirror_images_are_as_likely() -> None:
    answer = md_answer(chairs(4, "O1CCOCC1"), 300.0)
    assert answer.is_sure and not answer.missing and answer.has_images
    assert [s.share for s in answer.states] == pytest.approx([0.5, 0.5], abs=1e-9)
    assert [s.n_replicas for s in answer.states] == [12, 12] == [s.n_begun for s in answer.states]
    assert len(answer.weights) == 12 and np.mean(np.concatenate(answer.weights)) == pytest.approx(1.0)
    one = md_answer(chairs(0, "O1CCOCC1"), 300.0)
    assert not one.has_images and not one.states, "negative control: nothing says that the other chair is the same"


def test_a_molecule_without_torsions_is_one_line() -> None:
    methane = prepare("smiles:C")
    md = Ensemble("MD", [np.repeat(methane.positions_nm[None], 60, 0).astype(np.float32)] * 4, 1.0, methane)
    with pytest.raises(InputError, match="no torsion turns"):
        md_answer(md, 300.0)
    counted = md_answer(md, 300.0, factors=[np.linspace(0.5, 1.5, 60)] * 4)
    assert counted.in_short[0] == "Use the reweighted frames." and counted.holds
    np.testing.assert_allclose(np.array(counted.weights), np.linspace(0.5, 1.5, 60)[None].repeat(4, 0), rtol=1e-6)


def test_equilibrium_takes_what_no_state_holds() -> None:
    states = jumps(MATRIX, [0, 1] * 8, 300, 0)
    states[:, ::50] = -1
    assert equilibrium(list(states)).populations.sum() == pytest.approx(1.0)


def test_starts_are_drawn_over_all_states_of_a_rollout(forms: np.ndarray) -> None:
    rare = drawn(forms, np.array([0.95, 0.03, 0.02]))
    frames = frames_over_states(rare, 16, seed=1)
    known = {forms[s, k].tobytes(): s for s in range(3) for k in range(FORMS)}
    counts = np.bincount([known[f.tobytes()] for f in frames], minlength=3)
    assert counts.min() >= 2 and counts.sum() == 16
    np.testing.assert_array_equal(frames, frames_over_states(rare, 16, seed=1))
