"""The curves of a training as a picture: NAME.svg beside the CSV that the loop writes."""

from __future__ import annotations

import csv
from pathlib import Path

from systems.files.whole_file import create_whole

Rows = list[dict[str, str]]


def read_curves(path: Path) -> dict[str, Rows]:
    """Return the rows of a training's CSV by stage, in the order of the training."""
    stages: dict[str, Rows] = {}
    with path.open(newline="") as handle:
        for row in csv.DictReader(handle):
            stages.setdefault(row["stage"], []).append(row)
    return stages


def series(rows: Rows, column: str) -> tuple[list[float], list[float]]:
    """Return the steps and values of one column, where it has any."""
    kept = [row for row in rows if row.get(column)]
    return [float(row["step"]) for row in kept], [float(row[column]) for row in kept]


def plot_curves(path: Path) -> Path:
    """Draw one panel per stage, errors in training (broken) and validation (full) over steps; return the .svg."""
    from matplotlib.figure import Figure

    stages = read_curves(path)
    figure = Figure(figsize=(5.5 * max(1, len(stages)), 4.0), layout="constrained")
    for panel, (stage, rows) in zip(figure.subplots(1, len(stages), squeeze=False)[0], stages.items(), strict=True):
        for column in [c for c in rows[0] if c.startswith(("train_", "validation_"))]:
            steps, values = series(rows, column)
            if steps and min(values) > 0.0:
                held = column.startswith("validation_")
                panel.plot(steps, values, "-" if held else "--", marker=".", label=column.replace("_", " "))
        panel.set(title=stage, xlabel="step", ylabel="error or gradient norm", yscale="log")
        if panel.has_data():
            panel.legend(fontsize="x-small")
    out = path.with_suffix(".svg")
    create_whole(out, lambda temporary: figure.savefig(temporary, format="svg"))
    return out
