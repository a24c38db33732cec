"""A random walk whose step every element learns: the least that an architecture of another package is made of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from surrogate.data import References
from surrogate.models.architecture import AdvanceFn, Architecture, Prepared, Settings, Trainer, TrainingRequest, build
from surrogate.models.propagator import Chunk, Molecule, Propagator
from surrogate.models.weights import provenance_of, save_weights, training_domain
from surrogate.training.loop import Stage, StageConfig, train_stages
from systems.scene import Scene


@dataclass(frozen=True)
class WalkConfig:
    n_new: int = 4
    first_step_nm: float = 0.01

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_dict(record: dict[str, Any]) -> WalkConfig:
        return build(WalkConfig, record)


class RandomWalk(Propagator):
    arch: ClassVar[str] = "random-walk"
    n_conditioning = 1

    def __init__(self, config: WalkConfig) -> None:
        super().__init__()
        self.config = config
        self.log_step = nn.Parameter(torch.full((119,), config.first_step_nm).log())

    @property
    def n_new(self) -> int:
        return self.config.n_new

    def featurise(self, scene: Scene) -> Molecule:
        """`own`: how many bonds each atom has, `(n_atoms,)`: atoms at the ends of bonds step further."""
        return Molecule.of(scene, torch.from_numpy(np.bincount(scene.bonds.ravel(), minlength=scene.n_atoms)).float())

    def noise_shape(self, n_atoms: int) -> tuple[int, ...]:
        return n_atoms, self.n_new, 3

    def next_chunk(
        self, last_frames_nm: Tensor, molecule: Molecule, noise: Tensor, *, solver_steps: int = 1,
        solver: str | None = None, last_velocities_nm_ps: Tensor | None = None,
    ) -> Chunk:  # fmt: skip
        steps = self.log_step.exp()[molecule.elements][:, None, None] * noise
        if molecule.own is not None:
            steps = steps * torch.where(molecule.own > 1, 1.0, 1.5)[:, None, None]
        return Chunk(last_frames_nm[:, -1:] + steps.cumsum(2).transpose(1, 2))


@dataclass(frozen=True)
class WalkTraining:
    budget_s: float | None = None
    steps: int | None = None
    batch: int = 32
    learning_rate: float = 0.05
    seed: int = 0
    device: str = "cpu"


class WalkTrainer(Trainer):
    def settings(self, request: TrainingRequest) -> Settings:
        asked = {"budget_s": request.budget_s, "steps": request.steps, "seed": request.seed, "device": request.device}
        return Settings(
            WalkConfig.from_dict(request.model), request.settings(WalkTraining, asked), resolved=frozenset(asked)
        )

    def prepare(self, references: References, request: TrainingRequest) -> Prepared:
        frames, settings = references.frames(canonical=True), self.settings(request)
        training: WalkTraining = settings.training
        model = RandomWalk(settings.model)
        elements = Molecule.of(frames.scene).elements
        starts = {held: frames.window_starts(2, validation=held) for held in (False, True)}

        def likelihood(first: Any) -> Tensor:
            """Minus the log-likelihood of the steps after frames `first`, of one coordinate."""
            x = torch.from_numpy(frames.positions_nm(first[:, None] + [0, 1]))
            log_step = model.log_step[elements][:, None]
            return (0.5 * (x[:, 1] - x[:, 0]).square() * (-2 * log_step).exp() + log_step).mean()

        def loss_fn(generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
            own = starts[False]
            loss = likelihood(own[torch.randint(len(own), (training.batch,), generator=generator).numpy()])
            return loss, {"walk": loss.detach()}

        @torch.no_grad()
        def validate() -> dict[str, float]:
            return {"validation_walk": float(likelihood(starts[True]))}

        def start(advance: AdvanceFn) -> Path:
            stage = StageConfig("walk", training.batch, training.learning_rate, training.budget_s, training.steps,
                                warmup_steps=1, seed=training.seed, bf16=False)  # fmt: skip

            def write(spent_s: list[float]) -> None:
                provenance = provenance_of(frames.origin, {"seed": training.seed})
                save_weights(request.out, model, training_domain(frames), provenance)

            train_stages([Stage(model, stage, loss_fn, validate)], request.out, write, device=torch.device("cpu"),
                         progress=lambda name, share, metrics: advance(name, share), resume=request.resume)  # fmt: skip
            return request.out

        return Prepared(frames.scene.name, start)


RANDOM_WALK = Architecture("random-walk", WalkConfig.from_dict, RandomWalk, WalkTrainer)
