"""Energy without a bath and temperature with one, of alanine dipeptide in TIP3P: SIMD replicas beside OpenMM.

    python docs/studies/water/conservation.py [-o docs/results/tables/water_conservation.json]

NVE: 2 fs, 100 ps, after 20 ps in a bath; OpenMM's leapfrog on its CPU platform from the states of some replicas. Drift
is the slope of the total energy, its error the standard error over replicas. NVT: 4 fs, 1/ps, 40 ps after 20.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import openmm

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.simd.force_field import SimdReplicas
from systems.library.named_scenes import prepare
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K

SPEC = ForceFieldSpec("ff14SB", "tip3p")
STEP_PS, NVE_PS, EVERY, OPENMM_RUNS = 0.002, 100.0, 500, 3
BATH_STEP_PS, WARM_PS, NVT_PS = 0.004, 20.0, 40.0


def slopes(times_ps: FloatArray, energies: FloatArray) -> FloatArray:
    """Return the slope in kJ/mol/ns of each column."""
    return np.polyfit(times_ps * 1e-3, energies, 1)[0]


def openmm_energies(system: openmm.System, positions_nm: FloatArray, velocities_nm_ps: FloatArray) -> list[float]:
    """Return total energies, kJ/mol, along a run of OpenMM's CPU platform without a bath."""
    integrator = openmm.VerletIntegrator(STEP_PS)
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("CPU"), {"Threads": "1"})
    context.setPositions(positions_nm)
    context.setVelocities(velocities_nm_ps)
    energies = []
    for _ in range(round(NVE_PS / STEP_PS / EVERY)):
        state = context.getState(energy=True)
        energies.append(state.getPotentialEnergy()._value + state.getKineticEnergy()._value)
        integrator.step(EVERY)
    return energies


def mean_and_error(values: FloatArray) -> str:
    """Return the mean of independent values with its standard error."""
    return f"{values.mean():.1f} ± {values.std(ddof=1) / np.sqrt(len(values)):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--out", type=Path)
    out = parser.parse_args().out
    scene = solvate(prepare("alanine-dipeptide"), SPEC, WaterBox())
    system = build_system(scene, SPEC)
    with Engine(scene, Conditions(force=SPEC, platform="CPU"), system=system, threads=1) as engine:
        engine.minimise(max_iterations=300)
        start = engine.positions()

    def replicas(step_ps: float, friction_per_ps: float) -> SimdReplicas:
        return SimdReplicas(system, temperature_k=300.0, friction_per_ps=friction_per_ps, timestep_ps=step_ps, seed=1)

    warm = replicas(BATH_STEP_PS, 1.0)
    warm.set_positions(np.repeat(start[None], warm.n_replicas, axis=0))
    warm.thermalise()
    warm.step(round(WARM_PS / BATH_STEP_PS))
    kelvin = []
    for _ in range(round(NVT_PS / 0.5)):
        warm.step(round(0.5 / BATH_STEP_PS))
        kelvin.append(np.stack(warm.temperatures_of_solute_and_water_k()))
    by_replica = np.mean(kelvin, axis=0)
    # Energies at the longer step belong to another Hamiltonian: it takes some ps to leave that behind.
    short = replicas(STEP_PS, 1.0)
    short.set_positions(warm.positions_nm)
    short.set_velocities(warm.velocities_nm_ps)
    short.step(round(WARM_PS / STEP_PS))
    x, v = short.positions_nm, short.velocities_nm_ps
    free = replicas(STEP_PS, 0.0)
    free.set_positions(x)
    free.set_velocities(v)
    ours = []
    half_kt = 0.5 * free.n_dof * GAS_CONSTANT_KJ_MOL_K
    for _ in range(round(NVE_PS / STEP_PS / EVERY)):
        # Velocities of a leapfrog lie half a step before positions.
        before, potential = free.temperatures_k(), free.energies()
        free.step(1)
        ours.append(potential + half_kt * 0.5 * (before + free.temperatures_k()))
        free.step(EVERY - 1)
    theirs = [openmm_energies(system, x[k], v[k]) for k in range(OPENMM_RUNS)]
    times = np.arange(len(ours)) * EVERY * STEP_PS
    rows = []
    for name, energies in (("SIMD replicas", np.array(ours)), ("OpenMM CPU", np.array(theirs).T)):
        drift = slopes(times, energies)
        scatter = (energies - energies.mean(0)).std()
        per_dof = drift.mean() / (free.n_dof * GAS_CONSTANT_KJ_MOL_K * 300.0)
        rows.append([name, str(len(drift)), mean_and_error(drift), f"{per_dof:.1e}", f"{scatter:.2f}", "", ""])
    rows[0][-2:] = [mean_and_error(kelvins) for kelvins in by_replica]
    for row in rows:
        sys.stdout.write(" | ".join(row) + "\n")
    if out:
        table = {
            "command": "python docs/studies/water/conservation.py",
            "machine": machine_name(),
            "note": f"{scene.n_atoms} atoms; NVE {NVE_PS:g} ps at {STEP_PS * 1e3:g} fs; "
            f"temperatures of {NVT_PS:g} ps at {BATH_STEP_PS * 1e3:g} fs in a bath of 300 K.",
            "columns": ["", "runs", "drift, kJ/mol/ns", "drift, kT/ns of a degree of freedom", "scatter, kJ/mol",
                        "solute, K",
                        "water, K"],
            "rows": rows,
        }  # fmt: skip
        out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
