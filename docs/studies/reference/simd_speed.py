"""Sixteen replicas by SIMD replicas against OpenMM on one core: processor time of a step, energies and forces.

    python docs/studies/reference/simd_speed.py [-o docs/results/tables/simd_speed.json]

Both are timed by turns in each round, OpenMM on the faster of its Reference and CPU platforms (one thread).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name, platform_properties
from md_reference.simd.force_field import SimdReplicas
from systems.library.named_scenes import prepare
from systems.scene import Scene

CASES = (
    ("ethanol", None),
    ("ACE-ALA-NME", "vacuum"),
    ("ACE-ALA-NME", "obc2"),
    ("ACE-TRP-ARG-NME", "obc2"),
    ("sequence:ALA-SER-VAL-LEU-GLY", "obc2"),
    ("chignolin", "obc2"),
)
TIMESTEP_PS, KELVIN = 0.004, 300.0
BATCH_S, ROUNDS = 0.3, 7


def timed(step: Any, n: int) -> float:
    began = time.process_time()
    step(n)
    return (time.process_time() - began) / n


def steps_for(step: Any) -> int:
    """Return how many steps take about BATCH_S of wall time, found by doubling."""
    n = 8
    while True:
        began = time.perf_counter()
        step(n)
        if time.perf_counter() - began > BATCH_S / 2:
            return n
        n *= 2


def measure(scene: Scene, spec: ForceFieldSpec) -> dict[str, Any]:
    """Return µs a step of a replica by OpenMM and by SIMD, their ratio with its range, and what they differ by."""
    system = build_system(scene, spec)
    with Engine(scene, Conditions(force=spec, platform="Reference"), system=system) as engine:
        engine.minimise()
        start = engine.positions()
    contexts = {}
    for name in ("Reference", "CPU"):
        integrator = openmm.LangevinMiddleIntegrator(KELVIN, 1.0, TIMESTEP_PS)
        contexts[name] = openmm.Context(
            system, integrator, openmm.Platform.getPlatform(name), platform_properties(name, 1)
        )
        contexts[name].setPositions(start)
        contexts[name].setVelocitiesToTemperature(KELVIN, 1)
    run = SimdReplicas(system, temperature_k=KELVIN, friction_per_ps=1.0, timestep_ps=TIMESTEP_PS, seed=1)
    run.check(system, start)
    run.set_positions(np.repeat(start[None], run.n_replicas, axis=0))
    run.thermalise()
    ways = {name: context.getIntegrator().step for name, context in contexts.items()} | {"simd": run.step}
    many = {name: steps_for(step) for name, step in ways.items()}
    rounds = [{name: timed(step, many[name]) * 1e6 for name, step in ways.items()} for _ in range(ROUNDS)]
    openmm_us = np.array([min(r["Reference"], r["CPU"]) for r in rounds])
    simd_us = np.array([r["simd"] / run.n_replicas for r in rounds])
    ratio = openmm_us / simd_us
    energies, forces = run.energies_and_forces(run.positions_nm)
    contexts["Reference"].setPositions(run.positions_nm[0].astype(np.float32))
    state = contexts["Reference"].getState(energy=True, forces=True)
    exact = state.getForces(asNumpy=True)._value
    return {
        "n_atoms": scene.n_atoms,
        "openmm_us": float(np.median(openmm_us)),
        "simd_us": float(np.median(simd_us)),
        "ratio": [float(f(ratio)) for f in (np.median, np.min, np.max)],
        "energy_off_kj_mol": abs(float(energies[0]) - float(state.getPotentialEnergy()._value)),
        "force_off": float(np.sqrt(np.mean((forces[0] - exact) ** 2) / np.mean(exact**2))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path)
    out = parser.parse_args().out
    rows = []
    for name, solvent in CASES:
        scene = prepare(name)
        spec = resolve(scene, ForceFieldSpec("auto", solvent or "auto"))
        found = measure(scene, spec)
        rows.append(
            [
                f"{found['n_atoms']} ({scene.name}, {spec.solvent})",
                f"{found['openmm_us']:.3g}",
                f"{found['simd_us']:.2g}",
                "{:.1f} [{:.1f}, {:.1f}]".format(*found["ratio"]),
                f"{found['energy_off_kj_mol']:.1e}",
                f"{found['force_off']:.1e}",
            ]
        )
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
    if out is not None:
        record = {
            "command": "python docs/studies/reference/simd_speed.py",
            "machine": machine_name(),
            "note": f"Processor time, medians of {ROUNDS} rounds, least and greatest ratio in brackets.",
            "columns": ["atoms", "OpenMM, µs a step", "SIMD, µs a step of a replica", "ratio", "energy, kJ/mol apart",
                        "forces, relative"],
            "rows": rows,
        }  # fmt: skip
        out.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
