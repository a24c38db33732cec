"""Rollout against OpenMM's fastest set-up on the same cores: `python docs/studies/surrogates/rollout_speed.py`.

Each round times, one after the other: OpenMM with one replica per core (Reference platform, native OBC2, 4 fs), the
surrogate with one replica, and the surrogate with a batch. Ratios are taken within a round; the median and the extremes
over rounds are printed.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from md_reference.run.machine import available_cores
from surrogate import api

SCENE = "alanine-dipeptide"


def microseconds_per_day(simulated_ps: float, run: Callable[[], object]) -> float:
    """Return simulated µs per day of wall time of `run`, start-up and writing included."""
    began = time.perf_counter()
    run()
    return simulated_ps * 1e-6 / (time.perf_counter() - began) * 86400.0


def one_round(
    weights: str, steps: int | None, batch: int, folder: Path, md_ps: float, roll_ps: float
) -> dict[str, float]:
    cores = available_cores()

    def rolled(replicas: int, each_ps: float) -> float:
        return microseconds_per_day(
            each_ps * replicas,
            lambda: api.rollout(SCENE, weights, folder / "roll.h5", time_ps=each_ps, replicas=replicas,
                                solver_steps=steps, overwrite=True, quiet=True),
        )  # fmt: skip

    reference = microseconds_per_day(
        md_ps * cores,
        lambda: api.reference(SCENE, folder / "md.h5", time_ps=md_ps, replicas=cores, overwrite=True, quiet=True),
    )
    return {"openmm": reference, "one_replica": rolled(1, roll_ps), "batch": rolled(batch, roll_ps / 4)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", default=SCENE)
    parser.add_argument("--solver-steps", type=int, default=None)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--md-ps", type=float, default=2000.0)
    parser.add_argument("--rollout-ps", type=float, default=4000.0)
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rounds = [
            one_round(args.weights, args.solver_steps, args.batch, Path(folder), args.md_ps, args.rollout_ps)
            for _ in range(args.rounds)
        ]
    for key in ("openmm", "one_replica", "batch"):
        speeds = [r[key] for r in rounds]
        ratios = [r[key] / r["openmm"] for r in rounds]
        sys.stdout.write(
            f"{key:12s} {statistics.median(speeds):8.1f} µs/day   {statistics.median(ratios):6.2f} x OpenMM "
            f"[{min(ratios):.2f}, {max(ratios):.2f}]\n"
        )
    if args.json is not None:
        args.json.write_text(json.dumps({"cores": available_cores(), "batch": args.batch, "rounds": rounds}, indent=1))


if __name__ == "__main__":
    main()
