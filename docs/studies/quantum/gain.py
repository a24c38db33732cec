"""What a potential's rollout is worth by long sampling at GFN2-xTB's own law, over the MD that its time buys.

    python docs/studies/quantum/gain.py WEIGHTS FOLDER --reference 'CHAINS_r[0-7].h5'
        --replicate 'CHAINS_r[89].h5,CHAINS_r1?.h5' [--time 510ps] [--replicas 32]
        [-o docs/results/tables/potential_speed_up.json]

Reference and replicate are chains of `corrected_md.py`; equivalent MD time ends at the length of one of them. FOLDER
gets the rollout, annealed first, and as much MD by GFN2-xTB, a process a core, as tells its speed: nothing else should
run. What is there is not made again. Chains that turn back now and then forget more slowly than MD does: a length of
theirs is as much less MD as their torsions take longer to relax than those of the rollout, which moves as MD does.
Speed-up: equivalent MD time over the MD that all cores make in the wall time of training (with its answers of GFN2-xTB)
and of the part of the rollout that comes so near, with the 95 % interval of the equivalent MD time.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from corrected_md import SAVE_PS

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.comparison.comparison import Evaluation
from surrogate.comparison.equivalent_time import EquivalentTime
from surrogate.models.architecture import weights_path
from surrogate.models.weights import load_weights
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps, format_wall, parse_time_ps

LEVEL, MD_PS, ANNEAL_PS, SEED = "gfn2-xtb", 10.0, 50.0, 77


def md_ps_per_s(scene: Scene, folder: Path) -> float:
    """Return how much MD by GFN2-xTB all cores make in a second of wall time, a replica each."""
    cores = os.cpu_count() or 1
    runs = sm.reference(
        scene, folder / "md.h5", time_ps=MD_PS, save_every_ps=0.1, equilibrate_ps=0.1, level=LEVEL, replicas=cores,
        seed=SEED, resume=True, quiet=True,
    )  # fmt: skip
    walls = []
    for run in runs:
        with open_trajectory(run) as reader:
            walls.append(float(reader.record["cost"]["wall_s"]))
    return cores * MD_PS / max(walls)


def speed_up_words(equivalent_time: EquivalentTime, bought_ps: float) -> str:
    """Return an equivalent MD time over the length that its cost buys, with the interval: 'at least 5.7 [1.9, ...]'."""
    ends = [
        None if end is None else f"{end / bought_ps:.2g}" for end in (equivalent_time.low_ps, equivalent_time.high_ps)
    ]
    said = f"{equivalent_time.bound} {equivalent_time.equivalent_ps / bought_ps:.2g}".strip()
    if ends == [None, None]:
        return said
    return f"{said} [{ends[0] or '...'}, {ends[1] or '...'}]"


def pace(evaluated: Evaluation) -> float:
    """Return how much MD a length of the chains is: the least ratio of relaxation times, and never more than 1."""
    rows = [row for row in evaluated.rows if row.key.startswith("correlation_time:") and row.reference is not None]
    return min([1.0, *(row.candidate.value / row.reference.value for row in rows if row.reference is not None)])


def differing(evaluated: Evaluation) -> list[str]:
    """Return the metrics by which a rollout differs from the chains, but for those of time."""
    return [row.metric for row in evaluated.rows if row.verdict == "differs" and row.group != "kinetics"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--reference", required=True)
    parser.add_argument("--replicate", required=True)
    parser.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=510.0)
    parser.add_argument("--replicas", type=int, default=32)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    weights = load_weights(weights_path(given.weights))
    scene = weights.domain.scene
    given.folder.mkdir(parents=True, exist_ok=True)
    rolled = sm.rollout(
        scene, given.weights, given.folder / "roll.h5", time_ps=given.time, save_every_ps=SAVE_PS, seed=SEED,
        replicas=given.replicas, anneal_ps=ANNEAL_PS, guard="resample", resume=True, quiet=True,
    )  # fmt: skip
    speed = md_ps_per_s(scene, given.folder)
    report = given.folder / "report.html"
    comparison = sm.compare(given.reference, [rolled], report, replicate=given.replicate, overwrite=True)
    evaluated = comparison.evaluations[0]
    training_s, rolled_ps = float(weights.provenance["training_s"]), evaluated.summary.total_ps
    rolling_s = evaluated.summary.wall_s or 0.0
    rows = [
        ["trained for", format_wall(training_s)],
        ["rolled", f"{format_time_ps(rolled_ps, 2)} in {format_wall(rolling_s)}"],
        ["MD by GFN2-xTB on all cores", f"{format_time_ps(3600.0 * speed, 3)} an hour"],
        ["a rollout's speed over that", f"{rolled_ps / rolling_s / speed:.0f}"],
        ["a ns of chains is so much MD", f"{pace(evaluated):.2f} ns"],
        ["differs from the chains in", ", ".join(differing(evaluated)) or "nothing but its pace"],
    ]
    for equivalent_time in (
        w for w in evaluated.equivalent_time if w.kind == "distribution"
    ):  # chains have no times of their own
        bought_ps = speed * (training_s + equivalent_time.share * rolling_s)
        rows += [
            [
                f"equivalent MD time by {equivalent_time.measure}, of chains",
                f"{equivalent_time.in_words()} by {equivalent_time.share:.2g} of it",
            ],
            ["MD in as much time", format_time_ps(bought_ps, 2)],
            ["speed_up", speed_up_words(equivalent_time, bought_ps / pace(evaluated))],
        ]
    for row in rows:
        sys.stdout.write(" | ".join(row) + "\n")
    if given.out is not None:
        table = {
            "command": f"python docs/studies/quantum/gain.py {given.weights} FOLDER --reference ... --replicate ...",
            "machine": machine_name(),
            "note": f"{given.replicas} replicas of {format_time_ps(given.time)}; reference and replicate "
                    f"{format_time_ps(comparison.reference.total_ps, 2)} each of corrected_md.py.",
            "columns": ["of the potential", ""],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
