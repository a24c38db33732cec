"""What `surromd compare` says of rollouts of unseen peptides: the gate `verdicts` of `peptide_gates`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Evaluation

# Rows of the comparison that the table shows, by their keys, in their units.
ROWS = {
    "msm_timescale": "slowest process of the MSM, ps",
    "msm_jsd": "MSM populations, distance",
    "valid:all": "valid, %",
    "temperature": "vibrations, K",
}


def verdict_row(evaluated: Evaluation) -> dict[str, Any]:
    """Return a molecule's verdict: each of ROWS for MD, the model and the replicate with their 95 % intervals, and by
    each measure how many ns of MD the rollouts are worth."""
    found: dict[str, Any] = {
        "status": evaluated.status,
        "verdict": evaluated.verdict,
        "compared_ps": evaluated.compared_ps,
    }
    for key in ROWS:
        try:
            row = evaluated.row(key)
        except InputError:
            continue
        found[key] = {
            source: None if value is None else [value.value, value.low, value.high]
            for source, value in (("MD", row.reference), ("model", row.candidate), ("replicate", row.replicate))
        }
    found["equivalent_ns"] = {
        w.measure: [None if x is None else x / 1000.0 for x in (w.equivalent_ps, w.low_ps, w.high_ps)]
        for w in evaluated.equivalent_time
    }
    return found


def verdicts_gate(a: argparse.Namespace) -> None:
    """Compare the rollouts that the gate `pairs` left in FOLDER with the first half of each molecule's runs of MD, the
    other half as the replicate; print and keep the table. A report of each lies beside it."""
    from surrogate.api import compare

    record = {}
    for folder in sorted(path for path in (a.folder / a.rollouts).iterdir() if path.is_dir()):
        rollouts = sorted(folder.glob("*.h5"))
        runs = sorted((a.test / folder.name).glob("run_*.h5"))
        half = len(runs) // 2
        if half and len(rollouts) >= half:
            compared = compare(
                runs[:half], [rollouts[:half]], folder / "report.html", replicate=runs[half:], overwrite=True
            )
            record[folder.name] = verdict_row(compared.evaluations[0])
            sys.stderr.write(f"{folder.name}: {record[folder.name]['verdict']}\n")
    (a.folder / "verdicts.json").write_text(json.dumps(record, indent=1))
    sys.stdout.write(verdicts_table(record) + "\n")


def verdicts_table(record: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the record as Markdown: of each row the model's value beside MD's interval."""
    lines = [
        "| molecule | " + " | ".join(ROWS.values()) + " | equivalent MD time, ns |",
        "|" + "---|" * (len(ROWS) + 2),
    ]
    for molecule, found in record.items():
        cells = [_cell(found[key]) if key in found else "-" for key in ROWS]
        equivalent_time = [value for value in found["equivalent_ns"].values() if value[0] is not None]
        least = min(equivalent_time, key=lambda value: value[0]) if equivalent_time else None
        lines.append(f"| {molecule} | " + " | ".join([*cells, _interval(least)]) + " |")
    return "\n".join(lines)


def _cell(row: Mapping[str, Sequence[float] | None]) -> str:
    return " / ".join(_interval(row[source]) for source in ("model", "MD", "replicate") if row[source] is not None)


def _interval(value: Sequence[float | None] | None) -> str:
    if value is None:
        return "-"
    middle, *ends = (None if x is None else f"{x:.3g}" for x in value)
    return f"{middle} [{', '.join(x or '-' for x in ends)}]"
