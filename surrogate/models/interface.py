"""The contract every surrogate fulfils: a molecule and its last frames in, the next chunk of frames out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from torch import Tensor, nn

from surrogate.models.atom_features import AtomFeatures
from surrogate.models.peptides.chains import ChainFeatures
from systems.errors import InputError
from systems.scene import ATOMIC_NUMBERS, PARTICLE

if TYPE_CHECKING:
    from systems.scene import Scene


@dataclass(frozen=True, eq=False)
class Molecule:
    """Input features of a scene, beside its frames.

    `elements` (n_atoms,) int64 atomic numbers, 0 for a particle of a model system; `masses_da` (n_atoms,) float32;
    `bonds` (n_bonds, 2) int64; `atoms`: features of the covalent graph, and `chain`: of a peptide's
    residues, each for a model that asks for them; `own`: what a model makes of the scene itself (`Surrogate.features`).
    """

    elements: Tensor
    masses_da: Tensor
    bonds: Tensor
    atoms: AtomFeatures | None = None
    chain: ChainFeatures | None = None
    own: Any = None

    @staticmethod
    def of(scene: Scene) -> Molecule:
        """Return the features of a scene, in its atom order."""
        numbers = [0 if e == PARTICLE else ATOMIC_NUMBERS[e] for e in scene.elements]
        return Molecule(
            elements=torch.tensor(numbers, dtype=torch.int64),
            masses_da=torch.tensor(scene.masses_da.tolist(), dtype=torch.float32),
            bonds=torch.tensor(scene.bonds.tolist(), dtype=torch.int64).reshape(-1, 2),
        )

    @property
    def n_atoms(self) -> int:
        return len(self.elements)

    def to(self, device: torch.device) -> Molecule:
        atoms = None if self.atoms is None else self.atoms.to(device)
        chain = None if self.chain is None else self.chain.to(device)
        own = None if self.own is None else self.own.to(device)
        return Molecule(self.elements.to(device), self.masses_da.to(device), self.bonds.to(device), atoms, chain, own)

    def permuted(self, order: Tensor) -> Molecule:
        """Return the molecule whose atom k is this one's atom order[k]."""
        atoms = None if self.atoms is None else self.atoms.permuted(order)
        return Molecule(self.elements[order], self.masses_da[order], torch.argsort(order)[self.bonds], atoms)


@dataclass(frozen=True)
class Chunk:
    """Frames `(b, n_new, n_atoms, 3)` nm and, of a model that carries them, the velocities `(b, n_atoms, 3)` nm/ps at
    the last of them; None of the others. `evaluations`: of the network, a row's mean; None where it is always one."""

    frames_nm: Tensor
    velocities_nm_ps: Tensor | None = None
    evaluations: float | None = None


class Surrogate(nn.Module, ABC):
    """A learned simulator, batched over replicas of one molecule.

    Frames are in the model's canonical frame when `canonical` is True (the caller superposes), else centred by the
    caller or not, as it likes; nm, float32. Randomness enters through `noise` alone: the same noise, frames and
    settings give the same chunk, row by row, whatever the batch they stand in. `surrogate.models.conformance` holds
    any model against this contract.
    """

    # Name in weights files and on the command line.
    arch: ClassVar[str]
    # Solvers that `next_chunk` knows, the default first; empty for a model that answers in one evaluation.
    solvers: tuple[str, ...] = ()
    # Names (prefixes) of layers that compute in float32 under autocast too.
    float32_layers: tuple[str, ...] = ()
    # Whether bf16 pays: False where the network is small and its rounding would heat what it integrates.
    bf16_by_default: ClassVar[bool] = True
    # Whether a chunk ends in velocities that the next one starts from.
    carries_velocities: ClassVar[bool] = False
    # Whether its frames leap by design: a baseline without motion, in which a jump is no fault.
    leaps: ClassVar[bool] = False
    # The time between the frames that it is asked for, of a model that takes it as an input (`at_lag`).
    lag_ps: float | None = None
    config: Any

    @property
    @abstractmethod
    def canonical(self) -> bool:
        """Whether frames must be superposed on the template first."""

    @property
    @abstractmethod
    def n_conditioning(self) -> int:
        """Frames the model looks back on."""

    @property
    @abstractmethod
    def n_new(self) -> int:
        """Frames one call returns."""

    @property
    def usual_steps(self) -> int:
        """Steps of its solver, where nothing else is asked for."""
        return 10

    @property
    def knows_bonds(self) -> bool:
        """Whether the model wants a molecule's features of the covalent graph (`Molecule.atoms`)."""
        return False

    @property
    def knows_chains(self) -> bool:
        """Whether the model wants a peptide's residues (`Molecule.chain`)."""
        return False

    def features(self, scene: Scene) -> Any:
        """Return input features of a scene that no other model knows, with a method `to(device)`: `Molecule.own` of
        what `next_chunk` is given. None of a model without any."""
        return None

    def at_lag(self, lag_ps: float) -> Surrogate:
        """Return this model, its weights shared, with frames `lag_ps` apart. Raises InputError where it was not trained
        for that; most models have one spacing, that of their weights."""
        raise InputError(f"{self.arch} was trained for one spacing of frames and takes no lag.")

    # Whether it integrates forces, in a bath that a rollout may choose (`in_bath`).
    integrates: ClassVar[bool] = False

    def in_bath(self, changes: dict[str, Any]) -> Surrogate:
        """Return this model, its weights shared, integrating under other settings: `temperature_k`, `friction_per_ps`,
        `timestep_ps`, `hydrogen_mass_da`, `ensemble`. Raises InputError for a model that learned frames, and their bath
        with them."""
        raise InputError(
            f"{self.arch} learned its bath with its frames; leave {', '.join(f'`{k}`' for k in changes)} out."
        )

    @abstractmethod
    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        """Shape of one replica's noise; (0,) of a model without any."""

    @abstractmethod
    def next_chunk(
        self,
        last_frames_nm: Tensor,
        molecule: Molecule,
        noise: Tensor,
        *,
        solver_steps: int = 1,
        solver: str | None = None,
        last_velocities_nm_ps: Tensor | None = None,
    ) -> Chunk:
        """Frames `(b, n_conditioning, n_atoms, 3)` nm, noise `(b, *noise_shape)` -> the next chunk.

        `last_velocities_nm_ps` `(b, n_atoms, 3)`: what the chunk before ended in, where the model carries velocities;
        None starts from velocities that the noise draws. Inputs are left untouched; `solver` None is the default.
        """


def draw_noise(model: Surrogate, n_atoms: int, generators: list[torch.Generator]) -> Tensor:
    """Return noise `(len(generators), *noise_shape)`, each row from its replica's own generator."""
    shape = model.noise_shape(n_atoms)
    return torch.stack([torch.randn(shape, generator=g) for g in generators])
