"""LaM-SLidE, both stages joined: frames -> latents -> next latents -> frames."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.network import Approximator, Autoencoder, LamSlideConfig
from surrogate.models.propagator import Chunk, Molecule, Propagator
from systems.errors import InputError

if TYPE_CHECKING:
    pass


class LamSlide(Propagator):
    """Encoder, approximator and decoder (section 3), behind the contract of `surrogate.models.propagator`.

    Latents are used as (z - mean) / scale with a mean per latent component and one common scale, both measured on the
    training frames: LayerNorm bounds their power but leaves constant offsets that carry no information.
    """

    arch: ClassVar[str] = "lam-slide"
    float32_layers: tuple[str, ...] = ("autoencoder.to_position",)
    config: LamSlideConfig
    latent_mean: Tensor
    latent_scale: Tensor

    def __init__(self, config: LamSlideConfig) -> None:
        super().__init__()
        self.config = config
        self.solvers = flow.solvers_for(config.approximator.interpolant)
        n_latents, latent_dim = config.autoencoder.n_latents, config.autoencoder.latent_dim
        self.autoencoder = Autoencoder(config.autoencoder)
        self.approximator = Approximator(config.approximator, n_latents, latent_dim)
        # Spacing of the frames that `next_chunk` returns: the shortest of the range, until `at_lag` sets another.
        self.lag_ps = config.approximator.lag_range_ps[0] if config.approximator.lag_range_ps else None
        self.register_buffer("latent_mean", torch.zeros(n_latents, latent_dim))
        self.register_buffer("latent_scale", torch.ones(()))

    @property
    def n_conditioning(self) -> int:
        return self.config.approximator.n_conditioning

    @property
    def n_new(self) -> int:
        return self.config.approximator.chunk_frames - self.n_conditioning

    def identifiers(self, n_atoms: int) -> Tensor:
        """The canonical assignment `(n_atoms,)`: identifier k for the template's atom k. Permuting a scene's atoms
        permutes identifiers with them: scenes are matched to the template before they get here."""
        return torch.arange(n_atoms, device=self.latent_mean.device)

    def at_lag(self, lag_ps: float) -> LamSlide:
        """Return this model, its weights shared, with frames `lag_ps` apart. Raises InputError outside its range."""
        known = self.config.approximator.lag_range_ps
        if known is None or not known[0] * (1 - 1e-6) <= lag_ps <= known[1] * (1 + 1e-6):
            raise InputError(f"a lag of {lag_ps:g} ps is none that this model was trained for.")
        model = copy.copy(self)
        model.lag_ps = lag_ps
        return model

    def embedded_lag(self, lag_ps: Tensor | None, rows: int) -> Tensor | None:
        """Return what the latent flow is told of the lags `(rows,)` asked for (the model's own where None), `(rows,
        width)`; None of a model of one lag."""
        if self.approximator.embed_lag is None:
            return None
        if lag_ps is None:
            assert self.lag_ps is not None
            lag_ps = torch.full((rows,), self.lag_ps, device=self.latent_mean.device)
        embedded: Tensor = self.approximator.embed_lag(lag_ps)
        return embedded

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
        solver = solver or self.solvers[0]
        if solver in flow.ADAPTIVE and len(noise) > 1:
            pairs = zip(last_frames_nm.split(1), noise.split(1), strict=True)
            rows = [self.next_chunk(x, molecule, n, solver_steps=solver_steps, solver=solver) for x, n in pairs]
            mean = sum(row.evaluations or 0.0 for row in rows) / len(rows)
            return Chunk(torch.cat([row.frames_nm for row in rows]), evaluations=mean)
        c = self.config.approximator
        # Frames that training turned at random, it had about their middle.
        middle_nm = 0.0 if self.config.canonical else last_frames_nm[:, -1:].mean(-2, keepdim=True)
        known = self.encode(last_frames_nm - middle_nm, molecule.elements)
        lag = self.embedded_lag(None, len(known))
        memory = self.approximator.remember(known, lag) if c.clean_conditioning else None
        evaluations = 0

        def predict(o: Tensor, tau: Tensor) -> Tensor:
            nonlocal evaluations
            evaluations += 1
            return self.approximator(o, tau, known, memory, lag)

        latents = flow.SOLVERS[solver](predict, noise, solver_steps, c.interpolant)
        frames = self.decode(latents[:, self.n_conditioning :], last_frames_nm.shape[-2])
        return Chunk(frames + middle_nm, evaluations=float(evaluations))
