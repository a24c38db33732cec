"""Alanine dipeptide in TIP3P water: the same System by OpenMM and by SIMD replicas.

    python docs/studies/water/alanine_dipeptide.py scene FOLDER             # solvated, at the mean volume of 1 bar
    python docs/studies/water/alanine_dipeptide.py openmm FOLDER --time 20ns --replicas 3
    python docs/studies/water/alanine_dipeptide.py simd FOLDER --time 60ns
    python docs/studies/water/alanine_dipeptide.py simd OTHER --time 60ns --padding 2nm    # twice as far between images
    python docs/studies/water/alanine_dipeptide.py table FOLDER    # simd_r*.h5, supercell.py's solute_r*.h5
    python docs/studies/water/alanine_dipeptide.py table FOLDER --control OTHER -o TABLE.json

A run that was stopped goes on. `table` leaves out the first 200 ps of each replica, and replicas that cross to phi > 0,
where they stay longer than these runs last: share of psi in the alpha basin (-120 to 80 degrees), the integral of the
autocorrelation of cos psi and cos phi up to where it falls below 0.05, and the Jensen-Shannon distance (natural
logarithm, square root) of phi/psi maps of 36 x 36 bins, each of the last part, as long in both, of as many replicas as
half of the smaller set has, mean over random draws. Errors are over replicas, one left out after the other.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions, MDConfig
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.run.replicas import simulate_batch
from md_reference.run.simulate import simulate
from md_reference.simd.force_field import n_replicas
from surrogate.comparison.measure.distributions import distance, is_alpha
from systems.chemistry.geometry import torsion
from systems.library.named_scenes import prepare
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory
from systems.units import parse_time_ps, quantity

SPEC = ForceFieldSpec("ff14SB", "tip3p")
VOLUME_PS, DISCARDED = 500.0, 0.2
SETTLED_PS = 200.0
# A replica is left out that is longer at phi > 0 than this share: it stays for nanoseconds.
CROSSED = 0.01


def at_one_bar(scene: Scene, *, seed: int) -> Scene:
    """Return the scene at the mean volume of 400 ps at 300 K and 1 bar."""
    conditions = Conditions(force=SPEC, ensemble="npt", platform="CPU", seed=seed)
    with Engine(scene, conditions, system=build_system(scene, SPEC)) as engine:
        engine.minimise(max_iterations=500)
        engine.thermalise()
        volumes = []
        for _ in range(500):
            engine.step(round(VOLUME_PS / 500 / conditions.timestep_ps))
            state = engine.state()
            assert state.cell_nm is not None
            volumes.append(float(np.linalg.det(state.cell_nm)))
    scale = (float(np.mean(volumes[round(DISCARDED * len(volumes)) :])) / volumes[-1]) ** (1 / 3)
    return replace(scene, positions_nm=state.positions_nm * scale, cell_nm=state.cell_nm * scale)


def angles_of(folder: Path, kind: str, every_ps: float = 1.0) -> list[FloatArray]:
    """Return phi and psi `(n_frames, 2)` in radians of each replica, frames `every_ps` apart."""
    found = []
    for k in range(len(list(folder.glob(f"{kind}_r*.h5")))):
        with open_trajectory(folder / f"{kind}_r{k}.h5") as reader:
            assert reader.scene is not None
            names = reader.scene.atom_names
            backbone = [i for i, name in enumerate(names) if name in ("C", "N", "CA")][:5]
            assert [names[i] for i in backbone] == ["C", "N", "CA", "C", "N"]
            quads = np.array([backbone[:4], backbone[1:]])
            lag_ps = float(reader.time_ps[1] - reader.time_ps[0])
            frames = reader.read(round(SETTLED_PS / lag_ps), None, max(1, round(every_ps / lag_ps)))
            found.append(np.asarray(torsion(frames.astype(np.float64), quads)))
    return found


def memory_ps(values: Sequence[FloatArray], every_ps: float = 1.0) -> float:
    """Return the integral of the autocorrelation of series of equal steps, up to where it is below 0.05."""
    mean, variance = np.concatenate(values).mean(), np.concatenate(values).var()
    total = 0.5
    for lag in range(1, min(map(len, values))):
        now = np.concatenate([(x[lag:] - mean) * (x[:-lag] - mean) for x in values]).mean() / variance
        if now < 0.05:
            break
        total += float(now)
    return every_ps * total


def with_error(of: Callable[[Sequence[FloatArray]], float], runs: Sequence[FloatArray]) -> str:
    n = len(runs)
    without = [of([*runs[:k], *runs[k + 1 :]]) for k in range(n)]
    return f"{of(runs):.3g} ± {np.sqrt((n - 1) * np.var(without)):.2g}"


def apart(one: Sequence[FloatArray], other: Sequence[FloatArray], n: int) -> str:
    """Return the mean distance and its spread of maps of `n` replicas of either set, which may be the same."""
    rng, found = np.random.default_rng(0), []
    for _ in range(50):
        first = rng.permutation(len(one))
        second = first[n:] if one is other else rng.permutation(len(other))
        maps = [np.histogramdd(np.concatenate([runs[k] for k in chosen[:n]]), 36, [(-np.pi, np.pi)] * 2)[0].ravel()
                for runs, chosen in ((one, first), (other, second))]  # fmt: skip
        found.append(float(distance(*maps)))
    return f"{np.mean(found):.3f} ± {np.std(found):.3f}"


def make_table(sets: dict[str, list[FloatArray]], machine: str, out: Path, *, is_control: bool) -> None:
    """Lay a set of runs beside another, which is the reference."""
    note = "; ".join(f"{name}: {len(runs)} runs, {sum(map(len, runs)) / 1e3:.1f} ns" for name, runs in sets.items())
    crossed = {name: [bool((x[:, 0] > 0).mean() > CROSSED) for x in runs] for name, runs in sets.items()}
    sets = {
        name: [x for x, left_out in zip(runs, crossed[name], strict=True) if not left_out]
        for name, runs in sets.items()
    }
    note += "".join(f"; {sum(x)} of {name} crossed to phi > 0 and left out" for name, x in crossed.items() if any(x))
    half = min(map(len, sets.values())) // 2
    measures: dict[str, Callable[[Sequence[FloatArray]], float]] = {
        "psi in the alpha basin, %": lambda runs: 100 * float(is_alpha(np.concatenate(runs)[:, 1]).mean()),
        "cos psi remembered, ps": lambda runs: memory_ps([np.cos(x[:, 1]) for x in runs]),
        "cos phi remembered, ps": lambda runs: memory_ps([np.cos(x[:, 0]) for x in runs]),
    }
    rows = [[name, *(with_error(of, runs) for runs in sets.values())] for name, of in measures.items()]
    last = min(len(x) for runs in sets.values() for x in runs)
    one, other = ([x[-last:] for x in runs] for runs in sets.values())
    name = f"phi/psi maps of {half} replicas, distance from the first column's"
    rows.append([name, apart(one, one, half), apart(one, other, half)])
    table = {
        "command": "python docs/studies/water/alanine_dipeptide.py table FOLDER" + " --control OTHER" * is_control,
        "machine": machine,
        "note": note,
        "columns": ["", *sets],
        "rows": rows,
    }
    out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("scene", "openmm", "simd", "table"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--time", default="20ns")
    parser.add_argument("--replicas", type=int, default=0, help="0: 3 by OpenMM, a batch by SIMD")
    parser.add_argument("--batch", type=int, default=0, help="simd: which batch of replicas, with a seed of its own")
    parser.add_argument("--padding", help="distance between images, in a cell of its own at the volume of 1 bar")
    parser.add_argument("--control", type=Path, help="table: runs in another cell, instead of OpenMM's")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/results/tables/water_alanine_dipeptide.json"))
    args = parser.parse_args()
    if args.what == "table":
        simd, machine = angles_of(args.folder, "simd"), f"SIMD: {machine_name()}"
        if args.control is None:
            sets = {"OpenMM": angles_of(args.folder, "solute"), "SIMD": simd}
            machine += "; OpenMM: OpenCL, one H200 GPU"
        else:
            sets = {"1 nm between images": simd, "2 nm between images": angles_of(args.control, "simd")}
        make_table(sets, machine, args.out, is_control=args.control is not None)
        return
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / "scene.json"
    dry = prepare("alanine-dipeptide")
    if args.what == "scene":
        path.write_text(json.dumps(at_one_bar(solvate(dry, SPEC, WaterBox()), seed=1).to_dict()))
        return
    if args.padding:
        scene = solvate(dry, SPEC, WaterBox(padding_nm=quantity("padding_nm", args.padding)))
    else:
        scene = Scene.from_dict(json.loads(path.read_text()))
    config = MDConfig(force=SPEC, time_ps=parse_time_ps(args.time), keep="solute", platform=args.what)
    if args.what == "simd":
        n = args.replicas or n_replicas()
        outs = [args.folder / f"simd_r{k}.h5" for k in range(args.batch * n, (args.batch + 1) * n)]
        simulate_batch(scene, replace(config, seed=args.batch), outs, resume=any(out.exists() for out in outs))
        return
    for k in range(args.replicas or 3):
        out = args.folder / f"openmm_r{k}.h5"
        settings = replace(config, platform="CPU", keep="all", seed=k)
        simulate(scene, settings, out, resume=out.exists())


if __name__ == "__main__":
    main()
