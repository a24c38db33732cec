"""Roll weights forward chunk by chunk in memory: what the benchmarks time, without guards and without files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from surrogate.sampling.chunks import ChunkSampler, noise_seed

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

Frames = npt.NDArray[np.float64]


class Roller:
    """`rows` replicas in one batch, from the template of the weights; each call goes on where the last one ended."""

    def __init__(self, weights: Weights, sampler: ChunkSampler, *, rows: int, seed: int) -> None:
        start = weights.domain.scene.positions_nm
        self._sampler, self._rows, self._seed = sampler, rows, seed
        self._last = np.repeat(start[None, None], sampler.n_conditioning, axis=1).repeat(rows, axis=0)
        self._velocities: npt.NDArray[np.floating] | None = None
        self._chunk = 0

    def advance(self, n_frames: int, kept: int | None = None) -> Frames:
        """Return `(rows, n_frames, n_atoms, 3)` nm, of each chunk the first `kept` frames (all). What a last chunk has
        beyond `n_frames` is lost: the next call goes on from that chunk's end."""
        each = kept or self._sampler.n_new
        parts: list[Frames] = []
        for _ in range(-(-n_frames // each)):
            # Velocities belong to a chunk's end; where it is cut, the model draws new ones.
            seeds = [noise_seed(self._seed, row, self._chunk) for row in range(self._rows)]
            drawn = self._sampler.draw(self._last, seeds, self._velocities)
            self._velocities = drawn.velocities_nm_ps if each == self._sampler.n_new else None
            parts.append(drawn.frames_nm[:, :each].astype(np.float64))
            self._last = np.concatenate([self._last, parts[-1]], axis=1)[:, -self._sampler.n_conditioning :]
            self._chunk += 1
        return np.concatenate(parts, axis=1)[:, :n_frames]
