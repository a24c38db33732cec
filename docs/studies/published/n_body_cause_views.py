"""Views of particles that the study of LaM-SLidE's error alone needs (`n_body_causes.py`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from forecast_methods import N_GIVEN, N_NEW, Array
from n_body_views import ParticleView, WindowView
from particle_flow import Given
from particle_sets import ParticleSet


class PositionsView(ParticleView):
    """Given frames as positions alone, about the centre of the last."""

    def given(self, given: Array) -> Array:
        return self.window.given(given).swapaxes(1, 2).reshape(len(given), given.shape[2], -1)


class VelocitiesView(ParticleView):
    """And the true velocities of the next frame."""

    def known(self, given: Array, data: ParticleSet) -> Given:
        known = super().known(given, data)
        velocities = torch.from_numpy(next_velocities(data)).float()
        return replace(known, features=torch.cat([known.features, velocities], dim=-1))


class InnovationsView(WindowView):
    """Each frame to predict as its difference from the extrapolation of the frames before it, predicted ones, too."""

    @staticmethod
    def of(data: ParticleSet, weights: Array | None) -> InnovationsView:
        bare = InnovationsView(1.0, np.ones(N_NEW), weights)
        sizes = np.sqrt((bare.ahead(data.positions_nm) ** 2).mean(axis=(0, 2, 3)))
        return InnovationsView(WindowView.of(data, weights).scale_nm, sizes, weights)

    def ahead(self, windows: Array) -> Array:
        before = [self._base(windows[:, at : at + N_GIVEN])[:, :1] for at in range(N_NEW)]
        return (windows[:, N_GIVEN:] - np.concatenate(before, axis=1)) / self.scales_nm[:, None, None]

    def from_model(self, given: Array, seen: Array) -> Array:
        x = given
        for k, scale in enumerate(self.scales_nm):
            x = np.concatenate([x, self._base(x[:, -N_GIVEN:])[:, :1] + scale * seen[:, k : k + 1]], axis=1)
        return x[:, N_GIVEN:]


def next_velocities(data: ParticleSet) -> Array:
    """Return the velocities `(n, n_particles, 3)` nm/ps of the first frame to predict, about their mean."""
    v = data.velocities_nm_ps[:, N_GIVEN]
    return v - v.mean(axis=1, keepdims=True)
