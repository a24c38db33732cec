"""Torsions: populations of basins, rare ones as free energies, distributions of φ and ψ and of all others; and what
moves fast: torsions within the states of slower ones and steps from frame to frame, in blocks of their own.

Some states MD enters so seldom that their populations are luck. A residue with phi > 0 that is entered once in 100 ns
holds none or five percent of a trajectory's frames, and whatever compares frames by number calls two runs of one
simulation different. What such a trajectory does tell is how often the state was entered, and from that a free energy
with its error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS, Bins
from surrogate.comparison.measure.slow_motion import slow_torsions, tica_features
from surrogate.comparison.measure.statistics import (
    BLOCK_IN_CORRELATION_TIMES,
    MAX_BLOCKS,
    AnyFloat,
    Blocks,
    BoolArray,
    FloatArray,
    IntArray,
    Segments,
    make_blocks,
)
from surrogate.comparison.measure.structure import MOST_HISTOGRAMS, Features, Residue, evenly
from surrogate.comparison.measure.torsions import Kind as TorsionKind
from surrogate.comparison.rows.charts import Chart, Landscape
from surrogate.comparison.rows.rows import (
    ONE_KJ_SHARE,
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Skipped,
    Three,
    distance_row,
    histogram,
    left_out,
    make_sample,
    mean_distance,
    mean_row,
    observable_row,
    series_counts,
    shift_row,
    three_means,
)
from systems.units import format_time_ps

# Of (reference, candidate, replicate): the state of each frame `(n,)` per segment, -1 for none.
States = Sequence[Sequence[IntArray]]

# More residues than this, and they share rows: means over all, and the one that is furthest off.
FEW_RESIDUES = 12
MOST_MAPS = 16
_MOST_DRAWN = 24
_LARGEST = Quantity(
    "population_shift", "populations", "Largest shift of a basin's population", "%", 5.0, resolution=0.1
)
_STEP_CAUSES = (
    "; possible causes: another time between frames than said, another temperature, friction, force field or solvent, "
    "smoothed frames, or a model that moves too far or too little in a step"
)
# Fewer visits than this in all MD of a comparison, and a smaller share of its frames, make a state rare.
_FEW_VISITS, _SMALL_SHARE = 10, 0.1
# Between the cores a frame counts as where it came from, so that trembling on the rim is no visit.
_CORE = (math.radians(20.0), math.radians(160.0))
# 1 kJ/mol at 300 K.
_TOLERANCE_KT = 0.4
_DRAWS = 400
# More of one kind than this, and they share one row.
_MANY, _MAX_SERIES = 6, 64
_NAMES: dict[TorsionKind, str] = {
    "ω": "Peptide torsions ω",
    "χ": "Side-chain torsions χ",
    "rotatable": "Rotatable torsions",
    "rotor": "Rotors (methyl, hydroxyl, ammonium)",
    "ring": "Ring puckers",
}
# A state that holds less of the frames of any of the three is left out of what moves within states.
_LEAST_SHARE = 0.05
_MOST_TORSIONS = 8
_LEAST_IN_STATE = 0.01
_N_STATES = 4
_STREAM = 40
_WITHOUT_STRAYS = (0.0005, 0.9995)


def _are_many(inputs: ComparisonInput) -> bool:
    """Whether residues are too many for rows of their own."""
    return max(len(inputs.torsions.phi), len(inputs.torsions.psi)) > FEW_RESIDUES


def population_rows(inputs: ComparisonInput) -> Measured:
    """Return the populations of psi's beta basin and of phi > 0, in percent of all frames, where that is rare its free
    energy; of many residues only the one that is furthest off."""
    found = [("ψ in the β basin", x) for x in inputs.torsions.psi_labels]
    found += [("φ > 0", x) for x in inputs.torsions.phi_labels]
    n_psi = len(inputs.torsions.psi_labels)
    if not found:
        return left_out("Backbone torsions φ, ψ and their basins", "the scene has no φ or ψ torsion")

    def members(f: Features) -> list[AnyFloat]:
        angles = zip(f.phi, f.psi, strict=True)
        basins = [(distributions.is_beta(psi), distributions.is_positive(phi)) for phi, psi in angles]
        return [100.0 * np.concatenate(both, axis=1) for both in basins]

    means = three_means(inputs, [members(s.features) for s in inputs.samples])
    if _are_many(inputs):
        return Measured([shift_row(_LARGEST, means, [", ".join(x) for x in found])])
    rows, rare = [], rare_residues(inputs)
    for k, (name, label) in enumerate(found):
        if k - n_psi in rare:
            rows.append(free_energy_row(inputs, k - n_psi, label))
            continue
        share = float(means[0].values[k])
        tolerance = min(share, 100.0 - share) * ONE_KJ_SHARE
        key, said = f"population:{name}:{label}", f"{name}, {label}"
        rows.append(mean_row(inputs, Quantity(key, "populations", said, "%", tolerance, "± 1 kJ/mol"), means, k))
    return Measured(rows)


def torsion_rows(inputs: ComparisonInput) -> Measured:
    """Return Jensen-Shannon distances: jointly per residue (50 x 50 bins), then phi and psi alone (100 bins); of many
    residues their means. Where phi > 0 is rare it is left out of the map and of phi. Maps and histograms are drawn of
    all, of many residues of some."""
    many = _are_many(inputs)
    rows: list[Row] = []
    for key, group in itertools.groupby(_histograms(inputs, many), lambda found: found.key):
        for part in [list(group)] if many else ([one] for one in group):
            label = f"mean of {len(part)} residues" if many else part[0].label
            counts = [np.stack(of_sample, axis=1) for of_sample in zip(*(x.counts for x in part), strict=True)]
            metric = f"Distance of {part[0].name}, {label}"
            rows.append(distance_row(inputs, counts, f"{key}:{label}", "distributions", metric))
    charts: list[Chart] = [_map(inputs, residue) for residue in evenly(inputs.torsions.residues, _MOST_DRAWN)]
    for symbol, name, labels in _phi_psi(inputs):
        for k, label in evenly(list(enumerate(labels)), _MOST_DRAWN):
            charts.append(histogram(inputs, inputs.column(name, k), TORSION_BINS, f"{symbol} {label}", "rad"))
    return Measured(rows, charts)


def _phi_psi(inputs: ComparisonInput) -> list[tuple[str, Literal["phi", "psi"], tuple[str, ...]]]:
    return [("φ", "phi", inputs.torsions.phi_labels), ("ψ", "psi", inputs.torsions.psi_labels)]


class _Histogram(NamedTuple):
    """A φ/ψ map or one torsion of a residue: `counts` per block of (reference, candidate, replicate)."""

    key: str
    name: str
    label: str
    counts: list[FloatArray]

    def at_negative_phi(self, bins: Bins) -> _Histogram:
        """Return the same without phi > 0."""
        counts = [without_positive_phi(c, bins.n) for c in self.counts]
        return self._replace(name=f"{self.name} (φ < 0 only)", counts=counts)


def _histograms(inputs: ComparisonInput, many: bool) -> Iterator[_Histogram]:
    """Yield the map and the single torsions of every residue, of `many` of some; without phi > 0 where that is rare."""
    residues, rare = inputs.torsions.residues, frozenset[int]() if many else rare_residues(inputs)
    for residue in evenly(residues, MOST_MAPS) if many else residues:
        counts = [joint_counts(s.features, s.blocks, residue) for s in inputs.samples]
        found = _Histogram("joint_jsd", "the φ/ψ map", residue.label, counts)
        yield found.at_negative_phi(RAMACHANDRAN_BINS) if residue.phi in rare else found
    for symbol, angle, labels in _phi_psi(inputs):
        for k, label in evenly(list(enumerate(labels)), MOST_HISTOGRAMS if many else len(labels)):
            counts = series_counts(inputs, inputs.column(angle, k), TORSION_BINS)
            found = _Histogram(f"{angle}_jsd", symbol, label, counts)
            yield found.at_negative_phi(TORSION_BINS) if angle == "phi" and k in rare else found


def joint_counts(f: Features, blocks: Blocks, residue: Residue) -> FloatArray:
    """Return the φ/ψ map of a residue per block, `(n_blocks, n_bins)`."""
    phi, psi = f.column("phi", residue.phi), f.column("psi", residue.psi)
    return distributions.block_counts_joint(phi, psi, RAMACHANDRAN_BINS, blocks)


def _map(inputs: ComparisonInput, residue: Residue) -> Landscape:
    n, n_total = RAMACHANDRAN_BINS.n, RAMACHANDRAN_BINS.n_total
    counts = [joint_counts(s.features, s.blocks, residue).sum(0) for s in inputs.samples]
    ref, cand, rep = (c.reshape(n_total, n_total)[:n, :n] for c in counts)
    edges = np.degrees(RAMACHANDRAN_BINS.edges)
    return Landscape("distributions", f"φ and ψ of {residue.label}", "φ / °", "ψ / °", edges, edges, ref, cand, rep)


@dataclass(frozen=True)
class Visits:
    """Of phi > 0 in one trajectory: how many `visits` there were, those under way at the start included, and how many
    of its `n_frames` frames belong to one."""

    visits: int
    inside: int
    n_frames: int

    def __add__(self, other: Visits) -> Visits:
        return Visits(self.visits + other.visits, self.inside + other.inside, self.n_frames + other.n_frames)


def visits_of(phi: Sequence[AnyFloat]) -> Visits:
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


def rare_residues(inputs: ComparisonInput) -> frozenset[int]:
    """Return the columns of phi whose positive side reference and replicate together visit fewer than ten times, in a
    small share of their frames, and which any of the three visits at all, but none all along."""
    found = []
    for k in range(len(inputs.torsions.phi_labels)):
        three = list(map(visits_of, inputs.column("phi", k)))
        reference, candidate, replicate = three
        source = reference + replicate
        small = source.inside < _SMALL_SHARE * source.n_frames and all(v.inside < v.n_frames for v in three)
        if source.visits < _FEW_VISITS and small and source.visits + candidate.visits:
            found.append(k)
    return frozenset(found)


def free_energy_row(inputs: ComparisonInput, k: int, label: str) -> Row:
    """Return the row of the free energy of phi > 0 over phi < 0, in kT, by the time inside. Visits are independent and
    their lengths exponential: of n visits the logarithm has the error sqrt(2 / n); of none the free energy is that of
    half a visit, no longer than the trajectory. The p-value is of the free energies, or of the visits if that is less
    (exact: which trajectory a visit falls into is a matter of their lengths), in either case doubled."""
    found = list(map(visits_of, inputs.column("phi", k)))
    reference, candidate, replicate = found
    of_all = reference + candidate + replicate
    length = of_all.inside / of_all.visits
    half = [0.5 * min(length, v.n_frames) for v in found]
    shares = [v.inside / v.n_frames if v.visits else h / (v.n_frames + h) for v, h in zip(found, half, strict=True)]
    values = [math.log((1.0 - p) / p) for p in shares]
    errors = [math.sqrt(2.0 / max(v.visits, 0.5)) for v in found]
    normal = np.random.default_rng([inputs.options.seed, k]).normal(size=(3, _DRAWS))
    n = candidate.visits
    seen = f" ({f'visited {n} times' if n else 'never visited'})"
    key, name = f"free_energy:φ > 0:{label}", f"Free energy of φ > 0, {label}"
    metric = Quantity(key, "populations", name, "kT", _TOLERANCE_KT, "± 1 kJ/mol", hint=seen)
    row = observable_row(inputs, metric, values, [v + e * x for v, e, x in zip(values, errors, normal, strict=True)])
    return replace(
        row,
        ratio=None,
        p_value=_lesser(row.p_value, visits_p(candidate, reference + replicate)),
        p_replicate=_lesser(row.p_replicate, visits_p(replicate, reference)),
    )


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


def other_torsion_rows(inputs: ComparisonInput) -> Measured:
    """Return Jensen-Shannon distances of every torsion beside phi and psi, 100 bins, symmetric rotors folded: chi and
    rotatable bonds have a row each (one for all above six), omega, rotors and rings one for all of them."""
    probes = inputs.probes
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    for kind, name in _NAMES.items():
        chosen = [k for k, torsion in enumerate(probes.torsions) if torsion.kind == kind]
        if not chosen:
            skipped.append((name, "the scene has none"))
        elif kind in ("χ", "rotatable") and len(chosen) <= _MANY:
            for k in chosen:
                label, fold = probes.torsions[k].label, probes.torsions[k].fold
                label += "" if fold == 1 else f" ({fold} equal positions folded: {fold} times the angle)"
                series, key = inputs.families("torsions", k), f"torsion_jsd:{label}"
                rows.append(mean_distance(inputs, series, [TORSION_BINS], key, label, "distributions"))
                charts.append(histogram(inputs, inputs.column("torsions", k), TORSION_BINS, label, "rad"))
        else:
            few = evenly(chosen, _MAX_SERIES)
            if len(few) < len(chosen):
                skipped.append((f"Some of the {len(chosen)} {name}", f"{len(few)}, evenly chosen, enter the mean"))
            picked, bins = inputs.families("torsions", *few), [TORSION_BINS] * len(few)
            rows.append(mean_distance(inputs, picked, bins, f"torsions_jsd:{kind}", name, "distributions"))
    return Measured(rows, charts, skipped)


def within_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of phi given psi's basin of every residue (of other molecules: of every rotatable torsion given the
    slowest motion). Within a state little is remembered for long: blocks are many, and so is what they can tell."""
    if _are_many(inputs):
        return left_out("φ given ψ's basin", f"{len(inputs.torsions.residues)} residues share their rows")
    rows: list[Row | None] = []
    turning = slow_torsions(inputs.reference.features)
    if inputs.torsions.residues:
        for residue in inputs.torsions.residues:
            metric = f"φ given ψ's basin, distance, {residue.label}"
            phi, states = inputs.column("phi", residue.phi), _basins(inputs, residue)
            rows.append(_conditional_row(inputs, [phi], states, f"phi_given_psi:{residue.label}", metric))
    elif len(turning) > 1:
        chosen = turning[:_MOST_TORSIONS]
        metric = f"{len(chosen)} rotatable torsions given the slowest motion, mean distance"
        angles = [inputs.column("torsions", k) for k in chosen]
        rows.append(_conditional_row(inputs, angles, slow_states(inputs), "torsions_given_slowest", metric))
    skipped = [("Torsions within the states of slower ones", "the three trajectories share none of them")]
    return Measured([row for row in rows if row is not None], skipped=skipped if None in rows else [])


def _basins(inputs: ComparisonInput, residue: Residue) -> States:
    """The two basins of psi with phi < 0, and what else there is: a third state that is slow in itself, left out."""
    return [
        [
            np.where(distributions.is_positive(f), -1, distributions.is_alpha(p).astype(np.int64))
            for f, p in zip(phi, psi, strict=True)
        ]
        for phi, psi in zip(inputs.column("phi", residue.phi), inputs.column("psi", residue.psi), strict=True)
    ]


def _conditional_row(
    inputs: ComparisonInput, angles: Sequence[Three], states: States, key: str, metric: str
) -> Row | None:
    """Return the row of angles within states. None where no state holds one frame in twenty of each of the three, of
    all of it and of the equal length."""
    n = min(s.features.n_frames for s in inputs.samples)
    flat = [np.concatenate(list(s)) + 1 for s in states]
    shares = [np.bincount(x, minlength=2) / len(x) for whole in flat for x in (whole, whole[:n])]
    n_states = min(map(len, shares)) - 1
    kept = [k for k in range(n_states) if min(share[k + 1] for share in shares) >= _LEAST_SHARE]
    if not kept:
        return None
    cosines = [[[np.cos(x.astype(np.float64)) for x in v] for v in three] for three in angles]
    fine = [with_own_blocks(inputs, residuals(three, states)) for three in cosines]
    chosen = max(fine, key=lambda x: x.reference.blocks.n_frames_each)
    counts, strata = [], []
    for which, sample in enumerate(chosen.samples):
        masked = [
            [np.where(s == k, x, np.nan) for x, s in zip(three[which], states[which], strict=True)]
            for three in angles
            for k in kept
        ]
        each = [distributions.block_counts(x, TORSION_BINS, sample.blocks)[:, : TORSION_BINS.n] for x in masked]
        counts.append(np.stack(each, axis=1))
        # The state that most frames of a block are in.
        most = int(max(int(s.max(initial=0)) for s in states[which])) + 2
        of_block = distributions.count_in_blocks([s + 1 for s in states[which]], most, sample.blocks)
        strata.append(np.asarray(of_block.argmax(axis=1), dtype=np.int64))
    return distance_row(chosen, counts, key, "distributions", metric, strata)


def step_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of the root mean square step of all torsions from frame to frame, as if every trajectory were in
    the states of the slowest motion as often as the reference; a wrong time between frames shows here first. Only
    states that all three hold count: what one run alone has met, and steps in otherwise, is no wrong time."""
    if not (len(inputs.torsions.phi) or len(inputs.torsions.psi) or slow_torsions(inputs.reference.features)):
        return left_out("Steps of torsions from frame to frame", "no rotatable torsion")
    # NaN after the last frame.
    squared = [[np.append(squared_turn(x), np.nan)[: len(x)] for x in _angles(s.features)] for s in inputs.samples]
    states = [
        [np.where((x >= 0) & (y >= 0), _N_STATES * x + y, -1) for x, y in zip(own, apart, strict=True)]
        for own, apart in zip(slow_states(inputs), _states_apart(inputs), strict=True)
    ]
    flat = [np.concatenate(list(own)) for own in states]
    n_states = max(int(x.max(initial=0)) for x in flat) + 1
    known = [(x >= 0) & np.isfinite(np.concatenate(own)) for x, own in zip(flat, squared, strict=True)]
    frames = [np.bincount(x[k], minlength=n_states) for x, k in zip(flat, known, strict=True)]
    shared = np.all([n >= _LEAST_IN_STATE * max(int(n.sum()), 1) for n in frames], axis=0)
    if not shared.any():
        return left_out("Steps of torsions from frame to frame", "the three trajectories share no state")
    share = np.where(shared, frames[0] + frames[2], 0.0)
    fine = with_own_blocks(inputs, residuals(squared, states))
    values, draws = [], []
    for sample, steps, of in zip(fine.samples, squared, states, strict=True):
        total, count = np.zeros((2, sample.blocks.n_blocks, n_states))
        for piece in sample.blocks.pieces:
            part, state = (x[piece.segment][piece.start : piece.stop] for x in (steps, of))
            ok = np.isfinite(part) & (state >= 0)
            total[piece.block] += np.bincount(state[ok], weights=part[ok], minlength=n_states)
            count[piece.block] += np.bincount(state[ok], minlength=n_states)
        values.append(float(_standardised(total.sum(0), count.sum(0), share)))
        draws.append(_standardised(sample.weights @ total, sample.weights @ count, share))
    name = f"Step of all torsions from frame to frame ({format_time_ps(inputs.lag_ps)}), root mean square"
    metric = Quantity("torsion_step", "kinetics", name, "°", 0.05, relative=True, hint=_STEP_CAUSES)
    return Measured([observable_row(fine, metric, values, draws)])


def _angles(features: Features) -> list[AnyFloat]:
    """Return phi, psi and every other rotatable torsion `(n, k)` per segment."""
    slow = slow_torsions(features)
    further = [x[:, slow] for x in features.series["torsions"]] if features.series else [x[:, :0] for x in features.phi]
    return [np.concatenate(x, axis=1) for x in zip(features.phi, features.psi, further, strict=True)]


def squared_turn(angles_rad: AnyFloat) -> FloatArray:
    """Return the mean square step in rad² of angles `(n, k)` from frame to frame, `(n - 1,)`."""
    step = np.diff(angles_rad.astype(np.float64), axis=0)
    return np.asarray(((step - 2 * np.pi * np.round(step / (2 * np.pi))) ** 2).mean(axis=1))


def _standardised(total: FloatArray, count: FloatArray, share: FloatArray) -> FloatArray:
    """Return the root in degrees of the means over states `(..., n_states)`, weighted by the reference's
    populations."""
    with np.errstate(invalid="ignore", divide="ignore"):
        means = total / count
        weight = np.where(count > 0, share, 0.0)
        return np.asarray(np.degrees(np.sqrt((np.nan_to_num(means) * weight).sum(-1) / weight.sum(-1))))


def with_own_blocks(inputs: ComparisonInput, series: Three) -> ComparisonInput:
    """Return the comparison in blocks that are long enough for `series`, the slowest motion's at most: ten correlation
    times, doubled until no longer one gives means that vary more than its own say (Flyvbjerg and Petersen, J. Chem.
    Phys. 91, 461, 1989), since a weak slow part makes the blocks long again."""
    longest = inputs.reference.blocks.n_frames_each
    n = min(s.features.n_frames for s in inputs.samples)
    times = [kinetics.zero_crossing([x - np.nanmean(np.concatenate(s)) for x in s])[1] for s in series]
    slowest = max((t for t in times if math.isfinite(t)), default=1.0)
    each = min(max(math.ceil(BLOCK_IN_CORRELATION_TIMES * slowest), -(-n // MAX_BLOCKS)), longest)
    lengths = [each]
    while 2 * lengths[-1] <= longest:
        lengths.append(2 * lengths[-1])
    spread = [_variance_of_mean(series, length) for length in lengths]
    for k, length in enumerate(lengths):
        beyond = [(v, 1.0 + 2.0 * math.sqrt(2.0 / max(degrees, 1))) for v, degrees in spread[k + 1 :]]
        if all(v <= doubt * spread[k][0] for v, doubt in beyond):
            each = length
            break
    made = [
        make_sample(s.features, make_blocks(s.features.segment_lengths, each), inputs.options, _STREAM + k, n)
        for k, s in enumerate(inputs.samples)
    ]
    return replace(inputs, reference=made[0], candidate=made[1], replicate=made[2])


def _variance_of_mean(series: Three, length: int) -> tuple[float, int]:
    """Return the variance of means over blocks times their length, of all three, and its degrees of freedom."""
    total, freedom = 0.0, 0
    for segments in series:
        cut = [np.nan_to_num(x[: len(x) // length * length]).reshape(-1, length).mean(axis=1) for x in segments]
        every = np.concatenate(cut)
        if len(every) > 1:
            total += float(((every - every.mean()) ** 2).sum())
            freedom += len(every) - 1
    return (length * total / freedom if freedom else 0.0), freedom


def slow_states(inputs: ComparisonInput) -> States:
    """Return the quarter of the reference's slowest motion (TIC 0) that each frame of each sample lies in, `(n,)` per
    segment: quarters hold equally many of its frames. All 0 where nothing turns or frames are too few for TICA, -1 for
    frames that are not finite."""
    features = [tica_features(s.features) for s in inputs.samples]
    between = np.arange(1, _N_STATES) / _N_STATES
    return _in_quarters(inputs, features, [*features[0], *features[2]], lambda x: np.quantile(x, between))


def _states_apart(inputs: ComparisonInput) -> States:
    """Return the same of the slowest motion of all three, its quarters equally wide: a state far from all others, which
    one run may visit once for long and another never, is a quarter of its own."""
    features = [tica_features(s.features) for s in inputs.samples]

    def edges(values: FloatArray) -> FloatArray:
        low, high = np.quantile(values, _WITHOUT_STRAYS)
        return np.asarray(np.linspace(low, high, _N_STATES + 1)[1:-1])

    return _in_quarters(inputs, features, [x for own in features for x in own], edges)


def _in_quarters(
    inputs: ComparisonInput,
    features: Three,
    fitted: Segments,
    edges: Callable[[FloatArray], FloatArray],
) -> States:
    """Fit TICA to `fitted`, and put every frame of `features` between the `edges` of its values there."""
    lag = kinetics.tica_lag(inputs.lag_ps)
    model = kinetics.fit_projection(fitted, lag, 1) if max(map(len, fitted)) > 10 * lag else None
    if model is None:
        return [[np.zeros(n, dtype=np.int64) for n in s.features.segment_lengths] for s in inputs.samples]
    values = np.concatenate([model.project(x)[:, 0] for x in fitted])
    between = edges(values[np.isfinite(values)])
    projected = [[model.project(x)[:, 0] for x in own] for own in features]
    return [
        [np.where(np.isfinite(p), np.searchsorted(between, p), -1).astype(np.int64) for p in own] for own in projected
    ]


def residuals(values: Three, states: States) -> list[list[FloatArray]]:
    """Return each value less its sample's mean over the frames of the same state; 0 where it is not finite."""
    out = []
    for own, of in zip(values, states, strict=True):
        flat, where = np.concatenate(list(own)), np.concatenate(list(of))
        rest = np.zeros(len(flat))
        for state in np.unique(where):
            inside: BoolArray = (where == state) & np.isfinite(flat)
            if inside.any():
                rest[inside] = flat[inside] - flat[inside].mean()
        out.append(np.split(rest, np.cumsum([len(x) for x in own])[:-1]))
    return out
