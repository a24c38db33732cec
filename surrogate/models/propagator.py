"""The protocol of models that make frames: the last frames of a molecule in, the next ones out."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from systems.errors import InputError
from systems.scene import ATOMIC_NUMBERS, PARTICLE, Scene


@dataclass(frozen=True, eq=False)
class Molecule:
    """Input features of a scene, beside its frames.

    `elements` (n_atoms,) int64 atomic numbers, 0 for a particle of a model system; `masses_da` (n_atoms,) float32;
    `bonds` (n_bonds, 2) int64; `own`: what a model's `featurise` adds for itself, a tensor with
    a row for each atom or anything else with a method `to(device)`; `charge` of the whole molecule in e.
    """

    elements: Tensor
    masses_da: Tensor
    bonds: Tensor
    own: Any = None
    charge: int = 0

    @staticmethod
    def of(scene: Scene, own: Any = None) -> Molecule:
        """Return the features of a scene, in its atom order."""
        numbers = [0 if e == PARTICLE else ATOMIC_NUMBERS[e] for e in scene.elements]
        return Molecule(
            elements=torch.tensor(numbers, dtype=torch.int64),
            masses_da=torch.tensor(scene.masses_da.tolist(), dtype=torch.float32),
            bonds=torch.tensor(scene.bonds.tolist(), dtype=torch.int64).reshape(-1, 2),
            own=own,
            charge=int(scene.formal_charges.sum()),
        )

    @property
    def n_atoms(self) -> int:
        return len(self.elements)

    def to(self, device: torch.device) -> Molecule:
        own = None if self.own is None else self.own.to(device)
        return replace(self, elements=self.elements.to(device), masses_da=self.masses_da.to(device),
                       bonds=self.bonds.to(device), own=own)  # fmt: skip

    def permuted(self, order: Tensor) -> Molecule:
        """Return the molecule whose atom k is this one's atom order[k]; `own` is permuted where it is a tensor."""
        own = self.own[order] if isinstance(self.own, Tensor) else self.own
        bonds = torch.argsort(order)[self.bonds]
        return replace(self, elements=self.elements[order], masses_da=self.masses_da[order], bonds=bonds, own=own)


@dataclass(frozen=True)
class Chunk:
    """Frames `(b, n_new, n_atoms, 3)` nm and, of a model that carries them, the velocities `(b, n_atoms, 3)` nm/ps at
    the last of them; None of the others. `evaluations`: of the network, a row's mean; None where it is always one."""

    frames_nm: Tensor
    velocities_nm_ps: Tensor | None = None
    evaluations: float | None = None


class Propagator(nn.Module, ABC):
    """A learned simulator, batched over replicas of one molecule: frames in, frames out, at any lag that it knows.

    A subclass sets `arch` and `config` (an `architecture.ModelConfig`, which the weights file keeps) and implements
    `n_new`, `noise_shape` and `next_chunk`; it sets `n_conditioning` where a chunk follows from more than one frame,
    `solvers` and `usual_steps` where it integrates a flow, `float32_layers` where it may be evaluated in bf16, and
    overrides `featurise` where it looks at more than elements, masses and bonds. One trained for several lags sets
    `lag_range_ps` and `lag_ps`. `Architecture` says how it is trained.

    What holds for every model, and what `surrogate.models.conformance` tests:

    - Frames are in nm, float32, without a box. Each row's frames are superposed on the template of the weights' domain
      by its heavy atoms, as a rigid body by the last of them; new frames are returned in that pose.
    - Randomness enters through `noise` alone, standard normal numbers: the same noise, frames and settings give the
      same chunk. A row does not depend on the rows beside it.
    - Inputs are left untouched. Frames are float32 under autocast, too.
    """

    # Name in weights files and on the command line.
    arch: ClassVar[str]
    config: Any
    # Frames that a chunk is conditioned on.
    n_conditioning: int = 1
    # Solvers that `next_chunk` knows, the default first, and its usual steps; none of a model of one evaluation.
    solvers: tuple[str, ...] = ()
    usual_steps: int = 10
    # Shortest and longest spacing of frames of a model trained for several, and that of the frames that it returns.
    lag_range_ps: tuple[float, float] | None = None
    lag_ps: float | None = None
    # The spacing up to which populations are those of the shortest; None where all are as good.
    usual_lag_ps: float | None = None
    # Which of several solvents its frames are in; None where it knows one, or means its first.
    solvent: str | None = None
    # Prefixes of the names of layers that stay in float32 when the others are evaluated in bf16; None where all do.
    float32_layers: tuple[str, ...] | None = None

    @property
    @abstractmethod
    def n_new(self) -> int:
        """Frames that one call returns."""

    def featurise(self, scene: Scene) -> Molecule:
        """Return the input features of a scene, in its atom order; it is posed as its frames are. Raises InputError for
        one that the model cannot take.
        """
        return Molecule.of(scene)

    def at_lag(self, lag_ps: float) -> Self:
        """Return this model, its weights shared, with frames `lag_ps` apart. Raises InputError outside its range."""
        if self.lag_range_ps is None:
            raise InputError(f"{self.arch} was trained for one spacing of frames and takes no lag.")
        low, high = self.lag_range_ps
        if not low * (1 - 1e-6) <= lag_ps <= high * (1 + 1e-6):
            raise InputError(f"a lag of {lag_ps:g} ps is none that this model was trained for.")
        model = copy.copy(self)
        model.lag_ps = lag_ps
        return model

    def keeps_populations(self, lag_ps: float) -> bool:
        """Whether populations by steps of `lag_ps` are those of shorter ones."""
        return self.usual_lag_ps is None or lag_ps <= self.usual_lag_ps * (1 + 1e-6)

    @abstractmethod
    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        """Return the shape of one replica's noise; (0,) of a model without any."""

    @abstractmethod
    def next_chunk(
        self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
        solver: str | None = None, last_velocities_nm_ps: Tensor | None = None,
    ) -> Chunk:  # fmt: skip
        """Return the frames that follow.

        Args:
            last_frames_nm: `(b, n_conditioning, n_atoms, 3)`, nm, the latest last.
            molecule: what `featurise` returned.
            noise: `(b, *noise_shape(n_atoms))`.
            solver_steps, solver: of a model with `solvers`; None is the first of them.
            last_velocities_nm_ps: `(b, n_atoms, 3)`, nm/ps, what the chunk before ended in, where it had velocities;
            None where a rollout begins, and a model that carries velocities draws them from its noise.
        """


def row_by_row(draw: Callable[[Tensor, Tensor], Chunk], last_frames_nm: Tensor, noise: Tensor) -> Chunk:
    """Return what `draw` makes of each row's frames and noise alone: of a solver whose steps suit the whole batch."""
    rows = [draw(x, own) for x, own in zip(last_frames_nm.split(1), noise.split(1), strict=True)]
    mean = sum(row.evaluations or 0.0 for row in rows) / len(rows)
    return Chunk(torch.cat([row.frames_nm for row in rows]), evaluations=mean)


def draw_noise(model: Propagator, n_atoms: int, generators: list[torch.Generator]) -> Tensor:
    """Return noise `(len(generators), *noise_shape)`, each row from its replica's own generator."""
    shape = model.noise_shape(n_atoms)
    return torch.stack([torch.randn(shape, generator=g) for g in generators])
