"""The methods of the n-body tasks: each is trained on a set of particle systems and forecasts another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from forecast_errors import forecast_errors
from forecast_methods import (
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
from n_body_views import ParticleView, WindowView
from particle_sets import ParticleSet

if TYPE_CHECKING:
    from surrogate.models.lam_slide.model import LamSlide

# Systems that are forecast at once.
_BLOCK = 250


def best_polynomial(data: ParticleSet) -> tuple[int, int, Array]:
    """Return the degree, the points and the weights with the least ADE on a set."""
    given, reference = data.positions_nm[:, :N_GIVEN], data.positions_nm[:, N_GIVEN:]
    tried = []
    for n_points in range(1, N_GIVEN + 1):
        for degree in range(n_points):
            weights = polynomial_weights(degree, n_points)
            ade = forecast_errors(extrapolate(given, weights)[None], reference)[0].mean()
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
    from forecaster_training import Tensors, held_jumps, jumps_of, train_egnn
    from particle_models import EgnnJump, EgnnJumpConfig

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
    from forecaster_training import train_pair_forces
    from particle_models import PairForces, PairForcesConfig

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
    """LaM-SLidE: ten given frames, random identifiers and rotations, loss on predicted frames; told of charges, which
    its code of a frame must give back, or it would leave them out."""
    import torch
    from forecaster_training import (
        PAPER_SIZES,
        StageSizes,
        encode_windows,
        train_lam_slide_on_windows,
        turned_windows,
    )

    training = settings.training("lam-slide")
    degree, _, weights = best_polynomial(validation) if settings.extrapolate else (0, 0, None)
    view = WindowView.of(train, weights)
    model = set_forecaster(settings, train.n_particles)
    held = validation.first(min(100, len(validation)))
    seen = [(torch.from_numpy(view.to_model(s.positions_nm)).float(), torch.from_numpy(s.types)) for s in (train, held)]
    sizes = PAPER_SIZES if settings.paper_size or settings.paper_form else StageSizes()
    seconds = train_lam_slide_on_windows(model, turned_windows(*seen[0]), [seen[1]], training, sizes)
    model.eval()
    device = torch.device(settings.device)

    @torch.no_grad()
    def forecast(data: ParticleSet, given: Array, n_samples: int) -> Array:
        generator, found = torch.Generator().manual_seed(settings.seed), []
        for start in range(0, len(data), _BLOCK):
            rows = slice(start, start + _BLOCK)
            seen_given = torch.from_numpy(view.given(given[rows])).float().to(device)
            known = encode_windows(model, seen_given, torch.from_numpy(data.types[rows]).to(device))
            drawn = sampled(model, known, data.n_particles, n_samples, settings, generator)
            found.append(np.stack([view.from_model(given[rows], sample) for sample in drawn]))
        return np.concatenate(found, axis=1)

    more = beyond({f"corrects a polynomial of degree {degree}": settings.extrapolate,
                   "loss on predicted frames alone": settings.predicted_only})  # fmt: skip
    return Fitted(
        forecast, f"positions, charges, {settings.solver_steps} solver steps{more}", seconds, n_parameters(model)
    )


def set_forecaster(settings: Settings, n_particles: int) -> LamSlide:
    """Return LaM-SLidE with a set of latents: joined in a token, for a CPU; of the paper's form, a token for each
    latent of each frame and random identifiers, of half its width and latents; or of the published sizes (Table 10)."""
    from surrogate.models.lam_slide.model import AutoencoderConfig

    code = AutoencoderConfig(identifier_pool=n_particles, latent_dim=32, n_octaves=3, type_weight=0.1)
    if settings.paper_size or settings.paper_form:
        n_latents, width = (16, 256) if settings.paper_size else (8, 128)
        code = replace(code, identifier_pool=max(10, n_particles), n_latents=n_latents, n_heads=2, head_dim=16,
                       identifier_dim=128, n_decoder_layers=1, latent_noise=0.0, random_identifiers=1.0)  # fmt: skip
        return latent_forecaster(settings, code, latents_per_token=1, width=width, n_layers=6, plain_flow=True)
    code = replace(code, n_latents=2, width=64)
    return latent_forecaster(settings, code, latents_per_token=2, width=128, n_layers=4, plain_flow=True)


def lam_slide_particles(train: ParticleSet, validation: ParticleSet, settings: Settings) -> Fitted[ParticleSet]:
    """LaM-SLidE with particles as their own latents, all that one will do in one token; told of charges and springs."""
    import torch
    from particle_flow import ParticleFlow, ParticleFlowConfig
    from particle_flow_training import sample_ahead, train_particle_flow

    training = settings.training("lam-slide-particles")
    degree, _, weights = best_polynomial(validation) if settings.extrapolate else (0, 0, None)
    view = ParticleView.of(train, weights)
    held = validation.first(min(100, len(validation)))
    seen = view.to_model(held.positions_nm, held)
    n_features = seen.given.features.shape[-1]
    model = ParticleFlow(ParticleFlowConfig(n_features, n_new=N_NEW, pair_messages=settings.pair_messages))
    draw = view.drawn(train, mirrored=settings.mirrored)
    seconds = train_particle_flow(model, draw, [seen], training)
    model.eval()

    def forecast(data: ParticleSet, given: Array, n_samples: int) -> Array:
        known = view.known(given, data).to(torch.device(settings.device))
        generator = torch.Generator().manual_seed(settings.seed)
        samples = [sample_ahead(model, known, settings.solver_steps, generator) for _ in range(n_samples)]
        return np.stack([view.from_model(given, x.double().cpu().numpy()) for x in samples])

    more = beyond({"particles are latents": True, f"corrects a polynomial of degree {degree}": settings.extrapolate,
                   "mirrored in space and time": settings.mirrored,
                   "messages along pairs": settings.pair_messages})  # fmt: skip
    return Fitted(
        forecast, f"positions, pair kinds, {settings.solver_steps} Euler steps{more}", seconds, n_parameters(model)
    )


METHODS: dict[str, Callable[[ParticleSet, ParticleSet, Settings], Fitted[ParticleSet]]] = {
    "frozen": lambda train, validation, settings: frozen(),
    "constant-velocity": lambda train, validation, settings: constant_velocity(),
    "polynomial": polynomial,
    "egnn": egnn,
    "lam-slide": lam_slide,
    "lam-slide-particles": lam_slide_particles,
    "pair-forces": pair_forces,
}
