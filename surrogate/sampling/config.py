"""What a rollout is asked to do."""

from __future__ import annotations

from dataclasses import dataclass

from systems.errors import InputError, UnknownNameError, nearest

# What is done about a frame that the guards catch: nothing and no stop at all; marked; the chunk drawn again; relaxed
# by OpenMM; replaced by real MD.
GUARDS = ("off", "flag", "resample", "repair", "fallback")


@dataclass(frozen=True)
class RolloutConfig:
    """One rollout. `save_every_ps` None keeps every model frame. `lag_ps` is the time between these, of weights that
    were trained for several; None is what `lags.choose_lag` says. `solver` None is the one that suits the weights, else
    one that its model knows. `precision`: 'fp32', 'bf16' (autocast of the network; coordinates and integration stay
    fp32) or 'auto' (bf16 where the processor multiplies it faster). `compile`: by torch, which takes a minute.

    `stiff`: bonds and angles 'modelled' by the network or 'imposed' from the weights' reference; None is what the
    weights can.

    `guard`: see `surrogate.sampling.interventions`. `energy_every`: k, the energy of every k-th model frame is
    checked, after stiff bonds are relaxed; 0 checks none. `md_between_ps`: so much real MD after each chunk. `select`
    (MDTraj's language) and `atoms` ('all' or 'heavy') say which atoms are written; all are computed. `force` rolls
    scenes that leave the training domain, `temperature_k` is the one wanted, where it may differ from the weights'.
    """

    time_ps: float
    save_every_ps: float | None = None
    lag_ps: float | None = None
    seed: int = 0
    solver_steps: int = 10
    solver: str | None = None
    precision: str = "auto"
    compile: bool = False
    stiff: str | None = None
    guard: str = "flag"
    energy_every: int = 0
    md_between_ps: float = 0.0
    select: str | None = None
    atoms: str = "all"
    force: bool = False
    temperature_k: float | None = None

    def __post_init__(self) -> None:
        if self.solver_steps < 1:
            raise InputError(f"solver steps must be at least 1, not {self.solver_steps}.")
        if self.precision not in ("auto", "fp32", "bf16"):
            raise InputError(f"precision {self.precision!r} is unknown; choose auto, fp32 or bf16.")
        if self.guard not in GUARDS:
            raise UnknownNameError(
                f"guard {self.guard!r} is unknown; choose {', '.join(GUARDS)}.{nearest(self.guard, list(GUARDS))}"
            )
        if self.stiff not in (None, "modelled", "imposed"):
            raise InputError(f"stiff {self.stiff!r} is unknown; choose modelled or imposed.")
        if self.atoms not in ("all", "heavy"):
            raise InputError(f"atoms {self.atoms!r} is unknown; choose all or heavy.")
        if self.energy_every < 0 or self.md_between_ps < 0:
            raise InputError("the interval of energies and the MD between chunks cannot be negative.")

    @property
    def needs_openmm(self) -> bool:
        """Whether frames are relaxed or simulated by OpenMM."""
        return self.guard in ("repair", "fallback") or self.energy_every > 0 or self.md_between_ps > 0
