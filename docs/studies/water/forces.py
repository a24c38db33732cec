"""Energies and forces of SIMD replicas in water against OpenMM, for twenty systems.

    python docs/studies/water/forces.py [-o docs/results/tables/water_forces.json]

Frames are of the replicas' own run, after 4 ps at 300 K. The other side is OpenMM's Reference platform, in double
precision; in slanted cells its CPU platform, since Reference leaves out pairs there (OpenMM 8.6.1). OpenMM's own single
precision, CPU against Reference, stands beside. The grid of reciprocal space has points of small factors, as the CPU
platform's; where that is not Reference's, forces and energies differ by what the grid leaves.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import openmm

from md_reference.forces.forcefield import build_system, resolve
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.simd.force_field import SimdReplicas
from systems.library.named_scenes import prepare
from systems.scene import FloatArray

PEPTIDES = (
    *("ACE-ALA-NME", "ACE-GLY-NME", "ACE-VAL-NME", "ACE-SER-NME", "ACE-PHE-NME", "ACE-TRP-NME", "ACE-LEU-SER-NME"),
    *("ACE-ALA-PRO-NME", "ACE-LYS-GLU-NME", "ACE-CYS-HIS-NME", "ALA-VAL", "GLY-TYR", "LYS-GLU", "ALA-SER-VAL"),
)
CASES = (
    *((f"sequence:{name}", "auto", 0.0) for name in PEPTIDES),
    ("sequence:ACE-ALA-NME", "ff99SB-ILDN", 0.0),
    ("sequence:ACE-ASP-NME", "auto", 0.15),
    ("sequence:ACE-LYS-NME", "auto", 0.15),
    ("smiles:CC(=O)Oc1ccccc1C(=O)O", "auto", 0.0),
    ("smiles:CC(=O)Nc1ccc(O)cc1", "auto", 0.0),
    ("smiles:OCCO", "auto", 0.0),
)
FRAMES = 3


def by_openmm(system: Any, frames: FloatArray, platform: str) -> tuple[FloatArray, FloatArray]:
    context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatform(platform))
    found = []
    for frame in frames:
        context.setPositions(frame.astype(np.float32))
        state = context.getState(energy=True, forces=True)
        found.append((state.getPotentialEnergy()._value, state.getForces(asNumpy=True)._value))
    energies, forces = zip(*found, strict=True)
    return np.array(energies), np.array(forces)


def relative(a: FloatArray, b: FloatArray) -> float:
    return float(np.sqrt(((a - b) ** 2).mean() / (b**2).mean()))


def measure(name: str, force_field: str, molar: float) -> dict[str, Any]:
    dry = prepare(name)
    spec = resolve(dry, ForceFieldSpec(force_field, "tip3p"))
    scene = solvate(dry, spec, WaterBox(ionic_strength_molar=molar), seed=5)
    system = build_system(scene, spec)
    with Engine(scene, Conditions(force=spec, platform="CPU"), system=system, threads=1) as engine:
        engine.minimise(max_iterations=200)
        start = engine.positions()
    run = SimdReplicas(system, temperature_k=300.0, friction_per_ps=5.0, timestep_ps=0.002, seed=1)
    run.set_positions(np.repeat(start[None], run.n_replicas, axis=0))
    run.thermalise()
    run.step(2000)
    frames = run.positions_nm
    energies, forces = run.energies_and_forces(frames)
    is_slanted = bool(np.abs(np.asarray(scene.cell_nm) - np.diag(np.diag(scene.cell_nm))).max() > 0)
    exact = by_openmm(system, frames[:FRAMES], "CPU" if is_slanted else "Reference")
    single = by_openmm(system, frames[:FRAMES], "CPU")
    solute = ~run.is_water
    return {
        "system": scene.name,
        "atoms": scene.n_atoms,
        "cell": "slanted" if is_slanted else "cube",
        "forces": relative(forces[:FRAMES], exact[1]),
        "solute": relative(forces[:FRAMES, solute], exact[1][:, solute]),
        "cpu": None if is_slanted else relative(single[1], exact[1]),
        # A constant is the grid's, whose points are those of this platform; energies matter by their differences.
        "energy": float(np.abs(energies[:FRAMES] - exact[0]).max()),
        "spread": float(energies.std()),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--out", type=Path)
    out = parser.parse_args().out
    rows = []
    for case in CASES:
        found = measure(*case)
        rows.append([
            f"{found['system']}{' (ff99SB-ILDN)' if case[1] != 'auto' else ''}{' 0.15 M' if case[2] else ''}",
            f"{found['atoms']:,}", found["cell"], f"{found['forces']:.1e}", f"{found['solute']:.1e}",
            "" if found["cpu"] is None else f"{found['cpu']:.1e}", f"{found['energy']:.1e}",
            f"{found['energy'] / found['spread']:.1e}",
        ])  # fmt: skip
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if out:
        table = {
            "command": "python docs/studies/water/forces.py",
            "machine": machine_name(),
            "note": f"{FRAMES} frames each; forces: root mean square of the difference over that of the force.",
            "columns": ["system", "atoms", "cell", "forces", "of the solute", "OpenMM CPU's", "energy, kJ/mol",
                        "over its spread"],
            "rows": rows,
        }  # fmt: skip
        out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
