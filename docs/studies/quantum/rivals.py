"""EGNN and MACE as potentials, on what `four_molecules.py` had PAINET learn, trained, rolled and evaluated alike.

    python docs/studies/quantum/rivals.py FOLDER [--molecules ethanol] [--rivals egnn,mace] [--budget 20min]
        [-o docs/results/tables/potential_rivals.json]

FOLDER is that of `four_molecules.py`, which comes first. EGNN (Satorras 2021): four layers of the decoder's, all pairs,
positions that move, the energy read from the last embeddings. MACE (Batatia 2022) is the package's own (`pip install
mace-torch`, of no use to surromd otherwise): two layers of 64 scalars and vectors, correlation 3, 5 Å. All of them: one
core, Adam, batches of 16, mean square errors of forces and energies. Each is rolled for `--roll` of that core, or as
long as PAINET was. What is there is not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import four_molecules as four
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from md_reference.run.machine import machine_name
from surrogate.models.painet.model import Egnn, molecular_graph
from surrogate.models.painet.potential_trainer import Samples, samples_path
from surrogate.models.potential import gradient_of
from surrogate.models.propagator import Molecule
from surrogate.models.weights import load_weights
from systems.prepare.molecule import scene_from_smiles
from systems.scene import FloatArray
from systems.units import GAS_CONSTANT_KJ_MOL_K, format_wall, parse_time_ps, parse_wall_s

BATCH, LEARNING_RATE, WARM_UP, ENERGY_WEIGHT, CLIP = 16, 2e-3, 50, 0.1, 10.0
ANGSTROM = 10.0  # of a nm
# Energies of frames (rows, n_atoms, 3) nm, in units of the samples' scale, (rows, 1)
EnergyFn = Callable[[Tensor], Tensor]


class EgnnEnergy(nn.Module):
    """Energies of frames by EGNN."""

    def __init__(self, molecule: Molecule, width: int = 64, n_layers: int = 4) -> None:
        super().__init__()
        self.elements, self.graph = molecule.elements, molecular_graph(molecule, all_pairs=True)
        self.embed = nn.Embedding(100, width)
        self.layers = Egnn(width, n_layers).layers
        self.read = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 1))

    def forward(self, positions_nm: Tensor) -> Tensor:
        x = ANGSTROM * positions_nm.float()
        still, reach = torch.zeros_like(x), x.new_ones(2)
        h, u = self.embed(self.elements).expand(len(x), -1, -1), still
        for layer in self.layers:
            h, x, u = layer(h, x, u, still, self.graph, reach)
        energy: Tensor = self.read(h).sum(1)
        return energy


class MaceEnergy(nn.Module):
    """Energies of frames by MACE, as its package has it."""

    def __init__(self, molecule: Molecule, width: int = 64, cutoff: float = 5.0) -> None:
        super().__init__()
        import mace  # noqa: F401  (before e3nn: it has torch load what that package brings)
        from e3nn import o3
        from mace.modules import ScaleShiftMACE, interaction_classes

        kinds, of_atom = torch.unique(molecule.elements, return_inverse=True)
        self.one_hot = F.one_hot(of_atom, len(kinds)).float()
        self.cutoff = cutoff
        self.pairs = torch.combinations(torch.arange(molecule.n_atoms)).T
        self.pairs = torch.cat([self.pairs, self.pairs.flip(0)], dim=1)
        self.network = ScaleShiftMACE(
            r_max=cutoff, num_bessel=8, num_polynomial_cutoff=5, max_ell=3, num_interactions=2,
            interaction_cls=interaction_classes["RealAgnosticResidualInteractionBlock"],
            interaction_cls_first=interaction_classes["RealAgnosticResidualInteractionBlock"],
            num_elements=len(kinds), hidden_irreps=o3.Irreps(f"{width}x0e + {width}x1o"), MLP_irreps=o3.Irreps("16x0e"),
            gate=F.silu, atomic_energies=np.zeros(len(kinds)), avg_num_neighbors=float(molecule.n_atoms - 1),
            atomic_numbers=kinds.tolist(), correlation=3, atomic_inter_scale=1.0, atomic_inter_shift=0.0,
        )  # fmt: skip

    def forward(self, positions_nm: Tensor) -> Tensor:
        x = ANGSTROM * positions_nm.float()
        rows, n = x.shape[:2]
        first, second = self.pairs
        row, pair = torch.nonzero((x[:, first] - x[:, second]).detach().norm(dim=-1) < self.cutoff, as_tuple=True)
        edges = self.pairs[:, pair] + n * row
        data = {
            "positions": x.flatten(0, 1), "node_attrs": self.one_hot.repeat(rows, 1), "edge_index": edges,
            "shifts": x.new_zeros(len(row), 3), "unit_shifts": x.new_zeros(len(row), 3),
            "cell": x.new_zeros(3 * rows, 3), "batch": torch.arange(rows).repeat_interleave(n),
            "ptr": n * torch.arange(rows + 1), "head": torch.zeros(rows, dtype=torch.long),
        }  # fmt: skip
        energy: Tensor = self.network(data, training=self.training, compute_force=False)["energy"]
        return energy[:, None]


RIVALS: dict[str, Callable[[Molecule], nn.Module]] = {"egnn": EgnnEnergy, "mace": MaceEnergy}


def learn(network: nn.Module, samples: Samples, budget_s: float) -> tuple[int, float, float]:
    """Train for so much processor time; return the steps, and scale and zero of energies in kJ/mol."""
    x, energies, forces = samples.where(~samples.held).tensors()
    scale, zero = 0.1 * float(forces.square().mean().sqrt()), float(energies.mean())
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    generator, began, steps = torch.Generator().manual_seed(0), time.process_time(), 0
    while (share := (time.process_time() - began) / budget_s) < 1.0:
        for group in optimiser.param_groups:
            group["lr"] = LEARNING_RATE * min((steps + 1) / WARM_UP, 1.0) * 0.5 * (1.0 + np.cos(np.pi * share))
        k = torch.randint(len(x), (BATCH,), generator=generator)
        at = x[k].requires_grad_(True)
        found = network(at)[:, 0].double()
        (gradient,) = torch.autograd.grad(found.sum(), at, create_graph=True)
        force = (gradient / ANGSTROM + forces[k] / (ANGSTROM * scale)).square().mean()
        energy = (found - (energies[k] - zero) / scale).square().mean()
        optimiser.zero_grad()
        (force + ENERGY_WEIGHT * energy).backward()
        nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        steps += 1
    return steps, scale, zero


def roll(energy: EnergyFn, scale: float, start: FloatArray, molecule: Molecule, time_ps: float, budget_s: float
         ) -> tuple[FloatArray, float]:  # fmt: skip
    """Return frames (n, replicas, n_atoms, 3) nm of Langevin MD (middle scheme), and forces a second of one core."""
    gradient, generator = gradient_of(energy), torch.Generator().manual_seed(four.ROLL_SEED)
    masses = molecule.masses_da.double()[:, None]
    thermal = (GAS_CONSTANT_KJ_MOL_K * four.TEMPERATURE_K / masses).sqrt()
    dt, share = four.TIMESTEP_PS, masses / masses.sum()
    kept = float(np.exp(-dt))
    lost = (1.0 - kept * kept) ** 0.5 * thermal
    x = torch.tensor(start).repeat(four.REPLICAS, 1, 1)
    v = thermal * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    frames, began, steps = [], time.process_time(), 0
    while len(frames) < round(time_ps / four.SAVE_PS) and time.process_time() - began < budget_s:
        for _ in range(round(four.SAVE_PS / dt)):
            v = v - dt * scale * gradient(x)[1].double() / masses
            x = x + 0.5 * dt * v
            v = kept * v + lost * torch.randn(x.shape, generator=generator, dtype=x.dtype)
            v = v - (share * v).sum(-2, keepdim=True)
            x = x + 0.5 * dt * v
            steps += 1
        frames.append(x.float().numpy())
    return np.stack(frames), four.REPLICAS * steps / (time.process_time() - began)


def rival_row(rival: str, name: str, folder: Path, budget_s: float, roll_s: float, given: Any) -> list[str]:
    """Train and roll a rival where that is not done, and return its line of the table."""
    scene = scene_from_smiles(four.MOLECULES[name])
    molecule, reference = Molecule.of(scene), four.ReferenceForces(scene, folder, given.md)
    learned = folder / "painet.safetensors"
    samples = Samples.load(samples_path(learned), scene.topology_hash)
    file, rolled = folder / f"{rival}.pt", folder / f"{rival}.npz"
    torch.manual_seed(0)
    network = RIVALS[rival](molecule)
    if not file.is_file():
        steps, scale, zero = learn(network, samples, budget_s)
        torch.save({"network": network.state_dict(), "steps": steps, "scale": scale, "zero": zero}, file)
    kept = torch.load(file, weights_only=True)
    network.load_state_dict(kept["network"])
    network.eval().requires_grad_(False)
    if not rolled.is_file():
        frames, forces_a_s = roll(network, kept["scale"], scene.positions_nm, molecule, given.time, roll_s)
        np.savez(rolled, frames=frames, forces_a_s=forces_a_s)
    made = np.load(rolled)
    parts = [gradient_of(network)(part)[1] for part in torch.tensor(reference.states).split(50)]
    error = four.force_error(-kept["scale"] * torch.cat(parts).double().numpy(), reference.forces)
    runs = list(made["frames"].astype(np.float64).swapaxes(0, 1))
    stable, far = reference.compare(runs, four.SAVE_PS)
    return [f"{name}, {rival.upper()}", f"{kept['steps']:,}", f"{error:.2f}", stable, far, f"{reference.replicate:.3f}",
            f"{float(made['forces_a_s']):,.0f}"]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--molecules", default="ethanol")
    parser.add_argument("--rivals", default=",".join(RIVALS))
    parser.add_argument("--budget", default="20min", help="of processor time, to train a rival")
    parser.add_argument("--roll", default="20min", help="of processor time, to roll it")
    parser.add_argument("--md", type=lambda text: parse_time_ps(text, "--md"), default=150.0)
    parser.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=300.0)
    parser.add_argument("-o", "--out", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in given.molecules.split(","):
        folder = given.folder / name
        made = load_weights(folder / "painet.safetensors").provenance
        sys.stdout.write(f"{name}: PAINET trained for {made['training_s']:g} s of wall time\n")
        for rival in given.rivals.split(","):
            rows.append(rival_row(rival, name, folder, parse_wall_s(given.budget), parse_wall_s(given.roll), given))
            sys.stdout.write(" | ".join(rows[-1]) + "\n")
            sys.stdout.flush()
    if given.out is not None:
        table = {
            "command": "python docs/studies/quantum/rivals.py FOLDER",
            "machine": machine_name(),
            "note": f"Trained for {format_wall(parse_wall_s(given.budget))} and rolled for "
                    f"{format_wall(parse_wall_s(given.roll))} of one core at most, on PAINET's own samples.",
            "columns": ["molecule, rival", "training steps", "force error, kcal/mol/Å", "stable",
                        "h(r) from each MD run", "one MD run from the other", "forces a second"],
            "rows": rows,
        }  # fmt: skip
        given.out.write_text(json.dumps(table, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
