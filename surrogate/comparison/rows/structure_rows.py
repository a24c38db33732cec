"""Structure: bond lengths and angles, the temperature that they vibrate at, size and shape, contacts, hydrogen bonds,
secondary structure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.statistics import FloatArray, Segments
from surrogate.comparison.measure.structure import (
    COIL,
    CONSTRAINED_BELOW_NM,
    HELIX,
    LEAST_RESIDUES,
    MOST_HISTOGRAMS,
    STRAND,
    equal_rows,
    evenly,
    group_labels,
)
from surrogate.comparison.measure.torsions import bond_label
from surrogate.comparison.read.stored_frames import angle_variance, length_error_nm
from surrogate.comparison.rows.charts import ROLES, BarChart, Chart, Line, LineChart, bar_chart
from surrogate.comparison.rows.rows import (
    ONE_KJ_SHARE,
    ComparisonInput,
    Limits,
    Means,
    Measured,
    Quantity,
    Row,
    Sample,
    Skipped,
    bounds,
    histogram,
    left_out,
    lower_first,
    mean_distance,
    mean_row,
    observable_row,
    series_distance,
    shift_row,
    three_means,
)

BOND_RESOLUTION_ANGSTROM = 0.001
# The width of a harmonic bond goes with the root of the temperature: 5 % is 30 K at 300 K.
BOND_WIDTH_TOLERANCE = 0.05
_BOND_SHIFT = Quantity(
    "bond_shift", "structure", "Largest shift of a mean bond length", "Å", 0.01, resolution=BOND_RESOLUTION_ANGSTROM
)
_ANGLE_SHIFT = Quantity("angle_shift", "structure", "Largest shift of a mean bond angle", "°", 1.0, resolution=0.05)
_CONTACT_SHIFT = Quantity(
    "contact_shift", "populations", "Largest shift of a contact's probability", "", 0.05, resolution=1e-3
)
_ANGLE_BINS = 50
_TEMPERATURE = "Temperature of vibrations"
_TEMPERATURE_TOLERANCE = 0.03
_LEAST_VIBRATIONS, _MOST_VIBRATIONS = 3, 256
_MAX_DRAWN = 60
# Columns of the family "shape".
_RG, _RMSD, _ENDS, _CONTACTS, _KEPT = range(5)
# Of single hydrogen bonds: the least share of frames, how many have rows, how many are drawn.
_POPULATED, _MAX_ROWS, _MAX_BARS = 0.01, 4, 24
_MOST_POINTS = 400
_LEAST_IN_NS_PS = 2000.0
_MOST_RESIDUES = 2
_MOST_NAMED = 12


@dataclass(frozen=True, eq=False)
class _Moments:
    """Mean and standard deviation of each bond in Å `(n_bonds,)`, with bootstrap draws `(n_draws, n_bonds)`."""

    mean: Means
    std: Means


def bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows on bond lengths (shift of means, widths, distributions), and a chart of all means."""
    pairs = np.asarray(inputs.geometry.bond_idx).reshape(-1, 2)
    if not len(pairs):
        return Measured()
    moments = [_bond_moments(s, 10.0 * np.asarray(inputs.geometry.bond_mean_nm, np.float64)) for s in inputs.samples]
    reference, probes = inputs.reference.features, inputs.reference.features.probes
    # What rounding alone may do counts as no vibration.
    least_nm = math.hypot(CONSTRAINED_BELOW_NM, 1.1 * length_error_nm(reference.grid_nm))
    rigid = ~(moments[0].std.values > 10 * least_nm)
    groups = equal_rows(pairs, probes.classes if probes else np.arange(inputs.scene.n_atoms))
    names = group_labels([bond_label(inputs.scene, i, j) for i, j in pairs.tolist()], groups)
    means = [m.mean.over(groups) for m in moments]
    rows = [shift_row(inputs, _BOND_SHIFT, means, names, _bond_words)]
    for chosen, kind, tolerance, words in (
        (~rigid, "flexible bonds", None, "± 5 %"),
        (rigid, "constrained bonds", 0.02, "± 0.02 Å"),
    ):
        if not chosen.any():
            continue
        values = [float(np.sqrt((m.std.values[chosen] ** 2).mean())) for m in moments]
        draws = [np.sqrt((m.std.draws[:, chosen] ** 2).mean(1)) for m in moments]
        metric = Quantity(
            f"bond_width:{kind}", "structure", f"Bond-length width, {kind}", "Å",
            BOND_WIDTH_TOLERANCE * values[0] if tolerance is None else tolerance, words,
            resolution=BOND_RESOLUTION_ANGSTROM,
        )  # fmt: skip
        said = f"{kind} vary by {{:.3f}} Å instead of {{:.3f}} Å"
        rows.append(observable_row(inputs, metric, values, draws, said.format))
    flexible = evenly([g for g in groups if not rigid[g].any()], MOST_HISTOGRAMS)
    if flexible:
        lengths = [s.features.bonds_nm for s in inputs.samples]
        bins = [distributions.normal_bins([x[:, g] for x in lengths[0]]) for g in flexible]
        rows.append(mean_distance(inputs, lengths, bins, "bond_jsd", "Flexible bond lengths", "structure", flexible))
    return Measured(rows, [_means_chart(means, names)])


def _bond_words(label: str, candidate: float, reference: float) -> str:
    percent = 100.0 * (candidate / reference - 1.0)
    return f"{label} bonds are {abs(percent):.1f} % {'long' if percent > 0 else 'short'}"


def _moment_sums(
    sample: Sample, segments: Segments, centre: FloatArray, limits: Limits
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return per block `(n_blocks, k)` how many values there are, and the sums of them and of their squares, of values
    about a `centre` and kept within limits."""
    n, first, second = np.zeros((3, sample.blocks.n_blocks, segments[0].shape[1]))
    for piece in sample.blocks.pieces:
        values = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = ~np.isnan(values)
        part = np.where(finite, np.clip(values, *limits) - centre, 0.0)
        n[piece.block] += finite.sum(0)
        first[piece.block] += part.sum(0)
        second[piece.block] += (part * part).sum(0)
    return n, first, second


def _bond_moments(sample: Sample, centre: FloatArray) -> _Moments:
    """Moments about the reference mean: plain ones would lose the width of a constrained bond to rounding. Deviations
    count as at most 0.5 Å: an exploded frame is the validity checks' to report, and must not drown the others."""
    lengths = [10.0 * x.astype(np.float64) for x in sample.features.bonds_nm]
    n, first, second = _moment_sums(sample, lengths, centre, (centre - 0.5, centre + 0.5))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = first.sum(0) / n.sum(0)
        std = np.sqrt(np.maximum(second.sum(0) / n.sum(0) - mean**2, 0.0))
        drawn = sample.weights @ n
        draws = sample.weights @ first / drawn
        draws_std = np.sqrt(np.maximum(sample.weights @ second / drawn - draws**2, 0.0))
    n_blocks = sample.blocks.n_blocks
    return _Moments(Means(mean + centre, draws + centre, n_blocks), Means(std, draws_std, n_blocks))


def _means_chart(means: Sequence[Means], labels: Sequence[str]) -> BarChart:
    """Mean lengths less the reference's, with the 95 % interval of the candidate's, the furthest off first."""
    ref, cand, rep = means
    shift = cand.values - ref.values
    order = np.argsort(-np.abs(np.nan_to_num(shift)), kind="stable")
    draws = cand.draws - ref.draws
    low, high = np.nanquantile(draws, [0.025, 0.975], axis=0) - np.nanmean(draws, axis=0)
    return BarChart(
        "structure",
        "Mean bond lengths, less the reference's",
        "The furthest off first; of bonds that the molecule's symmetry makes equal the mean.",
        "length / Å",
        names=tuple(labels[k] for k in order),
        reference=np.zeros(len(order)),
        candidate=shift[order],
        replicate=(rep.values - ref.values)[order],
        candidate_low=(shift + low)[order],
        candidate_high=(shift + high)[order],
    )


def temperature_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of the reference's temperature times the median ratio of variances of bonds and angles to its own.

    A stiff coordinate's variance goes with the temperature (equipartition); bonds that are held by constraints are left
    out, and so are those that the rounding of the files makes vary more than the temperature does; of the others its
    part of the variance is taken off. A model that vibrates too much or too little reads as too hot or too cold.
    """
    # Bond lengths (nm) and angles (rad) side by side.
    columns = [
        [np.concatenate(both, axis=1) for both in zip(s.features.bonds_nm, s.family("angles"), strict=True)]
        for s in inputs.samples
    ]
    low, high = bounds(columns[0])
    spread = np.concatenate(columns[0]).std(axis=0)
    rounding = _rounding_variance(inputs, np.nanmean(np.concatenate(columns[0]), axis=0))
    loose = spread > 10 * CONSTRAINED_BELOW_NM
    moving = np.flatnonzero(loose & (spread**2 > 2.0 * rounding))
    if len(moving) < _LEAST_VIBRATIONS:
        hidden = loose.sum() >= _LEAST_VIBRATIONS
        why = "the rounding of the files hides how" if hidden else "fewer than three"
        return left_out(_TEMPERATURE, f"{why} bonds and angles vibrate")
    k = np.array(evenly(moving.tolist(), _MOST_VIBRATIONS))
    found = [
        _variances(s, [x[:, k] for x in c], (low[k], high[k]), rounding[k])
        for s, c in zip(inputs.samples, columns, strict=True)
    ]
    own = found[0][0]
    values = [inputs.temperature_k * float(np.median(v / own)) for v, _ in found]
    draws = [inputs.temperature_k * np.median(d / own, axis=1) for _, d in found]
    name = f"{_TEMPERATURE}: {len(k)} bonds and angles, by the reference's widths"
    tolerance, words = _TEMPERATURE_TOLERANCE * inputs.temperature_k, f"± {100 * _TEMPERATURE_TOLERANCE:g} %"
    metric = Quantity("temperature", "structure", name, "K", tolerance, words)
    said = "bonds and angles vibrate as at {:.0f} K instead of {:.0f} K"
    return Measured([observable_row(inputs, metric, values, draws, said.format)])


def _rounding_variance(inputs: ComparisonInput, means: FloatArray) -> FloatArray:
    """Return what rounding adds to the variance of every column `(k,)`: bond lengths (nm²), then angles (rad²)."""
    grid_nm, probes = inputs.reference.features.grid_nm, inputs.reference.features.probes
    bonds = inputs.geometry.bond_idx
    out = np.full(len(means), length_error_nm(grid_nm) ** 2)
    if probes is not None and grid_nm > 0:
        length = {frozenset(pair): r for pair, r in zip(bonds.tolist(), means.tolist(), strict=False)}
        arms = np.array([[length[frozenset((b, x))] for x in (a, c)] for a, b, c in probes.angles.tolist()])
        arms = arms.reshape(-1, 2)
        out[len(bonds) :] = angle_variance(arms[:, 0], arms[:, 1], means[len(bonds) :], grid_nm)
    return out


def _variances(
    sample: Sample, segments: Segments, limits: Limits, rounding: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the variance of every column `(k,)` and its bootstrap draws `(n_draws, k)`, values kept within limits,
    less what `rounding` `(k,)` adds to it."""
    n, first, second = _moment_sums(sample, segments, 0.5 * (limits[0] + limits[1]), limits)

    def variance(w: FloatArray) -> FloatArray:
        with np.errstate(invalid="ignore", divide="ignore"):
            whole = (w @ second) / (w @ n) - ((w @ first) / (w @ n)) ** 2
            return np.asarray(np.where(rounding > 0, np.maximum(whole - rounding, 0.0), whole))

    return variance(np.ones((1, len(n))))[0], variance(sample.weights)


def angle_rows(inputs: ComparisonInput) -> Measured:
    """Return rows on bond angles: the mean that is furthest off, and the distributions."""
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not len(probes.angles):
        return left_out("Bond angles", "no atom has two neighbours")
    angles = inputs.families("angles")
    groups = equal_rows(probes.angles, probes.classes)
    means = [m.over(groups).times(180.0 / math.pi) for m in three_means(inputs, angles, limited=True)]
    names = group_labels(probes.labels("angles"), groups)
    drawn = evenly(groups, MOST_HISTOGRAMS)
    bins = [distributions.normal_bins([x[:, g] for x in angles[0]], _ANGLE_BINS) for g in drawn]
    return Measured(
        [
            shift_row(inputs, _ANGLE_SHIFT, means, names, _angle_words),
            mean_distance(inputs, angles, bins, "angle_jsd", "Bond angles", "structure", drawn),
        ]
    )


def _angle_words(label: str, candidate: float, reference: float) -> str:
    off = candidate - reference
    return f"the angle {label} is {abs(off):.1f}° too {'wide' if off > 0 else 'narrow'}"


def shape_rows(inputs: ComparisonInput) -> Measured:
    """Return rows and charts of radius of gyration, RMSD, RMSF and end-to-end distance."""
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    skipped: list[Skipped] = [*probes.left_out]
    lengths = [(_RG, "rg", "Radius of gyration", 0.02), (_RMSD, "rmsd", "RMSD from the reference's mean structure", 0)]
    if probes.ends is not None:
        names = " to ".join(probes.scene.atom_names[i] for i in probes.ends)
        lengths.append((_ENDS, "end_to_end", f"End-to-end distance ({names})", 0.03))
    else:
        skipped.append(("End-to-end distance", "no two heavy atoms are four bonds apart"))
    rows: list[Row] = []
    charts: list[Chart] = []
    for k, key, name, tolerance in lengths:
        # The distribution of a length, and its mean where there is a relative tolerance to hold it to.
        series = [[10.0 * x for x in v] for v in inputs.families("shape", k)]
        if tolerance:
            means = three_means(inputs, series, limited=True)
            limit, words = tolerance * float(means[0].values[0]), f"± {100 * tolerance:g} %"
            metric = Quantity(f"{key}_mean", "structure", f"{name}, mean", "Å", limit, words)
            rows.append(mean_row(inputs, metric, means, 0, _instead(f"the {lower_first(name)} is", "Å on average")))
        flat = [[x[:, 0] for x in v] for v in series]
        bins = distributions.reference_bins(flat[0])
        rows.append(series_distance(inputs, flat, bins, f"{key}_jsd", name, "structure"))
        charts.append(histogram(inputs, flat, bins, name, "Å"))
    fluctuation, chart = _fluctuation(inputs)
    return Measured([*rows, fluctuation], [*charts, chart], skipped)


def _fluctuation(inputs: ComparisonInput) -> tuple[Row, Chart]:
    """RMSF about the reference's mean structure after superposition: its root mean square, and one bar per atom, or for
    all of a kind that the molecule's symmetry makes equal.

    Every trajectory is laid over the same mean structure, so that a shifted mean shows as well as another spread.
    """
    probes = inputs.reference.features.probes
    assert probes is not None
    means = three_means(inputs, inputs.families("deviation"), limited=True)

    def rms(squared: FloatArray) -> FloatArray:
        return 10.0 * np.sqrt(squared.mean(axis=-1))

    metric = Quantity("rmsf", "structure", "RMSF over all fitted atoms", "Å", 0.1, relative=True)
    values, draws = [float(rms(m.values)) for m in means], [rms(m.draws) for m in means]
    said = "atoms fluctuate by {:.3g} Å instead of {:.3g} Å (RMSF)"
    row = observable_row(inputs, metric, values, draws, said.format)
    groups = equal_rows(probes.fit_idx[:, None], probes.classes)
    labels = group_labels(probes.labels("deviation"), groups)
    shown = np.unique(np.linspace(0, len(groups) - 1, _MAX_DRAWN).astype(int))
    numbers: dict[str, FloatArray] = {}
    for role, m in zip(ROLES, [m.over(groups) for m in means], strict=True):
        numbers[role] = 10.0 * np.sqrt(m.values[shown])
        for end, q in (("low", 0.025), ("high", 0.975)) if role != "replicate" else ():
            numbers[f"{role}_{end}"] = 10.0 * np.sqrt(np.maximum(np.nanquantile(m.draws[:, shown], q, axis=0), 0.0))
    caption = "Root mean square distance of each atom from the reference's mean structure, frames superposed on it."
    return row, BarChart("structure", "RMSF", caption, "RMSF / Å", tuple(labels[k] for k in shown), **numbers)


def contact_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the number of contacts, the share of the reference's that is kept, the contact furthest off.

    A contact is two heavy atoms more than three bonds apart within 0.45 nm; in chains of five residues or more, two
    alpha carbons three or more residues apart within 0.8 nm. A contact of the reference is formed in more than half of
    its frames.
    """
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not len(probes.all_contacts):
        return left_out("Contacts", "no two heavy atoms are more than three bonds apart")
    means = three_means(inputs, inputs.families("shape", _CONTACTS, _KEPT))
    name = f"Contacts (of {len(probes.all_contacts)} possible), mean number"
    count = Quantity("contacts", "populations", name, "", 0.05 * max(float(means[0].values[0]), 1e-9), "± 5 %")
    said = "{:.3g} contacts are formed on average instead of {:.3g}"
    rows = [mean_row(inputs, count, means, 0, said.format)]
    if len(probes.native):
        name = f"The reference's {len(probes.native)} contacts, share kept"
        rows.append(mean_row(inputs, Quantity("contacts_kept", "populations", name, "", 0.03), means, 1, _kept))
    groups = equal_rows(probes.contacts, probes.classes)
    single = [m.over(groups) for m in three_means(inputs, inputs.families("contacts"))]
    labels = group_labels(probes.labels("contacts"), groups)
    return Measured([*rows, shift_row(inputs, _CONTACT_SHIFT, single, labels, _contact_words)])


def _instead(before: str, after: str) -> Callable[[float, float], str]:
    """Words such as 'the radius of gyration is 3 Å on average instead of 4 Å'."""
    return lambda c, r: f"{before} {c:.3g} {after} instead of {r:.3g} {after.split()[0]}"


def _kept(candidate: float, reference: float) -> str:
    return f"{100 * candidate:.3g} % of the reference's contacts are formed instead of {100 * reference:.3g} %"


def _contact_words(label: str, candidate: float, reference: float) -> str:
    return f"the contact {label} is formed {100 * candidate:.3g} % of the time instead of {100 * reference:.3g} %"


def hydrogen_bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the mean number of hydrogen bonds and of the most populated ones, and a chart of populations.

    Criterion: see `structure.is_formed`. A bond is shown when the reference or the candidate forms it in more than 1 %
    of frames. Of bonds that the molecule's symmetry makes equal, such as those of an ammonium's three hydrogens, the
    population is the mean.
    """
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not len(probes.hydrogen_bonds):
        missing = "H" not in probes.scene.elements
        why = "the trajectories hold no hydrogens" if missing else "no donor has an acceptor three bonds away"
        return left_out("Hydrogen bonds", why)
    formed = inputs.families("hydrogen_bonds")
    number = three_means(inputs, [[x.sum(axis=1, keepdims=True) for x in v] for v in formed])
    groups = equal_rows(probes.hydrogen_bonds, probes.classes)
    single = [m.over(groups) for m in three_means(inputs, formed)]
    labels = group_labels(probes.labels("hydrogen_bonds"), groups)
    rows: list[Row] = []
    if len(probes.hydrogen_bonds) > 1 and max(m.values[0] for m in number) > 0:
        tolerance = ONE_KJ_SHARE * float(number[0].values[0])
        count = Quantity("hydrogen_bonds", "populations", "Hydrogen bonds, mean number", "", tolerance, "± 1 kJ/mol")
        said = "{:.3g} hydrogen bonds are formed on average instead of {:.3g}"
        rows.append(mean_row(inputs, count, number, 0, said.format))
    most = np.maximum(single[0].values, single[1].values)
    order = [int(k) for k in np.argsort(-most, kind="stable") if most[k] > _POPULATED]
    percent = [m.times(100) for m in single]
    for k in order[:_MAX_ROWS]:
        share = float(single[0].values[k])
        tolerance = 100.0 * min(share, 1.0 - share) * ONE_KJ_SHARE
        key, name = f"hydrogen_bond:{labels[k]}", f"Hydrogen bond {labels[k]}"
        metric = Quantity(key, "populations", name, "%", tolerance, "± 1 kJ/mol")
        words = _instead(f"the {lower_first(name)} is formed", "% of the time")
        rows.append(mean_row(inputs, metric, percent, k, words))
    if not order:
        return Measured(rows, (), [("Single hydrogen bonds", "none is formed in more than 1 % of frames")])
    caption = (
        "Share of frames in which each is formed (H to acceptor below 2.5 Å, angle above 120°); of equal ones the mean."
    )
    shown = order[:_MAX_BARS]
    made = [m.estimates(shown) for m in percent]
    chart = bar_chart("structure", "Hydrogen bonds", caption, "frames / %", [labels[k] for k in shown], made)
    return Measured(rows, [chart])


def secondary_structure(inputs: ComparisonInput) -> Measured:
    """Return rows of the share of residues in helix and in strand, and charts of helix, strand and coil residue by
    residue, with 95 % intervals. By DSSP (`structure.secondary_structure`); peptides of five residues and more."""
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not probes.chains.labels:
        return left_out("Secondary structure", f"fewer than {LEAST_RESIDUES} residues have N, CA, C and O")
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    for name, code in (("helix", HELIX), ("strand", STRAND), ("coil", COIL)):
        percent = [[100.0 * (x == code) for x in v] for v in inputs.families("secondary")]
        if code != COIL:
            means = three_means(inputs, [[x.mean(axis=1, keepdims=True) for x in v] for v in percent])
            metric = Quantity(f"secondary:{name}", "structure", f"Residues in {name} (DSSP)", "%", 5.0)
            said = f"{{:.3g}} % of residues are in {name} instead of {{:.3g}} %"
            rows.append(mean_row(inputs, metric, means, 0, said.format))
        each = three_means(inputs, percent)
        if any((m.values > 0).any() for m in each):
            charts.append(_residue_chart(f"Residues in {name}", probes.chains.labels, each))
        else:
            skipped.append((f"Residues in {name}", "there are none in any frame"))
    return Measured(rows, charts, skipped)


def _residue_chart(title: str, labels: Sequence[str], each: Sequence[Means]) -> Chart:
    """Names beside dots where there is room for them; of longer chains lines with bands over the residues in order."""
    caption = "Share of frames by DSSP, with 95 % intervals."
    made = [means.estimates() for means in each]
    if len(labels) <= _MOST_NAMED:
        return bar_chart("structure", title, caption, "frames / %", labels, made)
    place = np.arange(1, len(labels) + 1, dtype=np.float64)
    lines = []
    for role, found in zip(ROLES, made, strict=True):
        value, low, high = (np.array([getattr(e, x) for e in found]) for x in ("value", "low", "high"))
        band = (None, None) if role == "replicate" else (np.clip(low, 0, 100), np.clip(high, 0, 100))
        lines.append(Line(role, role, place, value, *band))
    ends = f"1 is {labels[0]}, {len(labels)} is {labels[-1]}."
    return LineChart("structure", title, f"{caption} {ends}", "residue", "frames / %", tuple(lines))


def along_time(inputs: ComparisonInput) -> Measured:
    """Return charts of the RMSD and of phi and psi along the first segment of each trajectory, every k-th frame."""
    charts: list[Chart] = []
    if inputs.reference.features.probes is not None:
        rmsd = [10.0 * v[0][:, 0].astype(np.float64) for v in inputs.families("shape", _RMSD)]
        charts.append(_series_chart(inputs, rmsd, "RMSD along time", "RMSD / Å"))
    for residue in inputs.torsions.residues[:_MOST_RESIDUES]:
        for symbol, k, pick in (("φ", residue.phi, "phi"), ("ψ", residue.psi, "psi")):
            angles = [np.degrees(getattr(s.features, pick)[0][:, k].astype(np.float64)) for s in inputs.samples]
            charts.append(_series_chart(inputs, angles, f"{symbol} of {residue.label} along time", f"{symbol} / °"))
    return Measured(charts=charts)


def _series_chart(inputs: ComparisonInput, values: Sequence[FloatArray], title: str, y_label: str) -> LineChart:
    shortest = min(map(len, values))
    step = max(1, -(-shortest // _MOST_POINTS))
    unit, scale = ("ns", 1e-3) if shortest * inputs.lag_ps >= _LEAST_IN_NS_PS else ("ps", 1.0)
    lines = []
    for role, series in zip(ROLES, values, strict=True):
        y: FloatArray = series[:shortest:step]
        lines.append(Line(role, role, np.arange(len(y), dtype=np.float64) * step * inputs.lag_ps * scale, y))
    caption = f"First segment of each trajectory, one frame in {step}." if step > 1 else "First segment of each."
    return LineChart("structure", title, caption, f"time / {unit}", y_label, tuple(lines), dots=True)
