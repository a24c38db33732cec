"""Populations of MD under an umbrella potential and of a surrogate, each by its error. Their transitions cannot be
counted together, as those of MD without one can: they follow different laws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from surrogate.comparison.answer import MODEL_ERROR, Answer, Named, StateEnergy
from surrogate.comparison.markov import with_mean_one
from surrogate.comparison.measure.statistics import FloatArray, IntArray
from systems.units import GAS_CONSTANT_KJ_MOL_K

_SWEEPS, _SETTLED = 200, 1e-6
_VISIT_FRAMES = 5


def pooled(
    answer: Answer, named: Sequence[Named], maps: Callable[[Sequence[FloatArray]], dict[str, FloatArray]],
    temperature_k: float,
) -> Answer:  # fmt: skip
    """Return the answer with shares that are means of MD's and of the surrogate's, which is off by MODEL_ERROR beside
    its own error, each by its inverse variance; with frames weighted so that they have these shares, and `maps` of such
    weights."""
    told = {(s.torsion, s.state): s for s in answer.states}
    states: list[StateEnergy] = []
    labels: list[tuple[list[IntArray], FloatArray]] = []
    for name, of_md, names, _ in named:
        own = {k: told[name, state] for k, state in enumerate(names) if (name, state) in told}
        both = _of_torsion(list(own.values()), temperature_k, np.array([_crossings(of_md, k) for k in own]))
        states += both
        shares = np.zeros(len(names))
        shares[list(own)] = [s.share for s in both]
        labels.append((of_md, shares))
    weights = raked(answer.weights, labels)
    return replace(answer, states=tuple(states), maps=maps(weights), weights=with_mean_one(weights))


def _of_torsion(own: list[StateEnergy], temperature_k: float, crossings: FloatArray) -> list[StateEnergy]:
    """Return the states of one torsion with both shares pooled; `crossings` of MD into each, and out of it."""
    md, error = (np.array(x) for x in ([s.share for s in own], [s.error for s in own]))
    rolled = np.array([s.surrogate or 0.0 for s in own])
    # Replicas tell no error of a state that they hardly enter or leave: n crossings either way leave p (1 - p)
    # sqrt(2 / n), whichever share is taken for p.
    spread = np.maximum(md * (1.0 - md), rolled * (1.0 - rolled))
    error = np.maximum(error, spread * np.sqrt(2.0 / np.maximum(crossings, 0.5)))
    off = np.array([math.hypot(MODEL_ERROR, s.surrogate_error or 0.0) for s in own])
    known = np.array([not s.missing for s in own]) / error**2
    counted = known + 1.0 / off**2
    shares = (known * md + rolled / off**2) / counted
    shares, errors = shares / shares.sum(), 1.0 / np.sqrt(counted)
    best, kt = int(shares.argmax()), GAS_CONSTANT_KJ_MOL_K * temperature_k
    found = []
    for s, share, left, own_error in zip(own, shares.tolist(), errors.tolist(), error.tolist(), strict=True):
        energy = -kt * math.log(share / shares[best]) if share > 0 else None
        # Of the logarithm of a ratio.
        its = None if energy is None else kt * math.hypot(left / share, float(errors[best] / shares[best]))
        found.append(replace(s, share=share, error=left, free_energy_kj_mol=energy, free_energy_error=its,
                             md_share=s.share, md_error=own_error))  # fmt: skip
    return found


def _crossings(labels: Sequence[IntArray], state: int) -> float:
    """Return how often replicas cross into a state, and out of it, in the mean, visits of a few frames left out."""
    n = 0
    for x in labels:
        inside = x == state
        ends = np.flatnonzero(np.diff(inside)) + 1
        pieces = [piece for piece in np.split(inside, ends) if len(piece) >= _VISIT_FRAMES]
        n += sum(bool(a[0] != b[0]) for a, b in pairwise(pieces))
    return n / 2.0


def raked(
    weights: Sequence[FloatArray], labels: Sequence[tuple[Sequence[IntArray], FloatArray]]
) -> tuple[FloatArray, ...]:
    """Return weights of frames, an array a replica, nearest to these with which the labels of each torsion have given
    shares, as far as frames have them (iterative proportional fitting: Deming and Stephan, Ann. Math. Stat. 11, 427
    (1940)); -1 is no label."""
    found = np.concatenate(list(weights))
    every = [(np.concatenate(list(of)), shares) for of, shares in labels]
    for _ in range(_SWEEPS):
        before = found
        for label, shares in every:
            has = np.bincount(label[label >= 0], found[label >= 0], len(shares))
            wanted = np.where(has > 0, shares, 0.0)
            factors = np.divide(wanted / max(wanted.sum(), 1e-300) * has.sum(), has, out=np.ones(len(has)),
                                where=has > 0)  # fmt: skip
            found = np.where(label >= 0, found * factors[label], found)
        if np.abs(found - before).max() < _SETTLED * before.max():
            break
    return tuple(np.split(found, np.cumsum([len(w) for w in weights])[:-1]))
