"""One matplotlib figure of a comparison, for notebooks: maps of φ and ψ side by side, or histograms."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from surrogate.judge.measure.distributions import free_energy_kj
from surrogate.judge.report.figures import MAP_MAX_KJ

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from surrogate.judge.comparison import Comparison

_MOST_ROWS, _MOST_HISTOGRAMS = 4, 6


def overview(comparison: Comparison) -> Figure:
    """Return a figure: free energy over φ and ψ, kJ/mol, a row a residue, reference, replicate and each candidate in
    columns; of a molecule without a backbone the densities of what was measured, each candidate a row."""
    from matplotlib.figure import Figure

    judged = comparison.judgements
    first = judged[0].curves
    figure: Any = Figure(layout="constrained")
    if not first.ramachandran:
        drawn = min(_MOST_HISTOGRAMS, max(len(first.histograms), 1))
        figure.set_size_inches(3.2 * drawn, 2.6 * len(judged))
        panels = figure.subplots(len(judged), drawn, squeeze=False)
        for row, judgement in zip(panels, judged, strict=True):
            for axes, data in zip(row, judgement.curves.histograms, strict=False):
                scale = 180.0 / math.pi if data.unit == "rad" else 1.0
                for values, name in ((data.reference, "reference"), (data.candidate, judgement.account.label)):
                    axes.stairs(values / scale, data.edges * scale, label=name, baseline=None)
                axes.set_xlabel(f"{data.label} / {'°' if data.unit == 'rad' else data.unit}")
                axes.set_yticks([])
            row[0].legend(fontsize=8)
        return figure
    n = min(_MOST_ROWS, len(first.ramachandran))
    figure.set_size_inches(3.2 * (2 + len(judged)), 2.8 * n)
    panels = figure.subplots(n, 2 + len(judged), squeeze=False, sharex=True, sharey=True)
    for k in range(n):
        residue = first.ramachandran[k]
        shown = [("reference", residue.reference), ("replicate", residue.replicate)]
        shown += [(j.account.label, j.curves.ramachandran[k].candidate) for j in judged]
        for axes, (name, counts) in zip(panels[k], shown, strict=True):
            energy = np.clip(free_energy_kj(counts, comparison.temperature_k), 0.0, MAP_MAX_KJ)
            image = axes.imshow(energy.T, origin="lower", extent=(-180, 180, -180, 180), aspect="auto",
                                vmin=0.0, vmax=MAP_MAX_KJ, cmap="viridis_r")  # fmt: skip
            axes.set_title(f"{name}, {residue.label}", fontsize=8)
            axes.set(xlabel="φ / °" if k == n - 1 else "", ylabel="ψ / °" if axes is panels[k][0] else "")
        figure.colorbar(image, ax=panels[k].tolist(), label="kJ/mol")
    return figure
