"""Error of the final answer against minutes: `surromd run`, MD from one start, MD from many, a rollout alone.

    python docs/studies/reference/error_against_minutes.py reference FOLDER [--time 140ns --every 50ps]
    python docs/studies/reference/error_against_minutes.py longer FOLDER --molecules NAME --time 40ns [--every 50ps]
    python docs/studies/reference/error_against_minutes.py runs FOLDER [--minutes 1 3 10]
    python docs/studies/reference/error_against_minutes.py rivals FOLDER [--minutes 10]
    python docs/studies/reference/error_against_minutes.py table FOLDER [-o TABLE.json] [--figure FIGURE.svg]
        [--earlier TABLE.json]

`reference` makes FOLDER/NAME/run_000.h5 and on, one batch of SIMD replicas from many starts, frames 10 ps apart, as
long as its slowest process needs for a split R-hat below 1.05; `longer` goes on where that was too short. `runs` spends
each budget by `surromd run` in FOLDER/NAME/MINUTESmin, on the cores it may use: it alone needs a quiet machine
(`taskset -c 0` for one core). `rivals` makes MD from one start (NAME/one) and a rollout (NAME/rollout) as long as the
whole budget buys by the rates that the runs measured, reports and preparation for nothing. MD from many starts is the
beginning of the reference, beside the rest of it. What is there is left alone, and what was stopped goes on. `table`
lays all beside the reference: mean Jensen-Shannon distance of torsions (50 bins), root mean square error of the
populations of states, how many 95 % intervals of populations, and of equivalent MD time, hold, and whether the verdict
is right or "not converged". A molecule without a reference (chignolin folds in microseconds) has its verdict alone.
With `--earlier`, molecules that FOLDER does not hold are taken from an earlier table, and the note names them.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import surrogate as sm
from md_reference.run.config import MDConfig
from md_reference.run.machine import machine_name
from md_reference.run.replicas import simulate_batch, simulate_replicas
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.answer import Answer
from surrogate.comparison.convergence import tested_reference
from surrogate.comparison.equivalent_time import EquivalentTime
from surrogate.comparison.md_answer import md_answer
from surrogate.comparison.measure.distributions import distance
from surrogate.comparison.measure.slow_motion import angles_of
from surrogate.comparison.measure.structure import Baseline, evenly
from surrogate.comparison.measure.torsions import find_wells
from surrogate.comparison.read.ensemble import Ensemble, load_ensemble
from surrogate.verbs.options import ReferenceOptions
from surrogate.verbs.run.run_record import RUN_NAME, RunResult
from surrogate.verbs.simulate import resolve_run
from systems.errors import SurromdError
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.trajectory.checkpoint import checkpoint_path
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps, parse_time_ps

FloatArray = npt.NDArray[np.float64]
Angles = dict[str, Sequence[FloatArray]]

# What `prepare` takes, and the length of a replica of the reference in ns, 0 for none.
MOLECULES = {
    "THR-PHE": ("sequence:ACE-THR-PHE-NME", 140),
    "GLN-ILE": ("sequence:ACE-GLN-ILE-NME", 30),
    "TYR-ASP": ("sequence:ACE-TYR-ASP-NME", 100),
    "TYR-THR-GLY": ("sequence:ACE-TYR-THR-GLY-NME", 60),
    "ASN-ALA-LEU": ("sequence:ACE-ASN-ALA-LEU-NME", 100),
    "free-GLY-VAL": ("sequence:GLY-VAL", 200),
    "free-ALA-TYR": ("sequence:ALA-TYR", 120),
    "VAL-SER-GLU-PHE": ("sequence:ACE-VAL-SER-GLU-PHE-NME", 60),
    "lidocaine": ("smiles:CCN(CC)CC(=O)Nc1c(C)cccc1C", 700),
    "clopidogrel": ("smiles:COC(=O)[C@H](c1ccccc1Cl)N1CCc2sccc2C1", 900),
    "metoprolol": ("smiles:COCCc1ccc(OC[C@@H](O)CNC(C)C)cc1", 300),
    "chignolin": ("chignolin", 0),
    "LEU-SER in TIP3P": ("sequence:ACE-LEU-SER-NME", 4),
}
SOLVENT = {"LEU-SER in TIP3P": "tip3p"}
WAYS = {"run": "surromd run", "one": "MD from one start", "many": "MD from many starts", "rollout": "rollout alone"}
HALVES = "reference's halves"
KELVIN, SEED, EVERY_PS, BINS = 300.0, 5_000, 10.0, 50
# Of each replica of the reference, as hot starts are to be forgotten: so much, but no more than a part.
LEFT_OUT_PS, LEFT_OUT = 5_000.0, 1 / 6
ENOUGH_R_HAT, HELD = 1.05, 0.95
# MD from one start that ends before this share of the time that a budget buys is none of that budget's.
LONG_ENOUGH = 0.9
LONGER = "longer"
EARLIER = "earlier"
# A rollout is no longer: what it is off by then is the model's.
ROLLED_MINUTES = 1.0


def plan(name: str, time_ps: float, every_ps: float, seed: int, **how: Any) -> tuple[Scene, MDConfig]:
    """Return the scene of a molecule and the MD of it, by SIMD replicas."""
    options = ReferenceOptions(
        time_ps=time_ps, save_every_ps=every_ps, seed=seed, solvent=SOLVENT.get(name), platform="simd", quiet=True,
        **how,
    )  # fmt: skip
    scene, config, _ = resolve_run(prepare(MOLECULES[name][0]), options, {"time_ps": time_ps}, quiet=True)
    return scene, config


def make_reference(folder: Path, names: Sequence[str], time_ps: float | None, every_ps: float) -> None:
    """Make the reference of every molecule, by default as long as its slowest process needs."""
    for name in names:
        ns = MOLECULES[name][1]
        if not ns:
            continue
        files = [folder / name / f"run_{k:03d}.h5" for k in range(n_replicas())]
        files[0].parent.mkdir(parents=True, exist_ok=True)
        length_ps = 1e3 * ns if time_ps is None else time_ps
        scene, config = plan(name, length_ps, every_ps, SEED)
        simulate_replicas(scene, config, files, resume=True)
        said(f"{name}: {len(files)} replicas of {format_time_ps(length_ps)}")


def make_longer(folder: Path, names: Sequence[str], time_ps: float, every_ps: float) -> None:
    """Go on from the last frames of every molecule's finished reference, with new velocities."""
    for name in names:
        before = finished(folder / name)
        files = [folder / name / LONGER / path.name for path in before]
        files[0].parent.mkdir(exist_ok=True)
        scene, config = plan(name, time_ps, every_ps, SEED + 500)
        simulate_batch(scene, config, files, resume=True, starts_nm=np.array([last_frame(path) for path in before]))
        said(f"{name}: {format_time_ps(time_ps)} more")


def last_frame(path: Path) -> FloatArray:
    with open_trajectory(path) as reader:
        return np.asarray(reader.read(reader.n_frames - 1, reader.n_frames)[0], dtype=np.float64)


def make_runs(folder: Path, names: Sequence[str], minutes: Sequence[float]) -> None:
    """Run every molecule with every budget; a run that is there is gone on with, unless it is done."""
    for budget in sorted(minutes):
        for name in names:
            out = folder / name / f"{budget:g}min"
            is_there = (out / RUN_NAME).is_file()
            if is_there and RunResult.of(out)["outcome"]:
                continue
            try:
                sm.run(
                    MOLECULES[name][0], out, budget_s=60.0 * budget, solvent=SOLVENT.get(name), quiet=True,
                    resume=is_there,
                )  # fmt: skip
            except SurromdError as error:  # its line of the table stays empty, and the next time it goes on
                said(f"{out}: {error}")
            said(f"{name}: {budget:g} min")


def make_rivals(folder: Path, names: Sequence[str], most_minutes: float) -> None:
    """Make MD from one start and a rollout of the lengths that this machine makes in the longest budget, by the rates
    that the runs measured; a shorter budget is the first part of these."""
    for name in names:
        rates = [rates_of(folder / name, m) for m in budgets(folder / name) if m <= most_minutes]
        if not rates:
            continue
        longest = max(md_length_ps(r, m) for r, m in rates)
        place = folder / name / "one"
        place.mkdir(exist_ok=True)
        scene, config = plan(name, EVERY_PS * math.ceil(longest / EVERY_PS), EVERY_PS, SEED + 900, starts="one")
        simulate_replicas(scene, config, [place / f"run_{k:03d}.h5" for k in range(n_replicas())], resume=True)
        rolls = rates[-1][0]["rolls"]
        first = folder / name / "rollout" / "rolled_r0.h5"
        if rolls and (checkpoint_path(first).exists() or not first.exists()):
            every_ps = max(EVERY_PS, rolls["lag_ps"])
            rolled_ps = max(rolled_length_ps(r, min(m, ROLLED_MINUTES)) for r, m in rates)
            time_ps = every_ps * math.ceil(rolled_ps / every_ps)
            out = folder / name / "rollout" / "rolled.h5"
            out.parent.mkdir(exist_ok=True)
            sm.rollout(
                MOLECULES[name][0], rolls["weights"], out, time_ps=time_ps, save_every_ps=every_ps,
                replicas=rolls["replicas"], solvent=SOLVENT.get(name), seed=SEED, resume=True, quiet=True,
            )  # fmt: skip
        said(f"{name}: rivals")


def budgets(place: Path) -> list[float]:
    """Return the budgets, in minutes, of the runs of a molecule that are done."""
    found = [p for p in place.glob("*min") if (p / RUN_NAME).is_file() and RunResult.of(p)["outcome"]]
    return sorted(float(p.name[:-3]) for p in found)


def rates_of(place: Path, minutes: float) -> tuple[dict[str, Any], float]:
    return RunResult.of(place / f"{minutes:g}min")["rates"], minutes


def md_length_ps(rates: dict[str, Any], minutes: float) -> float:
    """Return how long each of sixteen replicas comes to be when the whole budget goes into MD."""
    return 60.0 * minutes * float(rates["md_ps_per_s"]) / n_replicas()


def rolled_length_ps(rates: dict[str, Any], minutes: float) -> float:
    return 60.0 * minutes * float(rates["rolls"]["ps_per_s"]) / float(rates["rolls"]["replicas"])


@dataclass(frozen=True, eq=False)
class LongMD:
    """Long MD of one molecule: its angles, its own answer, and whether it has forgotten where it began."""

    files: list[Path]
    baseline: Baseline
    ensemble: Ensemble
    angles: Angles
    answer: Answer
    r_hat: float
    replicate_baseline: float

    @classmethod
    def of(cls, files: Sequence[Path]) -> LongMD:
        """Return what files of replicas tell, without the first part of each."""
        whole = load_ensemble(files)
        ensemble = stretch(whole, round(left_out_ps(whole) / whole.lag_ps), None)
        if longer := sorted((files[0].parent / LONGER).glob("[!.]*.h5")):
            later = load_ensemble(longer, template=whole.scene)
            every = round(later.lag_ps / ensemble.lag_ps)
            pairs = zip(ensemble.segments, later.segments, strict=True)
            segments = [np.concatenate([np.asarray(s[every - 1 :: every]), np.asarray(x)]) for s, x in pairs]
            ensemble = replace(ensemble, segments=segments, lag_ps=later.lag_ps, flags=None, chunk_idx=None)
        baseline = Baseline.of(ensemble, parent=ensemble.scene, kept=ensemble.kept)
        angles = measured(baseline, ensemble)
        halves = ({k: x[: len(x) // 2] for k, x in angles.items()}, {k: x[len(x) // 2 :] for k, x in angles.items()})
        r_hat = tested_reference([ensemble]).r_hat
        answer = md_answer(ensemble, KELVIN)
        return cls(list(files), baseline, ensemble, angles, answer, r_hat, torsion_distance(*halves))

    def load(self, files: Sequence[Path], first_ps: float | None = None) -> Ensemble:
        """Return other files of the molecule, or what is first in each."""
        found = load_ensemble(files, template=self.ensemble.scene)
        return found if first_ps is None else stretch(found, 0, max(2, round(first_ps / found.lag_ps)))

    def errors_of_beginning(self, first_ps: float) -> tuple[float, float]:
        """Return the errors of the first part of the reference's own replicas, beside the rest of it."""
        own = self.load(self.files, first_ps)
        gone_ps = left_out_ps(self.load(self.files))
        n = max(0, round((len(own.segments[0]) * own.lag_ps - gone_ps) / self.ensemble.lag_ps))
        rest = {k: [x[n:] for x in segments] for k, segments in self.angles.items()}
        angles, weights = measured(self.baseline, own), own_weights(own)
        return torsion_distance(rest, angles, weights), population_error(rest, angles, weights)

    def errors(self, of: Ensemble, weights: Sequence[FloatArray] | None = None) -> tuple[float, float]:
        """Return the distance of torsions, and the error of populations in per cent."""
        angles = measured(self.baseline, of)
        return torsion_distance(self.angles, angles, weights), population_error(self.angles, angles, weights)


def left_out_ps(whole: Ensemble) -> float:
    return min(LEFT_OUT_PS, LEFT_OUT * len(whole.segments[0]) * whole.lag_ps)


def stretch(ensemble: Ensemble, first: int, last: int | None) -> Ensemble:
    """Return frames `first` to `last` of each segment."""
    return replace(
        ensemble,
        segments=[np.asarray(s[first:last]) for s in ensemble.segments],
        flags=None if ensemble.flags is None else [f[first:last] for f in ensemble.flags],
        chunk_idx=None if ensemble.chunk_idx is None else [c[first:last] for c in ensemble.chunk_idx],
    )


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


def population_error(ref: Angles, other: Angles, weights: Sequence[FloatArray] | None = None) -> float:
    """Return the root mean square error of the populations of the states of every torsion, in per cent."""
    squares: list[float] = []
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
        squares += ((shares[1] - shares[0]) ** 2).tolist()
    return 100.0 * math.sqrt(float(np.mean(squares))) if squares else math.nan


def stated_error(answer: dict[str, Any]) -> float:
    """Return the root mean square error that a run states of its populations, in per cent."""
    errors = [s["error"] for s in answer["states"] if not s["missing"]]
    return 100.0 * math.sqrt(float(np.mean(np.square(errors)))) if errors else math.nan


def same_state(a: str, b: str) -> bool:
    """Return whether two names are of the same state of a torsion: wells are where their means are within 30
    degrees."""
    x, y = (re.fullmatch(r"(-?\d+)°", s) for s in (a, b))
    if x is None or y is None:
        return a == b
    return abs((float(x[1]) - float(y[1]) + 180.0) % 360.0 - 180.0) < 30.0


def intervals_held(told: dict[str, Any], ref: Answer) -> tuple[int, int]:
    """Return how many 95 % intervals of populations in a run's equilibrium.json hold the reference's, and of how
    many."""
    held = total = 0
    for state in told.get("states", ()):
        right = [s for s in ref.states if s.torsion == state["torsion"] and same_state(s.state, state["state"])]
        if state["missing"] or len(right) != 1:
            continue
        total += 1
        held += abs(state["share"] - right[0].share) <= 1.96 * math.hypot(state["error"], right[0].error)
    return held, total


def equivalent_time_held(result: RunResult, ref: LongMD) -> bool | None:
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


def answer_again(result: RunResult, ref: LongMD | None) -> Answer | None:
    """Return what the MD of a run, and its rollout, tell by the present program, None where it is nothing."""
    md = load_ensemble(result.md) if ref is None else ref.load(result.md)
    rolled = None if result["decision"]["way"] == "md" else load_ensemble(result.trajectory, template=md.scene)
    try:
        return md_answer(md, KELVIN, surrogate=rolled, seed=result["settings"]["seed"])
    except SurromdError:
        return None


def row(name: str, minutes: float, place: Path, ref: LongMD | None) -> dict[str, Any]:
    """Return a line of the table; a way that is not there has no error, and nothing is right without a reference."""
    result = RunResult.of(place / f"{minutes:g}min")
    answer = answer_again(result, ref)
    told = answer.to_dict() if answer else {}
    # What is said to be used, but for what is named.
    converged = answer is not None and answer.is_sure and not (answer.is_joint and answer.missing)
    line: dict[str, Any] = {
        "molecule": name, "minutes": minutes, "way": result["decision"]["way"],
        "populations by": told.get("populations_by", ""),
        "stated": rounded(stated_error(told)) if answer else None,
        "verdict": "" if converged else "not converged",
    }  # fmt: skip
    if ref is None:
        return line
    found = errors_of_ways(result, minutes, place, ref, None if answer is None else answer.weights)
    for way, (distance_, populations) in found.items():
        line |= {f"{way}: distance": rounded(distance_), f"{way}: populations": rounded(populations)}
    held, total = intervals_held(told, ref.answer)
    line |= {"R-hat": rounded(ref.r_hat), HALVES: rounded(ref.replicate_baseline)}
    line |= {"intervals held": held, "of": total, "equivalent MD time held": equivalent_time_held(result, ref)}
    if converged:
        line["verdict"] = "right" if held >= HELD * total - 1.0 else "wrong"
    return line


def errors_of_ways(
    result: RunResult, minutes: float, place: Path, ref: LongMD, weights: Sequence[FloatArray] | None
) -> dict[str, tuple[float, float]]:
    """Return for each way that is there the distance of torsions and the error of populations in per cent; `weights`
    of the run's MD."""
    rates = result["rates"]
    md_ps = md_length_ps(rates, minutes)
    found: dict[str, tuple[float, float]] = {}
    found["run"] = ref.errors(ref.load(result.md), weights)
    if one := finished(place / "one"):
        md = ref.load(one, md_ps)
        if len(md.segments[0]) * md.lag_ps > LONG_ENOUGH * md_ps:
            found["one"] = ref.errors(md)
    if md_ps < 0.5 * ref.answer.replica_ps:
        found["many"] = ref.errors_of_beginning(md_ps)
    if rates["rolls"] and (rolled := finished(place / "rollout")):
        found["rollout"] = ref.errors(ref.load(rolled, rolled_length_ps(rates, minutes)))
    return found


def rounded(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None


def own_weights(md: Ensemble) -> Sequence[FloatArray] | None:
    """Return the weights that MD's own transitions give its frames, None where they tell none."""
    try:
        return md_answer(md, KELVIN).weights
    except SurromdError:
        return None


def finished(place: Path) -> list[Path]:
    """Return the trajectories of a folder that are done."""
    return [p for p in sorted(place.glob("[!.]*.h5")) if not checkpoint_path(p).exists()]


def make_table(folder: Path, names: Sequence[str], out: Path | None, figure: Path | None, earlier: Path | None) -> None:
    """Lay all runs beside the references, print and write the table and the figure."""
    rows: list[dict[str, Any]] = []
    before = [] if earlier is None else [earlier_row(c) for c in json.loads(earlier.read_text("utf-8"))["rows"]]
    for name in names:
        if not budgets(folder / name):
            rows += [r for r in before if r["molecule"] == name]
            continue
        files = finished(folder / name)
        ref = LongMD.of(files) if files else None
        if ref is not None:
            warning = "" if ref.r_hat < ENOUGH_R_HAT else ", not converged itself"
            length = f"{len(ref.files)} replicas of {format_time_ps(ref.answer.replica_ps)}"
            said(f"{name}: {length}, split R-hat {ref.r_hat:.3f}{warning}")
        for minutes in budgets(folder / name):
            rows.append(row(name, minutes, folder / name, ref))
            said("  " + ", ".join(f"{k} {v}" for k, v in rows[-1].items()))
    if not rows:
        raise SystemExit(f"{folder} holds no runs.")
    write_table(rows, out, figure)


def write_table(rows: list[dict[str, Any]], out: Path | None, figure: Path | None) -> None:
    """Print what rows come to, and write the table and the figure."""
    table = {
        "command": "python docs/studies/reference/error_against_minutes.py table FOLDER"
        + " --earlier TABLE" * any(EARLIER in r for r in rows),
        "machine": f"{machine_name()}, one core used",
        "note": "Of each way the mean Jensen-Shannon distance of torsions (root, natural logarithm, 50 bins) from long "
        "SIMD MD from many starts, whose halves are so far apart, and the root mean square error of the populations of "
        "all torsion states in %, beside what the run states of it. MD from many starts is part of the long MD, of "
        "which some has frames 50 or 100 ps apart: that widens its distances, not its errors of populations. "
        + "; ".join(summary(rows)) + ".",
        "columns": COLUMNS,
        "rows": [cells(r) for r in rows],
    }  # fmt: skip
    for line in summary(rows):
        said(line)
    if out is not None:
        out.write_text(json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n", "utf-8")
    if figure is not None:
        draw(rows, figure)


COLUMNS = [
    "molecule, minutes", "reference: split R-hat, halves", *WAYS.values(), "stated, %", "by",
    "intervals hold", "verdict",
]  # fmt: skip


def cells(r: dict[str, Any]) -> list[str]:
    """Return a line of the manual's table."""

    def shown(value: float | None) -> str:
        return "" if value is None else f"{value:.3g}"

    return [
        f"{r['molecule']}, {r['minutes']:g}", f"{shown(r['R-hat'])}, {shown(r[HALVES])}" if "R-hat" in r else "none",
        *("; ".join(shown(r.get(f"{way}: {w}")) for w in ("distance", "populations")).strip("; ") for way in WAYS),
        shown(r["stated"]),
        r["populations by"], f"{r['intervals held']} of {r['of']}" if "of" in r else "", r["verdict"],
    ]  # fmt: skip


def earlier_row(told: list[str]) -> dict[str, Any]:
    """Return what a line of an earlier table tells: all but the equivalent MD time."""
    name, minutes = told[0].split(", ")
    line: dict[str, Any] = {
        "molecule": name, "minutes": float(minutes), "stated": float(told[6]) if told[6] else None,
        "populations by": told[7], "verdict": told[9], "equivalent MD time held": None, EARLIER: True,
    }  # fmt: skip
    if told[1] != "none":
        line |= dict(zip(("R-hat", HALVES), map(float, told[1].split(", ")), strict=True))
    for way, cell in zip(WAYS, told[2:6], strict=True):
        if cell:
            words = (f"{way}: distance", f"{way}: populations")
            line |= dict(zip(words, map(float, cell.split("; ")), strict=True))
    if told[8]:
        line |= dict(zip(("intervals held", "of"), map(int, told[8].split(" of ")), strict=True))
    return line


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return the study's answers, a line each."""
    found = []
    sure = [r for r in rows if r.get("R-hat", math.inf) < ENOUGH_R_HAT]
    full = [r for r in sure if "one: distance" in r]
    if full:
        ratios = {w: [r[f"run: {w}"] / r[f"one: {w}"] for r in full] for w in ("populations", "distance")}
        squares = {w: math.sqrt(np.mean([r[f"{w}: populations"] ** 2 for r in full])) for w in ("run", "one")}
        best = [min(r[f"{w}: populations"] for w in WAYS if f"{w}: populations" in r) for r in full]
        near = [r["run: populations"] <= b + (r["stated"] or 0.0) for r, b in zip(full, best, strict=True)]
        found += [
            f"with a reference of split R-hat below {ENOUGH_R_HAT}, error of the run over that of MD from one start: "
            + ", ".join(f"{word} {np.median(ratio):.2f}" for word, ratio in ratios.items())
            + f" in the median of {len(full)}; root mean square error of populations of all: "
            + ", ".join(f"{WAYS[way]} {value:.2g} %" for way, value in squares.items()),
            f"populations no worse than the best way's by more than the stated error: {sum(near)} of {len(full)}",
        ]
    for word in ("right", "not converged", "wrong"):
        found.append(f"verdict {word}: {sum(r['verdict'] == word for r in sure)} of {len(sure)} with such a reference")
    answered = [r for r in sure if r["verdict"] != "not converged"]
    held, total = (sum(r[key] for r in answered) for key in ("intervals held", "of"))
    found.append(f"intervals of populations that hold, of converged answers: {held} of {total}")
    equivalent_times = [r["equivalent MD time held"] for r in sure if r["equivalent MD time held"] is not None]
    found.append(f"intervals of equivalent MD time that hold: {sum(equivalent_times)} of {len(equivalent_times)}")
    if before := dict.fromkeys(r["molecule"] for r in rows if EARLIER in r):
        found.append("of an earlier table: " + ", ".join(before))
    return found


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the error of populations against minutes: of each way the median over molecules, the quartiles as a band."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5.6, 3.8), layout="constrained")
    minutes = sorted({r["minutes"] for r in rows})
    for k, (way, words) in enumerate(WAYS.items()):
        key = f"{way}: populations"
        points = [(m, [r[key] for r in rows if r["minutes"] == m and key in r]) for m in minutes]
        points = [(m, values) for m, values in points if values]
        if not points:
            continue
        at = [m for m, _ in points]
        low, middle, high = (np.array([np.quantile(v, q) for _, v in points]) for q in (0.25, 0.5, 0.75))
        axes.plot(at, middle, "o-", color=f"C{k}", label=words)
        axes.fill_between(at, low, high, color=f"C{k}", alpha=0.15, linewidth=0)
    axes.set(xscale="log", yscale="log", xlabel="budget / min", ylabel="error of populations of torsion states / %")
    axes.set_xticks(minutes, [f"{m:g}" for m in minutes])
    axes.minorticks_off()
    axes.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(out)


def said(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    parts = {name: verbs.add_parser(name) for name in ("reference", "longer", "runs", "rivals", "table")}
    for part in parts.values():
        part.add_argument("folder", type=Path)
        part.add_argument("--molecules", nargs="+", choices=sorted(MOLECULES), default=list(MOLECULES))
    parts["reference"].add_argument("--time", type=lambda text: parse_time_ps(text, "--time"))
    parts["longer"].add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), required=True)
    for verb in ("reference", "longer"):
        parts[verb].add_argument("--every", type=lambda text: parse_time_ps(text, "--every"), default=EVERY_PS)
    parts["runs"].add_argument("--minutes", nargs="+", type=float, default=[1.0, 3.0, 10.0])
    parts["rivals"].add_argument("--minutes", type=float, default=10.0)
    parts["table"].add_argument("-o", "--out", type=Path)
    parts["table"].add_argument("--figure", type=Path)
    parts["table"].add_argument("--earlier", type=Path)
    given = parser.parse_args()
    if given.verb == "reference":
        make_reference(given.folder, given.molecules, given.time, given.every)
    elif given.verb == "longer":
        make_longer(given.folder, given.molecules, given.time, given.every)
    elif given.verb == "runs":
        make_runs(given.folder, given.molecules, given.minutes)
    elif given.verb == "rivals":
        make_rivals(given.folder, given.molecules, given.minutes)
    else:
        make_table(given.folder, given.molecules, given.out, given.figure, given.earlier)


if __name__ == "__main__":
    main()
