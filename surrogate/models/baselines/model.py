"""Baselines behind the surrogates' contract: what a learned model must beat. They are fitted, not trained."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from surrogate.models.interface import Chunk, Molecule, Surrogate
from surrogate.models.settings import build
from systems.errors import InputError


@dataclass(frozen=True)
class BaselineConfig:
    """Sizes that a baseline's tensors have: `n_new` frames a call, `n_atoms` (0: any), and of those that keep frames,
    modes or states, how many."""

    n_new: int = 16
    n_atoms: int = 0
    n_frames: int = 0
    n_modes: int = 0
    n_states: int = 0

    def __post_init__(self) -> None:
        if self.n_new < 1:
            raise InputError(f"n_new = {self.n_new} must be at least 1.")

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> BaselineConfig:
        """Raises InputError for an unknown key, naming the nearest."""
        return build(BaselineConfig, record)


class Baseline(Surrogate):
    """What all of them share; those fitted to one molecule work in its canonical frame."""

    config: BaselineConfig
    conditions_on: ClassVar[int] = 1
    fitted: ClassVar[bool] = False

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__()
        self.config = config

    @property
    def canonical(self) -> bool:
        return self.fitted

    @property
    def n_conditioning(self) -> int:
        return self.conditions_on

    @property
    def n_new(self) -> int:
        return self.config.n_new

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (0,)

    def check_atoms(self, molecule: Molecule) -> None:
        """Raise InputError for another number of atoms than the baseline was fitted to."""
        if self.config.n_atoms not in (0, molecule.n_atoms):
            raise InputError(f"this {self.arch} model has {self.config.n_atoms} atoms, not {molecule.n_atoms}.")


class FrozenFrame(Baseline):
    """The last frame, again and again."""

    arch: ClassVar[str] = "frozen"

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`."""
        return Chunk(last_frames_nm[:, -1:].repeat(1, self.n_new, 1, 1))


class ConstantVelocity(Baseline):
    """The step from the frame before the last to the last, repeated."""

    arch: ClassVar[str] = "constant-velocity"
    conditions_on: ClassVar[int] = 2

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`."""
        last = last_frames_nm[:, -1:]
        steps = torch.arange(1, self.n_new + 1, device=last.device)[None, :, None, None]
        return Chunk(last + steps * (last - last_frames_nm[:, -2:-1]))


class TrainingFrameResampling(Baseline):
    """Training frames drawn at random: the right ensemble, as far as it was seen, and no dynamics at all."""

    arch: ClassVar[str] = "resampling"
    fitted: ClassVar[bool] = True
    leaps: ClassVar[bool] = True
    frames_nm: Tensor

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.register_buffer("frames_nm", torch.zeros(config.n_frames, config.n_atoms, 3))

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new,)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`."""
        self.check_atoms(molecule)
        return Chunk(self.frames_nm[pick(noise, torch.full_like(noise, self.config.n_frames).long())])


class NormalModes(Baseline):
    """Independent damped oscillators about the mean structure: principal components, each an autoregression over two
    frames, c(t+1) = a c(t) + b c(t-1) + s noise.

    A harmonic mode obeys it exactly (a = 2 cos(omega lag), b = -1 without friction), an overdamped one with b = 0; the
    coefficients keep each mode's variance and its correlation after one and two frames (Yule-Walker).
    """

    arch: ClassVar[str] = "normal-modes"
    fitted: ClassVar[bool] = True
    conditions_on: ClassVar[int] = 2
    mean_nm: Tensor
    modes: Tensor
    coefficients: Tensor

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.register_buffer("mean_nm", torch.zeros(config.n_atoms, 3))
        # Orthonormal rows (n_modes, 3 n_atoms), and a, b, s of each.
        self.register_buffer("modes", torch.zeros(config.n_modes, 3 * config.n_atoms))
        self.register_buffer("coefficients", torch.zeros(3, config.n_modes))

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new, self.config.n_modes)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`."""
        self.check_atoms(molecule)
        with torch.autocast(noise.device.type, enabled=False):
            before, last = ((last_frames_nm - self.mean_nm).flatten(2) @ self.modes.T).unbind(1)
            a, b, s = self.coefficients
            found = []
            for t in range(self.n_new):
                before, last = last, a * last + b * before + s * noise[:, t]
                found.append(last)
            moved = torch.stack(found, dim=1) @ self.modes
        return Chunk(self.mean_nm + moved.unflatten(-1, (-1, 3)))


class MarkovStateModel(Baseline):
    """A Markov state model that jumps between clusters of structures and shows a training frame of the one it is in.

    `centres_nm` (n_states, n_atoms, 3), compared over the atoms where `heavy` is one; `cumulative` (n_states,
    n_states) rows of summed transition probabilities; `frames_nm` sorted by state, state k from `first[k]` on.
    """

    arch: ClassVar[str] = "msm"
    fitted: ClassVar[bool] = True
    leaps: ClassVar[bool] = True
    centres_nm: Tensor
    cumulative: Tensor
    frames_nm: Tensor
    first: Tensor
    heavy: Tensor

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.register_buffer("centres_nm", torch.zeros(config.n_states, config.n_atoms, 3))
        self.register_buffer("cumulative", torch.zeros(config.n_states, config.n_states))
        self.register_buffer("frames_nm", torch.zeros(config.n_frames, config.n_atoms, 3))
        self.register_buffer("first", torch.zeros(config.n_states + 1, dtype=torch.int64))
        # One of the atoms that tell states apart, zero of the others.
        self.register_buffer("heavy", torch.ones(config.n_atoms))

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new, 2)

    def states_of(self, frames_nm: Tensor) -> Tensor:
        """Return the nearest centre of canonical frames `(b, n_atoms, 3)`: `(b,)`."""
        flat = (frames_nm * self.heavy[:, None]).flatten(1)
        return torch.cdist(flat, (self.centres_nm * self.heavy[:, None]).flatten(1)).argmin(1)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Surrogate.next_chunk`."""
        self.check_atoms(molecule)
        state = self.states_of(last_frames_nm[:, -1])
        visited = []
        for t in range(self.n_new):
            share = uniform(noise[:, t, :1])
            state = torch.searchsorted(self.cumulative[state], share).squeeze(1).clamp(max=self.config.n_states - 1)
            visited.append(state)
        states = torch.stack(visited, dim=1)
        members = self.first[states + 1] - self.first[states]
        return Chunk(self.frames_nm[self.first[states] + pick(noise[..., 1], members)])


def uniform(noise: Tensor) -> Tensor:
    """Turn normal noise into uniform numbers in [0, 1)."""
    return torch.special.ndtr(noise.double()).clamp(max=1.0 - 1e-12).to(noise.dtype)


def pick(noise: Tensor, n: Tensor) -> Tensor:
    """Turn normal noise into an index below `n`, of the same shape, each as likely."""
    share = torch.special.ndtr(noise.double())
    return torch.minimum((share * n).long(), n - 1)
