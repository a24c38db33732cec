"""Frames that are molecules: every check of every frame; and frames that are copies of others."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.statistics import BoolArray, Estimate, estimate, excess_p
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Row,
    Skipped,
    left_out,
)
from systems.chemistry import validity
from systems.chemistry.validity import Geometry

TORN_NM = 0.25
# Frames are compared by so many angles, on a grid in rad.
_KEY_COLUMNS, _GRID = 6, 1e-3
# Copies are named from this share on; a candidate of which so much is the reference's own is not compared.
_NAMED_SHARE, _MOSTLY = 0.01, 0.5


class Check(NamedTuple):
    """One per-frame rule: its bit, passing and failing in words, the share of frames that may fail, and whether thermal
    motion reaches it now and then, so that a few faults may be chance."""

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


def unchecked(geometry: Geometry) -> dict[int, Skipped]:
    """Return the checks, by their bit, that have nothing to look at in this scene, and why."""
    n_pairs = geometry.n_atoms * (geometry.n_atoms - 1) // 2
    none = "none among the atoms compared"
    found = (
        (validity.BOND_HALF_ANGSTROM, len(geometry.bond_idx), ("Bond lengths", none)),
        (validity.BOND_20_PERCENT, len(geometry.bond_idx), ("Bond lengths", none)),
        (
            validity.CLASH,
            n_pairs - len(geometry.near_keys),
            ("Clashes", "no two atoms are more than three bonds apart"),
        ),
        (validity.CHIRALITY, len(geometry.stereo_idx), ("Stereocentres", none)),
        (validity.OMEGA, len(geometry.omega_idx), ("Peptide and double bonds", none)),
        (validity.RING, len(geometry.ring_idx), ("Planar rings", none)),
    )
    return {mask: words for mask, n, words in found if n <= 0}


def validity_rows(inputs: ComparisonInput) -> Measured:
    """Return the share of frames that pass each check, in percent; a frame that is not finite passes none."""
    nothing = unchecked(inputs.geometry)
    rows = [_share_row(inputs, check, f"valid:{check.mask}") for check in CHECKS if check.mask not in nothing]
    if len(inputs.geometry.bond_idx):
        rows.append(_share_row(inputs, _WHOLE, "valid:whole"))
    return Measured([*rows, _share_row(inputs, _ALL, "valid:all")], skipped=list(dict.fromkeys(nothing.values())))


def is_torn(bonds_nm: npt.NDArray[np.floating], geometry: Geometry) -> BoolArray:
    """Return for bond lengths `(n_frames, n_bonds)` whether the molecule came apart: a bond 2.5 Å too long, as in
    MLIPAudit's rule of dissociation."""
    with np.errstate(invalid="ignore"):
        return np.asarray((bonds_nm > np.asarray(geometry.bond_mean_nm) + TORN_NM).any(1))


def _share_row(inputs: ComparisonInput, check: Check, key: str) -> Row:
    made: list[Estimate] = []
    failing: list[int] = []
    percent = 0.0
    for sample in inputs.samples:
        f = sample.features
        if check is _WHOLE:
            bad = [is_torn(b, inputs.geometry) for b in f.bonds_nm]
        else:
            bad = [(x & check.mask) != 0 for x in f.flags]
        if sample is inputs.candidate:
            # The sentence counts what this check finds.
            percent = 100.0 * float(np.concatenate(bad).mean())
        # Frames that are not finite fail every check.
        good = [~b & ((x & validity.NOT_FINITE) == 0) for b, x in zip(bad, f.flags, strict=True)]
        inside, total = distributions.block_occupancy(good, sample.blocks)
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        found = estimate(float(100.0 * inside.sum() / total.sum()), draws, sample.blocks.n_blocks)
        failing.append(round(float(total.sum() - inside.sum())))
        made.append(replace(found, low=max(found.low, 0.0), high=min(found.high, 100.0)))
    said = f"{percent:.2g} %" if percent < 99.5 else f"{percent:.1f} %"
    n_frames = [s.features.n_frames for s in inputs.samples]
    p = excess_p(failing[1], failing[0] + failing[2], n_frames[1] / sum(n_frames)) if check.by_chance else math.nan
    return Row(
        key=key,
        group="validity",
        metric=f"Frames {check.passing}" if check is _ALL else f"Frames with {check.passing}",
        unit="%",
        form="share",
        reference=made[0],
        candidate=made[1],
        replicate=made[2],
        p_value=p,
        tolerance=100.0 * check.allowed,
        tolerance_text=f"≥ {100 * (1 - check.allowed):g} %, or as the reference" if check.allowed else "all frames",
        statement=f"{said} of frames {check.failing}" if percent > 100.0 - made[0].value else "",
    )


def frame_keys(features: Features, k: int = 0) -> npt.NDArray[np.void] | None:
    """Return a number per frame `(n,)` that copies share, whatever was rotated, shifted or converted in between, or
    whichever of equal hydrogens was called the first: a few torsions on a grid of 0.06°, bond angles as well where
    there are fewer than three; None where there are too few of both. NaN frames are no copies of each other, nor of
    those of trajectories of another `k`."""
    torsions, angles = (features.series[f] for f in ("torsions", "angles")) if features.series else ((), ())
    every = np.concatenate([np.concatenate(list(v)) for v in (features.phi, features.psi, torsions) if v], axis=1)
    if every.shape[1] < 3 and angles:
        every = np.concatenate([every, np.concatenate(list(angles))], axis=1)
    if every.shape[1] < 3:
        return None
    chosen = np.unique(np.linspace(0, every.shape[1] - 1, _KEY_COLUMNS).astype(int))
    grid = np.round(every[:, chosen].astype(np.float64) / _GRID)
    broken = ~np.isfinite(grid).all(axis=1)
    grid[broken] = 1e9 * (k + 1) + np.arange(int(broken.sum()))[:, None]
    keys = np.ascontiguousarray(grid.astype(np.int64))
    return keys.view(np.dtype((np.void, keys.dtype.itemsize * keys.shape[1])))[:, 0]


def copy_rows(inputs: ComparisonInput) -> Measured:
    """Return the row of frames that are copies of others of the same trajectory, where any has one in a hundred."""
    name = "Frames that are copies of others"
    keys = [k for s in inputs.samples if (k := frame_keys(s.features)) is not None]
    if len(keys) < 3:
        return left_out(name, "fewer than three angles tell frames apart")
    shares = [1.0 - len(np.unique(k)) / len(k) for k in keys]
    if max(shares) < _NAMED_SHARE:
        return left_out(name, "fewer than one frame in a hundred is one")
    percent = [Estimate(100.0 * x, n_blocks=s.blocks.n_blocks) for x, s in zip(shares, inputs.samples, strict=True)]
    still = shares[1] > 1.0 - 1.5 / inputs.candidate.features.n_frames
    said = f"{100 * shares[1]:.3g} % of frames are copies of other frames"
    row = Row(
        key="copies",
        group="validity",
        metric=name,
        unit="%",
        form="observable",
        reference=percent[0],
        candidate=Estimate(math.nan) if still else percent[1],
        replicate=percent[2],
        p_value=0.0 if shares[1] - max(shares[0], shares[2]) >= _NAMED_SHARE else 1.0,
        p_replicate=0.0 if abs(shares[2] - shares[0]) >= _NAMED_SHARE else 1.0,
        tolerance=100.0 * _NAMED_SHARE,
        tolerance_text=f"+ {100 * _NAMED_SHARE:g} %",
        statement="every frame is the same: it does not move" if still else said,
    )
    return Measured([row])


def copied_from(inputs: ComparisonInput) -> tuple[str, list[str]]:
    """Return why there is nothing to evaluate, where most of the candidate's frames are the reference's own; and notes
    on frames that any two of the three have in common."""
    ref, cand, rep = (frame_keys(s.features, k) for k, s in enumerate(inputs.samples))
    if ref is None or cand is None or rep is None:
        return "", []
    why, notes = "", []
    for source, keys in (("reference", ref), ("replicate", rep)):
        share = float(np.isin(cand, keys).mean())
        said = f"{100 * share:.3g} % of its frames are frames of the {source}"
        if share >= _MOSTLY:
            why = why or f"{said}, so that nothing is compared"
        elif share >= _NAMED_SHARE:
            notes.append(f"{inputs.candidate.features.label}: {said}.")
    share = float(np.isin(rep, ref).mean())
    if share >= _NAMED_SHARE:
        notes.append(
            f"{100 * share:.3g} % of the replicate's frames are the reference's: the two are not independent, and the "
            "replicate baseline is too low."
        )
    return why, notes
