"""PAINET as a potential: energies, their exact gradient, and the molecule integrated on them."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from surrogate.models.interface import Chunk, Molecule, Surrogate
from surrogate.models.painet.potential.config import LONGEST_FLEXIBLE_PS, PotentialConfig
from surrogate.models.painet.potential.edges import FEW_ATOMS
from surrogate.models.painet.potential.energy import N_TYPES, EnergyNetwork, Fabric, Prepared
from surrogate.models.painet.potential.gradient import GradientFn, gradient_of
from surrogate.models.painet.potential.rigid import RigidBonds
from surrogate.models.painet.potential.simd import Bath, SimdPotential, simd_potential_of
from systems.errors import InputError
from systems.scene import Scene
from systems.units import GAS_CONSTANT_KJ_MOL_K, whole_steps

_HYDROGEN = 1
_RELAXED_ROUNDS = 100


@dataclass(frozen=True, eq=False)
class Evaluation:
    """`energy_kj_mol` (rows,) and `forces_kj_mol_nm` (rows, n_atoms, 3), the mean of the members; `members_kj_mol`
    (rows, n_members)."""

    energy_kj_mol: Tensor
    forces_kj_mol_nm: Tensor
    members_kj_mol: Tensor


class PainetPotential(Surrogate):
    """A scalar energy, invariant to rotations, reflections, translations and the order of like atoms, and smooth; its
    exact gradient as forces, so that momentum, angular momentum and energy are kept.

    As a surrogate its chunk is MD on this potential: Langevin middle (Zhang 2019) or velocity Verlet, in double
    precision, bonds to hydrogen rigid at steps above 2 fs. Energies are `energy_offset_kj_mol` plus the network's times
    `energy_scale_kj_mol`, both of training.
    """

    arch: ClassVar[str] = "painet-potential"
    carries_velocities: ClassVar[bool] = True
    integrates: ClassVar[bool] = True
    bf16_by_default: ClassVar[bool] = False
    canonical: ClassVar[bool] = False
    n_conditioning: ClassVar[int] = 1
    config: PotentialConfig
    energy_offset_kj_mol: Tensor
    energy_scale_kj_mol: Tensor

    def __init__(self, config: PotentialConfig) -> None:
        super().__init__()
        self.config = config
        self.network = EnergyNetwork(config)
        self.register_buffer("energy_offset_kj_mol", torch.zeros(()))
        self.register_buffer("energy_scale_kj_mol", torch.full((), 100.0))
        self._known: tuple[Molecule, GradientFn] | None = None

    @property
    def n_new(self) -> int:
        return self.config.n_new

    def in_bath(self, changes: dict[str, Any]) -> PainetPotential:
        """See `Surrogate.in_bath`. Raises InputError and UnitError for settings that do not go together."""
        model = copy.copy(self)
        model.config, model._known = replace(self.config, **changes), None
        _ = model.steps_per_frame
        return model

    def features(self, scene: Scene) -> RigidBonds | None:
        """See `Surrogate.features`: bonds to hydrogen, as long as at the nearest minimum of the energy; None where they
        are flexible."""
        molecule = Molecule.of(scene)
        bonds = [pair for pair in molecule.bonds.tolist() if any(molecule.elements[i] == _HYDROGEN for i in pair)]
        if not (self.config.constrain_hydrogens and bonds):
            return None
        rest_nm = self._minimum_nm(torch.tensor(scene.positions_nm, dtype=torch.float64), molecule)
        return RigidBonds.of(rest_nm, torch.tensor(bonds), self.masses_da(molecule))

    def _minimum_nm(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        fabric = self.fabric(molecule)
        with torch.inference_mode(False), torch.enable_grad():
            x = positions_nm.clone().requires_grad_(True)
            descent = torch.optim.LBFGS([x], max_iter=_RELAXED_ROUNDS, line_search_fn="strong_wolfe")

            def energy() -> Tensor:
                descent.zero_grad()
                total = self.members(x[None], fabric).mean()
                (x.grad,) = torch.autograd.grad(total, x)
                return total.detach()

            descent.step(energy)
            return x.detach()

    @property
    def steps_per_frame(self) -> int:
        return whole_steps(self.config.lag_ps, self.config.timestep_ps, "frame spacing in time steps")

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        """One vector an atom for the first velocities, then for each step."""
        return (n_atoms, 1 + self.n_new * self.steps_per_frame, 3)

    def train(self, mode: bool = True) -> PainetPotential:
        """As any module; what was made of earlier weights is forgotten."""
        self._known = None
        super().train(mode)
        return self

    def fabric(self, molecule: Molecule) -> Fabric:
        """Return what `evaluate` needs of a molecule. Raises InputError for elements beyond radon."""
        heaviest = int(molecule.elements.max())
        if heaviest >= N_TYPES:
            raise InputError(f"PAINET has types up to atomic number {N_TYPES - 1}; this molecule holds {heaviest}.")
        return Fabric.of(molecule)

    def members(self, positions_nm: Tensor, fabric: Fabric, made: Prepared | None = None) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> the members' energies `(rows, n_members)` in kJ/mol, in float64."""
        made = made or self.network.prepare(fabric, positions_nm)
        energy = self.network(positions_nm, fabric, made)
        return self.energy_offset_kj_mol.double() + self.energy_scale_kj_mol.double() * energy.double()

    def evaluate(self, positions_nm: Tensor, fabric: Fabric, made: Prepared | None = None) -> Evaluation:
        """Frames `(rows, n_atoms, 3)` nm, in double precision for forces to the last digit -> energies and forces."""
        members, gradient = gradient_of(lambda x: self.members(x, fabric, made))(positions_nm)
        return Evaluation(members.mean(-1), -gradient, members)

    def member_forces(self, positions_nm: Tensor, fabric: Fabric) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> each member's forces `(n_members, rows, n_atoms, 3)` kJ/mol/nm."""
        with torch.inference_mode(False), torch.enable_grad():
            x = positions_nm.detach().clone().requires_grad_(True)
            totals = self.members(x, fabric).sum(0)
            return -torch.stack([torch.autograd.grad(total, x, retain_graph=True)[0] for total in totals])

    def masses_da(self, molecule: Molecule) -> Tensor:
        """Masses `(n_atoms,)` that move: hydrogens as heavy as the settings have them, at the cost of their bond's
        other end."""
        masses, heavy = molecule.masses_da.double().clone(), self.config.hydrogen_mass_da
        if heavy is not None:
            for i, j in [*molecule.bonds.tolist(), *molecule.bonds.flip(1).tolist()]:
                if molecule.elements[i] == _HYDROGEN != molecule.elements[j]:
                    masses[j] -= heavy - molecule.masses_da[i]
                    masses[i] = heavy
        return masses

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`: MD on the potential."""
        with torch.inference_mode(False):
            x, draws = last_frames_nm[:, -1].clone().double(), noise.clone().double()
            masses = self.masses_da(molecule)[:, None]
            thermal = (GAS_CONSTANT_KJ_MOL_K * self.config.temperature_k / masses).sqrt()
            share = masses / masses.sum()
            drawn = thermal * draws[:, :, 0]
            drawn = drawn - (share * drawn).sum(-2, keepdim=True)
            if (rigid := self._rigid(molecule, self.config.timestep_ps)) is not None:
                x = rigid.place(x, x)
                drawn = rigid.project(drawn, x)
            v = drawn if last_velocities_nm_ps is None else last_velocities_nm_ps.clone().double()
            frames = []
            move = self.verlet if self.config.ensemble == "nve" else self.langevin
            for draw in draws[:, :, 1:].split(self.steps_per_frame, dim=2):
                x, v = move(x, v, molecule, masses, thermal, draw)
                frames.append(x)
            dtype = last_frames_nm.dtype
            found = torch.stack(frames, dim=1).to(dtype)
            return Chunk(found, v.to(dtype), float(draws.shape[2] - 1))

    def forces(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> forces, with what depends on the molecule alone kept from call to call."""
        return -self.gradient(positions_nm, molecule)(positions_nm)[1]

    def gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        """Return what computes the members' energies and their mean's gradient at frames like these: by SIMD where
        they run, else by torch."""
        known = self._known
        # Above so many atoms pairs change from frame to frame.
        if known is None or known[0] is not molecule or molecule.n_atoms > FEW_ATOMS or self.training:
            fabric = self.fabric(molecule)
            with torch.inference_mode(False), torch.no_grad():
                made = self.network.prepare(fabric, positions_nm)
            simd = self._by_simd(fabric, made, len(positions_nm))
            known = molecule, simd or gradient_of(lambda x: self.members(x, fabric, made))
            self._known = known
        return known[1]

    def _by_simd(self, fabric: Fabric, made: Prepared, rows: int) -> SimdPotential | None:
        if self.training:
            return None
        unit, zero = float(self.energy_scale_kj_mol), float(self.energy_offset_kj_mol)
        return simd_potential_of(self.network, fabric, made, rows, unit=unit, zero=zero)

    def langevin(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, thermal: Tensor, draw: Tensor, *,
                 timestep_ps: float | None = None) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Return positions nm and velocities nm/ps `(rows, n_atoms, 3)` after the steps that `draw` (rows, n_atoms,
        n_steps, 3) holds normal numbers for, by the Langevin middle scheme: kick, half a drift, bath, half a drift.

        `thermal`: what velocities are at the bath's temperature, root mean square; the centre of mass is at rest.
        """
        dt = timestep_ps or self.config.timestep_ps
        kept = math.exp(-self.config.friction_per_ps * dt)
        lost = math.sqrt(1.0 - kept * kept) * thermal
        rigid = self._rigid(molecule, dt)
        share = masses / masses.sum()
        v = v - (share * v).sum(-2, keepdim=True)
        if isinstance(simd := self.gradient(x, molecule), SimdPotential):
            return simd.langevin(x, v, draw, Bath(dt, kept, lost, masses, rigid))
        for k in range(draw.shape[2]):
            v = v + dt * self.forces(x, molecule) / masses
            if rigid is not None:
                v = rigid.project(v, x)
            free = x + 0.5 * dt * v
            v = kept * v + lost * draw[:, :, k]
            v = v - (share * v).sum(-2, keepdim=True)
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
        return molecule.own if timestep_ps > LONGEST_FLEXIBLE_PS else None

    def set_scales(self, energies_kj_mol: Tensor, forces_kj_mol_nm: Tensor) -> None:
        """Take the units of what is learned from samples: mean energy, and the root mean square force over 0.1 nm."""
        self.energy_offset_kj_mol.fill_(float(energies_kj_mol.mean()))
        self.energy_scale_kj_mol.fill_(max(0.1 * float(forces_kj_mol_nm.square().mean().sqrt()), 1e-3))


def _drift(before: Tensor, x: Tensor, v: Tensor, ahead_ps: float, rigid: RigidBonds | None, step_ps: float
           ) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return positions `ahead_ps` after `x`, and velocities; where bonds are rigid, placed along those of `before`,
    `step_ps` ago, and the velocities that this takes."""
    free = x + ahead_ps * v
    if rigid is None:
        return free, v
    placed = rigid.place(free, before)
    return placed, v + (placed - free) / step_ps
