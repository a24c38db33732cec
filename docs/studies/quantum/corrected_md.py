"""Long sampling at GFN2-xTB's own law: MD by a potential, accepted or refused by GFN2-xTB every 0.6 ps.

    python docs/studies/quantum/corrected_md.py WEIGHTS OUT.h5 [--time 2.5ns] [--replicas 16] [--seed 1]
        [--turn 6,7,8,17]

Generalised hybrid Monte Carlo (Horowitz, Phys. Lett. B 268, 247 (1991)): velocities are refreshed as friction of 1/ps
does it, RATTLE moves a molecule by the potential for 0.6 ps (3 fs, hydrogens of 3 Da, their bonds rigid), GFN2-xTB's
energy of both ends decides; what is refused turns back. Frames follow GFN2-xTB's Boltzmann law at 300 K whatever the
potential is: a wrong one is refused more often. A ns costs a twentieth of MD by GFN2-xTB or less, so that references of
tens of ns can be had. Replicas start with torsions turned at random and settle for 0.25 ns. What is there goes on.
With `--turn` half a turn about the middle bond of four atoms is offered after each piece, too: such chains know the
sides of a torsion that seldom turns, and have no times of their own.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from md_reference.forces.quantum import Potential
from surrogate.models.architecture import weights_path
from surrogate.models.painet.painet_potential import PainetPotential
from surrogate.models.propagator import Molecule
from surrogate.models.weights import Weights, load_weights
from systems.chemistry.graph import bonded_graph, rotatable_torsions, turned
from systems.errors import PreparationError
from systems.scene import FloatArray, Scene
from systems.trajectory.codec import open_trajectory, open_writer
from systems.units import GAS_CONSTANT_KJ_MOL_K, parse_time_ps

TEMPERATURE_K, FRICTION_PER_PS, TIMESTEP_PS, PIECE_PS = 300.0, 1.0, 0.003, 0.6
SAVE_PS, DISCARDED_PS = 0.6, 250.0
# Frames of a replica that are written at once.
TOGETHER = 50
_OUT_OF_REACH = 1e9

# States (rows, n_atoms, 3) nm and nm/ps -> those a piece later; velocities -> those the bonds allow; energies in kJ/mol
Move = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
Allow = Callable[[Tensor, Tensor], Tensor]
Energies = Callable[[Tensor], Tensor]
# Positions -> others of the same law of volume; done twice it leads back
Turn = Callable[[Tensor], Tensor]


class Chain:
    """Replicas `(rows, n_atoms, 3)` nm, of `masses` (n_atoms, 1) Da, that follow the Boltzmann law of `energies`."""

    def __init__(self, x: Tensor, masses: Tensor, energies: Energies, move: Move, allow: Allow, seed: int,
                 turn: Turn | None = None) -> None:  # fmt: skip
        self.energies, self.move, self.allow, self.masses, self.turn = energies, move, allow, masses, turn
        self.kt = GAS_CONSTANT_KJ_MOL_K * TEMPERATURE_K
        self.generator = torch.Generator().manual_seed(seed)
        self.kept = float(np.exp(-FRICTION_PER_PS * PIECE_PS))
        self.x, self.energy = x, energies(x)
        self.v = self._drawn()
        self.accepted = self.asked = self.turned = 0
        self.moves = torch.zeros(len(x), dtype=torch.bool)

    def _drawn(self) -> Tensor:
        drawn = torch.randn(self.x.shape, generator=self.generator, dtype=self.x.dtype)
        drawn = (self.kt / self.masses).sqrt() * drawn
        drawn = drawn - (self.masses * drawn).sum(1, keepdim=True) / self.masses.sum()
        return self.allow(drawn, self.x)

    def _kinetic(self, v: Tensor) -> Tensor:
        return 0.5 * (self.masses * v.square()).sum((1, 2))

    def step(self) -> None:
        """Refresh, move, accept or turn back."""
        v = self.kept * self.v + (1.0 - self.kept**2) ** 0.5 * self._drawn()
        x, moved = self.move(self.x, v)
        energy = self.energies(x)
        taken = self._taken(energy + self._kinetic(moved) - self.energy - self._kinetic(v))
        self._put(taken, x, energy, moved, -v)
        self.moves |= taken
        self.accepted, self.asked = self.accepted + int(taken.sum()), self.asked + len(taken)
        if self.turn is not None:
            x = self.turn(self.x)
            energy = self.energies(x)
            taken = self._taken(energy - self.energy)
            self._put(taken, x, energy, self.v, self.v)
            self.v = torch.where(taken[:, None, None], self._drawn(), self.v)
            self.turned += int(taken.sum())

    def free(self) -> int:
        """Put replicas that never moved, whose start is too strained, where others are; return how many."""
        stuck = torch.nonzero(~self.moves).flatten()
        free = torch.nonzero(self.moves).flatten()
        if not len(free):
            raise SystemExit("No replica moves: these weights are too far from GFN2-xTB.")
        others = free[torch.arange(len(stuck)) % len(free)]
        for values in (self.x, self.v, self.energy):
            values[stuck] = values[others]
        return len(stuck)

    def _taken(self, rise: Tensor) -> Tensor:
        chance = torch.rand(len(rise), generator=self.generator, dtype=rise.dtype)
        return chance.log() < -rise / self.kt

    def _put(self, taken: Tensor, x: Tensor, energy: Tensor, v: Tensor, otherwise: Tensor) -> None:
        self.x = torch.where(taken[:, None, None], x, self.x)
        self.v = torch.where(taken[:, None, None], v, otherwise)
        self.energy = torch.where(taken, energy, self.energy)


def energies_of(scene: Scene) -> Energies:
    """Return what asks GFN2-xTB; where it finds no ground state nothing is accepted."""
    reference = Potential(scene)

    def energy(at: FloatArray) -> float:
        try:
            return reference(at)[0]
        except PreparationError:
            return _OUT_OF_REACH

    return lambda x: torch.tensor([energy(at) for at in x.numpy()], dtype=x.dtype)


def half_turn(scene: Scene, quad: list[int]) -> Turn:
    """Return half a turn about the middle bond of `quad`, which must be in no ring."""
    graph = bonded_graph(scene)
    return lambda x: torch.from_numpy(np.stack([turned(at, quad, np.pi, graph) for at in x.numpy()]))


def chain_of(weights: Weights, x: FloatArray, seed: int, quad: list[int] | None = None) -> Chain:
    """Return replicas of a potential's molecule from positions `(rows, n_atoms, 3)` nm; `quad`: a torsion to turn."""
    scene, model = weights.domain.scene, weights.model
    assert isinstance(model, PainetPotential)
    model = model.eval().requires_grad_(False)
    model.config = replace(model.config, timestep_ps=TIMESTEP_PS, hydrogen_mass_da=3.0, ensemble="nve")
    rigid = model.features(scene)
    assert rigid is not None
    molecule = replace(Molecule.of(scene), own=rigid)
    masses = model.masses_da(molecule)[:, None]
    still = torch.zeros(len(x), scene.n_atoms, round(PIECE_PS / TIMESTEP_PS), 3)

    def move(x: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return model.verlet(x, v, molecule, masses, masses, still)

    placed = rigid.place(torch.tensor(x), torch.tensor(x))
    turn = None if quad is None else half_turn(scene, quad)
    return Chain(placed, masses, energies_of(scene), move, rigid.project, seed, turn)


def starts(scene: Scene, replicas: int, seed: int) -> FloatArray:
    """Return positions `(replicas, n_atoms, 3)` nm with every torsion turned at random, atoms apart."""
    rng, graph, found = np.random.default_rng(seed), bonded_graph(scene), []
    near = np.linalg.norm(scene.positions_nm[:, None] - scene.positions_nm[None], axis=-1)
    least = near[np.triu_indices(scene.n_atoms, 1)].min()
    while len(found) < replicas:
        at = scene.positions_nm
        for quad in rotatable_torsions(scene, rotors=True).tolist():
            at = turned(at, quad, float(rng.uniform(0.0, 2.0 * np.pi)), graph)
        apart = np.linalg.norm(at[:, None] - at[None], axis=-1)[np.triu_indices(scene.n_atoms, 1)]
        if apart.min() > 0.9 * least:
            found.append(at)
    return np.stack(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights")
    parser.add_argument("out", type=Path)
    parser.add_argument("--time", type=lambda text: parse_time_ps(text, "--time"), default=2_500.0)
    parser.add_argument("--replicas", type=int, default=16)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--turn", type=lambda text: [int(atom) for atom in text.split(",")])
    given = parser.parse_args()
    torch.set_num_threads(1)
    weights = load_weights(weights_path(given.weights))
    scene = weights.domain.scene
    paths = [given.out.with_name(f"{given.out.stem}_r{k}.h5") for k in range(given.replicas)]
    goes_on = paths[-1].is_file()
    if goes_on:
        lasts = []
        for path in paths:
            with open_trajectory(path) as reader:
                lasts.append(reader.read()[-1].astype(np.float64))
        chain = chain_of(weights, np.stack(lasts), given.seed + 1_000, given.turn)
    else:
        chain = chain_of(weights, starts(scene, given.replicas, given.seed), given.seed, given.turn)
        for _ in range(round(DISCARDED_PS / PIECE_PS)):
            chain.step()
        sys.stdout.write(f"{chain.free()} of {given.replicas} replicas never left their start and begin elsewhere\n")
    record = {"made_by": "docs/studies/quantum/corrected_md.py", "lag_ps": SAVE_PS, "temperature_k": TEMPERATURE_K}
    writers = [open_writer(path, scene, record, append=goes_on) for path in paths]
    n_frames = min(writer.n_frames for writer in writers)
    for writer in writers:
        writer.truncate(n_frames)
    while n_frames * SAVE_PS < given.time:
        frames = []
        for _ in range(TOGETHER):
            for _ in range(round(SAVE_PS / PIECE_PS)):
                chain.step()
            frames.append(chain.x.numpy().copy())
        times_ps = SAVE_PS * (n_frames + 1 + np.arange(TOGETHER))
        for writer, run in zip(writers, np.stack(frames, axis=1), strict=True):
            writer.append(run, times_ps)
        n_frames += TOGETHER
        taken, turned_ = chain.accepted / chain.asked, chain.turned / chain.asked
        sys.stdout.write(f"{n_frames * SAVE_PS:.0f} ps: {taken:.1%} accepted, {turned_:.1%} turned\n")
        sys.stdout.flush()
    for writer in writers:
        writer.close()


if __name__ == "__main__":
    main()
