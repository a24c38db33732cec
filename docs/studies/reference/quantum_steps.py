"""Step sizes of MD by GFN2-xTB: what heavier hydrogens, rigid bonds and longer steps leave of temperature, bonds,
angles and torsions, and how far short pieces of a run scatter about its temperature.

    python docs/studies/reference/quantum_steps.py run OUT.npz --step 2fs --mass 3 --time 200ps [--rigid] [SMILES]
    python docs/studies/reference/quantum_steps.py table OUT.npz...

Error bars are of block means, the largest over several lengths of blocks.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import Conditions
from md_reference.run.engine import Engine
from systems.chemistry.geometry import torsion
from systems.chemistry.graph import bonded_graph, rotatable_torsions
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene
from systems.units import parse_time_ps

SAVE_PS = 0.02
DISCARDED_PS = 3.0
PIECE_PS = 5.0
# Blocks of a run of which means are compared.
BLOCKS = (5, 8, 10, 16)
FRAMES_A_WRITE = 500


def run(out: Path, smiles: str, timestep_ps: float, mass_da: float | None, rigid: bool, time_ps: float, seed: int
        ) -> None:  # fmt: skip
    """Write frames `x` (n, n_atoms, 3) nm, temperatures `t` (n,) K and what they cost."""
    scene = scene_from_smiles(smiles)
    spec = ForceFieldSpec(QUANTUM, "vacuum", mass_da, constrain_hydrogens=rigid)
    conditions = Conditions(force=spec, timestep_ps=timestep_ps, seed=seed, platform="Reference")
    frames, temperatures = [], []
    with Engine(scene, conditions) as engine:
        engine.minimise(max_iterations=200)
        engine.thermalise()
        engine.step(round(DISCARDED_PS / timestep_ps))
        began = time.process_time()
        for k in range(1, round(time_ps / SAVE_PS) + 1):
            engine.step(round(SAVE_PS / timestep_ps))
            state = engine.state()
            frames.append(state.positions_nm)
            temperatures.append(state.temperature_k)
            if k % FRAMES_A_WRITE == 0:
                spent = time.process_time() - began
                np.savez(out, x=np.array(frames), t=np.array(temperatures), smiles=smiles, timestep_ps=timestep_ps,
                         mass_da=mass_da or 0.0, rigid=rigid, seconds_a_ps=spent / (k * SAVE_PS))  # fmt: skip


def with_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean of a series `(n,)` and its standard error."""
    errors = []
    for n in BLOCKS:
        means = values[: len(values) // n * n].reshape(n, -1).mean(1)
        errors.append(means.std(ddof=1) / np.sqrt(n))
    return float(values.mean()), float(max(errors))


def observables(scene: Scene, x: FloatArray) -> dict[str, FloatArray]:
    """Return series `(n,)`: mean length of the bonds to hydrogen and of the others (pm), their and the angles' mean
    square deviation, and for each rotatable bond the share of trans."""
    light = [(i, j) for i, j in scene.bonds.tolist() if "H" in (scene.elements[i], scene.elements[j])]
    heavy = [tuple(bond) for bond in scene.bonds.tolist() if tuple(bond) not in light]
    found = {}
    for name, bonds in (("X-H", light), ("heavy", heavy)):
        lengths = np.stack([np.linalg.norm(x[:, i] - x[:, j], axis=-1) for i, j in bonds], axis=1) * 1e3
        found[f"bonds {name}, pm"] = lengths.mean(1)
        found[f"bonds {name}, variance, pm²"] = np.square(lengths - lengths.mean(0)).mean(1)
    angles = []
    for at, neighbours in bonded_graph(scene).adjacency():
        ends = sorted(neighbours)
        for a in range(len(ends)):
            for b in range(a):
                u, v = x[:, ends[a]] - x[:, at], x[:, ends[b]] - x[:, at]
                cosine = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
                angles.append(np.degrees(np.arccos(cosine)))
    bent = np.stack(angles, axis=1)
    found["angles, variance, deg²"] = np.square(bent - bent.mean(0)).mean(1)
    quads = rotatable_torsions(scene, rotors=True)
    for quad, angle in zip(quads.tolist(), torsion(x, quads).T, strict=True):
        name = "-".join(f"{scene.elements[k]}{k}" for k in quad)
        found[f"{name} trans, %"] = 100.0 * (np.abs(np.degrees(angle)) > 120.0)
    return found


def table(paths: list[Path]) -> None:
    """Print a row for each run: each observable with its standard error, the temperature, and its scatter by pieces."""
    rows: list[dict[str, str]] = []
    for path in paths:
        data: Any = np.load(path)
        scene, x, t = scene_from_smiles(str(data["smiles"])), data["x"], data["t"]
        mass, rigid = float(data["mass_da"]), bool(data["rigid"])
        row = {"step": f"{1e3 * float(data['timestep_ps']):g} fs",
               "hydrogens": f"{mass:g} Da" * bool(mass) + "natural" * (not mass) + ", rigid" * rigid,
               "ps": f"{len(x) * SAVE_PS:.0f}", "s a ps": f"{float(data['seconds_a_ps']):.2f}"}  # fmt: skip
        for name, values in {"T, K": t, **observables(scene, x)}.items():
            mean, error = with_error(values)
            row[name] = f"{mean:.{1 if mean > 20 else 2}f} ± {error:.{1 if mean > 20 else 2}f}"
        n = round(PIECE_PS / SAVE_PS)
        pieces = t[: len(t) // n * n].reshape(-1, n).mean(1)
        row[f"T of {PIECE_PS:g} ps: sd, K"] = f"{pieces.std(ddof=1):.0f} (largest {pieces.max():.0f})"
        rows.append(row)
    for name in rows[0]:
        sys.stdout.write("| " + " | ".join([name, *(row[name] for row in rows)]) + " |\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(required=True, dest="verb")
    one = verbs.add_parser("run")
    one.add_argument("out", type=Path)
    one.add_argument("smiles", nargs="?", default="OCCO")
    one.add_argument("--step", required=True)
    one.add_argument("--mass", type=float)
    one.add_argument("--rigid", action="store_true")
    one.add_argument("--time", required=True)
    one.add_argument("--seed", type=int, default=0)
    verbs.add_parser("table").add_argument("runs", type=Path, nargs="+")
    given = parser.parse_args()
    if given.verb == "table":
        table(given.runs)
    else:
        run(given.out, given.smiles, parse_time_ps(given.step), given.mass, given.rigid, parse_time_ps(given.time),
            given.seed)  # fmt: skip


if __name__ == "__main__":
    main()
