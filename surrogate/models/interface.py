"""The contract every surrogate fulfils: the last frames in, the next chunk of frames out."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Surrogate(Protocol):
    """A learned simulator of one scene, batched over replicas.

    Frames are in the model's canonical frame when `canonical` is True (the caller superposes), in nm, float32.
    Randomness enters through `noise` alone: the same noise, frames and settings give the same chunk, row by row,
    whatever the batch they stand in.
    """

    @property
    def canonical(self) -> bool:
        """Whether frames must be superposed on the template first."""
        ...

    @property
    def n_conditioning(self) -> int:
        """Frames the model looks back on."""
        ...

    @property
    def n_new(self) -> int:
        """Frames one call returns."""
        ...

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        """Shape of one replica's noise."""
        ...

    def next_chunk(
        self, last_frames_nm: Tensor, elements: Tensor, noise: Tensor, *, solver_steps: int, solver: str | None = None
    ) -> Tensor:
        """Frames `(b, n_conditioning, n_atoms, 3)` nm, atomic numbers `(n_atoms,)`, noise `(b, *noise_shape)` ->
        `(b, n_new, n_atoms, 3)` nm. Inputs are left untouched; `solver` None is the model's own choice."""
        ...


def draw_noise(model: Surrogate, n_atoms: int, generators: list[torch.Generator]) -> Tensor:
    """Return noise `(len(generators), *noise_shape)`, each row from its replica's own generator."""
    shape = model.noise_shape(n_atoms)
    return torch.stack([torch.randn(shape, generator=g) for g in generators])
