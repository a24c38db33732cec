"""Rows and charts of what touches what: contacts and hydrogen bonds, their numbers and single populations."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from surrogate.judge.measure.equal_atoms import equal_rows, group_labels
from surrogate.judge.rows.block_means import Means, block_means, family_of, over_equal, shift_row
from surrogate.judge.rows.charts import BarChart, Chart
from surrogate.judge.rows.metrics import ONE_KJ_FACTOR
from surrogate.judge.rows.rows import Row, Trio, observable_row

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
    rows = [
        _mean_row(trio, means, 0, "contacts", f"Contacts (of {len(probes.all_contacts)} possible), mean number",
                  "", 0.05 * max(float(means[0].values[0]), 1e-9), "± 5 %",
                  lambda c, r: f"{c:.3g} contacts are formed on average instead of {r:.3g}"),
    ]  # fmt: skip
    if len(probes.native):
        rows.append(
            _mean_row(trio, means, 1, "contacts_kept", f"The reference's {len(probes.native)} contacts, share kept",
                      "", 0.03, "± 0.03",
                      lambda c, r: f"{100 * c:.3g} % of the reference's contacts are formed instead of {100 * r:.3g} %")
        )  # fmt: skip
    groups = equal_rows(probes.contacts, probes.classes)
    single = [over_equal(block_means(s, family_of(s, "contacts")), groups) for s in trio.samples]
    rows.append(
        shift_row(
            trio,
            single,
            group_labels(probes.labels("contacts"), groups),
            key="contact_shift",
            group="populations",
            metric="Largest shift of a contact's probability",
            unit="",
            tolerance=0.05,
            resolution=1e-3,
            statement=lambda label, c, r: (
                f"the contact {label} is formed {100 * c:.3g} % of the time instead of {100 * r:.3g} %"
            ),
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
        rows.append(
            _mean_row(trio, number, 0, "hydrogen_bonds", "Hydrogen bonds, mean number", "",
                      (1.0 - 1.0 / ONE_KJ_FACTOR) * float(number[0].values[0]), "± 1 kJ/mol",
                      lambda c, r: f"{c:.3g} hydrogen bonds are formed on average instead of {r:.3g}")
        )  # fmt: skip
    most = np.maximum(single[0].values, single[1].values)
    order = [int(k) for k in np.argsort(-most, kind="stable") if most[k] > _POPULATED]
    percent = [Means(100 * m.values, 100 * m.draws, m.n_blocks) for m in single]
    for k in order[:_MAX_ROWS]:
        share = float(single[0].values[k])
        tolerance = 100.0 * min(share, 1.0 - share) * (1.0 - 1.0 / ONE_KJ_FACTOR)
        name = f"Hydrogen bond {labels[k]}"
        rows.append(
            _mean_row(
                trio, percent, k, f"hydrogen_bond:{labels[k]}", name, "%", tolerance, "± 1 kJ/mol", _formed(labels[k])
            )
        )
    skipped = [] if order else [("Single hydrogen bonds", "none is formed in more than 1 % of frames")]
    return rows, _chart(labels, single, order[:_MAX_BARS]), skipped


def _formed(label: str) -> Callable[[float, float], str]:
    return lambda c, r: f"the hydrogen bond {label} is formed {c:.3g} % of the time instead of {r:.3g} %"


def _mean_row(
    trio: Trio,
    means: Sequence[Means],
    k: int,
    key: str,
    metric: str,
    unit: str,
    tolerance: float,
    words: str,
    statement: Callable[[float, float], str],
) -> Row:
    return observable_row(
        trio,
        [float(m.values[k]) for m in means],
        [m.draws[:, k] for m in means],
        key=key,
        group="populations",
        metric=metric,
        unit=unit,
        tolerance=tolerance,
        tolerance_text=words,
        statement=statement,
    )


def _chart(labels: Sequence[str], single: Sequence[Means], order: Sequence[int]) -> list[Chart]:
    if not order:
        return []
    made = [m.estimates(order) for m in single]

    def pick(which: int, name: str) -> np.ndarray:
        return np.array([100.0 * getattr(e, name) for e in made[which]])

    return [
        BarChart(
            section="structure",
            title="Hydrogen bonds",
            caption="Share of frames in which each is formed (H to acceptor below 2.5 Å, angle above 120°); of equal "
            "ones the mean.",
            y_label="frames / %",
            names=tuple(labels[k] for k in order),
            reference=pick(0, "value"),
            candidate=pick(1, "value"),
            replicate=pick(2, "value"),
            reference_low=pick(0, "low"),
            reference_high=pick(0, "high"),
            candidate_low=pick(1, "low"),
            candidate_high=pick(1, "high"),
        )
    ]
