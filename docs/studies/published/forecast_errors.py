"""ADE and FDE as the papers on forecasting define them, with error bars over test trajectories."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.floating[Any]]

N_RESAMPLES = 1000


@dataclass(frozen=True)
class Estimate:
    """A mean over test trajectories with the 95 % interval of a bootstrap over them."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:#.3g} [{self.low:#.3g}, {self.high:#.3g}]"

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


def forecast_errors(predicted: Floats, ref: Floats) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return ADE and FDE of every trajectory, `(n,)` each, in the unit of the positions.

    `predicted` (K, n, n_frames, n_particles, 3) samples, `reference` (n, n_frames, n_particles, 3). The displacement
    error is the Euclidean distance of a particle from where it was; ADE is its mean over frames and particles, FDE its
    mean over particles at the last frame, both the mean over the K samples (not the best of them), as in GeoTDM (Han
    2024) and LaM-SLidE, section 4.3. Raises ValueError for shapes that do not fit.
    """
    if predicted.ndim != 5 or predicted.shape[1:] != ref.shape or ref.shape[-1] != 3:
        raise ValueError(f"samples {predicted.shape} do not fit the reference {ref.shape}")
    distance = np.linalg.norm(predicted.astype(np.float64) - ref, axis=-1)
    return distance.mean(axis=(0, 2, 3)), distance[:, :, -1].mean(axis=(0, 2))


def estimate(errors: Floats, seed: int = 0) -> Estimate:
    """Return the mean of `errors` (n,) with its bootstrap interval: trajectories drawn again with replacement."""
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(errors), size=(N_RESAMPLES, len(errors)))
    low, high = np.quantile(errors[draws].mean(axis=1), [0.025, 0.975])
    return Estimate(float(errors.mean()), float(low), float(high))


def block_means(errors: Floats, blocks: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Return the mean of `errors` (n,) over each block of windows that overlap, in units that count as independent."""
    _, place = np.unique(blocks, return_inverse=True)
    return np.bincount(place, weights=errors) / np.bincount(place)


def ratio(errors: Floats, reference: Floats, seed: int = 0) -> Estimate:
    """Return mean(errors) / mean(reference) over the same trajectories, drawn again together."""
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(errors), size=(N_RESAMPLES, len(errors)))
    low, high = np.quantile(errors[draws].mean(axis=1) / reference[draws].mean(axis=1), [0.025, 0.975])
    return Estimate(float(errors.mean() / reference.mean()), float(low), float(high))
