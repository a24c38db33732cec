"""Curves to SVG. Colours are names of CSS variables, so that one picture serves light and dark pages and any width."""

from __future__ import annotations

import html
import math
import re
import textwrap
from collections.abc import Callable
from io import StringIO
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from surrogate.judge.measure.distributions import free_energy_kj
from surrogate.judge.rows.charts import Histogram
from surrogate.judge.rows.curves import CorrelationCurve, RamachandranMap, Timeline
from systems.units import GAS_CONSTANT_KJ_MOL_K

FloatArray = npt.NDArray[np.float64]

MAP_MAX_KJ = 20.0
MAP_SIZE, CURVE_SIZE = (2.95, 2.5), (2.95, 2.3)
DIFFERENCE_MAX_KJ = 4.0
# The two ends of the difference map, in words: high (too rare) and low (too frequent).
DIFFERENCE_COLOURS = ("orange", "purple")
_MIN_COUNT = 5
# Characters in a line below a narrow picture.
_LABEL_WIDTH = 36
# Stand-ins that matplotlib carries through; each becomes a CSS variable in the finished SVG.
TEXT, CANDIDATE, REPLICATE, FAULT, STRAINED, LINE, EMPTY, PAGE = (f"#01010{i}" for i in range(1, 9))
_VARIABLES = {
    TEXT: "currentColor",
    CANDIDATE: "var(--candidate)",
    REPLICATE: "var(--replicate)",
    FAULT: "var(--fault)",
    STRAINED: "var(--strained)",
    LINE: "var(--line)",
    EMPTY: "var(--map-empty)",
    PAGE: "var(--page)",
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


def _visible(colours: str) -> Any:
    """Return a colour map without its darkest ends where it diverges: they would vanish on a dark page."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    if colours != "PuOr_r":
        return colormaps[colours]
    return ListedColormap(colormaps[colours](np.linspace(0.14, 0.86, 256)))


def _degrees(axes: Any, *, both: bool) -> None:
    ticks = [-180, -90, 0, 90, 180]
    axes.set_xticks(ticks)
    axes.set_xlim(-180, 180)
    if both:
        axes.set_yticks(ticks)
        axes.set_ylim(-180, 180)


def ramachandran(title: str, counts: FloatArray, temperature_k: float) -> str:
    """Return the free-energy map of joint counts `(50, 50)` in kJ/mol, up to 20; bins never visited stay empty."""
    energy = free_energy_kj(counts, temperature_k)

    def paint(figure: Any, axes: Any) -> None:
        _torsion_map(figure, axes, np.clip(energy, 0.0, MAP_MAX_KJ), "viridis_r", (0.0, MAP_MAX_KJ), MAP_MAX_KJ / 4)

    return draw(title, MAP_SIZE, paint)


def difference(title: str, data: RamachandranMap, temperature_k: float) -> str:
    """Return the map of candidate minus reference, kJ/mol within ±4; a bin that only one of them visits is at the end.

    Bins with fewer than 5 counts on both sides are noise and stay empty.
    """
    change, limit = difference_kj(data.reference, data.candidate, temperature_k)

    def paint(figure: Any, axes: Any) -> None:
        _torsion_map(figure, axes, change, "PuOr_r", (-limit, limit), limit / 2)

    return draw(title, MAP_SIZE, paint)


def difference_kj(reference: FloatArray, candidate: FloatArray, temperature_k: float) -> tuple[FloatArray, float]:
    """Return candidate minus reference in kJ/mol, cut off at the second number; NaN where there are too few counts."""
    rt_kj = GAS_CONSTANT_KJ_MOL_K * temperature_k
    p_reference, p_candidate = (counts / max(counts.sum(), 1.0) for counts in (reference, candidate))
    with np.errstate(divide="ignore", invalid="ignore"):
        change = -rt_kj * np.log(p_candidate / p_reference)
    enough = np.maximum(reference, candidate) >= _MIN_COUNT
    return np.where(enough, np.clip(change, -DIFFERENCE_MAX_KJ, DIFFERENCE_MAX_KJ), np.nan), DIFFERENCE_MAX_KJ


def map_caption() -> str:
    """Return what a difference map shows."""
    rare, often = DIFFERENCE_COLOURS
    return f"Candidate minus reference: {rare} where the candidate comes too rarely, {often} where too often"


def _torsion_map(
    figure: Any, axes: Any, values: FloatArray, colours: str, limits: tuple[float, float], step: float
) -> None:
    paint_map(figure, axes, values, colours, limits, step, (-180, 180, -180, 180))
    _degrees(axes, both=True)
    axes.set_xlabel("φ / °")
    axes.set_ylabel("ψ / °", labelpad=-5)


def paint_map(
    figure: Any,
    axes: Any,
    values: FloatArray,
    colours: str,
    limits: tuple[float, float],
    step: float,
    extent: tuple[float, float, float, float],
) -> None:
    """Paint `values (n_x, n_y)` kJ/mol over `extent` (left, right, bottom, top) with a colour bar; NaN stays empty."""
    axes.set_facecolor(EMPTY)
    image = axes.imshow(
        values.T,
        origin="lower",
        extent=extent,
        aspect="auto",
        cmap=_visible(colours),
        vmin=limits[0],
        vmax=limits[1],
        interpolation="nearest",
    )
    bar = figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
    bar.outline.set_visible(False)
    bar.set_ticks(np.arange(limits[0], limits[1] + 0.5 * step, step).tolist())
    bar.ax.set_title("kJ/mol", fontsize=8, pad=5)


def correlation(data: CorrelationCurve) -> str:
    """Return the autocorrelation curves with their 95 % bands."""

    def paint(figure: Any, axes: Any) -> None:
        axes.axhline(0.0, color=LINE, linewidth=0.8)
        axes.fill_between(data.lag_ps, data.reference_low, data.reference_high, color=TEXT, alpha=0.15, linewidth=0)
        axes.fill_between(data.lag_ps, data.candidate_low, data.candidate_high, color=CANDIDATE, alpha=0.2, linewidth=0)
        axes.plot(data.lag_ps, data.reference, color=TEXT)
        axes.plot(data.lag_ps, data.replicate, color=REPLICATE, linestyle=(0, (4, 2)))
        axes.plot(data.lag_ps, data.candidate, color=CANDIDATE)
        axes.set_xlim(0, data.lag_ps[-1])
        lowest = np.nanmin(np.concatenate([data.reference, np.nan_to_num(data.candidate), [-0.05]]))
        axes.set_ylim(max(1.1 * float(lowest), -1.0), 1.02)
        axes.set_xlabel("lag / ps")
        axes.set_ylabel("C(lag)")

    return draw(f"Autocorrelation of {data.label}", CURVE_SIZE, paint)


def histogram(data: Histogram) -> str:
    """Return the three densities as steps."""
    scale = 180.0 / math.pi if data.unit == "rad" else 1.0

    def paint(figure: Any, axes: Any) -> None:
        for values, colour, style in (
            (data.reference, TEXT, "solid"),
            (data.replicate, REPLICATE, (0, (4, 2))),
            (data.candidate, CANDIDATE, "solid"),
        ):
            axes.stairs(
                values / scale,
                data.edges * scale,
                color=colour,
                linestyle=style,
                linewidth=1.4,
                baseline=None,
            )
        axes.set_xlim(data.edges[0] * scale, data.edges[-1] * scale)
        axes.set_ylim(bottom=0)
        if data.unit == "rad":
            _degrees(axes, both=False)
        unit = "°" if data.unit == "rad" else data.unit
        axes.set_xlabel(textwrap.fill(f"{data.label} / {unit}" if unit else data.label, _LABEL_WIDTH))
        axes.set_ylabel("density")
        axes.set_yticks([])

    return draw(f"Distribution of {data.label}", CURVE_SIZE, paint)


def timeline(data: Timeline) -> str:
    """Return the share of faulty frames along the trajectory, with segment and chunk boundaries."""

    def paint(figure: Any, axes: Any) -> None:
        unit, scale = ("ns", 1e-3) if data.edges_ps[-1] >= 2000 else ("ps", 1.0)
        edges = data.edges_ps * scale
        top = 100.0 * float((data.invalid + data.strained).max())
        axes.stairs(100 * (data.invalid + data.strained), edges, fill=True, color=STRAINED)
        axes.stairs(100 * data.invalid, edges, fill=True, color=FAULT)
        for at in data.chunks_ps[1:]:
            axes.axvline(at * scale, color=LINE, linewidth=0.5)
        for at in data.segments_ps[1:]:
            axes.axvline(at * scale, color=TEXT, linewidth=0.9, linestyle=(0, (1, 1)))
        axes.set_xlim(edges[0], edges[-1])
        axes.set_ylim(0, 1.1 * top if top > 0 else 1.0)
        axes.set_xlabel(f"time, segments end to end / {unit}")
        axes.set_ylabel("frames / %")

    return draw(f"Faulty frames of {data.label} along time", CURVE_SIZE, paint)


def by_position(data: Timeline) -> str:
    """Return the share of invalid frames against the place of a frame in its chunk."""

    def paint(figure: Any, axes: Any) -> None:
        place = np.arange(len(data.by_position) + 1)
        axes.stairs(100 * data.by_position, place, fill=True, color=FAULT)
        axes.set_xlim(0, place[-1])
        axes.set_ylim(0, 110 * float(data.by_position.max()) or 1.0)
        axes.set_xlabel("frame within its chunk")
        axes.set_ylabel("invalid frames / %")

    return draw(f"Invalid frames of {data.label} by place in the chunk", CURVE_SIZE, paint)
