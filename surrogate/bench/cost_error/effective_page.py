"""Effective samples a second against distance, as a table with the front and the break-even, and as a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from surrogate.bench.cost_error.effective_samples import break_even, pareto_front
from surrogate.bench.cost_error.sweep_settings import SIMD
from surrogate.bench.stress.stress_page import table


def effective_lines(result: dict[str, Any], sound_percent: float) -> list[str]:
    """Return the section of the page; why there is none, where no torsion relaxes often enough to count by."""
    md = result["md"]
    slow = md.get("slowest")
    if slow is None:
        return ["No torsion relaxes 50 times over in the MD at hand: effective samples are not counted.", ""]
    points = _points(result, sound_percent)
    front = set(pareto_front([(one["rate"], one["distance"]) for one in points]))
    best = max(one["rate"] for one in points if one["md"] and one["way"] != SIMD)
    rows = [
        {
            "what": one["name"],
            "effective samples/s": f"{one['rate']:.3g}",
            "over OpenMM": f"{one['rate'] / best:.3g}",
            "JSD": f"{one['distance']:.3f}",
            "front": "yes" if k in front else "",
        }
        for k, one in enumerate(points)
    ]
    return [
        "## Effective samples",
        "",
        *table(rows),
        "",
        f"Simulated time over 2 max(τ, τ of MD) of {slow['name']} (MD: {slow['tau_ps']:.1f} ps, {slow['samples']:.0f} "
        f"of them at hand), a processor second; distances after {1e-3 * result['config']['time_ps']:g} ns, of MD of "
        f"that length, too. Front: none is both faster and nearer. Settings under {sound_percent:g} % of whole frames "
        "are left out. Over OpenMM: at its fastest. Plain: its own files and defaults. SIMD: sixteen at once.",
        "",
        *_break_even(result, points, best, slow["tau_ps"]),
    ]


def _break_even(result: dict[str, Any], points: list[dict[str, Any]], md_rate: float, tau_ps: float) -> list[str]:
    lines = []
    rates = {one["name"]: one["rate"] for one in points}
    for row in result["rows"]:
        before = row.get("before")
        if before is None or _name(row) not in rates or before["training_s"] is None:
            continue
        words = []
        for what, spent in (
            ("set-up", row.get("first_chunks_s", 0.0)),
            ("training", before["training_s"]),
            ("training and its reference", before["training_s"] + before["reference_s"]),
        ):
            n = break_even(spent, rates[_name(row)], md_rate)
            told = "never" if n is None else f"{n:.3g} samples, {2e-3 * tau_ps * n:.3g} ns of MD"
            words.append(f"{what} ({spent:.3g} s): {told}")
        lines.append(f"- {_name(row)}: " + "; ".join(words))
    if not lines:
        return []
    return ["Paid for, beside OpenMM at its fastest, after:", "", *lines, ""]


def plot_effective(result: dict[str, Any], path: Path, sound_percent: float, form: str = "svg") -> None:
    """Draw distance against effective samples a second, both logarithmic, and the front."""
    from matplotlib.figure import Figure

    points = _points(result, sound_percent)
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    for one in points:
        axes.plot(
            one["rate"], one["distance"], "s" if one["md"] else "o", color="black" if one["md"] else "#d62728", ms=5
        )
        axes.annotate(
            one["name"], (one["rate"], one["distance"]), xytext=(5, 3), textcoords="offset points", fontsize=7.5
        )
    front = [points[k] for k in pareto_front([(one["rate"], one["distance"]) for one in points])]
    axes.plot([one["rate"] for one in front], [one["distance"] for one in front], "-", color="grey", lw=0.8, zorder=0)
    replicate_baseline = result["md"]["replicate_baseline"]
    axes.axhline(replicate_baseline, color="black", lw=0.8, alpha=0.5)
    axes.annotate(f"two runs of {1e-3 * result['md']['length_ps']:g} ns", (0.01, replicate_baseline),
                  xycoords=("axes fraction", "data"), va="bottom", fontsize=8)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="effective samples a processor second (one core)",
             ylabel="Jensen-Shannon distance of the φ/ψ map to held-out MD",
             title=f"{result['scene']}: effective samples against distance")  # fmt: skip
    axes.grid(alpha=0.25)
    axes.plot([], [], "s", color="black", label="MD")
    axes.plot([], [], "o", color="#d62728", label="surrogate")
    axes.legend(frameon=False, fontsize=8.5)
    figure.savefig(path, format=form, dpi=140)


def _points(result: dict[str, Any], sound_percent: float) -> list[dict[str, Any]]:
    """MD and the settings whose molecules are whole: name, effective samples a second, distance."""
    md = result["md"]
    slow = md["slowest"]
    length = min(result["config"]["time_ps"], md["lengths_ps"][-1])
    distance = float(np.exp(np.interp(np.log(length), np.log(md["lengths_ps"]), np.log(md["errors"]))))
    points = [
        {
            "name": cost["label"],
            "rate": 1e3 / cost["cpu_s_per_ns"]["mean"] / (2.0 * slow["tau_ps"]),
            "distance": distance,
            "md": True,
            "way": cost["way"],
        }
        for cost in md["cost"]
    ]
    return points + [
        {"name": _name(row), "rate": row["effective_per_s"], "distance": row["jsd"]["value"], "md": False}
        for row in result["rows"]
        if row.get("effective_per_s") and row["valid_half_angstrom_%"]["value"] >= sound_percent
    ]


def _name(row: dict[str, Any]) -> str:
    return f"{row['weights']}, {row['label']}"
