"""Settings of a rollout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from systems.errors import InputError
from systems.options import check_options, option

# What is done about a frame that the guards catch: nothing and no stop at all; marked; the chunk drawn again; relaxed
# by OpenMM; replaced by real MD.
GUARDS = ("off", "flag", "resample", "repair", "fallback")


@dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """One rollout. `save_every_ps` None keeps every model frame. `lag_ps` is the time between these, of weights that
    were trained for several; None is what `choose_lag` says. `solver` None is the one that suits the weights, else
    one that its model knows. `precision` 'bf16' is autocast of the network (coordinates and integration stay fp32),
    'auto' is bf16 where the processor multiplies it faster.

    `guard`: see `surrogate.sampling.chunks`. `energy_every`: k, the energy of a learned potential is compared with the
    reference's at every k-th frame; 0 compares none. `anneal_ps`: before its first frame each replica of a learned
    potential moves for so long, from 600 K down to its temperature, so that torsions that turn seldom start all over.
    `select` and `atoms` say which atoms are written; all are computed. Raises InputError.
    """

    time_ps: float = option("Simulated time, such as 100ns.")
    save_every_ps: float | None = option("Interval between saved frames.", None, unset="that of the weights")
    lag_ps: float | None = option(
        "Lag time of a surrogate step, for weights trained at several.",
        None,
        unset="the longest that the save interval is a multiple of, of peptides 501ps to 1ns or up to 100ps",
    )
    solvent: str | None = option(
        "Solvent, for weights trained in several: obc2, tip3p.", None, unset="the first that they were trained in"
    )
    guard: str = option(
        "Action on invalid frames: flag, resample (the chunk), repair (by OpenMM), fallback (MD instead) or off.",
        "flag",
        choices=GUARDS,
    )
    energy_every: int = option(
        "Compare the energy with the reference's every N frames (learned potentials); 0 for none.",
        0,
        within=(0, None),
    )
    select: str | None = option("Atoms to save, as an MDTraj selection: 'backbone'.", None)
    atoms: str = option("Save all atoms or heavy atoms only.", "all", choices=("all", "heavy"))
    force: bool = option("Roll out scenes outside the training domain; frames are flagged.", False)
    temperature_k: float | None = option("Temperature; for models of frames it must be that of training.", None)
    friction_per_ps: float | None = option(
        "Langevin friction coefficient (learned potentials).", None, within=(0.0, None)
    )
    timestep_ps: float | None = option(
        "Integration time step (learned potentials); above 2fs bonds to hydrogen are constrained.", None
    )
    hydrogen_mass_da: float | None = option("Mass of hydrogens (learned potentials).", None, within=(1.0, 5.0))
    ensemble: str | None = option(
        "Ensemble (learned potentials).", None, choices=("nvt", "nve"), unset="that of the weights"
    )
    anneal_ps: float = option(
        "Length of simulated annealing from 600 K before the first frame (learned potentials).", 0.0, within=(0.0, None)
    )
    torsion_moves: int = option(
        "Monte Carlo moves of torsions per frame (learned potentials); populations as before, but no kinetics.",
        0,
        within=(0, 100),
    )
    solver: str | None = option(
        "ODE solver: multistep, fitted (few steps), gaussian, angular (peptides), euler, dopri5.",
        None,
        unset="chosen by the weights",
        section="sampling",
    )
    solver_steps: int | None = option(
        "ODE solver steps per chunk.", None, unset="10; peptides 6", within=(1, None), section="sampling"
    )
    precision: str = option(
        "Floating-point precision of the network.", "auto", choices=("auto", "fp32", "bf16"), section="sampling"
    )
    seed: int = option("Random seed.", 0, within=(0, None))

    def __post_init__(self) -> None:
        check_options(self)
        for name in ("temperature_k", "timestep_ps"):
            if (value := getattr(self, name)) is not None and not value > 0.0:
                raise InputError(f"{name} {value!r} must be greater than 0.")

    @property
    def bath(self) -> dict[str, Any]:
        """What is asked for of the integration, by the names of a potential's settings."""
        names = ("temperature_k", "friction_per_ps", "timestep_ps", "hydrogen_mass_da", "ensemble")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return given | ({"torsion_moves": self.torsion_moves} if self.torsion_moves else {})
