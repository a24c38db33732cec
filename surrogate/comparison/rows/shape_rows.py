"""The whole molecule: size and shape, contacts, hydrogen bonds, secondary structure, RMSD and torsions along time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.probes import (
    COIL,
    HELIX,
    LEAST_RESIDUES,
    STRAND,
    equal_rows,
    group_labels,
)
from surrogate.comparison.rows.block_means import (
    Means,
    block_means,
    bounds,
    column,
    family_of,
    mean_row,
    over_equal,
    shift_row,
)
from surrogate.comparison.rows.charts import ROLES, BarChart, Chart, Line, LineChart, bar_chart
from surrogate.comparison.rows.rows import (
    ONE_KJ_FACTOR,
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    Series,
    Skipped,
    histogram,
    observable_row,
    series_distance,
)

FloatArray = npt.NDArray[np.float64]

_MAX_DRAWN = 60
_RG, _RMSD, _ENDS = 0, 1, 2
_CONTACTS, _KEPT = 3, 4
_POPULATED = 0.01
_MAX_ROWS = 4
_MAX_BARS = 24
_MOST_POINTS = 400
_LEAST_IN_NS_PS = 2000.0
_MOST_RESIDUES = 2
_SECONDARY_TOLERANCE = 5.0
_MOST_NAMED = 12


def shape_rows(inputs: ComparisonInput) -> Measured:
    """Return rows and charts of radius of gyration, RMSD, RMSF and end-to-end distance."""
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = [*probes.left_out]
    rows += _length_rows(inputs, _RG, "rg", "Radius of gyration", 0.02, charts)
    rows += _length_rows(inputs, _RMSD, "rmsd", "RMSD from the reference's mean structure", None, charts)
    if probes.ends is not None:
        names = " to ".join(probes.scene.atom_names[i] for i in probes.ends)
        rows += _length_rows(inputs, _ENDS, "end_to_end", f"End-to-end distance ({names})", 0.03, charts)
    else:
        skipped.append(("End-to-end distance", "no two heavy atoms are four bonds apart"))
    fluctuation, chart = _fluctuation(inputs)
    rows.append(fluctuation)
    charts.append(chart)
    return Measured(rows, charts, skipped)


def _in_angstrom(inputs: ComparisonInput, k: int) -> Series:
    return [[10.0 * x for x in column(family_of(s, "shape"), k)] for s in inputs.samples]


def _length_rows(
    inputs: ComparisonInput, k: int, key: str, name: str, tolerance: float | None, charts: list[Chart]
) -> list[Row]:
    """The distribution of a length, and its mean where there is a relative `tolerance` to hold it to."""
    series = _in_angstrom(inputs, k)
    bins = distributions.reference_bins(series[0])
    rows = [series_distance(inputs, series, bins, f"{key}_jsd", name, "structure")]
    charts.append(histogram(inputs, series, bins, name, "Å"))
    if tolerance is None:
        return rows
    limits = bounds([x[:, None] for x in series[0]])
    means = [block_means(s, [x[:, None] for x in v], limits) for s, v in zip(inputs.samples, series, strict=True)]
    low = name[0].lower() + name[1:]
    mean = mean_row(
        inputs,
        Quantity(
            f"{key}_mean",
            "structure",
            f"{name}, mean",
            "Å",
            tolerance * float(means[0].values[0]),
            tolerance_text=f"± {100 * tolerance:g} %",
        ),
        means,
        0,
        lambda c, r: f"the {low} is {c:.3g} Å on average instead of {r:.3g} Å",
    )
    return [mean, *rows]


def _fluctuation(inputs: ComparisonInput) -> tuple[Row, Chart]:
    """RMSF about the reference's mean structure after superposition: its root mean square, and one bar per atom, or for
    all of a kind that the molecule's symmetry makes equal.

    Every trajectory is laid over the same mean structure, so that a shifted mean shows as well as another spread.
    """
    probes = inputs.reference.features.probes
    assert probes is not None
    deviation = [family_of(s, "deviation") for s in inputs.samples]
    limits = bounds(deviation[0])
    means = [block_means(s, v, limits) for s, v in zip(inputs.samples, deviation, strict=True)]

    def rms(squared: FloatArray) -> FloatArray:
        return 10.0 * np.sqrt(squared.mean(axis=-1))

    row = observable_row(
        inputs,
        Quantity("rmsf", "structure", "RMSF over all fitted atoms", "Å", 0.1, relative=True),
        [float(rms(m.values)) for m in means],
        [rms(m.draws) for m in means],
        lambda c, r: f"atoms fluctuate by {c:.3g} Å instead of {r:.3g} Å (RMSF)",
    )
    groups = equal_rows(probes.fit_idx[:, None], probes.classes)
    means = [over_equal(m, groups) for m in means]
    labels = group_labels(probes.labels("deviation"), groups)
    shown = np.unique(np.linspace(0, len(groups) - 1, _MAX_DRAWN).astype(int))
    bands = [[10.0 * np.sqrt(np.maximum(np.nanquantile(m.draws[:, shown], q, axis=0), 0.0)) for q in (0.025, 0.975)]
             for m in means]  # fmt: skip
    values = [10.0 * np.sqrt(m.values[shown]) for m in means]
    chart = BarChart(
        section="structure",
        title="RMSF",
        caption="Root mean square distance of each atom from the reference's mean structure, frames superposed on it.",
        y_label="RMSF / Å",
        names=tuple(labels[k] for k in shown),
        reference=values[0],
        candidate=values[1],
        replicate=values[2],
        reference_low=bands[0][0],
        reference_high=bands[0][1],
        candidate_low=bands[1][0],
        candidate_high=bands[1][1],
    )
    return row, chart


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
        return Measured(skipped=[("Contacts", "no two heavy atoms are more than three bonds apart")])
    shape = [family_of(s, "shape") for s in inputs.samples]
    means = [block_means(s, [x[:, [_CONTACTS, _KEPT]] for x in v]) for s, v in zip(inputs.samples, shape, strict=True)]
    number = float(means[0].values[0])
    name = f"Contacts (of {len(probes.all_contacts)} possible), mean number"
    count = Quantity("contacts", "populations", name, "", 0.05 * max(number, 1e-9), tolerance_text="± 5 %")
    rows = [
        mean_row(inputs, count, means, 0, lambda c, r: f"{c:.3g} contacts are formed on average instead of {r:.3g}")
    ]
    if len(probes.native):
        kept = Quantity(
            "contacts_kept", "populations", f"The reference's {len(probes.native)} contacts, share kept", "", 0.03
        )
        rows.append(mean_row(inputs, kept, means, 1, _kept))
    groups = equal_rows(probes.contacts, probes.classes)
    single = [over_equal(block_means(s, family_of(s, "contacts")), groups) for s in inputs.samples]
    rows.append(
        shift_row(
            inputs,
            Quantity(
                "contact_shift", "populations", "Largest shift of a contact's probability", "", 0.05, resolution=1e-3
            ),
            single,
            group_labels(probes.labels("contacts"), groups),
            lambda label, c, r: f"the contact {label} is formed {100 * c:.3g} % of the time instead of {100 * r:.3g} %",
        )
    )
    return Measured(rows, [], [])


def hydrogen_bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the mean number of hydrogen bonds and of the most populated ones, and a chart of populations.

    Criterion: see `hydrogen_bonds.is_formed`. A bond is shown when the reference or the candidate forms it in more than
    1 % of frames. Of bonds that the molecule's symmetry makes equal, such as those of an ammonium's three hydrogens,
    the population is the mean.
    """
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not len(probes.hydrogen_bonds):
        missing = "H" not in probes.scene.elements
        why = "the trajectories hold no hydrogens" if missing else "no donor has an acceptor three bonds away"
        return Measured(skipped=[("Hydrogen bonds", why)])
    formed = [family_of(s, "hydrogen_bonds") for s in inputs.samples]
    number = [
        block_means(s, [x.sum(axis=1, keepdims=True) for x in v]) for s, v in zip(inputs.samples, formed, strict=True)
    ]
    groups = equal_rows(probes.hydrogen_bonds, probes.classes)
    single = [over_equal(block_means(s, v), groups) for s, v in zip(inputs.samples, formed, strict=True)]
    labels = group_labels(probes.labels("hydrogen_bonds"), groups)
    rows: list[Row] = []
    if len(probes.hydrogen_bonds) > 1 and max(m.values[0] for m in number) > 0:
        tolerance = (1.0 - 1.0 / ONE_KJ_FACTOR) * float(number[0].values[0])
        name = "Hydrogen bonds, mean number"
        count = Quantity("hydrogen_bonds", "populations", name, "", tolerance, tolerance_text="± 1 kJ/mol")
        rows.append(
            mean_row(
                inputs,
                count,
                number,
                0,
                lambda c, r: f"{c:.3g} hydrogen bonds are formed on average instead of {r:.3g}",
            )
        )
    most = np.maximum(single[0].values, single[1].values)
    order = [int(k) for k in np.argsort(-most, kind="stable") if most[k] > _POPULATED]
    percent = [Means(100 * m.values, 100 * m.draws, m.n_blocks) for m in single]
    for k in order[:_MAX_ROWS]:
        share = float(single[0].values[k])
        tolerance = 100.0 * min(share, 1.0 - share) * (1.0 - 1.0 / ONE_KJ_FACTOR)
        name = f"Hydrogen bond {labels[k]}"
        rows.append(
            mean_row(
                inputs,
                Quantity(
                    f"hydrogen_bond:{labels[k]}", "populations", name, "%", tolerance, tolerance_text="± 1 kJ/mol"
                ),
                percent,
                k,
                _formed(labels[k]),
            )
        )
    skipped = [] if order else [("Single hydrogen bonds", "none is formed in more than 1 % of frames")]
    return Measured(rows, _chart(labels, percent, order[:_MAX_BARS]), skipped)


def _kept(candidate: float, reference: float) -> str:
    return f"{100 * candidate:.3g} % of the reference's contacts are formed instead of {100 * reference:.3g} %"


def _formed(label: str) -> Callable[[float, float], str]:
    return lambda c, r: f"the hydrogen bond {label} is formed {c:.3g} % of the time instead of {r:.3g} %"


def _chart(labels: Sequence[str], percent: Sequence[Means], order: Sequence[int]) -> list[Chart]:
    if not order:
        return []
    caption = (
        "Share of frames in which each is formed (H to acceptor below 2.5 Å, angle above 120°); of equal ones the mean."
    )
    made = [m.estimates(order) for m in percent]
    return [bar_chart("structure", "Hydrogen bonds", caption, "frames / %", [labels[k] for k in order], made)]


def along_time(inputs: ComparisonInput) -> Measured:
    """Return charts of the RMSD and of phi and psi along the first segment of each trajectory, every k-th frame."""
    charts: list[Chart] = []
    if inputs.reference.features.probes is not None:
        rmsd = [10.0 * family_of(s, "shape")[0][:, _RMSD].astype(np.float64) for s in inputs.samples]
        charts.append(_series_chart(inputs, rmsd, "RMSD along time", "RMSD / Å"))
    for residue in inputs.torsions.residues[:_MOST_RESIDUES]:
        for symbol, k, pick in (("φ", residue.phi, "phi"), ("ψ", residue.psi, "psi")):
            angles = [np.degrees(getattr(s.features, pick)[0][:, k].astype(np.float64)) for s in inputs.samples]
            charts.append(_series_chart(inputs, angles, f"{symbol} of {residue.label} along time", f"{symbol} / °"))
    return Measured(charts=charts)


def _series_chart(inputs: ComparisonInput, values: Sequence[FloatArray], title: str, y_label: str) -> LineChart:
    shortest = min(map(len, values))
    step = max(1, -(-shortest // _MOST_POINTS))
    lag_ps = inputs.reference.features.lag_ps
    unit, scale = ("ns", 1e-3) if shortest * lag_ps >= _LEAST_IN_NS_PS else ("ps", 1.0)
    lines = []
    for role, series in zip(ROLES, values, strict=True):
        y: FloatArray = series[:shortest:step]
        lines.append(Line(role, role, np.arange(len(y), dtype=np.float64) * step * lag_ps * scale, y))
    return LineChart(
        section="structure",
        title=title,
        caption=f"First segment of each trajectory, one frame in {step}." if step > 1 else "First segment of each.",
        x_label=f"time / {unit}",
        y_label=y_label,
        lines=tuple(lines),
        dots=True,
    )


def secondary_structure(inputs: ComparisonInput) -> Measured:
    """Return rows of the share of residues in helix and in strand, and charts of helix, strand and coil residue by
    residue, with 95 % intervals. By DSSP (`measure.probes.secondary_structure`); peptides of five residues and more."""
    probes = inputs.reference.features.probes
    if probes is None:
        return Measured()
    if not probes.chains.labels:
        return Measured(skipped=[("Secondary structure", f"fewer than {LEAST_RESIDUES} residues have N, CA, C and O")])
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    for name, code in (("helix", HELIX), ("strand", STRAND), ("coil", COIL)):
        percent = [[100.0 * (x == code) for x in family_of(s, "secondary")] for s in inputs.samples]
        if code != COIL:
            share = [[x.mean(axis=1, keepdims=True) for x in v] for v in percent]
            means = [block_means(s, v) for s, v in zip(inputs.samples, share, strict=True)]
            metric = Quantity(f"secondary:{name}", "structure", f"Residues in {name} (DSSP)", "%", _SECONDARY_TOLERANCE)
            rows.append(mean_row(inputs, metric, means, 0, _in_words(name)))
        each = [block_means(s, v) for s, v in zip(inputs.samples, percent, strict=True)]
        if any((m.values > 0).any() for m in each):
            charts.append(_residue_chart(f"Residues in {name}", probes.chains.labels, each))
        else:
            skipped.append((f"Residues in {name}", "there are none in any frame"))
    return Measured(rows, charts, skipped)


def _in_words(name: str) -> Callable[[float, float], str]:
    return lambda c, r: f"{c:.3g} % of residues are in {name} instead of {r:.3g} %"


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
