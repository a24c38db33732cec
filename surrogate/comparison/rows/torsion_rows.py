"""Torsions: populations of basins, rare ones as free energies, distributions of φ and ψ and of all others.

Some states MD enters so seldom that their populations are luck. A residue with phi > 0 that is entered once in 100 ns
holds none or five percent of a trajectory's frames, and whatever compares frames by number calls two runs of one
simulation different. What such a trajectory does tell is how often the state was entered, and from that a free energy
with its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS, block_counts_joint
from surrogate.comparison.measure.probes import MOST_HISTOGRAMS, evenly
from surrogate.comparison.measure.structure import Residue
from surrogate.comparison.measure.torsions import Kind as TorsionKind
from surrogate.comparison.rows.block_means import block_means, column, family_of, mean_row, shift_row
from surrogate.comparison.rows.charts import Chart, Landscape
from surrogate.comparison.rows.rows import (
    ONE_KJ_FACTOR,
    ComparisonInput,
    Group,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    distance_row,
    histogram,
    mean_distance,
    observable_row,
    series_distance,
)

FloatArray = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating]

# More residues than this, and they share rows: means over all, and the one that is furthest off.
FEW_RESIDUES = 12
MOST_MAPS = 16
_MOST_DRAWN = 24
_LARGEST = Quantity(
    "population_shift", "populations", "Largest shift of a basin's population", "%", 5.0, resolution=0.1
)
_PHI_PSI: tuple[
    tuple[str, Callable[[ComparisonInput], tuple[str, ...]], Callable[[Sample], Sequence[AnyFloat]]], ...
] = (
    ("φ", lambda inputs: inputs.torsions.phi_labels, lambda s: s.features.phi),
    ("ψ", lambda inputs: inputs.torsions.psi_labels, lambda s: s.features.psi),
)
# Fewer visits than this in all MD of a comparison, and a smaller share of its frames, make a state rare.
_FEW_VISITS = 10
_SMALL_SHARE = 0.1
# Between the cores a frame counts as where it came from, so that trembling on the rim is no visit.
_CORE = (math.radians(20.0), math.radians(160.0))
# 1 kJ/mol at 300 K.
_TOLERANCE_KT = 0.4
_DRAWS = 400

# More of one kind than this, and they share one row.
_MANY = 6
_MAX_SERIES = 64
_NAMES: dict[TorsionKind, str] = {
    "ω": "Peptide torsions ω",
    "χ": "Side-chain torsions χ",
    "rotatable": "Rotatable torsions",
    "rotor": "Rotors (methyl, hydroxyl, ammonium)",
}
_WITHOUT_CHANGED = "Distributions without frames that guards changed"
_LEAST_SHARE = 0.1


def are_many(inputs: ComparisonInput) -> bool:
    """Whether residues are too many for rows of their own."""
    return max(len(inputs.torsions.phi), len(inputs.torsions.psi)) > FEW_RESIDUES


def population_rows(inputs: ComparisonInput) -> Measured:
    """Return the populations of psi's beta basin and of phi > 0, in percent of all frames, where that is rare its free
    energy; of many residues only the one that is furthest off."""
    found = [("ψ in the β basin", x) for x in inputs.torsions.psi_labels]
    found += [("φ > 0", x) for x in inputs.torsions.phi_labels]
    n_psi = len(inputs.torsions.psi_labels)

    def members(sample: Sample) -> list[FloatArray]:
        parts = zip(sample.features.phi, sample.features.psi, strict=True)
        return [
            100.0 * np.concatenate([distributions.is_beta(psi), distributions.is_positive(phi)], axis=1)
            for phi, psi in parts
        ]

    means = [block_means(s, members(s)) for s in inputs.samples]
    if are_many(inputs):
        return Measured([shift_row(inputs, _LARGEST, means, [", ".join(x) for x in found], _instead)])
    rows, rare = [], rare_residues(inputs)
    for k, (name, label) in enumerate(found):
        if k - n_psi in rare:
            rows.append(free_energy_row(inputs, k - n_psi, label))
            continue
        share = float(means[0].values[k])
        tolerance = min(share, 100.0 - share) * (1.0 - 1.0 / ONE_KJ_FACTOR)
        key = f"population:{name}:{label}"
        quantity = Quantity(key, "populations", f"{name}, {label}", "%", tolerance, "± 1 kJ/mol")
        rows.append(mean_row(inputs, quantity, means, k, _held(name, label)))
    return Measured(rows)


def _instead(label: str, candidate: float, reference: float) -> str:
    return f"{label}: {candidate:.3g} % of frames instead of {reference:.3g} %"


def _held(name: str, label: str) -> Callable[[float, float], str]:
    def statement(candidate: float, reference: float) -> str:
        if candidate == 0.0:
            return f"{name} of {label} is never visited (reference {reference:.3g} %)"
        return f"{name} of {label} holds {candidate:.3g} % instead of {reference:.3g} %"

    return statement


def torsion_rows(inputs: ComparisonInput) -> Measured:
    """Return Jensen-Shannon distances: jointly per residue (50 x 50 bins), then phi and psi alone (100 bins); of many
    residues their means. Where phi > 0 is rare it is left out of the map and of phi. Maps and histograms are drawn of
    all, of many residues of some."""
    rows = _mean_torsion_rows(inputs) if are_many(inputs) else _single_torsion_rows(inputs)
    of_map = {row.key: row for row in rows}
    charts: list[Chart] = [
        _map(inputs, residue, of_map.get(f"joint_jsd:{residue.label}"))
        for residue in evenly(inputs.torsions.residues, _MOST_DRAWN)
    ]
    for symbol, labels, pick in _PHI_PSI:
        for k, label in evenly(list(enumerate(labels(inputs))), _MOST_DRAWN):
            series = [[x[:, k] for x in pick(s)] for s in inputs.samples]
            charts.append(histogram(inputs, series, TORSION_BINS, f"{symbol} {label}", "rad"))
    return Measured(rows, charts)


def _map(inputs: ComparisonInput, residue: Residue, row: Row | None) -> Landscape:
    """Counts over φ and ψ; captions with the distances of the residue's row, where it has one."""
    n, n_total = RAMACHANDRAN_BINS.n, RAMACHANDRAN_BINS.n_total
    ref, cand, rep = (_joint_counts(s, residue).sum(0).reshape(n_total, n_total)[:n, :n] for s in inputs.samples)
    edges = np.degrees(RAMACHANDRAN_BINS.edges)
    captions = ("Reference", "Candidate", "Replicate")
    if row is not None and row.replicate is not None:
        apart, replicate_baseline = row.candidate.value, row.replicate.value
        captions = (
            captions[0],
            f"Candidate: distance {apart:.3g} to the reference",
            f"Replicate: distance {replicate_baseline:.3g}, the replicate baseline",
        )
    title = f"φ and ψ of {residue.label}"
    return Landscape("distributions", title, "φ / °", "ψ / °", edges, edges, ref, cand, rep, captions)


def _single_torsion_rows(inputs: ComparisonInput) -> list[Row]:
    rows, rare = [], rare_residues(inputs)
    for residue in inputs.torsions.residues:
        counts = [_joint_counts(s, residue) for s in inputs.samples]
        what = "Joint φ/ψ"
        if residue.phi in rare:
            counts, what = [without_positive_phi(c, RAMACHANDRAN_BINS.n) for c in counts], f"{what} at φ < 0"
        rows.append(_jsd_row(inputs, counts, "joint_jsd", what, residue.label, "distributions"))
    for symbol, labels, pick in _PHI_PSI:
        for k, label in enumerate(labels(inputs)):
            counts = [
                distributions.block_counts([x[:, k] for x in pick(s)], TORSION_BINS, s.blocks) for s in inputs.samples
            ]
            key, what = "phi_jsd" if symbol == "φ" else "psi_jsd", symbol
            if symbol == "φ" and k in rare:
                counts, what = [without_positive_phi(c, TORSION_BINS.n) for c in counts], f"{symbol} at φ < 0"
            rows.append(_jsd_row(inputs, counts, key, what, label, "distributions"))
    return rows


def _joint_counts(sample: Sample, residue: Residue) -> FloatArray:
    phi, psi = (
        [x[:, k] for x in series]
        for series, k in ((sample.features.phi, residue.phi), (sample.features.psi, residue.psi))
    )
    return distributions.block_counts_joint(phi, psi, RAMACHANDRAN_BINS, sample.blocks)


def _mean_torsion_rows(inputs: ComparisonInput) -> list[Row]:
    rows = []
    residues = evenly(inputs.torsions.residues, MOST_MAPS)
    if residues:
        counts = [np.stack([_joint_counts(s, r) for r in residues], axis=1) for s in inputs.samples]
        rows.append(
            _jsd_row(inputs, counts, "joint_jsd", "Joint φ/ψ", f"mean of {len(residues)} residues", "distributions")
        )
    for symbol, _, pick in _PHI_PSI:
        key = "phi_jsd" if symbol == "φ" else "psi_jsd"
        columns = evenly(range(pick(inputs.reference)[0].shape[1]), MOST_HISTOGRAMS)
        if columns:
            counts = [
                np.stack(
                    [distributions.block_counts([x[:, k] for x in pick(s)], TORSION_BINS, s.blocks) for k in columns], 1
                )
                for s in inputs.samples
            ]
            rows.append(_jsd_row(inputs, counts, key, symbol, f"mean of {len(columns)} residues", "distributions"))
    return rows


def _jsd_row(
    inputs: ComparisonInput, counts: Sequence[FloatArray], key: str, what: str, label: str, group: Group
) -> Row:
    def statement(ratio: float) -> str:
        return f"the {what} distribution of {label} is {ratio:.2g} times as far from the reference as a replicate's"

    return distance_row(
        inputs, counts, key=f"{key}:{label}", group=group, metric=f"{what} distance, {label}", statement=statement
    )


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


def rare_residues(inputs: ComparisonInput) -> frozenset[int]:
    """Return the columns of phi whose positive side reference and replicate together visit fewer than ten times, in a
    small share of their frames, and which any of the three visits at all."""
    found = []
    for k in range(len(inputs.torsions.phi_labels)):
        reference, candidate, replicate = (_visits(s, k) for s in inputs.samples)
        source = reference + replicate
        small = source.inside < _SMALL_SHARE * source.n_frames
        if source.visits < _FEW_VISITS and small and source.visits + candidate.visits:
            found.append(k)
    return frozenset(found)


def free_energy_row(inputs: ComparisonInput, k: int, label: str) -> Row:
    """Return the row of the free energy of phi > 0 over phi < 0, in kT, by the time inside.

    Visits are independent and their lengths exponential, so that of n visits the logarithm has the error sqrt(2 / n);
    of none the free energy is that of half a visit. The p-value is of the free energies, or of the visits if that is
    less (exact: which trajectory a visit falls into is a matter of their lengths), in either case doubled.
    """
    found = [_visits(s, k) for s in inputs.samples]
    of_all = sum(found[1:], found[0])
    length = of_all.inside / of_all.visits
    shares = [(v.inside if v.visits else 0.5 * length) / v.n_frames for v in found]
    values = [math.log((1.0 - p) / p) if p < 1.0 else -math.log(v.n_frames) for p, v in zip(shares, found, strict=True)]
    errors = [math.sqrt(2.0 / max(v.visits, 0.5)) for v in found]
    normal = np.random.default_rng([inputs.options.seed, k]).normal(size=(3, _DRAWS))

    def statement(candidate: float, reference: float) -> str:
        n = found[1].visits
        seen = f"visited {n} {'time' if n == 1 else 'times'}" if n else "never visited"
        return f"φ > 0 of {label} is {seen}, {candidate:.2g} kT above φ < 0 instead of {reference:.2g} kT"

    metric = Quantity(
        f"free_energy:φ > 0:{label}", "populations", f"Free energy of φ > 0, {label}", "kT", _TOLERANCE_KT,
        tolerance_text="± 1 kJ/mol",
    )  # fmt: skip
    draws = [v + e * n for v, e, n in zip(values, errors, normal, strict=True)]
    row = observable_row(inputs, metric, values, draws, statement)
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


def other_torsion_rows(inputs: ComparisonInput) -> Measured:
    """Return Jensen-Shannon distances of every torsion beside phi and psi, 100 bins, symmetric rotors folded.

    Chi and rotatable bonds have a row each (one for all above six), omega and rotors one for all of them.
    """
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    measured = [family_of(s, "torsions") for s in inputs.samples]
    for kind, name in _NAMES.items():
        chosen = [k for k, torsion in enumerate(probes.torsions) if torsion.kind == kind]
        if not chosen:
            skipped.append((name, "the scene has none"))
        elif kind in ("χ", "rotatable") and len(chosen) <= _MANY:
            for k in chosen:
                series = [column(v, k) for v in measured]
                label = _folded(probes.torsions[k].label, probes.torsions[k].fold)
                rows.append(
                    series_distance(inputs, series, TORSION_BINS, f"torsion_jsd:{label}", label, "distributions")
                )
                charts.append(histogram(inputs, series, TORSION_BINS, label, "rad"))
        else:
            few = _spread(chosen)
            if len(few) < len(chosen):
                skipped.append((f"Some of the {len(chosen)} {name}", f"{len(few)}, evenly chosen, enter the mean"))
            picked = [[x[:, few] for x in v] for v in measured]
            bins = [TORSION_BINS] * len(few)
            rows.append(mean_distance(inputs, picked, bins, f"torsions_jsd:{kind}", name, "distributions"))
    return Measured(rows, charts, skipped)


def _spread(chosen: Sequence[int]) -> list[int]:
    step = -(-len(chosen) // _MAX_SERIES)
    return list(chosen[::step])


def _folded(label: str, fold: int) -> str:
    return label if fold == 1 else f"{label} ({fold} equal positions folded: {fold} times the angle)"


def intervention_rows(inputs: ComparisonInput) -> Measured:
    """Return each joint φ/ψ distance with the changed frames of the candidate left out, beside that of all frames.

    Where the two differ, the interventions show in the statistics. Skipped where no frame was changed, or nearly all
    were; a candidate whose file has no such column gets neither rows nor a reason.
    """
    changed = inputs.candidate.features.changed
    if changed is None:
        return Measured()
    share = float(np.concatenate(list(changed)).mean())
    if share == 0.0:
        return Measured(skipped=[(_WITHOUT_CHANGED, "the guards changed no frame")])
    if share > 1.0 - _LEAST_SHARE:
        return Measured(skipped=[(_WITHOUT_CHANGED, f"{100 * share:.3g} % of the frames were changed")])
    rows = []
    for residue in inputs.torsions.residues:
        where = f"{residue.label}, without the {100 * share:.2g} % that guards changed"

        def statement(ratio: float, where: str = where) -> str:
            return f"the φ/ψ distribution of {where}, is {ratio:.2g} times as far from the reference as a replicate's"

        rows.append(
            distance_row(
                inputs,
                [_counts(s, residue.phi, residue.psi) for s in inputs.samples],
                key=f"joint_jsd_unchanged:{residue.label}",
                group="distributions",
                metric=f"Joint φ/ψ distance, {where}",
                statement=statement,
            )
        )
    return Measured(rows, [], [])


def _counts(sample: Sample, phi: int, psi: int) -> FloatArray:
    """Joint histograms per block `(n_blocks, n_bins)` of the frames that nothing was done about."""
    features = sample.features
    x, y = [s[:, phi] for s in features.phi], [s[:, psi] for s in features.psi]
    counts = block_counts_joint(x, y, RAMACHANDRAN_BINS, sample.blocks)
    if features.changed is None:
        return counts
    n = RAMACHANDRAN_BINS.n_total
    for piece in sample.blocks.pieces:
        part = slice(piece.start, piece.stop)
        gone = features.changed[piece.segment][part]
        index = RAMACHANDRAN_BINS.index(x[piece.segment][part][gone]) * n
        index += RAMACHANDRAN_BINS.index(y[piece.segment][part][gone])
        counts[piece.block] -= np.bincount(index, minlength=n * n)
    return counts
