"""Train PAINET (or its decoder alone) to forecast positions and the last velocity, with noise and pushforward."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surrogate.data.frames import TrainingFrames
from surrogate.data.references import References
from surrogate.models.architecture import (
    RESOLVED,
    AdvanceFn,
    Architecture,
    Prepared,
    Settings,
    Trainer,
    TrainingRequest,
)
from surrogate.models.painet.model import EgnnForecaster, Painet, PainetConfig, Structure
from surrogate.models.weights import Weights, provenance_of, save_weights, training_domain
from surrogate.training.loop import ProgressFn, Stage, StageConfig, train_stages
from systems.errors import InputError


@dataclass(frozen=True)
class PainetTraining:
    """The optimisation. `noise`: standard deviation of what is added to the state a training window starts from, as a
    share of what positions and velocities change by over a chunk, so that the model learns to come back from its own
    errors (Sanchez-Gonzalez 2020). `pushforward`: share of windows that start where the model itself arrives after one
    chunk from the reference, with no gradient through that chunk (Brandstetter 2022). `velocity_weight`: of the last
    frame's velocity beside the positions, each in units of its own change over a chunk."""

    budget_s: float | None = None
    steps: int | None = None
    batch: int = 32
    learning_rate: float = 2e-3
    noise: float = 0.02
    pushforward: float = 0.3
    velocity_weight: float = 0.5
    seed: int = 0
    bf16: bool = False
    device: str = "cpu"
    validate_every_s: float = 60.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.pushforward <= 1.0:
            raise InputError(f"pushforward is a share of windows, between 0 and 1, not {self.pushforward:g}.")


def for_frames(config: PainetConfig, frames: TrainingFrames) -> PainetConfig:
    """Return the configuration with frame spacing, temperature and friction of the reference."""
    bath = frames.conditions
    return replace(
        config,
        lag_ps=frames.lag_ps * config.frame_stride,
        temperature_k=float(bath.get("temperature_k") or config.temperature_k),
        friction_per_ps=float(bath.get("friction_per_ps") or 0.0),
    )


def train_painet(
    frames: TrainingFrames,
    out: str | Path,
    model_config: PainetConfig,
    config: PainetTraining,
    *,
    model_class: type[Painet] = Painet,
    start: Weights | None = None,
    resume: bool = False,
    progress: ProgressFn | None = None,
) -> Path:
    """Train on `frames`, which carry velocities, and write `out` (.safetensors) with a CSV of the curves beside it.

    `start`: weights of the same configuration that the training begins from, with their scales.

    Raises InputError when the frames carry none or are too short, SimulationError when training diverges.
    """
    out = Path(out)
    if frames.velocities is None:
        raise InputError(f"{model_class.arch} learns from velocities; these frames carry none.")
    model_config = for_frames(model_config, frames)
    torch.manual_seed(config.seed)
    device = torch.device(config.device)
    model = model_class(model_config).to(device)
    structure = model.structure(model.featurise(frames.scene).to(device))
    windows = StateWindows(frames, model_config, device)
    model.set_scales(windows.velocity_scale_nm_ps, windows.position_scale_nm, windows.change_scale_nm_ps)
    if start is not None:
        if start.model.config != model_config:
            raise InputError(f"{start.path} is of another configuration, {start.model.config}, than {model_config}.")
        model.load_state_dict(start.model.state_dict())
    stage = StageConfig("forecast", config.batch, config.learning_rate, config.budget_s, config.steps,
                        seed=config.seed, bf16=config.bf16, validate_every_s=config.validate_every_s)  # fmt: skip
    domain = training_domain(frames, stride=model_config.frame_stride)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        return forecast_loss(model, structure, windows, config, generator)

    @torch.no_grad()
    def validate() -> dict[str, float]:
        return forecast_errors(model, structure, windows)

    def write(spent_s: list[float]) -> None:
        settings = {"seed": config.seed, "noise": config.noise, "pushforward": config.pushforward,
                    "training_s": round(sum(spent_s), 1)}  # fmt: skip
        save_weights(out, model, domain, provenance_of(frames.origin, settings, start))

    stages = [Stage(model, stage, loss_fn, validate)]
    train_stages(stages, out, write, device=device, resume=resume, progress=progress)
    return out


class StateWindows:
    """States and their futures, cut from frames: two chunks long, so that a pushforward has a reference to compare
    with.

    `position_scale_nm`, `change_scale_nm_ps`: root mean square displacement and change of velocity over a chunk, what
    errors are measured in; `velocity_scale_nm_ps`: root mean square velocity.
    """

    def __init__(self, frames: TrainingFrames, config: PainetConfig, device: torch.device) -> None:
        assert frames.velocities is not None
        self.frames, self.config, self.device = frames, config, device
        self.velocities = frames.velocities
        self.span = config.n_new * config.frame_stride
        self.starts = frames.window_starts(2 * self.span + 1, validation=False)
        self.held = frames.spread_starts(128, self.span + 1, validation=True)
        sample = frames.spread_starts(512, 2 * self.span + 1)
        (x, v), (x_new, v_new) = self.state(sample), self.future(sample)
        self.position_scale_nm = max(float((x_new - x[:, None]).square().mean().sqrt()), 1e-6)
        self.change_scale_nm_ps = max(float((v_new - v).square().mean().sqrt()), 1e-6)
        self.velocity_scale_nm_ps = max(float(v.square().mean().sqrt()), 1e-6)

    def state(self, first: np.ndarray) -> tuple[Tensor, Tensor]:
        """Positions and velocities `(b, n_atoms, 3)` at frames `first`."""
        x, v = self.frames.positions_nm(first), self.velocities[first]
        return torch.from_numpy(x).to(self.device), torch.from_numpy(v).to(self.device)

    def future(self, first: np.ndarray) -> tuple[Tensor, Tensor]:
        """Positions `(b, n_new, n_atoms, 3)` of the chunk after `first`, velocities `(b, n_atoms, 3)` at its end."""
        idx = first[:, None] + self.config.frame_stride * np.arange(1, self.config.n_new + 1)
        x, v = self.frames.positions_nm(idx), self.velocities[idx[:, -1]]
        return torch.from_numpy(x).to(self.device), torch.from_numpy(v).to(self.device)


def forecast_loss(model: Painet, structure: Structure, windows: StateWindows, config: PainetTraining,
                  generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:  # fmt: skip
    """Mean square error of all predicted frames and of the last velocity, each over its scale squared."""
    picked = torch.randint(len(windows.starts), (config.batch,), generator=generator).numpy()
    first = windows.starts[picked]
    x, v = windows.state(first)
    noise = torch.randn(2, *x.shape, generator=generator).to(x.device)
    pushed = torch.rand(config.batch, generator=generator) < config.pushforward
    x = x + config.noise * windows.position_scale_nm * noise[0]
    v = v + config.noise * windows.change_scale_nm_ps * noise[1]
    if bool(pushed.any()):
        with torch.no_grad():
            x_far, v_far = model(x[pushed], v[pushed], structure)
        x[pushed], v[pushed] = x_far[:, -1], v_far[:, -1]
        first = np.where(pushed.numpy(), first + windows.span, first)
    x_true, v_true = windows.future(first)
    x_new, v_new = model(x, v, structure)
    position = (x_new - x_true).square().mean() / windows.position_scale_nm**2
    velocity = (v_new[:, -1] - v_true).square().mean() / windows.change_scale_nm_ps**2
    loss = position + config.velocity_weight * velocity
    return loss, {"position": position.detach(), "velocity": velocity.detach()}


def forecast_errors(model: Painet, structure: Structure, windows: StateWindows) -> dict[str, float]:
    """Errors on held-out windows: A-MSE over all predicted frames and F-MSE of the last, per coordinate in Å^2, beside
    the frozen frame's A-MSE, and the last velocity's root mean square error in nm/ps."""
    (x, v), (x_true, v_true) = windows.state(windows.held), windows.future(windows.held)
    x_new, v_new = model(x, v, structure)
    error = 100.0 * (x_new - x_true).square()
    return {
        "validation_a_mse_a2": float(error.mean()),
        "validation_f_mse_a2": float(error[:, -1].mean()),
        "frozen_a_mse_a2": float(100.0 * (x[:, None] - x_true).square().mean()),
        "validation_velocity_nm_ps": float((v_new[:, -1] - v_true).square().mean().sqrt()),
    }


class PainetTrainer(Trainer):
    """Trains PAINET, or its decoder alone, as `model_class` says."""

    def __init__(self, model_class: type[Painet]) -> None:
        self.model_class = model_class

    def settings(self, request: TrainingRequest) -> Settings:
        """See `Trainer.settings`. Frame spacing and bath are the reference's (`for_frames`)."""
        resolved = RESOLVED | {"lag_ps", "temperature_k", "friction_per_ps"}
        return Settings(PainetConfig.from_dict(request.model), request.settings(PainetTraining), resolved)

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        """See `Trainer.prepare`. Raises InputError for references without velocities."""
        settings = self.settings(request)
        frames = references.frames(canonical=False, velocities=True)
        span = settings.model.n_new * settings.model.frame_stride
        frames.window_starts(2 * span + 1, validation=False)
        frames.window_starts(span + 1, validation=True)

        def run(advance: AdvanceFn) -> Path:
            return train_painet(
                frames, request.out, settings.model, settings.training, model_class=self.model_class,
                resume=request.resume, progress=lambda stage, share, metrics: advance(stage, share),
            )  # fmt: skip

        return Prepared(frames.scene.name, run)


PAINET = Architecture("painet", PainetConfig.from_dict, Painet, partial(PainetTrainer, Painet))
EGNN = Architecture("egnn", PainetConfig.from_dict, EgnnForecaster, partial(PainetTrainer, EgnnForecaster))
