"""Rows of bond lengths: how far the means are off, how wide they vibrate, how their distributions differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import distributions
from surrogate.judge.measure.equal_atoms import MOST_HISTOGRAMS, equal_rows, evenly, group_labels, over_groups
from surrogate.judge.measure.statistics import Estimate, difference_p, estimate, mean_estimate
from surrogate.judge.measure.structure import CONSTRAINED_BELOW_NM, bond_label
from surrogate.judge.read.rounding import length_error_nm
from surrogate.judge.rows.curves import BondLength
from surrogate.judge.rows.rows import Metric, Row, Sample, Trio, distance_row, observable_row, truth_of
from systems.chemistry.validity import Geometry

FloatArray = npt.NDArray[np.float64]

BOND_TOLERANCE_ANGSTROM = 0.01
BOND_RESOLUTION_ANGSTROM = 0.001
# The width of a harmonic bond goes with the root of the temperature: 5 % is 30 K at 300 K.
BOND_WIDTH_TOLERANCE = 0.05


def bond_rows(trio: Trio) -> tuple[list[Row], list[BondLength]]:
    """Return rows on bond lengths (shift of means, widths, distributions), and the table behind them."""
    pairs = np.asarray(trio.geometry.bond_idx).reshape(-1, 2).tolist()
    if not pairs:
        return [], []
    labels = [bond_label(trio.scene, i, j) for i, j in pairs]
    moments = [_bond_moments(s, trio.geometry) for s in trio.samples]
    table = [
        BondLength(labels[b], *(float(x) for m in moments for x in (m.mean[b], m.std[b]))) for b in range(len(labels))
    ]
    # What rounding alone may do counts as no vibration.
    least_nm = math.hypot(CONSTRAINED_BELOW_NM, 1.1 * length_error_nm(trio.reference.features.grid_nm))
    rigid = ~(moments[0].std > 10 * least_nm)
    classes = (
        trio.reference.features.probes.classes if trio.reference.features.probes else np.arange(trio.scene.n_atoms)
    )
    groups = equal_rows(np.asarray(pairs), classes)
    rows = [_bond_shift_row(trio, [_over_groups(m, groups) for m in moments], group_labels(labels, groups))]
    for chosen, name, tolerance, words in (
        (~rigid, "Bond-length width, flexible bonds", None, "± 5 %"),
        (rigid, "Bond-length width, constrained bonds", 0.02, "± 0.02 Å"),
    ):
        if not chosen.any():
            continue
        values = [float(np.sqrt((m.std[chosen] ** 2).mean())) for m in moments]
        draws = [np.sqrt((m.draws_std[:, chosen] ** 2).mean(1)) for m in moments]
        kind = name.split(", ")[1]
        rows.append(
            observable_row(
                trio,
                Metric(
                    f"bond_width:{kind}",
                    "structure",
                    name,
                    "Å",
                    BOND_WIDTH_TOLERANCE * values[0] if tolerance is None else tolerance,
                    tolerance_text=words,
                    resolution=BOND_RESOLUTION_ANGSTROM,
                ),
                values,
                draws,
                lambda c, r, kind=kind: f"{kind} vary by {c:.3f} Å instead of {r:.3f} Å",  # type: ignore[misc]
            )
        )
    flexible = evenly([g for g in groups if not rigid[g].any()], MOST_HISTOGRAMS)
    if flexible:
        rows.append(_bond_distance_row(trio, flexible))
    return rows, table


@dataclass(frozen=True, eq=False)
class _Moments:
    """Mean and standard deviation of each bond in Å `(n_bonds,)`, with bootstrap draws `(n_draws, n_bonds)`.

    Deviations from the reference mean count as at most 0.5 Å: an exploded frame is the validity checks' to report, and
    must not drown what the other frames say.
    """

    mean: FloatArray
    std: FloatArray
    draws_mean: FloatArray
    draws_std: FloatArray
    n_blocks: int


def _bond_moments(sample: Sample, geometry: Geometry) -> _Moments:
    n_bonds = sample.features.bonds_nm[0].shape[1]
    n, first, second = (np.zeros((sample.blocks.n_blocks, n_bonds)) for _ in range(3))
    # Moments about the reference mean: plain ones would lose the width of a constrained bond to rounding.
    centre = 10.0 * np.asarray(geometry.bond_mean_nm, dtype=np.float64)
    for piece in sample.blocks.pieces:
        lengths = sample.features.bonds_nm[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = ~np.isnan(lengths)
        part = np.where(finite, np.clip(10.0 * lengths - centre, -0.5, 0.5), 0.0)
        n[piece.block] += finite.sum(0)
        first[piece.block] += part.sum(0)
        second[piece.block] += (part * part).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = first.sum(0) / n.sum(0)
        std = np.sqrt(np.maximum(second.sum(0) / n.sum(0) - mean**2, 0.0))
        drawn = sample.weights @ n
        draws = sample.weights @ first / drawn
        draws_std = np.sqrt(np.maximum(sample.weights @ second / drawn - draws**2, 0.0))
    return _Moments(mean + centre, std, draws + centre, draws_std, sample.blocks.n_blocks)


def _over_groups(moments: _Moments, groups: Sequence[npt.NDArray[np.intp]]) -> _Moments:
    """The moments of bonds that the molecule's symmetry makes equal, averaged."""
    mean, std, draws_mean, draws_std = (
        over_groups(x, groups) for x in (moments.mean, moments.std, moments.draws_mean, moments.draws_std)
    )
    return _Moments(mean, std, draws_mean, draws_std, moments.n_blocks)


def _bond_shift_row(trio: Trio, moments: Sequence[_Moments], labels: Sequence[str]) -> Row:
    """The bond whose mean is farthest off; significance is corrected for having looked at all bonds."""
    ref, cand, rep = moments
    shift = np.abs(cand.mean - ref.mean)
    if not np.isfinite(shift).any():
        worst, value = 0, math.nan
    else:
        worst = int(np.nanargmax(shift))
        value = float(shift[worst])
    n_blocks = min(ref.n_blocks, cand.n_blocks)
    signed = cand.draws_mean[:, worst] - ref.draws_mean[:, worst]
    found = estimate(value, signed * np.sign(cand.mean[worst] - ref.mean[worst]), n_blocks)
    p_value, p_replicate = _least_p(ref, cand, rep)
    floor = np.abs(rep.mean - ref.mean)
    at = int(np.nanargmax(floor)) if np.isfinite(floor).any() else 0
    percent = 100.0 * (cand.mean[worst] / ref.mean[worst] - 1.0)
    words = f"{labels[worst]} bonds are {abs(percent):.1f} % {'long' if percent > 0 else 'short'}"
    return Row(
        key="bond_shift",
        group="structure",
        metric=f"Largest shift of a mean bond length: {labels[worst]}",
        unit="Å",
        kind="distance",
        reference=None,
        candidate=replace(found, low=max(found.low, 0.0)),
        replicate=Estimate(float(floor[at]), error=float((rep.draws_mean - ref.draws_mean)[:, at].std())),
        ratio=None,
        p_value=p_value if math.isfinite(value) else math.nan,
        p_replicate=p_replicate,
        tolerance=BOND_TOLERANCE_ANGSTROM,
        tolerance_text=f"≤ {BOND_TOLERANCE_ANGSTROM:g} Å",
        statement=words,
    )


def _least_p(ref: _Moments, cand: _Moments, rep: _Moments) -> tuple[float, float]:
    """The least p-value over bonds times their number, for the candidate and for the replicate."""
    n_bonds = len(ref.mean)
    least = [1.0, 1.0]
    for b in range(n_bonds):
        r, c, other = (mean_estimate(float(m.mean[b]), m.draws_mean[:, b], m.n_blocks) for m in (ref, cand, rep))
        both = truth_of(r, other)
        for k, (x, y) in enumerate(((c, both), (other, r))):
            if abs(x.value - y.value) > BOND_RESOLUTION_ANGSTROM:
                least[k] = min(least[k], difference_p(x, y) * n_bonds)
    return least[0], least[1]


def _bond_distance_row(trio: Trio, flexible: Sequence[npt.NDArray[np.intp]]) -> Row:
    measured = [s.features.bonds_nm for s in trio.samples]
    bins = [distributions.normal_bins([x[:, g] for x in measured[0]]) for g in flexible]
    counts = [
        np.stack([distributions.grouped_counts(v, g, own, s.blocks) for g, own in zip(flexible, bins, strict=True)], 1)
        for s, v in zip(trio.samples, measured, strict=True)
    ]
    return distance_row(
        trio,
        counts,
        key="bond_jsd",
        group="structure",
        metric=f"Bond-length distance, mean of {sum(map(len, flexible))} flexible bonds",
        statement=lambda ratio: f"bond-length distributions are {ratio:.3g} times as far off as a replicate's",
    )
