"""Pure TIP3P water by SIMD replicas and by OpenMM, the same System: structure, diffusion, permittivity.

    python docs/studies/water/properties.py [--time 200ps] [--openmm-time 1ns] [-o TABLE]

NVT at 300 K, 4 fs, 1/ps, 20 ps left out. g(r) of oxygens: position and height of the first maximum, height of the first
minimum. Diffusion: slope of the mean square displacement from 2 to 10 ps (in a bath of 1/ps, so lower than in NVE; no
correction for the cell). Permittivity: 1 + (<M^2> - <M>^2) / (3 eps0 V kT) (Neumann, Mol. Phys. 50, 841 (1983)).
Density: OpenMM in NPT. Errors are those of the mean of replicas, for OpenMM of five blocks.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.solvation import solvate
from md_reference.forces.spec import ForceFieldSpec, WaterBox
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from md_reference.run.machine import machine_name
from md_reference.simd.force_field import SimdReplicas
from systems.library.named_scenes import prepare
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K, parse_time_ps

SPEC = ForceFieldSpec("ff14SB", "tip3p")
STEP_PS, SAVE_PS, WARM_PS = 0.004, 0.4, 20.0
BINS = np.linspace(0.2, 0.9, 141)
# e^2 / (eps0 nm kT) at 300 K, over 3.
PERMITTIVITY = 4 * np.pi * 138.93545764438198 / (GAS_CONSTANT_KJ_MOL_K * 300.0) / 3


def first_shell(oxygens: FloatArray, edge: float) -> list[float]:
    """Return r (nm) and height of the first maximum of g(r), and the height of the minimum behind it."""
    n = oxygens.shape[1]
    upper = np.triu_indices(n, 1)
    counts = np.zeros(len(BINS) - 1)
    for frame in oxygens[::5]:
        d = (frame[:, None] - frame)[upper]
        d -= edge * np.round(d / edge)
        counts += np.histogram(np.linalg.norm(d, axis=1), BINS)[0]
    shells = 4 / 3 * np.pi * (BINS[1:] ** 3 - BINS[:-1] ** 3)
    g = counts / len(oxygens[::5]) / (n * (n - 1) / 2 * shells / edge**3)
    middles = 0.5 * (BINS[1:] + BINS[:-1])
    top = int(g.argmax())
    fit = np.polyfit(middles[top - 2 : top + 3], g[top - 2 : top + 3], 2)
    at = -fit[1] / (2 * fit[0])
    behind = (middles > at) & (middles < 0.42)
    return [float(at), float(np.polyval(fit, at)), float(g[behind].min())]


def diffusion(oxygens: FloatArray) -> float:
    """Return the self-diffusion coefficient in 1e-5 cm^2/s, frames `SAVE_PS` apart."""
    lags = np.arange(round(2 / SAVE_PS), round(10 / SAVE_PS) + 1, 2)
    square = [((oxygens[k:] - oxygens[:-k]) ** 2).sum(-1).mean() for k in lags]
    return float(np.polyfit(lags * SAVE_PS, square, 1)[0] / 6 * 1e3)


def measures(frames: FloatArray, edge: float) -> list[float]:
    """Return the first shell and the diffusion of one run `(n_frames, n_atoms, 3)`."""
    oxygens = frames[:, ::3] - frames[:, ::3].mean(axis=1, keepdims=True)
    return [*first_shell(oxygens, edge), diffusion(oxygens)]


def permittivity(dipoles: Sequence[FloatArray], edge: float) -> tuple[float, float]:
    """Return the permittivity of all runs and its error by leaving out one after the other."""

    def of(runs: Sequence[FloatArray]) -> float:
        moments = np.concatenate(list(runs))
        return 1 + PERMITTIVITY * float((moments**2).sum(1).mean() - (moments.mean(0) ** 2).sum()) / edge**3

    without = [of([*dipoles[:k], *dipoles[k + 1 :]]) for k in range(len(dipoles))]
    return of(dipoles), float(np.sqrt((len(dipoles) - 1) * np.var(without)))


def row(name: str, runs: Sequence[FloatArray], charges: FloatArray, edge: float) -> list[str]:
    found = np.array([measures(run, edge) for run in runs])
    error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    eps = permittivity([np.einsum("fad,a->fd", run, charges) for run in runs], edge)
    values = [*zip(found.mean(axis=0), error, strict=True), eps]
    return [name, *(f"{value:.4g} ± {off:.2g}" for value, off in values)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--time", default="200ps")
    parser.add_argument("--openmm-time", default="1ns")
    parser.add_argument("-o", "--out", type=Path)
    args = parser.parse_args()
    scene = solvate(prepare("smiles:O"), SPEC, WaterBox())
    system = build_system(scene, SPEC)
    edge = float(np.asarray(scene.cell_nm)[0, 0])
    nonbonded = next(f for f in system.getForces() if type(f).__name__ == "NonbondedForce")
    charges = np.array([nonbonded.getParticleParameters(k)[0]._value for k in range(scene.n_atoms)])
    every = round(SAVE_PS / STEP_PS)
    with Engine(scene, Conditions(force=SPEC, platform="CPU", seed=1), system=system, threads=1) as engine:
        engine.minimise(max_iterations=300)
        start = engine.positions()
        run = SimdReplicas(system, temperature_k=300.0, friction_per_ps=1.0, timestep_ps=STEP_PS, seed=1)
        run.set_positions(np.repeat(start[None], run.n_replicas, axis=0))
        run.thermalise()
        run.step(round(WARM_PS / STEP_PS))
        frames = []
        for _ in range(round(parse_time_ps(args.time) / SAVE_PS)):
            run.step(every)
            frames.append(run.positions_nm.astype(np.float32))
        rows = [row("SIMD replicas", list(np.stack(frames, axis=1)), charges, edge)]
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
        engine.thermalise()
        engine.step(round(WARM_PS / STEP_PS))
        single = []
        for _ in range(round(parse_time_ps(args.openmm_time) / SAVE_PS)):
            engine.step(every)
            single.append(engine.positions().astype(np.float32))
        rows.append(row("OpenMM CPU", np.array_split(np.array(single), 5), charges, edge))
    sys.stdout.write(" | ".join(rows[-1]) + "\n")
    if args.out:
        table = {
            "command": f"python docs/studies/water/properties.py --time {args.time} --openmm-time {args.openmm_time}",
            "machine": machine_name(),
            "note": f"{scene.n_atoms // 3} waters, edge {edge:.3f} nm, 300 K.",
            "columns": ["", "g(r) of oxygens: first maximum, nm", "its height", "minimum behind it",
                        "diffusion, 1e-5 cm²/s", "permittivity"],
            "rows": rows,
        }  # fmt: skip
        args.out.write_text(json.dumps(table, ensure_ascii=False, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
