"""From measured features to rows: what each metric is made of. The verdict on a row is given elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.judge import distributions
from surrogate.judge.block_means import equal_rows, group_labels, over_groups
from surrogate.judge.curves import BondLength
from surrogate.judge.distributions import RAMACHANDRAN_BINS, TORSION_BINS
from surrogate.judge.rows import Group, Row, Sample, Trio, distance_row, observable_row
from surrogate.judge.statistics import Estimate, difference_p, estimate, excess_p, mean_estimate, pooled
from surrogate.judge.structure import CONSTRAINED_BELOW_NM, bond_label
from systems import validity
from systems.validity import Geometry

FloatArray = npt.NDArray[np.float64]
Membership = Callable[[npt.NDArray[np.floating]], npt.NDArray[np.bool_]]

# A population within this factor is 1 kJ/mol away at 300 K.
ONE_KJ_FACTOR = math.exp(1.0 / (8.31446261815324e-3 * 300.0))
BOND_TOLERANCE_ANGSTROM = 0.01
BOND_RESOLUTION_ANGSTROM = 0.001
# The width of a harmonic bond goes with the root of the temperature: 5 % is 30 K at 300 K.
BOND_WIDTH_TOLERANCE = 0.05
TORN_NM = 0.25
WHOLE_KEY = "valid:whole"


class Check(NamedTuple):
    """One per-frame rule: its bit, passing and failing in words, the share of frames that may fail.

    `by_chance`: whether thermal motion reaches it now and then, so that a few faults may be chance.
    """

    mask: int
    passing: str
    failing: str
    allowed: float
    by_chance: bool


CHECKS = (
    Check(validity.NOT_FINITE, "all coordinates finite", "have coordinates that are not finite", 0.0, False),
    Check(validity.BOND_HALF_ANGSTROM, "every bond within 0.5 Å", "have a bond more than 0.5 Å off", 1e-3, False),
    Check(validity.BOND_20_PERCENT, "every bond within 20 %", "have a bond more than 20 % off", 1e-2, True),
    Check(validity.CLASH, "no clash", "have clashing atoms", 1e-3, True),
    Check(validity.CHIRALITY, "stereocentres kept", "have an inverted stereocentre", 1e-3, False),
    Check(validity.OMEGA, "peptide and double bonds kept", "have a peptide or double bond turned over", 1e-3, False),
    Check(validity.RING, "rings planar", "have a bent ring", 1e-3, False),
)
_WHOLE = Check(0, "the molecule in one piece", "have a molecule that came apart (a bond 2.5 Å too long)", 0.0, False)
_ALL = Check(validity.INVALID, "valid in every respect", "are invalid", 1e-3, True)


def applicable_checks(geometry: Geometry) -> list[Check]:
    """Return the checks that this scene can fail; a check without anything to check is skipped."""
    n_pairs = geometry.n_atoms * (geometry.n_atoms - 1) // 2
    nothing = {
        validity.BOND_HALF_ANGSTROM: not len(geometry.bond_idx),
        validity.BOND_20_PERCENT: not len(geometry.bond_idx),
        validity.CLASH: len(geometry.near_keys) >= n_pairs,
        validity.CHIRALITY: not len(geometry.stereo_idx),
        validity.OMEGA: not len(geometry.omega_idx),
        validity.RING: not len(geometry.ring_idx),
    }
    return [check for check in CHECKS if not nothing.get(check.mask, False)]


def validity_rows(trio: Trio) -> list[Row]:
    """Return the share of frames that pass each check, in percent; a frame that is not finite passes none."""
    rows = [_share_row(trio, check, f"valid:{check.mask}") for check in applicable_checks(trio.geometry)]
    if len(trio.geometry.bond_idx):
        rows.append(_share_row(trio, _WHOLE, WHOLE_KEY, torn=True))
    return [*rows, _share_row(trio, _ALL, "valid:all")]


def is_torn(bonds_nm: npt.NDArray[np.floating], geometry: Geometry) -> npt.NDArray[np.bool_]:
    """Return for bond lengths `(n_frames, n_bonds)` whether the molecule came apart: a bond 2.5 Å too long.

    Source: the dissociation rule of MLIPAudit (a hydrogen 2.5 Å from its partner), applied to every bond.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((bonds_nm > np.asarray(geometry.bond_mean_nm) + TORN_NM).any(1))


def _share_row(trio: Trio, check: Check, key: str, *, torn: bool = False) -> Row:
    mask = check.mask | validity.NOT_FINITE
    made: list[Estimate] = []
    failing_frames: list[int] = []
    for sample in trio.samples:
        good = [(f & mask) == 0 for f in sample.features.flags]
        if torn:
            whole = [~is_torn(b, trio.geometry) for b in sample.features.bonds_nm]
            good = [a & b for a, b in zip(good, whole, strict=True)]
        inside, total = distributions.block_occupancy(good, sample.blocks)
        value = 100.0 * inside.sum() / total.sum()
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        found = estimate(float(value), draws, sample.blocks.n_blocks)
        failing_frames.append(round(float(total.sum() - inside.sum())))
        made.append(replace(found, low=max(found.low, 0.0), high=min(found.high, 100.0)))
    # Frames that are not finite fail every check; the sentence counts what this one finds beyond the reference.
    if torn:
        found_bad = np.concatenate([is_torn(b, trio.geometry) for b in trio.candidate.features.bonds_nm])
    else:
        found_bad = (np.concatenate(list(trio.candidate.features.flags)) & check.mask) != 0
    percent = 100.0 * float(found_bad.mean())
    said = f"{percent:.2g} %" if percent < 99.5 else f"{percent:.1f} %"
    return Row(
        key=key,
        group="validity",
        metric=f"Frames {check.passing}" if check is _ALL else f"Frames with {check.passing}",
        unit="%",
        kind="share",
        reference=made[0],
        candidate=made[1],
        replicate=made[2],
        ratio=None,
        p_value=excess_p(failing_frames[1], failing_frames[0] + failing_frames[2], 1.0 / 3.0)
        if check.by_chance
        else math.nan,
        p_replicate=math.nan,
        tolerance=100.0 * check.allowed,
        tolerance_text=f"≥ {100 * (1 - check.allowed):g} %, or as the reference" if check.allowed else "all frames",
        statement=f"{said} of frames {check.failing}" if percent > 100.0 - made[0].value else "",
    )


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
    rigid = ~(moments[0].std > 10 * CONSTRAINED_BELOW_NM)
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
                values,
                draws,
                key=f"bond_width:{kind}",
                group="structure",
                metric=name,
                unit="Å",
                tolerance=BOND_WIDTH_TOLERANCE * values[0] if tolerance is None else tolerance,
                tolerance_text=words,
                statement=lambda c, r, kind=kind: f"{kind} vary by {c:.3f} Å instead of {r:.3f} Å",  # type: ignore[misc]
                resolution=BOND_RESOLUTION_ANGSTROM,
            )
        )
    flexible = [g for g in groups if not rigid[g].any()]
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
        both = pooled(r, other) if math.isfinite(other.value) else r
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


def population_rows(trio: Trio) -> list[Row]:
    """Return the populations of the psi basins and of phi > 0, in percent of all frames."""
    rows = []
    for k, label in enumerate(trio.torsions.psi_labels):
        for name, member in (("β", distributions.is_beta), ("α", distributions.is_alpha)):
            rows.append(_population_row(trio, "psi", k, member, f"ψ in the {name} basin", label))
    for k, label in enumerate(trio.torsions.phi_labels):
        rows.append(_population_row(trio, "phi", k, distributions.is_positive, "φ > 0", label))
    return rows


def _population_row(
    trio: Trio,
    torsion: str,
    k: int,
    member: Callable[[npt.NDArray[np.floating]], npt.NDArray[np.bool_]],
    name: str,
    label: str,
) -> Row:
    values, draws = [], []
    for sample in trio.samples:
        series = sample.features.psi if torsion == "psi" else sample.features.phi
        inside, total = distributions.block_occupancy([member(s[:, k]) for s in series], sample.blocks)
        values.append(100.0 * float(inside.sum() / total.sum()))
        draws.append(100.0 * (sample.weights @ inside) / (sample.weights @ total))
    share = values[0] / 100.0

    def statement(candidate: float, reference: float) -> str:
        if candidate == 0.0:
            return f"{name} of {label} is never visited (reference {reference:.3g} %)"
        return f"{name} of {label} holds {candidate:.3g} % instead of {reference:.3g} %"

    return observable_row(
        trio,
        values,
        draws,
        key=f"population:{name}:{label}",
        group="populations",
        metric=f"{name}, {label}",
        unit="%",
        tolerance=100.0 * min(share, 1.0 - share) * (1.0 - 1.0 / ONE_KJ_FACTOR),
        tolerance_text="± 1 kJ/mol",
        statement=statement,
    )


def torsion_rows(trio: Trio) -> list[Row]:
    """Return Jensen-Shannon distances: jointly per residue (50 x 50 bins), then phi and psi alone (100 bins)."""
    rows = []
    for residue in trio.torsions.residues:
        counts = [
            distributions.block_counts_joint(
                [x[:, residue.phi] for x in s.features.phi],
                [x[:, residue.psi] for x in s.features.psi],
                RAMACHANDRAN_BINS,
                s.blocks,
            )
            for s in trio.samples
        ]
        rows.append(_jsd_row(trio, counts, "joint_jsd", "Joint φ/ψ", residue.label, "distributions"))
    for symbol, labels, pick in (
        ("φ", trio.torsions.phi_labels, lambda s: s.features.phi),
        ("ψ", trio.torsions.psi_labels, lambda s: s.features.psi),
    ):
        for k, label in enumerate(labels):
            counts = [
                distributions.block_counts([x[:, k] for x in pick(s)], TORSION_BINS, s.blocks) for s in trio.samples
            ]
            key = "phi_jsd" if symbol == "φ" else "psi_jsd"
            rows.append(_jsd_row(trio, counts, key, symbol, label, "distributions"))
    return rows


def _jsd_row(trio: Trio, counts: Sequence[FloatArray], key: str, what: str, label: str, group: Group) -> Row:
    def statement(ratio: float) -> str:
        return f"the {what} distribution of {label} is {ratio:.2g} times as far from the reference as a replicate's"

    return distance_row(
        trio, counts, key=f"{key}:{label}", group=group, metric=f"{what} distance, {label}", statement=statement
    )
