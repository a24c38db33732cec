"""Forecast error of paired trajectories: how far from the reference's atoms the candidate's are, against time.

Segments are paired in order, where both start from the same frame or frames; nothing else can be called a forecast.
Beside the candidate stand the replicate, where it starts there too, the last shared frame held still, and the last
shared step repeated for ever.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.comparison.read.ensemble import Ensemble
from surrogate.comparison.rows.charts import Chart, Line, LineChart, Role
from surrogate.comparison.rows.rows import ComparisonInput, Measured
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]

_NAME = "Forecast error (ADE, FDE)"
# The first frames are the same within what any format rounds to; further ones are shared, and not forecast very well,
# within single precision.
SAME_NM, SHARED_NM = 1e-3, 2e-5
MAX_GIVEN, MAX_HORIZON, MAX_PAIRS = 64, 1000, 200


@dataclass(frozen=True, eq=False)
class Forecast:
    """Mean distance over atoms in nm, `(n_pairs, n_times)`, at each frame after the `n_given` that both share."""

    name: str
    role: Role
    distance_nm: FloatArray

    def final(self) -> FloatArray:
        """Return the FDE `(n_times,)` in Å of a forecast that ends at each time: the mean over pairs."""
        return np.asarray(10.0 * self.distance_nm.mean(axis=0))

    def average(self) -> FloatArray:
        """Return the ADE `(n_times,)` in Å of a forecast that ends at each time: the mean over all frames up to it."""
        return np.asarray(self.final().cumsum() / np.arange(1, self.distance_nm.shape[1] + 1))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Frames of paired segments `(n_pairs, n_given + n_times, n_atoms, 3)` nm, the second laid on the first's start."""

    ref: FloatArray
    forecast: FloatArray
    n_given: int


def find_pairs(reference: Ensemble, other: Ensemble) -> Pairs | None:
    """Return the segments that start from the same frames, paired in order; None where the first ones do not.

    Each segment of `other` is moved rigidly, as a whole, so that its first frame lies on the reference's.
    """
    n_pairs = min(len(reference.segments), len(other.segments), MAX_PAIRS)
    found: list[tuple[FloatArray, FloatArray]] = []
    for k in range(n_pairs):
        most = min(len(reference.segments[k]), len(other.segments[k]), MAX_GIVEN + MAX_HORIZON)
        first, start = (np.asarray(e.segments[k][:1], dtype=np.float64) for e in (reference, other))
        if most < 2 or not _same(first, start):
            break
        ref, forecast = (np.asarray(e.segments[k][:most], dtype=np.float64) for e in (reference, other))
        found.append((ref, _laid(forecast, ref[0])))
    if not found:
        return None
    length = min(len(ref) for ref, _ in found)
    ref, forecast = (np.stack([pair[i][:length] for pair in found]) for i in (0, 1))
    near = (np.abs(ref - forecast).max(axis=(2, 3)) < SHARED_NM).all(axis=0)
    n_given = length if near.all() else max(int(np.argmin(near)), 1)
    return Pairs(ref, forecast, n_given) if n_given < length and n_given <= MAX_GIVEN else None


def forecasts(pairs: Pairs, role: Role = "candidate") -> list[Forecast]:
    """Return the errors of the forecast itself, of the frozen frame, and of constant velocity (two shared frames).

    Definition: mean L2 distance over atoms, as in EGNO, EqMotion and LaM-SLidE (Tables of MD17).
    """
    g = pairs.n_given
    ref, last = pairs.ref[:, g:], pairs.ref[:, g - 1 : g]
    out = [Forecast(role, role, _distance(ref, pairs.forecast[:, g:]))]
    if role == "candidate":
        out.append(Forecast("frozen frame", "other", _distance(ref, last)))
        if g >= 2:
            step = last - pairs.ref[:, g - 2 : g - 1]
            ahead = np.arange(1, ref.shape[1] + 1)[None, :, None, None]
            out.append(Forecast("constant velocity", "other", _distance(ref, last + ahead * step)))
    return out


def forecast_charts(inputs: ComparisonInput) -> Measured:
    """Return charts of FDE and ADE against time of the candidate's pairs and the replicate's, or why there are none."""
    if inputs.trajectories is None:
        return Measured()
    reference, candidate, replicate = inputs.trajectories
    pairs = find_pairs(reference, candidate)
    if pairs is None:
        why = "the reference and the candidate do not start from the same frame, or never part"
        return Measured(skipped=[(_NAME, why)])
    lag_ps = reference.lag_ps
    beside = None if replicate is None else find_pairs(reference, replicate)
    found = forecasts(pairs)
    if beside is not None:
        found += forecasts(beside, "replicate")
    n_times = min(f.distance_nm.shape[1] for f in found)
    time_ps = lag_ps * np.arange(1, n_times + 1)
    said = "; ".join(f"{f.name} {f.average()[n_times - 1]:.3g} and {f.final()[n_times - 1]:.3g} Å" for f in found)
    caption = (
        f"{len(pairs.ref)} pairs over {format_time_ps(float(time_ps[-1]))} after {pairs.n_given} shared frames. Mean "
        f"distance of all atoms; ADE and FDE at the end: {said}."
    )
    charts: list[Chart] = []
    for title, pick in (("Forecast error at a time (FDE)", "final"), ("Forecast error up to a time (ADE)", "average")):
        lines = [_line(f, time_ps, getattr(f, pick)()[:n_times], banded=pick == "final") for f in found]
        charts.append(
            LineChart("forecast", title, caption, "time / ps", "error / Å", tuple(lines), log_x=n_times > 3, log_y=True)
        )
    return Measured(charts=charts)


def _line(found: Forecast, time_ps: FloatArray, values: FloatArray, *, banded: bool) -> Line:
    n = len(found.distance_nm)
    y = np.where(values > 0, values, np.nan)
    if not banded or n < 3:
        return Line(found.name, found.role, time_ps, y)
    half = 10.0 * 1.96 * found.distance_nm[:, : len(y)].std(axis=0, ddof=1) / math.sqrt(n)
    low = np.where(y > half, y - half, y)
    return Line(found.name, found.role, time_ps, y, low, y + half)


def _same(a: FloatArray, b: FloatArray) -> bool:
    """Whether frames `(1, n_atoms, 3)` nm are the same but for a rigid motion."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    return bool(np.abs(_laid(b, a[0]) - a).max() < SAME_NM)


def _laid(frames: FloatArray, start: FloatArray) -> FloatArray:
    """Return frames `(n, n_atoms, 3)` moved rigidly, all alike, so that the first lies on `start` `(n_atoms, 3)`.

    Where it lies there already nothing is moved: a rotation of a straight or single-atom scene would be arbitrary.
    """
    from systems.chemistry.geometry import superposition

    if np.abs(frames[0] - start).max() < SAME_NM:
        return frames
    rotation, translation = superposition(frames[:1], start)
    return np.asarray(np.einsum("ij,tnj->tni", rotation[0], frames) + translation[0])


def _distance(ref: FloatArray, forecast: FloatArray) -> FloatArray:
    """Mean distance over atoms `(n_pairs, n_times)` nm; frames that are not finite are infinitely far."""
    with np.errstate(invalid="ignore", over="ignore"):
        gap = np.linalg.norm(forecast - ref, axis=-1).mean(axis=-1)
    return np.where(np.isfinite(gap), gap, np.inf)
