"""Rows and charts of what touches what: contacts and hydrogen bonds, their numbers and single populations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from surrogate.judge.measure.equal_atoms import equal_rows, group_labels
from surrogate.judge.rows.block_means import Means, block_means, family_of, mean_row, over_equal, shift_row
from surrogate.judge.rows.charts import Chart, bar_chart
from surrogate.judge.rows.metrics import ONE_KJ_FACTOR
from surrogate.judge.rows.rows import Metric, Row, Trio

Skipped = tuple[str, str]

_COUNT, _KEPT = 3, 4
_POPULATED = 0.01
_MAX_ROWS = 4
_MAX_BARS = 24


def contact_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows of the number of contacts, the share of the reference's that is kept, the contact furthest off.

    A contact is two heavy atoms more than three bonds apart within 0.45 nm; in chains of five residues or more, two
    alpha carbons three or more residues apart within 0.8 nm. A contact of the reference is formed in more than half of
    its frames.
    """
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    if not len(probes.all_contacts):
        return [], [], [("Contacts", "no two heavy atoms are more than three bonds apart")]
    shape = [family_of(s, "shape") for s in trio.samples]
    means = [block_means(s, [x[:, [_COUNT, _KEPT]] for x in v]) for s, v in zip(trio.samples, shape, strict=True)]
    number = float(means[0].values[0])
    name = f"Contacts (of {len(probes.all_contacts)} possible), mean number"
    count = Metric("contacts", "populations", name, "", 0.05 * max(number, 1e-9), tolerance_text="± 5 %")
    rows = [mean_row(trio, count, means, 0, lambda c, r: f"{c:.3g} contacts are formed on average instead of {r:.3g}")]
    if len(probes.native):
        kept = Metric(
            "contacts_kept", "populations", f"The reference's {len(probes.native)} contacts, share kept", "", 0.03
        )
        rows.append(mean_row(trio, kept, means, 1, _kept))
    groups = equal_rows(probes.contacts, probes.classes)
    single = [over_equal(block_means(s, family_of(s, "contacts")), groups) for s in trio.samples]
    rows.append(
        shift_row(
            trio,
            Metric(
                "contact_shift", "populations", "Largest shift of a contact's probability", "", 0.05, resolution=1e-3
            ),
            single,
            group_labels(probes.labels("contacts"), groups),
            lambda label, c, r: f"the contact {label} is formed {100 * c:.3g} % of the time instead of {100 * r:.3g} %",
        )
    )
    return rows, [], []


def hydrogen_bond_rows(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows of the mean number of hydrogen bonds and of the most populated ones, and a chart of populations.

    Criterion: see `hydrogen_bonds.is_formed`. A bond is shown when the reference or the candidate forms it in more than
    1 % of frames. Of bonds that the molecule's symmetry makes equal, such as those of an ammonium's three hydrogens,
    the population is the mean.
    """
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    if not len(probes.hydrogen_bonds):
        missing = "H" not in probes.scene.elements
        why = "the trajectories hold no hydrogens" if missing else "no donor has an acceptor three bonds away"
        return [], [], [("Hydrogen bonds", why)]
    formed = [family_of(s, "hydrogen_bonds") for s in trio.samples]
    number = [
        block_means(s, [x.sum(axis=1, keepdims=True) for x in v]) for s, v in zip(trio.samples, formed, strict=True)
    ]
    groups = equal_rows(probes.hydrogen_bonds, probes.classes)
    single = [over_equal(block_means(s, v), groups) for s, v in zip(trio.samples, formed, strict=True)]
    labels = group_labels(probes.labels("hydrogen_bonds"), groups)
    rows: list[Row] = []
    if len(probes.hydrogen_bonds) > 1 and max(m.values[0] for m in number) > 0:
        tolerance = (1.0 - 1.0 / ONE_KJ_FACTOR) * float(number[0].values[0])
        name = "Hydrogen bonds, mean number"
        count = Metric("hydrogen_bonds", "populations", name, "", tolerance, tolerance_text="± 1 kJ/mol")
        rows.append(
            mean_row(
                trio, count, number, 0, lambda c, r: f"{c:.3g} hydrogen bonds are formed on average instead of {r:.3g}"
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
                trio,
                Metric(f"hydrogen_bond:{labels[k]}", "populations", name, "%", tolerance, tolerance_text="± 1 kJ/mol"),
                percent,
                k,
                _formed(labels[k]),
            )
        )
    skipped = [] if order else [("Single hydrogen bonds", "none is formed in more than 1 % of frames")]
    return rows, _chart(labels, percent, order[:_MAX_BARS]), skipped


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
