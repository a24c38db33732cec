"""Baselines behind the surrogates' contract: what a learned model must beat. They are fitted, not trained."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.data import References, TrainingFrames
from surrogate.models.architecture import Architecture, ModelConfig, Prepared, Settings, Trainer, TrainingRequest
from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import provenance_of, save_weights, training_domain
from systems.errors import InputError
from systems.scene import FloatArray

N_KEPT_FRAMES = 4000
# Modes that move less than this have no motion to model (a tenth of the frames' int16 unit).
SMALLEST_DEVIATION_NM = 2e-5


@dataclass(frozen=True)
class BaselineConfig(ModelConfig):
    """Sizes that a baseline's tensors have: `n_new` frames a call, `n_atoms` (0: any), and of those that keep frames or
    modes, how many."""

    n_new: int = 16
    n_atoms: int = 0
    n_frames: int = 0
    n_modes: int = 0

    def __post_init__(self) -> None:
        if self.n_new < 1:
            raise InputError(f"n_new = {self.n_new} must be at least 1.")


class Baseline(Propagator):
    """What all of them share; they work in the canonical frame of the molecule that they are fitted to."""

    config: BaselineConfig

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__()
        self.config = config

    @classmethod
    @abstractmethod
    def fit(cls, frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Self:
        """Return the model that the training part of canonical frames gives."""

    @property
    def n_new(self) -> int:
        return self.config.n_new

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (0,)

    @abstractmethod
    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        """Return the next frames `(b, n_new, n_atoms, 3)`; otherwise as `Propagator.next_chunk`."""

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`. Raises InputError for another number of atoms than it was fitted to."""
        if self.config.n_atoms not in (0, molecule.n_atoms):
            raise InputError(f"this {self.arch} model has {self.config.n_atoms} atoms, not {molecule.n_atoms}.")
        return Chunk(self.frames_after(last_frames_nm, noise))


class FrozenFrame(Baseline):
    """The last frame, again and again."""

    arch: ClassVar[str] = "frozen"

    @classmethod
    def fit(cls, frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Self:
        """Nothing is fitted."""
        return cls(BaselineConfig(n_new))

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        return last_frames_nm[:, -1:].repeat(1, self.n_new, 1, 1)


class TrainingFrameResampling(Baseline):
    """Training frames drawn at random: the right ensemble, as far as it was seen, and no dynamics at all."""

    arch: ClassVar[str] = "resampling"

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.frames_nm = nn.Buffer(torch.zeros(config.n_frames, config.n_atoms, 3))

    @classmethod
    def fit(cls, frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Self:
        """Keep evenly drawn training frames."""
        starts = frames.window_starts(1, validation=False)
        kept = np.sort(rng.permutation(starts)[:N_KEPT_FRAMES])
        model = cls(BaselineConfig(n_new, frames.scene.n_atoms, n_frames=len(kept)))
        model.frames_nm.copy_(torch.from_numpy(frames.positions_nm(kept)))
        return model

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new,)

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        # Normal noise as an index, each as likely.
        share = torch.special.ndtr(noise.double())
        return self.frames_nm[(share * self.config.n_frames).long().clamp(max=self.config.n_frames - 1)]


class NormalModes(Baseline):
    """Independent damped oscillators about the mean structure: principal components, each an autoregression over two
    frames, c(t+1) = a c(t) + b c(t-1) + s noise.

    A harmonic mode obeys it exactly (a = 2 cos(omega lag), b = -1 without friction), an overdamped one with b = 0; the
    coefficients keep each mode's variance and its correlation after one and two frames (Yule-Walker).
    """

    arch: ClassVar[str] = "normal-modes"
    n_conditioning = 2

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.mean_nm = nn.Buffer(torch.zeros(config.n_atoms, 3))
        # Orthonormal rows (n_modes, 3 n_atoms), and a, b, s of each.
        self.modes = nn.Buffer(torch.zeros(config.n_modes, 3 * config.n_atoms))
        self.coefficients = nn.Buffer(torch.zeros(3, config.n_modes))

    @classmethod
    def fit(cls, frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Self:
        """Principal components of the training frames; each mode's correlations after one and two frames."""
        starts = frames.window_starts(3, validation=False)
        starts = np.sort(rng.permutation(starts)[:50_000])
        return cls.of(frames.positions_nm(starts[:, None] + np.arange(3)).astype(np.float64), n_new)

    @classmethod
    def of(cls, triples: FloatArray, n_new: int) -> Self:
        """Fit to successive canonical frames `(n, 3, n_atoms, 3)` nm. Raises InputError where nothing moves."""
        n_atoms = triples.shape[2]
        x = triples.reshape(len(triples), 3, -1)
        mean = x.mean((0, 1))
        x = x - mean
        covariance = np.einsum("bti,btj->ij", x, x) / (3 * len(x))
        variance, vectors = np.linalg.eigh(covariance)
        kept = variance > SMALLEST_DEVIATION_NM**2
        if not kept.any():
            raise InputError("no atom moves in these frames; there are no modes to fit.")
        modes = vectors[:, kept].T
        model = cls(BaselineConfig(n_new, n_atoms, n_modes=len(modes)))
        model.mean_nm.copy_(torch.from_numpy(mean.reshape(-1, 3)))
        model.modes.copy_(torch.from_numpy(modes))
        model.coefficients.copy_(torch.from_numpy(autoregression(np.einsum("bti,ki->btk", x, modes))))
        return model

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new, self.config.n_modes)

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        with torch.autocast(noise.device.type, enabled=False):
            before, last = ((last_frames_nm - self.mean_nm).flatten(2) @ self.modes.T).unbind(1)
            a, b, s = self.coefficients
            found = []
            for t in range(self.n_new):
                before, last = last, a * last + b * before + s * noise[:, t]
                found.append(last)
            moved = torch.stack(found, dim=1) @ self.modes
        return self.mean_nm + moved.unflatten(-1, (-1, 3))


def autoregression(triples: FloatArray) -> FloatArray:
    """Return a, b, s `(3, n_modes)` of c(t+1) = a c(t) + b c(t-1) + s noise from successive values `(n, 3, n_modes)`.

    Yule-Walker from the correlations r1, r2: stationary with the variance of the data.
    """
    variance = np.square(triples).mean((0, 1))
    r1 = 0.5 * ((triples[:, 0] * triples[:, 1]).mean(0) + (triples[:, 1] * triples[:, 2]).mean(0)) / variance
    r2 = (triples[:, 0] * triples[:, 2]).mean(0) / variance
    r1 = np.clip(r1, -1 + 1e-9, 1 - 1e-9)
    r2 = np.clip(r2, 2 * r1**2 - 1, 1.0)  # what the correlations of a stationary series can be
    a = r1 * (1 - r2) / (1 - r1**2)
    b = (r2 - r1**2) / (1 - r1**2)
    share = np.clip(1 - a * r1 - b * r2, 0.0, 1.0)
    return np.stack([a, b, np.sqrt(variance * share)])


def fit_baseline(kind: type[Baseline], frames: TrainingFrames, out: str | Path, *, seed: int = 0) -> Path:
    """Fit a baseline on the training part of canonical `frames` and write `out` (.safetensors). Raises InputError when
    the frames are too few."""
    model = kind.fit(frames, BaselineConfig.n_new, np.random.default_rng(seed))
    domain = training_domain(frames)
    if kind is TrainingFrameResampling and domain.limits is not None:
        # Successive frames have nothing in common, so that no limit of jumps is theirs.
        domain = replace(domain, limits={**domain.limits, "jump_idx": []})
    save_weights(out, model, domain, provenance_of(frames.origin, {"seed": seed}))
    return Path(out)


class BaselineTrainer(Trainer):
    """Fits a baseline in one go; there is nothing to set."""

    fitted = True

    def __init__(self, kind: type[Baseline]) -> None:
        self.kind = kind

    def settings(self, request: TrainingRequest) -> Settings:
        return Settings(None, None)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        frames = references.frames(canonical=True)
        return Prepared(
            frames.scene.name, lambda advance: fit_baseline(self.kind, frames, request.out, seed=request.seed)
        )


FROZEN, RESAMPLING, NORMAL_MODES = (
    Architecture(kind.arch, BaselineConfig.from_dict, kind, partial(BaselineTrainer, kind))
    for kind in (FrozenFrame, TrainingFrameResampling, NormalModes)
)
