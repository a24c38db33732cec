"""What implicit solvent is worth for explicit water: alanine dipeptide in TIP3P, by `peptides` (OBC2), tuned or not.

`peptides` are the weights before they knew TIP3P, as of commit cf3bf1a; put that file in the place of today's.

    python docs/studies/water/transfer.py train FOLDER WATER [--replicas 1 4 16 --steps 1500]
    python docs/studies/water/transfer.py table FOLDER WATER

WATER is the folder of `alanine_dipeptide.py` and `supercell.py`: SIMD replicas in water to learn from (`simd_r*.h5`),
OpenMM's to be tested by (`solute_r*.h5`). `train` takes so many of the former and makes FOLDER/tuned-N.safetensors,
which goes on from `peptides`, and FOLDER/new-N.safetensors, which begins with nothing and has as many steps. `table`
rolls each as often and as long as OpenMM's replicas are, frames 10 ps apart, and `peptides` itself, and a mixture:
`states-N` has the flow of `peptides` and the probabilities of torsions' states of `tuned-N`. MD in OBC2 stands beside
them. phi > 0 takes longer than the replicas in water are, and is left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import alanine_dipeptide as water
import numpy as np

import surrogate as sm
from md_reference.run.machine import machine_name
from surrogate.comparison.measure.distributions import is_alpha
from surrogate.data import collect_frames
from surrogate.models.architecture import weights_path
from surrogate.models.peptides.chains import POSITIVE_PHI_DEG
from surrogate.models.peptides.layout import PeptideConfig
from surrogate.models.peptides.trainer import PeptideTraining, train_peptides
from surrogate.models.weights import load_weights, save_weights
from systems.scene import FloatArray
from systems.trajectory.codec import open_trajectory

SCENE, IMPLICIT = "alanine-dipeptide", "peptides"
EVERY_PS, SEED = 10.0, 1
# Rolled with the solver that trainings make use of; `peptides` itself by its own.
METHODS = {
    "tuned": "peptides, tuned whole",
    "states": "peptides, its probabilities of states tuned",
    "new": "from nothing",
}


def train(folder: Path, water_runs: Path, replicas: Sequence[int], steps: int) -> None:
    """Train what is not there, on the first replicas of each number."""
    for n in replicas:
        frames = [collect_frames([water_runs / f"simd_r{k}.h5" for k in range(n)])]
        for method, start in (("tuned", load_weights(weights_path(IMPLICIT))), ("new", None)):
            out = folder / f"{method}-{n}.safetensors"
            if is_done(out):
                continue
            training = PeptideTraining(steps=steps, time_reversal=True)
            train_peptides(frames, out, PeptideConfig(), training, start=start, resume=True)


def is_done(weights: Path) -> bool:
    return weights.exists() and not list(weights.parent.glob(f"{weights.stem}.*.train.safetensors"))


def with_states_of(tuned: Path, out: Path) -> None:
    """Write `peptides` with the probabilities of states of weights that go on from them."""
    whole, other = load_weights(weights_path(IMPLICIT)), load_weights(tuned)
    whole.model.load_state_dict({k: v for k, v in other.model.state_dict().items() if k.startswith("jumps")}, False)
    save_weights(out, whole.model, other.domain, other.provenance)


def rolled(folder: Path, weights: str | Path, n: int, time_ps: float) -> tuple[list[FloatArray], str]:
    """Return phi and psi of `n` rollouts, made where they are not there yet, and kept in `folder`, and how many us an
    hour are rolled."""
    folder.mkdir(parents=True, exist_ok=True)
    sm.rollout(SCENE, weights, folder / "rolled.h5", time_ps=time_ps, save_every_ps=EVERY_PS, replicas=n, seed=SEED,
               resume=True, force=True, quiet=True)  # fmt: skip
    with open_trajectory(folder / "rolled_r0.h5") as reader:
        per_hour = float(reader.record["cost"]["ns_per_day"]) / 24.0
    return water.angles_of(folder, "rolled", EVERY_PS), f"{1e-3 * per_hour:.2g}"


def md_in_obc2(folder: Path, n: int, time_ps: float) -> list[FloatArray]:
    """Return phi and psi of `n` replicas of MD in OBC2."""
    folder.mkdir(parents=True, exist_ok=True)
    sm.reference(SCENE, folder / "md.h5", time_ps=time_ps, save_every_ps=EVERY_PS, replicas=n, seed=SEED,
                 platform="simd", resume=True, quiet=True)  # fmt: skip
    return water.angles_of(folder, "md", EVERY_PS)


def left(runs: Sequence[FloatArray]) -> list[FloatArray]:
    """Return runs of phi and psi without frames at phi > 0."""
    low, high = np.radians(POSITIVE_PHI_DEG)
    return [x[~((x[:, 0] > low) & (x[:, 0] < high))] for x in runs]


def make_table(folder: Path, water_runs: Path, out: Path) -> None:
    test = water.angles_of(water_runs, "solute", EVERY_PS)
    n, half = len(test), len(test) // 2
    time_ps = water.SETTLED_PS + EVERY_PS * min(map(len, test))
    sources: dict[tuple[str, str], tuple[list[FloatArray], str]] = {
        ("MD in TIP3P by OpenMM", ""): (test, ""),
        ("MD in TIP3P by SIMD, what is learned from", "16"): (water.angles_of(water_runs, "simd", EVERY_PS), ""),
        ("MD in OBC2", ""): (md_in_obc2(folder / "obc2", n, time_ps), ""),
        ("peptides, as shipped", "0"): rolled(folder / IMPLICIT, IMPLICIT, n, time_ps),
    }
    for method, words in METHODS.items():
        for tuned in sorted(filter(is_done, folder.glob("tuned-*[0-9].safetensors")), key=lambda p: p.stem.zfill(20)):
            trained = tuned.stem.rpartition("-")[2]
            weights = folder / f"{method}-{trained}.safetensors"
            if method == "states" and not weights.exists():
                with_states_of(tuned, weights)
            if is_done(weights):
                sources[words, trained] = rolled(folder / weights.stem, weights, n, time_ps)
    rows, of_test = [], left(test)
    for (words, trained), (runs, per_hour) in sources.items():
        own = of_test if runs is test else left(runs)  # `apart` tells by this what shares no run
        rows.append([
            words, trained, water.apart(of_test, own, half),
            water.with_error(lambda some: 100 * float(is_alpha(np.concatenate(some)[:, 1]).mean()), own),
            *(water.with_error(lambda some, k=k: water.memory_ps([np.cos(x[:, k]) for x in some], EVERY_PS), runs)
              for k in (1, 0)), per_hour,
        ])  # fmt: skip
        print(*rows[-1], sep=" | ")  # noqa: T201
    table = {
        "command": "python docs/studies/water/transfer.py table FOLDER WATER",
        "machine": f"trained and rolled: {machine_name()}, one core",
        "note": f"{n} x {1e-3 * (time_ps - water.SETTLED_PS):.2f} ns of each, but SIMD's sixteen replicas; maps of "
        f"{half} against {half} of OpenMM's; phi > 0 left out; errors over replicas",
        "columns": ["", "replicas in water trained on", "phi/psi map, distance from OpenMM's",
                    "psi in the alpha basin, %", "cos psi remembered, ps", "cos phi remembered, ps",
                    "rolled, us an hour"],
        "rows": rows,
    }  # fmt: skip
    out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("train", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("water", type=Path)
    parser.add_argument("--replicas", type=int, nargs="+", default=(16, 4, 1))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/results/tables/water_transfer.json"))
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.what == "train":
        train(args.folder, args.water, args.replicas, args.steps)
    else:
        make_table(args.folder, args.water, args.out)


if __name__ == "__main__":
    main()
