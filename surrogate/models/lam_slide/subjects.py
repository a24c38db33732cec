"""Dataset of one molecule for LaM-SLidE's two stages: its frames, windows of them, their latents, input features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from surrogate.data.descriptions import describe
from surrogate.data.frames import TrainingFrames
from surrogate.models.interface import Molecule
from surrogate.models.lam_slide.losses import random_rotations
from surrogate.models.lam_slide.model import LamSlide

_HELD_FRAMES = 2048
_BLOCK = 8192


@dataclass(eq=False)
class Subject:
    """Frames of one molecule and its input features. `latents` (n_frames, n_latents, dim): those of all
    frames, once stage one is over, where poses stay and memory suffices."""

    frames: TrainingFrames
    molecule: Molecule
    latents: Tensor | None = None

    @staticmethod
    def of(frames: TrainingFrames, model: LamSlide) -> Subject:
        return Subject(frames, describe(model, frames.scene).to(model.latent_mean.device))

    @property
    def n_atoms(self) -> int:
        return self.molecule.n_atoms

    def poses(self, model: LamSlide, rows: int, generator: torch.Generator) -> Tensor | None:
        """Return a rotation `(rows, 3, 3)` for each window, uniform; None where poses stay as they are."""
        return None if model.canonical else random_rotations(rows, generator)

    def seen(self, x: Tensor, turns: Tensor | None) -> Tensor:
        """Return frames `(b, ..., n_atoms, 3)` turned, on the model's device."""
        if turns is not None:
            x = torch.einsum("bij,b...nj->b...ni", turns, x)
        return x.to(self.molecule.elements.device)

    @torch.no_grad()
    def reconstruction_error_nm(self, model: LamSlide) -> float:
        """Return the root mean square error of held-out frames that went through the autoencoder."""
        held = self.frames.spread_starts(_HELD_FRAMES, validation=True)
        x = self.seen(torch.from_numpy(self.frames.positions_nm(held)), None)
        error = model.decode(model.encode(x, self.molecule.elements), self.n_atoms) - x
        return float(error.square().sum(-1).mean().sqrt())

    @torch.no_grad()
    def encode(self, model: LamSlide, idx: npt.NDArray[np.int64]) -> Tensor:
        """Return the latents `(len(idx), n_latents, dim)` of frames `(n,)` as they are posed."""
        x = self.seen(torch.from_numpy(self.frames.positions_nm(idx)), None)
        return model.encode(x, self.molecule.elements)

    def keep_latents(self, model: LamSlide) -> None:
        """Encode every frame once and keep the latents."""
        parts = [
            self.encode(model, np.arange(start, min(start + _BLOCK, self.frames.n_frames))).cpu()
            for start in range(0, self.frames.n_frames, _BLOCK)
        ]
        self.latents = torch.cat(parts).to(self.molecule.elements.device)

    def windows(self, model: LamSlide, idx: Tensor, generator: torch.Generator) -> Tensor:
        """Return the latents `(b, length, n_latents, dim)` of frames `idx` (b, length), each window in its own pose."""
        if self.latents is not None:
            return self.latents[idx.to(self.latents.device)]
        turns = self.poses(model, len(idx), generator)
        x = self.seen(torch.from_numpy(self.frames.positions_nm(idx.numpy())), turns)
        with torch.no_grad():
            return model.encode(x, self.molecule.elements)


def pick(subjects: Sequence[object], generator: torch.Generator) -> int:
    """Return which subject a batch is of, each as likely; a single one costs no random number."""
    if len(subjects) == 1:
        return 0
    return int(torch.randint(len(subjects), (1,), generator=generator))


@torch.no_grad()
def normalise_latents(model: LamSlide, subject: Subject, seed: int, n_frames: int = 20_000) -> None:
    """Measure the latents' means and common scale on training frames and set them."""
    model.latent_mean.zero_()
    model.latent_scale.fill_(1.0)
    starts = subject.frames.window_starts(1, validation=False)
    idx = np.random.default_rng(seed).choice(len(starts), size=min(n_frames, len(starts)), replace=False)
    z = subject.encode(model, starts[np.sort(idx)])
    model.latent_mean.copy_(z.mean(0))
    model.latent_scale.copy_((z - z.mean(0)).square().mean().sqrt())
