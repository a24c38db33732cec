"""Charts of any room of metrics to SVG, by their type: line charts, landscapes, bars, histograms."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.distributions import free_energy_kj
from surrogate.judge.report.figures import (
    CANDIDATE,
    CURVE_SIZE,
    LINE,
    MAP_MAX_KJ,
    MAP_SIZE,
    PAGE,
    REPLICATE,
    TEXT,
    Figure,
    difference_kj,
    draw,
    histogram,
    map_caption,
    paint_map,
)
from surrogate.judge.rows.charts import BarChart, Chart, Histogram, Landscape, Line, LineChart

FloatArray = npt.NDArray[np.float64]

_COLOURS = {"reference": TEXT, "candidate": CANDIDATE, "replicate": REPLICATE, "other": TEXT}
_DASHES: dict[str, Any] = {
    "reference": "solid",
    "candidate": "solid",
    "replicate": (0, (4, 2)),
    "other": (0, (1, 1.5)),
}
_MAX_NAMES = 12
# Characters in a line of a name beside its bar.
_NAME_WIDTH = 20
# Of the height of the axes: what a line of small print takes.
_NAME_HEIGHT = 0.07


def draw_chart(chart: Chart, temperature_k: float) -> list[Figure]:
    """Return the pictures of one chart: four maps for a landscape, one for anything else."""
    if isinstance(chart, Landscape):
        return _landscape(chart, temperature_k)
    if isinstance(chart, Histogram):
        outside = chart.outside[1]
        beyond = f"; {100 * outside:.2g} % of the candidate's frames lie outside" if outside > 0 else ""
        return [Figure(histogram(chart), f"Distribution of {chart.label}{beyond}")]
    if isinstance(chart, BarChart):
        shown = f"The first {_MAX_NAMES} of {len(chart.names)}." if len(chart.names) > _MAX_NAMES else ""
        return [Figure(_bars(chart), _caption(chart.title, " ".join(filter(None, (chart.caption, shown)))))]
    return [Figure(_lines(chart), _caption(chart.title, chart.caption))]


def _caption(title: str, caption: str) -> str:
    return f"{title}: {caption}" if caption else title


def _lines(chart: LineChart) -> str:
    def paint(figure: Any, axes: Any) -> None:
        # Of dots those drawn last are seen best.
        for line in sorted(chart.lines, key=lambda x: x.role != "replicate") if chart.dots else chart.lines:
            colour, dash = _COLOURS[line.role], _DASHES[line.role]
            if line.low is not None and line.high is not None:
                axes.fill_between(line.x, line.low, line.high, color=colour, alpha=0.17, linewidth=0)
            if chart.dots:
                axes.plot(line.x, line.y, color=colour, linestyle="none", marker=".", markersize=2.2, alpha=0.75)
                continue
            marker = "o" if line.role != "other" and np.count_nonzero(np.isfinite(line.y)) <= 12 else None
            axes.plot(line.x, line.y, color=colour, linestyle=dash, marker=marker, markersize=3)
        if chart.log_x:
            axes.set_xscale("log")
            _plain_ticks(axes.xaxis, axes.get_xlim())
        if chart.log_y:
            axes.set_yscale("log")
            _plain_ticks(axes.yaxis, axes.get_ylim())
        axes.set_xlabel(chart.x_label)
        axes.set_ylabel(chart.y_label)
        axes.margins(x=0.01)
        _name_guides(axes, [line for line in chart.lines if line.role == "other"])

    return draw(chart.title, CURVE_SIZE, paint)


def _plain_ticks(axis: Any, limits: tuple[float, float]) -> None:
    """Label a logarithmic axis with plain numbers: decades, or 1-2-5, or even steps where it spans less than three."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

    factor = limits[1] / limits[0]
    if factor < 3:
        axis.set_major_locator(MaxNLocator(4))
        axis.set_minor_locator(NullLocator())
    elif factor < 300:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if factor < 30 else (1.0, 3.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _name_guides(axes: Any, lines: Sequence[Line]) -> None:
    """Write the name of each guide line, up to a comma, at its end, except where it would run into another name."""
    taken: list[float] = []
    for line in lines:
        finite = np.flatnonzero(np.isfinite(line.y))
        if not line.name or not len(finite):
            continue
        x, y = line.x[finite[-1]], line.y[finite[-1]]
        height = float(axes.transAxes.inverted().transform(axes.transData.transform((x, y)))[1])
        if all(abs(height - other) > _NAME_HEIGHT for other in taken):
            taken.append(height)
            axes.annotate(
                line.name.partition(",")[0],
                (x, y),
                xytext=(-4, 4),
                textcoords="offset points",
                ha="right",
                fontsize=7,
                bbox={"facecolor": PAGE, "edgecolor": "none", "pad": 0.4},
            )


def short_name(name: str) -> str:
    """Return a name in at most two lines that leave a narrow picture room for what they name; what is cut off ends in
    an ellipsis."""
    lines = textwrap.wrap(name, _NAME_WIDTH, max_lines=2, placeholder=" …")
    return "\n".join(lines) if len(name) > _NAME_WIDTH else name


def _bars(chart: BarChart) -> str:
    """Dots with error bars, one row per name: the names stay legible where upright bars would have to turn them."""
    names = [short_name(name) for name in chart.names[:_MAX_NAMES]]
    n = len(names)
    height = 0.36 if any("\n" in name for name in names) else 0.24
    series = (
        (chart.reference, chart.reference_low, chart.reference_high, TEXT, "o", -0.2),
        (chart.candidate, chart.candidate_low, chart.candidate_high, CANDIDATE, "s", 0.0),
        (chart.replicate, None, None, REPLICATE, "D", 0.2),
    )

    def paint(figure: Any, axes: Any) -> None:
        for values, low, high, colour, marker, shift in series:
            if values is None:
                continue
            at = np.arange(n) + shift
            if low is not None and high is not None:
                axes.hlines(at, low[:n], high[:n], color=colour, linewidth=1.2)
            axes.plot(values[:n], at, linestyle="none", marker=marker, markersize=3.5, color=colour)
        axes.set_yticks(range(n), labels=names, fontsize=7 if height > 0.3 else 9)
        axes.set_ylim(n - 0.5, -0.5)
        axes.set_xlabel(chart.y_label)
        axes.grid(axis="y", color=LINE, linewidth=0.4)

    return draw(chart.title, (CURVE_SIZE[0], max(1.2, 0.6 + height * n)), paint)


def _landscape(chart: Landscape, temperature_k: float) -> list[Figure]:
    extent = (chart.x_edges[0], chart.x_edges[-1], chart.y_edges[0], chart.y_edges[-1])
    box = (float(extent[0]), float(extent[1]), float(extent[2]), float(extent[3]))

    def painter(values: FloatArray, colours: str, limits: tuple[float, float], step: float) -> Callable[..., None]:
        def paint(figure: Any, axes: Any) -> None:
            paint_map(figure, axes, values, colours, limits, step, box)
            axes.set_xlabel(chart.x_label)
            axes.set_ylabel(chart.y_label)

        return paint

    out = []
    for name, counts in (
        ("Reference", chart.reference),
        ("Candidate", chart.candidate),
        ("Replicate", chart.replicate),
    ):
        energy = np.clip(free_energy_kj(counts, temperature_k), 0.0, MAP_MAX_KJ)
        paint = painter(energy, "viridis_r", (0.0, MAP_MAX_KJ), MAP_MAX_KJ / 4)
        out.append(Figure(draw(f"{name}, {chart.title}", MAP_SIZE, paint), name))
    change, limit = difference_kj(chart.reference, chart.candidate, temperature_k)
    paint = painter(change, "PuOr_r", (-limit, limit), limit / 2)
    out.append(Figure(draw(f"Candidate minus reference, {chart.title}", MAP_SIZE, paint), map_caption()))
    return out
