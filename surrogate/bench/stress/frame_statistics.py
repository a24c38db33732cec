"""Statistics of frames in a stress test: the share of valid ones, the first invalid one, and drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.distributions import distance
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import rotatable_torsions
from systems.chemistry.validity import BOND_HALF_ANGSTROM, INVALID, NOT_FINITE, Geometry, check_frames
from systems.scene import Scene

Frames = npt.NDArray[np.floating[Any]]
FloatArray = npt.NDArray[np.float64]

# The published stability rule: finite, and each bond within 0.5 Å of the reference's mean (Fu et al., TMLR 2023).
HALF_ANGSTROM_RULE = NOT_FINITE | BOND_HALF_ANGSTROM
_TORSION_BINS = 36
# Bonds that the reference constrains do not vibrate and have no temperature.
_STIFF_NM = 5e-4


@dataclass(frozen=True)
class Validity:
    """Frames that break the 0.5 Å rule and frames that break any rule, with the first of the former in ps."""

    frames: int
    broken: int
    invalid: int
    first_broken_ps: float | None
    survival: tuple[tuple[float, float], ...]

    def to_dict(self) -> dict[str, Any]:
        """Return percentages and the survival curve for JSON and the table."""
        return {
            "frames": self.frames,
            "valid_half_angstrom_%": 100.0 * (1.0 - self.broken / self.frames),
            "valid_all_%": 100.0 * (1.0 - self.invalid / self.frames),
            "first_failure_ps": self.first_broken_ps,
            "survival": [list(point) for point in self.survival],
        }


def measure_validity(replicas: Sequence[Frames], geometry: Geometry, spacing_ps: float) -> Validity:
    """Return the validity of replicas, each `(n_frames, n_atoms, 3)` nm in the geometry's atom order.

    `survival`: points (ps, share of replicas without a frame that breaks the 0.5 Å rule up to there), one per failure.
    """
    flags = [check_frames(frames, geometry) for frames in replicas]
    broken = [np.flatnonzero(f & HALF_ANGSTROM_RULE) for f in flags]
    firsts = sorted(float(b[0] + 1) * spacing_ps for b in broken if len(b))
    n = len(replicas)
    curve = [(0.0, 1.0), *((t, 1.0 - (k + 1) / n) for k, t in enumerate(firsts))]
    longest = max(len(f) for f in flags) * spacing_ps
    return Validity(
        frames=sum(map(len, flags)),
        broken=sum(map(len, broken)),
        invalid=sum(int(np.count_nonzero(f & INVALID)) for f in flags),
        first_broken_ps=firsts[0] if firsts else None,
        survival=(*curve, (longest, curve[-1][1])),
    )


def measure_bonds(frames: Frames, geometry: Geometry) -> dict[str, float]:
    """Return of frames `(n, n_atoms, 3)` nm: the root mean square of mean bond lengths from the reference's, in pm, and
    the share of the reference's variance that bonds which vibrate have, times 100 (100 % is the reference's
    temperature, by equipartition)."""
    pairs = geometry.bond_idx
    x = frames[np.isfinite(frames).all(axis=(1, 2))].astype(np.float64)
    if not len(x) or not len(pairs):
        return {}
    lengths = np.linalg.norm(x[:, pairs[:, 0]] - x[:, pairs[:, 1]], axis=2)
    out = {"bond_shift_pm": 1e3 * float(np.sqrt(np.square(lengths.mean(axis=0) - geometry.bond_mean_nm).mean()))}
    soft = geometry.bond_std_nm > _STIFF_NM
    if soft.any():
        out["bond_variance_%"] = 100.0 * float((lengths.var(axis=0)[soft] / geometry.bond_std_nm[soft] ** 2).mean())
    return out


def measure_drift(replicas: Sequence[Frames], scene: Scene, geometry: Geometry) -> dict[str, Any]:
    """Return what differs between the first and the last tenth of replicas `(n_frames, n_atoms, 3)` nm, template order.

    `torsion_jsd`: the mean Jensen-Shannon distance (square root, natural logarithm) of the rotatable torsions'
    histograms of 10° bins; `torsion_jsd_floor` the same between two halves of the replicas over both tenths, which
    differ by chance alone.
    """
    tenth = max(1, min(map(len, replicas)) // 10)
    first, last = (np.concatenate([r[part] for r in replicas]) for part in (slice(tenth), slice(-tenth, None)))
    out: dict[str, Any] = {"first": measure_bonds(first, geometry), "last": measure_bonds(last, geometry)}
    quads = rotatable_torsions(scene, rotors=False)
    if len(quads):
        out["torsion_jsd"] = _torsion_distance(first, last, quads)
    if len(quads) and len(replicas) > 1:
        ends = [np.concatenate([r[:tenth], r[-tenth:]]) for r in replicas]
        out["torsion_jsd_floor"] = _torsion_distance(np.concatenate(ends[::2]), np.concatenate(ends[1::2]), quads)
    return out


def _torsion_distance(one: Frames, other: Frames, quads: npt.NDArray[np.int64]) -> float:
    return float(np.mean(distance(_histograms(one, quads), _histograms(other, quads))))


def _histograms(frames: Frames, quads: npt.NDArray[np.int64]) -> FloatArray:
    finite = frames[np.isfinite(frames).all(axis=(1, 2))]
    angles = torsion(finite, quads)
    edges = np.linspace(-np.pi, np.pi, _TORSION_BINS + 1)
    return np.stack([np.histogram(angles[:, k], bins=edges)[0].astype(np.float64) for k in range(len(quads))])
