"""What `surromd run --level gfn2-xtb` knows after a few minutes, over the MD that the same minutes buy.

    python docs/studies/quantum/reweighted_runs.py runs FOLDER [--minutes 5] [--molecules NAME ...]
    python docs/studies/quantum/reweighted_runs.py table FOLDER [-o TABLE.json]

`runs` spends the budget on each molecule twice, with two seeds, by the general potential that never saw it (paracetamol
by its own weights, too), on the cores it may use; nothing else should run (`taskset -c 1` for one core). `table` takes
cos and sin of every torsion that turns, folded by its symmetry, as observables f. A run states the mean of each at
GFN2-xTB's law with an error s (jackknife over its replicas); MD of length T would know it to sqrt(2 tau Var f / T),
with tau the integrated correlation time of f in a rollout without torsion moves (16 replicas of 100 ps, annealed first,
which `runs` makes, too): that moves as MD does, and what turns more slowly counts as if it took no longer than that
rollout shows. So a run is worth T = 2 tau Var f / s^2 of MD that has forgotten its start; the speed-up is that over
what MD by GFN2-xTB, a replica a core, makes in the whole budget, at the faster of the speeds that both runs measured.
`z`: root mean square difference of the two runs over their errors, 1 where errors are right.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.comparison.measure.kinetics import zero_crossing
from surrogate.comparison.measure.slow_motion import SLOW_KINDS
from surrogate.comparison.measure.torsions import find_torsions
from surrogate.comparison.read.ensemble import load_ensemble
from surrogate.verbs.run.run_record import RUN_NAME, RunResult
from systems.chemistry.geometry import torsion_angle
from systems.files.whole_file import replica_paths

FloatArray = npt.NDArray[np.float64]
GENERAL = "drug-like-gfn2-xtb"
# None was trained on, but paracetamol by its own weights.
MOLECULES = {
    "paracetamol": ("smiles:CC(=O)Nc1ccc(O)cc1", GENERAL),
    "paracetamol, own weights": ("smiles:CC(=O)Nc1ccc(O)cc1", "paracetamol-gfn2-xtb"),
    "aspirin": ("smiles:CC(=O)Oc1ccccc1C(=O)O", GENERAL),
    "suprofen": ("smiles:CC(C(=O)O)c1ccc(C(=O)c2cccs2)cc1", GENERAL),
    "ibuprofen": ("smiles:CC(C)Cc1ccc(C(C)C(=O)O)cc1", GENERAL),
    "clopidogrel": ("smiles:COC(=O)[C@H](c1ccccc1Cl)N1CCc2sccc2C1", GENERAL),
    "lidocaine": ("smiles:CCN(CC)CC(=O)Nc1c(C)cccc1C", GENERAL),
}
SEEDS = (0, 1)
# The rollout without torsion moves.
PLAIN: dict[str, Any] = {
    "time_ps": 100.0,
    "save_every_ps": 0.5,
    "replicas": 16,
    "anneal_ps": 20.0,
    "guard": "resample",
    "seed": 2,
}
# Two runs so many of their errors apart have errors that are too small: such a molecule counts as no speed-up, and so
# does one whose runs say themselves that they have not converged.
LARGEST_Z = 3.0


def place(folder: Path, name: str, which: int | str) -> Path:
    return folder / f"{name.replace(', ', '_').replace(' ', '_')}_{which}"


def make_runs(folder: Path, names: list[str], minutes: float) -> None:
    """Run every molecule with both seeds; what is done is left alone, what was stopped goes on."""
    for name in names:
        source, weights = MOLECULES[name]
        sm.rollout(source, weights, place(folder, name, "plain.h5"), **PLAIN, resume=True, quiet=True)
    for seed in SEEDS:
        for name in names:
            source, weights = MOLECULES[name]
            out = place(folder, name, seed)
            is_there = (out / RUN_NAME).is_file()
            if not (is_there and RunResult.of(out)["outcome"]):
                sm.run(source, out, level="gfn2-xtb", weights=weights, budget_s=60.0 * minutes, seed=seed, quiet=True,
                       resume=is_there)  # fmt: skip
            said(f"{name}, seed {seed}: {RunResult.of(out).headline}")


def observables(paths: Sequence[str | Path]) -> tuple[FloatArray, float]:
    """Return cos and sin of torsions that turn, folded, `(replicas, frames, k)`, and the frames' spacing in ps."""
    rolled = load_ensemble(paths)
    torsions = [t for t in find_torsions(rolled.scene) if t.kind in SLOW_KINDS]
    quads, fold = np.array([t.quad for t in torsions]), np.array([t.fold for t in torsions])
    n = min(rolled.segment_lengths)
    angles = [fold * torsion_angle(np.asarray(s[:n]).transpose(2, 1, 0), quads).T for s in rolled.segments]
    return np.array([np.concatenate([np.cos(a), np.sin(a)], axis=1) for a in angles]), rolled.lag_ps


def correlation_ps(f: FloatArray, lag_ps: float) -> FloatArray:
    """Return the integrated correlation time of each observable, ps."""
    return lag_ps * np.array([zero_crossing(list(f[:, :, k]))[1] for k in range(f.shape[2])])


class Run:
    """One run: observables `(replicas, frames, k)` of its rollout, weights `(replicas, frames)` at GFN2-xTB's law;
    `tau_ps` (k,) of MD."""

    def __init__(self, folder: Path, tau_ps: FloatArray) -> None:
        self.result, self.tau_ps = RunResult.of(folder), tau_ps
        self.f, lag_ps = observables(self.result.trajectory)
        self.own_tau_ps = correlation_ps(self.f, lag_ps)
        n = self.f.shape[1]
        self.w = np.array([sm.frame_weights(path)[:n] for path in self.result.trajectory])
        self.asked, self.effective = self.result.answer["energies"]
        # As in the answer: frames that were asked, weighted, less what these are off by without weights.
        by_all, by_asked, weighted = (
            self.without(w) for w in (np.ones_like(self.w), (self.w > 0).astype(float), self.w)
        )
        off, apart = (x - x.mean(0) for x in (by_asked - by_all, weighted))
        b = np.clip((off * apart).sum(0) / np.square(off).sum(0), 0.0, 1.0)
        each = weighted - b * (by_asked - by_all)
        r = len(each)
        self.mean, self.error = each.mean(0), np.sqrt((r - 1) / r * np.square(each - each.mean(0)).sum(0))
        norm = self.w.sum()
        self.variance = np.einsum("rt,rtk->k", self.w, np.square(self.f - self.mean)) / norm

    def without(self, w: FloatArray) -> FloatArray:
        """Return the means of f by some weights, each replica left out once, `(replicas, k)`."""
        sums, norms = np.einsum("rt,rtk->rk", w, self.f), w.sum(1)[:, None]
        return np.asarray((sums.sum(0) - sums) / (norms.sum() - norms))

    def worth_ps(self) -> FloatArray:
        """Return of how much MD each observable is worth."""
        return np.asarray(2.0 * self.tau_ps * self.variance / np.square(self.error))

    @property
    def md_ps(self) -> float:
        """What MD makes in the whole budget."""
        return float(self.result["rates"]["md_ps_per_s"]) * float(self.result["settings"]["budget_s"])


def line(name: str, runs: list[Run]) -> tuple[list[str], float]:
    """Return the cells of a molecule, and its speed-up: the mean of both runs' medians over observables."""
    md_ps = max(r.md_ps for r in runs)
    # What does not vary (sin of a mirror image) is no observable.
    varies = np.all([r.variance > 1e-3 for r in runs], axis=0)
    worth = [np.median((r.worth_ps() / md_ps)[varies]) for r in runs]
    least = [np.min((r.worth_ps() / md_ps)[varies]) for r in runs]
    a, b = runs
    z = float(np.sqrt(np.mean(np.square((a.mean - b.mean)[varies]) / (a.error**2 + b.error**2)[varies])))
    converged = all(r.result["outcome"]["converged"] for r in runs)
    none = "not converged" if not converged else "runs disagree" if z >= LARGEST_Z else ""
    shares = ", ".join(f"{r.effective / r.asked:.0%} of {r.asked}" for r in runs)
    rolled = float(np.mean([r["rolled_ps"] for r in (x.result["outcome"] for x in runs)])) * 2e-3
    return [
        name, str(a.result["rates"]["n_atoms"]), f"{rolled:.2g}", f"{md_ps:.0f}", shares,
        f"{a.tau_ps[varies].max():.2g}; {max(r.own_tau_ps[varies].max() for r in runs):.2g}",
        f"{max(np.max(r.error[varies]) for r in runs):.2g}", f"{z:.2g}",
        f"none: {none}" if none else f"{np.mean(worth):.3g} ({', '.join(f'{w:.3g}' for w in worth)})",
        "" if none else f"{np.mean(least):.2g}",
    ], 0.0 if none else float(np.mean(worth))  # fmt: skip


def make_table(folder: Path, out: Path | None) -> None:
    rows, gains = [], {}
    for name in MOLECULES:
        places = [place(folder, name, seed) for seed in SEEDS]
        if all((p / RUN_NAME).is_file() and RunResult.of(p)["outcome"] for p in places):
            tau_ps = correlation_ps(*observables(replica_paths(place(folder, name, "plain.h5"), PLAIN["replicas"])))
            cells, gains[name] = line(name, [Run(p, tau_ps) for p in places])
            rows.append(cells)
            said(" | ".join(cells))
    unseen = [gain for name, gain in gains.items() if not name.startswith("paracetamol")]
    if not unseen:
        raise SystemExit("there are no two runs of any molecule; make them first.")
    said(f"median of {len(unseen)} molecules but paracetamol: {np.median(unseen):.2g}")
    if out is not None:
        settings = RunResult.of(next(p.parent for p in folder.glob(f"*/{RUN_NAME}")))
        table = {
            "command": "python docs/studies/quantum/reweighted_runs.py table FOLDER",
            "machine": f"{machine_name()}, {settings['rates']['cores']} core(s) used",
            "note": f"Budgets of {settings['settings']['budget_s'] / 60:g} min in all, two runs each. Median of all "
                    f"but paracetamol: {np.median(unseen):.2g}.",
            "columns": ["molecule", "atoms", "rolled, ns", "MD in as much time, ps", "effective of frames asked",
                        "slowest, ps: without moves; with", "largest error", "z",
                         "speed-up, median of observables (both runs)", "least"],
            "rows": rows,
        }  # fmt: skip
        out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


def said(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    running, telling = verbs.add_parser("runs"), verbs.add_parser("table")
    for part in (running, telling):
        part.add_argument("folder", type=Path)
    running.add_argument("--minutes", type=float, default=5.0)
    running.add_argument("--molecules", nargs="+", default=list(MOLECULES), choices=list(MOLECULES))
    telling.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    if given.verb == "runs":
        given.folder.mkdir(parents=True, exist_ok=True)
        make_runs(given.folder, given.molecules, given.minutes)
    else:
        make_table(given.folder, given.out)


if __name__ == "__main__":
    main()
