"""A benchmark of run time against error as a Markdown table, JSON and a plot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from surrogate.bench.cost_error.effective_page import effective_lines, plot_effective
from surrogate.bench.cost_error.sweep_settings import OURS
from surrogate.bench.stress.stress_page import table
from systems.files.whole_file import create_whole

# A rollout with fewer whole molecules is drawn hollow, and nobody should count its error.
SOUND_PERCENT = 99.0
_COLOURS = {"multistep": "#1f77b4", "fitted": "#d62728", "euler": "#7f7f7f", "dopri5": "#9467bd"}
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
        create_whole(written[-1], lambda path: plot_effective(result, path, SOUND_PERCENT))
    return written


def markdown(result: dict[str, Any]) -> str:
    """Return the tables: MD, the settings, and where their curves cross."""
    md, config = result["md"], result["config"]
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
        + "; ".join(
            f"{1e-3 * ps:.3g} ns {error:.3f} [{low:.3f}, {high:.3f}]"
            for ps, error, low, high in zip(
                md["lengths_ps"], md["errors"], md["errors_low"], md["errors_high"], strict=True
            )
        )
        + ". The same at each time step, by simulated time.",
        "",
        "## Settings",
        "",
        *table([_row(row, _varies(result["rows"]), md["errors"][0]) for row in result["rows"]]),
        "",
        "JSD: Jensen-Shannon distance of the joint φ/ψ map (50 x 50) to the held-out runs, root mean square; "
        f"{md['replicate_baseline']:.3f} is what these have between them, and nothing below is claimed. MD, "
        "same seconds: the JSD of as many processor seconds of OpenMM at 4 fs. Equivalent MD time: how much MD "
        "is as far from the "
        "reference; faster: what that MD takes, over what the rollout took. C1: autocorrelation of cos ψ after one "
        f"frame (reference {_mean(md['correlation']):.3f}), τ: its relaxation time (reference "
        f"{_mean(md['relaxation_ps']):.1f} ps). "
        "Bond variance: of bonds that vibrate, in per cent of the reference's. (timed): not rolled on, as replicas do "
        "not depend on those beside them.",
        "",
        *crossings(result),
        *effective_lines(result, SOUND_PERCENT),
    ]
    return "\n".join(lines)


def crossings(result: dict[str, Any]) -> list[str]:
    """Return in words where each setting's point lies beside MD's curve; nothing of settings that break molecules."""
    lines = []
    for row in _evaluated(result):
        if row["valid_half_angstrom_%"]["value"] < SOUND_PERCENT:
            continue
        md_s = row["md_s_per_ns"]["mean"] * 1e-3 * row["equivalent_time"]["equivalent_ps"]
        words = {"at least": "at least ", "less than": "less than "}.get(row["equivalent_time"]["bound"], "")
        lines.append(
            f"- {_name(row, result['rows'])}: after {row['spent_s']:.3g} s at {row['jsd']['value']:.3f}; OpenMM (4 fs) "
            f"is there after {words}{md_s:.3g} s ({row['equivalent_time']['words']})."
        )
    return ["Where MD's curve crosses:", "", *lines, ""] if lines else []


def plot(result: dict[str, Any], path: Path, form: str = "svg") -> None:
    """Draw error against processor seconds, logarithmic: MD of every length, each setting and its shorter parts."""
    import numpy as np
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
    axes.axhline(md["replicate_baseline"], color="black", lw=0.8, alpha=0.5)
    axes.annotate(
        f"two runs of {1e-3 * md['length_ps']:g} ns",
        (0.01, md["replicate_baseline"]),
        xycoords=("axes fraction", "data"),
        va="bottom",
        fontsize=8,
    )
    evaluated = _evaluated(result)
    for solver in dict.fromkeys(row["solver"] for row in evaluated):
        axes.plot([], [], "o", color=_colour(solver), label=solver or "surrogate")
    for row in evaluated:
        colour = _colour(row["solver"])
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
    figure.savefig(path, format=form, dpi=140)


def _evaluated(result: dict[str, Any]) -> list[dict[str, Any]]:
    return [row for row in result["rows"] if "jsd" in row]


def _colour(solver: str | None) -> str:
    return _COLOURS.get(solver or "", "#2ca02c")


def _varies(rows: list[dict[str, Any]]) -> list[str]:
    """What of the weights differs between rows, and is worth a column."""
    keys = ("weights", "clean_conditioning")
    return [key for key in keys if len({row.get(key) for row in rows}) > 1]


def _name(row: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    return f"{row['weights']}, {row['label']}" if "weights" in _varies(rows) else str(row["label"])


def _row(row: dict[str, Any], varies: list[str], shortest: float) -> dict[str, Any]:
    """Return the cells of a setting; `shortest` is the error of the shortest MD at hand."""
    out: dict[str, Any] = {key: row.get(key) for key in varies}
    out |= {"setting": row["label"]}
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


def _mean(found: list[dict[str, Any]]) -> float:
    return sum(float(one["value"]) for one in found) / len(found)


def _short(value: float | None) -> str:
    return "..." if value is None else f"{value:.2g}"
