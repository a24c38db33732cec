"""What the reference's own start or length leaves open of a difference, and what differs all the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogate.judge.convergence import (
    LEAST_PASSAGES,
    RARE_BELOW,
    Column,
    Convergence,
    State,
    angles_of,
    convergence_of,
    find_wells,
    long_enough,
    state_columns,
)
from surrogate.judge.measure.statistics import Estimate
from surrogate.judge.measure.structure import Backbone, Features
from surrogate.judge.rows.rows import Row

_TOLERANCE = 0.05
# Entries by the candidate's own rates that a reference must have missed to rule a state out; so many times as few.
_ENTRIES_TO_RULE_OUT = 20.0
_TIMES_FEWER = 5.0
# Standard errors beyond what the reference allows.
_SURELY = 3.0


@dataclass(frozen=True)
class Excess:
    """A state whose share in the candidate, with its standard error, is none that the reference allows: it allows
    `low` to `high`."""

    state: State
    share: float
    error: float
    low: float
    high: float

    def row(self) -> Row:
        """Return the row that says so."""
        from scipy.special import ndtr

        s = self.state
        beyond = max(self.low - self.share, self.share - self.high)
        p = float(2.0 * ndtr(-beyond / max(self.error, 1e-6)))
        allowed = f"{100 * self.low:.2g} to {100 * self.high:.2g}"
        own = Estimate(100 * self.share, 100 * (self.share - 2 * self.error), 100 * (self.share + 2 * self.error),
                       100 * self.error)  # fmt: skip
        truth = Estimate(100 * s.share, 100 * self.low, 100 * self.high, 100 * s.error)
        return Row(
            f"allowed:{s.label}", "populations", f"Share of {s.label}, against what the reference allows", "%",
            "observable", truth, own, None, None, p, 1.0, 100 * _TOLERANCE, "± 5 points",
            f"{s.label} is held {100 * self.share:.3g} % of the time, where the reference allows {allowed} %, whatever "
            "it has not converged in",
        )  # fmt: skip


@dataclass(frozen=True)
class Explained:
    """What an unconverged reference, or one too short to have seen a state, leaves open (`why`, a line each; empty:
    nothing), and what differs all the same."""

    why: tuple[str, ...] = ()
    excess: tuple[Excess, ...] = ()

    def in_words(self, found: Convergence) -> str:
        """Return why a verdict must wait; empty where it need not."""
        if not self.why:
            return ""
        if not found.converged:
            return f"the reference is {found.verdict.removesuffix('.')}; {found.remedy}"
        return f"the reference, {found.length}, is too short to tell: {'; '.join(self.why[:3])}"


NOTHING_OPEN = Explained()


def explain(
    reference: Sequence[Features], candidate: Features, torsions: Backbone, found: Convergence, *, seed: int = 0
) -> Explained:
    """Return what of a candidate's difference the reference's start or length can explain, and what it cannot.

    `found` is the reference's convergence. A state is ruled out where the candidate's share lies outside what the
    reference allows, whatever its unconverged states come to (these shift others by as much as they depend on them), or
    where the candidate enters it so often that the reference must have seen it: that is left to the other rows.
    """
    theirs, own = long_enough(reference), long_enough([candidate])
    if not theirs or not own:
        return Explained(found.reasons)
    pairs = zip(angles_of(theirs, torsions), angles_of(own, torsions), strict=True)
    wells = [find_wells(name, a, b) for (name, a), (_, b) in pairs]
    truths, mine = state_columns(theirs, torsions, wells), state_columns(own, torsions, wells)
    total_ps = sum(f.total_ps for f in theirs)
    unseen, outside = [], [np.zeros(len(x), dtype=np.bool_) for x in mine[0].series] if mine else []
    for truth, column in zip(truths, mine, strict=True):
        line = _unseen(truth, column, found, total_ps, candidate.lag_ps)
        if line:
            unseen.append(line)
            outside = [o | (x > 0) for o, x in zip(outside, column.series, strict=True)]
    if found.converged and not unseen:
        return NOTHING_OPEN
    allowed = convergence_of(theirs, torsions, wells=wells, seed=seed).states
    open_ones = [(s, c) for s, c in zip(allowed, truths, strict=False) if s.fault]
    excess = []
    for state, truth, column in zip(allowed, truths, mine, strict=False):
        parts = [x[~o] for x, o in zip(column.series, outside, strict=True) if not o.all()]
        if not parts:
            continue
        left = Column(column.torsion, column.name, parts)
        # Of two states of one torsion only one need be open for both to be.
        shift = max(
            (max(s.high - s.share, s.share - s.low) * _dependence(truth, c)
             for s, c in open_ones if s.torsion != state.torsion), default=0.0,
        )  # fmt: skip
        low, high = max(state.low - shift, 0.0), min(state.high + shift, 1.0)
        if max(low - left.share, left.share - high) > _TOLERANCE + _SURELY * left.error:
            excess.append(Excess(state, left.share, left.error, low, high))
    return Explained((*(() if found.converged else found.reasons), *unseen), tuple(excess))


def _unseen(truth: Column, column: Column, found: Convergence, total_ps: float, lag_ps: float) -> str:
    """Return in a line that the reference hardly ever saw a state of the candidate and could not; empty otherwise."""
    entries, exits = truth.passages()
    if entries + exits >= LEAST_PASSAGES or truth.share >= RARE_BELOW:
        return ""
    if column.share <= max(_TOLERANCE, _TIMES_FEWER * truth.share):
        return ""
    n_outside = sum(int((x == 0).sum()) for x in column.series)
    expected = column.passages()[0] / max(n_outside * lag_ps, lag_ps) * (1.0 - truth.share) * total_ps
    if expected >= _ENTRIES_TO_RULE_OUT and entries <= expected / _TIMES_FEWER:
        return ""
    times = "once" if entries == 1 else f"{entries} times" if entries else "never"
    return (
        f"{truth.torsion} {truth.name}, {100 * column.share:.2g} % of the candidate, is {times} entered in "
        f"{found.length}, which by the candidate's own rates would enter it {expected:.2g} times"
    )


def _dependence(truth: Column, other: Column) -> float:
    """Return by how much the share of one state differs between frames in and out of another, in the reference."""
    a, b = np.concatenate(list(truth.series)), np.concatenate(list(other.series)) > 0
    if b.all() or not b.any():
        return 0.0
    return float(abs(a[b].mean() - a[~b].mean()))
