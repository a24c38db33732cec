"""LaM-SLidE: its settings, autoencoder and latent flow model, and both joined: frames -> latents -> next frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from surrogate.models import layers
from surrogate.models.architecture import ModelConfig
from surrogate.models.lam_slide import flow
from surrogate.models.propagator import Chunk, Molecule, Propagator, row_by_row
from systems.errors import InputError


@dataclass(frozen=True)
class AutoencoderConfig:
    """Stage one (Tables 8 to 12; small sizes). `latent_noise` is the standard deviation added to latents in training:
    with LayerNorm bounding their power it makes the encoder spend latent variance where positions need it."""

    n_latents: int = 4
    latent_dim: int = 24
    width: int = 128
    n_heads: int = 4
    head_dim: int = 32
    identifier_dim: int = 64
    identifier_pool: int = 32
    n_octaves: int = 4
    n_encoder_layers: int = 1
    n_decoder_layers: int = 2
    latent_noise: float = 0.03
    position_weight: float = 1.0
    distance_weight: float = 1.0
    type_weight: float = 0.01
    # Share of stage-one samples whose identifiers are drawn at random (Algorithm 1; 1.0 is the paper). The others get
    # the canonical assignment, which is what stage two and rollouts use; one molecule learns it faster.
    random_identifiers: float = 0.0


@dataclass(frozen=True)
class ApproximatorConfig:
    """Stage two. `precondition` scales skip and output of the data prediction by the flow time so that its error
    vanishes with the noise (Karras 2022, for this path)."""

    chunk_frames: int = 32
    n_conditioning: int = 1
    # Latent vectors joined into one token of the transformer: 1 as in the paper, more for fewer and wider tokens.
    latents_per_token: int = 4
    width: int = 256
    n_layers: int = 7
    n_heads: int = 4
    precondition: bool = True
    # Conditioning frames see neither the flow time nor the frames that follow them, so that a chunk's evaluations
    # compute them once; False is the paper.
    clean_conditioning: bool = False
    # Given frames count in the loss beside the predicted ones, as in the paper's code.
    loss_on_given: bool = False
    # Flow times are logit-normal: a positive location draws more of them near the data end. Uniform is the paper.
    uniform_tau: bool = False
    tau_location: float = 0.5
    tau_scale: float = 1.4
    position_weight: float = 0.25
    distance_weight: float = 0.25
    auxiliary_frames: int = 4
    # Shortest and longest spacing of frames, in ps, which the network takes as an input. None: one spacing alone.
    lag_range_ps: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.loss_on_given and self.clean_conditioning:
            raise InputError("approximator.loss_on_given: with clean_conditioning given frames come back as they are.")


@dataclass(frozen=True)
class LamSlideConfig(ModelConfig):
    """The whole model. `canonical`: frames are superposed on the template by heavy atoms (exact SE(3) equivariance);
    without it, training rotates at random instead (the paper's augmentation)."""

    canonical: bool = True
    position_scale_nm: float = 0.2
    autoencoder: AutoencoderConfig = field(default_factory=AutoencoderConfig)
    approximator: ApproximatorConfig = field(default_factory=ApproximatorConfig)

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> LamSlideConfig:
        """See `ModelConfig.from_dict`; the interpolant that older weights name is always the linear one."""
        stage_two = record.get("approximator")
        if isinstance(stage_two, dict) and stage_two.get("interpolant") == "linear":
            record = record | {"approximator": {k: v for k, v in stage_two.items() if k != "interpolant"}}
        return super().from_dict(record)


# Stage one: a cross-attention encoder into a few latent vectors and a decoder queried by identifier (section 3.3).

MAX_ATOMIC_NUMBER = 54


def draw_identifiers(n_atoms: int, pool: int, batch: int, generator: torch.Generator | None) -> Tensor:
    """Algorithm 1: for each batch row, `n_atoms` different identifiers from the pool: `(batch, n_atoms)` int64."""
    if n_atoms > pool:
        raise ValueError(f"{n_atoms} atoms need an identifier pool of at least that size, not {pool}")
    device = generator.device if generator is not None else None
    return torch.rand(batch, pool, generator=generator, device=device).argsort(dim=1)[:, :n_atoms]


@dataclass(frozen=True)
class Decoded:
    """Positions `(b, n_atoms, 3)` in scaled units and, when asked for, logits `(b, n_atoms, types)` of the elements."""

    positions: Tensor
    type_logits: Tensor | None


class Autoencoder(nn.Module):
    """Encoder [x, m, u] -> Z (Algorithm 2) and decoder Z, u -> x, m (Algorithm 3)."""

    def __init__(self, config: AutoencoderConfig) -> None:
        super().__init__()
        self.config = c = config
        self.n_latents, self.latent_dim = c.n_latents, c.latent_dim
        self.identifiers = nn.Embedding(c.identifier_pool, c.identifier_dim)
        self.elements = nn.Embedding(MAX_ATOMIC_NUMBER + 1, 16)
        coordinate_dim = 3 * (1 + 2 * c.n_octaves)
        # Identifiers bind to coordinates by a product, so that a sum over atoms can be taken apart again.
        self.embed_coordinates = nn.Linear(coordinate_dim, c.width)
        self.embed_entity = nn.Linear(16 + c.identifier_dim, 2 * c.width)
        dense = (nn.Linear(c.width, c.width), nn.GELU(approximate="tanh"), nn.Linear(c.width, c.width))
        self.embed = nn.Sequential(*dense)
        self.queries = nn.Parameter(torch.randn(c.n_latents, c.width) * 0.5)
        self.encoder = nn.ModuleList(
            layers.CrossAttentionBlock(c.width, c.width, c.n_heads, c.head_dim) for _ in range(c.n_encoder_layers)
        )
        self.to_latent = nn.Linear(c.width, c.latent_dim)
        self.query = nn.Linear(c.identifier_dim, c.width)
        self.decoder = nn.ModuleList(
            layers.CrossAttentionBlock(c.width, c.latent_dim, c.n_heads, c.head_dim, gated=True)
            for _ in range(c.n_decoder_layers)
        )
        self.to_position = nn.Sequential(nn.LayerNorm(c.width), nn.Linear(c.width, 3))
        self.to_element = nn.Sequential(nn.LayerNorm(c.width), nn.Linear(c.width, MAX_ATOMIC_NUMBER + 1))

    def encode(self, x: Tensor, elements: Tensor, identifiers: Tensor) -> Tensor:
        """Positions `(b, n, 3)` (scaled), atomic numbers and identifiers `(b, n)` -> latents `(b, n_latents, dim)`."""
        entity = self.embed_entity(torch.cat([self.elements(elements), self.identifiers(identifiers)], dim=-1))
        scale, shift = entity.chunk(2, dim=-1)
        tokens = self.embed_coordinates(layers.fourier_features(x, self.config.n_octaves)) * scale + shift
        tokens = tokens + self.embed(tokens)
        latents = self.queries.expand(x.shape[0], -1, -1)
        for block in self.encoder:
            latents = block(latents, tokens)
        z = self.to_latent(latents).float()
        return F.layer_norm(z, (self.config.latent_dim,))

    def decode(self, latents: Tensor, identifiers: Tensor, *, with_types: bool = False) -> Decoded:
        """Latents `(b, n_latents, dim)`, identifiers `(b, n)` -> positions `(b, n, 3)` (scaled), element logits."""
        context = F.layer_norm(latents, (self.config.latent_dim,))
        # The residual stream and the last layer stay in float32: bf16 would round positions to 0.001 nm.
        h = self.query(self.identifiers(identifiers)).float()
        for block in self.decoder:
            h = block(h, context)
        logits = self.to_element(h).float() if with_types else None
        with torch.autocast(h.device.type, enabled=False):
            return Decoded(self.to_position(h.float()), logits)


# Stage two: the latent flow model, transformer layers alternating over latents and time (Algorithms 4 and 5).

Rope = tuple[Tensor, Tensor]
# Keys and values of the conditioning frames, layer by layer.
Memory = list[layers.KeysValues]


class LagEmbedding(nn.Module):
    """How far apart frames are to be: the place of the lag's logarithm in the trained range, in waves long enough that
    between two trained lags nothing but a smooth line can be learned."""

    def __init__(self, width: int, lag_range_ps: tuple[float, float]) -> None:
        super().__init__()
        self.lag_range_ps = lag_range_ps
        self.frequency = nn.Buffer(math.pi * torch.tensor([0.5, 1.0, 2.0, 3.0]), persistent=False)
        self.of_lag = nn.Sequential(nn.Linear(9, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, lag_ps: Tensor) -> Tensor:
        """Lags `(b,)` in ps -> `(b, width)`."""
        low, high = (math.log(lag) for lag in self.lag_range_ps)
        place = ((lag_ps.float().log() - low) / max(high - low, 1e-6))[:, None]
        angles = place * self.frequency
        return cast(Tensor, self.of_lag(torch.cat([place, angles.sin(), angles.cos()], dim=-1)))


class LatentLayer(nn.Module):
    """Algorithm 5: one parallel block along the latent dimension, one along time. With a single latent vector there is
    nothing to attend to along the first, and its block is left out."""

    def __init__(self, width: int, n_heads: int, n_latents: int) -> None:
        super().__init__()
        self.spatial = layers.ParallelBlock(width, n_heads) if n_latents > 1 else None
        self.temporal = layers.ParallelBlock(width, n_heads)

    def forward(
        self, o: Tensor, modulation: Tensor, rope_latent: Rope, rope_time: Rope, past: layers.KeysValues | None = None
    ) -> tuple[Tensor, layers.KeysValues]:
        """`o` (b, L, T, width), `modulation` (b, 6, width): three for each block; `past` of earlier frames."""
        if self.spatial is not None:
            o = self.spatial(o.transpose(1, 2), modulation[:, :3], rope_latent)[0].transpose(1, 2)
        return self.temporal(o, modulation[:, 3:], rope_time, past)


class Approximator(nn.Module):
    """Data prediction network: noisy latents of a chunk, flow time, conditioning latents -> clean latents."""

    def __init__(self, config: ApproximatorConfig, n_latents: int, latent_dim: int) -> None:
        super().__init__()
        self.config = c = config
        self.per_token = c.latents_per_token
        if n_latents % self.per_token:
            raise InputError(f"latents_per_token = {self.per_token} does not divide {n_latents} latents.")
        n_latents, latent_dim = n_latents // self.per_token, latent_dim * self.per_token
        self.embed_noisy = nn.Linear(latent_dim, c.width)
        self.embed_conditioning = nn.Linear(latent_dim, c.width)
        self.embed_mask = nn.Embedding(2, c.width)
        self.embed_latent = nn.Parameter(torch.randn(n_latents, c.width) * 0.02)
        self.embed_time = layers.TimeEmbedding(c.width)
        self.layers = nn.ModuleList(LatentLayer(c.width, c.n_heads, n_latents) for _ in range(c.n_layers))
        self.modulation = nn.Linear(c.width, 6 * c.width)
        self.final_modulation = nn.Linear(c.width, 2 * c.width)
        self.final = nn.Linear(c.width, latent_dim)
        self.embed_lag = None if c.lag_range_ps is None else LagEmbedding(c.width, c.lag_range_ps)
        for module in (self.modulation, self.final_modulation, self.final):
            nn.init.zeros_(module.weight)
            nn.init.zeros_(module.bias)
        head_dim = c.width // c.n_heads
        of_time, of_latent = (layers.rotary_angles(n, head_dim) for n in (c.chunk_frames, n_latents))
        self.cos_time, self.sin_time = (nn.Buffer(x, persistent=False) for x in (of_time.cos(), of_time.sin()))
        self.cos_latent, self.sin_latent = (nn.Buffer(x, persistent=False) for x in (of_latent.cos(), of_latent.sin()))

    def forward(
        self, o: Tensor, tau: Tensor, conditioning: Tensor, memory: Memory | None = None, lag: Tensor | None = None
    ) -> Tensor:
        """Return the predicted data `(b, T, L, dim)`.

        `o` (b, T, L, dim) noisy latents, of which the first frames are replaced by `conditioning` (b, n_conditioning,
        L, dim), clean ones; `tau` (b,). With `clean_conditioning` these come back as they are, and `memory` is what
        `remember` returns, once a chunk. `lag` (b, width): the embedded lag, for a network that takes it.
        """
        c = self.config
        time = self.embed_time(tau) if lag is None else self.embed_time(tau) + lag
        if c.clean_conditioning:
            known = self.remember(conditioning, lag) if memory is None else memory
            n_known = conditioning.shape[1]
            found = self._denoise(o[:, n_known:], tau, lambda x: self._network_after(x, time, known, n_known))
            return torch.cat([conditioning.to(found.dtype), found], dim=1)
        return self._denoise(o, tau, lambda x: self._network(x, time, conditioning))

    def remember(self, conditioning: Tensor, lag: Tensor | None = None) -> Memory:
        """Return keys and values of clean frames `(b, n_conditioning, L, dim)`, which see each other alone and no flow
        time but that of the data (tau = 1)."""
        h = self.embed_conditioning(self._tokens(conditioning)) + self.embed_mask.weight[1] + self.embed_latent
        time = self.embed_time(torch.ones(len(h), device=h.device))
        modulation, _ = self._modulations(time if lag is None else time + lag)
        memory: Memory = []
        h = h.transpose(1, 2)
        for layer in self.layers:
            h, kept = layer(h, modulation, *self._ropes(0, conditioning.shape[1]))
            memory.append(kept)
        return memory

    def _denoise(self, o: Tensor, tau: Tensor, network: Callable[[Tensor], Tensor]) -> Tensor:
        if not self.config.precondition:
            return network(o)
        skip, out, scale_in = (flow.expand(v, o) for v in flow.preconditioning(tau))
        return skip * o + out * network(o * scale_in)

    def _network(self, o: Tensor, time: Tensor, conditioning: Tensor) -> Tensor:
        shape = o.shape
        o, conditioning = self._tokens(o), self._tokens(conditioning)
        n_known, n_frames = conditioning.shape[1], o.shape[1]
        known = torch.zeros(n_frames, dtype=torch.long, device=o.device)
        known[:n_known] = 1
        padded = F.pad(conditioning, (0, 0, 0, 0, 0, n_frames - n_known))
        noisy = torch.where(known[None, :, None, None] == 1, 0.0, o)
        h = self.embed_noisy(noisy) + self.embed_conditioning(padded)
        h = h + self.embed_mask(known)[None, :, None, :] + self.embed_latent
        return self._transform(h, time, 0, [None] * len(self.layers)).reshape(shape)

    def _network_after(self, o: Tensor, time: Tensor, memory: Memory, n_known: int) -> Tensor:
        h = self.embed_noisy(self._tokens(o)) + self.embed_mask.weight[0] + self.embed_latent
        return self._transform(h, time, n_known, memory).reshape(o.shape)

    def _transform(self, h: Tensor, time: Tensor, first: int, past: Sequence[layers.KeysValues | None]) -> Tensor:
        """Embedded frames `(b, T, L, width)`, of which the first has the place `first`, through all layers."""
        modulation, final_modulation = self._modulations(time)
        ropes = self._ropes(first, h.shape[1])
        h = h.transpose(1, 2)
        for layer, before in zip(self.layers, past, strict=True):
            h, _ = layer(h, modulation, *ropes, before)
        shift, scale = final_modulation[:, None, None, :].chunk(2, dim=-1)
        h = F.layer_norm(h.transpose(1, 2), h.shape[-1:]) * (1.0 + scale) + shift
        return self.final(h).float()

    def _tokens(self, o: Tensor) -> Tensor:
        return o if self.per_token == 1 else o.unflatten(2, (-1, self.per_token)).flatten(-2)

    def _modulations(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """From the embedded flow time `(b, width)`, lag included where the network takes it."""
        time = F.silu(time)
        return self.modulation(time).unflatten(-1, (6, -1)), self.final_modulation(time)

    def _ropes(self, first: int, n_frames: int) -> tuple[Rope, Rope]:
        frames = slice(first, first + n_frames)
        return (self.cos_latent, self.sin_latent), (self.cos_time[frames], self.sin_time[frames])


# Both stages joined.


class LamSlide(Propagator):
    """Encoder, approximator and decoder (section 3), behind the contract of `surrogate.models.propagator`.

    Latents are used as (z - mean) / scale with a mean per component and one common scale of the training frames.
    """

    arch: ClassVar[str] = "lam-slide"
    float32_layers: tuple[str, ...] = ("autoencoder.to_position",)
    solvers: tuple[str, ...] = ("multistep", "fitted", "euler", "dopri5")
    config: LamSlideConfig

    def __init__(self, config: LamSlideConfig) -> None:
        super().__init__()
        self.config = config
        self.n_conditioning = config.approximator.n_conditioning
        n_latents, latent_dim = config.autoencoder.n_latents, config.autoencoder.latent_dim
        self.autoencoder = Autoencoder(config.autoencoder)
        self.approximator = Approximator(config.approximator, n_latents, latent_dim)
        self.lag_range_ps = config.approximator.lag_range_ps
        self.lag_ps = self.lag_range_ps[0] if self.lag_range_ps else None
        self.latent_mean = nn.Buffer(torch.zeros(n_latents, latent_dim))
        self.latent_scale = nn.Buffer(torch.ones(()))

    @property
    def n_new(self) -> int:
        return self.config.approximator.chunk_frames - self.n_conditioning

    def identifiers(self, n_atoms: int) -> Tensor:
        """The canonical assignment `(n_atoms,)`: identifier k for the template's atom k."""
        return torch.arange(n_atoms, device=self.latent_mean.device)

    def embedded_lag(self, lag_ps: Tensor | None, rows: int) -> Tensor | None:
        """Return the lags `(rows,)` (the model's own where None) as the latent flow takes them, `(rows, width)`; None
        of a model of one lag."""
        if self.approximator.embed_lag is None:
            return None
        if lag_ps is None:
            assert self.lag_ps is not None
            lag_ps = torch.full((rows,), self.lag_ps, device=self.latent_mean.device)
        return cast(Tensor, self.approximator.embed_lag(lag_ps))

    def encode(self, frames_nm: Tensor, elements: Tensor) -> Tensor:
        """Frames `(..., n_atoms, 3)` nm -> latents `(..., n_latents, latent_dim)`."""
        lead, n_atoms = frames_nm.shape[:-2], frames_nm.shape[-2]
        x = frames_nm.reshape(-1, n_atoms, 3).float() / self.config.position_scale_nm
        rows = x.shape[0]
        z = self.autoencoder.encode(x, elements.expand(rows, n_atoms), self.identifiers(n_atoms).expand(rows, -1))
        return ((z - self.latent_mean) / self.latent_scale).unflatten(0, lead)

    def decode(self, latents: Tensor, n_atoms: int) -> Tensor:
        """Latents `(..., n_latents, latent_dim)` -> frames `(..., n_atoms, 3)` nm."""
        lead = latents.shape[:-2]
        z = latents.reshape(-1, *latents.shape[-2:]) * self.latent_scale + self.latent_mean
        # Identifiers are those of all frames: what follows from them alone is computed once.
        x = self.autoencoder.decode(z, self.identifiers(n_atoms)[None]).positions
        return (x * self.config.position_scale_nm).unflatten(0, lead)

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        ae = self.config.autoencoder
        return (self.config.approximator.chunk_frames, ae.n_latents, ae.latent_dim)

    def next_chunk(self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 10,
                   solver: str | None = None, last_velocities_nm_ps: Tensor | None = None) -> Chunk:  # fmt: skip
        """See `Propagator.next_chunk`. Velocities play no part."""
        if solver in flow.ADAPTIVE and len(noise) > 1:
            draw = partial(self.next_chunk, solver_steps=solver_steps, solver=solver)
            return row_by_row(lambda x, own: draw(x, molecule, own), last_frames_nm, noise)
        # Frames that training turned at random, it had about their middle.
        middle_nm = 0.0 if self.config.canonical else last_frames_nm[:, -1:].mean(-2, keepdim=True)
        known = self.encode(last_frames_nm - middle_nm, molecule.elements)
        lag = self.embedded_lag(None, len(known))
        memory = self.approximator.remember(known, lag) if self.config.approximator.clean_conditioning else None
        evaluations = 0

        def predict(o: Tensor, tau: Tensor) -> Tensor:
            nonlocal evaluations
            evaluations += 1
            return self.approximator(o, tau, known, memory, lag)

        latents = flow.SOLVERS[solver or self.solvers[0]](predict, noise, solver_steps)
        frames = self.decode(latents[:, self.n_conditioning :], last_frames_nm.shape[-2])
        return Chunk(frames + middle_nm, evaluations=float(evaluations))
