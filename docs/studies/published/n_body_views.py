"""How LaM-SLidE sees windows of particle systems: as frames of a set of latents, or as what each particle does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from forecast_methods import (
    N_GIVEN,
    N_NEW,
    Array,
    extrapolate,
    motion_features,
    motion_sizes,
)
from particle_sets import ParticleSet

if TYPE_CHECKING:
    import torch
    from particle_flow import Given
    from particle_flow_training import DrawParticles, ParticleWindows


@dataclass(frozen=True, eq=False)
class WindowView:
    """How LaM-SLidE sees windows `(n, n_frames, n_particles, 3)`: given frames about the mean of the last one's
    particles in units of `scale_nm`; those to predict likewise or, with `weights`, as the difference from the
    extrapolation, frame by frame in units of `scales_nm` (n_new,)."""

    scale_nm: float
    scales_nm: Array
    weights: Array | None

    @staticmethod
    def of(data: ParticleSet, weights: Array | None) -> WindowView:
        """Measure the scales on a set."""
        x = data.positions_nm
        about = x - _centre(x[:, :N_GIVEN])
        scale = float(np.sqrt((about[:, :N_GIVEN] ** 2).mean()))
        if weights is None:
            return WindowView(scale, np.full(N_NEW, float(np.sqrt((about**2).mean()))), None)
        left = x[:, N_GIVEN:] - extrapolate(x[:, :N_GIVEN], weights)
        return WindowView(scale, np.sqrt((left**2).mean(axis=(0, 2, 3))), weights)

    def given(self, given: Array) -> Array:
        return (given - _centre(given)) / self.scale_nm

    def ahead(self, windows: Array) -> Array:
        """Windows -> frames to predict as the model sees them, `(n, n_new, n_particles, 3)`."""
        return (windows[:, N_GIVEN:] - self._base(windows[:, :N_GIVEN])) / self.scales_nm[:, None, None]

    def to_model(self, windows: Array) -> Array:
        return np.concatenate([self.given(windows[:, :N_GIVEN]), self.ahead(windows)], axis=1)

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones as the model sees them -> predicted positions, nm."""
        return self._base(given) + seen * self.scales_nm[:, None, None]

    def _base(self, given: Array) -> Array:
        return _centre(given) if self.weights is None else extrapolate(given, self.weights)


@dataclass(frozen=True, eq=False)
class ParticleView:
    """How LaM-SLidE sees what each particle does: frames to predict as `window` does; of the given ones the last
    position, the steps between them and the changes of these, each in units of its own size `sizes_nm`, the latest
    first, about the centre of each frame, which moves straight on. As positions alone bf16 and the first layer would
    lose the forces, which are a hundredth of them."""

    window: WindowView
    sizes_nm: tuple[float, float, float]

    @staticmethod
    def of(data: ParticleSet, weights: Array | None) -> ParticleView:
        """Measure the sizes on a set."""
        return ParticleView(WindowView.of(data, weights), motion_sizes(data.positions_nm[:, :N_GIVEN]))

    def given(self, given: Array) -> Array:
        """Given frames `(n, n_given, n_particles, 3)` nm -> features `(n, n_particles, n_features)`."""
        return motion_features(given, self.sizes_nm)

    def known(self, given: Array, data: ParticleSet) -> Given:
        """Return what the network is told of systems with these given frames."""
        import torch
        from particle_flow import Given

        return Given(
            torch.from_numpy(self.given(given)).float(), torch.from_numpy(data.types), torch.from_numpy(data.pairs)
        )

    def to_model(self, windows: Array, data: ParticleSet) -> ParticleWindows:
        """Windows `(n, n_given + n_new, n_particles, 3)` nm of the systems `data` as the network sees them."""
        import torch
        from particle_flow_training import ParticleWindows

        ahead = torch.from_numpy(self.window.ahead(windows).swapaxes(1, 2)).float()
        return ParticleWindows(self.known(windows[:, :N_GIVEN], data), ahead.contiguous())

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones `(n, n_particles, n_new, 3)` as the network sees them -> positions, nm."""
        return self.window.from_model(given, seen.swapaxes(1, 2))

    def drawn(self, data: ParticleSet, *, mirrored: bool) -> DrawParticles:
        """Return a `draw` of training windows, each turned at random (appendix E.3). `mirrored` (beyond the paper):
        half of them are reflected, and half run backwards in time, which the laws of motion allow as well."""
        from surrogate.models.lam_slide.trainer import random_rotations

        def draw(batch: int, generator: torch.Generator) -> ParticleWindows:
            import torch

            rows = torch.randint(len(data), (batch,), generator=generator).numpy()
            turns = random_rotations(batch, generator).double()
            windows = data.positions_nm[rows]
            if mirrored:
                signs = torch.randint(2, (2, batch), generator=generator)
                turns = turns * (2 * signs[0] - 1)[:, None, None]
                back = signs[1].numpy() == 1
                windows[back] = windows[back, ::-1]
            windows = windows @ turns.mT.numpy()[:, None]
            return self.to_model(windows, data.rows(rows))

        return draw


def _centre(given: Array) -> Array:
    return given[:, -1:].mean(axis=2, keepdims=True)
