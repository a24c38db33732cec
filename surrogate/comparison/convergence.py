"""Whether a set of trajectories has forgotten where it began: drift, agreement of replicas, transitions, lengths.

Halves of one set share its start, so neither a replicate nor a bootstrap can see that a set still depends on it. Time
can: equilibrium MD looks the same forwards and backwards, so that whatever grows along the replicas, more often than
swapped signs of time would give, has not ended. What cannot drift because it never moves is counted: transitions,
replicas that left their start, their length against the slowest relaxation. `explain` says what an unconverged
reference leaves open of a candidate's difference, and what differs all the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.distributions import divergence
from surrogate.comparison.measure.slow_motion import angles_of, tic_0
from surrogate.comparison.measure.statistics import Estimate, FloatArray, Segments
from surrogate.comparison.measure.structure import Backbone, Baseline, Features, evenly
from surrogate.comparison.measure.torsions import Wells, find_wells
from surrogate.comparison.read.ensemble import Ensemble, length_words
from surrogate.comparison.rows.rows import Row
from systems.units import format_time_ps

# A replica shorter than so many relaxation times remembers its start, whatever the starts are.
LEAST_RELAXATIONS = 5.0
# Entries and exits of a state that is neither rare nor everything; share below which a state is rare.
LEAST_PASSAGES = 6
RARE_BELOW = 0.05
# What a start may leave in a share, and by how much quarters must differ to be a drift that matters.
_LEAST_BIAS = 0.05
# Of each test that can give a false alarm: drift, the φ/ψ map, a replica that is stuck.
_SIGNIFICANCE = 0.01
_FLIPS = 2000
_LEAST_REPLICAS = 8
_MOST_TORSIONS, _MOST_MAPS = 64, 16
_MAP_BINS, _LEAST_FRAMES = 18, 16
_MENTIONED = 3
# Of quarters, the straight line through them.
_CONTRAST = np.array([-3.0, -1.0, 1.0, 3.0])
_TOLERANCE = 0.05
# Entries by the candidate's own rates that a reference must have missed to rule a state out; so many times as few.
_ENTRIES_TO_RULE_OUT = 20.0
_TIMES_FEWER = 5.0
# Standard errors beyond what the reference allows.
_SURELY = 3.0


@dataclass(frozen=True)
class State:
    """A state of one torsion, or a continuous coordinate (`entries` None), along the replicas of a set.

    `share` and `error` (over replicas) of time in it; `quarters`, `quarter_errors`: the same by quarters of each
    replica's time; `drift_p`: that they change by chance, corrected for the number of states (NaN for fewer than eight
    replicas); `r_hat`: rank-normalised split R-hat; `relaxation_ps`: integrated correlation time; `entries`, `exits`:
    how often it was entered and left; `started` replicas began in it, of which `left` left; `low`, `high`: the shares
    at equilibrium that the set allows; `fault`: why it is not converged, empty where it is.
    """

    torsion: str
    name: str
    share: float
    error: float
    quarters: tuple[float, ...]
    quarter_errors: tuple[float, ...]
    drift_p: float
    r_hat: float
    relaxation_ps: float
    entries: int | None
    exits: int | None
    started: int
    left: int
    low: float
    high: float
    fault: str = ""

    @property
    def label(self) -> str:
        return f"{self.torsion} {self.name}".rstrip()


@dataclass(frozen=True)
class Convergence:
    """What is known of a set's memory of its start.

    `length`: such as '32 replicas of 3.8 ns'; `reasons`: why it is not converged, a line each; `slowest_ps` of
    `slowest` is the longest relaxation seen in states that are not rare, `needed_ps` how long replicas must be for it
    (None where nothing that was seen tells); `r_hat`: the worst; `map_p`: that the φ/ψ map changes along the replicas
    by chance.
    """

    converged: bool
    reasons: tuple[str, ...]
    length: str
    n_replicas: int
    replica_ps: float
    slowest: str
    slowest_ps: float
    needed_ps: float | None
    r_hat: float
    map_p: float
    states: tuple[State, ...]

    @property
    def verdict(self) -> str:
        """One sentence: converged or not, and why."""
        if not self.n_replicas:
            return f"too short to test: {self.reasons[0]}."
        if self.converged:
            alone = " States that one run never entered do not show." if self.n_replicas == 1 else ""
            return f"{self.length}: no sign that it still depends on where it started.{alone}"
        more = f"; {len(self.reasons) - _MENTIONED} more" if len(self.reasons) > _MENTIONED else ""
        named = "; ".join(self.reasons[:_MENTIONED])
        return f"{self.length}, not converged: it still depends on where it started ({named}{more})."

    @property
    def remedy(self) -> str:
        """What would settle it; empty where it is converged."""
        if self.converged:
            return ""
        if not self.n_replicas:
            return "longer replicas would settle it"
        if apart := {s.torsion for s in self.states if s.entries == s.exits == 0 and 0 < s.started < self.n_replicas}:
            either = ", ".join(sorted(apart)[:_MENTIONED])
            return f"replicas began on either side of {either}, and none crossed: far longer ones would settle it"
        if self.needed_ps is None:
            return "starts spread over all states would settle it; longer replicas from the same start may not"
        longer = f"replicas of {format_time_ps(self.needed_ps, 2)} or more"
        return f"{longer}, or starts spread over all states, would settle it"


def tested_reference(trajectories: Sequence[Ensemble]) -> Convergence:
    """Return whether trajectories of one simulation (replicas, or several sets of them, with the same atoms and the
    same time between frames) have forgotten their start."""
    first = trajectories[0]
    baseline = Baseline.of(first, parent=first.scene, kept=first.kept)
    return convergence_of([baseline.measure(t) for t in trajectories], baseline.torsions)


def convergence_of(
    sets: Sequence[Features], torsions: Backbone, *, wells: Sequence[Wells] | None = None, seed: int = 0
) -> Convergence:
    """Return the convergence of measured trajectories, all their segments together as replicas.

    `wells`: the states of each angle; found in these trajectories by default.
    """
    features = long_enough(sets)
    lag_ps = sets[0].lag_ps
    lengths = [n for f in features for n in f.segment_lengths]
    columns = state_columns(features, torsions, wells)
    slow = tic_0(features) if features else None
    if slow is not None:
        columns.append(Column("TIC 0", "", _normal_scores(slow), is_state=False))
    signs = np.random.default_rng([seed, 11]).choice([-1.0, 1.0], size=(_FLIPS, len(lengths)))
    tested = len(lengths) >= _LEAST_REPLICAS
    drift_p = _drift_p(columns, signs) if tested and columns else np.full(len(columns), math.nan)
    n_tests = max(len(columns) * len(lengths), 1)
    states = tuple(_evaluated(c, float(p), lag_ps, n_tests) for c, p in zip(columns, drift_p, strict=True))
    map_p = _map_p(features, torsions, signs) if tested else math.nan
    return _summed_up(states, map_p, lengths, lag_ps)


@dataclass(frozen=True, eq=False)
class Column:
    """One coordinate along all replicas: `series` 0 or 1 where it `is_state`."""

    torsion: str
    name: str
    series: Sequence[FloatArray]
    is_state: bool = True

    @cached_property
    def share(self) -> float:
        return float(np.concatenate(list(self.series)).mean())

    @cached_property
    def quarters(self) -> FloatArray:
        """Means by quarters of each replica, `(n_replicas, 4)`."""
        return np.array([[q.mean() for q in np.array_split(x, 4)] for x in self.series])

    @cached_property
    def error(self) -> float:
        """Standard error of `share`: over replicas, or of effective samples where those give more."""
        means, n = np.array([x.mean() for x in self.series]), len(self.series)
        over = float(means.std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0
        values = np.concatenate(list(self.series))
        tau = self.relaxation
        own = float(values.std()) * math.sqrt(min(2.0 * tau, len(values)) / len(values)) if math.isfinite(tau) else 0.0
        return max(over, own)

    @cached_property
    def relaxation(self) -> float:
        """Integrated correlation time in frames, about the mean of all replicas; NaN where nothing moves."""
        return kinetics.zero_crossing(self.series)[1]

    def passages(self) -> tuple[int, int]:
        """Return how often it is entered and left."""
        steps = [np.diff(x) for x in self.series]
        return sum(int((s > 0).sum()) for s in steps), sum(int((s < 0).sum()) for s in steps)


def state_columns(
    features: Sequence[Features], torsions: Backbone, wells: Sequence[Wells] | None = None
) -> list[Column]:
    """Return every state of every angle that has two or more."""
    columns = []
    for k, (name, segments, fold) in enumerate(_followed(features, torsions) if features else []):
        well = find_wells(segments, fold=fold) if wells is None else wells[k]
        if len(well.names) < 2:
            continue
        assigned = well.assign(segments)
        columns += [
            Column(name, text, [(x == state).astype(np.float64) for x in assigned])
            for state, text in enumerate(well.names)
        ]
    return columns


def _followed(features: Sequence[Features], torsions: Backbone) -> list[tuple[str, Segments, int]]:
    """Return the angles that are followed: name, values in rad, and by how many equal positions these are folded."""
    probes = features[0].probes
    further = [t.fold for t in probes.torsions] if probes else []
    found = angles_of(features, torsions)
    folds = [1] * (len(found) - len(further)) + further
    return evenly([(name, values, n) for (name, values), n in zip(found, folds, strict=True)], _MOST_TORSIONS)


def long_enough(sets: Sequence[Features]) -> list[Features]:
    """Return the sets without segments of fewer than 16 frames, in which no quarter means anything."""
    out = []
    for f in sets:
        ends = np.cumsum(f.segment_lengths).tolist()
        parts = [f.frames(end - n, end) for end, n in zip(ends, f.segment_lengths, strict=True) if n >= _LEAST_FRAMES]
        out += [f] if len(parts) == len(ends) else parts
    return out


def _normal_scores(segments: Sequence[FloatArray]) -> list[FloatArray]:
    """Return normal quantiles of ranks over all replicas: what a rare state far away does not rule."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    values = np.concatenate(list(segments))
    values = np.where(np.isfinite(values), values, np.nanmedian(values))
    scores = ndtri((rankdata(values) - 0.375) / (len(values) + 0.25))
    return list(np.split(scores, np.cumsum([len(x) for x in segments])[:-1]))


def _drift_p(columns: Sequence[Column], signs: FloatArray) -> FloatArray:
    """Return the p-value of every column's slope over quarters, corrected for their number.

    In equilibrium each replica run backwards is as likely, with all its coordinates together, so that slopes change
    sign: the largest slope (over its spread) of all columns in random reversals is what one must exceed. Exact for
    reversible dynamics, whatever the correlation in time. Source: Westfall and Young, Resampling-Based Multiple
    Testing (1993), maxT.
    """
    slopes = np.array([c.quarters @ _CONTRAST for c in columns])
    spread = np.sqrt((slopes**2).sum(axis=1, keepdims=True))
    scaled = np.divide(slopes, spread, out=np.zeros_like(slopes), where=spread > 0)
    largest = np.abs(signs @ scaled.T).max(axis=1)
    seen = np.abs(scaled.sum(axis=1))
    return np.asarray((1.0 + (largest[:, None] >= seen - 1e-9).sum(axis=0)) / (1.0 + len(signs)))


def _map_p(features: Sequence[Features], torsions: Backbone, signs: FloatArray) -> float:
    """Return the p-value of the φ/ψ maps of first and second halves being one, by reversals of replicas as above."""
    residues = evenly(torsions.residues, _MOST_MAPS)
    if not residues:
        return math.nan
    seen, drawn = 0.0, np.zeros(len(signs))
    for r in residues:
        halves = []
        for f in features:
            for phi, psi in zip(f.phi, f.psi, strict=True):
                both = np.stack([phi[:, r.phi], psi[:, r.psi]], axis=1)
                for part in np.array_split(both, 2):
                    finite = part[np.isfinite(part).all(axis=1)]
                    turn = np.floor((finite + math.pi) / (2 * math.pi) * _MAP_BINS).astype(np.int64) % _MAP_BINS
                    halves.append(np.bincount(turn[:, 0] * _MAP_BINS + turn[:, 1], minlength=_MAP_BINS**2))
        counts = np.array(halves, dtype=np.float64).reshape(-1, 2, _MAP_BINS**2)
        total, odd = counts.sum(axis=(0, 1)), counts[:, 0] - counts[:, 1]
        first = 0.5 * (total + np.concatenate([np.ones((1, len(odd))), signs]) @ odd)
        apart = divergence(first, total - first)
        seen, drawn = seen + float(apart[0]), drawn + apart[1:]
    return float((1.0 + (drawn >= seen - 1e-12).sum()) / (1.0 + len(drawn)))


def _r_hat(column: Column) -> float:
    """Return split R-hat: each replica in two halves, a single one in four parts.

    Source: Vehtari, Gelman, Simpson, Carpenter and Bürkner, Bayesian Analysis 16, 667 (2021), equations 3 and 4; of a
    state, 0 or 1, ranks change nothing.
    """
    parts = [p for x in column.series for p in np.array_split(x, 2 if len(column.series) > 1 else 4)]
    means, within = np.array([p.mean() for p in parts]), float(np.mean([p.var(ddof=1) for p in parts]))
    between = float(means.var(ddof=1))
    if within <= 1e-12:
        return math.inf if between > 1e-12 else math.nan
    n = len(np.concatenate(parts)) / len(parts)
    return math.sqrt((n - 1.0) / n + between / within)


def _evaluated(column: Column, drift_p: float, lag_ps: float, n_tests: int) -> State:
    """Return one coordinate with the shares that it allows, and what is wrong with it."""
    quarters, share, error = column.quarters, column.share, column.error
    lengths = np.array([len(x) for x in column.series], dtype=np.float64)
    replica = float(np.median(lengths))
    n = len(lengths)
    by_quarter = quarters.mean(axis=0)
    of_quarter = quarters.std(axis=0, ddof=1) / math.sqrt(n) if n > 1 else np.full(4, math.nan)
    tau = column.relaxation
    begun = np.array([x[0] for x in column.series])
    late = float(np.concatenate([x[len(x) // 2 :] for x in column.series]).mean())
    start = float(np.average(begun, weights=lengths))
    bias = (late - start) * min(tau / replica, 1.0) if math.isfinite(tau) else 0.0
    entries = exits = None
    left = started = 0
    fault, low, high = "", share - 2.0 * error, share + 2.0 * error
    label = f"{column.torsion} {column.name}".rstrip()
    common = not column.is_state or RARE_BELOW <= share <= 1.0 - RARE_BELOW
    if column.is_state:
        entries, exits = column.passages()
        started = int((begun > 0).sum())
        left = sum(bool(x[0] > 0 and (x == 0).any()) for x in column.series)
        if entries + exits == 0 and 0.0 < share < 1.0:
            fault = f"{label} is held by the {started} of {n} replicas that began in it, and never entered or left"
        elif common and entries + exits < LEAST_PASSAGES:
            fault = f"{label} is entered or left {entries + exits} times in all, too few to know its share"
        elif (stuck := _stuck_p(column)) * n_tests < _SIGNIFICANCE:
            fault = f"a replica stays in {label} all along, which its rates elsewhere make {_chance(stuck)} likely"
        low, high = (0.0, 1.0) if fault else (low, high)
    moves = not column.is_state or float(np.ptp(by_quarter)) > _LEAST_BIAS
    if not fault and moves and drift_p < _SIGNIFICANCE:
        words = ", ".join(f"{100 * q:.3g}" for q in by_quarter)
        fault = f"{label} drifts: {words} % by quarters" if column.is_state else f"{label} drifts along the replicas"
        low, high = (low, 1.0) if by_quarter @ _CONTRAST > 0 else (0.0, high)
    elif not fault and common and replica < LEAST_RELAXATIONS * tau:
        fault = (
            f"{label} relaxes in {format_time_ps(tau * lag_ps, 2)} or more, and the replicas are "
            f"{format_time_ps(replica * lag_ps, 2)}"
        )
        known = abs(late - start) > 3.0 * error
        low, high = (low if known and late > start else 0.0), (high if known and late <= start else 1.0)
    elif not fault and column.is_state and abs(bias) > _LEAST_BIAS:
        fault = f"{label} still carries about {100 * abs(bias):.2g} points of its start"
        low, high = (low, high + 2.0 * bias) if bias > 0 else (low + 2.0 * bias, high)
    return State(
        column.torsion, column.name, share, error, tuple(by_quarter.tolist()), tuple(of_quarter.tolist()), drift_p,
        _r_hat(column), tau * lag_ps, entries, exits, started, left, max(low, 0.0) if column.is_state else low,
        min(high, 1.0) if column.is_state else high, fault,
    )  # fmt: skip


def _stuck_p(column: Column) -> float:
    """Return the least probability of a replica that stays in the state all along, if it were as the others.

    Of n exits none falls on it (binomial). Where exits come in bursts (crossing back and forth at once) fewer count:
    those of a two-state process that relaxes as slowly as the others do.
    """
    whole = np.array([bool(x.all()) for x in column.series])
    if not whole.any() or whole.all():
        return 1.0
    others = Column(column.torsion, column.name, [x for x, w in zip(column.series, whole, strict=True) if not w])
    inside, exits = float(sum(x.sum() for x in others.series)), float(others.passages()[1])
    if math.isfinite(others.relaxation):
        exits = min(exits, inside * (1.0 - others.share) / others.relaxation)
    longest = max(len(x) for x, w in zip(column.series, whole, strict=True) if w)
    return float((inside / (inside + longest)) ** exits)


def _chance(p: float) -> str:
    return "less than 1 in a million" if p < 1e-6 else f"1 in {float(f'{1 / max(p, 1e-300):.2g}'):,g}"


def _summed_up(states: Sequence[State], map_p: float, lengths: Sequence[int], lag_ps: float) -> Convergence:
    """Return what all coordinates together say."""
    faulty = sorted((s for s in states if s.fault), key=lambda s: (s.torsion[:1] not in "φψ", -(s.high - s.low)))
    # Of one torsion the worst state is enough.
    worst: dict[str, str] = {}
    for s in faulty:
        worst.setdefault(s.torsion, s.fault)
    reasons = list(worst.values())
    if not reasons and map_p < _SIGNIFICANCE:
        reasons.append(f"the φ/ψ map of the second halves is not that of the first (p = {map_p:.1g})")
    if not lengths:
        reasons.append(f"no replica has {_LEAST_FRAMES} frames")
    common = [s for s in states if s.entries is None or RARE_BELOW <= s.share <= 1.0 - RARE_BELOW]
    timed = [s for s in common if math.isfinite(s.relaxation_ps)]
    slowest = max(timed, key=lambda s: s.relaxation_ps, default=None)
    replica_ps = float(np.median(lengths)) * lag_ps if lengths else 0.0
    slowest_ps = slowest.relaxation_ps if slowest else math.nan
    # A time that is as long as the replicas is none that was seen; what never moved has none.
    seen = slowest is not None and slowest_ps < 0.5 * replica_ps
    blind = any((s.entries or 0) + (s.exits or 0) < LEAST_PASSAGES for s in faulty if s.entries is not None)
    return Convergence(
        converged=not reasons,
        reasons=tuple(reasons),
        length=length_words(lengths, lag_ps),
        n_replicas=len(lengths),
        replica_ps=replica_ps,
        slowest=slowest.label if slowest else "",
        slowest_ps=slowest_ps,
        needed_ps=None if blind or not seen else max(2.0 * replica_ps, 20.0 * slowest_ps),
        r_hat=max((s.r_hat for s in common if not math.isnan(s.r_hat)), default=math.nan),
        map_p=map_p,
        states=tuple(states),
    )


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
        low, high = 100 * (self.share - 2 * self.error), 100 * (self.share + 2 * self.error)
        return Row(
            key=f"allowed:{s.label}",
            group="populations",
            metric=f"Share of {s.label}, against what the reference allows",
            unit="%",
            form="observable",
            reference=Estimate(100 * s.share, 100 * self.low, 100 * self.high, 100 * s.error),
            candidate=Estimate(100 * self.share, low, high, 100 * self.error),
            p_value=float(2.0 * ndtr(-beyond / max(self.error, 1e-6))),
            p_replicate=1.0,
            tolerance=100 * _TOLERANCE,
            tolerance_text="± 5 points",
            statement=f"{s.label} is held {100 * self.share:.3g} % of the time, where the reference allows "
            f"{100 * self.low:.3g} to {100 * self.high:.3g} %, whatever it has not converged in",
        )


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
    pairs = zip(*(_followed(x, torsions) for x in (theirs, own)), strict=True)
    wells = [find_wells(a, b, fold=fold) for (_, a, fold), (_, b, _) in pairs]
    references, mine = state_columns(theirs, torsions, wells), state_columns(own, torsions, wells)
    total_ps = sum(f.total_ps for f in theirs)
    unseen, outside = [], [np.zeros(len(x), dtype=np.bool_) for x in mine[0].series] if mine else []
    for ref, column in zip(references, mine, strict=True):
        line = _unseen(ref, column, found, total_ps, candidate.lag_ps)
        if line:
            unseen.append(line)
            outside = [o | (x > 0) for o, x in zip(outside, column.series, strict=True)]
    if found.converged and not unseen:
        return NOTHING_OPEN
    allowed = convergence_of(theirs, torsions, wells=wells, seed=seed).states
    open_ones = [(s, c) for s, c in zip(allowed, references, strict=False) if s.fault]
    excess = []
    for state, ref, column in zip(allowed, references, mine, strict=False):
        parts = [x[~o] for x, o in zip(column.series, outside, strict=True) if not o.all()]
        if not parts:
            continue
        left = Column(column.torsion, column.name, parts)
        # Of two states of one torsion only one need be open for both to be.
        shift = max(
            (max(s.high - s.share, s.share - s.low) * _dependence(ref, c)
             for s, c in open_ones if s.torsion != state.torsion), default=0.0,
        )  # fmt: skip
        low, high = max(state.low - shift, 0.0), min(state.high + shift, 1.0)
        if max(low - left.share, left.share - high) > _TOLERANCE + _SURELY * left.error:
            excess.append(Excess(state, left.share, left.error, low, high))
    return Explained((*(() if found.converged else found.reasons), *unseen), tuple(excess))


def _unseen(ref: Column, column: Column, found: Convergence, total_ps: float, lag_ps: float) -> str:
    """Return in a line that the reference hardly ever saw a state of the candidate and could not; empty otherwise."""
    entries, exits = ref.passages()
    if entries + exits >= LEAST_PASSAGES or ref.share >= RARE_BELOW:
        return ""
    if column.share <= max(_TOLERANCE, _TIMES_FEWER * ref.share):
        return ""
    n_outside = sum(int((x == 0).sum()) for x in column.series)
    expected = column.passages()[0] / max(n_outside * lag_ps, lag_ps) * (1.0 - ref.share) * total_ps
    if expected >= _ENTRIES_TO_RULE_OUT and entries <= expected / _TIMES_FEWER:
        return ""
    times = "once" if entries == 1 else f"{entries} times" if entries else "never"
    share = f"{100 * column.share:.3g} % of the candidate"
    said = f"{ref.torsion} {ref.name}, {share}, is {times} entered in {found.length}"
    if not expected:
        return f"{said}, and the candidate, which began in it, never enters it either"
    return f"{said}, which by the candidate's own rates would enter it {expected:.2g} times"


def _dependence(ref: Column, other: Column) -> float:
    """Return by how much the share of one state differs between frames in and out of another, in the reference."""
    a, b = np.concatenate(list(ref.series)), np.concatenate(list(other.series)) > 0
    if b.all() or not b.any():
        return 0.0
    return float(abs(a[b].mean() - a[~b].mean()))
