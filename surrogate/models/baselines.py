"""Baselines behind the surrogates' contract: what a learned model must beat. They are fitted, not trained."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from surrogate.data import References, TrainingFrames, fitted_atoms
from surrogate.models.architecture import Architecture, ModelConfig, Prepared, Settings, Trainer, TrainingRequest
from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import provenance_of, save_weights, training_domain
from systems.errors import InputError


@dataclass(frozen=True)
class BaselineConfig(ModelConfig):
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


class Baseline(Propagator):
    """What all of them share; those fitted to one molecule work in its canonical frame."""

    config: BaselineConfig
    fitted: ClassVar[bool] = False
    # Whether successive frames have nothing in common, so that no limit of jumps is theirs.
    leaps: ClassVar[bool] = False

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__()
        self.config = config

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

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        return last_frames_nm[:, -1:].repeat(1, self.n_new, 1, 1)


class ConstantVelocity(Baseline):
    """The step from the frame before the last to the last, repeated."""

    arch: ClassVar[str] = "constant-velocity"
    n_conditioning = 2

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        last = last_frames_nm[:, -1:]
        steps = torch.arange(1, self.n_new + 1, device=last.device)[None, :, None, None]
        return last + steps * (last - last_frames_nm[:, -2:-1])


class TrainingFrameResampling(Baseline):
    """Training frames drawn at random: the right ensemble, as far as it was seen, and no dynamics at all."""

    arch: ClassVar[str] = "resampling"
    fitted: ClassVar[bool] = True
    leaps: ClassVar[bool] = True

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.frames_nm = nn.Buffer(torch.zeros(config.n_frames, config.n_atoms, 3))

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new,)

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        return self.frames_nm[pick(noise, torch.full_like(noise, self.config.n_frames).long())]


class NormalModes(Baseline):
    """Independent damped oscillators about the mean structure: principal components, each an autoregression over two
    frames, c(t+1) = a c(t) + b c(t-1) + s noise.

    A harmonic mode obeys it exactly (a = 2 cos(omega lag), b = -1 without friction), an overdamped one with b = 0; the
    coefficients keep each mode's variance and its correlation after one and two frames (Yule-Walker).
    """

    arch: ClassVar[str] = "normal-modes"
    fitted: ClassVar[bool] = True
    n_conditioning = 2

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.mean_nm = nn.Buffer(torch.zeros(config.n_atoms, 3))
        # Orthonormal rows (n_modes, 3 n_atoms), and a, b, s of each.
        self.modes = nn.Buffer(torch.zeros(config.n_modes, 3 * config.n_atoms))
        self.coefficients = nn.Buffer(torch.zeros(3, config.n_modes))

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


class MarkovStateModel(Baseline):
    """A Markov state model that jumps between clusters of structures and shows a training frame of the one it is in.

    `centres_nm` (n_states, n_atoms, 3), compared over the atoms where `heavy` is one; `cumulative` (n_states,
    n_states) rows of summed transition probabilities; `frames_nm` sorted by state, state k from `first[k]` on.
    """

    arch: ClassVar[str] = "msm"
    fitted: ClassVar[bool] = True
    leaps: ClassVar[bool] = True

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__(config)
        self.centres_nm = nn.Buffer(torch.zeros(config.n_states, config.n_atoms, 3))
        self.cumulative = nn.Buffer(torch.zeros(config.n_states, config.n_states))
        self.frames_nm = nn.Buffer(torch.zeros(config.n_frames, config.n_atoms, 3))
        self.first = nn.Buffer(torch.zeros(config.n_states + 1, dtype=torch.int64))
        # One of the atoms that tell states apart, zero of the others.
        self.heavy = nn.Buffer(torch.ones(config.n_atoms))

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return (self.n_new, 2)

    def states_of(self, frames_nm: Tensor) -> Tensor:
        """Return the nearest centre of canonical frames `(b, n_atoms, 3)`: `(b,)`."""
        flat = (frames_nm * self.heavy[:, None]).flatten(1)
        return torch.cdist(flat, (self.centres_nm * self.heavy[:, None]).flatten(1)).argmin(1)

    def frames_after(self, last_frames_nm: Tensor, noise: Tensor) -> Tensor:
        state = self.states_of(last_frames_nm[:, -1])
        visited = []
        for t in range(self.n_new):
            share = uniform(noise[:, t, :1])
            state = torch.searchsorted(self.cumulative[state], share).squeeze(1).clamp(max=self.config.n_states - 1)
            visited.append(state)
        states = torch.stack(visited, dim=1)
        members = self.first[states + 1] - self.first[states]
        return self.frames_nm[self.first[states] + pick(noise[..., 1], members)]


def uniform(noise: Tensor) -> Tensor:
    """Turn normal noise into uniform numbers in [0, 1)."""
    return torch.special.ndtr(noise.double()).clamp(max=1.0 - 1e-12).to(noise.dtype)


def pick(noise: Tensor, n: Tensor) -> Tensor:
    """Turn normal noise into an index below `n`, of the same shape, each as likely."""
    share = torch.special.ndtr(noise.double())
    return torch.minimum((share * n).long(), n - 1)


N_KEPT_FRAMES = 4000
N_STATES = 100
# Modes that move less than this have no motion to model (a tenth of the frames' int16 unit).
SMALLEST_DEVIATION_NM = 2e-5
FloatArray = npt.NDArray[np.float64]


def fit_baseline(arch: str, frames: TrainingFrames, out: str | Path, *, n_new: int = 16, seed: int = 0) -> Path:
    """Fit the baseline called `arch` on the training part of `frames` and write `out` (.safetensors). Raises InputError
    when the frames are not in the canonical pose that the baseline needs, or too few."""
    (kind,) = (b for b in FITS if b.arch == arch)
    if kind.fitted and not frames.canonical:
        raise InputError(f"{arch} is fitted to canonical frames; make the windows without `canonical=False`.")
    model = FITS[kind](frames, n_new, np.random.default_rng(seed))
    out = Path(out)
    domain = training_domain(frames)
    if kind.leaps and domain.limits is not None:
        domain = replace(domain, limits={**domain.limits, "jump_idx": []})
    save_weights(out, model, domain, provenance_of(frames.origin, {"seed": seed}))
    return out


def fit_resampling(frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Baseline:
    """Keep evenly drawn training frames."""
    starts = frames.window_starts(1, validation=False)
    kept = np.sort(rng.permutation(starts)[:N_KEPT_FRAMES])
    model = TrainingFrameResampling(BaselineConfig(n_new, frames.scene.n_atoms, n_frames=len(kept)))
    model.frames_nm.copy_(torch.from_numpy(frames.positions_nm(kept)))
    return model


def fit_normal_modes(frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Baseline:
    """Principal components of the training frames; each mode's correlations after one and two frames."""
    starts = frames.window_starts(3, validation=False)
    starts = np.sort(rng.permutation(starts)[:50_000])
    return normal_modes_of(frames.positions_nm(starts[:, None] + np.arange(3)).astype(np.float64), n_new)


def normal_modes_of(triples: FloatArray, n_new: int) -> NormalModes:
    """Fit `NormalModes` to successive canonical frames `(n, 3, n_atoms, 3)` nm. Raises InputError where nothing
    moves."""
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
    coefficients = autoregression(np.einsum("bti,ki->btk", x, modes))
    model = NormalModes(BaselineConfig(n_new, n_atoms, n_modes=len(modes)))
    model.mean_nm.copy_(torch.from_numpy(mean.reshape(-1, 3)))
    model.modes.copy_(torch.from_numpy(modes))
    model.coefficients.copy_(torch.from_numpy(coefficients))
    return model


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


def fit_markov_state_model(frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Baseline:
    """k-means on the canonical heavy atoms, a reversible transition matrix at one frame's lag (deeptime), and training
    frames of each state. States outside the largest connected set are left out."""
    from deeptime.clustering import KMeans
    from deeptime.markov import TransitionCountEstimator
    from deeptime.markov.msm import MaximumLikelihoodMSM

    scene = frames.scene
    starts = frames.window_starts(1, validation=False)
    heavy = fitted_atoms(scene)
    features = frames.positions_nm(starts)[:, heavy].reshape(len(starts), -1)
    n_states = max(1, min(N_STATES, len(starts) // 20))
    sample = features[np.sort(rng.permutation(len(features))[:20_000])]
    clusters = KMeans(n_states, max_iter=50, fixed_seed=int(rng.integers(2**31))).fit(sample).fetch_model()
    states = clusters.transform(features)
    # A trajectory is a run of successive frames: the validation blocks cut the others apart.
    pieces = np.split(states, np.flatnonzero(np.diff(starts) != 1) + 1)
    counts = TransitionCountEstimator(lagtime=1, count_mode="sliding").fit(pieces).fetch_model().submodel_largest()
    msm = MaximumLikelihoodMSM(reversible=True).fit(counts).fetch_model()
    symbols = counts.state_symbols
    most = max(1, N_KEPT_FRAMES // N_STATES)
    picked = [np.sort(rng.permutation(np.flatnonzero(states == k))[:most]) for k in symbols]
    n_kept = sum(map(len, picked))
    model = MarkovStateModel(BaselineConfig(n_new, scene.n_atoms, n_frames=n_kept, n_states=len(symbols)))
    centres = np.zeros((len(symbols), scene.n_atoms, 3))
    centres[:, heavy] = clusters.cluster_centers[symbols].reshape(len(symbols), -1, 3)
    model.centres_nm.copy_(torch.from_numpy(centres))
    model.cumulative.copy_(torch.from_numpy(np.cumsum(msm.transition_matrix, axis=1)))
    model.frames_nm.copy_(torch.from_numpy(frames.positions_nm(starts[np.concatenate(picked)])))
    model.first.copy_(torch.from_numpy(np.concatenate([[0], np.cumsum([len(p) for p in picked])])))
    model.heavy.zero_()
    model.heavy[torch.from_numpy(heavy)] = 1.0
    return model


FITS: dict[type[Baseline], Callable[[TrainingFrames, int, np.random.Generator], Baseline]] = {
    FrozenFrame: lambda frames, n_new, rng: FrozenFrame(BaselineConfig(n_new)),
    ConstantVelocity: lambda frames, n_new, rng: ConstantVelocity(BaselineConfig(n_new)),
    TrainingFrameResampling: fit_resampling,
    NormalModes: fit_normal_modes,
    MarkovStateModel: fit_markov_state_model,
}


class BaselineTrainer(Trainer):
    """Fits a baseline in one go; there is nothing to set."""

    fitted = True

    def settings(self, request: TrainingRequest) -> Settings:
        return Settings(None, None)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        frames = references.frames(canonical=True)
        return Prepared(
            frames.scene.name, lambda advance: fit_baseline(request.arch, frames, request.out, seed=request.seed)
        )


def _baseline(kind: type[Baseline]) -> Architecture:
    return Architecture(kind.arch, BaselineConfig.from_dict, kind, BaselineTrainer)


FROZEN = _baseline(FrozenFrame)
CONSTANT_VELOCITY = _baseline(ConstantVelocity)
RESAMPLING = _baseline(TrainingFrameResampling)
NORMAL_MODES = _baseline(NormalModes)
MSM = _baseline(MarkovStateModel)
