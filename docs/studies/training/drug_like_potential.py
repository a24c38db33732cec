"""One potential for drug-like molecules, trained on states of many molecules labelled by GFN2-xTB.

    python docs/studies/training/drug_like_potential.py train FOLDER -o OUT.safetensors --budget 6h [--resume]
    python docs/studies/training/drug_like_potential.py errors OUT.safetensors FOLDER
    python docs/studies/training/drug_like_potential.py trust OUT.safetensors FOLDER [--time 250ps]
    python docs/studies/training/drug_like_potential.py tune OUT.safetensors FOLDER [--seconds 60 180] [--molecules 10]

FOLDER is what drug_like_states.py labels. A step takes some molecules and some states of each. Energies count less
their mean over a molecule's states, so that no baseline of atoms is needed; each member of the potential learns from
three molecules in four, so that members disagree about chemistry that they have not seen. `errors` prints errors on
the molecules that are held out, beside those that are trained on. `trust` rolls molecules that are neither, measures
where the members' spread (`sampling.domain`) tells those that fly apart, and writes that limit into the weights. `tune`
trains on held-out molecules one by one, beginning with the weights and with nothing, as `surromd train` does.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from drug_like_states import Entry, read_list
from torch import Tensor

import surrogate as sm
from surrogate.models.painet.energy import NO_WALL_NM, PainetPotential, PotentialConfig, Topology
from surrogate.models.painet.potential_trainer import conditions_of
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Chemistry, TrainingDomain, Weights, load_weights, provenance_of, save_weights
from surrogate.sampling.domain import disagreement
from surrogate.training.devices import torch_threads
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.chemistry.validity import INVALID, geometry_from_scene
from systems.errors import SimulationError, SurromdError
from systems.library.named_scenes import prepare
from systems.scene import ATOMIC_NUMBERS
from systems.trajectory.codec import open_trajectory
from systems.units import parse_time_ps, parse_wall_s

# States so far above a molecule's lowest, for each atom, are left out: no MD comes there.
HIGHEST_KJ_MOL = 12.0
BAG, SEED = 0.75, 7
KJ_MOL_NM_PER_KCAL_MOL_A, KJ_MOL_PER_KCAL = 41.84, 4.184
VALIDATED = 40
# Every so many-th molecule of the training list is kept for `trust`.
ASIDE_EVERY, ASIDE = 42, "aside"
REPLICAS, KEPT_WHOLE = 16, 0.96


@dataclass(frozen=True, eq=False)
class Labelled:
    """States of one molecule: `positions_nm` and `forces` (n, n_atoms, 3), `energies` (n,), in kJ/mol and nm."""

    entry: Entry
    topology: Topology
    positions_nm: Tensor
    energies: Tensor
    forces: Tensor


def load(folder: Path, splits: Sequence[str], most: int | None = None) -> list[Labelled]:
    """Return the molecules of these splits that have been labelled."""
    found = []
    for number, entry in enumerate(read_list()):
        path = folder / f"{number:04d}.npz"
        split = ASIDE if entry.split == "train" and number % ASIDE_EVERY == 0 else entry.split
        if split not in splits or not path.exists():
            continue
        with np.load(path) as data:
            energies = data["energies_kj_mol"] - data["energies_kj_mol"].min()
            numbers = torch.from_numpy(data["numbers"])
            kept = energies < HIGHEST_KJ_MOL * len(numbers)
            molecule = Molecule(numbers, torch.ones(len(numbers)), torch.from_numpy(data["bonds"]),
                                charge=int(data["charges"].sum()))  # fmt: skip
            arrays = (data["positions_nm"][kept], energies[kept].astype(np.float32), data["forces_kj_mol_nm"][kept])
        if kept.sum() >= 8:
            found.append(Labelled(entry, Topology.of(molecule), *map(torch.from_numpy, arrays)))
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
        sources = [{"file": "docs/studies/training/drug_like.tsv", "n_frames": sum(len(s.energies) for s in learned)}]
        found = {"seed": SEED, "training_s": round(sum(spent_s), 1), **learner.errors()}
        provenance = provenance_of({"reference_ns": 0.0, "sources": sources}, found)
        save_weights(given.out, model, domain_of(learned, config), provenance)

    def progress(name: str, share: float, metrics: dict[str, float]) -> None:
        if metrics:
            said(f"{100 * share:.1f} %: " + ", ".join(f"{k} {v:.4g}" for k, v in metrics.items()))

    with torch_threads(given.threads):
        train_stages([Stage(model, stage, learner.loss, learner.errors)], given.out, write, device=torch.device("cpu"),
                     resume=given.resume, progress=progress)  # fmt: skip


def domain_of(learned: list[Labelled], config: PotentialConfig) -> TrainingDomain:
    """Return what the weights cover, with nothing trusted yet."""
    scene = prepare(f"smiles:{learned[0].entry.smiles}")
    numbers = torch.cat([one.topology.present for one in learned]).tolist()
    elements = tuple(symbol for symbol, number in ATOMIC_NUMBERS.items() if number in numbers)
    charges = [one.entry.charge for one in learned]
    # Nothing is trusted until it is measured how far.
    known = Chemistry(elements, max(one.entry.n_atoms for one in learned), (min(charges), max(charges)), 0.0)
    geometry = geometry_from_scene(scene).to_dict()
    return TrainingDomain(scene, config.lag_ps, conditions_of(config), geometry, transferable=True, chemistry=known)


def print_errors(given: argparse.Namespace) -> None:
    model = load_weights(given.weights).model
    assert isinstance(model, PainetPotential)
    for split in ("test", "train"):
        rows = np.array([errors_of(model, one, 80) for one in load(given.folder, [split], 60)])
        force, energy, spread = rows.T
        related = np.corrcoef(force, spread)[0, 1]
        said(f"{split}: {len(rows)} molecules, force {force.mean():.3f} (median {np.median(force):.3f}, worst "
             f"{force.max():.2f}) kcal/mol/Å, energy {energy.mean():.4f} kcal/mol an atom; spread "
             f"{np.median(spread):.3f}, whose correlation with the error is {related:.2f}")  # fmt: skip


def stays_whole(weights: Weights, smiles: str, time_ps: float, out: Path) -> float:
    """Return the share of replicas whose frames are all valid after so long."""
    try:
        files = sm.rollout(f"smiles:{smiles}", weights.path, out, time_ps=time_ps, save_every_ps=1.0, guard="flag",
                           replicas=REPLICAS, seed=SEED, force=True, quiet=True, overwrite=True)  # fmt: skip
    except SimulationError:
        return 0.0
    whole = 0
    for file in files:
        with open_trajectory(file) as reader:
            whole += not (reader.flags & INVALID).any()
    return whole / len(files)


def trust(given: argparse.Namespace) -> None:
    """Roll molecules that are kept aside, and write the greatest spread below which so many of them stay whole."""
    weights = load_weights(given.weights)
    known, model = weights.domain.chemistry, weights.model
    assert known is not None and isinstance(model, PainetPotential)
    rows = []
    for one in load(given.folder, [ASIDE]):
        try:
            spread, n_lost = disagreement(prepare(f"smiles:{one.entry.smiles}"), model)
            whole = stays_whole(weights, one.entry.smiles, given.time, given.weights.with_suffix(".h5"))
        except SurromdError as error:
            said(f"{one.entry.smiles}: {error}")
            continue
        force, energy, _ = errors_of(model, one, 80)
        with torch.no_grad():
            members = model.members(one.positions_nm, one.topology)
        unsure = float((members - members[:1]).std(-1, correction=0).mean())
        if not n_lost:  # others are refused whatever the spread
            rows.append((spread, whole, energy * KJ_MOL_PER_KCAL * one.entry.n_atoms, unsure))
        said(f"{one.entry.smiles}: spread {spread:.3g} kJ/mol/nm, {100 * whole:.0f} % of replicas whole, force error "
             f"{force:.2f} kcal/mol/Å")  # fmt: skip
    if not rows:
        raise SystemExit("none of the molecules kept aside stays whole for 2 ps; train longer.")
    rows.sort()
    lost = np.cumsum([whole < 1.0 for _, whole, *_ in rows])
    enough = [k for k in range(len(rows)) if 1.0 - lost[k] / (k + 1) >= KEPT_WHOLE]
    limit = rows[enough[-1]][0] if enough else 0.0
    said(f"spread of at most {limit:.3g} kJ/mol/nm: {enough[-1] + 1 if enough else 0} of {len(rows)} molecules, "
         f"{int(lost[enough[-1]]) if enough else 0} of these lose a replica")  # fmt: skip
    domain = replace(weights.domain, chemistry=replace(known, spread_kj_mol_nm=limit))
    energies = dict(zip(("energy_mae", "energy_spread"), np.median(rows, axis=0)[2:].tolist(), strict=True))
    save_weights(given.weights, model, domain, {**weights.provenance, **energies})


def tune(given: argparse.Namespace) -> None:
    """Print errors of forces after so much training on one molecule, from the weights and from nothing."""
    for one in load(given.folder, ["test"], given.molecules):
        found = []
        for seconds in given.seconds:
            for start in (given.weights, None):
                out = given.weights.with_name("tuned.safetensors")
                sm.train(f"smiles:{one.entry.smiles}", out, level="gfn2-xtb", start_from=start, budget_s=seconds,
                         seed=SEED, quiet=True, overwrite=True)  # fmt: skip
                model = load_weights(out).model
                assert isinstance(model, PainetPotential)
                force = errors_of(model, one, 80)[0]
                found.append(f"{seconds:g} s from {'nothing' if start is None else 'these'} {force:.2f}")
        model = load_weights(given.weights).model
        assert isinstance(model, PainetPotential)
        said(f"{one.entry.smiles}: untuned {errors_of(model, one, 80)[0]:.2f}, {', '.join(found)} kcal/mol/Å")


def said(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    training, errors, trusting, tuning = (verbs.add_parser(name) for name in ("train", "errors", "trust", "tune"))
    for part in (errors, trusting, tuning):
        part.add_argument("weights", type=Path)
    for part in (training, errors, trusting, tuning):
        part.add_argument("folder", type=Path)
    tuning.add_argument("--seconds", type=float, nargs="+", default=[60.0, 180.0])
    tuning.add_argument("--molecules", type=int, default=10)
    trusting.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=250.0)
    training.add_argument("--width", type=int, default=96)
    training.add_argument("--steps-of-network", type=int, default=2)
    training.add_argument("-o", "--out", type=Path, required=True)
    training.add_argument("--budget", type=lambda text: parse_wall_s(text, "--budget"), required=True)
    training.add_argument("--resume", action="store_true")
    training.add_argument("--molecules", type=int, default=4)
    training.add_argument("--rows", type=int, default=24)
    training.add_argument("--most", type=int, help="molecules to train on")
    training.add_argument("--threads", type=int, default=1)
    training.add_argument("--validate", type=float, default=300.0)
    given = parser.parse_args()
    {"train": train, "errors": print_errors, "trust": trust, "tune": tune}[given.verb](given)


if __name__ == "__main__":
    main()
