"""One potential for drug-like molecules, trained on states of many molecules labelled by GFN2-xTB.

    python docs/studies/training/drug_like_potential.py train FOLDER -o OUT.safetensors --budget 6h [--resume]
    python docs/studies/training/drug_like_potential.py errors OUT.safetensors FOLDER
    python docs/studies/training/drug_like_potential.py effective OUT.safetensors [--molecules 18]
    python docs/studies/training/drug_like_potential.py trust OUT.safetensors FOLDER [--time 250ps]
    python docs/studies/training/drug_like_potential.py stability OUT.safetensors FOLDER [--time 250ps] [--molecules 50]
    python docs/studies/training/drug_like_potential.py tune OUT.safetensors FOLDER [--seconds 60 180] [--molecules 10]

FOLDER is what drug_like_states.py labels. A step takes some molecules and some states of each. Energies count less
their mean over a molecule's states, so that no baseline of atoms is needed; each member of the potential learns from
three molecules in four, so that members disagree about chemistry that they have not seen. `errors` prints errors on
the molecules that are held out, beside those that are trained on. `effective` prints how much the energy is off in MD
on the weights, at 300 K, of held-out molecules, and how many of such frames count once they are weighted to
GFN2-xTB's law. `trust` rolls molecules that are neither, measures
where the members' spread (`sampling.domain`) tells those that fly apart, and writes that limit into the weights.
`stability` rolls held-out molecules that the weights then do not refuse. `tune` trains on held-out molecules one by
one, beginning with the weights, as `surromd train` does.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from drug_like_states import (
    COMPACT,
    HIGHEST_KJ_MOL,
    RECOMBINED,
    ROLLED_REPLICAS,
    Entry,
    conformers,
    file_of,
    read_compact,
    read_list,
    rolled_states,
)
from recorded import Recorded
from torch import Tensor
from torch.nn import functional as F

import surrogate as sm
from md_reference.forces.quantum import Potential
from md_reference.run.labeller import Labeller
from surrogate.models.painet.energy import (
    LEAST_NM,
    N_SHELLS,
    WALL,
    Edges,
    EnergyNetwork,
    PotentialConfig,
    Topology,
    measure_edges,
)
from surrogate.models.painet.model import dense_mean
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.painet.potential_trainer import conditions_of
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Chemistry, TrainingDomain, Weights, load_weights, provenance_of, save_weights
from surrogate.sampling.domain import disagreement, in_step, match_domain
from surrogate.training.devices import choose_device, torch_threads
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.chemistry.validity import INVALID, geometry_from_scene
from systems.errors import SimulationError, SurromdError
from systems.files.whole_file import replica_paths
from systems.library.named_scenes import prepare
from systems.scene import ATOMIC_NUMBERS, Scene
from systems.trajectory.checkpoint import checkpoint_path
from systems.trajectory.codec import open_trajectory, reweighting
from systems.units import parse_time_ps, parse_wall_s

BAG, SEED = 0.75, 7
ENERGY_WEIGHT = 2.0
SUMS = ("n_scalars", "n_vectors", "n_tensors")
KJ_MOL_NM_PER_KCAL_MOL_A, KJ_MOL_PER_KCAL = 41.84, 4.184
# Molecules are batched with others of about their size, in so many arrays of one shape.
N_BUCKETS, HELD_STATES = 6, 24
# Every so many-th molecule of the training list is kept for `trust`.
ASIDE_EVERY, ASIDE = 42, "aside"
REPLICAS, KEPT_WHOLE = 16, 0.96
# Where `tune` measures.
TUNED_K = (300.0, 500.0)


@dataclass(frozen=True, eq=False)
class Labelled:
    """States of one molecule: `positions_nm` and `forces` (n, n_atoms, 3), `energies` (n,), in kJ/mol and nm."""

    entry: Entry
    topology: Topology
    positions_nm: Tensor
    energies: Tensor
    forces: Tensor


def load(folder: Path, splits: Sequence[str], most: int | None = None, states: int | None = None) -> list[Labelled]:
    """Return the molecules of these splits that have been labelled, at most so many, with at most so many states."""
    found = []
    for number, entry in enumerate(read_list()):
        aside = entry.split == "train" and entry.source != RECOMBINED and number % ASIDE_EVERY == 0
        split = ASIDE if aside else entry.split
        paths = [path for by in (None, "any") if (path := file_of(folder, number, by)).exists()]
        if split not in splits or not paths:
            continue
        found_in = []
        for path in paths:
            with np.load(path) as data:
                found_in.append((data["energies_kj_mol"], *(read_compact(data, name) for name in COMPACT)))
                numbers = torch.from_numpy(data["numbers"])
                molecule = Molecule(numbers, torch.ones(len(numbers)), torch.from_numpy(data["bonds"]),
                                    charge=int(data["charges"].sum()))  # fmt: skip
        energies, x, forces = map(np.concatenate, zip(*found_in, strict=True))
        energies = energies - energies.min()
        kept = energies < HIGHEST_KJ_MOL * len(numbers)
        arrays = (a[kept][:states] for a in (x, energies.astype(np.float32), forces))
        if kept.sum() >= 8:
            found.append(Labelled(entry, Topology.of(molecule), *map(torch.from_numpy, arrays)))
        if most and len(found) >= most:
            break
    return found


class Blocks(Edges):
    """Edges of several molecules side by side, each in a block of as many places: every place with every one of its
    block. A place that holds no atom is to all as it is to itself, infinitely far."""

    @property
    def by_block(self) -> tuple[int, int]:
        return (-1, self.n_atoms)

    def sent(self, values: Tensor) -> Tensor:
        blocks = values.unflatten(0, self.by_block)
        return blocks[:, None].expand(-1, self.n_atoms, *blocks.shape[1:]).flatten(0, 2)

    def apart_nm(self, positions_nm: Tensor) -> Tensor:
        x = positions_nm.unflatten(0, self.by_block)
        return (x[:, :, None] - x[:, None]).flatten(0, 2)

    def sum(self, values: Tensor) -> Tensor:
        return values.unflatten(0, self.by_block).sum(1)

    def by_atom(self, shapes: Tensor) -> Tensor:
        return shapes.unflatten(0, self.by_block).permute(0, 2, 3, 1).contiguous()

    def sum_of_products(self, laid: Tensor, values: Tensor) -> Tensor:
        return laid @ values.unflatten(0, self.by_block).transpose(1, 2)


@dataclass(frozen=True, eq=False)
class Bucket:
    """Molecules of about one size in arrays of one shape, on the device that trains: `elements` (n, places), zero where
    there is no atom, `charge` (n,), `shell` (n, places, places), `bonded` of ones where atoms share a bond; `x` nm and
    `forces` (n, states, places, 3), `energies` (n, states), of which the first `n_states` (n,) count; `bags` (n,
    members), ones where a member learns from the molecule."""

    elements: Tensor
    charge: Tensor
    shell: Tensor
    bonded: Tensor
    x: Tensor
    forces: Tensor
    energies: Tensor
    n_states: Tensor
    bags: Tensor

    @staticmethod
    def of(learned: list[Labelled], bags: Tensor, device: torch.device) -> Bucket:
        n, places = len(learned), max(one.entry.n_atoms for one in learned)
        states = max(len(one.energies) for one in learned)
        elements, shell = torch.zeros(n, places, dtype=torch.int64), torch.full((n, places, places), N_SHELLS - 1)
        bonded, energies = torch.zeros(n, places, places), torch.zeros(n, states)
        x, forces = torch.zeros(n, states, places, 3), torch.zeros(n, states, places, 3)
        for k, one in enumerate(learned):
            n_states, n_atoms, _ = one.positions_nm.shape
            elements[k, :n_atoms] = one.topology.molecule.elements
            bonded[k, *one.topology.bonds] = 1.0
            for (i, j), apart in one.topology.shells.items():
                shell[k, [i, j], [j, i]] = apart
            x[k, :n_states, :n_atoms], forces[k, :n_states, :n_atoms] = one.positions_nm, one.forces
            energies[k, :n_states] = one.energies - one.energies.mean()
        counts = torch.tensor([len(one.energies) for one in learned])
        charge = torch.tensor([float(one.topology.molecule.charge) for one in learned])
        return Bucket(*(t.to(device) for t in (elements, charge, shell, bonded, x, forces, energies, counts, bags)))


def buckets_of(learned: list[Labelled], bags: Tensor, device: torch.device) -> list[Bucket]:
    """Return the molecules by size."""
    order = sorted(range(len(learned)), key=lambda k: learned[k].entry.n_atoms)
    parts = np.array_split(order, min(N_BUCKETS, len(order)))
    return [Bucket.of([learned[k] for k in part], bags[part], device) for part in parts]


def energies_of_many(network: EnergyNetwork, bucket: Bucket, chosen: Tensor, x: Tensor) -> Tensor:
    """Frames `x` (molecules, rows, places, 3) nm of the `chosen` molecules of a bucket -> the members' energies
    (molecules, rows, n_members), as `EnergyNetwork` computes them of one molecule."""
    c, (many, rows, places, _) = network.config, x.shape
    elements, shell = bucket.elements[chosen], bucket.shell[chosen]
    real = elements > 0
    z = network.embed_type(elements) + bucket.charge[chosen, None, None] * network.embed_type.weight[0]
    for round_ in network.surroundings:
        z = z + round_(torch.cat([z, bucket.bonded[chosen] @ z], dim=-1))
    of_shell = network.of_shell(shell)
    ends = (z[:, :, None] + of_shell).flatten(0, 2), z[:, None].expand_as(of_shell).flatten(0, 2)
    of_edge = network.of_pair(torch.cat(ends, dim=-1))
    place = torch.arange(places, device=x.device)
    apart = (place[:, None] != place) & real[:, :, None] & real[:, None]
    receiver = torch.zeros_like(shell).flatten()
    edges = Blocks(receiver, apart.long().flatten(), shell.flatten(), places, True)
    at = x.transpose(1, 2).flatten(0, 1)
    seen = measure_edges(at, edges, c.n_radial, c.cutoff_nm, x.dtype)
    weight = real / real.sum(1, keepdim=True)
    moved = 10.0 * (x - torch.einsum("bn,brnd->brd", weight, x)[:, :, None])
    h = z.flatten(0, 1)[:, None].expand(-1, rows, -1)
    carried = None
    types = elements[:, :, None], elements[:, None]
    for look, step in zip(network.looks, network.steps, strict=True):
        h = look(h, carried, seen, edges, look.weights(of_edge))
        phi, psi = (m[:, *types].movedim(0, 1)[:, None] * real[:, None, None, None] for m in step.type_matrices())
        of_atom = h.unflatten(0, (many, places)).transpose(1, 2)
        q, k, v = step.qkv(of_atom).unflatten(-1, (3, c.n_heads, -1)).permute(3, 0, 1, 4, 2, 5)
        q, k = F.normalize(q, dim=-1), F.normalize(k, dim=-1)
        v = torch.cat([v, moved[:, :, None].expand(-1, -1, c.n_heads, -1, -1)], dim=-1)
        own, means = dense_mean(q, k, v, phi, psi).split((c.head_dim, 3), dim=-1)
        new = (1.0 - c.step) * of_atom + c.step * step.out(own.transpose(2, 3).flatten(-2))
        h = new.transpose(1, 2).flatten(0, 1)
        carried = (means - moved[:, :, None]).permute(0, 3, 1, 4, 2).flatten(0, 1)
    both = real[:, None, None, :, None] & real[:, None, None, None]
    s = 2.0 - 2.0 * q @ q.transpose(-1, -2)
    latent = (both * (phi + psi) * s - both * 0.25 * psi * s.square()).sum((-1, -2)) / real.sum(1)[:, None, None] ** 2
    site = network.site(h).unflatten(0, (many, places)) * real[..., None, None]
    table = network.table(of_edge).unflatten(-1, (c.n_radial, -1))
    paired = torch.bmm(seen.radial, table).unflatten(0, (many, -1)).sum(1)
    walls = shell, *(t.expand_as(shell) for t in types)
    near = torch.relu(1.0 - seen.distance_nm / network.nearest_nm[walls].flatten()[:, None].clamp(min=LEAST_NM))
    far = torch.where(apart, network.farthest_nm[walls], torch.inf).flatten()
    held = (near.pow(3) + torch.relu(seen.distance_nm / far[:, None] - 1.0).pow(3)).unflatten(0, (many, -1)).sum(1)
    return site.sum(1) + 0.5 * paired + latent @ network.latent + WALL * held[..., None]


class Learner:
    """`loss` learns from some molecules a step, of about one size; `errors` measures on molecules that are held out."""

    def __init__(self, model: PainetPotential, learned: list[Labelled], held: list[Labelled], molecules: int, rows: int,
                 device: torch.device) -> None:  # fmt: skip
        self.model, self.molecules, self.rows = model, molecules, rows
        self.recorded: dict[int, Recorded] = {}
        draw = torch.rand(len(learned), model.config.n_members, generator=torch.Generator().manual_seed(SEED))
        bags = ((draw < BAG) | (draw == draw.amin(1, keepdim=True))).float()
        self.buckets, self.held = buckets_of(learned, bags, device), buckets_of(held, torch.ones(len(held), 1), device)
        self.scale = float(model.energy_scale_kj_mol)

    def loss(self, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        """Mean length of the error of an atom's force, and mean error of energies over the root of the atoms."""
        place = int(torch.randint(len(self.buckets), (), generator=generator))
        bucket = self.buckets[place]
        u = torch.rand(self.molecules, self.rows + 2, generator=generator).to(bucket.charge)
        chosen = (u[:, 0] * len(bucket.charge)).long()
        # Of the members that learn from a molecule, one.
        bags = bucket.bags[chosen].cumsum(1)
        member = (bags <= (u[:, 1:2] * bags[:, -1:]).floor()).sum(1)
        drawn = chosen, (u[:, 2:] * bucket.n_states[chosen, None]).long(), member
        if u.device.type == "cpu":
            found = self.parts(bucket, self.model, *drawn)
        else:
            if place not in self.recorded:
                self.recorded[place] = Recorded(self.model, partial(self.parts, bucket), drawn)
            found = self.recorded[place](*drawn)
        return found.sum(), dict(zip(("force", "energy"), found.detach(), strict=True))

    def parts(self, bucket: Bucket, model: PainetPotential, chosen: Tensor, picked: Tensor, member: Tensor) -> Tensor:
        """Return the losses of forces and of energies (2,) for the states `picked` (n, rows) of the molecules `chosen`
        (n,), from which a `member` (n,) learns."""
        at = bucket.x[chosen[:, None], picked].requires_grad_(True)
        of_members = energies_of_many(model.network, bucket, chosen, at)
        found = self.scale * of_members.gather(2, member[:, None, None].expand(-1, self.rows, 1))[..., 0]
        (gradient,) = torch.autograd.grad(found.sum(), at, create_graph=True)
        wrong = (gradient + bucket.forces[chosen[:, None], picked]) / (10.0 * self.scale)
        real = (bucket.elements[chosen] > 0)[:, None]
        of_forces = ((wrong.square().sum(-1) + 1e-8).sqrt() * real).sum() / real.sum() / self.rows
        off = (found - bucket.energies[chosen[:, None], picked]) / self.scale
        uneven = ((off - off.mean(1, keepdim=True)).square() + 1e-8).sqrt().mean(1)
        return torch.stack([of_forces, ENERGY_WEIGHT * (uneven / real.sum((1, 2)) ** 0.5).mean()])

    def errors(self) -> dict[str, float]:
        found = torch.cat([errors_of_many(self.model, bucket) for bucket in self.held])
        force, energy = found.mean(0).tolist()
        return {"validation_force_kcal": force, "validation_energy_kcal_atom": energy}


def errors_of_many(model: PainetPotential, bucket: Bucket, most: int = HELD_STATES) -> Tensor:
    """Return by molecule the first two of `errors_of`: (n, 2)."""
    found = []
    for chosen in torch.arange(len(bucket.charge), device=bucket.x.device).split(8):
        picked = torch.arange(most, device=bucket.x.device) % bucket.n_states[chosen, None]
        at = bucket.x[chosen[:, None], picked].requires_grad_(True)
        energies = float(model.energy_scale_kj_mol) * energies_of_many(model.network, bucket, chosen, at).mean(-1)
        (gradient,) = torch.autograd.grad(energies.sum(), at)
        n_atoms = (bucket.elements[chosen] > 0).sum(1)
        wrong = (gradient + bucket.forces[chosen[:, None], picked]).abs().sum((1, 2, 3)) / (3.0 * most * n_atoms)
        off = energies.detach() - bucket.energies[chosen[:, None], picked]
        uneven = (off - off.mean(1, keepdim=True)).abs().mean(1) / n_atoms
        found.append(torch.stack([wrong / KJ_MOL_NM_PER_KCAL_MOL_A, uneven / KJ_MOL_PER_KCAL], dim=-1))
    return torch.cat(found).cpu()


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
    for k, one in enumerate(learned):
        model.network.set_walls(one.positions_nm, one.topology, widen=k > 0)


def train(given: argparse.Namespace) -> None:
    torch.manual_seed(SEED)
    sums = dict(zip(SUMS, given.sums, strict=True))
    config = PotentialConfig(width=given.width, n_steps=given.steps_of_network, **sums)
    model, domain = PainetPotential(config), None
    if given.start:
        weights = load_weights(given.start)
        assert isinstance(weights.model, PainetPotential)
        config, domain = weights.model.config, weights.domain
        model = PainetPotential(config)
        model.load_state_dict(weights.model.state_dict())
    learned, held = load(given.folder, ["train"], given.most, given.states), load(given.folder, ["test"])
    said(f"{len(learned)} molecules with {sum(len(s.energies) for s in learned):,} states, {len(held)} held out; "
         f"{sum(p.numel() for p in model.parameters()):,} parameters")  # fmt: skip
    set_walls(model, learned)
    if domain is None:
        forces = torch.cat([s.forces.square().mean((1, 2)) for s in learned])
        model.energy_scale_kj_mol.fill_(0.1 * float(forces.median().sqrt()))
        model.energy_offset_kj_mol.zero_()
        domain = load_weights(given.like).domain if given.like else domain_of(learned, config)
    device = torch.device(choose_device(given.device))
    torch.set_float32_matmul_precision("high")
    learner = Learner(model.to(device), learned, held, given.molecules, given.rows, device)
    stage = StageConfig("potential", given.molecules * given.rows, given.rate, given.budget, given.steps, seed=SEED,
                        bf16=False, matrix_rate=5.0 * given.rate, validate_every_s=given.validate)  # fmt: skip

    def write(spent_s: list[float]) -> None:
        sources = [{"file": "docs/studies/training/drug_like.tsv", "n_frames": sum(len(s.energies) for s in learned)}]
        found = {"seed": SEED, "training_s": round(sum(spent_s), 1), **learner.errors()}
        provenance = provenance_of({"reference_ns": 0.0, "sources": sources}, found)
        save_weights(given.out, model, domain, provenance)

    def progress(name: str, share: float, metrics: dict[str, float]) -> None:
        if metrics:
            said(f"{100 * share:.1f} %: " + ", ".join(f"{k} {v:.4g}" for k, v in metrics.items()))

    with torch_threads(given.threads):
        train_stages([Stage(model, stage, learner.loss, learner.errors)], given.out, write, device=device,
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


def print_effective(given: argparse.Namespace) -> None:
    model = load_weights(given.weights).model
    assert isinstance(model, PainetPotential)
    rows = []
    entries = read_list()
    named, unseen = ([e for e in entries if e.split == split] for split in ("named", "test"))
    for entry in (named + unseen)[: given.molecules]:
        scene = prepare(f"smiles:{entry.smiles}")
        reference = Potential(scene)
        starts = np.stack(conformers(scene, entry.smiles, SEED))
        x = rolled_states(scene, given.weights, starts, SEED)[ROLLED_REPLICAS:]  # at 300 K
        own = model.energies(torch.from_numpy(x), Molecule.of(scene)).mean(-1).detach().numpy()
        off = np.array([reference(state)[0] for state in x]) - own
        share = reweighting(off, 300.0)[1] / len(off)
        rows.append((off.std(), share))
        said(f"{entry.smiles}: off by {off.std():.1f} kJ/mol, {100 * share:.0f} % effective")
    off_by, shares = np.median(rows, axis=0)
    said(f"{len(rows)} molecules: off by {off_by:.1f} kJ/mol, {100 * shares:.0f} % effective (medians)")


def stays_whole(weights: Weights, scene: Scene, time_ps: float, out: Path) -> float:
    """Return the share of replicas whose frames are all valid after so long. What was stopped goes on; what a lost
    replica ended does not."""
    first = replica_paths(out, REPLICAS)[0]
    if first.exists() and not checkpoint_path(first).exists():
        with open_trajectory(first) as reader:
            if not reader.record["completed"]:
                return 0.0
    try:
        files = sm.rollout(scene, weights.path, out, time_ps=time_ps, save_every_ps=1.0, guard="flag", force=True,
                           replicas=REPLICAS, seed=SEED, quiet=True,
                           resume=first.exists())  # fmt: skip
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
            scene = prepare(f"smiles:{one.entry.smiles}")
            stepped = in_step(weights, scene).model
            assert isinstance(stepped, PainetPotential)
            spread, n_lost = disagreement(scene, stepped)
            whole = stays_whole(weights, scene, given.time, given.folder / f"trust_{read_list().index(one.entry)}.h5")
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


def stability(given: argparse.Namespace) -> None:
    """Roll molecules that are held out, but those that are refused; prepared scenes are kept in the folder."""
    weights = load_weights(given.weights)
    refused, whole = 0, []
    for k, one in enumerate(load(given.folder, ["test"], given.molecules)):
        if given.places and k not in given.places:
            continue
        kept, out = given.folder / f"scene_{k}.json", given.folder / f"stability_{k}.h5"
        try:
            if not kept.exists():
                kept.write_text(json.dumps(prepare(f"smiles:{one.entry.smiles}").to_dict()))
            match_domain(scene := Scene.from_dict(json.loads(kept.read_text())), weights)
        except SurromdError as error:
            refused += 1
            said(f"{k} {one.entry.smiles}: refused: {getattr(error, 'brief', error)}")
            continue
        whole.append(stays_whole(weights, scene, given.time, out))
        said(f"{k} {one.entry.smiles}: {100 * whole[-1]:.0f} % of replicas whole")
    said(f"{len(whole)} molecules rolled for {given.time:g} ps in {REPLICAS} replicas, {refused} refused: "
         f"{sum(w == 1.0 for w in whole)} without a replica lost")  # fmt: skip


def tune(given: argparse.Namespace) -> None:
    """Print errors of forces in MD at 300 and 500 K, by GAFF2, after so much training on one molecule, as
    `surromd train` does it; keep the weights."""
    for one in load(given.folder, ["test"], given.molecules):
        number, found = read_list().index(one.entry), []
        scene = prepare(f"smiles:{one.entry.smiles}")
        with Labeller(scene) as reference:
            asked = reference.label(np.concatenate([reference.motion(40, 1.0, t, seed=SEED) for t in TUNED_K]))
        for seconds in (0.0, *given.seconds):
            weights = given.weights
            if seconds:
                weights = given.folder / f"tuned_{number}_{seconds:g}s.safetensors"
                if not weights.exists():
                    sm.train(f"smiles:{one.entry.smiles}", weights, level="gfn2-xtb", start_from=given.weights,
                             budget_s=seconds, seed=SEED, quiet=True)  # fmt: skip
            model = load_weights(weights).model
            assert isinstance(model, PainetPotential)
            forces = model.evaluate(torch.from_numpy(asked.positions_nm), Molecule.of(scene)).forces_kj_mol_nm
            off = np.abs(forces.numpy() - asked.forces_kj_mol_nm).mean() / KJ_MOL_NM_PER_KCAL_MOL_A
            found.append(f"{seconds:g} s {off:.2f}")
        said(f"{one.entry.smiles}: {', '.join(found)} kcal/mol/Å")


def said(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    names = ("train", "errors", "effective", "trust", "stability", "tune")
    training, errors, counting, trusting, staying, tuning = (verbs.add_parser(name) for name in names)
    for part in (errors, counting, trusting, staying, tuning):
        part.add_argument("weights", type=Path)
    for part in (training, errors, trusting, staying, tuning):
        part.add_argument("folder", type=Path)
    tuning.add_argument("--seconds", type=float, nargs="+", default=[60.0, 180.0])
    tuning.add_argument("--molecules", type=int, default=10)
    staying.add_argument("--molecules", type=int, default=50)
    staying.add_argument("--places", type=int, nargs="+", help="only these of them")
    counting.add_argument("--molecules", type=int, default=18)
    for part in (trusting, staying):
        part.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=250.0)
    training.add_argument("--width", type=int, default=96)
    training.add_argument("--steps-of-network", type=int, default=2)
    training.add_argument("--sums", type=int, nargs=3, default=[16, 8, 4], help="scalars, vectors, tensors of a look")
    training.add_argument("--device", default="auto")
    training.add_argument("--like", type=Path, help="weights whose domain these get, where RDKit and OpenMM are not")
    training.add_argument("--start", type=Path, help="weights to begin from, with their domain")
    training.add_argument("--rate", type=float, default=2e-3)
    training.add_argument("-o", "--out", type=Path, required=True)
    training.add_argument("--budget", type=lambda text: parse_wall_s(text, "--budget"))
    training.add_argument("--steps", type=int)
    training.add_argument("--resume", action="store_true")
    training.add_argument("--molecules", type=int, default=4)
    training.add_argument("--rows", type=int, default=24)
    training.add_argument("--most", type=int, help="molecules to train on")
    training.add_argument("--states", type=int, help="states of each")
    training.add_argument("--threads", type=int, default=1)
    training.add_argument("--validate", type=float, default=300.0)
    given = parser.parse_args()
    verb = {
        "train": train,
        "errors": print_errors,
        "effective": print_effective,
        "trust": trust,
        "stability": stability,
        "tune": tune,
    }
    verb[given.verb](given)


if __name__ == "__main__":
    main()
