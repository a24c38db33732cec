"""What implicit data are worth for peptides in explicit water: weights for OBC2 on molecules in TIP3P, in six ways.

    python docs/studies/training/peptide_water.py train FOLDER WATER OBC2 [--start W] [--runs 1 4 16] [--steps 600]
    python docs/studies/training/peptide_water.py table FOLDER WATER OBC2 [--start W]

WATER and OBC2 are folders of `peptide_campaign`: what is in WATER/train is learned from, of each molecule so many runs,
and what is in WATER/test is rolled (`peptide_unseen`). Weights W, for OBC2, are taken as they are (`unchanged`); their
frames are weighed and their time is stretched as monomers in both solvents say (`corrected`, `peptide_correction`);
they are trained further, `whole`, or what a solvent has of its own alone (`solvent`), or whole on both folders
(`joint`); and weights are trained `new`, from nothing. `train` makes FOLDER/METHOD-RUNS.safetensors, one after the
other in one process a core; what is there stays. `table` rolls them all.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import peptide_transfer
from peptide_correction import Correction
from peptide_unseen import molecule
from processes import in_order, is_trained

from md_reference.run.machine import available_cores, machine_name
from surrogate.models.architecture import weights_path
from surrogate.models.weights import load_weights
from systems.trajectory.codec import open_trajectory

TABLES = Path(__file__).parents[2] / "results" / "tables"
# By what follows `peptide_transfer`: whether it goes on from weights, and what is tuned of these.
TRAINED = {"new": None, "solvent": "solvent", "whole": "all", "joint": "all"}
WORDS = {
    "unchanged": "as they are", "corrected": "reweighted and stretched by monomers", "new": "trained from nothing",
    "solvent": "the solvent's own parts tuned", "whole": "tuned whole", "joint": "tuned whole, on both solvents",
}  # fmt: skip
# MD of one core in this time stands beside the equivalent MD time of rollouts.
MINUTES = 10.0


def tasks(runs: Sequence[int]) -> list[tuple[str, int]]:
    """Return what is trained, the most runs first; on both folders with the most runs alone."""
    return [
        (method, n) for n in sorted(runs, reverse=True) for method in TRAINED if method != "joint" or n == max(runs)
    ]


def train(
    task: tuple[str, int], deadline: float, folder: Path, water: Path, obc2: Path, start: str, steps: int
) -> None:
    """Train weights by one method on so many runs of each molecule in water."""
    method, n = task
    places = [water / "train", *([obc2 / "train"] if method == "joint" else [])]
    going_on = ["--start", start, "--tuned", TRAINED[method]] if TRAINED[method] else ["--coupled"]
    peptide_transfer.main([
        str(folder / f"{method}-{n}.safetensors"), "--train", *map(str, places), "--runs", str(n),
        "--steps", str(steps), *going_on,
    ])  # fmt: skip


def simulated_ns(folder: Path, runs: int) -> float:
    """Return how long the first so many runs of all molecules in a folder are together."""
    total_ps = 0.0
    for path in (path for place in folder.iterdir() for path in sorted(place.glob("run_*.h5"))[:runs]):
        with open_trajectory(path) as reader:
            total_ps += float(reader.time_ps[-1])
    return total_ps * 1e-3


def mean_row(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a line of the table, of the lines of test molecules."""

    def of(what: str) -> list[float]:
        return [row[what][0] for row in rows if row[what]]

    off = [x for row in rows for name, x in row["kinetics"].items() if name.startswith("ψ") and math.isfinite(x)]
    errors, floors = np.array([row["free energies of states, kT: error, MD's halves"] for row in rows]).T
    spread = math.exp(float(np.std(np.log(off), ddof=1) / math.sqrt(len(off)))) if len(off) > 1 else math.nan
    return [
        *(f"{np.mean(of(what)):.2f} ({max(of(what)):.2f})"
          for what in ("torsions, single", "torsions, pooled", "joint maps, pooled") if of(what)),
        f"{np.sqrt(np.mean(errors**2)):.2f} ({np.sqrt(np.mean(floors**2)):.2f})",
        f"{math.exp(float(np.mean(np.log(off)))):.2f} (×/÷ {spread:.2f})",
    ]  # fmt: skip


def make_table(folder: Path, water: Path, obc2: Path, start: str, out: Path) -> None:
    correction = Correction.of(water / "train", obc2 / "train")
    tests = {place.name: files for place in sorted((water / "test").iterdir())
             if len(files := sorted(place.glob("run_*.h5"))) >= 4}  # fmt: skip
    todo: list[tuple[str, int, Path, str | None, Correction | None]] = [
        ("unchanged", 0, weights_path(start), None, None), ("corrected", 16, weights_path(start), None, correction)
    ]  # fmt: skip
    made = {(list(TRAINED).index(path.stem.split("-")[0]), int(path.stem.split("-")[1])): path
            for path in folder.glob("*-*.safetensors") if is_trained(path)}  # fmt: skip
    for (k, n), path in sorted(made.items()):
        method = list(TRAINED)[k]
        todo.append((method, n, path, "tip3p" if TRAINED[method] else None, None))
    lines, found = [], {}
    for method, n, path, solvent, corrected in todo:
        rows = {name: molecule(load_weights(path), runs, folder / method / str(n) / name, solvent, corrected)
                for name, runs in tests.items()}  # fmt: skip
        found[f"{method}-{n}"] = rows
        (folder / "rows.json").write_text(json.dumps(found, indent=1, ensure_ascii=False), "utf-8")
        ns = simulated_ns(water / "train", n) if n else 0.0
        equivalent = [ns for row in rows.values() if math.isfinite(ns := row["equivalent MD time"][0])]
        lines.append([WORDS[method], f"{ns:.0f}", *mean_row(list(rows.values())),
                      f"{np.median(equivalent):.2g}" if equivalent and not corrected else "-",
                      f"{np.median([row['MD of the same wall time, ns'] for row in rows.values()]):.2g}"])  # fmt: skip
        sys.stdout.write(" | ".join(lines[-1]) + "\n")
        sys.stdout.flush()
    shown = " and ".join(f"{name} ({row['frames']} frames)" for name, row in rows.items())
    table = {
        "command": f"python docs/studies/training/peptide_water.py table FOLDER WATER OBC2 --start {start}",
        "machine": machine_name(),
        "note": f"Means over {shown}; largest in brackets, of ψ the standard error. Times are stretched by "
        f"{correction.clock:.2f}.",
        "columns": ["weights for OBC2", "MD in water, ns", "torsions, one run", "torsions, pooled",
                    "joint maps, pooled", "free energies of states, kT (MD's halves)", "ψ remembered, over MD's",
                    "equivalent MD time, ns", "MD of the same wall time, ns"],
        "rows": lines,
    }  # fmt: skip
    out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("water", type=Path)
    parser.add_argument("obc2", type=Path)
    parser.add_argument("--start", default="peptides")
    parser.add_argument("--runs", type=int, nargs="+", default=(1, 4, 16))
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("-o", "--out", type=Path, default=TABLES / "peptides_water.json")
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    if a.what == "table":
        make_table(a.folder, a.water, a.obc2, a.start, a.out)
        return
    in_order(partial(tasks, tuple(a.runs)), train, math.inf, a.workers, a.folder, a.water, a.obc2, a.start, a.steps)


if __name__ == "__main__":
    main()
