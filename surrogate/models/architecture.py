"""An architecture as a value: how its network is built from a record, how it is trained, and which references it suits.

A package offers one by an entry point of the group `surromd.architectures` (`surrogate.models.registry`):

    [project.entry-points."surromd.architectures"]
    my-model = "my_package:MY_MODEL"

with `MY_MODEL = Architecture("my-model", MyConfig.from_dict, MyModel, my_trainer)`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surrogate.models.interface import Surrogate
    from systems.scene import Scene


@dataclass(frozen=True, eq=False)
class Survey:
    """A summary of the trajectories to train on, made without reading their frames.

    `scenes`: each molecule trained on once; `unseen`: those that appear in the validation alone. `longest`: frames of
    the longest trajectory of each of `scenes`, `n_frames` all that are trained on. `lag_ps`: time between frames.
    `velocities`: whether all files carry them. `equilibrium`: whether all were simulated at constant temperature.
    """

    scenes: tuple[Scene, ...]
    unseen: tuple[Scene, ...]
    longest: tuple[int, ...]
    n_frames: int
    lag_ps: float
    velocities: bool
    equilibrium: bool

    @property
    def one_molecule(self) -> bool:
        return len(self.scenes) == 1 and not self.unseen


@dataclass(frozen=True)
class Suitability:
    """How well an architecture suits references: of several that do, the one of the highest `rank` is trained."""

    rank: int
    reason: str


def never(survey: Survey) -> None:
    """The predicate of an architecture that is trained only when it is asked for by name."""


@dataclass(frozen=True)
class Architecture:
    """One kind of surrogate, under the name that weights files and `arch` have for it.

    `config` builds a configuration from a record (InputError for unknown keys), `model` the network from that.
    `trainer` imports the training code and returns its `surrogate.training.trainer.Trainer`: rollouts do not call it.
    `suits` returns how well the architecture suits references, None where it does not.
    """

    name: str
    config: Callable[[dict[str, Any]], Any]
    model: Callable[[Any], Surrogate]
    trainer: Callable[[], Any]
    suits: Callable[[Survey], Suitability | None] = never
