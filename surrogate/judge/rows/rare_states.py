"""States that MD enters so seldom that their populations are luck: judged as free energies, left out of maps.

A residue with phi > 0 that is entered once in 100 ns holds none or five percent of a trajectory's frames, and whatever
compares frames by number calls two runs of one simulation different. What such a trajectory does tell is how often the
state was entered, and from that a free energy with its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from surrogate.judge.rows.rows import Metric, Row, Sample, Trio, observable_row

FloatArray = npt.NDArray[np.float64]

# Fewer visits than this in all MD of a comparison, and a smaller share of its frames, make a state rare.
_FEW_VISITS = 10
_SMALL_SHARE = 0.1
# Between the cores a frame counts as where it came from, so that trembling on the rim is no visit.
_CORE = (math.radians(20.0), math.radians(160.0))
# 1 kJ/mol at 300 K.
_TOLERANCE_KT = 0.4
_DRAWS = 400


@dataclass(frozen=True)
class Visits:
    """Of phi > 0 in one trajectory: how many `visits` there were, those under way at the start included, and how many
    of its `n_frames` frames belong to one."""

    visits: int
    inside: int
    n_frames: int

    def __add__(self, other: Visits) -> Visits:
        return Visits(self.visits + other.visits, self.inside + other.inside, self.n_frames + other.n_frames)


def visits_of(phi: Sequence[npt.NDArray[np.floating]]) -> Visits:
    """Return the visits to phi > 0 of segments `(n,)` rad."""
    visits = inside = 0
    for segment in phi:
        core = np.where((segment > _CORE[0]) & (segment < _CORE[1]), 1, 0)
        core[(segment < -_CORE[0]) & (segment > -_CORE[1])] = -1
        known = np.flatnonzero(core)
        if not len(known):
            continue
        # Each frame is where the last core before it was, those before the first one where that is.
        state = core[known[np.maximum(np.searchsorted(known, np.arange(len(core)), side="right") - 1, 0)]]
        inside += int((state > 0).sum())
        visits += int((np.diff(state, prepend=-1) > 0).sum())
    return Visits(visits, inside, sum(map(len, phi)))


def rare_residues(trio: Trio) -> frozenset[int]:
    """Return the columns of phi whose positive side reference and replicate together visit fewer than ten times, in a
    small share of their frames, and which any of the three visits at all."""
    found = []
    for k in range(len(trio.torsions.phi_labels)):
        reference, candidate, replicate = (_visits(s, k) for s in trio.samples)
        truth = reference + replicate
        small = truth.inside < _SMALL_SHARE * truth.n_frames
        if truth.visits < _FEW_VISITS and small and truth.visits + candidate.visits:
            found.append(k)
    return frozenset(found)


def free_energy_row(trio: Trio, k: int, label: str) -> Row:
    """Return the row of the free energy of phi > 0 over phi < 0, in kT, by the time inside.

    Visits are independent and their lengths exponential, so that of n visits the logarithm has the error sqrt(2 / n);
    of none the free energy is that of half a visit. The p-value is of the free energies, or of the visits if that is
    less (exact: which trajectory a visit falls into is a matter of their lengths), in either case doubled.
    """
    found = [_visits(s, k) for s in trio.samples]
    of_all = sum(found[1:], found[0])
    length = of_all.inside / of_all.visits
    shares = [(v.inside if v.visits else 0.5 * length) / v.n_frames for v in found]
    values = [math.log((1.0 - p) / p) if p < 1.0 else -math.log(v.n_frames) for p, v in zip(shares, found, strict=True)]
    errors = [math.sqrt(2.0 / max(v.visits, 0.5)) for v in found]
    normal = np.random.default_rng([trio.options.seed, k]).normal(size=(3, _DRAWS))

    def statement(candidate: float, reference: float) -> str:
        n = found[1].visits
        seen = f"visited {n} {'time' if n == 1 else 'times'}" if n else "never visited"
        return f"φ > 0 of {label} is {seen}, {candidate:.2g} kT above φ < 0 instead of {reference:.2g} kT"

    metric = Metric(
        f"free_energy:φ > 0:{label}", "populations", f"Free energy of φ > 0, {label}", "kT", _TOLERANCE_KT,
        tolerance_text="± 1 kJ/mol",
    )  # fmt: skip
    draws = [v + e * n for v, e, n in zip(values, errors, normal, strict=True)]
    row = observable_row(trio, metric, values, draws, statement)
    reference, candidate, replicate = found
    return replace(
        row,
        ratio=None,
        p_value=_lesser(row.p_value, visits_p(candidate, reference + replicate)),
        p_replicate=_lesser(row.p_replicate, visits_p(replicate, reference)),
    )


def _visits(sample: Sample, k: int) -> Visits:
    return visits_of([phi[:, k] for phi in sample.features.phi])


def visits_p(a: Visits, b: Visits) -> float:
    """Return the two-sided p-value of visits falling on two trajectories in proportion to their lengths (binomial)."""
    from scipy.stats import binomtest

    n = a.visits + b.visits
    return float(binomtest(a.visits, n, a.n_frames / (a.n_frames + b.n_frames)).pvalue) if n else math.nan


def _lesser(*p_values: float) -> float:
    known = [p for p in p_values if math.isfinite(p)]
    return min(1.0, len(known) * min(known)) if known else math.nan


def without_positive_phi(counts: FloatArray, n_bins: int) -> FloatArray:
    """Return histograms of phi, `(..., n_bins + 3)`, or maps with phi first, `(..., (n_bins + 3) ** 2)`, with the bins
    of phi > 0 empty. `n_bins`: over the circle from -π, an even number."""
    wide = n_bins + 3
    of_phi = counts.reshape(*counts.shape[:-1], wide, -1).copy()
    of_phi[..., n_bins // 2 : n_bins, :] = 0.0
    return of_phi.reshape(counts.shape)
