"""LaM-SLidE on heavy atoms: the network moves these, and each chunk's hydrogens are placed about them afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from surrogate.models.hydrogens import HydrogenPlacer
from surrogate.models.interface import Chunk, Molecule, Surrogate
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.further_noise import HYDROGENS, generators
from surrogate.models.lam_slide.model import LamSlide
from systems.errors import InputError


class HeavyLamSlide(Surrogate):
    """Frames of all atoms in and out; `model` in between sees the heavy ones alone.

    Rotors turn on from the last frame's hydrogens, so that chunks join without a seam. `model` and `hydrogens` are made
    of the configuration where they are not given. Raises InputError for one that does not say where hydrogens are.
    """

    arch: ClassVar[str] = LamSlide.arch
    float32_layers: tuple[str, ...] = tuple(f"model.{name}" for name in LamSlide.float32_layers)
    config: LamSlideConfig

    def __init__(
        self, config: LamSlideConfig, model: LamSlide | None = None, hydrogens: HydrogenPlacer | None = None
    ) -> None:
        super().__init__()
        if config.hydrogen_plan is None:
            raise InputError('hydrogens = "placed" needs to know where they are: training finds it (hydrogen_plan).')
        self.config = config
        self.model = LamSlide(config) if model is None else model
        self.hydrogens = HydrogenPlacer(config.hydrogen_plan) if hydrogens is None else hydrogens
        self.solvers = self.model.solvers

    @property
    def canonical(self) -> bool:
        return self.model.canonical

    @property
    def n_conditioning(self) -> int:
        return self.model.n_conditioning

    @property
    def n_new(self) -> int:
        return self.model.n_new

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return self.model.noise_shape(len(self.hydrogens.plan.heavy))

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 10,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`. Velocities play no part. Raises InputError for another number of atoms."""
        n_atoms = self.hydrogens.plan.n_atoms
        if last_frames_nm.shape[-2] != n_atoms:
            raise InputError(f"this model places hydrogens among {n_atoms} atoms, not {last_frames_nm.shape[-2]}.")
        heavy = self.hydrogens.heavy
        chunk = self.model.next_chunk(last_frames_nm[:, :, heavy], _part(molecule, heavy), noise,
                                      solver_steps=solver_steps, solver=solver)  # fmt: skip
        size = (self.n_new, self.hydrogens.n_noise)
        drawn = torch.stack([torch.randn(size, generator=g) for g in generators(noise, HYDROGENS)]).to(noise.device)
        frames: Tensor = self.hydrogens(chunk.frames_nm, last_frames_nm[:, -1], drawn)
        return replace(chunk, frames_nm=frames)


def lam_slide_model(config: LamSlideConfig) -> LamSlide | HeavyLamSlide:
    """Return the model that a configuration describes."""
    return HeavyLamSlide(config) if config.hydrogen_plan is not None else LamSlide(config)


def _part(molecule: Molecule, atoms: Tensor) -> Molecule:
    """Return the molecule of some atoms, ascending."""
    atoms = atoms.to(molecule.elements.device)
    place = torch.full((molecule.n_atoms,), -1, device=atoms.device)
    place[atoms] = torch.arange(len(atoms), device=atoms.device)
    bonds = place[molecule.bonds]
    return Molecule(molecule.elements[atoms], molecule.masses_da[atoms], bonds[(bonds >= 0).all(dim=1)])
