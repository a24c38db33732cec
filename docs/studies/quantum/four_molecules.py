"""Potentials of four molecules at 500 K, reference GFN2-xTB, after 'Forces are not enough' (Fu et al., TMLR 2023).

    python docs/studies/quantum/four_molecules.py FOLDER [--molecules ethanol,uracil] [--budget 20min]
        [-o docs/results/tables/four_molecules.json]

For each molecule FOLDER/NAME gets two MD runs by GFN2-xTB (steps of 1 fs, natural hydrogens, 1/ps), weights learned in
`--budget` (they never see the MD), and 32 replicas of `--time` by these, integrated as the MD is. What is there is not
made again. Force error: mean absolute, of states of the MD. Stable: mean time until a bond is 0.5 Å from its mean in
the MD. h(r): interatomic distances in 500 bins up to 10 Å, integral of the absolute difference, from each MD run to the
rollout, beside that from one MD run to the other. Forces a second: processor time of one core.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch

import surrogate as sm
from md_reference.forces.quantum import Potential
from md_reference.run.machine import machine_name
from surrogate.models.painet.potential_trainer import Samples, samples_path
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.chemistry.validity import BOND_HALF_ANGSTROM, NOT_FINITE, check_frames, geometry_from_frames
from systems.errors import SimulationError
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory
from systems.units import format_time_ps, format_wall, parse_time_ps, parse_wall_s

MOLECULES = {"ethanol": "CCO", "malonaldehyde": "O=CC=CO", "uracil": "O=c1cc[nH]c(=O)[nH]1",
             "aspirin": "CC(=O)Oc1ccccc1C(=O)O"}  # fmt: skip
TEMPERATURE_K, TIMESTEP_PS, SAVE_PS = 500.0, 0.001, 0.1
REPLICAS, HELD_STATES, ROLL_SEED, MD_SEED = 32, 200, 5, 11
KJ_MOL_NM = 41.84  # of a kcal/mol/Å
EDGES_NM = np.linspace(0.0, 1.0, 501)


def frames_of(path: Path) -> FloatArray:
    """Return all frames `(n, n_atoms, 3)` nm of a trajectory."""
    with open_trajectory(path) as reader:
        return reader.read().astype(np.float64)


def distance_density(runs: list[FloatArray]) -> FloatArray:
    """Return h(r) `(500,)` in 1/Å of runs `(n, n_atoms, 3)` nm: the density of distances between any two atoms."""
    first, second = np.triu_indices(runs[0].shape[1], 1)
    counts = np.zeros(len(EDGES_NM) - 1)
    for part in (part for run in runs for part in np.array_split(run, max(1, len(run) // 500))):
        apart = np.linalg.norm(part[:, first] - part[:, second], axis=-1)
        counts += np.histogram(apart, EDGES_NM)[0]
    density: FloatArray = counts / counts.sum() / (10.0 * np.diff(EDGES_NM))
    return density


def density_error(one: FloatArray, other: FloatArray) -> float:
    """Return the integral of |h - h'| over r: 0 for equal densities, 2 for those that share no distance."""
    return float(np.abs(one - other).sum() * 10.0 * (EDGES_NM[1] - EDGES_NM[0]))


def until_lost(run: FloatArray, lost: FloatArray) -> FloatArray:
    """Return the frames before the first that is `lost` (n,)."""
    return run[: int(np.argmax(lost))] if lost.any() else run


def force_error(answer: FloatArray, ref: FloatArray) -> float:
    """Return the mean absolute difference of forces in kJ/mol/nm as kcal/mol/Å."""
    return float(np.abs(answer - ref).mean()) / KJ_MOL_NM


class ReferenceForces:
    """Two MD runs of a scene by GFN2-xTB, what it says of states of them, and what it costs."""

    def __init__(self, scene: Scene, folder: Path, md_ps: float) -> None:
        paths = sm.reference(
            scene, folder / "md.h5", time_ps=md_ps, save_every_ps=SAVE_PS, level="gfn2-xtb", replicas=2,
            temperature_k=TEMPERATURE_K, timestep_ps=TIMESTEP_PS, hydrogen_mass_da=None, equilibrate_ps=10.0,
            seed=MD_SEED, resume=True, quiet=True,
        )  # fmt: skip
        self.runs = [frames_of(path) for path in paths]
        self.densities = [distance_density([run]) for run in self.runs]
        together = np.concatenate(self.runs)
        self.geometry = geometry_from_frames(scene, together)
        self.states = together[np.linspace(0, len(together) - 1, HELD_STATES).astype(int)]
        potential = Potential(scene)
        began = time.process_time()
        self.forces = np.stack([potential(state)[1] for state in self.states])
        self.forces_a_s = HELD_STATES / (time.process_time() - began)

    @property
    def replicate(self) -> float:
        """How far one run's h(r) is from the other's."""
        return density_error(*self.densities)

    def compare(self, runs: list[FloatArray], save_ps: float) -> list[str]:
        """Return of replicas: how long they are stable, how many are lost, how far their h(r) is from each MD run's."""
        rule = NOT_FINITE | BOND_HALF_ANGSTROM
        kept = [until_lost(run, check_frames(run, self.geometry) & rule != 0) for run in runs]
        stable_ps = np.array([len(run) for run in kept]) * save_ps
        lost = sum(len(k) < len(run) for k, run in zip(kept, runs, strict=True))
        words = f"{stable_ps.mean():.0f} of {len(runs[0]) * save_ps:.0f} ps, {lost} of {len(runs)} lost"
        if not any(map(len, kept)):
            return [words, "no frames"]
        density = distance_density([run for run in kept if len(run)])
        far = [density_error(density, of_run) for of_run in self.densities]
        return [words, " and ".join(f"{value:.3f}" for value in far)]


def potential_row(name: str, folder: Path, budget_s: float, md_ps: float, time_ps: float) -> list[str]:
    """Make what a molecule lacks and return its line of the table."""
    scene = scene_from_smiles(MOLECULES[name])
    folder.mkdir(parents=True, exist_ok=True)
    ref = ReferenceForces(scene, folder, md_ps)
    file, spent_s = folder / "painet.safetensors", folder / "rollout_s"
    if not file.is_file():
        sm.train(f"smiles:{MOLECULES[name]}", file, arch="painet", level="gfn2-xtb", budget_s=budget_s, resume=True,
                 quiet=True)  # fmt: skip
    outs = [folder / f"roll_r{k}.h5" for k in range(REPLICAS)]
    if not spent_s.is_file():
        began = time.process_time()
        with suppress(SimulationError):  # one flew apart: what all of them did until then is evaluated
            sm.rollout(scene, file, folder / "roll.h5", time_ps=time_ps, save_every_ps=SAVE_PS, replicas=REPLICAS,
                       temperature_k=TEMPERATURE_K, timestep_ps=TIMESTEP_PS, hydrogen_mass_da=1.008, guard="off",
                       seed=ROLL_SEED, overwrite=True, quiet=True)  # fmt: skip
        spent_s.write_text(f"{time.process_time() - began:.3f}\n")
    weights = load_weights(file)
    model, trained_s = weights.model, float(weights.provenance["training_s"])
    n_states = len(Samples.load(samples_path(file), scene.topology_hash))
    answer = model.evaluate(torch.tensor(ref.states), Molecule.of(scene)).forces_kj_mol_nm.numpy()
    runs = [frames_of(out) for out in outs]
    forces_a_s = sum(map(len, runs)) * SAVE_PS / TIMESTEP_PS / float(spent_s.read_text())
    stable, far = ref.compare(runs, SAVE_PS)
    error = force_error(answer, ref.forces)
    return [
        f"{name}, {scene.n_atoms}",
        f"{n_states:,} in {format_wall(trained_s)}",
        f"{error:.2f}",
        stable,
        far,
        f"{ref.replicate:.3f} ({format_time_ps(md_ps)})",
        f"{forces_a_s:,.0f}",
        f"{ref.forces_a_s:,.0f}",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--molecules", default=",".join(MOLECULES))
    parser.add_argument("--md", default="150ps", help="of each of the two runs")
    parser.add_argument("--budget", default="20min", help="of wall time, to learn a molecule in")
    parser.add_argument("--time", default="300ps", help="of each replica")
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    md_ps, time_ps = parse_time_ps(given.md, "--md"), parse_time_ps(given.time, "--time")
    rows = []
    for name in given.molecules.split(","):
        rows.append(potential_row(name, given.folder / name, parse_wall_s(given.budget), md_ps, time_ps))
        sys.stdout.write(" | ".join(rows[-1]) + "\n")
        sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": "python docs/studies/quantum/four_molecules.py FOLDER",
            "machine": machine_name(),
            "note": f"At 500 K; two MD runs by GFN2-xTB; {REPLICAS} replicas; processor time of one core.",
            "columns": ["molecule, atoms", "states learned from", "force error, kcal/mol/Å", "stable",
                        "h(r) from each MD run", "one MD run from the other", "forces a second", "GFN2-xTB's"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
