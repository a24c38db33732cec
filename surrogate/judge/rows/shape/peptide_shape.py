"""What chemists look at first: torsions and RMSD along time, and the secondary structure of peptides."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.secondary import COIL, HELIX, LEAST_RESIDUES, STRAND
from surrogate.judge.rows.block_means import Means, block_means, family_of, mean_row
from surrogate.judge.rows.charts import Chart, Line, LineChart, Role, bar_chart
from surrogate.judge.rows.rows import Metric, Row, Trio

FloatArray = npt.NDArray[np.float64]
Skipped = tuple[str, str]

_ROLES: tuple[Role, Role, Role] = ("reference", "candidate", "replicate")
_MOST_POINTS = 400
_LEAST_IN_NS_PS = 2000.0
_MOST_RESIDUES = 2
_TOLERANCE = 5.0
_RMSD = 1
_MOST_NAMED = 12


def along_time(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return charts of the RMSD and of phi and psi along the first segment of each trajectory, every k-th frame."""
    charts: list[Chart] = []
    if trio.reference.features.probes is not None:
        rmsd = [10.0 * family_of(s, "shape")[0][:, _RMSD].astype(np.float64) for s in trio.samples]
        charts.append(_series_chart(trio, rmsd, "RMSD along time", "RMSD / Å"))
    for residue in trio.torsions.residues[:_MOST_RESIDUES]:
        for symbol, k, pick in (("φ", residue.phi, "phi"), ("ψ", residue.psi, "psi")):
            angles = [np.degrees(getattr(s.features, pick)[0][:, k].astype(np.float64)) for s in trio.samples]
            charts.append(_series_chart(trio, angles, f"{symbol} of {residue.label} along time", f"{symbol} / °"))
    return [], charts, []


def _series_chart(trio: Trio, values: Sequence[FloatArray], title: str, y_label: str) -> LineChart:
    shortest = min(map(len, values))
    step = max(1, -(-shortest // _MOST_POINTS))
    lag_ps = trio.reference.features.lag_ps
    unit, scale = ("ns", 1e-3) if shortest * lag_ps >= _LEAST_IN_NS_PS else ("ps", 1.0)
    lines = []
    for role, series in zip(_ROLES, values, strict=True):
        y: FloatArray = series[:shortest:step]
        lines.append(Line(role, role, np.arange(len(y), dtype=np.float64) * step * lag_ps * scale, y))
    return LineChart(
        section="structure",
        title=title,
        caption=f"First segment of each trajectory, one frame in {step}." if step > 1 else "First segment of each.",
        x_label=f"time / {unit}",
        y_label=y_label,
        lines=tuple(lines),
        dots=True,
    )


def secondary_structure(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows of the share of residues in helix and in strand, and charts of helix, strand and coil residue by
    residue, with 95 % intervals. By DSSP (see `measure.secondary`); peptides of five residues and more."""
    probes = trio.reference.features.probes
    if probes is None:
        return [], [], []
    if not probes.chains.labels:
        return [], [], [("Secondary structure", f"fewer than {LEAST_RESIDUES} residues have N, CA, C and O")]
    rows: list[Row] = []
    charts: list[Chart] = []
    skipped: list[Skipped] = []
    for name, code in (("helix", HELIX), ("strand", STRAND), ("coil", COIL)):
        percent = [[100.0 * (x == code) for x in family_of(s, "secondary")] for s in trio.samples]
        if code != COIL:
            share = [[x.mean(axis=1, keepdims=True) for x in v] for v in percent]
            means = [block_means(s, v) for s, v in zip(trio.samples, share, strict=True)]
            metric = Metric(f"secondary:{name}", "structure", f"Residues in {name} (DSSP)", "%", _TOLERANCE)
            rows.append(mean_row(trio, metric, means, 0, _in_words(name)))
        each = [block_means(s, v) for s, v in zip(trio.samples, percent, strict=True)]
        if any((m.values > 0).any() for m in each):
            charts.append(_residue_chart(f"Residues in {name}", probes.chains.labels, each))
        else:
            skipped.append((f"Residues in {name}", "there are none in any frame"))
    return rows, charts, skipped


def _in_words(name: str) -> Callable[[float, float], str]:
    return lambda c, r: f"{c:.3g} % of residues are in {name} instead of {r:.3g} %"


def _residue_chart(title: str, labels: Sequence[str], each: Sequence[Means]) -> Chart:
    """Names beside dots where there is room for them; of longer chains lines with bands over the residues in order."""
    caption = "Share of frames by DSSP, with 95 % intervals."
    made = [means.estimates() for means in each]
    if len(labels) <= _MOST_NAMED:
        return bar_chart("structure", title, caption, "frames / %", labels, made)
    place = np.arange(1, len(labels) + 1, dtype=np.float64)
    lines = []
    for role, found in zip(_ROLES, made, strict=True):
        value, low, high = (np.array([getattr(e, x) for e in found]) for x in ("value", "low", "high"))
        band = (None, None) if role == "replicate" else (np.clip(low, 0, 100), np.clip(high, 0, 100))
        lines.append(Line(role, role, place, value, *band))
    ends = f"1 is {labels[0]}, {len(labels)} is {labels[-1]}."
    return LineChart("structure", title, f"{caption} {ends}", "residue", "frames / %", tuple(lines))
