"""PAINET as a potential: the energy of `EnergyNetwork` in kJ/mol, its forces and steps of MD, by torch and by SIMD."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from surrogate.models.painet.energy import FEW_ATOMS, N_TYPES, EdgeWeights, EnergyNetwork, PotentialConfig, Topology
from surrogate.models.painet.simd import SimdPotential, simd_potential_of
from surrogate.models.potential import GradientFn, Potential, at_rest, gradient_of
from surrogate.models.propagator import Molecule
from systems.errors import InputError


class PainetPotential(Potential):
    """A scalar energy, invariant to rotations, reflections, translations and the order of like atoms, and smooth:
    `energy_offset_kj_mol` plus the network's times `energy_scale_kj_mol`, both of training."""

    arch: ClassVar[str] = "painet-potential"
    config: PotentialConfig

    def __init__(self, config: PotentialConfig) -> None:
        super().__init__()
        self.config = config
        self.network = EnergyNetwork(config)
        self.energy_offset_kj_mol = nn.Buffer(torch.zeros(()))
        self.energy_scale_kj_mol = nn.Buffer(torch.full((), 100.0))
        self._made: tuple[Molecule, GradientFn] | None = None
        self._topology: Topology | None = None

    def train(self, mode: bool = True) -> PainetPotential:
        """As any module; what was made of earlier weights is forgotten."""
        self._made = None
        super().train(mode)
        return self

    def topology(self, molecule: Molecule) -> Topology:
        """Return what the network needs of a molecule, made once for call after call. Raises InputError for elements
        beyond radon."""
        if self._topology is None or self._topology.molecule is not molecule:
            heaviest = int(molecule.elements.max())
            if heaviest >= N_TYPES:
                raise InputError(f"PAINET has types up to atomic number {N_TYPES - 1}; this molecule holds {heaviest}.")
            with torch.inference_mode(False):
                self._topology = Topology.of(molecule)
        return self._topology

    def energies(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        return self.members(positions_nm, self.topology(molecule))

    def members(self, positions_nm: Tensor, topology: Topology, made: EdgeWeights | None = None) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> the members' energies `(rows, n_members)` in kJ/mol, in float64."""
        made = made or self.network.prepare(topology, positions_nm)
        energy = self.network(positions_nm, topology, made)
        return self.energy_offset_kj_mol.double() + self.energy_scale_kj_mol.double() * energy.double()

    def member_forces(self, positions_nm: Tensor, topology: Topology) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> each member's forces `(n_members, rows, n_atoms, 3)` kJ/mol/nm."""
        with torch.inference_mode(False), torch.enable_grad():
            x = positions_nm.detach().clone().requires_grad_(True)
            totals = self.members(x, topology).sum(0)
            return -torch.stack([torch.autograd.grad(total, x, retain_graph=True)[0] for total in totals])

    def spread(self, positions_nm: Tensor, molecule: Molecule) -> Tensor:
        """Frames `(rows, n_atoms, 3)` nm -> `(rows,)` kJ/mol/nm, the root mean square deviation of the members' forces
        from their mean, the largest of a frame's atoms."""
        found = []
        for part in positions_nm.double().split(256):
            forces = self.member_forces(part, self.topology(molecule))
            found.append((forces - forces.mean(0)).square().sum(-1).mean(0).sqrt().amax(-1))
        return torch.cat(found)

    def gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        """Return what computes the members' energies and their mean's gradient at frames like these: by SIMD where
        they run, else by torch."""
        # Above so many atoms pairs change from frame to frame.
        fixed = molecule.n_atoms <= FEW_ATOMS and not self.training
        if fixed and self._made is not None and self._made[0] is molecule:
            return self._made[1]
        topology, simd = self.topology(molecule), None
        with torch.inference_mode(False), torch.no_grad():
            made = self.network.prepare(topology, positions_nm)
        if not self.training:
            unit, zero = float(self.energy_scale_kj_mol), float(self.energy_offset_kj_mol)
            simd = simd_potential_of(self.network, topology, made, len(positions_nm), unit=unit, zero=zero)
        self._made = molecule, simd or gradient_of(lambda x: self.members(x, topology, made))
        return self._made[1]

    def exact_gradient(self, positions_nm: Tensor, molecule: Molecule) -> GradientFn:
        if molecule.n_atoms > FEW_ATOMS:
            return super().exact_gradient(positions_nm, molecule)
        topology = self.topology(molecule)
        with torch.inference_mode(False), torch.no_grad():
            made = self.network.prepare(topology, positions_nm)
        return gradient_of(lambda x: self.members(x, topology, made))

    def langevin(self, x: Tensor, v: Tensor, molecule: Molecule, masses: Tensor, thermal: Tensor, draw: Tensor, *,
                 timestep_ps: float | None = None) -> tuple[Tensor, Tensor]:  # fmt: skip
        """See `Potential.langevin`; all steps by SIMD where that runs."""
        if isinstance(simd := self.gradient(x, molecule), SimdPotential):
            return simd.langevin(x, at_rest(v, masses), draw, self.bath(molecule, masses, thermal, timestep_ps))
        return super().langevin(x, v, molecule, masses, thermal, draw, timestep_ps=timestep_ps)

    def set_scales(self, energies_kj_mol: Tensor, forces_kj_mol_nm: Tensor) -> None:
        """Take the units of what is learned from samples: mean energy, and the root mean square force over 0.1 nm."""
        self.energy_offset_kj_mol.fill_(float(energies_kj_mol.mean()))
        self.energy_scale_kj_mol.fill_(max(0.1 * float(forces_kj_mol_nm.square().mean().sqrt()), 1e-3))

    def set_offset(self, positions_nm: Tensor, energies_kj_mol: Tensor, topology: Topology) -> None:
        """Take the zero of energies from samples `(n, n_atoms, 3)` nm, and leave the scale that was learned with."""
        with torch.no_grad():
            found = torch.cat([self.members(x, topology).mean(-1) for x in positions_nm.split(256)])
        self.energy_offset_kj_mol.add_(float((energies_kj_mol - found).mean()))
