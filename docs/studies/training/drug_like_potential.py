"""One potential for drug-like molecules, trained on states of many molecules labelled by GFN2-xTB.

    python docs/studies/training/drug_like_potential.py train FOLDER -o OUT.safetensors --budget 6h [--resume]
    python docs/studies/training/drug_like_potential.py errors OUT.safetensors FOLDER

FOLDER is what drug_like_states.py labels. A step takes some molecules and some states of each. Energies count less
their mean over a molecule's states, so that no baseline of atoms is needed; each member of the potential learns from
three molecules in four, so that members disagree about chemistry that they have not seen. `errors` prints errors on
the molecules that are held out, beside those that are trained on.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from drug_like_states import read_list
from safetensors.torch import load_file, save_file
from torch import Tensor

from surrogate.models.painet.energy import NO_WALL_NM, PainetPotential, PotentialConfig, Topology
from surrogate.models.propagator import Molecule
from surrogate.training.devices import torch_threads
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.units import parse_wall_s

# States so far above a molecule's lowest, for each atom, are left out: no MD comes there.
HIGHEST_KJ_MOL = 12.0
BAG, SEED = 0.75, 7
KJ_MOL_NM_PER_KCAL_MOL_A, KJ_MOL_PER_KCAL = 41.84, 4.184
VALIDATED = 40


@dataclass(frozen=True, eq=False)
class Labelled:
    """States of one molecule: `positions_nm` and `forces` (n, n_atoms, 3), `energies` (n,), in kJ/mol and nm."""

    topology: Topology
    positions_nm: Tensor
    energies: Tensor
    forces: Tensor


def load(folder: Path, splits: Sequence[str], most: int | None = None) -> list[Labelled]:
    """Return the molecules of these splits that have been labelled."""
    found = []
    for number, entry in enumerate(read_list()):
        path = folder / f"{number:04d}.npz"
        if entry.split not in splits or not path.exists():
            continue
        with np.load(path) as data:
            energies = data["energies_kj_mol"] - data["energies_kj_mol"].min()
            numbers = torch.from_numpy(data["numbers"])
            kept = energies < HIGHEST_KJ_MOL * len(numbers)
            molecule = Molecule(numbers, torch.ones(len(numbers)), torch.from_numpy(data["bonds"]),
                                charge=int(data["charges"].sum()))  # fmt: skip
            arrays = (data["positions_nm"][kept], energies[kept].astype(np.float32), data["forces_kj_mol_nm"][kept])
        if kept.sum() >= 8:
            found.append(Labelled(Topology.of(molecule), *map(torch.from_numpy, arrays)))
        if most and len(found) >= most:
            break
    return found


class Learner:
    """`loss` learns from some molecules a step, `errors` measures on molecules that are held out."""

    def __init__(
        self, model: PainetPotential, learned: list[Labelled], held: list[Labelled], molecules: int, rows: int
    ) -> None:
        self.model, self.learned, self.held, self.molecules, self.rows = model, learned, held, molecules, rows
        draw = torch.rand(len(learned), model.config.n_members, generator=torch.Generator().manual_seed(SEED))
        self.bags = ((draw < BAG) | (draw == draw.amin(1, keepdim=True))).float()
        forces = torch.cat([s.forces.square().mean((1, 2)) for s in learned])
        model.energy_scale_kj_mol.fill_(0.1 * float(forces.median().sqrt()))
        model.energy_offset_kj_mol.zero_()

    def loss(self, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean length of the error of an atom's force, and mean square error of energies for each atom."""
        scale = float(self.model.energy_scale_kj_mol)
        force, energy = [], []
        for k in torch.randint(len(self.learned), (self.molecules,), generator=generator).tolist():
            one = self.learned[k]
            pick = torch.randint(len(one.energies), (self.rows,), generator=generator)
            member = int(torch.multinomial(self.bags[k], 1, generator=generator))
            at = one.positions_nm[pick].requires_grad_(True)
            found = self.model.members(at, one.topology)[:, member]
            (gradient,) = torch.autograd.grad(found.sum(), at, create_graph=True)
            wrong = (gradient + one.forces[pick]) / (10.0 * scale)
            force.append((wrong.square().sum(-1) + 1e-8).sqrt().mean())
            off = (found - one.energies[pick]) / scale
            energy.append((off - off.mean()).square().mean() / at.shape[1] ** 0.5)
        of_forces, of_energies = torch.stack(force).mean(), torch.stack(energy).mean()
        return of_forces + 0.1 * of_energies, {"force": of_forces.detach(), "energy": of_energies.detach()}

    def errors(self) -> dict[str, float]:
        found = np.array([errors_of(self.model, one)[:2] for one in self.held[:VALIDATED]])
        force, energy = found.mean(0).tolist()
        return {"validation_force_kcal": force, "validation_energy_kcal_atom": energy}


def errors_of(model: PainetPotential, one: Labelled, most: int = 24) -> tuple[float, float, float]:
    """Return the mean absolute error of force components (kcal/mol/Å), that of energies less their mean for each atom
    (kcal/mol), and the root mean square spread of the members' forces (kcal/mol/Å), over a molecule's first states."""
    x = one.positions_nm[:most]
    at = x.clone().requires_grad_(True)
    totals = model.members(at, one.topology)
    by_member = -torch.stack([torch.autograd.grad(t, at, retain_graph=True)[0] for t in totals.sum(0)]).detach()
    forces = by_member.mean(0)
    off = totals.detach().mean(-1).float() - one.energies[:most]
    spread = (by_member - forces).square().mean().sqrt()
    unit = KJ_MOL_NM_PER_KCAL_MOL_A
    return (
        float((forces - one.forces[:most]).abs().mean()) / unit,
        float((off - off.mean()).abs().mean()) / KJ_MOL_PER_KCAL / x.shape[1],
        float(spread) / unit,
    )


def set_walls(model: PainetPotential, learned: list[Labelled]) -> None:
    """Stand walls beyond the distances of all molecules together."""
    network = model.network
    nearest = torch.full_like(network.nearest_nm, NO_WALL_NM)
    farthest = torch.zeros_like(network.farthest_nm)
    for one in learned:
        network.set_walls(one.positions_nm, one.topology)
        seen = network.nearest_nm > 0
        nearest[seen] = torch.minimum(nearest, network.nearest_nm)[seen]
        bound = network.farthest_nm < NO_WALL_NM
        farthest[bound] = torch.maximum(farthest, network.farthest_nm)[bound]
    network.nearest_nm.copy_(torch.where(nearest < NO_WALL_NM, nearest, 0.0))
    network.farthest_nm.copy_(torch.where(farthest > 0, farthest, NO_WALL_NM))


def train(given: argparse.Namespace) -> None:
    torch.manual_seed(SEED)
    config = PotentialConfig(width=given.width, n_steps=given.steps_of_network, n_members=4)
    model = PainetPotential(config)
    learned, held = load(given.folder, ["train"], given.most), load(given.folder, ["test"])
    said(f"{len(learned)} molecules with {sum(len(s.energies) for s in learned):,} states, {len(held)} held out; "
         f"{sum(p.numel() for p in model.parameters()):,} parameters")  # fmt: skip
    learner = Learner(model, learned, held, given.molecules, given.rows)
    set_walls(model, learned)
    stage = StageConfig("potential", given.molecules * given.rows, 2e-3, given.budget, matrix_rate=0.01, seed=SEED,
                        bf16=False, validate_every_s=given.validate)  # fmt: skip

    def write(spent_s: list[float]) -> None:
        save_file({k: v.contiguous() for k, v in model.state_dict().items()}, given.out)

    def progress(name: str, share: float, metrics: dict[str, float]) -> None:
        if metrics:
            said(f"{100 * share:.1f} %: " + ", ".join(f"{k} {v:.4g}" for k, v in metrics.items()))

    with torch_threads(given.threads):
        train_stages([Stage(model, stage, learner.loss, learner.errors)], given.out, write, device=torch.device("cpu"),
                     resume=given.resume, progress=progress)  # fmt: skip


def print_errors(given: argparse.Namespace) -> None:
    model = PainetPotential(PotentialConfig(width=given.width, n_steps=given.steps_of_network, n_members=4))
    model.load_state_dict(load_file(given.weights))
    model.eval()
    for split in ("test", "train"):
        rows = np.array([errors_of(model, one, 80) for one in load(given.folder, [split], 60)])
        force, energy, spread = rows.T
        related = np.corrcoef(force, spread)[0, 1]
        said(f"{split}: {len(rows)} molecules, force {force.mean():.3f} (median {np.median(force):.3f}, worst "
             f"{force.max():.2f}) kcal/mol/Å, energy {energy.mean():.4f} kcal/mol an atom; spread "
             f"{np.median(spread):.3f}, whose correlation with the error is {related:.2f}")  # fmt: skip


def said(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    training, errors = verbs.add_parser("train"), verbs.add_parser("errors")
    errors.add_argument("weights", type=Path)
    for part in (training, errors):
        part.add_argument("folder", type=Path)
        part.add_argument("--width", type=int, default=96)
        part.add_argument("--steps-of-network", type=int, default=2)
    training.add_argument("-o", "--out", type=Path, required=True)
    training.add_argument("--budget", type=lambda text: parse_wall_s(text, "--budget"), required=True)
    training.add_argument("--resume", action="store_true")
    training.add_argument("--molecules", type=int, default=4)
    training.add_argument("--rows", type=int, default=24)
    training.add_argument("--most", type=int, help="molecules to train on")
    training.add_argument("--threads", type=int, default=1)
    training.add_argument("--validate", type=float, default=300.0)
    given = parser.parse_args()
    train(given) if given.verb == "train" else print_errors(given)


if __name__ == "__main__":
    main()
