"""The slowest motion of whatever molecule: how long it is remembered, and whether two trajectories share its states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.statistics import BoolArray, FloatArray, Segments
from surrogate.comparison.measure.structure import Backbone, Features

# More series than this, and only those are followed whose means over blocks vary most.
_MOST_FOLLOWED = 48
_SCREENING_BLOCKS = (8, 40)
# TICA finds slow combinations in noise unless there are this many frames a feature.
_FRAMES_A_FEATURE = 20
_ANGLE_BINS = 36
# States apart are angles that one side has so many times as often, with so large a share of its frames.
_TIMES_AS_OFTEN, _LEAST_APART = 10.0, 0.3
# Of fewer passages in all runs together nobody can tell which side is the likelier, however long each stays.
_FEW_CROSSINGS = 5
_STRETCHES = 200
SLOW_KINDS = ("χ", "rotatable")


def longest_correlation(*features: Features) -> float:
    """Return the longest integrated autocorrelation time, in frames, of all trajectories about their common mean, among
    cos and sin of every torsion, phi > 0, size and shape, and TIC 0; 1 where nothing moves. Trajectories that stay in
    different states share a mean that neither returns to: such a motion is as long as they are."""
    chosen = _slowest(list(_all_series(features)))
    slowest = tic_0(features)
    times = [kinetics.zero_crossing(s)[1] for s in (*chosen, *([] if slowest is None else [slowest]))]
    return max((t for t in times if math.isfinite(t)), default=1.0)


def rarely_crossed(references: Sequence[Features], candidate: Features, torsions: Backbone | None = None) -> list[str]:
    """Return the torsions by which candidate and reference lie in different states that hardly any run passes between:
    replicas of one simulation do that, too. `torsions`: by which φ and ψ are named."""
    runs = [angles_of([t], torsions) for t in (*references, candidate)]
    found = []
    for k, (label, own) in enumerate(runs[-1]):
        p, q = _density(own), _density([x for angles in runs[:-1] for x in angles[k][1]])
        if p is None or q is None:
            continue
        for more, less in ((p, q), (q, p)):
            apart = more > _TIMES_AS_OFTEN * less
            if float(more[apart].sum()) < _LEAST_APART:
                continue
            if sum(_passages(x, apart) for angles in runs for x in angles[k][1]) < _FEW_CROSSINGS:
                found.append(label)
                break
    return found


def angles_of(features: Sequence[Features], torsions: Backbone | None = None) -> list[tuple[str, Segments]]:
    """Return every torsion: its name and its values in rad `(n,)` per segment of all trajectories. `torsions`: by which
    φ and ψ are named; by their number where None."""
    first = features[0]
    n_phi, n_psi = first.phi[0].shape[1], first.psi[0].shape[1]
    count = [str(k + 1) for k in range(max(n_phi, n_psi))]
    phi, psi = (torsions.phi_labels, torsions.psi_labels) if torsions else (count, count)
    families: list[tuple[Any, Sequence[str]]] = [
        ("phi", [f"φ {x}" for x in phi[:n_phi]]),
        ("psi", [f"ψ {x}" for x in psi[:n_psi]]),
        ("torsions", first.probes.labels("torsions") if first.probes else []),
    ]
    return [
        (name, [x for f in features for x in f.column(family, k)])
        for family, names in families
        for k, name in enumerate(names)
    ]


def _density(segments: Sequence[npt.NDArray[Any]]) -> FloatArray | None:
    values = np.concatenate([np.asarray(s, dtype=np.float64) for s in segments])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    counts = np.histogram(values, bins=_ANGLE_BINS, range=(-math.pi, math.pi))[0].astype(np.float64)
    # What vibrates about one angle must overlap with itself.
    spread = counts + np.roll(counts, 1) + np.roll(counts, -1)
    return np.asarray(spread / spread.sum(), dtype=np.float64)


def _passages(angles: npt.NDArray[Any], apart: BoolArray) -> int:
    """Return how often one segment passes between the bins in `apart` and the others, at the resolution of stretches of
    a two-hundredth of its length; a stretch that has both counts as one."""
    values = np.asarray(angles, dtype=np.float64)
    bins = np.nan_to_num((values + math.pi) / (2 * math.pi) * _ANGLE_BINS).astype(int) % _ANGLE_BINS
    size = max(len(bins) // _STRETCHES, 1)
    share = apart[bins][: len(bins) // size * size].reshape(-1, size).mean(axis=1)
    mixed = (share > 0.1) & (share < 0.9)
    jumps = np.abs(np.diff(share)) > 0.8
    return int(mixed.sum() + jumps.sum())


def _all_series(features: Sequence[Features]) -> Iterator[list[FloatArray]]:
    """Yield every scalar that may move slowly, segments of all trajectories one after another."""
    first = features[0]
    angles = [x for _, x in angles_of(features)]
    for phi in angles[: first.phi[0].shape[1]]:
        yield [np.where(np.isfinite(x), x > 0, np.nan) for x in phi]
    for angle in angles:
        yield [np.cos(x.astype(np.float64)) for x in angle]
        yield [np.sin(x.astype(np.float64)) for x in angle]
    if first.series:
        for k in range(first.series["shape"][0].shape[1]):
            yield [x.astype(np.float64) for f in features for x in f.column("shape", k)]
    elif not angles and first.bonds_nm[0].shape[1]:
        yield [np.asarray(x.mean(1), dtype=np.float64) for f in features for x in f.bonds_nm]


def _slowest(every: list[list[FloatArray]]) -> list[list[FloatArray]]:
    """Return all series, or of many those whose means over long and over short blocks vary most for their width."""
    if len(every) <= _MOST_FOLLOWED:
        return every
    chosen: set[int] = set()
    for n_blocks in _SCREENING_BLOCKS:
        shares = [-_share_between(s, n_blocks) for s in every]
        chosen.update(np.argsort(shares)[: _MOST_FOLLOWED // len(_SCREENING_BLOCKS)].tolist())
    return [every[k] for k in sorted(chosen)]


def _share_between(segments: list[FloatArray], n_blocks: int) -> float:
    """Return the variance of means over blocks over that of all frames."""
    values = np.concatenate(segments)
    values = np.where(np.isfinite(values), values, np.nanmean(values) if np.isfinite(values).any() else 0.0)
    size = max(len(values) // n_blocks, 1)
    total = float(values.var())
    if total <= 1e-12:
        return 0.0
    return float(values[: len(values) // size * size].reshape(-1, size).mean(axis=1).var()) / total


def tic_0(features: Sequence[Features]) -> list[FloatArray] | None:
    """Return TIC 0 of all torsions, fitted on all trajectories together; None where frames are too few."""
    parts = [x for f in features for x in tica_features(f)]
    n_features = parts[0].shape[1]
    lag = kinetics.tica_lag(features[0].lag_ps)
    n_frames = sum(map(len, parts))
    if not n_features or n_frames < _FRAMES_A_FEATURE * n_features or max(map(len, parts)) < 10 * lag:
        return None
    model = kinetics.fit_projection(parts, lag, 1)
    return None if model is None else [model.project(x)[:, 0] for x in parts]


def slow_torsions(features: Features) -> list[int]:
    """Return the columns of the family "torsions" that are chi or another rotatable bond."""
    return [k for k, t in enumerate(features.probes.torsions) if t.kind in SLOW_KINDS] if features.probes else []


def tica_features(features: Features) -> list[FloatArray]:
    """Return cos and sin of phi, psi, chi and every other rotatable torsion, `(n_frames, k)` per segment; amide bonds
    and rotors turn otherwise than slowly."""
    slow = slow_torsions(features)
    out = []
    for i, (phi, psi) in enumerate(zip(features.phi, features.psi, strict=True)):
        others = [features.series["torsions"][i][:, slow]] if slow else []
        out.append(kinetics.circular_features(phi, psi, *others))
    return out
