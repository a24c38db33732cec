"""Alanine dipeptide in TIP3P water: the same System by OpenMM's CPU platform and by SIMD replicas.

    python docs/studies/water/alanine_dipeptide.py scene FOLDER      # solvated, at the mean volume of 1 bar
    python docs/studies/water/alanine_dipeptide.py openmm FOLDER --replicas 4 --time 20ns
    python docs/studies/water/alanine_dipeptide.py simd FOLDER --time 60ns

A run that was stopped goes on. `surromd compare FOLDER/openmm_r*.h5 FOLDER/simd_r*.h5 -o report.html` compares them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions, MDConfig
from md_reference.run.engine import Engine
from md_reference.run.simulate import simulate
from systems.scene import Scene
from systems.source import prepare
from systems.units import parse_time_ps

SPEC = ForceFieldSpec("ff14SB", "tip3p")
VOLUME_PS, DISCARDED = 500.0, 0.2


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
            volumes.append(float(np.linalg.det(state.cell_nm)))
    mean = float(np.mean(volumes[round(DISCARDED * len(volumes)) :]))
    print(f"{scene.n_atoms} atoms, volume {volumes[0]:.3f} -> {mean:.3f} nm^3")
    from dataclasses import replace

    scale = (mean / volumes[-1]) ** (1 / 3)
    return replace(scene, positions_nm=state.positions_nm * scale, cell_nm=state.cell_nm * scale)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("scene", "openmm"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--time", default="20ns")
    parser.add_argument("--replicas", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    path = args.folder / "scene.json"
    if args.what == "scene":
        dry = prepare("alanine-dipeptide")
        wet = at_one_bar(solvate(dry, SPEC, WaterBox()), seed=1)
        path.write_text(json.dumps(wet.to_dict()))
        return
    scene = Scene.from_dict(json.loads(path.read_text()))
    for k in range(args.first, args.first + args.replicas):
        out = args.folder / f"openmm_r{k}.h5"
        config = MDConfig(force=SPEC, time_ps=parse_time_ps(args.time), save_every_ps=1.0, platform="CPU", seed=k)
        simulate(scene, config, out, resume=True)


if __name__ == "__main__":
    main()
