"""Options of the benchmarks; light to import (`systems.options`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from surrogate.verbs.options import Quiet, Seeded
from systems.errors import InputError
from systems.options import check_options, option

STEPS = (2, 3, 4, 6, 10, 20)
USUAL_BATCH = 32


@dataclass(frozen=True)
class Setting:
    """One way to roll. `solver` None: of a model without one, for which `steps` mean nothing."""

    solver: str | None
    steps: int
    precision: str = "auto"
    batch: int = USUAL_BATCH
    compile: bool = False

    @property
    def label(self) -> str:
        words = [f"{self.solver} {self.steps}" if self.solver else "as it is"]
        words += [self.precision] if self.precision != "auto" else []
        words += [f"batch {self.batch}"] if self.batch != USUAL_BATCH else []
        return ", ".join(words + (["compiled"] if self.compile else []))


@dataclass(frozen=True, kw_only=True)
class CostErrorConfig:
    """What is the same for all settings. Rolled are `time_ps` in all replicas together, in `rounds` parts, after
    `discarded_ps` of each replica that count in neither cost nor error; MD runs `slice_ps` before each part."""

    time_ps: float = option("Rollout time per setting, all replicas together.", 20_000.0)
    discarded_ps: float = option("Of each replica, before anything counts.", 100.0, words=None)
    rounds: int = option("Number of blocks, alternating with OpenMM.", 4, within=(1, None))
    slice_ps: float = option("Of MD before each part.", 40.0, words=None)
    lag_ps: float | None = option("Interval between compared frames.", None, unset="as in the references")
    threads: int = option("Of both.", 1, within=(1, None), words=None)
    seed: int = option("Random seed.", 0, within=(0, None))

    def __post_init__(self) -> None:
        check_options(self)
        if self.time_ps <= 0 or self.slice_ps <= 0 or self.discarded_ps < 0 or (self.lag_ps or 1.0) <= 0:
            raise InputError("times must be positive.")


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """What is gone through: all combinations of what is given; None leaves the choice to `choose_settings`."""

    solvers: Sequence[str] | None = option("Solver to try; repeatable.", None, words=("solver",))
    steps: Sequence[int] | None = option(
        "Value to try; repeatable.", None, within=(1, None), unset=", ".join(map(str, STEPS))
    )
    precisions: Sequence[str] | None = option(
        "Value to try; repeatable.", None, choices=("auto", "fp32", "bf16"), words=("precision",)
    )
    batches: Sequence[int] | None = option(
        "Number of replicas to try; repeatable.", None, within=(1, None), words=("batch",), unset=str(USUAL_BATCH)
    )
    compiled: bool = option("Also time the compiled network.", False, words=("compile",))


@dataclass(frozen=True, kw_only=True)
class CostErrorOptions(CostErrorConfig, Sweep, Quiet):
    """Options of `bench cost-error`: what is the same for all settings, and which settings."""


@dataclass(frozen=True, kw_only=True)
class StressOptions(Seeded, Quiet):
    """Options of `stress`."""

    frames: Sequence[int] | None = option(
        "Rollout length in frames, all replicas together; repeatable.", None, within=(1, None), unset="10000 and 100000"
    )
    replicas: int | None = option("Number of rollout replicas.", None, within=(1, None), unset="16")
    guards: Sequence[str] | None = option(
        "Guard policy of the rollouts; repeatable.", None, words=("guard",), unset="flag and repair"
    )
    sections: Sequence[str] | None = option(
        "Test to run: length, invariance, inputs, precision, batches, solvers, openmm; repeatable.",
        None,
        words=("section",),
    )
    scene: str | None = option(
        "Scene to test, for weights of several peptides, such as sequence:ACE-LEU-SER-NME.", None
    )
    quick: bool = option("Short runs: a minute or two.", False)
