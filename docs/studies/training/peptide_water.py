"""What implicit data are worth for peptides in explicit water: weights for OBC2 on molecules in TIP3P, in six ways.

    python docs/studies/training/peptide_water.py train FOLDER WATER OBC2 [--start W] [--runs 1 4 16]
               [--methods new states whole joint] [--steps 600]
    python docs/studies/training/peptide_water.py table FOLDER WATER OBC2 [--start W]

WATER and OBC2 are folders of `peptide_campaign`: what is in WATER/train is learned from, of each molecule so many runs,
and what is in WATER/test is rolled as often and as long, from the same first frames. Weights W, for OBC2, are taken as
they are (`unchanged`); their frames are weighed and their time is stretched as monomers in both solvents say
(`corrected`, `peptide_correction`); they are trained further, `whole`, or the probabilities of `states` alone, or whole
on both folders (`joint`); and weights are trained `new`, from nothing. `train` makes FOLDER/METHOD-RUNS.safetensors,
one after the other in one process a core; what is there stays. `table` rolls them all beside MD in both solvents: how
far torsions are from MD's in water (`peptide_unseen`, pooled), of every ψ the share of time in helices and how often it
crosses to the other basin or back, this over MD's in the geometric mean, and the pace over that of MD by SIMD replicas
on the same core.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import peptide_transfer
from peptide_correction import Correction
from peptide_rollouts import FRAMES_PS, rolled, thinned
from peptide_scores import Turn, angles, psi_crossings, rarely_positive, turns_of
from peptide_unseen import densities, over, pace, pooled, shown, spent_s
from processes import in_order, is_trained

from md_reference.run.machine import available_cores, machine_name
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.measure.distributions import is_alpha
from surrogate.models.architecture import weights_path
from surrogate.models.weights import load_weights
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory

FloatArray = npt.NDArray[np.float64]
SHIPPED = "peptides"
_WHAT = ("weights for OBC2", "MD, ns")
TABLES = Path(__file__).parents[2] / "results" / "tables"
# By what follows `peptide_transfer`: whether it goes on from weights, and what is tuned of these.
TRAINED = {"new": None, "states": "states", "whole": "all", "joint": "all"}
WORDS = {
    "unchanged": "as they are", "corrected": "reweighted and stretched by monomers", "new": "trained from nothing",
    "states": "probabilities of states tuned", "whole": "tuned whole", "joint": "tuned whole, on both solvents",
}  # fmt: skip


def tasks(methods: Sequence[str], runs: Sequence[int]) -> list[tuple[str, int]]:
    """Return what is trained, the most runs first."""
    return [(method, n) for n in sorted(runs, reverse=True) for method in methods]


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


class Molecule(NamedTuple):
    """A molecule that is tested by: its scene in water, torsions, runs of MD in water and in OBC2 as torsions
    `(n_frames, n_torsions)` in rad, the first frames in water, and how long a run is."""

    name: str
    scene: Scene
    turns: list[Turn]
    md: list[FloatArray]
    in_obc2: list[FloatArray]
    starts_nm: FloatArray
    time_ps: float

    @classmethod
    def of(cls, water: Path, obc2: Path | None, name: str) -> Molecule:
        files = sorted((water / "test" / name).glob("run_*.h5"))
        scene, frames, time_ps = thinned(files)
        turns, dry = turns_of(scene), [] if obc2 is None else sorted((obc2 / "test" / name).glob("run_*.h5"))
        implicit = thinned(dry)[1] if dry else []
        md, in_obc2 = ([angles(turns, x) for x in some] for some in (frames, implicit))
        return cls(name, scene, turns, md, in_obc2, np.stack([x[0] for x in frames]), time_ps)

    @property
    def residues(self) -> list[str]:
        return [name for name in self.scene.residue_names if name not in ("ACE", "NME")]

    @property
    def psi(self) -> dict[str, int]:
        """Every ψ, by what it is called in a table."""
        free = " (free)" if self.name.startswith("free-") else ""
        return {f"ψ {self.residues[t.residue]}{free}": k for k, t in enumerate(self.turns) if t.kind == "psi"}

    def crossings(self, runs: Sequence[FloatArray], k: int, clock: float = 1.0) -> FloatArray:
        """Return how often the ψ at a place crosses, and the time in ns, of each run `(n_runs, 2)`."""
        return np.array([[psi_crossings(x[:, k]), 1e-3 * FRAMES_PS * len(x) * clock] for x in runs])

    def apart(self, runs: Sequence[FloatArray], weights: Sequence[FloatArray]) -> float:
        """Return how far torsions are from MD's in water, pooled, over MD's own; a φ > 0 that MD hardly enters plays no
        part."""
        rare, n = rarely_positive(self.turns, self.md), min(map(len, self.md))
        both = []
        for some, counted in ((self.md, None), ([x[:n] for x in runs], weights)):
            left = [(~x).astype(np.float64) for x in shown(some, rare)]
            if counted is not None:
                left = [a * b[:n] for a, b in zip(left, counted, strict=True)]
            both.append(densities(some, left))
        return over(pooled, *both)[0]


def free_ends(residues: Sequence[str]) -> bool:
    return residues[0] != "ACE"


def with_error(of: Callable[[list[int]], float], n: int) -> str:
    """Return what a statistic is of all `n` runs, and its standard error by leaving one out after the other."""
    without = [of([k for k in range(n) if k != left]) for left in range(n)]
    error = math.sqrt((n - 1) * float(np.var(without)))
    digits = max(0, -math.floor(math.log10(error))) if error > 0 else 2
    return f"{of(list(range(n))):.{digits}f} ± {error:.{digits}f}"


def row(
    words: str, learned: str, of: Sequence[tuple[Molecule, list[FloatArray], list[FloatArray]]], clock: float = 1.0
) -> tuple[list[str], list[str]]:  # fmt: skip
    """Return a line of both tables, of crossings and of populations, of weights that `learned` so many ns: of each
    molecule runs, none where weights do not cover it, and what their frames count."""
    apart = [m.apart(runs, weights) for m, runs, weights in of if not free_ends(m.scene.residue_names)]
    helices, often, ratios = [], [], []
    for molecule, runs, weights in of:
        if not runs:
            often += [""] * len(molecule.psi)
            helices += [""] * len(molecule.psi)
            continue
        for k in molecule.psi.values():
            alpha = np.array([[(w * is_alpha(x[:, k])).sum(), w.sum()] for x, w in zip(runs, weights, strict=True)])
            count, of_md = molecule.crossings(runs, k, clock), molecule.crossings(molecule.md, k)
            for found, each, factor in ((helices, alpha, 100.0), (often, count, 1.0)):
                found.append(with_error(lambda some, e=each, f=factor: f * np.divide(*e[some].sum(axis=0)), len(runs)))
            if free_ends(molecule.scene.residue_names):
                continue  # which not all weights cover
            # Half a crossing more, for those never seen; counts scatter as Poisson's.
            (n, ns), (n_md, ns_md) = (x.sum(axis=0) + (0.5, 0.0) for x in (count, of_md))
            ratios.append((math.log(n / ns / n_md * ns_md), 1.0 / n + (1.0 / n_md if runs is not molecule.md else 0.0)))
    logs, variances = np.array(ratios).T
    error = math.sqrt(variances.sum()) / len(logs)
    mean, low, high = (f"{math.exp(logs.mean() + k * error):.2f}" for k in (0, -1, 1))
    return [words, learned, *often, f"{mean} [{low}, {high}]"], [words, learned, f"{np.mean(apart):.2f}", *helices]


class Tests(NamedTuple):
    """The molecules that are tested by, and how fast a core simulates each by SIMD replicas."""

    molecules: list[Molecule]
    paces: dict[str, float]

    @classmethod
    def of(cls, water: Path, obc2: Path | None = None) -> Tests:
        found = [Molecule.of(water, obc2, place.name) for place in sorted((water / "test").iterdir())
                 if len(list(place.glob("run_*.h5"))) >= 4]  # fmt: skip
        return cls(found, {m.name: pace(m.scene, m.starts_nm[0], "tip3p") for m in found})

    def even(self, some: Sequence[list[FloatArray]]) -> list[tuple[Molecule, list[FloatArray], list[FloatArray]]]:
        return [(m, runs, [np.ones(len(x)) for x in runs]) for m, runs in zip(self.molecules, some, strict=True)]

    def roll(self, path: Path, folder: Path, solvent: str | None) -> tuple[list[list[FloatArray]], str]:
        """Return what weights roll, and how many times faster than MD by SIMD replicas on this core."""
        weights, faster = load_weights(path), []
        found: list[list[FloatArray]] = []
        for m in self.molecules:
            outs = [folder / path.stem / m.name / f"{k:02d}.h5" for k in range(len(m.md))]
            if free_ends(m.scene.residue_names) and not any(map(free_ends, weights.domain.peptides)):
                found.append([])
                continue
            frames = rolled(weights, m.scene, outs, m.time_ps, FRAMES_PS, solvent, m.starts_nm)
            found.append([angles(m.turns, x) for x in frames])
            faster.append(m.time_ps / spent_s(outs[0]) / self.paces[m.name])
        return found, f"{float(f'{np.mean(faster):.2g}'):,.0f}"

    @property
    def psi(self) -> list[str]:
        return [name for m in self.molecules for name in m.psi]

    @property
    def lengths(self) -> str:
        return "; ".join(f"{len(m.md)} runs of {1e-3 * m.time_ps:.2g} ns of {m.name}" for m in self.molecules)


def write(out: Path, columns: Sequence[str], rows: Sequence[Sequence[str]], words: str, note: str) -> None:
    about = {"command": f"python docs/studies/training/peptide_water.py {words}", "machine": machine_name()}
    table = {"columns": columns, "rows": rows, **about, "note": note}
    out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")
    for line in rows:
        sys.stdout.write(" | ".join(line) + "\n")


def make_table(folder: Path, water: Path, obc2: Path, start: str, out: Path) -> None:
    tests = Tests.of(water, obc2)
    correction = Correction.of(water / "train", obc2 / "train")
    unchanged, faster = tests.roll(weights_path(start), folder, None)
    weighed = [(m, runs, [correction.weights(m.turns, m.residues, x) for x in runs])
               for m, runs in zip(tests.molecules, unchanged, strict=True)]  # fmt: skip
    ns = f"{simulated_ns(water / 'train', n_replicas()):.0f}"
    lines = [
        (*row("MD in TIP3P", "", tests.even([m.md for m in tests.molecules])), "1"),
        (*row("MD in OBC2", "", tests.even([m.in_obc2 for m in tests.molecules])), ""),
        (*row(WORDS["unchanged"], "0", tests.even(unchanged)), faster),
        (*row(WORDS["corrected"], ns, weighed, correction.clock), faster),
    ]
    made = {(list(TRAINED).index(path.stem.split("-")[0]), int(path.stem.split("-")[1])): path
            for path in folder.glob("*-*.safetensors") if is_trained(path)}  # fmt: skip
    for (k, n), path in sorted(made.items()):
        method = list(TRAINED)[k]
        runs, faster = tests.roll(path, folder, "tip3p" if TRAINED[method] else None)
        lines.append((*row(WORDS[method], f"{simulated_ns(water / 'train', n):.0f}", tests.even(runs)), faster))
    note = (
        f"{tests.lengths}. Rollouts from the first frames of MD in TIP3P; MD in OBC2 is longer. Errors over runs, of "
        f"the geometric mean by counts; means are of capped pairs. Stretched by {correction.clock:.1f}."
    )
    words = f"table FOLDER WATER OBC2 --start {start}"
    write(out, [*_WHAT, *tests.psi, "over MD's"], [of_rates for of_rates, *_ in lines], words, note)
    populations = [[*of_helices, faster] for _, of_helices, faster in lines]
    columns = [*_WHAT, "torsions, pooled", *tests.psi, "pace"]
    write(out.with_stem(f"{out.stem}_helices"), columns, populations, words, note)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("water", type=Path)
    parser.add_argument("obc2", type=Path)
    parser.add_argument("--start", default=SHIPPED)
    parser.add_argument("--methods", nargs="+", choices=TRAINED, default=list(TRAINED))
    parser.add_argument("--runs", type=int, nargs="+", default=(1, 4, 16))
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("-o", "--out", type=Path, default=TABLES / "peptides_water.json")
    a = parser.parse_args(arguments)
    a.folder.mkdir(parents=True, exist_ok=True)
    if a.what == "table":
        make_table(a.folder, a.water, a.obc2, a.start, a.out)
        return
    in_order(partial(tasks, a.methods, a.runs), train, math.inf, a.workers, a.folder, a.water, a.obc2, a.start, a.steps)


if __name__ == "__main__":
    main()
