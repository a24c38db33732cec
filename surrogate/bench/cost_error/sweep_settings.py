"""The settings that a benchmark of run time against error goes through, and what is the same for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

from surrogate.verbs.options import Quiet
from systems.errors import InputError
from systems.options import check_options, option

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

STEPS = (2, 3, 4, 6, 10, 20)
# Ways of MD: OpenMM as it is set up here and as its manual does, and sixteen copies at once (`md_reference.simd`).
OURS, PLAIN, SIMD = "ours", "plain", "simd"
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
    """What `bench cost-error` can be told: what is the same for all settings, and which settings."""


def choose_settings(weights: Weights, sweep: Sweep) -> list[Setting]:
    """Return the settings to run. Without solvers those that take a batch at once.

    Where neither precisions nor batches are given, the usual solver at the usual steps is run in both precisions, alone
    and in a batch; with `compiled` also compiled. Raises InputError for a solver that the weights do not know.
    """
    from surrogate.models.lam_slide.flow import ADAPTIVE
    from surrogate.training.devices import choose_precision

    known = weights.model.solvers
    unknown = [name for name in sweep.solvers or () if name not in known]
    if unknown:
        raise InputError(f"{weights.path.name} knows no solver {unknown[0]!r}; choose {', '.join(known) or 'none'}.")
    chosen: list[str | None] = [*(sweep.solvers or [name for name in known if name not in ADAPTIVE])] or [None]
    own = weights.model.usual_steps
    numbers = (sweep.steps or STEPS) if known else (own,)
    found = [
        Setting(solver, n, precision, batch)
        for solver, n, precision, batch in product(
            chosen, numbers, sweep.precisions or ("auto",), sweep.batches or (USUAL_BATCH,)
        )
    ]
    usual = Setting(chosen[0], own if own in numbers else max(numbers))
    if not (sweep.precisions or sweep.batches):
        with_bf16 = choose_precision("auto", suits=weights.model.float32_layers is not None).bf16
        found += [replace(usual, precision="fp32" if with_bf16 else "bf16")]
        found += [replace(usual, batch=1)]
    if sweep.compiled:
        found += [replace(usual, compile=True)]
    return list(dict.fromkeys(found))
