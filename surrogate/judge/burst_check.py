"""Short bursts of the truth from a candidate's own frames: does it move between states as the truth does?

Long MD would say so directly; where it is too dear, many short runs from frames of the candidate say it of each state
alone. The candidate goes on from the same frames, so that both are draws from the same starts: which of the two ended
where can be exchanged, start by start, if they move alike (a permutation test). A reversible Markov model of the
bursts' transitions says which populations the truth would have of these states (Prinz et al., J. Chem. Phys. 134,
174105 (2011)). Frames within a state are the candidate's: what it never visits, no burst sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import msm
from surrogate.judge.measure.slow_motion import tica_features
from surrogate.judge.measure.structure import Yardstick
from surrogate.judge.read.ensemble import Ensemble
from systems.errors import InputError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_DRAWS = 999
_ALARM = 0.05


@dataclass(frozen=True)
class Burst:
    """A frame to start from: its place in the candidate, and the states that the candidate is in then and a lag
    later."""

    segment: int
    frame: int
    state: int
    later: int


@dataclass(frozen=True)
class BurstCheck:
    """What bursts say of a candidate.

    `lag_ps`: their length. `truth`, `candidate`: transition counts `(n_states, n_states)` from the same starts;
    `p_value`: of both moving alike. `populations`: `(n_states,)` of the candidate; `reweighted`: what the truth's
    transitions make of them, with standard errors `reweighted_error`; NaN where bursts do not connect the states.
    """

    lag_ps: float
    truth: IntArray
    candidate: IntArray
    p_value: float
    populations: FloatArray
    reweighted: FloatArray
    reweighted_error: FloatArray

    @property
    def verdict(self) -> str:
        """One sentence: agreement, or the state whose way out differs most."""
        n = int(self.truth.sum())
        if self.p_value >= _ALARM:
            return f"moves between states as the truth does, as far as {n} bursts of {self.lag_ps:g} ps can tell"
        apart = np.abs(self.truth - self.candidate).sum(axis=1)
        worst = int(np.argmax(apart))
        stay = [int(100 * c[worst, worst] / max(c[worst].sum(), 1)) for c in (self.truth, self.candidate)]
        return (
            f"moves otherwise than the truth (p = {self.p_value:.3f}): of state {worst} {stay[1]} % are still there "
            f"after {self.lag_ps:g} ps, of the truth's bursts {stay[0]} %"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the check as JSON-able values."""
        found = {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in vars(self).items()}
        return found | {"verdict": self.verdict}


class States:
    """The metastable states of a candidate, found in its own torsions; for new frames, too."""

    def __init__(self, candidate: Ensemble, lag_ps: float) -> None:
        """Raises InputError where the molecule has no torsion, or the candidate is too short, to tell states apart."""
        self._candidate = candidate
        self._yardstick = Yardstick.of(candidate)
        self.lag = max(1, round(lag_ps / candidate.lag_ps))
        self.lag_ps = self.lag * candidate.lag_ps
        features = self._features(candidate)
        projection = msm.fit_projection(features, self.lag) if features[0].shape[1] else None
        if projection is None:
            raise InputError(
                f"{candidate.label}: no torsion varies enough to tell states apart; bursts need two states."
            )
        self._projection = projection
        coordinates = [projection.project(x) for x in features]
        model = msm.fit_model(projection, coordinates, self.lag)
        if model is None or model.n_states < 2:
            raise InputError(f"{candidate.label}: too few frames to tell states apart; bursts need two states.")
        self._model = model
        self.n_states = model.n_states
        self.of_candidate = model.lump(model.assign(coordinates))

    def _features(self, ensemble: Ensemble) -> list[FloatArray]:
        return tica_features(self._yardstick.measure(ensemble))

    def of(self, frames_nm: npt.NDArray[np.floating]) -> IntArray:
        """Return the states `(n,)` of frames `(n, n_atoms, 3)` nm, -1 for those in none."""
        c = self._candidate
        some = Ensemble("bursts", [np.asarray(frames_nm, dtype=np.float32)], c.lag_ps, c.scene)
        coordinates = [self._projection.project(x) for x in self._features(some)]
        return self._model.lump(self._model.assign(coordinates))[0]

    def starts(self, n: int, rng: np.random.Generator) -> list[Burst]:
        """Return `n` frames to start from, as many in each state, drawn evenly among those with a frame a lag later."""
        found: list[list[Burst]] = [[] for _ in range(self.n_states)]
        for k, labels in enumerate(self.of_candidate):
            for t in range(len(labels) - self.lag):
                if labels[t] >= 0 and labels[t + self.lag] >= 0:
                    found[labels[t]].append(Burst(k, t, int(labels[t]), int(labels[t + self.lag])))
        chosen = []
        for state in found:
            for i in rng.permutation(len(state))[: -(-n // self.n_states)]:
                chosen.append(state[i])
        return chosen


def judge_bursts(states: States, starts: list[Burst], ends: IntArray, seed: int = 0) -> BurstCheck:
    """Return what the truth's end states `ends` (n_starts,) say of the candidate; -1 (in no state) is left out."""
    n = states.n_states
    known = ends >= 0
    begun = np.array([s.state for s in starts])[known]
    later = np.array([s.later for s in starts])[known]
    ends = ends[known]
    rng = np.random.default_rng(seed)
    observed = _apart(begun, ends, later, n)
    swaps = rng.random((_DRAWS, len(ends))) < 0.5
    by_chance = [_apart(begun, np.where(s, later, ends), np.where(s, ends, later), n) for s in swaps]
    p = (1 + sum(d >= observed * (1 - 1e-12) for d in by_chance)) / (1 + _DRAWS)
    labels = np.concatenate(states.of_candidate)
    populations = np.bincount(labels[labels >= 0], minlength=n) / max(int((labels >= 0).sum()), 1)
    truth = _counts(begun, ends, n)
    bootstrap = []
    for _ in range(100):
        pick = rng.integers(len(ends), size=len(ends))
        bootstrap.append(_stationary(_counts(begun[pick], ends[pick], n)))
    connected = [drawn for drawn in bootstrap if np.isfinite(drawn).all()]
    error = np.std(connected, axis=0, ddof=1) if len(connected) > 1 else np.full(n, np.nan)
    return BurstCheck(
        states.lag_ps, truth, _counts(begun, later, n), p, populations, _stationary(truth), error
    )  # fmt: skip


def _counts(begun: IntArray, ended: IntArray, n: int) -> IntArray:
    return np.bincount(begun * n + ended, minlength=n * n).reshape(n, n)


def _apart(begun: IntArray, first: IntArray, second: IntArray, n: int) -> float:
    """A chi-square distance of two tables of transitions from the same starts."""
    a, b = _counts(begun, first, n).astype(float), _counts(begun, second, n).astype(float)
    return float((np.square(a - b) / np.maximum(a + b, 1.0)).sum())


def _stationary(counts: IntArray) -> FloatArray:
    """Return the stationary distribution of the reversible model with these transition counts, NaN where there is
    none."""
    from deeptime.markov.msm import MaximumLikelihoodMSM

    try:
        model = MaximumLikelihoodMSM(reversible=True).fit(counts.astype(np.float64)).fetch_model()
    except (RuntimeError, ValueError, AssertionError, np.linalg.LinAlgError):
        return np.full(len(counts), np.nan)
    if model.n_states < len(counts):
        return np.full(len(counts), np.nan)
    return np.asarray(model.stationary_distribution)
