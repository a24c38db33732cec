"""Short runs of many peptides from diverse starts: `python -m surrogate.bench.recipes.peptide_runs FOLDER --budget 3h`.

What the weights `peptides` learn from. Each molecule gets a folder: `seeds.npz` (starting structures chosen from
metadynamics) and `run_000.h5`, ...: ff14SB, OBC2, 300 K, 4 fs, frames 1 ps apart, the first 20 ps after each start
discarded. What is there is left alone, so that the same command goes on after an interruption; a run that was under
way is begun again. One process a core, at low priority.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import multiprocessing
import os
import sys
import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions, MDConfig, settings_of
from md_reference.run.engine import Engine
from md_reference.run.integrators import integrator_name
from md_reference.run.machine import available_cores
from md_reference.run.parent_watch import end_with_parent
from md_reference.run.platforms import PlatformChoice, measured_platform
from surrogate.bench.recipes.peptide_list import Peptide, training_peptides
from surrogate.bench.recipes.peptide_seeds import Seeds, choose_seeds
from systems.errors import SimulationError
from systems.prepare.peptide import build_peptide
from systems.scene import Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.trajectory.topology_file import topology_path
from systems.units import parse_wall_s

DISCARD_PS = 20.0
_SPEC = ForceFieldSpec("ff14SB", "obc2")
# What of a molecule's runs is made before any other molecule's rest: a sweep through all shows early what is wrong.
_SWEEPS = (0.25, 1.0)


def simulate_peptide(folder: Path, peptide: Peptide, share: float, deadline: float) -> bool:
    """Make the first `share` of a peptide's runs as far as they are missing; False when the deadline came first."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "a") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        wanted = [folder / f"run_{k:03d}.h5" for k in range(round(share * peptide.n_starts))]
        missing = [(k, path) for k, path in enumerate(wanted) if not path.exists()]
        if not missing:
            return True
        scene = build_peptide(peptide.sequence)
        choice = measured_platform(scene, Conditions(force=_SPEC, timestep_ps=0.004), side_by_side=available_cores())
        if time.time() > deadline:
            return False
        seeds = _seeds(folder / "seeds.npz", scene, peptide, choice.name)
        for k, path in missing:
            if time.time() > deadline:
                return False
            run(scene, seeds, k, path, peptide, choice)
    return True


def _seed_of(peptide: Peptide, k: int) -> int:
    return zlib.crc32(f"{peptide.name}:{k}".encode()) % (2**31 - 2)


def _seeds(path: Path, scene: Scene, peptide: Peptide, platform: str) -> Seeds:
    if path.exists():
        with np.load(path) as stored:
            return Seeds(stored["positions_nm"], tuple(str(g) for g in stored["groups"]))
    seeds = choose_seeds(scene, peptide.n_starts, seed=_seed_of(peptide, -1), platform=platform)
    part = path.with_suffix(".part.npz")
    np.savez_compressed(part, positions_nm=seeds.positions_nm, groups=np.array(seeds.groups))
    os.replace(part, path)
    return seeds


def run(scene: Scene, seeds: Seeds, k: int, out: Path, peptide: Peptide, choice: PlatformChoice) -> None:
    """Simulate from the k-th start and write `out` when all frames are there. Raises SimulationError."""
    import openmm

    config = MDConfig(time_ps=peptide.time_ps, equilibrate_ps=DISCARD_PS, seed=_seed_of(peptide, k), force=_SPEC)
    began = time.monotonic()
    states = []
    with Engine(scene, replace(config, platform=choice.name), threads=1) as engine:
        engine.set_positions(seeds.positions_nm[k])
        engine.thermalise()
        engine.step(round(DISCARD_PS / config.timestep_ps))
        engine.reset_clock()
        for _ in range(config.n_frames):
            engine.step(config.steps_per_frame)
            states.append(engine.state())
    wall_s = time.monotonic() - began
    record: dict[str, Any] = {
        "kind": "reference",
        "integrator": integrator_name(config.ensemble, scene),
        "program": {"openmm": openmm.__version__},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "completed": True,
        **settings_of(config),
        "platform": choice.name,
        "threads": 1,
        "platform_reason": choice.reason,
        "start": {"group": seeds.groups[k], "index": k, "discarded_ps": DISCARD_PS},
        "cost": {
            "wall_s": wall_s,
            "energy_evaluations": config.n_frames * config.steps_per_frame,
            "ns_per_day": config.time_ps * 1e-3 / wall_s * 86400.0,
        },
    }
    part = out.with_name(f".{out.stem}.part.h5")
    with open_writer(part, scene, record, overwrite=True) as writer:
        writer.append(
            np.array([s.positions_nm for s in states], dtype=np.float32),
            (1 + np.arange(config.n_frames)) * config.save_every_ps,
            scalars={
                "potential_kj_mol": np.array([s.potential_kj_mol for s in states]),
                "temperature_k": np.array([s.temperature_k for s in states]),
            },
        )
    os.replace(topology_path(part), topology_path(out))
    os.replace(part, out)


def _work(folder: str, todo: Any, deadline: float) -> None:
    end_with_parent()
    os.environ["OPENMM_CPU_THREADS"] = "1"
    peptides = training_peptides()
    while time.time() < deadline:
        with todo.get_lock():
            place = todo.value
            todo.value += 1
        if place >= len(peptides) * len(_SWEEPS):
            return
        peptide, share = peptides[place % len(peptides)], _SWEEPS[place // len(peptides)]
        try:
            simulate_peptide(Path(folder) / peptide.name, peptide, share, deadline)
        except SimulationError as error:
            print(f"{peptide.name}: {error}", file=sys.stderr, flush=True)  # noqa: T201


def account(folder: Path) -> dict[str, Any]:
    """Return what is there: runs and simulated ns of each molecule, and in all."""
    rows = {}
    for peptide in training_peptides():
        done = sorted((folder / peptide.name).glob("run_*.h5"))
        if done:
            rows[peptide.name] = {"runs": len(done), "of": peptide.n_starts, "ns": len(done) * peptide.time_ps * 1e-3}
    return {"molecules": rows, "ns": sum(row["ns"] for row in rows.values())}


def check(folder: Path) -> list[str]:
    """Read every run and return what is wrong: files that cannot be opened, frames that are missing."""
    wrong = []
    for peptide in training_peptides():
        for path in sorted((folder / peptide.name).glob("run_*.h5")):
            with open_trajectory(path) as reader:
                if reader.n_frames != round(peptide.time_ps):
                    wrong.append(f"{path}: {reader.n_frames} frames")
    return wrong


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budget", default="3h", help="wall time after which no further run is begun")
    parser.add_argument("--workers", type=int, default=available_cores())
    parser.add_argument("--account", action="store_true", help="say what is there and check it; simulate nothing")
    chosen = parser.parse_args(arguments)
    if chosen.account:
        print(json.dumps({**account(chosen.folder), "wrong": check(chosen.folder)}, indent=1))  # noqa: T201
        return
    os.nice(10)
    deadline = time.time() + parse_wall_s(chosen.budget, "--budget")
    context = multiprocessing.get_context("spawn")
    todo = context.Value("i", 0)
    workers = [context.Process(target=_work, args=(str(chosen.folder), todo, deadline)) for _ in range(chosen.workers)]
    for worker in workers:
        worker.start()
    try:
        for worker in workers:
            worker.join()
    finally:
        for worker in workers:
            worker.terminate()
    print(json.dumps(account(chosen.folder)["ns"]))  # noqa: T201


if __name__ == "__main__":
    main()
