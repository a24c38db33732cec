"""How long a trajectory stays a molecule: first-failure times of its replicas and the share that survives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.structure import Features
from surrogate.judge.rows.charts import Chart, Line, LineChart
from surrogate.judge.rows.rows import Row, Trio
from systems.chemistry import validity
from systems.units import format_time_ps

FloatArray = npt.NDArray[np.float64]

_NORMAL_95 = 1.959964


@dataclass(frozen=True, eq=False)
class Survival:
    """Kaplan-Meier estimate: the share `share` `(n,)` of replicas still whole after `time_ps` `(n,)`, 95 % band.

    `failures_ps`: first-failure time of each replica, None where it never failed.
    """

    time_ps: FloatArray
    share: FloatArray
    low: FloatArray
    high: FloatArray
    failures_ps: tuple[float | None, ...]

    @property
    def n_failed(self) -> int:
        return sum(t is not None for t in self.failures_ps)

    def median_ps(self) -> float | None:
        """Return the time by which half of the replicas have failed; None when fewer ever do."""
        below = np.flatnonzero(self.share <= 0.5)
        return float(self.time_ps[below[0]]) if len(below) else None


def survival(lengths_ps: Sequence[float], failures_ps: Sequence[float | None]) -> Survival:
    """Return the survival of replicas of these lengths, each with its first failure or None (censored at its end).

    Source: Kaplan and Meier, J. Am. Stat. Assoc. 53, 457 (1958); the band is Greenwood's on the log-log scale
    (Kalbfleisch and Prentice), which stays between 0 and 1.
    """
    ends = np.array([length if t is None else t for length, t in zip(lengths_ps, failures_ps, strict=True)])
    failed = np.array([t is not None for t in failures_ps])
    times, share, low, high = [0.0], [1.0], [1.0], [1.0]
    running, variance = 1.0, 0.0
    for t in np.unique(ends[failed]):
        at_risk, lost = int((ends >= t).sum()), int((failed & (ends == t)).sum())
        running *= 1.0 - lost / at_risk
        variance += lost / (at_risk * (at_risk - lost)) if at_risk > lost else math.inf
        band = _band(running, variance)
        times += [float(t)] * 2
        share += [share[-1], running]
        low += [low[-1], band[0]]
        high += [high[-1], band[1]]
    times.append(float(max(lengths_ps)))
    for series in (share, low, high):
        series.append(series[-1])
    return Survival(np.array(times), np.array(share), np.array(low), np.array(high), tuple(failures_ps))


def _band(share: float, variance: float) -> tuple[float, float]:
    if not 0.0 < share < 1.0:
        return share, share
    spread = _NORMAL_95 * math.sqrt(variance) / abs(math.log(share))
    return share ** math.exp(spread), share ** math.exp(-spread)


def survival_of(features: Features, mask: int = validity.INVALID) -> Survival:
    """Return the survival of the segments of one trajectory until the first frame that carries a bit of `mask`."""
    bad = [(f & mask) != 0 for f in features.flags]
    failures = [int(np.argmax(b)) * features.lag_ps if b.any() else None for b in bad]
    return survival([len(b) * features.lag_ps for b in bad], failures)


def survival_charts(trio: Trio) -> tuple[list[Row], list[Chart], list[tuple[str, str]]]:
    """Return the survival curves of reference and candidate, or say that no frame of either is invalid."""
    found = [survival_of(s.features) for s in (trio.reference, trio.candidate)]
    if not any(s.n_failed for s in found):
        return [], [], [("Survival of replicas", "no frame of the reference or the candidate is invalid")]
    said = []
    for name, s in zip(("reference", "candidate"), found, strict=True):
        first = min((t for t in s.failures_ps if t is not None), default=None)
        text = f"{name}: {s.n_failed} of {len(s.failures_ps)} segments meet an invalid frame"
        said.append(text + ("" if first is None else f", the first after {format_time_ps(first)}"))
    lines = [
        Line("reference", "reference", found[0].time_ps, found[0].share, found[0].low, found[0].high),
        Line("candidate", "candidate", found[1].time_ps, found[1].share, found[1].low, found[1].high),
    ]
    chart = LineChart(
        section="validity",
        title="Survival: segments without an invalid frame so far",
        caption="Kaplan-Meier estimate with its 95 % band; segments end where they end. " + "; ".join(said) + ".",
        x_label="time / ps",
        y_label="share of segments",
        lines=tuple(lines),
    )
    return [], [chart], []
