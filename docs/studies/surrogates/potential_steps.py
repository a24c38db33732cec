"""What the time step of a potential's rollout changes: its cost, its mean energy, lengths and widths of heavy bonds.

    python docs/studies/surrogates/potential_steps.py paracetamol-gfn2-xtb [--steps 2fs,4fs] [--time 4ps]

32 replicas at each step one after the other, hydrogens of 3 Da, friction 5/ps, the first ps discarded; processor time
of one core, start and guards included. Above 2 fs bonds to hydrogen are rigid, which takes kT/2 each from the energy.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from surrogate.models.architecture import weights_path
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights, load_weights
from surrogate.sampling.runner import RolloutConfig, rollout
from systems.trajectory.codec import open_trajectory
from systems.units import parse_time_ps

REPLICAS, DISCARDED_PS = 32, 1.0


def line(weights: Weights, timestep_ps: float, time_ps: float, folder: Path) -> str:
    """Roll at one step and say what came of it."""
    scene, outs = weights.domain.scene, [folder / f"{timestep_ps:g}-{k}.h5" for k in range(REPLICAS)]
    config = RolloutConfig(time_ps=time_ps, seed=1, timestep_ps=timestep_ps, hydrogen_mass_da=3.0, friction_per_ps=5.0)
    began = time.process_time()
    rollout(scene, weights, outs, config)
    spent = time.process_time() - began
    runs = []
    for out in outs:
        with open_trajectory(out) as reader:
            runs.append(reader.read()[reader.time_ps > DISCARDED_PS].astype(np.float64))
    model, molecule = weights.model, Molecule.of(scene)
    energies = [float(model.evaluate(torch.tensor(x), molecule).energy_kj_mol.mean()) for x in runs]
    heavy = [pair for pair in scene.bonds.tolist() if "H" not in (scene.elements[pair[0]], scene.elements[pair[1]])]
    first, second = np.array(heavy).T
    lengths = np.linalg.norm(np.concatenate(runs)[:, first] - np.concatenate(runs)[:, second], axis=-1)
    error = np.std(energies, ddof=1) / REPLICAS**0.5
    return (
        f"{1e3 * timestep_ps:g} fs: {1e3 * spent / (REPLICAS * time_ps):.0f} s a ns, energy {np.mean(energies):.1f} "
        f"± {error:.1f} kJ/mol, heavy bonds {lengths.mean():.4f} nm, {1e3 * lengths.std(axis=0).mean():.2f} pm wide\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", help="a potential, by name or file")
    parser.add_argument("--steps", default="2fs,4fs")
    parser.add_argument("--time", default="4ps", help="of each replica")
    given = parser.parse_args()
    torch.set_num_threads(1)
    weights, time_ps = load_weights(weights_path(given.weights)), parse_time_ps(given.time)
    with tempfile.TemporaryDirectory() as folder:
        for step in given.steps.split(","):
            sys.stdout.write(line(weights, parse_time_ps(step), time_ps, Path(folder)))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
