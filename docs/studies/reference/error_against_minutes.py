"""Error of the final answer against minutes: `surromd run`, MD from one start, MD from many, a rollout alone.

    python docs/studies/reference/error_against_minutes.py reference FOLDER [--time 30ns] [--replicas 16]
    python docs/studies/reference/error_against_minutes.py runs FOLDER [--minutes 1 3 10]
    python docs/studies/reference/error_against_minutes.py table FOLDER [-o TABLE.json] [--figure FIGURE.svg]

`reference` makes FOLDER/NAME/run_000.h5 and on, SIMD replicas from many starts, frames 10 ps apart, a batch of every
molecule before the next. `runs` spends each budget in four ways in FOLDER/NAME/MINUTESmin. What is there is left alone,
and what was stopped goes on. `table` lays all beside the reference: mean Jensen-Shannon distance of
torsions (50 bins), root mean square error of free energies of states, how many 95 % intervals of populations, and of
equivalent MD time, hold, and whether the verdict is right or "not converged".
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import surrogate as sm
from md_reference.run.machine import machine_name
from md_reference.run.replicas import simulate_replicas
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.convergence import tested_reference
from surrogate.comparison.equivalent_time import EquivalentTime
from surrogate.comparison.md_answer import Answer, md_answer
from surrogate.comparison.measure.distributions import distance
from surrogate.comparison.measure.slow_motion import angles_of
from surrogate.comparison.measure.structure import Baseline, evenly
from surrogate.comparison.measure.torsions import find_wells
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.verbs.options import ReferenceOptions
from surrogate.verbs.reference import resolve_run
from surrogate.verbs.run.run_record import RUN_NAME
from surrogate.verbs.run.run_result import RunResult
from surrogate.verbs.run.stage_clock import Clock
from systems.errors import OutOfDomainError, SurromdError
from systems.library.named_scenes import prepare
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_time_ps, parse_time_ps

FloatArray = npt.NDArray[np.float64]
Angles = dict[str, Sequence[FloatArray]]

MOLECULES = {
    "THR-PHE": "sequence:ACE-THR-PHE-NME",
    "GLN-ILE": "sequence:ACE-GLN-ILE-NME",
    "TYR-ASP": "sequence:ACE-TYR-ASP-NME",
    "TYR-THR-GLY": "sequence:ACE-TYR-THR-GLY-NME",
    "ASN-ALA-LEU": "sequence:ACE-ASN-ALA-LEU-NME",
    "free-GLY-VAL": "sequence:GLY-VAL",
    "free-ALA-TYR": "sequence:ALA-TYR",
    "VAL-SER-GLU-PHE": "sequence:ACE-VAL-SER-GLU-PHE-NME",
    "lidocaine": "smiles:CCN(CC)CC(=O)Nc1c(C)cccc1C",
    "clopidogrel": "smiles:COC(=O)[C@H](c1ccccc1Cl)N1CCc2sccc2C1",
    "metoprolol": "smiles:COCCc1ccc(OC[C@@H](O)CNC(C)C)cc1",
    "chignolin": "chignolin",
}
WAYS = {"run": "surromd run", "one": "MD from one start", "many": "MD from many starts", "rollout": "rollout alone"}
KELVIN, SEED, EVERY_PS, BINS = 300.0, 5_000, 10.0, 50
# A state with a smaller share is left out of free energies; one that is never visited counts as so rare.
RARE, NEVER = 0.01, 1e-3
ENOUGH_R_HAT, HELD = 1.05, 0.95


def make_reference(folder: Path, names: Sequence[str], time_ps: float, replicas: int) -> None:
    """Make the reference of every molecule, batch by batch."""
    size = n_replicas()
    for first in range(0, replicas, size):
        for name in names:
            files = [folder / name / f"run_{k:03d}.h5" for k in range(first, first + size)]
            files[0].parent.mkdir(parents=True, exist_ok=True)
            scene = prepare(MOLECULES[name])
            options = ReferenceOptions(
                time_ps=time_ps, save_every_ps=EVERY_PS, seed=SEED + first, platform="simd", quiet=True
            )
            scene, config, _ = resolve_run(scene, options, {"time_ps": time_ps}, quiet=True)
            simulate_replicas(scene, config, files, resume=True)
            said(f"{name}: {first + size} replicas of {format_time_ps(time_ps)}")


def make_runs(folder: Path, names: Sequence[str], minutes: Sequence[float], weights: str | None) -> None:
    """Spend every budget in every way."""
    for budget in sorted(minutes):
        for name in names:
            place, budget_s = folder / name / f"{budget:g}min", 60.0 * budget
            spent(place / "run", name, budget_s, weights=weights)
            for way in ("one", "many"):
                spent(place / way, name, budget_s, way="md", starts=way, weights=weights)
            rolled(place, name, budget_s)
            said(f"{name}: {budget:g} min")


def spent(out: Path, name: str, budget_s: float, **how: Any) -> None:
    """Run a molecule, or go on, unless that is done. Weights that are named are left out where they do not cover it."""
    is_there = (out / RUN_NAME).is_file()
    if is_there and RunResult.of(out)["outcome"]:
        return
    out.parent.mkdir(parents=True, exist_ok=True)
    if is_there and "weights" in how:
        how["weights"] = RunResult.of(out)["settings"]["weights"]
    try:
        sm.run(MOLECULES[name], out, budget_s=budget_s, quiet=True, resume=is_there, **how)
    except OutOfDomainError:
        sm.run(MOLECULES[name], out, budget_s=budget_s, quiet=True, overwrite=True, **(how | {"weights": None}))
    except SurromdError as error:  # its line of the table stays empty, and the next time it goes on
        said(f"{out}: {error}")


def rolled(place: Path, name: str, budget_s: float) -> None:
    """Roll for the whole budget with the weights that the run took; nothing where no weights cover the molecule."""
    rates = RunResult.of(place / "run")["rates"]
    rolls = rates["rolls"] if rates else None
    done = place / "rollout" / "done"
    if rolls is None or done.exists():
        return
    done.parent.mkdir(parents=True, exist_ok=True)
    clock = Clock(budget_s, 0.0, lambda _: None)
    every_ps = rolls["lag_ps"]
    time_ps = every_ps * math.ceil(3.0 * budget_s * rolls["ps_per_s"] / rolls["replicas"] / every_ps)
    clock.work(
        "rollout",
        budget_s,
        lambda: sm.rollout(
            MOLECULES[name], rolls["weights"], done.parent / "rolled.h5", time_ps=time_ps, save_every_ps=every_ps,
            replicas=rolls["replicas"], seed=SEED, resume=True, quiet=True,
        ),
    )  # fmt: skip
    done.write_text(f"{clock.spent_s:.1f} s\n")


@dataclass(frozen=True, eq=False)
class ReferenceForces:
    """Long MD of one molecule: its angles, its own answer, and whether it has forgotten where it began."""

    files: list[Path]
    baseline: Baseline
    ensemble: Ensemble
    angles: Angles
    answer: Answer
    r_hat: float
    replicate_baseline: float

    @classmethod
    def of(cls, folder: Path) -> ReferenceForces | None:
        """Return what a folder of replicas tells, None for fewer than four."""
        files = sorted(folder.glob("run_*.h5"))
        if len(files) < 4:
            return None
        ensemble = load_ensemble(files)
        baseline = Baseline.of(ensemble, parent=ensemble.scene, kept=ensemble.kept)
        angles = measured(baseline, ensemble)
        halves = ({k: x[: len(x) // 2] for k, x in angles.items()}, {k: x[len(x) // 2 :] for k, x in angles.items()})
        r_hat = tested_reference([ensemble]).r_hat
        return cls(files, baseline, ensemble, angles, md_answer(ensemble, KELVIN), r_hat, torsion_distance(*halves))

    def of_files(self, files: Sequence[Path]) -> Angles:
        return measured(self.baseline, load_ensemble(files, template=self.ensemble.scene))


def measured(baseline: Baseline, ensemble: Ensemble) -> Angles:
    """Return every torsion in rad, `(n_frames,)` a replica."""
    return {k: [np.asarray(x, dtype=np.float64) for x in s]
            for k, s in evenly(angles_of([baseline.measure(ensemble)], baseline.torsions), 64)}  # fmt: skip


def pooled(segments: Sequence[FloatArray], weights: Sequence[FloatArray] | None) -> tuple[FloatArray, FloatArray]:
    values = np.concatenate(list(segments))
    w = np.ones(len(values)) if weights is None else np.concatenate(list(weights))
    return values[np.isfinite(values)], w[np.isfinite(values)]


def torsion_distance(ref: Angles, other: Angles, weights: Sequence[FloatArray] | None = None) -> float:
    """Return the mean Jensen-Shannon distance (square root, natural logarithm) of all torsions, 50 bins."""
    found = []
    for name, segments in ref.items():
        counts = []
        for of, w in ((segments, None), (other[name], weights)):
            values, each = pooled(of, w)
            counts.append(np.histogram(values, BINS, (-math.pi, math.pi), weights=each)[0])
        found.append(float(distance(counts[0], counts[1])))
    return float(np.mean(found))


def energy_error(ref: Angles, other: Angles, weights: Sequence[FloatArray] | None = None) -> float:
    """Return the root mean square error of free energies of the states of every torsion, kJ/mol."""
    rt, squares = GAS_CONSTANT_KJ_MOL_K * KELVIN, []
    for name, segments in ref.items():
        wells = find_wells(segments)
        if len(wells.names) < 2:
            continue
        shares = []
        for of, w in ((segments, None), (other[name], weights)):
            states = np.concatenate(wells.assign(of))
            each = np.ones(len(states)) if w is None else np.concatenate(list(w))
            counts = np.bincount(states, each, minlength=len(wells.names))
            shares.append(counts / counts.sum())
        squares += [(rt * math.log(max(q, NEVER) / p)) ** 2 for p, q in zip(*shares, strict=True) if p >= RARE]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def intervals_held(told: dict[str, Any], ref: Answer) -> tuple[int, int]:
    """Return how many 95 % intervals of populations in a run's equilibrium.json hold the reference's, and of how many;
    wells of torsions are the same where their means are within 30 degrees."""

    def same(a: str, b: str) -> bool:
        x, y = (re.fullmatch(r"(-?\d+)°", s) for s in (a, b))
        if x is None or y is None:
            return a == b
        return abs((float(x[1]) - float(y[1]) + 180.0) % 360.0 - 180.0) < 30.0

    held = total = 0
    for state in told.get("states", ()):
        right = [s for s in ref.states if s.torsion == state["torsion"] and same(s.state, state["state"])]
        if state["missing"] or len(right) != 1:
            continue
        total += 1
        held += abs(state["share"] - right[0].share) <= 1.96 * math.hypot(state["error"], right[0].error)
    return held, total


def equivalent_time_held(result: RunResult, ref: ReferenceForces) -> bool | None:
    """Return whether the equivalent MD time that a run tells of its rollout holds what long MD tells of it, None where
    it tells none."""
    told = of_distribution(json.loads((result.folder / "report.json").read_text("utf-8"))["evaluations"][0])
    if not result["outcome"]["equivalent_time"] or told is None:
        return None
    half = len(ref.files) // 2
    evaluated = sm.compare(ref.files[:half], [result.trajectory], replicate=ref.files[half:]).evaluations[0]
    right: EquivalentTime | None = next((w for w in evaluated.equivalent_time if w.kind == "distribution"), None)
    if right is None:
        return None
    low, high = told["low_ps"] or 0.0, told["high_ps"]
    if told["bound"] == "at least":
        low, high = told["equivalent_ps"], None
    if told["bound"] == "less than":
        low, high = 0.0, told["equivalent_ps"]
    return low <= (right.high_ps or math.inf) and (high is None or (right.low_ps or 0.0) <= high)


def of_distribution(evaluated: dict[str, Any]) -> dict[str, Any] | None:
    return next((w for w in evaluated["equivalent_time"] if w["kind"] == "distribution"), None)


def row(name: str, minutes: float, place: Path, ref: ReferenceForces) -> dict[str, Any]:
    """Return a line of the table; a way that was not gone has no error."""
    line: dict[str, Any] = {
        "molecule": name,
        "minutes": minutes,
        "R-hat": round(ref.r_hat, 3) if math.isfinite(ref.r_hat) else None,
        "reference's halves": round(ref.replicate_baseline, 4),
    }
    for way in WAYS:
        if way == "rollout":
            files = sorted((place / way).glob("rolled*.h5")) if (place / way / "done").exists() else []
            weights = None
        else:
            is_done = (place / way / RUN_NAME).is_file() and RunResult.of(place / way)["outcome"]
            files = RunResult.of(place / way).md if is_done else []
            weights = None if way == "one" else [sm.frame_weights(f) for f in files]
        if not files:
            continue
        angles = ref.of_files(files)
        line[f"{way}: distance"] = round(torsion_distance(ref.angles, angles, weights), 4)
        error = energy_error(ref.angles, angles, weights)
        line[f"{way}: kJ/mol"] = round(error, 3) if math.isfinite(error) else None
    if "run: distance" in line:
        result = RunResult.of(place / "run")
        held, total = intervals_held(result.answer, ref.answer)
        line |= {"way": result["decision"]["way"], "intervals held": held, "of": total}
        line["equivalent MD time held"] = equivalent_time_held(result, ref)
        if not result["outcome"]["converged"]:
            line["verdict"] = "not converged"
        else:
            line["verdict"] = "right" if held >= HELD * total - 1.0 else "wrong"
    return line


def make_table(folder: Path, out: Path | None, figure: Path | None) -> None:
    """Lay all runs beside the references, print and write the table and the figure."""
    rows = []
    for name in MOLECULES:
        ref = ReferenceForces.of(folder / name)
        if ref is None:
            continue
        warning = "" if ref.r_hat < ENOUGH_R_HAT else ", not converged itself"
        length = f"{len(ref.files)} replicas of {format_time_ps(ref.answer.replica_ps)}"
        said(f"{name}: {length}, split R-hat {ref.r_hat:.3f}{warning}")
        for place in sorted((folder / name).glob("*min"), key=lambda p: float(p.name[:-3])):
            rows.append(row(name, float(place.name[:-3]), place, ref))
            said("  " + ", ".join(f"{k} {v}" for k, v in rows[-1].items()))
    if not rows:
        raise SystemExit(f"{folder} holds no reference of four replicas with runs beside it.")
    table = {
        "command": "python docs/studies/reference/error_against_minutes.py table FOLDER",
        "machine": machine_name(),
        "note": "Distance: mean Jensen-Shannon distance of torsions, 50 bins. kJ/mol: root mean square error of free "
        "energies of states. Of each molecule against long SIMD MD from many starts, whose halves are so far apart.",
        "summary": summary(rows),
        "rows": rows,
    }  # fmt: skip
    for line in summary(rows):
        said(line)
    if out is not None:
        out.write_text(json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")
    if figure is not None:
        draw(rows, figure)


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return the study's answers, a line each."""
    found = []
    full = [r for r in rows if "run: distance" in r and "one: distance" in r]
    if full:
        ratio = [r["run: distance"] / r["one: distance"] for r in full]
        rivals = [min(r[f"{w}: distance"] for w in WAYS if f"{w}: distance" in r) for r in full]
        best = [r["run: distance"] <= rival + r["reference's halves"] for r, rival in zip(full, rivals, strict=True)]
        found += [
            f"error of the run over that of MD from one start: median {np.median(ratio):.2f} of {len(full)}",
            f"no worse than the best of the four by more than the reference's own error: {sum(best)} of {len(full)}",
        ]
    told = [r for r in rows if "verdict" in r]
    for word in ("right", "not converged", "wrong"):
        found.append(f"verdict {word}: {sum(r['verdict'] == word for r in told)} of {len(told)}")
    sure = [r for r in told if r["verdict"] != "not converged"]
    held, total = (sum(r[key] for r in sure) for key in ("intervals held", "of"))
    found.append(
        f"intervals of populations that hold, of answers that are not told to be unconverged: {held} of {total}"
    )
    equivalent_times = [r["equivalent MD time held"] for r in told if r["equivalent MD time held"] is not None]
    found.append(f"intervals of equivalent MD time that hold: {sum(equivalent_times)} of {len(equivalent_times)}")
    return found


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw error against minutes: of each way the median over molecules, and the quartiles as a band."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.6, 3.8), layout="constrained")
    minutes = sorted({r["minutes"] for r in rows})
    for k, (way, words) in enumerate(WAYS.items()):
        points = [
            (m, [r[f"{way}: distance"] for r in rows if r["minutes"] == m and f"{way}: distance" in r]) for m in minutes
        ]
        points = [(m, values) for m, values in points if values]
        if not points:
            continue
        at = [m for m, _ in points]
        low, middle, high = (np.array([np.quantile(v, q) for _, v in points]) for q in (0.25, 0.5, 0.75))
        axes.plot(at, middle, "o-", color=f"C{k}", label=words)
        axes.fill_between(at, low, high, color=f"C{k}", alpha=0.15, linewidth=0)
    replicate_baseline = float(np.median([r["reference's halves"] for r in rows]))
    axes.axhline(replicate_baseline, color="0.6", linestyle=":", label="two halves of the reference")
    axes.set(xscale="log", yscale="log", xlabel="budget / min", ylabel="mean distance of torsions to long MD")
    axes.set_xticks(minutes, [f"{m:g}" for m in minutes])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(out)


def said(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    parts = {name: verbs.add_parser(name) for name in ("reference", "runs", "table")}
    for part in parts.values():
        part.add_argument("folder", type=Path)
        part.add_argument("--molecules", nargs="+", choices=sorted(MOLECULES), default=list(MOLECULES))
    parts["reference"].add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=30_000.0)
    parts["reference"].add_argument("--replicas", type=int, default=16)
    parts["runs"].add_argument("--minutes", nargs="+", type=float, default=[1.0, 3.0, 10.0])
    parts["runs"].add_argument("--weights", help="of the rollouts, where those that cover a molecule are not wanted")
    parts["table"].add_argument("-o", "--out", type=Path)
    parts["table"].add_argument("--figure", type=Path)
    given = parser.parse_args()
    if given.verb == "reference":
        make_reference(given.folder, given.molecules, given.time, given.replicas)
    elif given.verb == "runs":
        make_runs(given.folder, given.molecules, given.minutes, given.weights)
    else:
        make_table(given.folder, given.out, given.figure)


if __name__ == "__main__":
    main()
