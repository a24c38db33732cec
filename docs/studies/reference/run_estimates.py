"""What `surromd run` estimates, and the equivalent MD time it tells, held against long MD made for the purpose.

    python docs/studies/reference/run_estimates.py RUNS LONG [--time 20ns] [-o docs/results/tables/run_estimates.json]

RUNS holds folders of runs. LONG gets a folder of the same name for each, with sixteen SIMD replicas of MD of
`--time` each, from another seed; what is there is not made again. Half of them is the reference, the other its
replicate.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.verbs.run.run_record import RUN_NAME, RunResult
from systems.units import format_time_ps, format_wall, parse_time_ps

REPLICAS = 16
SEED = 77


def long_md(record: dict[str, Any], folder: Path, time_ps: float) -> list[Path]:
    """Return files of long MD of a run's scene, frames as far apart as its own."""
    found = sorted(folder.glob("md_r*.h5"))
    if len(found) < REPLICAS:
        folder.mkdir(parents=True, exist_ok=True)
        every_ps = record["decision"]["save_every_ps"]
        sm.reference(
            record["scene"], folder / "md.h5", time_ps=every_ps * round(time_ps / every_ps), save_every_ps=every_ps,
            replicas=REPLICAS, platform="simd", seed=SEED, resume=True, quiet=True,
        )  # fmt: skip
        found = sorted(folder.glob("md_r*.h5"))
    return found


def row(run: Path, long: list[Path]) -> list[str]:
    """Return a line of the table."""
    record = RunResult.of(run)
    decision, outcome, settings = record["decision"], record["outcome"], record["settings"]
    made_ps = outcome["held_out_ps"] + outcome["rolled_ps"]
    planned_ps = decision["expected_md_ps"] + decision["expected_rollout_ps"]
    half = len(long) // 2
    evaluated = sm.compare(
        long[:half], [[run / file for file in record["trajectory"]]], replicate=long[half:]
    ).evaluations[0]  # fmt: skip
    equivalent_time = next((w for w in evaluated.equivalent_time if w.kind == "distribution"), None)
    return [
        run.name,
        f"{decision['way']}, {format_wall(settings['budget_s'])}",
        f"{record['spent_s'] / settings['budget_s'] - 1:+.0%}",
        f"{format_time_ps(planned_ps, 2)}",
        f"{made_ps / planned_ps:.2f}",
        outcome["equivalent_time"] or "not told",
        equivalent_time.in_words() if equivalent_time and evaluated.equivalent_time_words else "not told",
        outcome["status"],
        evaluated.status,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path)
    parser.add_argument("long", type=Path)
    parser.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=20_000.0)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    rows = []
    for run in sorted(path.parent for path in given.runs.glob(f"*/{RUN_NAME}")):
        record = RunResult.of(run)
        if record["outcome"] is None:
            continue
        rows.append(row(run, long_md(record, given.long / run.name, given.time)))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": "python docs/studies/reference/run_estimates.py RUNS LONG",
            "machine": machine_name(),
            "note": f"Long MD: {REPLICAS} replicas of {format_time_ps(given.time)} each, by SIMD, from another seed.",
            "columns": ["scene", "way, budget", "time over budget", "planned in all", "made, of planned",
                        "equivalent MD time told",
                        "equivalent MD time by long MD", "verdict told", "verdict by long MD"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
