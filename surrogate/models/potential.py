"""The protocol of models that give energies and forces, and the MD that rolls a molecule on them."""

from __future__ import annotations

import copy
import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from surrogate.models.architecture import ModelConfig
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.chemistry.graph import beyond, bonded_graph, rotatable_torsions
from systems.chemistry.validity import geometry_from_scene
from systems.errors import InputError
from systems.scene import FloatArray, Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K, whole_steps

# Frames (rows, n_atoms, 3) nm -> the members' energies (rows, n_members)
EnergyFn = Callable[[Tensor], Tensor]
# The same -> these energies, and the gradient (rows, n_atoms, 3) of their mean
GradientFn = Callable[[Tensor], tuple[Tensor, Tensor]]

_HYDROGEN = 1
_RELAXED_ROUNDS = 100
LONGEST_FLEXIBLE_PS = 0.002
# Of a squared length, and of a velocity along a bond in nm^2/ps; rounds until they are met.
TOLERANCE = 1e-9
ROUNDS = 50


@dataclass(frozen=True)
class IntegratorConfig(ModelConfig):
    """Settings of the MD on a potential, which a potential's own configuration extends.

    A chunk is `n_new` frames `lag_ps` apart, in steps of `timestep_ps`, in a Langevin bath at `temperature_k`
    with `friction_per_ps`, or with `ensemble` 'nve' without one; hydrogens weigh `hydrogen_mass_da`, if any is given.
    As of reference MD, steps are of 4 fs, hydrogens of 3 Da and their bonds rigid (`constrain_hydrogens`). Before each
    frame so many `torsion_moves` of Monte Carlo are tried.
    """

    n_new: int = 10
    lag_ps: float = 0.1
    timestep_ps: float = 0.004
    temperature_k: float = 300.0
    friction_per_ps: float = 1.0
    ensemble: str = "nvt"
    hydrogen_mass_da: float | None = 3.0
    torsion_moves: int = 0

    def __post_init__(self) -> None:
        if self.ensemble not in ("nvt", "nve"):
            raise InputError(f"ensemble = {self.ensemble!r} is unknown to a learned potential; choose nvt or nve.")
        if self.torsion_moves and self.ensemble == "nve":
            raise InputError("torsion moves are of a temperature: leave `torsion_moves` out, or the ensemble 'nve'.")
        if self.n_new < 1:
            raise InputError(f"n_new = {self.n_new} must be at least 1.")

    @property
    def constrain_hydrogens(self) -> bool:
        """Whether bonds to hydrogen are rigid, as reference MD's are: at steps above 2 fs."""
        return self.timestep_ps > LONGEST_FLEXIBLE_PS


class Evaluation(NamedTuple):
    """`energy_kj_mol` (rows,) and `forces_kj_mol_nm` (rows, n_atoms, 3), the mean of the members; `members_kj_mol`
    (rows, n_members)."""

    energy_kj_mol: Tensor
    forces_kj_mol_nm: Tensor
    members_kj_mol: Tensor


class Bath(NamedTuple):
    """Langevin middle steps of `timestep_ps`, velocities `kept` in each and `lost` (rows, n_atoms, 1) times what is
    drawn; `masses` (n_atoms, 1) in Da; `rigid` bonds, if any."""

    timestep_ps: float
    kept: float
    lost: Tensor
    masses: Tensor
    rigid: RigidBonds | None


class Turns(NamedTuple):
    """Bonds that torsion moves turn: their two atoms `ends` (k, 2), and which atoms turn with the second, `side`
    (k, n_atoms), the fewer; and `pairs` (m, 2) of atoms more than three bonds apart, which overlap nearer than
    `least_nm` (m,)."""

    ends: Tensor
    side: Tensor
    pairs: Tensor
    least_nm: Tensor

    @staticmethod
    def of(scene: Scene) -> Turns:
        """Return a molecule's rotatable bonds, hydroxyl's and the like among them, but not those of methyl's kind, nor
        of unknown order, which may be double."""
        graph, ends, sides = bonded_graph(scene), [], []
        for quad in rotatable_torsions(scene, rotors=True).tolist():
            for last, fixed in (quad[1:3], quad[2:0:-1]):
                side = beyond(graph, fixed, last)
                if 2 * len(side) <= scene.n_atoms:
                    break
            if graph.edges[fixed, last]["order"] and not (
                len(side) == len(graph[last]) == 4 and len({scene.elements[i] for i in side - {last}}) == 1
            ):
                ends.append((fixed, last))
                sides.append([i in side for i in range(scene.n_atoms)])
        contacts = geometry_from_scene(scene)
        least_nm = torch.tensor(contacts.clash_pair_min_nm)
        bonds = torch.tensor(ends).reshape(-1, 2), torch.tensor(sides).reshape(-1, scene.n_atoms)
        return Turns(*bonds, torch.tensor(contacts.clash_idx), least_nm)

    def to(self, device: torch.device) -> Turns:
        return Turns(*(tensor.to(device) for tensor in self))

    def overlap(self, x_nm: Tensor) -> Tensor:
        """Return in which frames `(rows, n_atoms, 3)` atoms overlap."""
        first, second = self.pairs.T
        return ((x_nm[:, first] - x_nm[:, second]).norm(dim=-1) < self.least_nm).any(-1)

    def turned(self, x_nm: Tensor, v: Tensor, which: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Return frames and velocities `(rows, n_atoms, 3)`, each turned about bond `which` (rows,) by `angle` (rows,),
        radian: rigid parts stay rigid, and move on as they did."""
        rows = torch.arange(len(x_nm))
        first, second = (x_nm[rows, self.ends[which, k]][:, None] for k in (0, 1))
        axis = torch.nn.functional.normalize(second - first, dim=-1).expand_as(x_nm)
        cos, sin, side = angle.cos()[:, None, None], angle.sin()[:, None, None], self.side[which][..., None]

        def turn(arm: Tensor) -> Tensor:
            along = (arm * axis).sum(-1, keepdim=True) * axis
            return cos * (arm - along) + sin * torch.linalg.cross(axis, arm) + along

        return torch.where(side, second + turn(x_nm - second), x_nm), torch.where(side, turn(v), v)


class Own(NamedTuple):
    """What the MD of a molecule needs beside its atoms: `rigid` bonds and bonds that torsion moves turn, if any."""

    rigid: RigidBonds | None
    turns: Turns | None

    def to(self, device: torch.device) -> Own:
        return Own(self.rigid and self.rigid.to(device), self.turns and self.turns.to(device))


class Potential(Propagator):
    """Energies and forces: a learned potential, which is a propagator by the MD that is run on it.

    A subclass sets `arch` and `config` (an `IntegratorConfig` or what extends it) and implements `energies`, a
    differentiable function of positions; forces are its exact gradient. Masses, rigid bonds to hydrogen, thermostat and
    chunks are here: Langevin middle (Zhang 2019) or velocity Verlet, in double precision, with the centre of mass at
    rest. It may override `gradient` where it has a faster one than torch's, and `featurise`, whose `own` is then an
    `Own` or None.

    Beside what holds for every propagator (`surrogate.models.conformance`), the energy does not depend on where the
    molecule lies, how it is turned and what is evaluated beside it, and is finite and smooth wherever MD may lead it.
    """

    config: Any
    _rest: tuple[tuple[int, int], list[Tensor], Tensor] | None = None

    @abstractmethod
    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Return the potential energy of frames.

        Args:
            positions_nm: `(rows, n_atoms, 3)`, nm, float64.
            molecule: what `featurise` returned, or `Molecule.of`.

        Returns:
            `(rows, n_members)`, kJ/mol, float64, with gradients: one column, or one for each member of an ensemble,
            whose mean is the potential and whose spread says where it is unsure.
        """

    def gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        """Return what computes the members' energies and their mean's gradient at frames like these."""
        return self.exact_gradient(positions_nm, molecule)

    def exact_gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        """Return the same in the precision of the positions, which SIMD has not."""
        return gradient_of(lambda x: self.energies(x, molecule))

    def evaluate(self, positions_nm: Tensor, molecule: Molecule) -> Evaluation:
        """Frames `(rows, n_atoms, 3)` nm, in double precision for forces to the last digit -> energies and forces."""
        members, gradient = gradient_of(lambda x: self.energies(x, molecule))(positions_nm)
        return Evaluation(members.mean(-1), -gradient, members)

    def forces(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> forces, with what depends on the molecule alone kept from call to call."""
        return -self.gradient(positions_nm, molecule)(positions_nm)[1]

    @property
    def n_new(self) -> int:
        return int(self.config.n_new)

    @property
    def steps_per_frame(self) -> int:
        return whole_steps(self.config.lag_ps, self.config.timestep_ps, "frame spacing in time steps")

    def in_bath(self, changes: dict[str, Any]) -> Self:
        """Return this model, its weights shared, with other settings of the MD, by the names of `IntegratorConfig`.
        Raises InputError and UnitError for settings that do not go together."""
        model = copy.copy(self)
        model.config = replace(self.config, **changes)
        _ = model.steps_per_frame
        return model

    def featurise(self, scene: Scene) -> Molecule:
        """See `Propagator.featurise`; bonds to hydrogen are as long as at the nearest minimum of the energy, and not
        rigid at short steps."""
        molecule, rigid = Molecule.of(scene), None
        bonds = [pair for pair in molecule.bonds.tolist() if any(molecule.elements[i] == _HYDROGEN for i in pair)]
        if self.config.constrain_hydrogens and bonds:
            rest_nm = self._minimum_nm(torch.tensor(scene.positions_nm, dtype=torch.float64), molecule)
            rigid = RigidBonds.of(rest_nm, torch.tensor(bonds), self.masses_da(molecule))
        turns = Turns.of(scene) if self.config.torsion_moves else None
        return replace(molecule, own=Own(rigid, turns if turns is not None and len(turns.ends) else None))

    def _minimum_nm(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Return the nearest minimum `(n_atoms, 3)` nm. The last is kept: a scene is asked for several times."""
        asked = sum(p._version for p in self.parameters()), int(molecule.charge)
        of = [positions_nm, molecule.elements, molecule.bonds]
        if self._rest is None or self._rest[0] != asked or not all(map(torch.equal, self._rest[1], of)):
            # torch's own L-BFGS takes two seconds to import what it compiles with.
            from scipy.optimize import minimize

            compute = self.exact_gradient(positions_nm[None], molecule)

            def energy(flat: FloatArray) -> tuple[float, FloatArray]:
                members, gradient = compute(torch.from_numpy(flat).view(1, -1, 3))
                return float(members.mean()), gradient.numpy().ravel()

            found = minimize(energy, positions_nm.numpy().ravel(), jac=True, method="L-BFGS-B",
                             options={"maxiter": _RELAXED_ROUNDS})  # fmt: skip
            self._rest = asked, of, torch.from_numpy(found.x).view(-1, 3)
        return self._rest[2]

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        """One vector an atom for the first velocities, then for each step; before a frame's steps those of its torsion
        moves."""
        return (n_atoms, 1 + self.n_new * (self.config.torsion_moves + self.steps_per_frame), 3)

    def masses_da(self, molecule: Molecule) -> Tensor:
        """Masses `(n_atoms,)` that move: hydrogens as heavy as the settings have them, at the cost of their bond's
        other end."""
        masses, heavy = molecule.masses_da.double().clone(), self.config.hydrogen_mass_da
        if heavy is not None:
            for i, j in [*molecule.bonds.tolist(), *molecule.bonds.flip(1).tolist()]:
                if molecule.elements[i] == _HYDROGEN != molecule.elements[j]:
                    masses[j] -= heavy - molecule.masses_da[i]
                    masses[i] = heavy
            if bool((masses <= 0.0).any()):
                raise InputError(f"`hydrogen_mass_da={heavy:g}` leaves a heavy atom no mass; use less.")
        return masses

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`: MD on the potential."""
        with torch.inference_mode(False):
            x, draws = last_frames_nm[:, -1].clone().double(), noise.clone().double()
            masses = self.masses_da(molecule)[:, None]
            thermal = (GAS_CONSTANT_KJ_MOL_K * self.config.temperature_k / masses).sqrt()
            drawn = at_rest(thermal * draws[:, :, 0], masses)
            if (rigid := self._rigid(molecule, self.config.timestep_ps)) is not None:
                x = rigid.place(x, x)
                drawn = rigid.project(drawn, x)
            v = drawn if last_velocities_nm_ps is None else last_velocities_nm_ps.clone().double()
            frames = []
            move = self.verlet if self.config.ensemble == "nve" else self.langevin
            for of_frame in draws[:, :, 1:].chunk(self.n_new, dim=2):
                turning, draw = of_frame.tensor_split([self.config.torsion_moves], dim=2)
                if molecule.own is not None and molecule.own.turns is not None:
                    x, v = self._turned(x, v, molecule, masses, turning)
                x, v = move(x, v, molecule, masses, thermal, draw)
                frames.append(x)
            found = torch.stack(frames, dim=1).to(last_frames_nm.dtype)
            return Chunk(found, v.to(found.dtype), float(draws.shape[2] - 1))

    def _turned(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, draw: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and velocities `(rows, n_atoms, 3)` after moves of Metropolis et al., J. Chem. Phys. 21,
        1087 (1953), which leave the Boltzmann distribution as it is: what is beyond one bond turns by any angle, its
        velocities with it, and stays so with the probability exp(-dU / kT). `draw` (rows, n_atoms, n_moves, 3): normal
        numbers, of which those of the first two atoms are used.

        No move ends where atoms overlap (`validity.CLASH_NM`), nearer than thermal frames come: there learned energies
        have holes. This changes the populations of such states alone, which guards reject.
        """
        turns, before, kt = molecule.own.turns, x, GAS_CONSTANT_KJ_MOL_K * self.config.temperature_k
        # A part's velocities turn with those of all that it moves along with: with the molecule at rest as a whole,
        # each move would cool it.
        v = v + (kt / masses.sum()).sqrt() * draw[:, 1:2, 0]
        now = self.gradient(x, molecule)(x)[0].mean(-1)
        for which, angle, chance in torch.special.ndtr(draw[:, 0]).permute(1, 2, 0):
            bond = (which * len(turns.ends)).long().clamp(max=len(turns.ends) - 1)
            there, moving = turns.turned(x, v, bond, 2.0 * math.pi * angle)
            then = self.gradient(there, molecule)(there)[0].mean(-1)
            taken = (chance.log() * kt < now - then) & ~turns.overlap(there)
            x, v = (torch.where(taken[:, None, None], a, b) for a, b in ((there, x), (moving, v)))
            now = torch.where(taken, then, now)
        # The centre of mass stays where it was.
        return x + (masses / masses.sum() * (before - x)).sum(1, keepdim=True), at_rest(v, masses)

    def bath(self, molecule: Molecule, masses: Tensor, thermal: Tensor, timestep_ps: float | None = None) -> Bath:
        """Return the bath of the settings; `thermal`: see `langevin`."""
        dt = timestep_ps or self.config.timestep_ps
        kept = math.exp(-self.config.friction_per_ps * dt)
        return Bath(dt, kept, math.sqrt(1.0 - kept * kept) * thermal, masses, self._rigid(molecule, dt))

    def langevin(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, thermal: Tensor, draw: Tensor, *,
                 timestep_ps: float | None = None) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return positions nm and velocities nm/ps `(rows, n_atoms, 3)` after the steps that `draw` (rows, n_atoms,
        n_steps, 3) holds normal numbers for, by the Langevin middle scheme: kick, half a drift, bath, half a drift.

        `thermal`: what velocities are at the bath's temperature, root mean square; the centre of mass is at rest.
        """
        bath = self.bath(molecule, masses, thermal, timestep_ps)
        dt, rigid = bath.timestep_ps, bath.rigid
        v = at_rest(v, masses)
        for k in range(draw.shape[2]):
            v = v + dt * self.forces(x, molecule) / masses
            if rigid is not None:
                v = rigid.project(v, x)
            free = x + 0.5 * dt * v
            v = at_rest(bath.kept * v + bath.lost * draw[:, :, k], masses)
            x, v = _drift(x, free, v, 0.5 * dt, rigid, dt)
        return x, v

    def verlet(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, thermal: Tensor, draw: Tensor
               ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The same by velocity Verlet, a leapfrog that shows velocities at full steps; without a bath."""
        dt = self.config.timestep_ps
        rigid = self._rigid(molecule, dt)
        force = self.forces(x, molecule)
        for _ in range(draw.shape[2]):
            v = v + 0.5 * dt * force / masses
            x, v = _drift(x, x, v, dt, rigid, dt)
            force = self.forces(x, molecule)
            v = v + 0.5 * dt * force / masses
            if rigid is not None:
                v = rigid.project(v, x)
        return x, v

    @staticmethod
    def _rigid(molecule: Molecule, timestep_ps: float) -> RigidBonds | None:
        return molecule.own.rigid if molecule.own is not None and timestep_ps > LONGEST_FLEXIBLE_PS else None


def at_rest(v: Tensor, masses: Tensor) -> Tensor:
    """Return velocities `(rows, n_atoms, 3)` without that of the centre of mass; `masses` (n_atoms, 1)."""
    return v - (masses / masses.sum() * v).sum(-2, keepdim=True)


def _drift(before: Tensor, x: Tensor, v: Tensor, ahead_ps: float, rigid: RigidBonds | None, step_ps: float
           ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return positions `ahead_ps` after `x`, and velocities; where bonds are rigid, placed along those of `before`,
    `step_ps` ago, and the velocities that this takes."""
    free = x + ahead_ps * v
    if rigid is None:
        return free, v
    placed = rigid.place(free, before)
    return placed, v + (placed - free) / step_ps


def gradient_of(energy: EnergyFn) -> GradientFn:
    """Return the function that computes energies and the gradient of the members' mean, detached."""

    def compute(positions_nm: Tensor) -> tuple[Tensor, Tensor]:
        # In bf16 energies would be steps, and their gradient heat.
        with torch.inference_mode(False), torch.enable_grad(), torch.autocast(positions_nm.device.type, enabled=False):
            x = positions_nm.detach().clone().requires_grad_(True)
            members = energy(x)
            (gradient,) = torch.autograd.grad(members.mean(-1).sum(), x)
        return members.detach(), gradient.detach()

    return compute


# Bonds to hydrogen that stay rigid while a molecule is integrated: CCMA (Eastman and Pande, J. Chem. Theory Comput. 6,
# 434 (2010)), for many replicas at once. One matrix, of the molecule at rest, turns deviations of all bonds into
# corrections of all: it depends on masses and on angles between bonds that share an atom, which hardly change.


class RigidBonds(NamedTuple):
    """Bonds between the atoms `first` and `second` (k,), of squared lengths `length2` (k,) nm^2; `per_mass` (k, 2) of
    both ends, 1/Da; `inverse` (k, k) of what corrections do to deviations."""

    first: Tensor
    second: Tensor
    length2: Tensor
    per_mass: Tensor
    inverse: Tensor

    @staticmethod
    def of(rest_nm: Tensor, bonds: Tensor, masses_da: Tensor) -> RigidBonds:
        """Return `bonds` (k, 2) as long as in the molecule at rest `rest_nm` (n_atoms, 3); `masses_da` (n_atoms,)."""
        first, second = bonds[:, 0], bonds[:, 1]
        along = rest_nm[first] - rest_nm[second]
        ends = torch.zeros(len(bonds), len(rest_nm), dtype=rest_nm.dtype)
        row = torch.arange(len(bonds))
        ends[row, first], ends[row, second] = 1.0, -1.0
        shared = (ends / masses_da) @ ends.T
        inverse = torch.linalg.inv(shared * (along @ along.T))
        return RigidBonds(first, second, along.square().sum(-1), 1.0 / masses_da[bonds], inverse)

    def to(self, device: torch.device) -> RigidBonds:
        return RigidBonds(*(tensor.to(device) for tensor in self))

    def place(self, free_nm: Tensor, before_nm: Tensor) -> Tensor:
        """Return positions `(rows, n_atoms, 3)` nearest to `free_nm` at which bonds have their lengths, moved along
        the bonds of `before_nm`. Rows that cannot be mended are returned as far as they came."""

        def off(bonds: Tensor) -> Tensor:
            return 0.5 * (self.length2 - bonds.square().sum(-1))

        return self._solved(free_nm, self._bonds(before_nm), off, TOLERANCE * self.length2)

    def project(self, v: Tensor, x_nm: Tensor) -> Tensor:
        """Return velocities `(rows, n_atoms, 3)` without those along bonds, at positions `x_nm`."""
        along = self._bonds(x_nm)
        return self._solved(v, along, lambda apart: -(along * apart).sum(-1), TOLERANCE)

    def _bonds(self, x: Tensor) -> Tensor:
        return x[:, self.first] - x[:, self.second]

    def _solved(self, x: Tensor, along: Tensor, off: Callable[[Tensor], Tensor], tolerance: Tensor | float) -> Tensor:
        """Move ends of bonds `along` (rows, k, 3) until what is `off` by bonds is within the tolerance."""
        for _ in range(ROUNDS):
            wrong = off(self._bonds(x))
            if not bool((wrong.abs() > tolerance).any()):
                break
            step = (wrong @ self.inverse)[..., None] * along
            x = x.index_add(1, self.first, step * self.per_mass[:, :1])
            x = x.index_add(1, self.second, -step * self.per_mass[:, 1:])
        return x
