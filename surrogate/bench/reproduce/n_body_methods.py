"""The methods of the n-body tasks: each is trained on a set of particle systems and forecasts another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surrogate.bench.reproduce.forecast_errors import forecast_errors
from surrogate.bench.reproduce.forecast_methods import (
    N_GIVEN,
    N_NEW,
    Array,
    Fitted,
    Settings,
    beyond,
    constant_velocity,
    extrapolate,
    extrapolated,
    frozen,
    latent_forecaster,
    n_parameters,
    polynomial_weights,
    sampled,
)
from surrogate.data.particle_sets import ParticleSet


def best_polynomial(data: ParticleSet) -> tuple[int, int, Array]:
    """Return the degree, the points and the weights with the least ADE on a set."""
    given, truth = data.positions_nm[:, :N_GIVEN], data.positions_nm[:, N_GIVEN:]
    tried = []
    for n_points in range(1, N_GIVEN + 1):
        for degree in range(n_points):
            weights = polynomial_weights(degree, n_points)
            ade = forecast_errors(extrapolate(given, weights)[None], truth)[0].mean()
            tried.append((float(ade), degree, n_points, weights))
    _, degree, n_points, weights = min(tried, key=lambda entry: entry[0])
    return degree, n_points, weights


def polynomial(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted[ParticleSet]:
    """The polynomial through the last given frames whose degree and number of frames suit the validation set best."""
    degree, n_points, weights = best_polynomial(validation)
    return extrapolated(weights, f"positions; degree {degree} through the last {n_points} frames")


def egnn(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted[ParticleSet]:
    """EGNN from the last given frame and its velocity, as in the published row (told of charges and springs)."""
    import torch

    from surrogate.models.particles.model import EgnnJump, EgnnJumpConfig
    from surrogate.models.particles.trainer import Tensors, held_jumps, jumps_of, train_egnn

    training = settings.training("egnn")
    config = EgnnJumpConfig(n_new=N_NEW, lag_ps=train.lag_ps, from_velocity=settings.from_velocity)
    model = EgnnJump(config)
    draw = jumps_of(train, N_GIVEN, any_start=settings.any_start)
    seconds = train_egnn(model, draw, [held_jumps(validation, N_GIVEN)], training)
    model.cpu()
    last = N_GIVEN - 1

    @torch.no_grad()
    def forecast(data: ParticleSet, given: Array, n_samples: int) -> Array:
        t = Tensors.of(data)
        return model.all_frames(t.x[:, last], t.v[:, last], t.types, t.pairs).double().numpy()[None]

    more = beyond({"any start": settings.any_start, "moved on at its velocity": settings.from_velocity})
    return Fitted(forecast, f"last frame and velocity, pair kinds{more}", seconds, n_parameters(model))


def pair_forces(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted[ParticleSet]:
    """A learned force between each pair, integrated; from given positions alone, told of charges and springs."""
    import torch

    from surrogate.models.particles.model import PairForces, PairForcesConfig
    from surrogate.models.particles.trainer import train_pair_forces

    training = settings.training("pair-forces")
    model = PairForces(PairForcesConfig(lag_ps=train.lag_ps))
    seconds = train_pair_forces(model, train, validation, training)
    model.double()

    @torch.no_grad()
    def forecast(data: ParticleSet, given: Array, n_samples: int) -> Array:
        return model.forecast(torch.from_numpy(given), torch.from_numpy(data.pairs), N_NEW).numpy()[None]

    note = (
        f"last {model.config.velocity_frames} positions, pair kinds; beyond the papers: integrates learned pair forces"
    )
    return Fitted(forecast, note, seconds, n_parameters(model))


def lam_slide(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted[ParticleSet]:
    """LaM-SLidE: ten given frames, random identifiers and rotations, loss on predicted frames; told of charges."""
    import torch

    from surrogate.models.lam_slide.config import AutoencoderConfig
    from surrogate.models.particles.trainer import encode_windows, train_lam_slide_on_windows, turned_windows

    training = settings.training("lam-slide")
    degree, _, weights = best_polynomial(validation) if settings.extrapolate else (0, 0, None)
    view = WindowView.of(train, weights)
    autoencoder = AutoencoderConfig(
        n_latents=2, latent_dim=32, width=64, identifier_pool=train.n_particles, n_octaves=3, type_weight=0.0
    )
    model = latent_forecaster(settings, autoencoder, latents_per_token=2, width=128, n_layers=4)
    held = validation.first(min(100, len(validation)))
    seen = [(torch.from_numpy(view.to_model(s.positions_nm)).float(), torch.from_numpy(s.types)) for s in (train, held)]
    seconds = train_lam_slide_on_windows(model, turned_windows(*seen[0]), [seen[1]], training)
    model.cpu().eval()

    @torch.no_grad()
    def forecast(data: ParticleSet, given: Array, n_samples: int) -> Array:
        n, types = data.n_particles, torch.from_numpy(data.types)
        known = encode_windows(model, torch.from_numpy(view.given(given)).float(), types)
        generator = torch.Generator().manual_seed(settings.seed)
        seen_ahead = sampled(model, known, n, n_samples, settings, generator)
        return np.stack([view.from_model(given, sample) for sample in seen_ahead])

    more = beyond({f"corrects a polynomial of degree {degree}": settings.extrapolate,
                   "loss on predicted frames alone": settings.predicted_only})  # fmt: skip
    return Fitted(
        forecast, f"positions, charges, {settings.solver_steps} solver steps{more}", seconds, n_parameters(model)
    )


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

    def to_model(self, windows: Array) -> Array:
        given, ahead = windows[:, :N_GIVEN], windows[:, N_GIVEN:]
        rest = (ahead - self._base(given)) / self.scales_nm[:, None, None]
        return np.concatenate([self.given(given), rest], axis=1)

    def from_model(self, given: Array, seen: Array) -> Array:
        """Given frames and predicted ones as the model sees them -> predicted positions, nm."""
        return self._base(given) + seen * self.scales_nm[:, None, None]

    def _base(self, given: Array) -> Array:
        return _centre(given) if self.weights is None else extrapolate(given, self.weights)


def _centre(given: Array) -> Array:
    return given[:, -1:].mean(axis=2, keepdims=True)


METHODS: dict[str, Callable[[ParticleSet, ParticleSet, Settings], Fitted[ParticleSet]]] = {
    "frozen": lambda train, validation, settings: frozen(),
    "constant-velocity": lambda train, validation, settings: constant_velocity(),
    "polynomial": polynomial,
    "egnn": egnn,
    "lam-slide": lam_slide,
    "pair-forces": pair_forces,
}
