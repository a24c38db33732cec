"""Train the forecasters of particle systems: `EgnnJump`, `PairForces` and LaM-SLidE on sets of trajectories."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from surrogate.data.particle_sets import ParticleSet
from surrogate.models.lam_slide.model import LamSlide
from surrogate.models.particles import EgnnJump, PairForces
from surrogate.training.loop import ProgressFn, StageConfig, run_stage
from surrogate.training.objectives import autoencoder_loss, draw_flow_times, flow_loss, random_rotations

# Share of LaM-SLidE's budget that the autoencoder gets.
STAGE_ONE_SHARE = 0.35
# Share of the pair forces' budget that coarse steps get.
COARSE_SHARE = 0.4
# Error of a particle's step beyond which it is left out of the fine part, nm/ps.
_LARGEST_MISS = 0.5
_VALIDATION = 100


@dataclass(frozen=True)
class Training:
    """How long to train and where: `budget_s` of wall time or `steps`; `folder` holds resume states and curves of
    `name`."""

    name: str
    folder: Path
    budget_s: float | None = None
    steps: int | None = None
    seed: int = 0
    resume: bool = False
    validate_every_s: float = 60.0
    progress: ProgressFn | None = None

    def stage(self, part: str, share: float, *, batch: int, rate: float, bf16: bool) -> StageConfig:
        """Return the loop's settings for a part of the training that gets this share of it."""
        return StageConfig(
            part,
            batch,
            rate,
            None if self.budget_s is None else self.budget_s * share,
            None if self.steps is None else max(1, round(self.steps * share)),
            warmup_steps=50,
            ema_decay=0.99,
            seed=self.seed,
            bf16=bf16,
            validate_every_s=self.validate_every_s,
        )

    def state(self, part: str) -> Path:
        return self.folder / f"{self.name}.{part}.train.safetensors"

    @property
    def log(self) -> Path:
        return self.folder / f"{self.name}.csv"


@dataclass(frozen=True, eq=False)
class Tensors:
    """A set as float32 tensors."""

    x: Tensor
    v: Tensor
    types: Tensor
    pairs: Tensor

    @staticmethod
    def of(data: ParticleSet) -> Tensors:
        return Tensors(
            torch.from_numpy(data.positions_nm).float(),
            torch.from_numpy(data.velocities_nm_ps).float(),
            torch.from_numpy(data.types),
            torch.from_numpy(data.pairs),
        )


def train_egnn(
    model: EgnnJump, train: ParticleSet, validation: ParticleSet, n_given: int, training: Training, *, any_start: bool
) -> float:
    """Train on the mean distance of one frame to come, another in each step; return the seconds spent.

    With `any_start` (beyond the paper) any frame of a trajectory may be the last given one, as far as its future lasts;
    else it is frame `n_given - 1` always.
    """
    data, held = Tensors.of(train), Tensors.of(validation.first(min(_VALIDATION, len(validation))))
    stage = training.stage("egnn", 1.0, batch=64, rate=2e-3, bf16=False)
    n_frames, last = data.x.shape[1], n_given - 1
    for frame in range(model.config.n_new):
        time_ps = (frame + 1) * train.lag_ps
        change = data.x[:, last + frame + 1] - data.x[:, last]
        if model.config.from_velocity:
            change = change - time_ps * data.v[:, last]
        model.reach[frame] = change.square().sum(-1).mean().sqrt()

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        frame = int(torch.randint(model.config.n_new, (1,), generator=generator))
        rows = torch.randint(len(train), (stage.batch,), generator=generator)
        at = torch.full((stage.batch,), last)
        if any_start:
            at = torch.randint(n_frames - frame - 1, (stage.batch,), generator=generator)
        moved = model(data.x[rows, at], data.v[rows, at], data.types[rows], data.pairs[rows], frame)
        error = mean_distance(moved, data.x[rows, at + frame + 1])
        return error / model.reach[frame], {"distance": error.detach()}

    @torch.no_grad()
    def validate() -> dict[str, float]:
        state = (held.x[:, last], held.v[:, last], held.types, held.pairs)
        frames = [model(*state, frame) for frame in range(model.config.n_new)]
        return {"validation_ade": float(mean_distance(torch.stack(frames, 1), held.x[:, n_given:]))}

    return _run(model, stage, loss_fn, validate, training)


def train_pair_forces(model: PairForces, train: ParticleSet, validation: ParticleSet, training: Training) -> float:
    """Train on single frame steps from the true state anywhere in a trajectory: position and velocity one frame on.

    The loss grows with the distance, not its square: a close encounter that no step resolves counts once. The first
    part takes coarse steps, the second fine ones, where a window that is `_LARGEST_MISS` off or more teaches nothing:
    its gradient runs through a collision and points anywhere.
    """
    data, held = Tensors.of(train), Tensors.of(validation.first(min(_VALIDATION, len(validation))))
    lag, n_frames = train.lag_ps, data.x.shape[1]
    rows_held = torch.arange(len(held.x)).repeat_interleave(n_frames - 1)
    at_held = torch.arange(n_frames - 1).repeat(len(held.x))

    def one_step(source: Tensors, rows: Tensor, at: Tensor, substeps: int) -> Tensor:
        x, v = source.x[rows, at], source.v[rows, at]
        x_new, v_new = model.step(x, v, source.pairs[rows], substeps)
        wrong_x = (x_new - source.x[rows, at + 1]) / lag
        wrong_v = v_new - source.v[rows, at + 1]
        return torch.cat([wrong_x, wrong_v], dim=-1).square().sum(-1).add(1e-8).sqrt()

    def part(name: str, share: float, substeps: int, rate: float, largest: float) -> float:
        stage = training.stage(name, share, batch=256, rate=rate, bf16=False)

        def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
            rows = torch.randint(len(train), (stage.batch,), generator=generator)
            at = torch.randint(n_frames - 1, (stage.batch,), generator=generator)
            loss = one_step(data, rows, at, substeps).clamp(max=largest).mean()
            return loss, {"step": loss.detach()}

        @torch.no_grad()
        def validate() -> dict[str, float]:
            return {"validation_step": float(one_step(held, rows_held, at_held, substeps).clamp(max=largest).mean())}

        return _run(model, stage, loss_fn, validate, training)

    c = model.config
    spent = part("pair-forces", COARSE_SHARE, c.training_substeps, 1e-2, float("inf"))
    return spent + part("pair-forces-fine", 1.0 - COARSE_SHARE, c.fine_substeps, 1e-3, _LARGEST_MISS)


def train_lam_slide_on_windows(
    model: LamSlide, windows: Tensor, types: Tensor, held: Tensor, held_types: Tensor, training: Training
) -> float:
    """Train both stages on windows `(n, n_frames, n_particles, 3)` in the model's units times its scale, types
    `(n, n_particles)`; return the seconds spent.

    Identifiers are drawn at random (Algorithm 1 with a pool of as many as there are particles) by permuting the
    particles of each window, in all its frames alike; every window is rotated at random (appendix E.3).
    """
    n_frames, n = windows.shape[1:3]
    one = training.stage("autoencoder", STAGE_ONE_SHARE, batch=256, rate=2e-3, bf16=False)
    two = training.stage("flow", 1.0 - STAGE_ONE_SHARE, batch=64, rate=1e-3, bf16=True)

    def draw(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(windows), (batch,), generator=generator)
        order = torch.rand(batch, n, generator=generator).argsort(1)
        x = windows[rows].gather(2, order[:, None, :, None].expand(-1, n_frames, -1, 3))
        return x @ random_rotations(batch, generator)[:, None].mT, types[rows].gather(1, order)

    def stage_one(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(one.batch, generator)
        at = torch.randint(n_frames, (one.batch,), generator=generator)
        return autoencoder_loss(model, x[torch.arange(one.batch), at], kinds, generator)

    @torch.no_grad()
    def reconstruction() -> dict[str, float]:
        back = model.decode(encode_windows(model, held, held_types), n)
        return {"validation_distance": float(mean_distance(back, held))}

    spent = _run(model.autoencoder, one, stage_one, reconstruction, training)
    _normalise(model, windows, types)
    model.autoencoder.requires_grad_(False)

    def stage_two(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = draw(two.batch, generator)
        with torch.no_grad(), torch.autocast("cpu", enabled=False):
            latents = encode_windows(model, x, kinds)
        return flow_loss(model, latents, n, draw_flow_times(model, two.batch, generator), generator)

    @torch.no_grad()
    def flow() -> dict[str, float]:
        generator = torch.Generator().manual_seed(0)
        tau = draw_flow_times(model, len(held), generator)
        _, terms = flow_loss(model, encode_windows(model, held, held_types), n, tau, generator)
        return {"validation_flow": float(terms["flow"])}

    return spent + _run(model.approximator, two, stage_two, flow, training)


def encode_windows(model: LamSlide, windows: Tensor, types: Tensor) -> Tensor:
    """Windows `(b, n_frames, n, 3)`, types `(b, n)` of each -> latents `(b, n_frames, n_latents, latent_dim)`."""
    per_frame = types[:, None].expand(-1, windows.shape[1], -1).flatten(0, 1)
    return model.encode(windows, per_frame)


def mean_distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean Euclidean distance of points `(..., 3)`, differentiable where they meet."""
    return (a - b).square().sum(-1).add(1e-10).sqrt().mean()


@torch.no_grad()
def _normalise(model: LamSlide, windows: Tensor, types: Tensor, at_most: int = 500) -> None:
    """Measure the latents' means and common scale, particles in the order of the set and permuted."""
    model.latent_mean.zero_()
    model.latent_scale.fill_(1.0)
    generator = torch.Generator().manual_seed(0)
    turned = windows[:at_most] @ random_rotations(min(at_most, len(windows)), generator)[:, None].mT
    z = encode_windows(model, turned, types[:at_most]).flatten(0, 1)
    model.latent_mean.copy_(z.mean(0))
    model.latent_scale.copy_((z - z.mean(0)).square().mean().sqrt())


def _run(
    module: torch.nn.Module,
    stage: StageConfig,
    loss_fn: Callable[[torch.Generator], tuple[Tensor, dict[str, Tensor]]],
    validate: Callable[[], dict[str, float]],
    training: Training,
) -> float:
    return run_stage(
        module,
        stage,
        loss_fn,
        validate,
        state_path=training.state(stage.name),
        log_path=training.log,
        resume=training.resume,
        device=torch.device("cpu"),
        progress=training.progress,
    )
