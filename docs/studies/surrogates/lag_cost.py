"""Effective samples of weights that know lags, beside OpenMM: `python docs/studies/surrogates/lag_cost.py W HELD...`.

Each setting (`--settings fitted:4 multistep:10`) rolls a batch of replicas at `--lag`, by turns with OpenMM at 4 fs, on
one thread, in processor time. Printed for each, and for each held-out run against the others: the distance of the φ/ψ
map at φ < 0 to that of all held-out frames; the autocorrelation of cos ψ at 10, 20 and 50 ps; the free energy of φ > 0
in kT; and effective samples a second, time / (2 max(τ, τ of MD)), over OpenMM's. Frames are whole where all their bonds
lie within 0.5 Å of the reference's.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.bench.cost_error import refuse_trained_on, samples_per_second
from surrogate.bench.timing import Roller, machine_facts, roll_in_turns
from surrogate.comparison.measure.distributions import RAMACHANDRAN_BINS, distance, is_positive
from surrogate.models.architecture import weights_path
from surrogate.models.weights import load_weights
from surrogate.sampling.chunks import ChunkSampler
from surrogate.sampling.domain import fit_weights
from surrogate.verbs.options import CostErrorConfig
from systems.chemistry.validity import INVALID, Geometry, check_frames
from systems.trajectory.codec import open_trajectory

sys.path.append(str(Path(__file__).parents[1] / "training"))
from lag_errors import torsions

Angles = npt.NDArray[np.float64]
LAGS_PS = (10.0, 20.0, 50.0)
_BLOCK = 20_000


def torsions_of(path: Path) -> tuple[Angles, float]:
    """Return φ and ψ `(n_frames, 2)` of a trajectory, and the time between its frames, ps."""
    with open_trajectory(path) as run:
        parts = (run.read(k, min(k + _BLOCK, run.n_frames)) for k in range(0, run.n_frames, _BLOCK))
        scene = run.scene
        assert scene is not None
        found = [torsions(scene, frames.astype(np.float64)) for frames in parts]
        return np.concatenate(found), float(run.time_ps[1] - run.time_ps[0])


def counts(runs: list[Angles]) -> npt.NDArray[np.float64]:
    """Return the histogram of φ and ψ at φ < 0, flat."""
    angles, n = np.concatenate(runs), RAMACHANDRAN_BINS.n_total
    angles = angles[angles[:, 0] < 0]
    i, j = (RAMACHANDRAN_BINS.index(angles[:, k]) for k in (0, 1))
    return np.bincount(i * n + j, minlength=n * n).astype(np.float64)


def autocorrelation(runs: list[Angles], most: int) -> npt.NDArray[np.float64]:
    """Return that of cos ψ from lag 0 to `most` frames."""
    values = [np.cos(run[:, 1]) for run in runs]
    whole = np.concatenate(values)
    values = [one - whole.mean() for one in values]
    found = [np.concatenate([x[: len(x) - k] * x[k:] for x in values]).mean() for k in range(most + 1)]
    return np.array(found) / whole.var()


def relaxation_ps(runs: list[Angles], lag_ps: float) -> float:
    """Return the integrated autocorrelation time of cos ψ, to the first zero crossing."""
    found = autocorrelation(runs, int(400 / lag_ps))
    below = np.flatnonzero(found <= 0)
    return lag_ps * (0.5 + float(found[1 : below[0] if len(below) else None].sum()))


def told(runs: list[Angles], lag_ps: float, reference: npt.NDArray[np.float64]) -> dict[str, Any]:
    """Return what is printed of runs with frames `lag_ps` apart."""
    at = autocorrelation(runs, round(LAGS_PS[-1] / lag_ps))
    positive = float(np.mean(is_positive(np.concatenate(runs)[:, 0])))
    return {
        "ns": 1e-3 * lag_ps * sum(map(len, runs)),
        "distance": float(distance(counts(runs), reference)),
        "cos psi": [float(at[round(lag / lag_ps)]) for lag in LAGS_PS],
        "tau_ps": relaxation_ps(runs, lag_ps),
        "phi > 0, kT": -float(np.log(positive / (1 - positive))) if positive else None,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("held", type=Path, nargs="+")
    parser.add_argument("--settings", nargs="+", default=["multistep:10", "fitted:6", "fitted:4"])
    parser.add_argument("--lag", type=float, default=10.0)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--ns", type=float, default=640.0)
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    torch.set_num_threads(1)
    weights = load_weights(weights_path(args.weights))
    refuse_trained_on(weights, args.held[:1], args.held[1:])
    held = [torsions_of(path) for path in args.held]
    runs, apart_ps = [angles for angles, _ in held], held[0][1]
    reference, tau_ps = counts(runs), relaxation_ps(runs, apart_ps)
    rows: dict[str, Any] = {"MD, all": told(runs, apart_ps, reference)}
    for k, path in enumerate(args.held):
        rows[f"MD, {path.stem}"] = told(runs[k : k + 1], apart_ps, reference - counts(runs[k : k + 1]))
    fitted, _ = fit_weights(weights.domain.scene, weights, lag_ps=args.lag)
    geometry = Geometry.from_dict(fitted.domain.geometry)
    config = CostErrorConfig(time_ps=1e3 * args.ns)
    for name in args.settings:
        solver, steps = name.split(":")
        sampler = ChunkSampler(fitted, solver=solver, solver_steps=int(steps))
        roller = Roller(fitted, sampler, rows=args.batch, seed=0)
        roller.advance(sampler.n_new)  # settles
        parts, cost = roll_in_turns(fitted, roller, sampler, config)
        frames = np.concatenate(parts, axis=1)
        row = told(list(torsions(fitted.domain.scene, frames)), args.lag, reference)
        flags = np.concatenate([check_frames(x, geometry) for x in frames])
        rate = samples_per_second(cost["cpu_s_per_ns"]["mean"], row["tau_ps"], tau_ps)
        md_rate = samples_per_second(cost["md_s_per_ns"]["mean"], tau_ps, tau_ps)
        assert rate is not None and md_rate is not None
        row |= {"whole": float(((flags & INVALID) == 0).mean()), "effective_per_s": rate, "over_md": rate / md_rate}
        rows[name] = row | cost | {"ms_per_frame": cost["cpu_s_per_ns"]["mean"] * args.lag}
        if args.json is not None:
            args.json.write_text(json.dumps({"machine": machine_facts(), "rows": rows}, indent=1), encoding="utf-8")
    for name, row in rows.items():
        at = " ".join(f"{value:.3f}" for value in row["cos psi"])
        rare = "never" if row["phi > 0, kT"] is None else f"{row['phi > 0, kT']:.1f} kT"
        line = f"{name:18} {row['ns']:6.0f} ns  distance {row['distance']:.3f}  cos ψ {at}  φ > 0 {rare}"
        if "over_md" in row:
            times = row["speed_over_md"]
            line += f"  whole {100 * row['whole']:.2f} %  {row['ms_per_frame']:.3f} ms/frame  {row['over_md']:.0f} x MD"
            line += f" (time alone {times['mean']:.0f} [{times['least']:.0f}, {times['greatest']:.0f}])"
        sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main()
