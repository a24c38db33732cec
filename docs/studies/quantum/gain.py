"""What potentials made by `surromd run` are worth by long MD of GFN2-xTB, and what that is of the MD their time buys.

    python docs/studies/quantum/gain.py SCENE FOLDER [--budgets 10min,20min] [--time 4ns]
        [-o docs/results/tables/potential_gain.json]

FOLDER gets a run of each budget, `surromd run SCENE --level gfn2-xtb --way surrogate`, and two runs of MD of `--time`
each, from another seed, that judge them: one is the truth, the other its replicate. What is there is not made again,
what was stopped goes on. Worth ends at `--time`. Gain: worth over the MD on all cores in the wall time of training and
of the part of the rollout that comes so near, with the 95 % interval of the worth.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.judge.worth import Worth
from surrogate.verbs.run.run_record import RUN_NAME, RunRecord, read_run
from surrogate.verbs.run.stages import costs_of
from systems.units import format_time_ps, format_wall, parse_time_ps, parse_wall_s

LEVEL, SAVE_PS, SEED = "gfn2-xtb", 0.5, 77


def made(scene: str, folder: Path, budget_s: float) -> RunRecord:
    """Return the record of a run, made where it is not done."""
    is_there = (folder / RUN_NAME).is_file()
    if not is_there or read_run(folder).outcome is None:
        sm.run(scene, folder, budget_s=budget_s, level=LEVEL, way="surrogate", quiet=True, resume=is_there)
    return read_run(folder)


def gain_words(worth: Worth, bought_ps: float) -> str:
    """Return a worth over the MD that its cost buys, with the interval: 'at least 5.7 [1.9, ...]'."""
    ends = [None if end is None else f"{end / bought_ps:.2g}" for end in (worth.low_ps, worth.high_ps)]
    said = f"{worth.bound} {worth.worth_ps / bought_ps:.2g}".strip()
    if ends == [None, None]:
        return said
    return f"{said} [{ends[0] or '...'}, {ends[1] or '...'}]"


def row(folder: Path, record: RunRecord, long: list[Path]) -> list[str]:
    """Return a line of the table."""
    comparison = sm.compare(long[0], [[folder / file for file in record.trajectory]], replicate=long[1])
    assert record.outcome is not None
    judged, costs = comparison.judgements[0], costs_of(record, comparison, record.outcome.held_out_ps)
    worth = next((w for w in judged.worth if w.kind == "distribution"), None) if judged.worth_words else None
    share = worth.share if worth else 1.0
    bought_ps = costs.md_ps_per_s * (costs.training_s + share * costs.rolling_s)
    return [
        format_wall(record.settings["budget_s"]),
        format_wall(costs.training_s),
        f"{format_time_ps(judged.account.total_ps, 2)} in {format_wall(costs.rolling_s)}",
        record.outcome.worth or "not told",
        worth.in_words() if worth else "not told",
        format_time_ps(bought_ps, 2),
        gain_words(worth, bought_ps) if worth else "not told",
        judged.status,
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budgets", default="10min,20min", help="of wall time, for a run each")
    parser.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=4_000.0)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    runs = [given.folder / budget for budget in given.budgets.split(",")]
    records = [made(given.scene, run, parse_wall_s(run.name)) for run in runs]
    long = sm.reference(
        given.scene, given.folder / "md.h5", time_ps=given.time, save_every_ps=SAVE_PS, level=LEVEL, replicas=2,
        seed=SEED, resume=True, quiet=True,
    )  # fmt: skip
    rows = []
    for run, record in zip(runs, records, strict=True):
        rows.append(row(run, record, long))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": f"python docs/studies/quantum/gain.py {given.scene!r} FOLDER",
            "machine": machine_name(),
            "note": f"{given.scene}, two runs of {format_time_ps(given.time)} of {LEVEL} from another seed.",
            "columns": ["budget", "trained for", "rolled", "worth told", "worth by long MD", "MD for as much time",
                        "gain", "verdict by long MD"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
