"""What chemists look at first: torsions and RMSD along time, and the secondary structure of peptides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from surrogate.judge.rows.block_means import block_means, family_of
from surrogate.judge.rows.charts import BarChart, Chart, Line, LineChart, Role
from surrogate.judge.rows.rows import Row, Trio, observable_row

FloatArray = npt.NDArray[np.float64]
Skipped = tuple[str, str]

_ROLES: tuple[Role, Role, Role] = ("reference", "candidate", "replicate")
_MOST_POINTS = 400
_LEAST_IN_NS_PS = 2000.0
_MOST_RESIDUES = 2
_LEAST_RESIDUES = 5
_TOLERANCE = 5.0
_RMSD = 1
# Regions of phi and psi in degrees, psi of the second running past 180.
_HELIX = ((-100.0, -30.0), (-80.0, -5.0))
_STRAND = ((-180.0, -45.0), (90.0, 210.0))
_IN_A_ROW = 3


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
        if y_label.endswith("°"):
            # An angle that runs over the end of its range is no jump across the picture.
            y = np.asarray(np.where(np.append(np.abs(np.diff(y)) > 180.0, False), np.nan, y), dtype=np.float64)
        lines.append(Line(role, role, np.arange(len(y), dtype=np.float64) * step * lag_ps * scale, y))
    return LineChart(
        section="structure",
        title=title,
        caption=f"First segment of each trajectory, every {step}. frame." if step > 1 else "First segment of each.",
        x_label=f"time / {unit}",
        y_label=y_label,
        lines=tuple(lines),
    )


def secondary_structure(trio: Trio) -> tuple[list[Row], list[Chart], list[Skipped]]:
    """Return rows of the helical and the extended share of the residues, and a chart of the helix residue by residue.

    By torsions alone: a residue is helical (extended) with its phi and psi in that region and two neighbours beside it
    that are, three in a row. Peptides of five residues and more.
    """
    residues = trio.torsions.residues
    if len(residues) < _LEAST_RESIDUES:
        return [], [], [("Secondary structure", f"fewer than {_LEAST_RESIDUES} residues have φ and ψ")]
    rows, charts = [], []
    for key, name, region in (("helix", "helical", _HELIX), ("strand", "extended", _STRAND)):
        formed = [
            [in_a_row(_inside(phi, psi, trio, region)) for phi, psi in zip(s.features.phi, s.features.psi, strict=True)]
            for s in trio.samples
        ]
        share = [[100.0 * x.mean(axis=1, keepdims=True) for x in v] for v in formed]
        means = [block_means(s, v) for s, v in zip(trio.samples, share, strict=True)]
        rows.append(
            observable_row(
                trio,
                [float(m.values[0]) for m in means],
                [m.draws[:, 0] for m in means],
                key=f"secondary:{key}",
                group="structure",
                metric=f"Residues that are {name}, by φ and ψ of three in a row",
                unit="%",
                tolerance=_TOLERANCE,
                tolerance_text=f"± {_TOLERANCE:g} %",
                statement=lambda c, r, name=name: f"{c:.3g} % of residues are {name} instead of {r:.3g} %",  # type: ignore[misc]
            )
        )
        each = [100.0 * np.concatenate(v).mean(axis=0) for v in formed]
        charts.append(
            BarChart(
                section="structure",
                title=f"Residues that are {name}",
                caption="Share of frames, by φ and ψ of three residues in a row.",
                y_label="frames / %",
                names=tuple(r.label for r in residues),
                reference=each[0],
                candidate=each[1],
                replicate=each[2],
            )
        )
    return rows, [*charts], []


def _inside(
    phi: npt.NDArray[np.floating], psi: npt.NDArray[np.floating], trio: Trio, region: tuple[tuple[float, float], ...]
) -> npt.NDArray[np.bool_]:
    """Return which residues `(n, n_residues)` lie in a region of phi and psi."""
    out = []
    for k, (low, high) in enumerate(region):
        angles = phi if k == 0 else psi
        columns = [r.phi if k == 0 else r.psi for r in trio.torsions.residues]
        turned = (np.degrees(angles[:, columns].astype(np.float64)) - low) % 360.0
        out.append(turned <= high - low)
    return np.asarray(out[0] & out[1])


def in_a_row(inside: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which columns `(n, k)` belong to a run of at least three that are set."""
    k = inside.shape[1]
    runs = np.ones((len(inside), k - _IN_A_ROW + 1), dtype=bool)
    for shift in range(_IN_A_ROW):
        runs &= inside[:, shift : k - _IN_A_ROW + 1 + shift]
    out = np.zeros_like(inside)
    for shift in range(_IN_A_ROW):
        out[:, shift : k - _IN_A_ROW + 1 + shift] |= runs
    return out
