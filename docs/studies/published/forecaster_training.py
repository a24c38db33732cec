"""Train the forecasters of particle systems: `EgnnJump`, `PairForces` and LaM-SLidE on sets of trajectories."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from particle_models import EgnnJump, PairForces
from particle_sets import ParticleSet
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "training"))
from recorded import Recorded

from surrogate.models.lam_slide.model import LamSlide, LatentLayer
from surrogate.models.lam_slide.trainer import (
    autoencoder_loss,
    draw_flow_times,
    flow_loss,
    random_rotations,
)
from surrogate.training.loop import ProgressFn, Stage, StageConfig, StagePlace, run_stage
from systems.errors import SurromdError


class UnfinishedError(SurromdError):
    """The call's time is up; the training is saved and can be resumed."""


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
    device: str = "cpu"
    # Monotonic time after which the first saved state ends the call.
    ends_at: float | None = None

    def stage(
        self, part: str, share: float, *, batch: int, rate: float, bf16: bool, ema_decay: float = 0.99
    ) -> StageConfig:
        """Return the loop's settings for a part of the training that gets this share of it."""
        return StageConfig(
            part,
            batch,
            rate,
            None if self.budget_s is None else self.budget_s * share,
            None if self.steps is None else max(1, round(self.steps * share)),
            warmup_steps=50,
            ema_decay=ema_decay,
            seed=self.seed,
            bf16=bf16,
            validate_every_s=self.validate_every_s,
        )

    def state(self, part: str) -> Path:
        return self.folder / f"{self.name}.{part}.train.safetensors"

    @property
    def log(self) -> Path:
        return self.folder / f"{self.name}.csv"


@dataclass(frozen=True)
class StageSizes:
    """Batches and learning rates of LaM-SLidE's two stages, the share of the training that the first one gets, and the
    decay of the averaged weights."""

    batches: tuple[int, int] = (256, 64)
    rates: tuple[float, float] = (2e-3, 1e-3)
    share: float = 0.35
    ema_decay: float = 0.99


# Table 10 and appendix E.5: 2,000 epochs and 1,000 of 3,000 windows, which are 47,000 steps of each stage.
PAPER_SIZES = StageSizes((128, 64), (1e-3, 1e-3), 0.5, 0.999)
PAPER_STEPS = 94_000


@dataclass(frozen=True, eq=False)
class Jump:
    """States `x`, `v` (b, n, 3) of systems of one size, `types` (b, n), `pairs` (b, n, n), and positions `reference` of
    a later frame, or of all `(b, n_new, n, 3)`."""

    x: Tensor
    v: Tensor
    types: Tensor
    pairs: Tensor
    reference: Tensor

    def to(self, device: torch.device) -> Jump:
        return Jump(*(t.to(device) for t in (self.x, self.v, self.types, self.pairs, self.reference)))


# Batch, frame to come -> states; batch -> windows (b, n_frames, n, 3) and types (b, n).
DrawJump = Callable[[int, int, torch.Generator], Jump]
DrawWindows = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]


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


def train_egnn(model: EgnnJump, draw: DrawJump, held: Sequence[Jump], training: Training) -> float:
    """Train on the mean distance of one frame to come, another in each step; return the seconds spent.

    `draw(batch, frame, generator)` gives states and what became of them after `frame + 1` frames; `held` states with
    all their frames to come. Sets the model's `reach` from what `draw` gives.
    """
    device = torch.device(training.device)
    stage = training.stage("egnn", 1.0, batch=64, rate=2e-3, bf16=False)
    generator = torch.Generator().manual_seed(training.seed)
    for frame in range(model.config.n_new):
        jump, time_ps = draw(512, frame, generator), (frame + 1) * model.config.lag_ps
        change = jump.reference - jump.x - (time_ps * jump.v if model.config.from_velocity else 0.0)
        model.reach[frame] = change.square().sum(-1).mean().sqrt()
    model.to(device)
    held = [jump.to(device) for jump in held]

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        frame = int(torch.randint(model.config.n_new, (1,), generator=generator))
        jump = draw(stage.batch, frame, generator).to(device)
        error = mean_distance(model(jump.x, jump.v, jump.types, jump.pairs, frame), jump.reference)
        return error / model.reach[frame], {"distance": error.detach()}

    @torch.no_grad()
    def validate() -> dict[str, float]:
        errors = [mean_distance(model.all_frames(j.x, j.v, j.types, j.pairs), j.reference) for j in held]
        return {"validation_ade": float(torch.stack(errors).mean())}

    return run_training(model, stage, loss_fn, validate, training)


def jumps_of(data: ParticleSet, n_given: int, *, any_start: bool) -> DrawJump:
    """Return a `draw` from a set. With `any_start` (beyond the paper) any frame of a trajectory may be the last given
    one, as far as its future lasts; else it is frame `n_given - 1` always."""
    t = Tensors.of(data)
    n_frames = t.x.shape[1]

    def draw(batch: int, frame: int, generator: torch.Generator) -> Jump:
        rows = torch.randint(len(t.x), (batch,), generator=generator)
        at = torch.full((batch,), n_given - 1)
        if any_start:
            at = torch.randint(n_frames - frame - 1, (batch,), generator=generator)
        return Jump(t.x[rows, at], t.v[rows, at], t.types[rows], t.pairs[rows], t.x[rows, at + frame + 1])

    return draw


def held_jumps(data: ParticleSet, n_given: int) -> Jump:
    """Return the last given states of a set's first trajectories, with all frames to come."""
    t = Tensors.of(data.first(min(_VALIDATION, len(data))))
    return Jump(t.x[:, n_given - 1], t.v[:, n_given - 1], t.types, t.pairs, t.x[:, n_given:])


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

        return run_training(model, stage, loss_fn, validate, training)

    c = model.config
    spent = part("pair-forces", COARSE_SHARE, c.training_substeps, 1e-2, float("inf"))
    return spent + part("pair-forces-fine", 1.0 - COARSE_SHARE, c.fine_substeps, 1e-3, _LARGEST_MISS)


def train_lam_slide_on_windows(
    model: LamSlide,
    draw: DrawWindows,
    held: Sequence[tuple[Tensor, Tensor]],
    training: Training,
    sizes: StageSizes = StageSizes(),
) -> float:
    """Train both stages on windows in the model's units times its scale; return the seconds spent.

    `draw(batch, generator)` gives windows `(b, n_frames, n, 3)` and types `(b, n)`, of systems of one size, another
    one each time if need be; `held` such pairs.
    """
    device = torch.device(training.device)
    model.to(device)
    held = [(x.to(device), kinds.to(device)) for x, kinds in held]
    more = {"ema_decay": sizes.ema_decay}
    one = training.stage("autoencoder", sizes.share, batch=sizes.batches[0], rate=sizes.rates[0], bf16=False, **more)
    two = training.stage("flow", 1.0 - sizes.share, batch=sizes.batches[1], rate=sizes.rates[1], bf16=True, **more)

    def drawn(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        x, kinds = draw(batch, generator)
        return x.to(device), kinds.to(device)

    def stage_one(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = drawn(one.batch, generator)
        at = torch.randint(x.shape[1], (one.batch,), generator=generator)
        return autoencoder_loss(model, x[torch.arange(one.batch), at], kinds, generator)

    @torch.no_grad()
    def reconstruction() -> dict[str, float]:
        errors = [mean_distance(model.decode(encode_windows(model, *pair), pair[0].shape[2]), pair[0]) for pair in held]
        return {"validation_distance": float(torch.stack(errors).mean())}

    spent = run_training(model.autoencoder, one, stage_one, reconstruction, training)
    normalise_latents(model, drawn)
    model.autoencoder.requires_grad_(False)

    def flow_of(module: LamSlide, x: Tensor, kinds: Tensor, tau: Tensor) -> Tensor:
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            latents = encode_windows(module, x, kinds)
        noise = torch.randn_like(latents)
        # What a graph repeats may not keep casts of weights from one step to the next.
        with torch.autocast(device.type, torch.bfloat16, cache_enabled=False):
            return flow_loss(module, latents, x.shape[2], tau, torch.Generator(), noise=noise)[0]

    recorded: list[Recorded] = []
    plain = model.config.approximator.position_weight == 0.0

    def stage_two(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        x, kinds = drawn(two.batch, generator)
        tau = draw_flow_times(model, two.batch, generator).to(device)
        if device.type == "cuda" and plain:
            # Noise is drawn on the GPU, by a seed of each step.
            torch.cuda.manual_seed(int(torch.randint(2**62, (1,), generator=generator)))
            if not recorded:
                recorded.append(Recorded(model, flow_of, (x, kinds, tau), compiled=(LatentLayer,)))
            loss = recorded[0](x, kinds, tau)
            return loss, {"flow": loss.detach()}
        with torch.no_grad(), torch.autocast(device.type, enabled=False):
            latents = encode_windows(model, x, kinds)
        return flow_loss(model, latents, x.shape[2], tau, generator)

    @torch.no_grad()
    def flow() -> dict[str, float]:
        generator, losses = torch.Generator().manual_seed(0), []
        for x, kinds in held:
            tau = draw_flow_times(model, len(x), generator).to(device)
            windows = encode_windows(model, x, kinds)
            losses.append(flow_loss(model, windows, x.shape[2], tau, generator)[1]["flow"])
        return {"validation_flow": float(torch.stack(losses).mean())}

    return spent + run_training(model.approximator, two, stage_two, flow, training)


def turned_windows(windows: Tensor, types: Tensor) -> DrawWindows:
    """Return a `draw` from windows `(n, n_frames, n_particles, 3)`, types `(n, n_particles)`.

    Identifiers are drawn at random (Algorithm 1 with a pool of as many as there are particles) by permuting the
    particles of each window, in all its frames alike; every window is rotated at random (appendix E.3).
    """
    n_frames, n = windows.shape[1:3]

    def draw(batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        rows = torch.randint(len(windows), (batch,), generator=generator)
        order = torch.rand(batch, n, generator=generator).argsort(1)
        x = windows[rows].gather(2, order[:, None, :, None].expand(-1, n_frames, -1, 3))
        return x @ random_rotations(batch, generator)[:, None].mT, types[rows].gather(1, order)

    return draw


def encode_windows(model: LamSlide, windows: Tensor, types: Tensor) -> Tensor:
    """Windows `(b, n_frames, n, 3)`, types `(b, n)` of each -> latents `(b, n_frames, n_latents, latent_dim)`."""
    per_frame = types[:, None].expand(-1, windows.shape[1], -1).flatten(0, 1)
    return model.encode(windows, per_frame)


def mean_distance(a: Tensor, b: Tensor) -> Tensor:
    """Mean Euclidean distance of points `(..., 3)`, differentiable where they meet."""
    return (a - b).square().sum(-1).add(1e-10).sqrt().mean()


@torch.no_grad()
def normalise_latents(model: LamSlide, draw: DrawWindows, n_draws: int = 16, batch: int = 32) -> None:
    """Measure the latents' means and common scale."""
    model.latent_mean.zero_()
    model.latent_scale.fill_(1.0)
    generator = torch.Generator().manual_seed(0)
    z = torch.cat([encode_windows(model, *draw(batch, generator)).flatten(0, 1) for _ in range(n_draws)])
    model.latent_mean.copy_(z.mean(0))
    model.latent_scale.copy_((z - z.mean(0)).square().mean().sqrt())


def run_training(
    module: torch.nn.Module,
    stage: StageConfig,
    loss_fn: Callable[[torch.Generator], tuple[Tensor, dict[str, Tensor]]],
    validate: Callable[[], dict[str, float]],
    training: Training,
) -> float:
    """Train a stage as `training` says; return the seconds spent. Raises UnfinishedError where the call has to end."""

    def progress(name: str, share: float, metrics: dict[str, float]) -> None:
        if training.progress is not None:
            training.progress(name, share, metrics)
        # With metrics the state has just been saved.
        if metrics and share < 1.0 and training.ends_at is not None and time.monotonic() > training.ends_at:
            raise UnfinishedError(
                f"{training.name}: this call's time is up at {share:.0%} of stage {name!r}; give the same command "
                "again with --resume."
            )

    place = StagePlace(training.state(stage.name), training.log, torch.device(training.device), training.resume)
    return run_stage(Stage(module, stage, loss_fn, validate), place, progress=progress)
