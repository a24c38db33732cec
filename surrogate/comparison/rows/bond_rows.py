"""Bond lengths and angles: means, widths, distributions, and the temperature that they vibrate at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.probes import MOST_HISTOGRAMS, equal_rows, evenly, group_labels, over_groups
from surrogate.comparison.measure.structure import CONSTRAINED_BELOW_NM, bond_label
from surrogate.comparison.read.stored_frames import angle_variance, length_error_nm
from surrogate.comparison.rows.block_means import Means, block_means, bounds, family_of, over_equal, shift_row
from surrogate.comparison.rows.charts import BarChart
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Sample,
    mean_distance,
    observable_row,
)
from systems.chemistry.validity import Geometry

FloatArray = npt.NDArray[np.float64]

BOND_RESOLUTION_ANGSTROM = 0.001
_BOND_SHIFT = Quantity(
    "bond_shift", "structure", "Largest shift of a mean bond length", "Å", 0.01, resolution=BOND_RESOLUTION_ANGSTROM
)
# The width of a harmonic bond goes with the root of the temperature: 5 % is 30 K at 300 K.
BOND_WIDTH_TOLERANCE = 0.05
_ANGLE_BINS = 50
_ANGLE_TOLERANCE_DEG = 1.0
_ANGLE_RESOLUTION_DEG = 0.05
_TEMPERATURE = "Temperature of vibrations"
_MOST_COLUMNS = 256
_TEMPERATURE_TOLERANCE = 0.03
_LEAST_VIBRATIONS = 3


def bond_rows(inputs: ComparisonInput) -> Measured:
    """Return rows on bond lengths (shift of means, widths, distributions), and a chart of all means."""
    pairs = np.asarray(inputs.geometry.bond_idx).reshape(-1, 2).tolist()
    if not pairs:
        return Measured()
    labels = [bond_label(inputs.scene, i, j) for i, j in pairs]
    moments = [_bond_moments(s, inputs.geometry) for s in inputs.samples]
    # What rounding alone may do counts as no vibration.
    least_nm = math.hypot(CONSTRAINED_BELOW_NM, 1.1 * length_error_nm(inputs.reference.features.grid_nm))
    rigid = ~(moments[0].std > 10 * least_nm)
    classes = (
        inputs.reference.features.probes.classes
        if inputs.reference.features.probes
        else np.arange(inputs.scene.n_atoms)
    )
    groups = equal_rows(np.asarray(pairs), classes)
    equal, names = [_over_groups(m, groups) for m in moments], group_labels(labels, groups)
    rows = [shift_row(inputs, _BOND_SHIFT, [m.means() for m in equal], names, _bond_words)]
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
                inputs,
                Quantity(
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
        lengths = [s.features.bonds_nm for s in inputs.samples]
        bins = [distributions.normal_bins([x[:, g] for x in lengths[0]]) for g in flexible]
        rows.append(mean_distance(inputs, lengths, bins, "bond_jsd", "Flexible bond lengths", "structure", flexible))
    return Measured(rows, [_means_chart(equal, names)])


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

    def means(self) -> Means:
        """Return the means without the widths."""
        return Means(self.mean, self.draws_mean, self.n_blocks)


def _bond_words(label: str, candidate: float, reference: float) -> str:
    percent = 100.0 * (candidate / reference - 1.0)
    return f"{label} bonds are {abs(percent):.1f} % {'long' if percent > 0 else 'short'}"


def _moment_sums(
    sample: Sample, segments: Sequence[npt.NDArray[np.floating]], centre: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return per block `(n_blocks, k)` how many values there are, and the sums of them and of their squares, of values
    about a `centre` and kept within limits."""
    n, first, second = (np.zeros((sample.blocks.n_blocks, segments[0].shape[1])) for _ in range(3))
    for piece in sample.blocks.pieces:
        values = segments[piece.segment][piece.start : piece.stop].astype(np.float64)
        finite = ~np.isnan(values)
        part = np.where(finite, np.clip(values, low, high) - centre, 0.0)
        n[piece.block] += finite.sum(0)
        first[piece.block] += part.sum(0)
        second[piece.block] += (part * part).sum(0)
    return n, first, second


def _bond_moments(sample: Sample, geometry: Geometry) -> _Moments:
    # Moments about the reference mean: plain ones would lose the width of a constrained bond to rounding.
    centre = 10.0 * np.asarray(geometry.bond_mean_nm, dtype=np.float64)
    lengths = [10.0 * x.astype(np.float64) for x in sample.features.bonds_nm]
    n, first, second = _moment_sums(sample, lengths, centre, centre - 0.5, centre + 0.5)
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


def _means_chart(moments: Sequence[_Moments], labels: Sequence[str]) -> BarChart:
    """Mean lengths less the reference's, with the 95 % interval of the candidate's, the furthest off first."""
    ref, cand, rep = moments
    shift = cand.mean - ref.mean
    order = np.argsort(-np.abs(np.nan_to_num(shift)), kind="stable")
    draws = cand.draws_mean - ref.draws_mean
    low, high = np.nanquantile(draws, [0.025, 0.975], axis=0) - np.nanmean(draws, axis=0)
    return BarChart(
        section="structure",
        title="Mean bond lengths, less the reference's",
        caption="The furthest off first; of bonds that the molecule's symmetry makes equal the mean.",
        y_label="length / Å",
        names=tuple(labels[k] for k in order),
        reference=np.zeros(len(order)),
        candidate=shift[order],
        replicate=(rep.mean - ref.mean)[order],
        candidate_low=(shift + low)[order],
        candidate_high=(shift + high)[order],
    )


def temperature_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of the reference's temperature times the median ratio of variances of bonds and angles to its own.

    A stiff coordinate's variance goes with the temperature (equipartition); bonds that are held by constraints are left
    out, and so are those that the rounding of the files makes vary more than the temperature does; of the others its
    part of the variance is taken off. A model that vibrates too much or too little reads as too hot or too cold.
    """
    columns = [_vibrations(s) for s in inputs.samples]
    limits = bounds(columns[0])
    spread = np.concatenate(columns[0]).std(axis=0)
    rounding = _rounding_variance(inputs, np.nanmean(np.concatenate(columns[0]), axis=0))
    loose = spread > 10 * CONSTRAINED_BELOW_NM
    moving = np.flatnonzero(loose & (spread**2 > 2.0 * rounding))
    if len(moving) < _LEAST_VIBRATIONS:
        hidden = loose.sum() >= _LEAST_VIBRATIONS
        why = "the rounding of the files hides how" if hidden else "fewer than three"
        return Measured(skipped=[(_TEMPERATURE, f"{why} bonds and angles vibrate")])
    chosen = np.array(evenly(moving.tolist(), _MOST_COLUMNS))
    found = [_variances(s, [x[:, chosen] for x in c], (limits[0][chosen], limits[1][chosen]), rounding[chosen])
             for s, c in zip(inputs.samples, columns, strict=True)]  # fmt: skip
    own = found[0][0]
    values = [inputs.temperature_k * float(np.median(v / own)) for v, _ in found]
    draws = [inputs.temperature_k * np.median(d / own, axis=1) for _, d in found]
    row = observable_row(
        inputs,
        Quantity(
            "temperature",
            "structure",
            f"{_TEMPERATURE}: {len(chosen)} bonds and angles, by the reference's widths",
            "K",
            _TEMPERATURE_TOLERANCE * inputs.temperature_k,
            tolerance_text=f"± {100 * _TEMPERATURE_TOLERANCE:g} %",
        ),
        values,
        draws,
        lambda c, r: f"bonds and angles vibrate as at {c:.0f} K instead of {r:.0f} K",
    )
    return Measured([row], [], [])


def _rounding_variance(inputs: ComparisonInput, means: FloatArray) -> FloatArray:
    """Return what rounding adds to the variance of every column `(k,)`: bond lengths (nm²), then angles (rad²)."""
    grid_nm, probes, bonds = (
        inputs.reference.features.grid_nm,
        inputs.reference.features.probes,
        inputs.geometry.bond_idx,
    )
    out = np.full(len(means), length_error_nm(grid_nm) ** 2)
    if probes is not None and grid_nm > 0:
        length = {frozenset(pair): r for pair, r in zip(bonds.tolist(), means.tolist(), strict=False)}
        arms = np.array([[length[frozenset((b, x))] for x in (a, c)] for a, b, c in probes.angles.tolist()])
        arms = arms.reshape(-1, 2)
        out[len(bonds) :] = angle_variance(arms[:, 0], arms[:, 1], means[len(bonds) :], grid_nm)
    return out


def _vibrations(sample: Sample) -> list[npt.NDArray[np.floating]]:
    """Return bond lengths (nm) and angles (rad) side by side, `(n, k)` per segment."""
    return [
        np.concatenate([bonds, angles], axis=1)
        for bonds, angles in zip(sample.features.bonds_nm, family_of(sample, "angles"), strict=True)
    ]


def _variances(
    sample: Sample,
    segments: Sequence[npt.NDArray[np.floating]],
    limits: tuple[FloatArray, FloatArray],
    rounding: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the variance of every column `(k,)` and its bootstrap draws `(n_draws, k)`, values kept within limits,
    less what `rounding` `(k,)` adds to it."""
    centre = 0.5 * (limits[0] + limits[1])
    n, first, second = _moment_sums(sample, segments, centre, *limits)

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
        return Measured(skipped=[("Bond angles", "no atom has two neighbours")])
    angles = [family_of(s, "angles") for s in inputs.samples]
    limits = bounds(angles[0])
    means = [block_means(s, v, limits) for s, v in zip(inputs.samples, angles, strict=True)]
    groups = equal_rows(probes.angles, probes.classes)
    drawn = evenly(groups, MOST_HISTOGRAMS)
    pooled = [over_equal(m, groups) for m in means]
    in_degrees = [Means(np.degrees(m.values), np.degrees(m.draws), m.n_blocks) for m in pooled]
    shift = shift_row(
        inputs,
        Quantity(
            "angle_shift",
            "structure",
            "Largest shift of a mean bond angle",
            "°",
            _ANGLE_TOLERANCE_DEG,
            resolution=_ANGLE_RESOLUTION_DEG,
        ),
        in_degrees,
        group_labels(probes.labels("angles"), groups),
        lambda label, c, r: f"the angle {label} is {abs(c - r):.1f}° too {'wide' if c > r else 'narrow'}",
    )
    bins = [distributions.normal_bins([x[:, g] for x in angles[0]], _ANGLE_BINS) for g in drawn]
    return Measured([shift, mean_distance(inputs, angles, bins, "angle_jsd", "Bond angles", "structure", drawn)])
