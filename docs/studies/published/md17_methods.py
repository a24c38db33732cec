"""The methods of the MD17 task: each is fitted to all molecules at once and forecasts any one of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from forecast_methods import (
    N_GIVEN,
    N_NEW,
    Fitted,
    Settings,
    beyond,
    constant_velocity,
    frozen,
    latent_forecaster,
    motion_sizes,
    n_parameters,
    sampled,
)
from md17_views import ELEMENTS, Array, AtomView, BodyFrame, LinearForecast, MoleculeView
from molecule_windows import MoleculeWindows

if TYPE_CHECKING:
    import torch

    from surrogate.models.lam_slide.model import LamSlide

_HELD = 32
_BLOCK = 250


def normal_modes(molecules: Sequence[MoleculeWindows], settings: Settings) -> Fitted[MoleculeWindows]:
    """Independent modes, each an autoregression over two frames (`models.baselines.NormalModes`), without its noise."""
    import torch

    from surrogate.models.baselines import NormalModes
    from surrogate.models.propagator import Molecule

    models: dict[str, NormalModes] = {}
    for m in molecules:
        starts = m.every_start["train"]
        triples = m.windows(starts[:: max(1, len(starts) // 10_000)])[:, N_GIVEN - 3 : N_GIVEN]
        models[m.name] = NormalModes.of(_inside_each(m, triples)[1], N_NEW)

    @torch.no_grad()
    def forecast(m: MoleculeWindows, given: Array, n_samples: int) -> Array:
        model = models[m.name]
        body, inside = _inside_each(m, given[:, -2:])
        noise = torch.zeros(len(given), *model.noise_shape(m.n_atoms))
        about = Molecule(torch.from_numpy(m.elements), torch.ones(m.n_atoms), torch.zeros((0, 2), dtype=torch.int64))
        chunk = model.next_chunk(torch.from_numpy(inside).float(), about, noise)
        return body.leave(chunk.frames_nm.double().numpy())[None]

    return Fitted(forecast, "last two frames; one model a molecule")


def linear(molecules: Sequence[MoleculeWindows], settings: Settings) -> Fitted[MoleculeWindows]:
    """The best linear forecast from all given frames in the body frame (`LinearForecast`)."""
    by_name = {m.name: LinearForecast.fit(m) for m in molecules}

    def forecast(m: MoleculeWindows, given: Array, n_samples: int) -> Array:
        return by_name[m.name].forecast(m, given)[None]

    return Fitted(forecast, "ten frames; one model a molecule")


def egnn(molecules: Sequence[MoleculeWindows], settings: Settings) -> Fitted[MoleculeWindows]:
    """EGNN from the last given frame and the step to it, one model for all molecules, told of elements and bonds."""
    import torch
    from forecaster_training import Jump, train_egnn
    from particle_models import EgnnJump, EgnnJumpConfig

    training = settings.training("egnn")
    model = EgnnJump(
        EgnnJumpConfig(n_types=len(ELEMENTS), n_new=N_NEW, lag_ps=molecules[0].lag_ps, from_velocity=False)
    )

    def jump(m: MoleculeWindows, given: Array, reference: Array) -> Jump:
        last = given[:, -1]
        centre = last.mean(axis=1, keepdims=True)
        # Lengths in units of a bond's: 0.1 nm.
        x, v = 10.0 * (last - centre), 10.0 * (last - given[:, -2]) / m.lag_ps
        ahead = 10.0 * (reference - (centre if reference.ndim == 3 else centre[:, None]))
        types = torch.tensor([ELEMENTS.index(e) for e in m.elements.tolist()]).expand(len(given), -1)
        kinds = torch.from_numpy(m.kinds).expand(len(given), -1, -1)
        state = [torch.from_numpy(a).float() for a in (x, v, ahead)]
        return Jump(state[0], state[1], types, kinds, state[2])

    def draw(batch: int, frame: int, generator: torch.Generator) -> Jump:
        m = molecules[int(torch.randint(len(molecules), (1,), generator=generator))]
        windows = _drawn(m, batch, generator, any_start=settings.any_start)
        return jump(m, windows[:, :N_GIVEN], windows[:, N_GIVEN + frame])

    held = [jump(m, w[:, :N_GIVEN], w[:, N_GIVEN:]) for m, w in _held(molecules)]
    seconds = train_egnn(model, draw, held, training)

    @torch.no_grad()
    def forecast(m: MoleculeWindows, given: Array, n_samples: int) -> Array:
        found = []
        for begin in range(0, len(given), _BLOCK):
            block = given[begin : begin + _BLOCK]
            j = jump(m, block, block[:, -1]).to(torch.device(settings.device))
            ahead = model.all_frames(j.x, j.v, j.types, j.pairs).double().cpu().numpy() / 10.0
            found.append(ahead + block[:, -1:].mean(axis=2, keepdims=True))
        return np.concatenate(found)[None]

    note = "last two frames, bonds" + beyond({"any start": settings.any_start})
    return Fitted(forecast, note, seconds, n_parameters(model))


def lam_slide(molecules: Sequence[MoleculeWindows], settings: Settings) -> Fitted[MoleculeWindows]:
    """LaM-SLidE: ten given frames, one model for all molecules, told of elements."""
    import torch
    from forecaster_training import encode_windows, train_lam_slide_on_windows

    from surrogate.models.lam_slide.trainer import random_rotations

    views = {
        m.name: MoleculeView.of(
            m, canonical=settings.canonical, linear=LinearForecast.fit(m) if settings.extrapolate else None
        )
        for m in molecules
    }
    training, device = settings.training("lam-slide"), torch.device(settings.device)
    model = lam_slide_model(settings, large=settings.paper_size or device.type == "cuda")

    def seen(m: MoleculeWindows, windows: Array) -> tuple[torch.Tensor, torch.Tensor]:
        x = torch.from_numpy(views[m.name].to_model(windows)).float()
        return x, torch.from_numpy(m.elements).expand(len(x), -1)

    def draw(batch: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        m = molecules[int(torch.randint(len(molecules), (1,), generator=generator))]
        x, kinds = seen(m, _drawn(m, batch, generator, any_start=settings.any_start))
        return (x if settings.canonical else x @ random_rotations(batch, generator)[:, None].mT), kinds

    held = [seen(m, windows) for m, windows in _held(molecules)]
    seconds = train_lam_slide_on_windows(model, draw, held, training)
    model.eval()

    @torch.no_grad()
    def forecast(m: MoleculeWindows, given: Array, n_samples: int) -> Array:
        view = views[m.name]
        kinds, n = torch.from_numpy(view.molecule.elements).to(device), view.molecule.n_atoms
        x = torch.from_numpy(view.given(given)).float().to(device)
        generator, blocks = torch.Generator().manual_seed(settings.seed), []
        for begin in range(0, len(x), _BLOCK):
            known = encode_windows(model, x[begin : begin + _BLOCK], kinds.expand(len(x[begin : begin + _BLOCK]), -1))
            seen_ahead = sampled(model, known, n, n_samples, settings, generator)
            part = given[begin : begin + _BLOCK]
            blocks.append(np.stack([view.from_model(part, sample) for sample in seen_ahead]))
        return np.concatenate(blocks, axis=1)

    switches = {"body frame": settings.canonical, "corrects the linear forecast": settings.extrapolate,
                "any start": settings.any_start,
                "loss on predicted frames alone": settings.predicted_only,
                "clean conditioning frames": settings.clean_conditioning}  # fmt: skip
    return Fitted(
        forecast,
        f"ten frames, elements, {settings.solver_steps} solver steps{beyond(switches)}",
        seconds,
        n_parameters(model),
    )


def lam_slide_particles(molecules: Sequence[MoleculeWindows], settings: Settings) -> Fitted[MoleculeWindows]:
    """LaM-SLidE with atoms as their own latents, all that one will do in one token; one model for all molecules, told
    of elements and bonds, in the body frame."""
    import torch
    from particle_flow import ParticleFlow, ParticleFlowConfig
    from particle_flow_training import ParticleWindows, sample_ahead, train_particle_flow

    training = settings.training("lam-slide-particles")
    held = _held(molecules)
    # Lengths in units of a bond's: 0.1 nm.
    motions = [motion_sizes(BodyFrame.of(m, w).enter(w)[:, :N_GIVEN]) for m, w in held]
    sizes_nm = (0.1, *(sum(size) / len(size) for size in list(zip(*motions, strict=True))[1:]))
    views = {
        m.name: AtomView(
            MoleculeView.of(m, canonical=True, linear=LinearForecast.fit(m) if settings.extrapolate else None), sizes_nm
        )
        for m in molecules
    }

    def draw(batch: int, generator: torch.Generator) -> ParticleWindows:
        m = molecules[int(torch.randint(len(molecules), (1,), generator=generator))]
        return views[m.name].to_model(_drawn(m, batch, generator, any_start=settings.any_start))

    seen = [views[m.name].to_model(windows) for m, windows in held]
    config = ParticleFlowConfig(
        seen[0].given.features.shape[-1],
        n_types=len(ELEMENTS),
        n_pair_kinds=3,
        n_new=N_NEW,
        pair_messages=settings.pair_messages,
    )
    model = ParticleFlow(config)
    seconds = train_particle_flow(model, draw, seen, training)
    model.eval()

    def forecast(m: MoleculeWindows, given: Array, n_samples: int) -> Array:
        view, generator = views[m.name], torch.Generator().manual_seed(settings.seed)
        known = view.known(given).to(torch.device(settings.device))
        samples = [sample_ahead(model, known, settings.solver_steps, generator) for _ in range(n_samples)]
        return np.stack([view.from_model(given, x.double().cpu().numpy()) for x in samples])

    more = beyond({"atoms are latents": True, "body frame": True, "corrects the linear forecast": settings.extrapolate,
                   "any start": settings.any_start, "messages along pairs": settings.pair_messages})  # fmt: skip
    note = f"ten frames, elements, bonds, {settings.solver_steps} Euler steps{more}"
    return Fitted(forecast, note, seconds, n_parameters(model))


def lam_slide_model(settings: Settings, *, large: bool) -> LamSlide:
    """Return the model: Table 11's sizes where there is a GPU for them, else one of four latents in one token."""
    from surrogate.models.lam_slide.model import AutoencoderConfig

    autoencoder = AutoencoderConfig(n_latents=32 if large else 4, latent_dim=32, n_octaves=3, type_weight=0.01)
    if large:
        return latent_forecaster(settings, autoencoder, latents_per_token=1, width=128, n_layers=6)
    return latent_forecaster(settings, autoencoder, latents_per_token=4, width=192, n_layers=5)


def _drawn(m: MoleculeWindows, batch: int, generator: torch.Generator, *, any_start: bool) -> Array:
    import torch

    starts = (m.every_start if any_start else m.starts)["train"]
    return m.windows(starts[torch.randint(len(starts), (batch,), generator=generator).numpy()])


def _held(molecules: Sequence[MoleculeWindows]) -> list[tuple[MoleculeWindows, Array]]:
    return [(m, m.windows(m.starts["validation"][:: max(1, len(m.starts["validation"]) // _HELD)])) for m in molecules]


def _inside_each(m: MoleculeWindows, frames: Array) -> tuple[BodyFrame, Array]:
    """Lay every frame on the template by itself, as fitted baselines see them; return where the last one was too."""
    flat = frames.reshape(-1, 1, m.n_atoms, 3)
    inside = BodyFrame.of(m, flat).enter(flat).reshape(frames.shape)
    return BodyFrame.of(m, frames), inside


METHODS: Mapping[str, Callable[[Sequence[MoleculeWindows], Settings], Fitted[MoleculeWindows]]] = {
    "frozen": lambda molecules, settings: frozen(),
    "constant-velocity": lambda molecules, settings: constant_velocity(),
    "normal-modes": normal_modes,
    "linear": linear,
    "egnn": egnn,
    "lam-slide": lam_slide,
    "lam-slide-particles": lam_slide_particles,
}
