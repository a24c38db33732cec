"""Frames that are molecules: every check of every frame, faults along time, potential energies; and frames that are
copies of others."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import distributions
from surrogate.comparison.measure.statistics import BoolArray, Estimate, FloatArray, IntArray, estimate, excess_p
from surrogate.comparison.measure.structure import Features
from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import ROLES, Chart, Histogram, Line, LineChart
from surrogate.comparison.rows.rows import (
    ComparisonInput,
    Measured,
    Quantity,
    Row,
    block_means,
    bounds,
    left_out,
    mean_row,
    three_means,
)
from systems.chemistry import validity
from systems.chemistry.validity import Geometry
from systems.units import GAS_CONSTANT_KJ_MOL_K

TORN_NM = 0.25
WHOLE_KEY = "valid:whole"
# Positions `(n_atoms, 3)` nm of one frame to kJ/mol; not finite where the frame has none.
EnergyFn = Callable[[FloatArray], float]

_ENERGY = "Potential energy"
N_ENERGIES = 400
_HIGH_QUANTILE = 0.99
_BINS = 40
_MOST_BINS, _MOST_PLACES = 240, 4096
# Of what tells frames apart: so many angles, on a grid in rad.
_KEY_COLUMNS, _GRID = 6, 1e-3
# Copies are named from this share on; a candidate of which so much is the reference's own is not compared.
_NAMED_SHARE, _MOSTLY = 0.01, 0.5


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
        rows.append(_share_row(inputs, _WHOLE, WHOLE_KEY))
    probes = inputs.reference.features.probes
    whole = probes is None or probes.whole
    none = "the scene has none" if whole else "atoms that it needs are not in all files: not checked"
    possible = {
        validity.BOND_HALF_ANGSTROM: ("Bond lengths", "the scene has no bonds"),
        validity.CLASH: ("Clashes", "no two atoms are more than three bonds apart"),
        validity.CHIRALITY: ("Stereocentres", none),
        validity.OMEGA: ("Peptide and double bonds", none),
        validity.RING: ("Planar rings", none),
    }
    done = {check.mask for check in applicable_checks(inputs.geometry)}
    charts = _fault_charts(inputs)
    skipped = [words for mask, words in possible.items() if mask not in done]
    skipped += [] if charts else [("Faults along time", "no frame has any")]
    return Measured([*rows, _share_row(inputs, _ALL, "valid:all")], charts, skipped)


def _fault_charts(inputs: ComparisonInput) -> list[Chart]:
    """Share of faulty frames of each trajectory that has any: along all frames in order, and by place in the chunk."""
    along: list[Line] = []
    in_chunk: list[Line] = []
    for sample, role in zip(inputs.samples, ROLES, strict=True):
        flags = np.concatenate(list(sample.features.flags))
        invalid = (flags & validity.INVALID) != 0
        strained = ((flags & validity.BOND_20_PERCENT) != 0) & ~invalid
        edges = np.unique(np.linspace(0, len(flags), min(len(flags), _MOST_BINS) + 1).astype(int))
        middle = 0.5 * (edges[1:] + edges[:-1]) * inputs.lag_ps
        for name, of in ((role, invalid), (f"{role}, a bond 20 % off and else valid", strained)):
            if of.any():
                share = np.add.reduceat(of.astype(float), edges[:-1]) / np.diff(edges)
                along.append(Line(name, role if of is invalid else "other", middle, 100.0 * share))
        place = places_in_chunk(sample.features)
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
    return charts


def places_in_chunk(features: Features) -> IntArray:
    """Return the place of each frame in its chunk `(n,)`, segments end to end; -1 outside of chunks."""
    if features.chunk_idx is None:
        return np.full(features.n_frames, -1, dtype=np.int64)
    chunk = np.concatenate(list(features.chunk_idx))
    new = np.concatenate([[True], chunk[1:] != chunk[:-1]])
    new[np.concatenate([[0], np.cumsum(features.segment_lengths)[:-1]])] = True
    at = np.arange(len(chunk))
    return np.where(chunk >= 0, at - np.maximum.accumulate(np.where(new, at, 0)), -1)


def is_torn(bonds_nm: npt.NDArray[np.floating], geometry: Geometry) -> BoolArray:
    """Return for bond lengths `(n_frames, n_bonds)` whether the molecule came apart: a bond 2.5 Å too long.

    Source: the dissociation rule of MLIPAudit (a hydrogen 2.5 Å from its partner), applied to every bond.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((bonds_nm > np.asarray(geometry.bond_mean_nm) + TORN_NM).any(1))


def _share_row(inputs: ComparisonInput, check: Check, key: str) -> Row:
    made: list[Estimate] = []
    failing: list[int] = []
    for sample in inputs.samples:
        f = sample.features
        # Frames that are not finite fail every check.
        good = [(x & (check.mask | validity.NOT_FINITE)) == 0 for x in f.flags]
        if check is _WHOLE:
            good = [a & ~is_torn(b, inputs.geometry) for a, b in zip(good, f.bonds_nm, strict=True)]
        inside, total = distributions.block_occupancy(good, sample.blocks)
        value = 100.0 * inside.sum() / total.sum()
        draws = 100.0 * (sample.weights @ inside) / (sample.weights @ total)
        found = estimate(float(value), draws, sample.blocks.n_blocks)
        failing.append(round(float(total.sum() - inside.sum())))
        made.append(replace(found, low=max(found.low, 0.0), high=min(found.high, 100.0)))
    # The sentence counts what this check finds.
    own = inputs.candidate.features
    if check is _WHOLE:
        found_bad = np.concatenate([is_torn(b, inputs.geometry) for b in own.bonds_nm])
    else:
        found_bad = (np.concatenate(list(own.flags)) & check.mask) != 0
    percent = 100.0 * float(found_bad.mean())
    said = f"{percent:.2g} %" if percent < 99.5 else f"{percent:.1f} %"
    share = own.n_frames / sum(s.features.n_frames for s in inputs.samples)
    return Row(
        key=key,
        group="validity",
        metric=f"Frames {check.passing}" if check is _ALL else f"Frames with {check.passing}",
        unit="%",
        form="share",
        reference=made[0],
        candidate=made[1],
        replicate=made[2],
        p_value=excess_p(failing[1], failing[0] + failing[2], share) if check.by_chance else math.nan,
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
    for segment, values in zip(ensemble.segments, out, strict=True):
        frames = np.asarray(segment[::stride], dtype=np.float64)
        found = np.array([energy_fn(x) if np.isfinite(x).all() else np.inf for x in frames])
        values[::stride] = np.where(np.isfinite(found), found, np.inf)
    return out


def energy_rows(inputs: ComparisonInput) -> Measured:
    """Return rows of the mean energy and of the share of frames above the reference's 99 % quantile; a histogram."""
    measured = [s.features.energy_kj for s in inputs.samples]
    series = [m for m in measured if m is not None]
    if len(series) < len(measured):
        return left_out(_ENERGY, "no energy function was given")
    known = [np.concatenate([x[~np.isnan(x)] for x in m]) for m in series]
    finite = known[0][np.isfinite(known[0])]
    if len(finite) < 20:
        return left_out(_ENERGY, "fewer than 20 energies of the reference are finite")
    columns = [[x[:, None] for x in m] for m in series]
    low, high = bounds([c[np.isfinite(c[:, 0])] for c in columns[0]])
    # An exploded frame counts as the edge of these limits; only what was not computed is left out.
    cut = [[np.where(np.isposinf(c), high, c) for c in m] for m in columns]
    means = [block_means(s, c, (low, high)) for s, c in zip(inputs.samples, cut, strict=True)]
    limit = float(np.quantile(finite, _HIGH_QUANTILE))
    above = three_means(inputs, [[np.where(np.isnan(c), np.nan, 100.0 * (c > limit)) for c in m] for m in columns])
    thermal_kj = GAS_CONSTANT_KJ_MOL_K * inputs.temperature_k
    name = f"{_ENERGY}, mean over {len(known[1])} frames"
    mean = Quantity("energy_mean", "structure", name, "kJ/mol", thermal_kj, "± RT")
    name = f"Frames above {limit:.5g} kJ/mol, the reference's 99 % quantile"
    share = Quantity("energy_high", "structure", name, "%", 2.0)
    said = "{:.2g} % of frames have an energy that {:.2g} % of the reference reaches"
    rows = [mean_row(inputs, mean, means, 0, _energy_words), mean_row(inputs, share, above, 0, said.format)]
    return Measured(rows, [_histogram(known)])


def _energy_words(candidate: float, reference: float) -> str:
    off = candidate - reference
    return f"the potential energy is {abs(off):.3g} kJ/mol too {'high' if off > 0 else 'low'}"


def _histogram(known: Sequence[FloatArray]) -> Histogram:
    """Densities from the reference's least energy to twice its range: where a poor candidate lies can be seen."""
    finite = known[0][np.isfinite(known[0])]
    low, span = float(finite.min()), max(float(np.ptp(finite)), 1e-6)
    edges = np.linspace(low - 0.2 * span, low + 2.0 * span, _BINS + 1)
    counts = [np.histogram(values[np.isfinite(values)], bins=edges)[0] for values in known]
    n_each = [max(len(values), 1) for values in known]
    ref, cand, rep = (c / n / (edges[1] - edges[0]) for c, n in zip(counts, n_each, strict=True))
    outside = [1.0 - float(c.sum()) / n for c, n in zip(counts, n_each, strict=True)]
    return Histogram(_ENERGY, "kJ/mol", edges, ref, cand, rep, (outside[0], outside[1], outside[2]), section="validity")


def frame_keys(features: Features) -> npt.NDArray[np.void] | None:
    """Return a number per frame `(n,)` that copies share, whatever was rotated, shifted or converted in between: a few
    angles on a grid of 0.06°; None where there are fewer than three. NaN frames are no copies of each other."""
    families = [features.series[f] for f in ("angles", "torsions")] if features.series else []
    columns = [np.concatenate(list(v)) for v in (features.phi, features.psi, *families)]
    every = np.concatenate(columns, axis=1)
    if every.shape[1] < 3:
        return None
    chosen = np.unique(np.linspace(0, every.shape[1] - 1, _KEY_COLUMNS).astype(int))
    grid = np.round(every[:, chosen].astype(np.float64) / _GRID)
    broken = ~np.isfinite(grid).all(axis=1)
    grid[broken] = 1e9 + np.arange(int(broken.sum()))[:, None]
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
        return left_out(name, "there are none")
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
    ref, cand, rep = (frame_keys(s.features) for s in inputs.samples)
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
