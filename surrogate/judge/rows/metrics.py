"""From measured features to rows: what each metric is made of. The verdict on a row is given elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import distributions
from surrogate.judge.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS
from surrogate.judge.measure.equal_atoms import MOST_HISTOGRAMS, evenly
from surrogate.judge.measure.statistics import Estimate, estimate, excess_p
from surrogate.judge.measure.structure import Residue
from surrogate.judge.rows.block_means import block_means, shift_row
from surrogate.judge.rows.rare_states import free_energy_row, rare_residues, without_positive_phi
from surrogate.judge.rows.rows import Group, Metric, Row, Sample, Trio, distance_row, observable_row
from systems.chemistry import validity
from systems.chemistry.validity import Geometry
from systems.units import GAS_CONSTANT_KJ_MOL_K

FloatArray = npt.NDArray[np.float64]

# A population within this factor is 1 kJ/mol away at 300 K.
ONE_KJ_FACTOR = math.exp(1.0 / (GAS_CONSTANT_KJ_MOL_K * 300.0))
TORN_NM = 0.25
WHOLE_KEY = "valid:whole"
# More residues than this, and they share rows: means over all, and the one that is furthest off.
FEW_RESIDUES = 12
MOST_MAPS = 16
_POPULATION_TOLERANCE = 5.0


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
    n_frames: list[int] = []
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
        n_frames.append(sample.features.n_frames)
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
        p_value=excess_p(failing_frames[1], failing_frames[0] + failing_frames[2], n_frames[1] / sum(n_frames))
        if check.by_chance
        else math.nan,
        p_replicate=math.nan,
        tolerance=100.0 * check.allowed,
        tolerance_text=f"≥ {100 * (1 - check.allowed):g} %, or as the reference" if check.allowed else "all frames",
        statement=f"{said} of frames {check.failing}" if percent > 100.0 - made[0].value else "",
    )


def are_many(trio: Trio) -> bool:
    """Whether residues are too many for rows of their own."""
    return max(len(trio.torsions.phi), len(trio.torsions.psi)) > FEW_RESIDUES


def population_rows(trio: Trio) -> list[Row]:
    """Return the populations of the psi basins and of phi > 0, in percent of all frames, where that is rare its free
    energy; of many residues only the one that is furthest off."""
    if are_many(trio):
        return [_largest_population_shift(trio)]
    rows, rare = [], rare_residues(trio)
    for k, label in enumerate(trio.torsions.psi_labels):
        for name, member in (("β", distributions.is_beta), ("α", distributions.is_alpha)):
            rows.append(_population_row(trio, "psi", k, member, f"ψ in the {name} basin", label))
    for k, label in enumerate(trio.torsions.phi_labels):
        if k in rare:
            rows.append(free_energy_row(trio, k, label))
        else:
            rows.append(_population_row(trio, "phi", k, distributions.is_positive, "φ > 0", label))
    return rows


def _largest_population_shift(trio: Trio) -> Row:
    labels = [f"ψ in the β basin, {x}" for x in trio.torsions.psi_labels]
    labels += [f"φ > 0, {x}" for x in trio.torsions.phi_labels]
    means = [
        block_means(
            sample,
            [
                100.0 * np.concatenate([distributions.is_beta(psi), distributions.is_positive(phi)], axis=1)
                for phi, psi in zip(sample.features.phi, sample.features.psi, strict=True)
            ],
        )
        for sample in trio.samples
    ]
    return shift_row(
        trio,
        Metric(
            "population_shift",
            "populations",
            "Largest shift of a basin's population",
            "%",
            _POPULATION_TOLERANCE,
            resolution=0.1,
        ),
        means,
        labels,
        lambda label, c, r: f"{label}: {c:.3g} % of frames instead of {r:.3g} %",
    )


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
        Metric(
            f"population:{name}:{label}",
            "populations",
            f"{name}, {label}",
            "%",
            100.0 * min(share, 1.0 - share) * (1.0 - 1.0 / ONE_KJ_FACTOR),
            tolerance_text="± 1 kJ/mol",
        ),
        values,
        draws,
        statement,
    )


def torsion_rows(trio: Trio) -> list[Row]:
    """Return Jensen-Shannon distances: jointly per residue (50 x 50 bins), then phi and psi alone (100 bins); of many
    residues their means. Where phi > 0 is rare it is left out of the map and of phi."""
    if are_many(trio):
        return _mean_torsion_rows(trio)
    rows, rare = [], rare_residues(trio)
    for residue in trio.torsions.residues:
        counts = [_joint_counts(s, residue) for s in trio.samples]
        what = "Joint φ/ψ"
        if residue.phi in rare:
            counts, what = [without_positive_phi(c, RAMACHANDRAN_BINS.n) for c in counts], f"{what} at φ < 0"
        rows.append(_jsd_row(trio, counts, "joint_jsd", what, residue.label, "distributions"))
    for symbol, labels, pick in (
        ("φ", trio.torsions.phi_labels, lambda s: s.features.phi),
        ("ψ", trio.torsions.psi_labels, lambda s: s.features.psi),
    ):
        for k, label in enumerate(labels):
            counts = [
                distributions.block_counts([x[:, k] for x in pick(s)], TORSION_BINS, s.blocks) for s in trio.samples
            ]
            key, what = "phi_jsd" if symbol == "φ" else "psi_jsd", symbol
            if symbol == "φ" and k in rare:
                counts, what = [without_positive_phi(c, TORSION_BINS.n) for c in counts], f"{symbol} at φ < 0"
            rows.append(_jsd_row(trio, counts, key, what, label, "distributions"))
    return rows


def _joint_counts(sample: Sample, residue: Residue) -> FloatArray:
    phi, psi = (
        [x[:, k] for x in series]
        for series, k in ((sample.features.phi, residue.phi), (sample.features.psi, residue.psi))
    )
    return distributions.block_counts_joint(phi, psi, RAMACHANDRAN_BINS, sample.blocks)


def _mean_torsion_rows(trio: Trio) -> list[Row]:
    rows = []
    residues = evenly(trio.torsions.residues, MOST_MAPS)
    if residues:
        counts = [np.stack([_joint_counts(s, r) for r in residues], axis=1) for s in trio.samples]
        rows.append(
            _jsd_row(trio, counts, "joint_jsd", "Joint φ/ψ", f"mean of {len(residues)} residues", "distributions")
        )
    for symbol, key, pick in (("φ", "phi_jsd", lambda s: s.features.phi), ("ψ", "psi_jsd", lambda s: s.features.psi)):
        columns = evenly(range(pick(trio.reference)[0].shape[1]), MOST_HISTOGRAMS)
        if columns:
            counts = [
                np.stack(
                    [distributions.block_counts([x[:, k] for x in pick(s)], TORSION_BINS, s.blocks) for k in columns], 1
                )
                for s in trio.samples
            ]
            rows.append(_jsd_row(trio, counts, key, symbol, f"mean of {len(columns)} residues", "distributions"))
    return rows


def _jsd_row(trio: Trio, counts: Sequence[FloatArray], key: str, what: str, label: str, group: Group) -> Row:
    def statement(ratio: float) -> str:
        return f"the {what} distribution of {label} is {ratio:.2g} times as far from the reference as a replicate's"

    return distance_row(
        trio, counts, key=f"{key}:{label}", group=group, metric=f"{what} distance, {label}", statement=statement
    )
