"""Charts to SVG, by their type, and which of them a page shows; and the figures of notebooks, by matplotlib.

Colours of the SVG are names of CSS variables, so that one picture serves light and dark pages and any width."""

from __future__ import annotations

import html
import math
import re
import textwrap
from collections.abc import Callable, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from surrogate.comparison.measure.distributions import free_energy_kj
from surrogate.comparison.measure.statistics import FloatArray
from surrogate.comparison.rows.charts import BarChart, Chart, Histogram, Landscape, LineChart, Section
from systems.units import GAS_CONSTANT_KJ_MOL_K

if TYPE_CHECKING:
    from matplotlib.figure import Figure as MatplotlibFigure

MAP_MAX_KJ = 20.0
MAP_SIZE, CURVE_SIZE = (2.95, 2.5), (2.95, 2.3)
DIFFERENCE_MAX_KJ = 4.0
_DIFFERENCE_CAPTION = "Candidate minus reference: orange where the candidate comes too rarely, purple where too often"
_MIN_COUNT = 5
_CIRCLE = np.linspace(-180.0, 180.0, 37)
# Characters in a line below a narrow picture.
_LABEL_WIDTH = 36
# Stand-ins that matplotlib carries through; each becomes a CSS variable in the finished SVG.
TEXT, CANDIDATE, REPLICATE, LINE, EMPTY = (f"#01010{i}" for i in range(1, 6))
_VARIABLES = {
    TEXT: "currentColor",
    CANDIDATE: "var(--candidate)",
    REPLICATE: "var(--replicate)",
    LINE: "var(--line)",
    EMPTY: "var(--map-empty)",
}
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "surromd",
    "font.size": 9,
    "axes.facecolor": "none",
    "font.family": "sans-serif",
    "axes.edgecolor": LINE,
    "axes.labelcolor": TEXT,
    "text.color": TEXT,
    "xtick.color": TEXT,
    "ytick.color": TEXT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.6,
}
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
_MOST_MAPS, _MOST_CHARTS = 6, 12
_MOST_ROWS, _MOST_HISTOGRAMS, _MOST_ANSWER_MAPS = 4, 6, 6
_TITLES: dict[Section, str] = {
    "equivalent_time": "Equivalent MD time",
    "distributions": "Distributions",
    "kinetics": "Kinetics",
    "structure": "Structure",
}


class Figure(NamedTuple):
    """One SVG with its caption."""

    svg: str
    caption: str


def draw(title: str, size: tuple[float, float], paint: Callable[[Any, Any], None]) -> str:
    """Return one SVG of `size` inches; `paint(figure, axes)` draws it. Nothing of matplotlib's global state is kept."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE | {"text.parse_math": False}):
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        paint(figure, figure.add_subplot())
        text = StringIO()
        figure.savefig(text, format="svg", transparent=False, facecolor="none", metadata={"Date": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>\s*", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<svg\b[^>]*?)\s+width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg\b[^>]*?)\s+height="[^"]*"', r"\1", svg, count=1)
    for stand_in, variable in _VARIABLES.items():
        svg = svg.replace(stand_in, variable)
    return svg.replace("<svg", f'<svg role="img" aria-label="{html.escape(title, quote=True)}"', 1)


def _degrees(axes: Any, *, both: bool) -> None:
    ticks = [-180, -90, 0, 90, 180]
    axes.set_xticks(ticks)
    axes.set_xlim(-180, 180)
    if both:
        axes.set_yticks(ticks)
        axes.set_ylim(-180, 180)


def histogram(data: Histogram) -> str:
    """Return the three densities as steps."""
    scale = 180.0 / math.pi if data.unit == "rad" else 1.0

    def paint(figure: Any, axes: Any) -> None:
        for values, colour, style in (
            (data.reference, TEXT, "solid"),
            (data.replicate, REPLICATE, (0, (4, 2))),
            (data.candidate, CANDIDATE, "solid"),
        ):
            edges = data.edges * scale
            axes.stairs(values / scale, edges, color=colour, linestyle=style, linewidth=1.4, baseline=None)
        axes.set_xlim(data.edges[0] * scale, data.edges[-1] * scale)
        axes.set_ylim(bottom=0)
        if data.unit == "rad":
            _degrees(axes, both=False)
        unit = "°" if data.unit == "rad" else data.unit
        axes.set_xlabel(textwrap.fill(f"{data.label} / {unit}" if unit else data.label, _LABEL_WIDTH))
        axes.set_ylabel("density")
        axes.set_yticks([])

    return draw(f"Distribution of {data.label}", CURVE_SIZE, paint)


def draw_chart(chart: Chart, temperature_k: float) -> list[Figure]:
    """Return the pictures of one chart: four maps for a landscape, one for anything else."""
    if isinstance(chart, Landscape):
        return _landscape(chart, temperature_k)
    if isinstance(chart, Histogram):
        outside = chart.outside[1]
        beyond = f"; {100 * outside:.2g} % of the candidate's frames lie outside" if outside > 0 else ""
        return [Figure(histogram(chart), f"Distribution of {chart.label}{beyond}")]
    caption, drawn = chart.caption, _bars(chart) if isinstance(chart, BarChart) else _lines(chart)
    if isinstance(chart, BarChart) and len(chart.names) > _MAX_NAMES:
        caption = f"{caption} The first {_MAX_NAMES} of {len(chart.names)}.".lstrip()
    return [Figure(drawn, f"{chart.title}: {caption}" if caption else chart.title)]


def _lines(chart: LineChart) -> str:
    def paint(figure: Any, axes: Any) -> None:
        for line in chart.lines:
            colour, dash = _COLOURS[line.role], _DASHES[line.role]
            if line.low is not None and line.high is not None:
                axes.fill_between(line.x, line.low, line.high, color=colour, alpha=0.17, linewidth=0)
            marker = "o" if line.role != "other" and np.count_nonzero(np.isfinite(line.y)) <= 12 else None
            axes.plot(line.x, line.y, color=colour, linestyle=dash, marker=marker, markersize=3)
        if chart.log_x:
            axes.set_xscale("log")
            _plain_ticks(axes.xaxis)
        if chart.log_y:
            axes.set_yscale("log")
            _plain_ticks(axes.yaxis)
        axes.set_xlabel(chart.x_label)
        axes.set_ylabel(chart.y_label)
        axes.margins(x=0.01)

    return draw(chart.title, CURVE_SIZE, paint)


def _plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with plain numbers, at 1, 2 and 5 of each decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def short_name(name: str) -> str:
    """Return a name in at most two lines that leave a narrow picture room; what is cut off ends in an ellipsis."""
    lines = textwrap.wrap(name, _NAME_WIDTH, max_lines=2, placeholder=" …")
    return "\n".join(lines) if len(name) > _NAME_WIDTH else name


def _bars(chart: BarChart) -> str:
    """Dots with error bars, one row per name: the names stay legible where upright bars would have to turn them."""
    names = [short_name(name) for name in chart.names[:_MAX_NAMES]]
    n = len(names)
    height = 0.36 if any("\n" in name for name in names) else 0.24

    def paint(figure: Any, axes: Any) -> None:
        for line, marker, shift in zip(chart.lines, "osD", (-0.2, 0.0, 0.2), strict=True):
            at, colour = np.arange(n) + shift, _COLOURS[line.role]
            if line.low is not None and line.high is not None:
                axes.hlines(at, line.low[:n], line.high[:n], color=colour, linewidth=1.2)
            axes.plot(line.y[:n], at, linestyle="none", marker=marker, markersize=3.5, color=colour)
        axes.set_yticks(range(n), labels=names, fontsize=7 if height > 0.3 else 9)
        axes.set_ylim(n - 0.5, -0.5)
        axes.set_xlabel(chart.y_label)
        axes.grid(axis="y", color=LINE, linewidth=0.4)

    return draw(chart.title, (CURVE_SIZE[0], max(1.2, 0.6 + height * n)), paint)


def _map(axes: Any, energy_kj: FloatArray, edges: tuple[FloatArray, FloatArray], **options: Any) -> Any:
    box = (float(edges[0][0]), float(edges[0][-1]), float(edges[1][0]), float(edges[1][-1]))
    chosen = {"vmin": 0.0, "vmax": MAP_MAX_KJ, "cmap": "viridis_r"} | options
    return axes.imshow(energy_kj.T, origin="lower", extent=box, aspect="auto", interpolation="nearest", **chosen)


def energy_map(
    title: str,
    energy_kj: FloatArray,
    edges: tuple[FloatArray, FloatArray],
    labels: tuple[str, str],
    *,
    difference: bool = False,
) -> str:
    """Return one map of energies `(n_x, n_y)` kJ/mol over x and y, or of a `difference` of two; NaN stays empty."""
    low, high = (-DIFFERENCE_MAX_KJ, DIFFERENCE_MAX_KJ) if difference else (0.0, MAP_MAX_KJ)
    step = (high - low) / 4

    def paint(figure: Any, axes: Any) -> None:
        from matplotlib import colormaps
        from matplotlib.colors import ListedColormap

        # Without the darkest ends of a diverging scale: they would vanish on a dark page.
        diverging = ListedColormap(colormaps["PuOr_r"](np.linspace(0.14, 0.86, 256)))
        axes.set_facecolor(EMPTY)
        image = _map(axes, energy_kj, edges, vmin=low, vmax=high, cmap=diverging if difference else "viridis_r")
        bar = figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
        bar.outline.set_visible(False)
        bar.set_ticks(np.arange(low, high + 0.5 * step, step).tolist())
        bar.ax.set_title("kJ/mol", fontsize=8, pad=5)
        in_degrees = labels[0].endswith("°")
        if in_degrees:
            _degrees(axes, both=True)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1], labelpad=-5 if in_degrees else None)

    return draw(title, MAP_SIZE, paint)


def _landscape(chart: Landscape, temperature_k: float) -> list[Figure]:
    where = (chart.x_edges, chart.y_edges), (chart.x_label, chart.y_label)
    three = chart.reference, chart.candidate, chart.replicate
    out = []
    for caption, counts in zip(("Reference", "Candidate", "Replicate"), three, strict=True):
        energy = free_energy_kj(counts, temperature_k)
        out.append(Figure(energy_map(f"{caption}, {chart.title}", energy, *where), caption))
    # Candidate minus reference, empty where there are too few counts.
    p, q = (counts / max(counts.sum(), 1.0) for counts in three[:2])
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.clip(-GAS_CONSTANT_KJ_MOL_K * temperature_k * np.log(q / p), -DIFFERENCE_MAX_KJ, DIFFERENCE_MAX_KJ)
    change[np.maximum(*three[:2]) < _MIN_COUNT] = np.nan
    picture = energy_map(f"Candidate minus reference, {chart.title}", change, *where, difference=True)
    return [*out, Figure(picture, _DIFFERENCE_CAPTION)]


class Album(NamedTuple):
    """Pictures under one heading; `note` says below them what they show, or what is only in the JSON."""

    title: str
    figures: list[Figure]
    note: str


def albums(charts: Sequence[Chart], temperature_k: float) -> list[Album]:
    """Return the charts of one candidate by section, landscapes each by themselves; of a long series the first."""
    out: list[Album] = []
    note = (
        f"Free energy in kJ/mol at {temperature_k:.0f} K above the deepest bin, up to {MAP_MAX_KJ:.0f} kJ/mol, 50 × 50 "
        "bins; what was never visited is left empty. In the difference, bins with fewer than 5 counts are left empty "
        "and bins that only one of the two visits stand at the end of the scale."
    )
    for section, title in _TITLES.items():
        mine = [c for c in charts if c.section == section]
        landscapes = [c for c in mine if isinstance(c, Landscape)][:_MOST_MAPS]
        out += [Album(c.title, draw_chart(c, temperature_k), note) for c in landscapes]
        others = [c for c in mine if not isinstance(c, Landscape)]
        drawn = [figure for chart in others[:_MOST_CHARTS] for figure in draw_chart(chart, temperature_k)]
        n_left = max(len(others) - _MOST_CHARTS, 0)
        if drawn:
            out.append(Album(title, drawn, f"{n_left} more are in the JSON file." if n_left else ""))
    return out


def overview(drawn: Sequence[tuple[str, Sequence[Chart]]], temperature_k: float) -> MatplotlibFigure:
    """Return a figure of the charts of each candidate (label, charts): free energy over φ and ψ, kJ/mol, a row a
    residue, reference, replicate and each candidate in columns; without a backbone the densities of what was measured,
    each candidate a row."""
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
            image = _map(axes, free_energy_kj(counts, temperature_k), (residue.x_edges, residue.y_edges))
            axes.set_title(f"{name}, {residue.title}", fontsize=8)
            axes.set(xlabel="φ / °" if k == n - 1 else "", ylabel="ψ / °" if axes is row[0] else "")
        figure.colorbar(image, ax=row.tolist(), label="kJ/mol")
    return figure


def answer_overview(molecule: str, answer: dict[str, Any]) -> MatplotlibFigure:
    """Return a figure of an `Answer.to_dict()`: populations of all states with their errors, beside a
    surrogate's, and the first residues' free energies over φ and ψ."""
    from matplotlib.figure import Figure

    maps = list(answer.get("maps_kj_mol", {}).items())[:_MOST_ANSWER_MAPS]
    states = [s for s in answer.get("states", []) if s.get("is_known", not s["missing"])]
    figure: Any = Figure(figsize=(4.0 * (1 + len(maps)), max(3.5, 0.22 * len(states))), layout="constrained")
    bars, *others = figure.subplots(1, 1 + len(maps), squeeze=False)[0]
    shares, errors = ([s[key] for s in states] for key in ("share", "error"))
    bars.barh(range(len(states)), shares, xerr=errors, color="0.75", label=answer.get("populations_by", "MD"))
    own = [(k, s["surrogate"], s["surrogate_error"]) for k, s in enumerate(states)]
    rolled = [(k, share, error or 0.0) for k, share, error in own if share is not None]
    if rolled:
        at, share, error = zip(*rolled, strict=True)
        bars.errorbar(share, at, xerr=error, fmt="o", color="C1", label="surrogate")
    bars.set_yticks(range(len(states)), [f"{s['torsion']} {s['state']}" for s in states], fontsize=7)
    bars.set(xlabel="population", title=molecule)
    if states:
        bars.invert_yaxis()
        figure.legend(loc="outside lower left", ncols=2, fontsize=8)
    for axes, (label, energy) in zip(others, maps, strict=True):
        values = np.array([[math.nan if x is None else x for x in row] for row in energy])
        image = _map(axes, values, (_CIRCLE, _CIRCLE))
        axes.set(xlabel="φ / °", ylabel="ψ / °", title=f"{label}, kJ/mol")
        figure.colorbar(image, ax=axes, shrink=0.7)
    return figure


def weighted_maps(maps: dict[str, FloatArray]) -> list[Figure]:
    """Return the report's pictures of MD's answer: the free energy (kJ/mol, `(36, 36)`) of the first residues."""
    found = []
    for label, energy in list(maps.items())[:_MOST_ANSWER_MAPS]:
        shown = np.where(np.isfinite(energy), energy, np.nan)
        picture = energy_map(f"By MD's weights, {label}", shown, (_CIRCLE, _CIRCLE), ("φ / °", "ψ / °"))
        found.append(Figure(picture, f"{label}: free energy by the answer, all of its frames weighted"))
    return found
