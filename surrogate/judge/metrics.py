"""From measured features to rows: what each metric is made of. The verdict on a row is given elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from surrogate.judge import distributions
from surrogate.judge.curves import BondLength
from surrogate.judge.distributions import RAMACHANDRAN_BINS, TORSION_BINS
from surrogate.judge.rows import Group, Row, Sample, Trio, distance_row, observable_row
from surrogate.judge.statistics import Estimate, difference_p, estimate
from surrogate.judge.structure import CONSTRAINED_BELOW_NM, bond_label
from systems import validity
from systems.validity import Geometry

FloatArray = npt.NDArray[np.float64]
Membership = Callable[[npt.NDArray[np.floating]], npt.NDArray[np.bool_]]

# A population within this factor is 1 kJ/mol away at 300 K.
ONE_KJ_FACTOR = math.exp(1.0 / (8.31446261815324e-3 * 300.0))
BOND_TOLERANCE_ANGSTROM = 0.01
BOND_RESOLUTION_ANGSTROM = 0.001

CHECKS: tuple[tuple[int, str, str, float], ...] = (
    (validity.NOT_FINITE, "all coordinates finite", "have coordinates that are not finite", 0.0),
    (validity.BOND_HALF_ANGSTROM, "every bond within 0.5 Å", "have a bond more than 0.5 Å off", 1e-3),
    (validity.BOND_20_PERCENT, "every bond within 20 %", "have a bond more than 20 % off", 1e-2),
    (validity.CLASH, "no clash", "have clashing atoms", 1e-3),
    (validity.CHIRALITY, "stereocentres kept", "have an inverted stereocentre", 1e-3),
    (validity.OMEGA, "peptide and double bonds kept", "have a peptide or double bond turned over", 1e-3),
    (validity.RING, "rings planar", "have a bent ring", 1e-3),
)
INVALID = validity.INVALID


def applicable_checks(geometry: Geometry) -> list[tuple[int, str, str, float]]:
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
    return [check for check in CHECKS if not nothing.get(check[0], False)]


def validity_rows(trio: Trio) -> list[Row]:
    """Return the share of frames that pass each check, in percent; a frame that is not finite passes none."""
    checks = applicable_checks(trio.geometry)
    rows = [
        _share_row(trio, mask | validity.NOT_FINITE, passing, failing, allowed, key=f"valid:{mask}")
        for mask, passing, failing, allowed in checks
    ]
    return [*rows, _share_row(trio, INVALID, "valid in every respect", "are invalid", 1e-3, key="valid:all")]


def _share_row(trio: Trio, mask: int, metric: str, failing: str, allowed: float, *, key: str) -> Row:
    made: list[Estimate] = []
    for sample in trio.samples:
        good = [(f & mask) == 0 for f in sample.features.flags]
        inside, total = distributions.block_occupancy(good, sample.blocks)
        value = 100.0 * inside.sum() / total.sum()
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        found = estimate(float(value), draws, sample.blocks.n_blocks)
        made.append(replace(found, low=max(found.low, 0.0), high=min(found.high, 100.0)))
    percent = 100.0 - made[1].value
    said = f"{percent:.2g} %" if percent < 99.5 else f"{percent:.1f} %"
    return Row(
        key=key,
        group="validity",
        metric=f"Frames with {metric}" if not metric.startswith("valid") else f"Frames {metric}",
        unit="%",
        kind="share",
        reference=made[0],
        candidate=made[1],
        replicate=made[2],
        ratio=None,
        p_value=math.nan,
        tolerance=100.0 * allowed,
        tolerance_text="all frames" if allowed == 0 else f"at least {100 * (1 - allowed):g} %, or as the reference",
        statement=f"{said} of frames {failing}",
    )


def bond_rows(trio: Trio) -> tuple[list[Row], list[BondLength]]:
    """Return rows on bond lengths (shift of means, widths, distributions), and the table behind them."""
    pairs = np.asarray(trio.geometry.bond_idx).reshape(-1, 2).tolist()
    if not pairs:
        return [], []
    labels = [bond_label(trio.scene, i, j) for i, j in pairs]
    moments = [_bond_moments(s) for s in trio.samples]
    table = [
        BondLength(labels[b], *(float(x) for m in moments for x in (m.mean[b], m.std[b]))) for b in range(len(labels))
    ]
    rigid = ~(moments[0].std > 10 * CONSTRAINED_BELOW_NM)
    rows = [_bond_shift_row(trio, moments, labels)]
    for chosen, name, tolerance, words in (
        (~rigid, "Bond-length width, flexible bonds", None, "within 20 % of the reference"),
        (rigid, "Bond-length width, constrained bonds", 0.02, "within 0.02 Å of the reference"),
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
                tolerance=0.2 * values[0] if tolerance is None else tolerance,
                tolerance_text=words,
                statement=lambda c, r, kind=kind: f"{kind} vary by {c:.3f} Å instead of {r:.3f} Å",  # type: ignore[misc]
                resolution=BOND_RESOLUTION_ANGSTROM,
            )
        )
    flexible = np.flatnonzero(~rigid)
    if len(flexible):
        rows.append(_bond_distance_row(trio, flexible))
    return rows, table


@dataclass(frozen=True, eq=False)
class _Moments:
    """Mean and standard deviation of each bond in Å `(n_bonds,)`, with bootstrap draws `(n_draws, n_bonds)`."""

    mean: FloatArray
    std: FloatArray
    draws_mean: FloatArray
    draws_std: FloatArray
    n_blocks: int


def _bond_moments(sample: Sample) -> _Moments:
    n_bonds = sample.features.bonds_nm[0].shape[1]
    n, first, second = (np.zeros((sample.blocks.n_blocks, n_bonds)) for _ in range(3))
    # Moments about a first guess: the plain second moment would lose the width of a constrained bond to rounding.
    guess = 10.0 * _finite_row(sample.features.bonds_nm)
    for piece in sample.blocks.pieces:
        part = 10.0 * sample.features.bonds_nm[piece.segment][piece.start : piece.stop].astype(np.float64) - guess
        finite = np.isfinite(part)
        part = np.where(finite, part, 0.0)
        n[piece.block] += finite.sum(0)
        first[piece.block] += part.sum(0)
        second[piece.block] += (part * part).sum(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = first.sum(0) / n.sum(0)
        std = np.sqrt(np.maximum(second.sum(0) / n.sum(0) - mean**2, 0.0))
        drawn = sample.weights @ n
        draws = sample.weights @ first / drawn
        draws_std = np.sqrt(np.maximum(sample.weights @ second / drawn - draws**2, 0.0))
    return _Moments(mean + guess, std, draws + guess, draws_std, sample.blocks.n_blocks)


def _finite_row(segments: Sequence[npt.NDArray[np.float32]]) -> FloatArray:
    for segment in segments:
        good = np.flatnonzero(np.isfinite(segment).all(1))
        if len(good):
            return np.asarray(segment[good[0]], dtype=np.float64)
    return np.zeros(segments[0].shape[1])


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
    smallest = 1.0
    for b in range(len(labels)):
        a = Estimate(float(cand.mean[b]), error=float(cand.draws_mean[:, b].std()), n_blocks=cand.n_blocks)
        r = Estimate(float(ref.mean[b]), error=float(ref.draws_mean[:, b].std()), n_blocks=ref.n_blocks)
        p = difference_p(a, r) if shift[b] > BOND_RESOLUTION_ANGSTROM else 1.0
        smallest = min(smallest, p) if math.isfinite(p) else smallest
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
        replicate=Estimate(float(floor[at]), n_blocks=rep.n_blocks),
        ratio=None,
        p_value=min(1.0, smallest * len(labels)) if math.isfinite(value) else math.nan,
        tolerance=BOND_TOLERANCE_ANGSTROM,
        tolerance_text=f"{BOND_TOLERANCE_ANGSTROM:g} Å",
        statement=words,
    )


def _bond_distance_row(trio: Trio, flexible: npt.NDArray[np.intp]) -> Row:
    bins = [
        distributions.reference_bins([s[:, b] for s in trio.reference.features.bonds_nm], tail=5e-4) for b in flexible
    ]
    counts = [
        np.stack(
            [
                distributions.block_counts([x[:, b] for x in s.features.bonds_nm], own, s.blocks)
                for b, own in zip(flexible, bins, strict=True)
            ],
            axis=1,
        )
        for s in trio.samples
    ]
    return distance_row(
        trio,
        counts,
        key="bond_jsd",
        group="structure",
        metric=f"Bond-length distance, mean of {len(flexible)} flexible bonds",
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
        tolerance_text="1 kJ/mol",
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
