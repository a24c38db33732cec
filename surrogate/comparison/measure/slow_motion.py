"""The slowest motion of whatever molecule: how long it is remembered, and whether two trajectories share its states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure import kinetics
from surrogate.comparison.measure.probes import Family
from surrogate.comparison.measure.structure import Features

FloatArray = npt.NDArray[np.float64]
Series = list[FloatArray]

# More series than this, and only those are followed whose means over blocks vary most.
_MOST_FOLLOWED = 48
_SCREENING_BLOCKS = (8, 40)
# TICA finds slow combinations in noise unless there are this many frames a feature.
_FRAMES_A_FEATURE = 20
_TICA_LAG_PS = 10.0
_ANGLE_BINS = 36
_TIMES_AS_OFTEN = 10.0
_LEAST_APART = 0.3
_FEW_CROSSINGS = 5
_STRETCHES = 200
SLOW_KINDS = ("χ", "rotatable")


def longest_correlation(*features: Features) -> float:
    """Return the longest integrated autocorrelation time, in frames, of all trajectories about their common mean.

    Looked for among cos and sin of every torsion, phi > 0, ring puckers, size and shape, and the slowest combination of
    torsions (TICA). Trajectories that stay in different states share a mean that neither returns to: such a motion is
    as long as they are. 1 where nothing moves.
    """
    chosen = _slowest(_all_series(features))
    slowest = tic_0(features)
    times = [kinetics.zero_crossing(s)[1] for s in (*chosen, *([] if slowest is None else [slowest]))]
    return max((t for t in times if math.isfinite(t)), default=1.0)


def rarely_crossed(references: Sequence[Features], candidate: Features) -> list[str]:
    """Return the torsions by which candidate and reference lie in different states that hardly any run passes between.

    States apart are angles that one side has ten times as often as the other, with three frames in ten of the one. Of
    fewer than `_FEW_CROSSINGS` passages in all runs together nobody can tell which side is the likelier, however long
    each stays: replicas of one simulation do that, too.
    """
    runs = [_angles(t) for t in (*references, candidate)]
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


def _angles(features: Features) -> list[tuple[str, list[npt.NDArray[Any]]]]:
    """Return the name and the values in rad `(n,)` per segment of every torsion and of every ring's pucker."""
    out = []
    for symbol, series in (("φ", features.phi), ("ψ", features.psi)):
        out += [(f"{symbol} {k + 1}", [x[:, k] for x in series]) for k in range(series[0].shape[1])]
    if features.probes is not None:
        families: tuple[tuple[Family, int, int], ...] = (("torsions", 0, 1), ("puckers", 1, 2))
        for family, first, step in families:
            if family in features.series:
                names = features.probes.labels(family)[first::step]
                out += [(n, [x[:, first + step * k] for x in features.series[family]]) for k, n in enumerate(names)]
    return out


def _density(segments: Sequence[npt.NDArray[Any]]) -> FloatArray | None:
    values = np.concatenate([np.asarray(s, dtype=np.float64) for s in segments])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    counts = np.histogram(values, bins=_ANGLE_BINS, range=(-math.pi, math.pi))[0].astype(np.float64)
    # What vibrates about one angle must overlap with itself.
    spread = counts + np.roll(counts, 1) + np.roll(counts, -1)
    return np.asarray(spread / spread.sum(), dtype=np.float64)


def _passages(angles: npt.NDArray[Any], apart: npt.NDArray[np.bool_]) -> int:
    """Return how often one segment passes between the bins in `apart` and the others, at the resolution of stretches of
    a two-hundredth of its length; a stretch that has both counts as one."""
    values = np.asarray(angles, dtype=np.float64)
    bins = np.nan_to_num((values + math.pi) / (2 * math.pi) * _ANGLE_BINS).astype(int) % _ANGLE_BINS
    size = max(len(bins) // _STRETCHES, 1)
    share = apart[bins][: len(bins) // size * size].reshape(-1, size).mean(axis=1)
    mixed = (share > 0.1) & (share < 0.9)
    jumps = np.abs(np.diff(share)) > 0.8
    return int(mixed.sum() + jumps.sum())


def _all_series(features: Sequence[Features]) -> Iterator[Series]:
    """Yield every scalar that may move slowly, segments of all trajectories one after another."""
    n_phi, n_psi = features[0].phi[0].shape[1], features[0].psi[0].shape[1]
    further = features[0].series
    n_torsions, n_puckers, n_shape = (
        further[family][0].shape[1] if family in further else 0 for family in ("torsions", "puckers", "shape")
    )
    for k in range(n_phi):
        yield [np.where(np.isfinite(x[:, k]), x[:, k] > 0, np.nan) for f in features for x in f.phi]
    angles = [[x[:, k] for f in features for x in f.phi] for k in range(n_phi)]
    angles += [[x[:, k] for f in features for x in f.psi] for k in range(n_psi)]
    angles += [[x[:, k] for f in features for x in f.series["torsions"]] for k in range(n_torsions)]
    # Of a ring: its amplitude, then its angle.
    angles += [[x[:, k] for f in features for x in f.series["puckers"]] for k in range(1, n_puckers, 2)]
    for angle in angles:
        yield [np.cos(x.astype(np.float64)) for x in angle]
        yield [np.sin(x.astype(np.float64)) for x in angle]
    for k in range(n_shape):
        yield [x[:, k].astype(np.float64) for f in features for x in f.series["shape"]]
    if not n_shape and not angles and features[0].bonds_nm[0].shape[1]:
        yield [np.asarray(x.mean(1), dtype=np.float64) for f in features for x in f.bonds_nm]


def _slowest(series: Iterator[Series]) -> list[Series]:
    """Return all series, or of many those whose means over long and over short blocks vary most for their width."""
    every = list(series)
    if len(every) <= _MOST_FOLLOWED:
        return every
    chosen: set[int] = set()
    for n_blocks in _SCREENING_BLOCKS:
        shares = [-_share_between(s, n_blocks) for s in every]
        chosen.update(np.argsort(shares)[: _MOST_FOLLOWED // len(_SCREENING_BLOCKS)].tolist())
    return [every[k] for k in sorted(chosen)]


def _share_between(segments: Series, n_blocks: int) -> float:
    """Return the variance of means over blocks over that of all frames."""
    values = np.concatenate(segments)
    values = np.where(np.isfinite(values), values, np.nanmean(values) if np.isfinite(values).any() else 0.0)
    size = max(len(values) // n_blocks, 1)
    total = float(values.var())
    if total <= 1e-12:
        return 0.0
    return float(values[: len(values) // size * size].reshape(-1, size).mean(axis=1).var()) / total


def tic_0(features: Sequence[Features]) -> Series | None:
    """Return TIC 0 of all torsions, fitted on all trajectories together; None where frames are too few."""
    parts = [x for f in features for x in tica_features(f)]
    n_features = parts[0].shape[1]
    lag = max(1, round(_TICA_LAG_PS / features[0].lag_ps))
    n_frames = sum(map(len, parts))
    if not n_features or n_frames < _FRAMES_A_FEATURE * n_features or max(map(len, parts)) < 10 * lag:
        return None
    model = kinetics.fit_tica(parts, lag)
    return None if model is None else [model.project(x) for x in parts]


def tica_features(features: Features) -> list[FloatArray]:
    """Return cos and sin of phi, psi, chi and every other rotatable torsion, `(n_frames, k)` per segment.

    Amide bonds and rotors (methyl and the like) are left out: what turns them is not the slow motion looked for.
    """
    slow = [k for k, t in enumerate(features.probes.torsions) if t.kind in SLOW_KINDS] if features.probes else []
    further = features.series.get("torsions") if slow else None
    out = []
    for i, (phi, psi) in enumerate(zip(features.phi, features.psi, strict=True)):
        others = [] if further is None else [further[i][:, slow]]
        out.append(kinetics.circular_features(phi, psi, *others))
    return out
