"""A benchmark of run time against error, and of effective samples a second, as Markdown tables, JSON and plots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from surrogate.bench.accuracy import break_even, fastest_openmm, pareto_front
from surrogate.bench.stress_page import table
from surrogate.bench.timing import OURS
from systems.files.whole_file import create_whole

# A rollout with fewer whole molecules is drawn hollow, and nobody should count its error.
SOUND_PERCENT = 99.0
_COLOURS = {"multistep": "#1f77b4", "fitted": "#d62728", "euler": "#7f7f7f"}
# Of these the shorter parts of a rollout are drawn, too.
_DRAWN_STEPS = (4, 10)
_MD_STYLES = (":", "--", "-")


def write_cost_error(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write cost_error.json, .md and, where a setting was measured, .svg and effective_samples.svg; return them. Raises
    StorageError."""
    written = [folder / "cost_error.json", folder / "cost_error.md"]
    create_whole(written[0], json.dumps(result, indent=1))
    create_whole(written[1], markdown(result))
    if any("jsd" in row for row in result["rows"]):
        written.append(folder / "cost_error.svg")
        create_whole(written[2], lambda path: plot(result, path))
    if any(row.get("effective_per_s") for row in result["rows"]):
        written.append(folder / "effective_samples.svg")
        create_whole(written[-1], lambda path: plot_effective(result, path))
    return written


def markdown(result: dict[str, Any]) -> str:
    """Return the tables: MD, the settings, effective samples."""
    md, config = result["md"], result["config"]
    correlation = np.mean([one["value"] for one in md["correlation"]])
    relaxation_ps = np.mean([one["value"] for one in md["relaxation_ps"]])
    columns = (md[key] for key in ("lengths_ps", "errors", "errors_low", "errors_high"))
    by_length = "; ".join(
        f"{1e-3 * ps:.3g} ns {error:.3f} [{low:.3f}, {high:.3f}]" for ps, error, low, high in zip(*columns, strict=True)
    )
    lines = [
        f"# Run time against error: {result['scene']}",
        "",
        f"Rollouts of {1e-3 * config['time_ps']:g} ns in all replicas, against two held-out runs of "
        f"{1e-3 * md['length_ps']:g} ns; processor seconds on {config['threads']} thread(s), mean of "
        f"{config['rounds']} parts [least, greatest]; 95 % intervals in brackets elsewhere.",
        "",
        *([result["machine"]["about"], ""] if "machine" in result else []),
        "## MD",
        "",
        *table([_md_row(row, md) for row in md["cost"]]),
        "",
        "JSD of MD by length, typical piece [10 %, 90 % of pieces]: "
        f"{by_length}. The same at each time step, by simulated time.",
        "",
        "## Settings",
        "",
        *table([_row(row, md["errors"][0]) for row in result["rows"]]),
        "",
        "JSD: Jensen-Shannon distance of the joint φ/ψ map (50 x 50) to the held-out runs, root mean square; "
        f"{md['replicate_baseline']:.3f} is what these have between them, and nothing below is claimed. MD, "
        "same seconds: the JSD of as many processor seconds of OpenMM at 4 fs. Equivalent MD time: how much MD "
        "is as far from the reference; faster: what that MD takes, over what the rollout took. C1: autocorrelation of "
        f"cos ψ after one frame (reference {correlation:.3f}), τ: its relaxation time (reference {relaxation_ps:.1f} "
        "ps). Bond variance: of bonds that vibrate, in per cent of the reference's. (timed): not rolled on, as "
        "replicas do not depend on those beside them.",
        "",
        *effective_lines(result),
    ]
    return "\n".join(lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Draw error against processor seconds, logarithmic: MD of every length, each setting and its shorter parts."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import FixedLocator, ScalarFormatter

    figure = Figure(figsize=(8.2, 5.4), layout="constrained")
    axes = figure.add_subplot()
    md = result["md"]
    for cost, style in zip((c for c in md["cost"] if c["way"] == OURS), _MD_STYLES, strict=False):
        x = 1e-3 * np.asarray(md["lengths_ps"]) * cost["cpu_s_per_ns"]["mean"]
        label = f"OpenMM, {cost['timestep_fs']:g} fs"
        axes.plot(x, md["errors"], style, color="black", lw=1.4 if style == "-" else 0.9, label=label)
        if style == "-":
            axes.fill_between(x, md["errors_low"], md["errors_high"], color="black", alpha=0.1, lw=0)
    _draw_baseline(axes, md)
    evaluated = [row for row in result["rows"] if "jsd" in row]
    colours = {row["solver"]: _COLOURS.get(row["solver"] or "", "#2ca02c") for row in evaluated}
    for solver, colour in colours.items():
        axes.plot([], [], "o", color=colour, label=solver or "surrogate")
    for row in evaluated:
        colour = colours[row["solver"]]
        sound = row["valid_half_angstrom_%"]["value"] >= SOUND_PERCENT
        plain = "," not in row["label"]
        x, y, low, high = row["spent_s"], *(row["jsd"][key] or row["jsd"]["value"] for key in ("value", "low", "high"))
        bar = [[max(y - max(low, 0.5 * y), 0.0)], [max(high - y, 0.0)]]
        axes.errorbar(x, y, bar, color=colour, lw=0.7, capsize=0)
        axes.plot(x, y, "o" if plain else "s", color=colour, mfc=colour if sound else "white", ms=6 if plain else 4.5,
                  zorder=3)  # fmt: skip
        text = f"{row['steps']}" if plain else row["label"].split(", ", 1)[-1]
        axes.annotate(text, (x, y), xytext=(5, 3), textcoords="offset points", fontsize=7.5, color=colour)
        if plain and row["steps"] in _DRAWN_STEPS:
            ps, errors = np.asarray(row["curve"]).T
            axes.plot(1e-3 * ps * row["cpu_s_per_ns"]["mean"], errors, "-", color=colour, lw=0.8, alpha=0.6)
    axes.set(xscale="log", yscale="log", xlabel="processor time / s (one core)",
             ylabel="Jensen-Shannon distance of the φ/ψ map to held-out MD",
             title=f"{result['scene']}: run time against error")  # fmt: skip
    axes.yaxis.set_major_locator(FixedLocator([0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8]))
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_locator(FixedLocator([]))
    axes.grid(alpha=0.25, which="major")
    axes.plot([], [], "o", color="grey", mfc="white", label=f"under {SOUND_PERCENT:g} % of frames whole")
    axes.legend(frameon=False, fontsize=8.5, title="numbers: solver steps", title_fontsize=8)
    figure.savefig(path, format="svg", dpi=140)


def _draw_baseline(axes: Any, md: dict[str, Any]) -> None:
    axes.axhline(md["replicate_baseline"], color="black", lw=0.8, alpha=0.5)
    at = (0.01, md["replicate_baseline"])
    text = f"two runs of {1e-3 * md['length_ps']:g} ns"
    axes.annotate(text, at, xycoords=("axes fraction", "data"), va="bottom", fontsize=8)


def _row(row: dict[str, Any], shortest: float) -> dict[str, Any]:
    """Return the cells of a setting; `shortest` is the error of the shortest MD at hand."""
    out: dict[str, Any] = {"weights": row["weights"], "setting": row["label"]}
    if "outcome" in row:
        return out | {"evaluations": row["outcome"]}
    out |= {
        "evaluations": f"{row['evaluations']:.3g}",
        "s/ns": _range(row["cpu_s_per_ns"]),
        "wall s/ns": f"{row['wall_s_per_ns']['mean']:.3g}",
        "x MD 4 fs": _range(row["speed_over_md"]),
    }
    if "jsd" not in row:
        return out | {"JSD": "(timed)"}
    equivalent_time = row["equivalent_time"]
    faster = [row[f"times_faster{end}"] for end in ("", "_low", "_high")]
    bound = {"at least": "≥ ", "less than": "< "}.get(equivalent_time["bound"], "")
    ends = "" if bound else f" [{_short(faster[1])}, {_short(faster[2])}]"
    same = row["md_of_same_seconds"]
    return out | {
        "0.5 Å %": f"{row['valid_half_angstrom_%']['value']:.2f}",
        "20 % %": f"{row['bonds_20_percent_%']['value']:.2f}",
        "JSD": _interval(row["jsd"], 3),
        "MD, same seconds": f"> {shortest:.3f}" if same is None else f"{same:.3f}",
        "equivalent_time": equivalent_time["words"],
        "faster": f"{bound}{faster[0]:.2g}{ends}",
        "C1": _number(row["correlation"]["value"], 3),
        "τ / ps": _interval(row["relaxation_ps"], 1),
        "bond variance %": _number(row.get("bond_variance_%"), 0),
    }


def _md_row(row: dict[str, Any], md: dict[str, Any]) -> dict[str, Any]:
    return {
        "time step": row["label"].removeprefix("OpenMM, "),
        "s/ns": _range(row["cpu_s_per_ns"]),
        "wall s/ns": f"{row['wall_s_per_ns']['mean']:.3g}",
        f"s to {md['replicate_baseline']:.3f}": f"{1e-3 * md['length_ps'] * row['cpu_s_per_ns']['mean']:.3g}",
    }


def _range(spread: dict[str, float]) -> str:
    return f"{spread['mean']:.3g} [{spread['least']:.3g}, {spread['greatest']:.3g}]"


def _interval(found: dict[str, Any], digits: int) -> str:
    if found["low"] is None or found["high"] is None:
        return _number(found["value"], digits)
    return f"{found['value']:.{digits}f} [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"


def _number(value: float | None, digits: int) -> str:
    return "none" if value is None else f"{value:.{digits}f}"


def _short(value: float | None) -> str:
    return "..." if value is None else f"{value:.2g}"


# ---- effective samples ----------------------------------------------------------------------------------------------


def effective_lines(result: dict[str, Any]) -> list[str]:
    """Return the section of the page; why there is none, where no torsion relaxes often enough to count by."""
    md = result["md"]
    slow = md.get("slowest")
    if slow is None:
        return ["No torsion relaxes 50 times over in the MD at hand: effective samples are not counted.", ""]
    points = _points(result)
    front = set(pareto_front([(one["rate"], one["distance"]) for one in points]))
    best = 1e3 / fastest_openmm(md) / (2.0 * slow["tau_ps"])
    rows = [
        {"what": one["name"], "effective samples/s": f"{one['rate']:.3g}", "over OpenMM": f"{one['rate'] / best:.3g}",
         "JSD": f"{one['distance']:.3f}", "front": "yes" if k in front else ""}
        for k, one in enumerate(points)
    ]  # fmt: skip
    return [
        "## Effective samples",
        "",
        *table(rows),
        "",
        f"Simulated time over 2 max(τ, τ of MD) of {slow['name']} (MD: {slow['tau_ps']:.1f} ps, {slow['samples']:.0f} "
        f"of them at hand), a processor second; distances after {1e-3 * result['config']['time_ps']:g} ns, of MD of "
        f"that length, too. Front: none is both faster and nearer. Settings under {SOUND_PERCENT:g} % of whole frames "
        "are left out. Over OpenMM: at its fastest. Plain: its own files and defaults. SIMD: sixteen at once.",
        "",
        *_break_even(result, points, best, slow["tau_ps"]),
    ]


def _break_even(result: dict[str, Any], points: list[dict[str, Any]], md_rate: float, tau_ps: float) -> list[str]:
    lines = []
    rates = {one["name"]: one["rate"] for one in points}
    for row in result["rows"]:
        name, before = f"{row['weights']}, {row['label']}", row.get("before")
        if before is None or name not in rates or before["training_s"] is None:
            continue
        words = []
        for what, spent in (
            ("set-up", row.get("first_chunks_s", 0.0)),
            ("training", before["training_s"]),
            ("training and its reference", before["training_s"] + before["reference_s"]),
        ):
            n = break_even(spent, rates[name], md_rate)
            after = "never" if n is None else f"{n:.3g} samples, {2e-3 * tau_ps * n:.3g} ns of MD"
            words.append(f"{what} ({spent:.3g} s): {after}")
        lines.append(f"- {name}: " + "; ".join(words))
    return ["Paid for, beside OpenMM at its fastest, after:", "", *lines, ""] if lines else []


def plot_effective(result: dict[str, Any], path: Path) -> None:
    """Draw distance against effective samples a second, both logarithmic, and the front."""
    from matplotlib.figure import Figure

    points = _points(result)
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    axes = figure.add_subplot()
    for one in points:
        at, colour = (one["rate"], one["distance"]), "black" if one["md"] else "#d62728"
        axes.plot(*at, "s" if one["md"] else "o", color=colour, ms=5)
        axes.annotate(one["name"], at, xytext=(5, 3), textcoords="offset points", fontsize=7.5)
    front = [points[k] for k in pareto_front([(one["rate"], one["distance"]) for one in points])]
    axes.plot([one["rate"] for one in front], [one["distance"] for one in front], "-", color="grey", lw=0.8, zorder=0)
    _draw_baseline(axes, result["md"])
    axes.set(xscale="log", yscale="log", xlabel="effective samples a processor second (one core)",
             ylabel="Jensen-Shannon distance of the φ/ψ map to held-out MD",
             title=f"{result['scene']}: effective samples against distance")  # fmt: skip
    axes.grid(alpha=0.25)
    axes.plot([], [], "s", color="black", label="MD")
    axes.plot([], [], "o", color="#d62728", label="surrogate")
    axes.legend(frameon=False, fontsize=8.5)
    figure.savefig(path, format="svg", dpi=140)


def _points(result: dict[str, Any]) -> list[dict[str, Any]]:
    """MD and the settings whose molecules are whole: name, effective samples a second, distance."""
    md, tau_ps = result["md"], result["md"]["slowest"]["tau_ps"]
    length = min(result["config"]["time_ps"], md["lengths_ps"][-1])
    distance = float(np.exp(np.interp(np.log(length), np.log(md["lengths_ps"]), np.log(md["errors"]))))
    rates = {cost["label"]: 1e3 / cost["cpu_s_per_ns"]["mean"] / (2.0 * tau_ps) for cost in md["cost"]}
    points = [{"name": name, "rate": rate, "distance": distance, "md": True} for name, rate in rates.items()]
    for row in result["rows"]:
        if row.get("effective_per_s") and row["valid_half_angstrom_%"]["value"] >= SOUND_PERCENT:
            name, error = f"{row['weights']}, {row['label']}", row["jsd"]["value"]
            points.append({"name": name, "rate": row["effective_per_s"], "distance": error, "md": False})
    return points
