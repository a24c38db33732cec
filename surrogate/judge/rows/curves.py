"""What the report draws: plain numbers, computed once, drawn elsewhere, written to the JSON as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure import distributions
from surrogate.judge.measure.equal_atoms import evenly
from surrogate.judge.measure.structure import Features
from surrogate.judge.rows.charts import Chart, Curve
from surrogate.judge.rows.charts import Histogram as Histogram
from surrogate.judge.rows.rows import Trio
from systems.chemistry import validity

FloatArray = npt.NDArray[np.float64]

MAX_TIMELINE_BINS = 240
MAX_DRAWN_BOUNDARIES = 60
MOST_RESIDUES = 24


@dataclass(frozen=True, eq=False)
class RamachandranMap(Curve):
    """Joint counts of one residue, each `(50, 50)`, first index phi, on [-pi, pi]."""

    label: str
    reference: FloatArray
    candidate: FloatArray
    replicate: FloatArray


@dataclass(frozen=True, eq=False)
class CorrelationCurve(Curve):
    """Autocorrelation against lag; `*_low` and `*_high` are 95 % bands."""

    label: str
    lag_ps: FloatArray
    reference: FloatArray
    reference_low: FloatArray
    reference_high: FloatArray
    candidate: FloatArray
    candidate_low: FloatArray
    candidate_high: FloatArray
    replicate: FloatArray


@dataclass(frozen=True, eq=False)
class Timeline(Curve):
    """Faults along all frames in order: share of frames with each fault per stretch of time.

    `edges_ps` `(n + 1,)`; `invalid` and `strained` (20 % bonds alone) `(n,)`; `segments_ps` and `chunks_ps` are where
    segments and chunks begin (no chunk is listed when there are more than can be drawn: `n_chunks` says how many);
    `by_position` is the share of invalid frames against the place of the frame in its chunk.
    """

    label: str
    edges_ps: FloatArray
    invalid: FloatArray
    strained: FloatArray
    segments_ps: FloatArray
    chunks_ps: FloatArray
    n_chunks: int
    by_position: npt.NDArray[np.floating]


@dataclass(frozen=True)
class BondLength(Curve):
    """Mean and standard deviation of one bond, Å."""

    label: str
    reference_mean: float
    reference_std: float
    candidate_mean: float
    candidate_std: float
    replicate_mean: float
    replicate_std: float


@dataclass(frozen=True, eq=False)
class Curves(Curve):
    """All curves of one candidate; `charts` are those that any room of metrics adds, drawn by their type."""

    ramachandran: tuple[RamachandranMap, ...]
    histograms: tuple[Histogram, ...]
    correlations: tuple[CorrelationCurve, ...]
    timelines: tuple[Timeline, ...]
    bonds: tuple[BondLength, ...]
    charts: tuple[Chart, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        out: dict[str, Any] = {name: [c.to_dict() for c in value] for name, value in vars(self).items()}
        for record, chart in zip(out["charts"], self.charts, strict=True):
            record["type"] = type(chart).__name__
        return out


def ramachandran_maps(trio: Trio) -> tuple[RamachandranMap, ...]:
    """Return the joint counts of every residue with both torsions, of many of some."""
    bins = distributions.RAMACHANDRAN_BINS
    out = []
    for residue in evenly(trio.torsions.residues, MOST_RESIDUES):
        maps = []
        for sample in trio.samples:
            counts = distributions.block_counts_joint(
                [x[:, residue.phi] for x in sample.features.phi],
                [x[:, residue.psi] for x in sample.features.psi],
                bins,
                sample.blocks,
            ).sum(0)
            maps.append(counts.reshape(bins.n_total, bins.n_total)[: bins.n, : bins.n])
        out.append(RamachandranMap(residue.label, *maps))
    return tuple(out)


def histogram(
    trio: Trio, series: Sequence[Sequence[npt.NDArray[np.floating]]], bins: distributions.Bins, label: str, unit: str
) -> Histogram:
    """Return the densities of (reference, candidate, replicate), normalised over all frames, in range or not."""
    width = (bins.high - bins.low) / bins.n
    densities, outside = [], []
    for sample, segments in zip(trio.samples, series, strict=True):
        counts = distributions.block_counts(segments, bins, sample.blocks).sum(0)
        densities.append(counts[: bins.n] / counts.sum() / width)
        outside.append(float(counts[bins.n :].sum() / counts.sum()))
    ref, cand, rep = densities
    return Histogram(label, unit, bins.edges, ref, cand, rep, (outside[0], outside[1], outside[2]))


def torsion_histograms(trio: Trio) -> tuple[Histogram, ...]:
    """Return the histograms of every phi and psi, of many of some."""
    bins = distributions.TORSION_BINS
    out = []
    for k, label in evenly(list(enumerate(trio.torsions.phi_labels)), MOST_RESIDUES):
        series = [[x[:, k] for x in s.features.phi] for s in trio.samples]
        out.append(histogram(trio, series, bins, f"φ {label}", "rad"))
    for k, label in evenly(list(enumerate(trio.torsions.psi_labels)), MOST_RESIDUES):
        series = [[x[:, k] for x in s.features.psi] for s in trio.samples]
        out.append(histogram(trio, series, bins, f"ψ {label}", "rad"))
    return tuple(out)


def timeline(features: Features) -> Timeline:
    """Return the faults of one ensemble along its frames, segments laid end to end."""
    flags = np.concatenate(list(features.flags))
    n = len(flags)
    edges = np.unique(np.linspace(0, n, min(n, MAX_TIMELINE_BINS) + 1).astype(int))
    invalid = (flags & validity.INVALID) != 0
    strained = ((flags & validity.BOND_20_PERCENT) != 0) & ~invalid
    per_bin = np.diff(edges)
    starts = np.concatenate([[0], np.cumsum(features.segment_lengths)[:-1]])
    begins: npt.NDArray[np.intp] = np.empty(0, dtype=np.intp)
    by_position: npt.NDArray[np.floating] = np.empty(0)
    if features.chunk_idx is not None:
        chunk = np.concatenate(list(features.chunk_idx))
        if (chunk >= 0).any():
            new = np.zeros(n, dtype=bool)
            new[starts] = True
            new[1:] |= chunk[1:] != chunk[:-1]
            begins = np.flatnonzero(new & (chunk >= 0))
            position = np.arange(n) - np.maximum.accumulate(np.where(new, np.arange(n), 0))
            inside = chunk >= 0
            of_all = np.bincount(position[inside])
            bad = np.bincount(position[inside & invalid], minlength=len(of_all))
            by_position = np.asarray(bad / np.maximum(of_all, 1), dtype=np.float64)
    drawn = begins if len(begins) <= MAX_DRAWN_BOUNDARIES else begins[:0]
    return Timeline(
        features.label,
        edges * features.lag_ps,
        np.add.reduceat(invalid.astype(float), edges[:-1]) / per_bin,
        np.add.reduceat(strained.astype(float), edges[:-1]) / per_bin,
        starts * features.lag_ps,
        np.asarray(drawn * features.lag_ps, dtype=np.float64),
        len(begins),
        by_position if len(by_position) <= 4096 else np.empty(0),
    )
