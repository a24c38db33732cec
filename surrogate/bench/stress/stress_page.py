"""A stress test's result as Markdown tables, a survival plot and JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from systems.files.whole_file import create_whole

TITLES = {
    "length": "Long rollouts",
    "invariance": "The first chunk of moved input, moved back: greatest deviation",
    "inputs": "Inputs pushed out of the training domain",
    "precision": "Arithmetic: the first chunk against float64",
    "batches": "Batch size: the first replica against the same alone",
    "solvers": "Solver steps, and chunks kept in part",
    "openmm": "OpenMM itself, by the same criteria",
}
_LEFT_TO_JSON = ("asked", "survival", "drift")
_DRIFT = {
    "bond_shift_pm": "mean bonds off, pm, first and last tenth",
    "bond_variance_%": "bond variance, % of the reference's",
}


def write_stress(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write stress.json, stress.md and, where rollouts were made, stress.svg; return them. Raises StorageError."""
    written = [folder / "stress.json", folder / "stress.md"]
    create_whole(written[0], json.dumps(result, indent=1))
    create_whole(written[1], markdown(result))
    curves = [row for row in result["sections"].get("length", []) if row.get("survival")]
    if curves:
        written.append(folder / "stress.svg")
        create_whole(written[2], lambda path: _plot(curves, path))
    return written


def markdown(result: dict[str, Any]) -> str:
    """Return the tables."""
    lines = [
        f"# Stress test of {result['weights']}",
        "",
        f"{result['domain']}; {result['model']}, {result['made']}",
        "",
        *([result["machine"]["about"], ""] if isinstance(result.get("machine"), dict) else []),
    ]
    for name, rows in result["sections"].items():
        lines += [f"## {TITLES[name]}", "", *table([_flat(row) for row in rows]), ""]
    lines += [
        "valid_half_angstrom: finite, and each bond within 0.5 Å of the reference's mean; valid_all: every rule of "
        "systems.chemistry.validity. chunks helped: those in which the guard caught a frame (under flag, only "
        "marked); checks and help: their time in per cent of the time that drawing took. A surrogate has no velocities "
        "that are its own: in place of a temperature stands the variance of bonds in per cent of the reference's.",
        "",
    ]
    return "\n".join(lines)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Return Markdown lines with a column for each key that a row has."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    if not keys:
        return ["nothing was run"]
    head = [key.replace("_", " ") for key in keys]
    lines = [head, ["---"] * len(keys), *([_text(row.get(key)) for key in keys] for row in rows)]
    return ["| " + " | ".join(cells) + " |" for cells in lines]


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    out = {key: value for key, value in row.items() if key not in _LEFT_TO_JSON}
    drift = row.get("drift", {})
    for key, title in _DRIFT.items():
        if key in drift.get("first", {}) and key in drift.get("last", {}):
            out[title] = f"{drift['first'][key]:.3g} → {drift['last'][key]:.3g}"
    if "torsion_jsd" in drift:
        replicate_baseline = drift.get("torsion_jsd_floor")
        out["torsion distance"] = f"{drift['torsion_jsd']:.3f}" + (
            f" (by chance {replicate_baseline:.3f})" if replicate_baseline else ""
        )
    if "energy_first_kj_mol" in drift and "energy_last_kj_mol" in drift:
        parts = [
            f"{drift[f'energy_{k}_kj_mol']:.1f} ± {drift[f'energy_{k}_error_kj_mol']:.1f}" for k in ("first", "last")
        ]
        out["relaxed energy, kJ/mol"] = " → ".join(parts)
    return out


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.2e}" if value and abs(value) < 1e-3 else f"{value:.6g}"
    return str(value).replace("|", "\\|")


def _plot(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot()
    styles = ("-", "--", ":", "-.")
    guards = list(dict.fromkeys(row["guard"] for row in rows))
    for row in rows:
        x, y = zip(*row["survival"], strict=True)
        style = styles[guards.index(row["guard"]) % len(styles)]
        axes.step(x, [100.0 * v for v in y], style, where="post", label=f"{row['guard']}, {row['frames']:,} frames")
    axes.set(xlabel="simulated time of a replica, ps", ylabel="replicas without a broken frame, %", ylim=(-3, 103))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(path, format="svg")
