"""Histograms per block, Jensen-Shannon distance, basins of the backbone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surrogate.comparison.measure.statistics import AnyFloat, Blocks, BoolArray, FloatArray, IntArray
from systems.units import GAS_CONSTANT_KJ_MOL_K

# The cuts lie at the two minima of the psi density of ff99SB and ff14SB alanine dipeptide (about 80 and -120 degrees).
ALPHA_PSI_RAD = (-2.0 * math.pi / 3.0, 80.0 * math.pi / 180.0)


@dataclass(frozen=True)
class Bins:
    """Evenly spaced bins on [low, high], with two bins for what lies outside and one for what is not a number.

    Index 0..n-1 are the bins, n is below, n+1 above, n+2 not finite: whatever leaves the range of the reference stays
    in the histogram, so that it cannot improve a score.
    """

    low: float
    high: float
    n: int

    @property
    def n_total(self) -> int:
        return self.n + 3

    @property
    def edges(self) -> FloatArray:
        """Bin edges, `(n + 1,)`."""
        return np.linspace(self.low, self.high, self.n + 1)

    def index(self, values: AnyFloat) -> IntArray:
        """Return the bin of each value, same shape as `values`."""
        width = (self.high - self.low) / self.n
        x = np.asarray(values, dtype=np.float64)
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = (x - self.low) / (width or 1.0)
            inside = np.clip(np.nan_to_num(scaled, posinf=0.0, neginf=0.0), 0, self.n - 1).astype(np.int64)
            out = np.where(x < self.low, self.n, np.where(x > self.high, self.n + 1, inside))
        return np.where(np.isfinite(x), out, self.n + 2)


TORSION_BINS = Bins(-math.pi, math.pi, 100)
RAMACHANDRAN_BINS = Bins(-math.pi, math.pi, 50)


def _finite_values(segments: Sequence[AnyFloat]) -> FloatArray:
    values = np.concatenate([np.asarray(s, dtype=np.float64).ravel() for s in segments])
    return values[np.isfinite(values)]


def reference_bins(segments: Sequence[AnyFloat]) -> Bins:
    """Return 100 bins over the finite values of the reference, from its least to its greatest and 5 % beyond: without
    that the reference alone would have nothing outside its range, and any replicate would stand out."""
    values = _finite_values(segments)
    if not len(values):
        return Bins(0.0, 1.0, 100)
    low, high = float(values.min()), float(values.max())
    margin = max(0.05 * (high - low), 1e-9)
    return Bins(low - margin, high + margin, 100)


def normal_bins(segments: Sequence[AnyFloat], n: int = 100) -> Bins:
    """Return bins over four standard deviations on either side of the mean of the reference's finite values, for what
    vibrates about one value: a few outliers do not widen the bins."""
    values = _finite_values(segments)
    if not len(values):
        return Bins(0.0, 1.0, n)
    width = max(4.0 * float(values.std()), 1e-9)
    return Bins(float(values.mean()) - width, float(values.mean()) + width, n)


def count_in_blocks(index: Sequence[IntArray], n: int, blocks: Blocks) -> FloatArray:
    """Return how often each of `n` bins occurs in each block, `(n_blocks, n)`, from indices `(n_frames,)`."""
    counts = np.zeros((blocks.n_blocks, n))
    for piece in blocks.pieces:
        counts[piece.block] += np.bincount(index[piece.segment][piece.start : piece.stop], minlength=n)
    return counts


def block_counts(segments: Sequence[AnyFloat], bins: Bins, blocks: Blocks) -> FloatArray:
    """Return a histogram per block, `(n_blocks, bins.n_total)`, of `segments` of `(n_frames,)` values."""
    return count_in_blocks([bins.index(s) for s in segments], bins.n_total, blocks)


def block_counts_joint(x: Sequence[AnyFloat], y: Sequence[AnyFloat], bins: Bins, blocks: Blocks) -> FloatArray:
    """Return a joint histogram per block, `(n_blocks, bins.n_total ** 2)`, row-major with x first."""
    n = bins.n_total
    return count_in_blocks([bins.index(a) * n + bins.index(b) for a, b in zip(x, y, strict=True)], n * n, blocks)


def divergence(counts_p: FloatArray, counts_q: FloatArray) -> FloatArray:
    """Return the Jensen-Shannon divergence in nats along the last axis, batched over the leading ones.

    D = H((p+q)/2) - (H(p) + H(q))/2 with p, q the normalised counts; 0 for equal, ln 2 for disjoint histograms; NaN
    when one is empty. Source: Lin, IEEE Trans. Inf. Theory 37, 145 (1991), eq. 4.1 with equal weights.
    """
    n_p, n_q = counts_p.sum(-1, keepdims=True), counts_q.sum(-1, keepdims=True)
    p, q = counts_p / np.maximum(n_p, 1e-300), counts_q / np.maximum(n_q, 1e-300)
    out = _minus_entropy(p) + _minus_entropy(q)
    p += q
    p *= 0.5
    out = 0.5 * out - _minus_entropy(p)
    empty = (n_p[..., 0] <= 0) | (n_q[..., 0] <= 0)
    return np.where(empty, np.nan, np.clip(out, 0.0, math.log(2.0)))


def _minus_entropy(p: FloatArray) -> FloatArray:
    """Return the sum of p log p along the last axis."""
    # Adding the least positive number leaves every positive one as it is, and makes 0 log 0 zero.
    log = p + np.finfo(np.float64).tiny
    np.log(log, out=log)
    return np.asarray(np.einsum("...i,...i->...", p, log))


def distance(counts_p: FloatArray, counts_q: FloatArray) -> FloatArray:
    """Return the Jensen-Shannon distance: the square root of `divergence` (natural logarithm), at most sqrt(ln 2).

    The convention of the peptide papers (MDGen, JAMUN, LaM-SLidE). Source: Endres and Schindelin, IEEE Trans. Inf.
    Theory 49, 1858 (2003): the square root is a metric.
    """
    return np.asarray(np.sqrt(divergence(counts_p, counts_q)), dtype=np.float64)


def is_alpha(psi_rad: AnyFloat) -> BoolArray:
    """Return whether psi lies in the alpha basin, [-120, 80) degrees."""
    with np.errstate(invalid="ignore"):
        return (psi_rad >= ALPHA_PSI_RAD[0]) & (psi_rad < ALPHA_PSI_RAD[1])


def is_beta(psi_rad: AnyFloat) -> BoolArray:
    """Return whether psi lies in the beta basin, the finite rest of the circle."""
    return np.isfinite(psi_rad) & ~is_alpha(psi_rad)


def is_positive(phi_rad: AnyFloat) -> BoolArray:
    """Return whether phi > 0 (left-handed region)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(phi_rad > 0)


def block_occupancy(member: Sequence[BoolArray], blocks: Blocks) -> tuple[FloatArray, FloatArray]:
    """Return per block how many frames are in the basin and how many there are, two `(n_blocks,)` arrays; frames that
    are not finite are members of nothing and stay in the denominator."""
    counts = count_in_blocks([m.astype(np.int64) for m in member], 2, blocks)
    return counts[:, 1], counts.sum(axis=1)


def free_energy_kj(counts: FloatArray, temperature_k: float) -> FloatArray:
    """Return -RT ln(p) in kJ/mol above the most populated bin; NaN where nothing was counted."""
    with np.errstate(divide="ignore", invalid="ignore"):
        energy = -GAS_CONSTANT_KJ_MOL_K * temperature_k * np.log(counts / counts.max())
    return np.where(counts > 0, energy, np.nan)
