"""Frames that are molecules: every check of every frame, faults along time, and potential energies."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.movie import pick_frames
from surrogate.comparison.measure.statistics import Estimate, estimate, excess_p
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.block_means import block_means, bounds, mean_row
from surrogate.comparison.rows.charts import ROLES, Chart, Histogram, Line, LineChart
from surrogate.comparison.rows.rows import ComparisonInput, Measured, Quantity, Row, Skipped
from systems.chemistry import validity
from systems.chemistry.validity import Geometry
from systems.units import GAS_CONSTANT_KJ_MOL_K

TORN_NM = 0.25
WHOLE_KEY = "valid:whole"
FloatArray = npt.NDArray[np.float64]
# Positions `(n_atoms, 3)` nm of one frame to kJ/mol; not finite where the frame has none.
EnergyFn = Callable[[FloatArray], float]

_ENERGY = "Potential energy"
N_ENERGIES = 400
_HIGH_QUANTILE = 0.99
_BINS = 40
_MOST_BINS, _MOST_PLACES = 240, 4096


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


def validity_rows(inputs: ComparisonInput) -> Measured:
    """Return the share of frames that pass each check, in percent; a frame that is not finite passes none. Charts of
    faults along time and along chunks, where there are any."""
    rows = [_share_row(inputs, check, f"valid:{check.mask}") for check in applicable_checks(inputs.geometry)]
    if len(inputs.geometry.bond_idx):
        rows.append(_share_row(inputs, _WHOLE, WHOLE_KEY, torn=True))
    charts, skipped = _fault_charts(inputs)
    return Measured([*rows, _share_row(inputs, _ALL, "valid:all")], charts, skipped)


def _fault_charts(inputs: ComparisonInput) -> tuple[list[Chart], list[Skipped]]:
    """Share of faulty frames of each trajectory that has any: along all frames in order, and by place in the chunk."""
    along: list[Line] = []
    in_chunk: list[Line] = []
    for sample, role in zip(inputs.samples, ROLES, strict=True):
        features = sample.features
        flags = np.concatenate(list(features.flags))
        invalid = (flags & validity.INVALID) != 0
        strained = ((flags & validity.BOND_20_PERCENT) != 0) & ~invalid
        edges = np.unique(np.linspace(0, len(flags), min(len(flags), _MOST_BINS) + 1).astype(int))
        for name, of in ((role, invalid), (f"{role}, a bond 20 % off and else valid", strained)):
            if of.any():
                share = np.add.reduceat(of.astype(float), edges[:-1]) / np.diff(edges)
                middle = 0.5 * (edges[1:] + edges[:-1]) * features.lag_ps
                along.append(Line(name, role if of is invalid else "other", middle, 100.0 * share))
        if invalid.any() and features.chunk_idx is not None:
            place = places_in_chunk(features)
            known = place >= 0
            of_all = np.bincount(place[known])
            bad = np.bincount(place[known & invalid], minlength=len(of_all))
            if 1 < len(of_all) <= _MOST_PLACES and bad.any():
                x = np.arange(len(of_all), dtype=np.float64)
                in_chunk.append(Line(role, role, x, 100.0 * bad / np.maximum(of_all, 1)))
    charts: list[Chart] = []
    caption = "Share of frames that are invalid, segments end to end; dotted: else valid, but a bond 20 % off."
    if along:
        charts.append(LineChart("validity", "Faults along time", caption, "time / ps", "frames / %", tuple(along)))
    if in_chunk:
        title, caption = "Invalid frames by place in the chunk", "Frames counted from the start of each chunk."
        charts.append(LineChart("validity", title, caption, "frame in chunk", "frames / %", tuple(in_chunk)))
    return charts, [] if along else [("Faults along time", "no frame has any")]


def places_in_chunk(features: Features) -> npt.NDArray[np.int64]:
    """Return the place of each frame in its chunk `(n,)`, segments end to end; -1 outside of chunks."""
    if features.chunk_idx is None:
        return np.full(features.n_frames, -1, dtype=np.int64)
    chunk = np.concatenate(list(features.chunk_idx))
    new = np.concatenate([[True], chunk[1:] != chunk[:-1]])
    new[np.concatenate([[0], np.cumsum(features.segment_lengths)[:-1]])] = True
    at = np.arange(len(chunk))
    return np.where(chunk >= 0, at - np.maximum.accumulate(np.where(new, at, 0)), -1)


def is_torn(bonds_nm: npt.NDArray[np.floating], geometry: Geometry) -> npt.NDArray[np.bool_]:
    """Return for bond lengths `(n_frames, n_bonds)` whether the molecule came apart: a bond 2.5 Å too long.

    Source: the dissociation rule of MLIPAudit (a hydrogen 2.5 Å from its partner), applied to every bond.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((bonds_nm > np.asarray(geometry.bond_mean_nm) + TORN_NM).any(1))


def _share_row(inputs: ComparisonInput, check: Check, key: str, *, torn: bool = False) -> Row:
    mask = check.mask | validity.NOT_FINITE
    made: list[Estimate] = []
    failing_frames: list[int] = []
    n_frames: list[int] = []
    for sample in inputs.samples:
        good = [(f & mask) == 0 for f in sample.features.flags]
        if torn:
            whole = [~is_torn(b, inputs.geometry) for b in sample.features.bonds_nm]
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
        found_bad = np.concatenate([is_torn(b, inputs.geometry) for b in inputs.candidate.features.bonds_nm])
    else:
        found_bad = (np.concatenate(list(inputs.candidate.features.flags)) & check.mask) != 0
    percent = 100.0 * float(found_bad.mean())
    said = f"{percent:.2g} %" if percent < 99.5 else f"{percent:.1f} %"
    return Row(
        key=key,
        group="validity",
        metric=f"Frames {check.passing}" if check is _ALL else f"Frames with {check.passing}",
        unit="%",
        form="share",
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


def measure_energies(ensemble: Ensemble, energy_fn: EnergyFn, n: int = N_ENERGIES) -> list[FloatArray]:
    """Return the energies of every k-th frame of each segment `(n_frames,)` kJ/mol, NaN for those between.

    k is chosen so that about `n` are computed. A frame whose energy is not finite, or higher than can be told from
    that, has infinity.
    """
    stride = max(1, ensemble.n_frames // n)
    out = [np.full(length, np.nan) for length in ensemble.segment_lengths]
    starts = np.concatenate([[0], np.cumsum(ensemble.segment_lengths)])
    for segment, values in enumerate(out):
        idx = np.arange(0, len(values), stride, dtype=np.int64)
        if not len(idx):
            continue
        frames = pick_frames(ensemble.segments, idx + starts[segment]).astype(np.float64)
        found = np.array([energy_fn(x) if np.isfinite(x).all() else np.inf for x in frames])
        values[idx] = np.where(np.isfinite(found), found, np.inf)
    return out


def energy_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the mean energy and of the share of frames above the reference's 99 % quantile; a histogram."""
    measured = [s.features.energy_kj for s in inputs.samples]
    if any(m is None for m in measured):
        return Measured(skipped=[(_ENERGY, "no energy function was given")])
    series: list[Sequence[FloatArray]] = [m for m in measured if m is not None]
    known = [np.concatenate([x[~np.isnan(x)] for x in m]) for m in series]
    finite = known[0][np.isfinite(known[0])]
    if len(finite) < 20:
        return Measured(skipped=[(_ENERGY, "fewer than 20 energies of the reference are finite")])
    columns = [[x[:, None] for x in m] for m in series]
    low, high = bounds([c[np.isfinite(c[:, 0])] for c in columns[0]])
    # An exploded frame counts as the edge of these limits; only what was not computed is left out.
    cut = [[np.where(np.isposinf(c), high, c) for c in m] for m in columns]
    means = [block_means(s, c, (low, high)) for s, c in zip(inputs.samples, cut, strict=True)]
    limit = float(np.quantile(finite, _HIGH_QUANTILE))
    above = [[np.where(np.isnan(c), np.nan, 100.0 * (c > limit)) for c in m] for m in columns]
    shares = [block_means(s, a) for s, a in zip(inputs.samples, above, strict=True)]
    thermal_kj = GAS_CONSTANT_KJ_MOL_K * inputs.temperature_k
    rows = [
        mean_row(
            inputs,
            Quantity(
                "energy_mean",
                "structure",
                f"{_ENERGY}, mean over {len(known[1])} frames",
                "kJ/mol",
                thermal_kj,
                tolerance_text="± RT",
            ),
            means,
            0,
            lambda c, r: f"the potential energy is {abs(c - r):.3g} kJ/mol too {'high' if c > r else 'low'}",
        ),
        mean_row(
            inputs,
            Quantity(
                "energy_high", "structure", f"Frames above {limit:.5g} kJ/mol, the reference's 99 % quantile", "%", 2.0
            ),
            shares,
            0,
            lambda c, r: f"{c:.2g} % of frames have an energy that {r:.2g} % of the reference reaches",
        ),
    ]
    return Measured(rows, [_histogram(known)])


def _histogram(known: Sequence[FloatArray]) -> Histogram:
    """Densities from the reference's least energy to twice its range: where a poor candidate lies can be seen."""
    finite = known[0][np.isfinite(known[0])]
    low, span = float(finite.min()), max(float(np.ptp(finite)), 1e-6)
    edges = np.linspace(low - 0.2 * span, low + 2.0 * span, _BINS + 1)
    densities, outside = [], []
    for values in known:
        counts = np.histogram(values[np.isfinite(values)], bins=edges)[0]
        densities.append(counts / max(len(values), 1) / (edges[1] - edges[0]))
        outside.append(1.0 - float(counts.sum()) / max(len(values), 1))
    ref, cand, rep = densities
    return Histogram(_ENERGY, "kJ/mol", edges, ref, cand, rep, (outside[0], outside[1], outside[2]), section="validity")
