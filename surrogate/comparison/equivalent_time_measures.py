"""By what the equivalent MD time of a candidate is measured: histograms of torsions and of TIC 0, bonds,
autocorrelation."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.equivalent_time import EquivalentTime, Measure, equivalent_time_by
from surrogate.comparison.measure import distributions, kinetics
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, TORSION_BINS, Bins
from surrogate.comparison.measure.probes import MOST_HISTOGRAMS, evenly
from surrogate.comparison.measure.slow_motion import SLOW_KINDS, longest_correlation, tica_features
from surrogate.comparison.measure.statistics import Blocks, Piece, block_length, make_blocks
from surrogate.comparison.measure.structure import Backbone, Features
from surrogate.comparison.rows.relaxation_rows import turning
from surrogate.comparison.rows.rows import Options
from surrogate.comparison.rows.torsion_rows import MOST_MAPS

FloatArray = npt.NDArray[np.float64]
AnyFloat = npt.NDArray[np.floating[Any]]
Segments = Sequence[AnyFloat]
Three = tuple[Features, Features, Features]
ThreeBlocks = tuple[Blocks, Blocks, Blocks]

# Pieces run from the whole length down to this share of it, halving each time.
SHORTEST_SHARE = 128
_LEAST_FRAMES = 10
_LAGS = 40


def equivalent_times(
    reference: Features, candidate: Features, replicate: Features, torsions: Backbone, options: Options
) -> tuple[EquivalentTime, ...]:
    """Return the equivalent MD time by each measure that applies: histograms of the torsions and of TIC 0, bonds,
    autocorrelation.

    The candidate enters with all its frames; reference and replicate are cut to one length.
    """
    parts = _equal_parts(reference, candidate, replicate)
    if parts is None:
        return ()
    three, blocks = parts
    ref = three[0]
    found = [equivalent_time_by(m, ref.total_ps, options.seed) for m in _measures(three, blocks, torsions, options)]
    return tuple(w for w in found if w is not None)


def joint_measure(
    reference: Features, candidate: Features, replicate: Features, torsions: Backbone
) -> tuple[Measure, float] | None:
    """Return the φ/ψ map alone as a measure, and the length in ps of reference and replicate; None where there is no
    residue with φ and ψ, or too few frames."""
    parts = _equal_parts(reference, candidate, replicate)
    if parts is None or not torsions.residues:
        return None
    return _joint_measure(*parts, torsions), parts[0][0].total_ps


def _equal_parts(reference: Features, candidate: Features, replicate: Features) -> tuple[Three, ThreeBlocks] | None:
    """Cut reference and replicate to one length and divide all three into blocks; None where frames are too few."""
    n = min(reference.n_frames, replicate.n_frames)
    n_blocks = 1 << int(math.log2(max(min(SHORTEST_SHARE, n // _LEAST_FRAMES), 1)))
    if n_blocks < 8:
        return None
    ref, other = reference.frames(0, n), replicate.frames(0, n)
    slowest = longest_correlation(ref, other)
    blocks = (
        even_blocks(ref.segment_lengths, n_blocks),
        make_blocks(candidate.segment_lengths, block_length(candidate.n_frames, slowest)),
        even_blocks(other.segment_lengths, n_blocks),
    )
    return (ref, candidate, other), blocks


def even_blocks(segment_lengths: Sequence[int], n_blocks: int) -> Blocks:
    """Return `n_blocks` blocks of equally many frames (but for one), counted through the segments in order."""
    edges = np.linspace(0, sum(segment_lengths), n_blocks + 1).astype(int)
    pieces, offset = [], 0
    for segment, n in enumerate(segment_lengths):
        for block in range(n_blocks):
            start, stop = max(int(edges[block]) - offset, 0), min(int(edges[block + 1]) - offset, n)
            if start < stop:
                pieces.append(Piece(segment, start, stop, block))
        offset += n
    return Blocks(tuple(pieces), n_blocks, max(int(np.diff(edges).max()), 1))


def _measures(three: Three, blocks: ThreeBlocks, torsions: Backbone, options: Options) -> list[Measure]:
    out = []
    if torsions.residues:
        out.append(_joint_measure(three, blocks, torsions))
    name, columns = _torsion_columns(three, torsions)
    if columns:
        singles = [[_counts(pick(f), k, b) for f, b in zip(three, blocks, strict=True)] for pick, k in columns]
        out.append(_histogram_measure("torsion_jsd", name, singles))
        out += _tica_measures(three, blocks, options)
        moving = _correlation_measure(three, blocks)
        out += [moving] if moving is not None else []
    elif three[0].bonds_nm[0].shape[1]:
        out.append(_bond_measure(three, blocks))
    return out


def _torsion_columns(three: Three, torsions: Backbone) -> tuple[str, list[tuple[Callable[[Features], Segments], int]]]:
    """Return what the torsions are called together, and each as the series it is in and its column: phi and psi, or,
    where there are none, rotatable torsions; rotors of what has nothing else that turns."""
    backbone = [(_phi, k) for k in range(len(torsions.phi))] + [(_psi, k) for k in range(len(torsions.psi))]
    if backbone:
        return "single φ and ψ", evenly(backbone, MOST_HISTOGRAMS)
    probes = three[0].probes
    if probes is None or "torsions" not in three[0].series:
        return "", []
    for kinds, name in ((SLOW_KINDS, "single rotatable torsions"), (("rotor",), "single rotors")):
        chosen = [(_further, k) for k, t in enumerate(probes.torsions) if t.kind in kinds]
        if chosen:
            return name, evenly(chosen, MOST_HISTOGRAMS)
    return "", []


def _joint_measure(three: Three, blocks: ThreeBlocks, torsions: Backbone) -> Measure:
    per_residue = [
        [
            distributions.block_counts_joint(
                [x[:, r.phi] for x in f.phi], [x[:, r.psi] for x in f.psi], RAMACHANDRAN_BINS, b
            )
            for f, b in zip(three, blocks, strict=True)
        ]
        for r in evenly(torsions.residues, MOST_MAPS)
    ]
    return _histogram_measure("joint_jsd", "φ/ψ map", per_residue)


def _phi(features: Features) -> Segments:
    return features.phi


def _psi(features: Features) -> Segments:
    return features.psi


def _further(features: Features) -> Segments:
    return features.series["torsions"]


def _counts(series: Segments, column: int, blocks: Blocks, bins: Bins = TORSION_BINS) -> FloatArray:
    return distributions.block_counts([x[:, column] for x in series], bins, blocks)


def _histogram_measure(key: str, name: str, counts: Sequence[Sequence[FloatArray]]) -> Measure:
    """Return the measure whose square is the mean Jensen-Shannon divergence over several histograms.

    `counts`: for each histogram those of (reference, candidate, replicate) per block.
    """
    visited = [sum(c.sum(0) for c in three) > 0 for three in counts]
    kept = [[c[:, v] for c in three] for three, v in zip(counts, visited, strict=True)]
    edges = np.cumsum([int(v.sum()) for v in visited])[:-1]
    first, own, second = (np.concatenate([three[k] for three in kept], axis=1) for k in range(3))

    def squared(p: FloatArray, q: FloatArray) -> FloatArray:
        parts = zip(np.split(p, edges, axis=1), np.split(q, edges), strict=True)
        return np.asarray(np.mean([distributions.divergence(a, b[None]) for a, b in parts], axis=0))

    return Measure(key, "distribution", name, (first, own, second), squared)


def _bond_measure(three: Three, blocks: ThreeBlocks) -> Measure:
    counts = []
    for b in range(three[0].bonds_nm[0].shape[1]):
        bins = distributions.normal_bins([x[:, b] for x in three[0].bonds_nm])
        counts.append([_counts(f.bonds_nm, b, own, bins) for f, own in zip(three, blocks, strict=True)])
    return _histogram_measure("bond_jsd", "bond lengths", counts)


def _tica_measures(three: Three, blocks: ThreeBlocks, options: Options) -> list[Measure]:
    lag = max(1, round(options.tica_lag_ps / three[0].lag_ps))
    features = [tica_features(f) for f in three]
    model = kinetics.fit_tica(features[0], lag) if max(map(len, features[0])) > 10 * lag else None
    if model is None:
        return []
    projected = [[model.project(x) for x in segments] for segments in features]
    bins = distributions.reference_bins(projected[0])
    counts = [distributions.block_counts(x, bins, b) for x, b in zip(projected, blocks, strict=True)]
    return [_histogram_measure("tic0_jsd", "TIC 0", [counts])]


def _correlation_measure(three: Three, blocks: ThreeBlocks) -> Measure | None:
    """Return the root mean square difference of the autocorrelations of cos psi (of rotatable torsions where there is
    no psi), at lags even on a log scale.

    Lags run to the first zero crossing of the reference's slowest torsion. None where none moves.
    """
    moving = [turning(f) for f in three]
    chosen = evenly(range(len(moving[0])), MOST_MAPS)
    series = [[m[k][2] for m in moving] for k in chosen]
    n_psi = len(series)
    longest = max((kinetics.zero_crossing(per_sample[0])[0] for per_sample in series), default=0)
    longest = min(longest, *(max(f.segment_lengths) - 1 for f in three))
    if longest < 2:
        return None
    lags = np.unique(np.geomspace(1, longest, _LAGS).astype(int))
    kept = np.concatenate([[0], lags])
    sums = []
    for k, own in enumerate(blocks):
        parts = [kinetics.lag_sums(per_sample[k], own, int(lags[-1]) + 1) for per_sample in series]
        sums.append(np.concatenate([a[:, kept] for s in parts for a in (s.xy, s.head, s.tail, s.n)], axis=1))

    def curves(flat: FloatArray) -> FloatArray:
        each = np.split(flat, 4 * n_psi, axis=1)
        found = [
            kinetics.autocorrelation(kinetics.LagSums(*each[4 * k : 4 * k + 4]), np.eye(len(flat)))[:, 1:]
            for k in range(n_psi)
        ]
        return np.concatenate(found, axis=1)

    def squared(p: FloatArray, q: FloatArray) -> FloatArray:
        return np.asarray(((curves(p) - curves(q[None])) ** 2).mean(-1))

    name = "autocorrelation of cos ψ" if moving[0][0][0] else "autocorrelation of rotatable torsions"
    return Measure("psi_correlation", "kinetics", name, (sums[0], sums[1], sums[2]), squared)
