"""How well a potential keeps its energy without a bath: fluctuation at several steps, and drift.

    python docs/studies/quantum/energy_conservation.py WEIGHTS... [--steps 0.25fs,0.5fs,1fs] [--time 50ps]
        [-o docs/results/tables/energy_conservation.json]

Sixteen replicas at 300 K, natural hydrogens, flexible bonds, velocity Verlet as `--ensemble nve` has it. From the same
states each step runs for a fiftieth of `--time`: the standard deviation of the total energy goes with the square of the
step where forces are an energy's gradient (slope 2). The middle one runs for all of `--time`: the slope of total energy
against time is its drift, with the standard error over replicas.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from md_reference.run.machine import machine_name
from surrogate.models.architecture import weights_path
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K, parse_time_ps

REPLICAS, TEMPERATURE_K, DISCARDED_PS, SHORT = 16, 300.0, 2.0, 50
# Between energies of short runs, and of the long one.
OFTEN_PS, SELDOM_PS = 0.005, 0.1


class Run:
    """A molecule of a potential, moved without a bath."""

    def __init__(self, model: PainetPotential, scene_nm: FloatArray, molecule: Molecule) -> None:
        self.model, self.molecule = model, molecule
        self.masses = model.masses_da(molecule)[:, None]
        self.thermal = (GAS_CONSTANT_KJ_MOL_K * TEMPERATURE_K / self.masses).sqrt()
        self.generator = torch.Generator().manual_seed(0)
        x = torch.tensor(scene_nm).repeat(REPLICAS, 1, 1)
        draw = torch.randn(*x.shape[:2], round(DISCARDED_PS / 0.0005), 3, generator=self.generator, dtype=x.dtype)
        v = self.thermal * torch.randn(x.shape, generator=self.generator, dtype=x.dtype)
        self.start = model.langevin(x, v, molecule, self.masses, self.thermal, draw, timestep_ps=0.0005)

    def energies(self, timestep_ps: float, time_ps: float, every_ps: float) -> FloatArray:
        """Return total energies `(n, replicas)` in kJ/mol, `every_ps` apart, from the same states each time."""
        self.model.config = replace(self.model.config, timestep_ps=timestep_ps, ensemble="nve")
        x, v = self.start
        steps = round(every_ps / timestep_ps)
        still = torch.zeros(REPLICAS, x.shape[1], steps, 3)
        found = []
        for _ in range(round(time_ps / every_ps)):
            found.append(self._total(x, v))
            x, v = self.model.verlet(x, v, self.molecule, self.masses, self.thermal, still)
        return np.stack(found)

    def _total(self, x: Tensor, v: Tensor) -> FloatArray:
        potential = self.model.evaluate(x, self.molecule).energy_kj_mol
        total: FloatArray = (potential + 0.5 * (self.masses * v.square()).sum((1, 2))).numpy()
        return total


def slope(steps: list[float], widths: list[float]) -> float:
    """Return the power of the step that widths grow with."""
    return float(np.polyfit(np.log(steps), np.log(widths), 1)[0])


def row(name: str, steps: list[float], time_ps: float) -> list[str]:
    """Return a line of the table."""
    weights = load_weights(weights_path(name))
    scene, model = weights.domain.scene, weights.model
    assert isinstance(model, PainetPotential)
    model.config = replace(model.config, timestep_ps=steps[0], hydrogen_mass_da=None)
    run = Run(model.eval().requires_grad_(False), scene.positions_nm, Molecule.of(scene))
    widths = [float(run.energies(step, time_ps / SHORT, OFTEN_PS).std(0).mean()) for step in steps]
    long = run.energies(steps[len(steps) // 2], time_ps, SELDOM_PS)
    drifts = np.polyfit(SELDOM_PS * np.arange(len(long)), long / scene.n_atoms, 1)[0]
    return [
        f"{Path(name).stem}, {scene.n_atoms} atoms",
        ", ".join(f"{width:.2g}" for width in widths),
        f"{slope(steps, widths):.2f}",
        f"{drifts.mean():.5f} ± {drifts.std(ddof=1) / len(drifts) ** 0.5:.5f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", nargs="+")
    parser.add_argument("--steps", default="0.25fs,0.5fs,1fs")
    parser.add_argument("--time", default="50ps")
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    steps, time_ps = [parse_time_ps(text) for text in given.steps.split(",")], parse_time_ps(given.time)
    rows = []
    for name in given.weights:
        rows.append(row(name, steps, time_ps))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": f"python docs/studies/quantum/energy_conservation.py WEIGHTS --time {given.time}",
            "machine": machine_name(),
            "note": f"{REPLICAS} replicas at 300 K without a bath; drift over {given.time}.",
            "columns": ["weights", f"standard deviation of the total energy at {given.steps}, kJ/mol", "slope",
                        "drift at the middle step, kJ/mol/ps per atom"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
