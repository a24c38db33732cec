"""Train `ParticleFlow`: flow matching with data prediction as in the paper, uniform flow times and weight one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from forecaster_training import Training, mean_distance, run_training
from particle_flow import Given, ParticleFlow
from torch import Tensor

from surrogate.models.lam_slide import flow
from surrogate.models.lam_slide.trainer import TAU_MAX

BATCH, RATE, EMA_DECAY = 256, 2e-3, 0.999
_BLOCK = 500


@dataclass(frozen=True, eq=False)
class ParticleWindows:
    """What is `given` of systems, and what is to come of them as the network sees it: `ahead` (b, n, n_new, 3)."""

    given: Given
    ahead: Tensor

    def to(self, device: torch.device) -> ParticleWindows:
        return ParticleWindows(self.given.to(device), self.ahead.to(device))


DrawParticles = Callable[[int, torch.Generator], ParticleWindows]


def train_particle_flow(
    model: ParticleFlow, draw: DrawParticles, held: Sequence[ParticleWindows], training: Training
) -> float:
    """Train on windows; return the seconds spent. `held` validates: the error of the mean forecast and of samples, in
    the network's units."""
    device = torch.device(training.device)
    model.to(device)
    stage = training.stage("particle-flow", 1.0, batch=BATCH, rate=RATE, bf16=True, ema_decay=EMA_DECAY)

    def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        windows = draw(stage.batch, generator).to(device)
        tau = torch.rand(stage.batch, generator=generator).clamp(max=TAU_MAX).to(device)
        noise = torch.randn(windows.ahead.shape, generator=generator).to(device)
        at = flow.expand(tau, noise)
        loss = (model(at * windows.ahead + (1.0 - at) * noise, tau, windows.given) - windows.ahead).square().mean()
        return loss, {"flow": loss.detach()}

    held = [windows.to(device) for windows in held]

    @torch.no_grad()
    def validate() -> dict[str, float]:
        found = {}
        for name, solver_steps in (("mean", 1), ("sample", 10)):
            drawn = [sample_ahead(model, w.given, solver_steps, torch.Generator().manual_seed(0)) for w in held]
            errors = [mean_distance(x, w.ahead) for x, w in zip(drawn, held, strict=True)]
            found[f"validation_{name}"] = float(torch.stack(errors).mean())
        return found

    return run_training(model, stage, loss_fn, validate, training)


@torch.no_grad()
def sample_ahead(model: ParticleFlow, given: Given, solver_steps: int, generator: torch.Generator) -> Tensor:
    """Draw what comes after `given`, `(b, n, n_new, 3)` in the network's units, by Euler steps (Table 10).

    The last step lands on the predicted data: of one step alone the sample is the mean forecast.
    """
    b, n = given.types.shape
    noise = torch.randn((b, n, model.config.n_new, 3), generator=generator).to(given.features.device)
    drawn = []
    for start in range(0, b, _BLOCK):
        rows = slice(start, start + _BLOCK)
        known = given.rows(rows)

        def predict(o: Tensor, tau: Tensor, known: Given = known) -> Tensor:
            with torch.autocast(o.device.type, dtype=torch.bfloat16):  # as it was trained
                return model(o, tau, known)

        drawn.append(flow.euler(predict, noise[rows], solver_steps))
    return torch.cat(drawn)
