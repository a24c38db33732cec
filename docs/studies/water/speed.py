"""SIMD replicas in TIP3P water against one thread of OpenMM's CPU platform: processor time of a step, and of its parts.

    python docs/studies/water/speed.py [-o docs/results/tables/water_speed.json]

Alanine dipeptide in cells of 985 to 3,000 atoms, PME, 0.9 nm, 4 fs. Both are timed by turns in each round; nothing else
should run. Replicas are equilibrated apart first, so that they see different pairs of waters.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.simd import force_field
from md_reference.simd.force_field import SimdReplicas, aligned
from systems.library.named_scenes import prepare

SPEC = ForceFieldSpec("ff14SB", "tip3p")
PADDINGS_NM = (1.0, 1.5, 2.0, 2.2, 2.5)
PARTS = ("pair list", "water and water", "solute and water", "within the solute", "charges to the grid", "transforms",
         "forces from the grid")  # fmt: skip
STEPS, ROUNDS, APART_STEPS = 50, 7, 5000


def seconds(call: Callable[[int], Any], n: int) -> float:
    began = time.process_time()
    call(n)
    return (time.process_time() - began) / n


def parts_of(run: SimdReplicas) -> tuple[dict[str, float], int]:
    """Return the seconds of each part of a step of all replicas, least of five, and the pairs of waters in the list."""
    part = force_field._program().part
    part.restype, part.argtypes = (
        ctypes.c_int64,
        [ctypes.c_void_p, ctypes.c_int32, *[ctypes.c_void_p] * 2, ctypes.c_int64],
    )
    forces = aligned(run._positions.shape)

    def call(which: int, n: int) -> int:
        return int(part(ctypes.byref(run._system), which, run._positions.ctypes.data, forces.ctypes.data, n))

    listed = call(0, 1)
    return {name: min(seconds(lambda n, k=k: call(k, n), 20) for _ in range(5)) for k, name in enumerate(PARTS)}, listed


def measure(padding_nm: float) -> dict[str, Any]:
    scene = solvate(prepare("alanine-dipeptide"), SPEC, WaterBox(padding_nm=padding_nm))
    system = build_system(scene, SPEC)
    with Engine(scene, Conditions(force=SPEC, platform="CPU"), system=system, threads=1) as engine:
        engine.minimise(max_iterations=200)
        start = engine.positions()
    run = SimdReplicas(system, temperature_k=300.0, friction_per_ps=1.0, timestep_ps=0.004, seed=1)
    run.check(system, start)
    run.set_positions(np.repeat(start[None], run.n_replicas, axis=0))
    run.thermalise()
    run.step(APART_STEPS)
    integrator = openmm.LangevinMiddleIntegrator(300.0, 1.0, 0.004)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("CPU"), {"Threads": "1"})
    context.setPositions(run.positions_nm[0])
    context.setVelocitiesToTemperature(300.0, 1)
    integrator.step(100)
    rounds = [(seconds(integrator.step, STEPS), seconds(run.step, STEPS) / run.n_replicas) for _ in range(ROUNDS)]
    theirs, ours = np.array(rounds).T
    parts, listed = parts_of(run)
    return {
        "n_atoms": scene.n_atoms,
        "openmm_ms": 1e3 * float(np.median(theirs)),
        "simd_ms": 1e3 * float(np.median(ours)),
        "ratio": [float(f(theirs / ours)) for f in (np.median, np.min, np.max)],
        "parts_ms": {name: 1e3 * cost for name, cost in parts.items()},
        "listed": listed / (system.getNumConstraints() // 3 * (system.getNumConstraints() // 3 - 1) / 2),
        "replicas": run.n_replicas,
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--out", type=Path)
    out = parser.parse_args().out
    rows, parts = [], []
    for padding_nm in PADDINGS_NM:
        found = measure(padding_nm)
        middle, least, most = found["ratio"]
        ns_a_day = 0.004e-3 * 86400e3 / found["simd_ms"]
        rows.append([f"{found['n_atoms']:,}", f"{found['openmm_ms']:.3g}", f"{found['simd_ms']:.3g}",
                     f"{middle:.1f} [{least:.1f}, {most:.1f}]", f"{ns_a_day:.3g}"])  # fmt: skip
        rest = found["simd_ms"] * found["replicas"] - sum(found["parts_ms"].values())
        # The list is made every twenty steps.
        rest += 0.95 * found["parts_ms"]["pair list"]
        parts.append([f"{found['n_atoms']:,}", f"{100 * found['listed']:.0f} %",
                      *(f"{cost:.2g}" for cost in found["parts_ms"].values()), f"{rest:.2g}"])  # fmt: skip
        sys.stdout.write(" | ".join(rows[-1]) + "\n" + " | ".join(parts[-1]) + "\n")
        sys.stdout.flush()
    if out:
        table = {
            "command": "python docs/studies/water/speed.py",
            "machine": machine_name(),
            "note": f"Processor time of one core, medians of {ROUNDS} rounds, least and greatest ratio in brackets.",
            "columns": ["atoms", "OpenMM CPU, one thread, ms a step", "SIMD, ms a step of a replica", "ratio",
                        "SIMD, ns a day and core"],
            "rows": rows,
        }  # fmt: skip
        out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")
        costs = table | {
            "note": f"A step of {force_field.n_replicas()} replicas, ms of one core. The list is made every 20 steps.",
            "columns": ["atoms", "pairs of waters listed", *PARTS, "bath, SETTLE and the rest"],
            "rows": parts,
        }
        out.with_name(out.stem + "_parts.json").write_text(
            json.dumps(costs, ensure_ascii=False, indent=1) + "\n", "utf-8"
        )


if __name__ == "__main__":
    main()
