"""Fit baselines to reference frames and write them as weights, so that they roll out and are judged like any model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from surrogate.data.frames import TrainingFrames
from surrogate.data.references import References
from surrogate.data.weights import save_weights
from surrogate.models.baselines.model import (
    Baseline,
    BaselineConfig,
    ConstantVelocity,
    FrozenFrame,
    MarkovStateModel,
    NormalModes,
    TrainingFrameResampling,
)
from surrogate.training.provenance import provenance_of, training_domain
from surrogate.training.trainer import Prepared, Settings, Trainer, TrainingRequest
from systems.errors import InputError

N_KEPT_FRAMES = 4000
N_STATES = 100
# Modes that move less than this have no motion to model (a tenth of the frames' int16 unit).
SMALLEST_DEVIATION_NM = 2e-5
FloatArray = npt.NDArray[np.float64]


def fit_baseline(arch: str, frames: TrainingFrames, out: str | Path, *, n_new: int = 16, seed: int = 0) -> Path:
    """Fit the baseline called `arch` on the training part of `frames` and write `out` (.safetensors).

    Raises InputError when the frames are not in the canonical pose that the baseline needs, or too few.
    """
    (kind,) = (b for b in FITS if b.arch == arch)
    if kind.fitted and not frames.canonical:
        raise InputError(f"{arch} is fitted to canonical frames; make the windows without `canonical=False`.")
    model = FITS[kind](frames, n_new, np.random.default_rng(seed))
    out = Path(out)
    save_weights(out, model, training_domain(frames), provenance_of(frames.origin, {"seed": seed}))
    return out


def fit_frozen(frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Baseline:
    return FrozenFrame(BaselineConfig(n_new=n_new))


def fit_constant_velocity(frames: TrainingFrames, n_new: int, rng: np.random.Generator) -> Baseline:
    return ConstantVelocity(BaselineConfig(n_new=n_new))


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
    triples = frames.positions_nm(starts[:, None] + np.arange(3)).astype(np.float64)
    try:
        return normal_modes_of(triples, n_new)
    except InputError as error:
        raise InputError(f"{frames.scene.name}: {error}") from error


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
    heavy = scene.heavy_idx if len(scene.heavy_idx) >= 3 else np.arange(scene.n_atoms)
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
    picked = [_members(states, int(k), rng) for k in symbols]
    model = MarkovStateModel(
        BaselineConfig(n_new, scene.n_atoms, n_frames=sum(map(len, picked)), n_states=len(symbols))
    )
    centres = np.zeros((len(symbols), scene.n_atoms, 3))
    centres[:, heavy] = clusters.cluster_centers[symbols].reshape(len(symbols), -1, 3)
    model.centres_nm.copy_(torch.from_numpy(centres))
    model.cumulative.copy_(torch.from_numpy(np.cumsum(msm.transition_matrix, axis=1)))
    model.frames_nm.copy_(torch.from_numpy(frames.positions_nm(starts[np.concatenate(picked)])))
    model.first.copy_(torch.from_numpy(np.concatenate([[0], np.cumsum([len(p) for p in picked])])))
    model.heavy.zero_()
    model.heavy[torch.from_numpy(heavy)] = 1.0
    return model


def _members(states: npt.NDArray[Any], state: int, rng: np.random.Generator) -> npt.NDArray[np.int64]:
    found = np.flatnonzero(states == state)
    return np.sort(rng.permutation(found)[: max(1, N_KEPT_FRAMES // N_STATES)])


FITS: dict[type[Baseline], Callable[[TrainingFrames, int, np.random.Generator], Baseline]] = {
    FrozenFrame: fit_frozen,
    ConstantVelocity: fit_constant_velocity,
    TrainingFrameResampling: fit_resampling,
    NormalModes: fit_normal_modes,
    MarkovStateModel: fit_markov_state_model,
}


class BaselineTrainer(Trainer):
    """Fits a baseline in one go; there is nothing to set."""

    fitted = True

    def settings(self, request: TrainingRequest) -> Settings:
        """See `Trainer.settings`."""
        return Settings(None, None)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        """See `Trainer.prepare`."""
        frames = references.frames(canonical=True)
        return Prepared(
            frames.scene.name, lambda advance: fit_baseline(request.arch, frames, request.out, seed=request.seed)
        )
