"""Structure: bond lengths and angles, the temperature that they vibrate at, size and shape, contacts, hydrogen bonds,
secondary structure."""

from __future__ import annotations

import math

import numpy as np

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.statistics import FloatArray, Segments
from surrogate.comparison.measure.structure import (
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
from surrogate.comparison.rows.charts import ROLES, Chart, Line, LineChart, bar_chart
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
    mean_distance,
    mean_row,
    observable_row,
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
    "contact_shift", "populations", "Largest shift of a contact's population", "%", 5.0, resolution=0.1
)
_HYDROGEN_BOND_SHIFT = Quantity(
    "hydrogen_bond_shift", "populations", "Largest shift of a hydrogen bond's population", "%", 5.0, resolution=0.1
)
_ANGLE_BINS = 50
_TEMPERATURE = "Temperature of vibrations"
_TEMPERATURE_TOLERANCE = 0.03
_LEAST_VIBRATIONS, _MOST_VIBRATIONS = 3, 256
_MAX_DRAWN = 60
# Columns of the family "shape".
_RG, _RMSD, _ENDS, _CONTACTS, _KEPT = range(5)
# Of single hydrogen bonds that are drawn: the least share of frames, and how many.
_POPULATED, _MAX_BARS = 0.01, 24


def bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows on bond lengths: shift of means, widths, distributions."""
    pairs = np.asarray(inputs.geometry.bond_idx).reshape(-1, 2)
    if not len(pairs):
        return Measured()
    # Moments in Å about the reference's mean, from which a bond counts as at most 0.5 Å off: an exploded frame is the
    # validity checks' to report, and must not drown the others.
    centre = 10.0 * np.asarray(inputs.geometry.bond_mean_nm, np.float64)
    moments = [
        _moments(s, [10.0 * x.astype(np.float64) for x in s.features.bonds_nm], centre, (centre - 0.5, centre + 0.5))
        for s in inputs.samples
    ]
    # What rounding alone may do counts as no vibration.
    least_nm = math.hypot(CONSTRAINED_BELOW_NM, 1.1 * length_error_nm(inputs.reference.features.grid_nm))
    rigid = ~(np.sqrt(moments[0][1].values) > 10 * least_nm)
    groups = equal_rows(pairs, inputs.probes.classes)
    names = group_labels([bond_label(inputs.scene, i, j) for i, j in pairs.tolist()], groups)
    rows = [shift_row(_BOND_SHIFT, [mean.over(groups) for mean, _ in moments], names)]
    for chosen, name, tolerance, words in (
        (~rigid, "flexible bonds", None, "± 5 %"),
        (rigid, "constrained bonds", 0.02, "± 0.02 Å"),
    ):
        if not chosen.any():
            continue
        values = [float(np.sqrt(variance.values[chosen].mean())) for _, variance in moments]
        draws = [np.sqrt(variance.draws[:, chosen].mean(1)) for _, variance in moments]
        metric = Quantity(
            f"bond_width:{name}", "structure", f"Bond-length width, {name}", "Å",
            BOND_WIDTH_TOLERANCE * values[0] if tolerance is None else tolerance, words,
            resolution=BOND_RESOLUTION_ANGSTROM,
        )  # fmt: skip
        rows.append(observable_row(inputs, metric, values, draws))
    flexible = evenly([g for g in groups if not rigid[g].any()], MOST_HISTOGRAMS)
    if flexible:
        lengths = [s.features.bonds_nm for s in inputs.samples]
        bins = [distributions.normal_bins([x[:, g] for x in lengths[0]]) for g in flexible]
        rows.append(mean_distance(inputs, lengths, bins, "bond_jsd", "Flexible bond lengths", "structure", flexible))
    return Measured(rows)


def _moments(sample: Sample, segments: Segments, centre: FloatArray, limits: Limits) -> tuple[Means, Means]:
    """Return the mean and the variance of every column `(n, k)`, of values kept within limits; they are summed about a
    `centre`, since plain sums would lose the width of a constrained bond to rounding."""
    n, first, second = np.zeros((3, sample.blocks.n_blocks, segments[0].shape[1]))
    for piece in sample.blocks.pieces:
        values = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = ~np.isnan(values)
        part = np.where(finite, np.clip(values, *limits) - centre, 0.0)
        n[piece.block] += finite.sum(0)
        first[piece.block] += part.sum(0)
        second[piece.block] += (part * part).sum(0)
    # All blocks once, and each bootstrap draw.
    weights = np.concatenate([np.ones((1, len(n))), sample.weights])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = weights @ first / (weights @ n)
        variance = np.maximum(weights @ second / (weights @ n) - mean**2, 0.0)
    return Means(mean[0] + centre, mean[1:] + centre, len(n)), Means(variance[0], variance[1:], len(n))


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
    spread = np.nanstd(np.concatenate(columns[0]), axis=0)
    rounding = _rounding_variance(inputs, np.nanmean(np.concatenate(columns[0]), axis=0))
    loose = spread > 10 * CONSTRAINED_BELOW_NM
    moving = np.flatnonzero(loose & (spread**2 > 2.0 * rounding))
    if len(moving) < _LEAST_VIBRATIONS:
        hidden = loose.sum() >= _LEAST_VIBRATIONS
        why = "the rounding of the files hides how" if hidden else "fewer than three"
        return left_out(_TEMPERATURE, f"{why} bonds and angles vibrate")
    k = np.array(evenly(moving.tolist(), _MOST_VIBRATIONS))
    limits = low[k], high[k]
    values, draws = [], []
    for sample, segments in zip(inputs.samples, columns, strict=True):
        _, whole = _moments(sample, [x[:, k] for x in segments], 0.5 * (limits[0] + limits[1]), limits)
        values.append(np.maximum(whole.values - rounding[k], 0.0))
        draws.append(np.maximum(whole.draws - rounding[k], 0.0))
    own, reference_k = values[0], inputs.temperature_k
    name, tolerance = f"{_TEMPERATURE} ({len(k)} bonds and angles)", _TEMPERATURE_TOLERANCE * reference_k
    metric = Quantity("temperature", "structure", name, "K", tolerance, f"± {100 * _TEMPERATURE_TOLERANCE:g} %")
    kelvin = [reference_k * float(np.median(v / own)) for v in values]
    return Measured([observable_row(inputs, metric, kelvin, [reference_k * np.median(d / own, axis=1) for d in draws])])


def _rounding_variance(inputs: ComparisonInput, means: FloatArray) -> FloatArray:
    """Return what rounding adds to the variance of every column `(k,)`: bond lengths (nm²), then angles (rad²)."""
    grid_nm, bonds = inputs.reference.features.grid_nm, inputs.geometry.bond_idx
    out = np.full(len(means), length_error_nm(grid_nm) ** 2)
    if grid_nm > 0:
        x, (a, b, c) = inputs.scene.positions_nm, inputs.probes.angles.T
        first, second = (np.linalg.norm(x[end] - x[b], axis=1) for end in (a, c))
        out[len(bonds) :] = angle_variance(first, second, means[len(bonds) :], grid_nm)
    return out


def angle_rows(inputs: ComparisonInput) -> Measured:
    """Return rows on bond angles: the mean that is furthest off, and the distributions."""
    probes = inputs.probes
    if not len(probes.angles):
        return left_out("Bond angles", "no atom has two neighbours")
    angles = inputs.families("angles")
    groups = equal_rows(probes.angles, probes.classes)
    means = [m.over(groups).times(180.0 / math.pi) for m in three_means(inputs, angles, limited=True)]
    drawn = evenly(groups, MOST_HISTOGRAMS)
    bins = [distributions.normal_bins([x[:, g] for x in angles[0]], _ANGLE_BINS) for g in drawn]
    return Measured(
        [
            shift_row(_ANGLE_SHIFT, means, group_labels(probes.labels("angles"), groups)),
            mean_distance(inputs, angles, bins, "angle_jsd", "Bond angles", "structure", drawn),
        ]
    )


def shape_rows(inputs: ComparisonInput) -> Measured:
    """Return rows and charts of radius of gyration, RMSD, RMSF and end-to-end distance."""
    probes = inputs.probes
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
            rows.append(
                mean_row(inputs, Quantity(f"{key}_mean", "structure", f"{name}, mean", "Å", limit, words), means)
            )
        bins = distributions.reference_bins(series[0])
        rows.append(mean_distance(inputs, series, [bins], f"{key}_jsd", name, "structure"))
        charts.append(histogram(inputs, [[x[:, 0] for x in v] for v in series], bins, name, "Å"))
    fluctuation, chart = _fluctuation(inputs)
    return Measured([*rows, fluctuation], [*charts, chart], skipped)


def _fluctuation(inputs: ComparisonInput) -> tuple[Row, Chart]:
    """RMSF about the reference's mean structure: its root mean square, and one bar per atom, or for all that symmetry
    makes equal. All are laid over the same structure, so that a shifted mean shows as well as another spread."""
    probes = inputs.probes
    means = three_means(inputs, inputs.families("deviation"), limited=True)

    def rms(squared: FloatArray) -> FloatArray:
        return 10.0 * np.sqrt(squared.mean(axis=-1))

    metric = Quantity("rmsf", "structure", "RMSF over all fitted atoms", "Å", 0.1, relative=True)
    row = observable_row(inputs, metric, [float(rms(m.values)) for m in means], [rms(m.draws) for m in means])
    groups = equal_rows(probes.fit_idx[:, None], probes.classes)
    labels = group_labels(probes.labels("deviation"), groups)
    shown = np.unique(np.linspace(0, len(groups) - 1, _MAX_DRAWN).astype(int)).tolist()
    of_atoms = [m.over(groups) for m in means]
    made = [Means(10.0 * np.sqrt(m.values), 10.0 * np.sqrt(m.draws), m.n_blocks).estimates(shown) for m in of_atoms]
    caption = "Root mean square distance of each atom from the reference's mean structure, frames superposed on it."
    return row, bar_chart("structure", "RMSF", caption, "RMSF / Å", [labels[k] for k in shown], made)


def contact_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the number of contacts (`structure._contact_pairs`), the share kept of those that the reference
    forms in more than half of its frames, and the one furthest off."""
    probes = inputs.probes
    if not len(probes.all_contacts):
        return left_out("Contacts", "no two heavy atoms are more than three bonds apart")
    number, kept = ([m.times(factor) for m in three_means(inputs, inputs.families("shape", column))]
                    for column, factor in ((_CONTACTS, 1.0), (_KEPT, 100.0)))  # fmt: skip
    name = f"Contacts (of {len(probes.all_contacts)} possible), mean number"
    tolerance = 0.05 * max(float(number[0].values[0]), 1e-9)
    rows = [mean_row(inputs, Quantity("contacts", "populations", name, "", tolerance, "± 5 %"), number)]
    if len(probes.native):
        name = f"The reference's {len(probes.native)} contacts, share kept"
        rows.append(mean_row(inputs, Quantity("contacts_kept", "populations", name, "%", 3.0), kept))
    groups = equal_rows(probes.contacts, probes.classes)
    single = [m.over(groups).times(100.0) for m in three_means(inputs, inputs.families("contacts"))]
    return Measured([*rows, shift_row(_CONTACT_SHIFT, single, group_labels(probes.labels("contacts"), groups))])


def hydrogen_bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the mean number of hydrogen bonds (`structure.is_formed`) and of the one furthest off, and a chart
    of those that the reference or the candidate forms in more than 1 % of frames. Of bonds that the molecule's symmetry
    makes equal, such as those of an ammonium's three hydrogens, the population is the mean."""
    probes = inputs.probes
    if not len(probes.hydrogen_bonds):
        missing = "H" not in probes.scene.elements
        why = "the trajectories hold no hydrogens" if missing else "no donor has an acceptor three bonds away"
        return left_out("Hydrogen bonds", why)
    formed = inputs.families("hydrogen_bonds")
    number = three_means(inputs, [[x.sum(axis=1, keepdims=True) for x in v] for v in formed])
    groups = equal_rows(probes.hydrogen_bonds, probes.classes)
    percent = [m.over(groups).times(100.0) for m in three_means(inputs, formed)]
    most = np.maximum(percent[0].values, percent[1].values)
    order = [int(k) for k in np.argsort(-most, kind="stable") if most[k] > 100.0 * _POPULATED]
    if not order:
        return left_out("Hydrogen bonds", "none is formed in more than 1 % of frames")
    labels = group_labels(probes.labels("hydrogen_bonds"), groups)
    tolerance = ONE_KJ_SHARE * float(number[0].values[0])
    count = Quantity("hydrogen_bonds", "populations", "Hydrogen bonds, mean number", "", tolerance, "± 1 kJ/mol")
    rows = [mean_row(inputs, count, number), shift_row(_HYDROGEN_BOND_SHIFT, percent, labels)]
    caption = (
        "Share of frames in which each is formed (H to acceptor below 2.5 Å, angle above 120°); of equal ones the mean."
    )
    shown = order[:_MAX_BARS]
    made = [m.estimates(shown) for m in percent]
    chart = bar_chart("structure", "Hydrogen bonds", caption, "frames / %", [labels[k] for k in shown], made)
    return Measured(rows, [chart])


def secondary_structure(inputs: ComparisonInput) -> Measured:
    """Return rows of the share of residues in helix and in strand by DSSP, and charts of both along the chain."""
    labels = inputs.probes.labels("secondary")
    if not labels:
        return left_out("Secondary structure", f"fewer than {LEAST_RESIDUES} residues have N, CA, C and O")
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    place = np.arange(1, len(labels) + 1, dtype=np.float64)
    caption = f"Share of frames by DSSP, with 95 % intervals. 1 is {labels[0]}, {len(labels)} is {labels[-1]}."
    for name, code in (("helix", HELIX), ("strand", STRAND)):
        percent = [[100.0 * (x == code) for x in v] for v in inputs.families("secondary")]
        means = three_means(inputs, [[x.mean(axis=1, keepdims=True) for x in v] for v in percent])
        metric = Quantity(f"secondary:{name}", "structure", f"Residues in {name} (DSSP)", "%", 5.0)
        rows.append(mean_row(inputs, metric, means))
        if not max(m.values[0] for m in means) > 0:
            skipped.append((f"Residues in {name}", "there are none in any frame"))
            continue
        lines = []
        for role, own in zip(ROLES, three_means(inputs, percent), strict=True):
            low, high = np.clip([(e.low, e.high) for e in own.estimates()], 0.0, 100.0).T
            band = (None, None) if role == "replicate" else (low, high)
            lines.append(Line(role, role, place, own.values, *band))
        charts.append(LineChart("structure", f"Residues in {name}", caption, "residue", "frames / %", tuple(lines)))
    return Measured(rows, charts, skipped)
