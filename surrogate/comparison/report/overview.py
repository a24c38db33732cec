"""One matplotlib figure of a comparison, or of MD's answer, for notebooks; and the report's maps of that answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from surrogate.comparison.measure.distributions import free_energy_kj
from surrogate.comparison.report.figures import MAP_MAX_KJ, energy_map
from surrogate.comparison.report.figures import Figure as Picture
from surrogate.comparison.rows.charts import Chart, Histogram, Landscape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FloatArray = npt.NDArray[np.float64]
_MOST_ROWS, _MOST_HISTOGRAMS, _MOST_MAPS = 4, 6, 6


def overview(drawn: Sequence[tuple[str, Sequence[Chart]]], temperature_k: float) -> Figure:
    """Return a figure: free energy over φ and ψ, kJ/mol, a row a residue, reference, replicate and each candidate in
    columns; of a molecule without a backbone the densities of what was measured, each candidate a row.

    `drawn`: of each candidate its label and its charts.
    """
    from matplotlib.figure import Figure

    labels = [label for label, _ in drawn]
    maps = [[c for c in charts if isinstance(c, Landscape) and c.x_label == "φ / °"] for _, charts in drawn]
    histograms = [[c for c in charts if isinstance(c, Histogram)] for _, charts in drawn]
    figure: Any = Figure(layout="constrained")
    if not maps[0]:
        n = min(_MOST_HISTOGRAMS, max(len(histograms[0]), 1))
        figure.set_size_inches(3.2 * n, 2.6 * len(labels))
        panels = figure.subplots(len(labels), n, squeeze=False)
        for row, label, own in zip(panels, labels, histograms, strict=True):
            for axes, data in zip(row, own, strict=False):
                scale, unit = (180.0 / math.pi, "°") if data.unit == "rad" else (1.0, data.unit)
                for values, name in ((data.reference, "reference"), (data.candidate, label)):
                    axes.stairs(values / scale, data.edges * scale, label=name, baseline=None)
                axes.set(xlabel=f"{data.label} / {unit}", yticks=[])
            row[0].legend(fontsize=8)
        return figure
    n = min(_MOST_ROWS, len(maps[0]))
    figure.set_size_inches(3.2 * (2 + len(labels)), 2.8 * n)
    panels = figure.subplots(n, 2 + len(labels), squeeze=False, sharex=True, sharey=True)
    for k, row in enumerate(panels):
        residue = maps[0][k]
        shown = [("reference", residue.reference), ("replicate", residue.replicate)]
        shown += [(label, own[k].candidate) for label, own in zip(labels, maps, strict=True)]
        for axes, (name, counts) in zip(row, shown, strict=True):
            energy = np.clip(free_energy_kj(counts, temperature_k), 0.0, MAP_MAX_KJ)
            image = axes.imshow(energy.T, origin="lower", extent=(-180, 180, -180, 180), aspect="auto",
                                vmin=0.0, vmax=MAP_MAX_KJ, cmap="viridis_r")  # fmt: skip
            axes.set_title(f"{name}, {residue.title}", fontsize=8)
            axes.set(xlabel="φ / °" if k == n - 1 else "", ylabel="ψ / °" if axes is row[0] else "")
        figure.colorbar(image, ax=row.tolist(), label="kJ/mol")
    return figure


def answer_overview(molecule: str, answer: dict[str, Any]) -> Figure:
    """Return a figure of an `Answer.to_dict()`: populations of all states by MD with their errors, beside a
    surrogate's, and the first residues' free energies over φ and ψ."""
    from matplotlib.figure import Figure

    maps = list(answer.get("maps_kj_mol", {}).items())[:_MOST_MAPS]
    states = [s for s in answer.get("states", []) if not s["missing"]]
    figure: Any = Figure(figsize=(4.0 * (1 + len(maps)), max(3.5, 0.22 * len(states))), layout="constrained")
    bars, *others = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    bars.barh(
        range(len(states)), [s["share"] for s in states], xerr=[s["error"] for s in states], color="0.75", label="MD"
    )
    rolled = [
        (k, s["surrogate"], s["surrogate_error"] or 0.0) for k, s in enumerate(states) if s["surrogate"] is not None
    ]
    if rolled:
        at, share, error = zip(*rolled, strict=True)
        bars.errorbar(share, at, xerr=error, fmt="o", color="C1", label="surrogate")
    bars.set_yticks(range(len(states)), [f"{s['torsion']} {s['state']}" for s in states], fontsize=7)
    bars.set(xlabel="population", title=molecule)
    if states:
        bars.invert_yaxis()
        bars.legend(fontsize=8)
    for axes, (label, energy) in zip(others, maps, strict=True):
        values = np.array([[math.nan if x is None else x for x in row] for row in energy])
        image = axes.imshow(values.T, origin="lower", extent=(-180, 180, -180, 180), vmin=0.0, vmax=MAP_MAX_KJ,
                            cmap="viridis_r")  # fmt: skip
        axes.set(xlabel="φ / °", ylabel="ψ / °", title=f"{label}, kJ/mol")
        figure.colorbar(image, ax=axes, shrink=0.7)
    return figure


def weighted_maps(maps: dict[str, FloatArray]) -> list[Picture]:
    """Return the report's pictures of MD's answer: the free energy (kJ/mol, `(36, 36)`) of the first residues."""
    edges = np.linspace(-180.0, 180.0, 37)

    def shown(energy: FloatArray) -> FloatArray:
        return np.where(np.isfinite(energy), np.minimum(energy, MAP_MAX_KJ), np.nan)

    return [
        Picture(
            energy_map(f"By MD's weights, {label}", shown(energy), (edges, edges), ("φ / °", "ψ / °")),
            f"{label}: free energy by MD's answer, all its frames weighted",
        )
        for label, energy in list(maps.items())[:_MOST_MAPS]
    ]
