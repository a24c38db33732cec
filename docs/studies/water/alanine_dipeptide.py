"""Alanine dipeptide in TIP3P water: the same System by OpenMM's CPU platform and by SIMD replicas.

    python docs/studies/water/alanine_dipeptide.py scene FOLDER             # solvated, at the mean volume of 1 bar
    python docs/studies/water/alanine_dipeptide.py openmm FOLDER --time 20ns --replicas 3
    python docs/studies/water/alanine_dipeptide.py simd FOLDER --time 60ns
    python docs/studies/water/alanine_dipeptide.py simd FOLDER --time 60ns --padding 3.3nm    # twice the cell's width

A run that was stopped goes on. `surromd compare` compares what they leave.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions, MDConfig
from md_reference.run.engine import Engine
from md_reference.run.replicas import simulate_batch
from md_reference.run.simulate import simulate
from md_reference.simd.force_field import n_replicas
from systems.library.named_scenes import prepare
from systems.scene import Scene
from systems.units import parse_time_ps, quantity

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
            assert state.cell_nm is not None
            volumes.append(float(np.linalg.det(state.cell_nm)))
    scale = (float(np.mean(volumes[round(DISCARDED * len(volumes)) :])) / volumes[-1]) ** (1 / 3)
    return replace(scene, positions_nm=state.positions_nm * scale, cell_nm=state.cell_nm * scale)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("scene", "openmm", "simd"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--time", default="20ns")
    parser.add_argument("--replicas", type=int, default=0, help="0: 3 by OpenMM, a batch by SIMD")
    parser.add_argument("--padding", help="distance between images, in a cell of its own at the volume of 1 bar")
    args = parser.parse_args()
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
        outs = [args.folder / f"simd_r{k}.h5" for k in range(args.replicas or n_replicas())]
        simulate_batch(scene, config, outs, resume=any(out.exists() for out in outs))
        return
    for k in range(args.replicas or 3):
        out = args.folder / f"openmm_r{k}.h5"
        settings = replace(config, platform="CPU", keep="all", seed=k)
        simulate(scene, settings, out, resume=out.exists())


if __name__ == "__main__":
    main()
