"""What MD's answer holds and how it is put into words; `surrogate.comparison.md_answer` finds it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Any

from surrogate.comparison.measure.statistics import FloatArray, IntArray
from systems.units import format_time_ps

# Shares are given no smaller error than counting leaves, and differ when they are so many errors apart.
_APART, _LEAST_APART = 2.5, 0.02
# MD contradicts a surrogate where it moves a share so many errors from the surrogate's.
_CONTRADICTS = 3.0
# What a surrogate is taken to be off by in the population of a state: weights keep no such number.
MODEL_ERROR = 0.1
# MD that has converged and whose errors are smaller than this share of that needs no surrogate.
_BY_ITSELF = 0.5

# Of every residue and further torsion its name, the label of each frame of MD, the names of labels, and the labels of
# the surrogate's frames.
Named = tuple[str, list[IntArray], tuple[str, ...], list[IntArray] | None]


@dataclass(frozen=True)
class StateEnergy:
    """A state of one torsion or residue. `share` of equilibrium with its standard `error`; `free_energy_kj_mol` above
    the likeliest state of that torsion, with `free_energy_error`; None where MD gives no weight; `n_replicas` that ever
    were there, `n_begun` there; `surrogate`: the share that the surrogate gives, `surrogate_error` its standard error,
    None without one; `missing`: what MD does not tell. Where the surrogate was taken in, `md_share` and `md_error` are
    MD's alone."""

    torsion: str
    state: str
    share: float
    error: float
    free_energy_kj_mol: float | None
    free_energy_error: float | None
    n_replicas: int
    n_begun: int
    surrogate: float | None = None
    surrogate_error: float | None = None
    missing: str = ""
    md_share: float | None = None
    md_error: float | None = None

    @property
    def is_known(self) -> bool:
        """Whether its share is known: by MD, or by the surrogate's transitions where MD has none."""
        return not self.missing if self.md_share is None else self.share > 0.0

    @property
    def by_md(self) -> tuple[float, float]:
        """MD's own share and its error."""
        return (self.share, self.error) if self.md_share is None else (self.md_share, self.md_error or 0.0)

    @property
    def differs(self) -> bool:
        """Whether the surrogate's share is outside the errors of MD's and its own."""
        if self.surrogate is None or self.missing:
            return False
        share, error = self.by_md
        error = math.hypot(error, self.surrogate_error or 0.0)
        return abs(self.surrogate - share) > max(_APART * error, _LEAST_APART)

    @property
    def moved(self) -> float:
        """How many errors MD has moved the surrogate's share. The variance of what data move a prior by is the prior's
        less what is left; the error that is left is the least."""
        if self.surrogate is None:
            return 0.0
        known = max(MODEL_ERROR**2 + (self.surrogate_error or 0.0) ** 2 - self.error**2, self.error**2)
        return abs(self.share - self.surrogate) / math.sqrt(known)


@dataclass(frozen=True, eq=False)
class Answer:
    """What MD says of a molecule, or a learned potential's rollout that its reference's energies reweight, or MD under
    an umbrella potential (`under_umbrella`): `energies` says of how many frames, and how many are effective. `weights`:
    of every frame, an array a replica; `lag_ps` between frames; `timescales_ps` with `timescale_errors_ps`, descending;
    `states`; `maps`: for each residue the free energy in kJ/mol `(36, 36)` over φ and ψ, from -180°, infinity where MD
    never was; `has_images`: whether each replica counts with its mirror image; `missing`: what it cannot tell."""

    method: str
    n_replicas: int
    replica_ps: float
    lag_ps: float
    model_lag_ps: float
    timescales_ps: tuple[float, ...]
    timescale_errors_ps: tuple[float, ...]
    tests: str
    has_images: bool
    holds: bool
    states: tuple[StateEnergy, ...]
    maps: dict[str, FloatArray]
    missing: tuple[str, ...]
    weights: tuple[FloatArray, ...]
    energies: tuple[int, float] = (0, 0.0)
    under_umbrella: bool = False

    @property
    def is_reweighted(self) -> bool:
        return self.energies[0] > 0

    @property
    def is_of_rollout(self) -> bool:
        """Whether it is of a rollout that its reference's energies reweight."""
        return self.is_reweighted and not self.under_umbrella

    @property
    def relaxation_ps(self) -> tuple[float, ...]:
        """Relaxation times of MD; none of a reweighted rollout, whose torsions Monte Carlo turns, or under an umbrella
        potential, which they do not tell."""
        return () if self.is_reweighted else self.timescales_ps

    @property
    def whose(self) -> str:
        """Whose populations these are, before the noun."""
        return "the reweighted" if self.is_of_rollout else "MD's"

    @property
    def _theirs(self) -> str:
        return f"{self.whose} ones" if self.is_of_rollout else self.whose

    @property
    def is_sure(self) -> bool:
        """Whether its tests hold, and transitions connect more than one of the states that were visited."""
        return self.holds and bool(self._weighed if self.states else self.timescales_ps or not self.missing)

    @property
    def _weighed(self) -> list[StateEnergy]:
        """The states that have weights, of torsions that have two or more of these."""
        known = [s for s in self.states if s.is_known]
        several = {t for t, n in Counter(s.torsion for s in known).items() if n > 1}
        return [s for s in known if s.torsion in several]

    @property
    def is_joint(self) -> bool:
        """Whether a surrogate's transitions count with MD's."""
        return any(s.md_share is not None for s in self.states)

    @property
    def wants_surrogate(self) -> bool:
        """Whether a surrogate's transitions may make it better: MD has not converged, lacks states, or has large
        errors."""
        rolled = [s for s in self.states if s.surrogate is not None]
        if not rolled or self.is_of_rollout:
            return False
        known = [s.error**2 for s in rolled if not s.missing]
        enough = (_BY_ITSELF * MODEL_ERROR) ** 2 * len(known)
        return not self.is_sure or bool(self.missing) or sum(known) > enough

    def is_better_than(self, joint: Answer) -> bool:
        """Whether MD alone, which lacks nothing, states errors no larger than with a surrogate's transitions."""
        own, both = (sum(s.error**2 for s in a.states) for a in (self, joint))
        return self.is_sure and not self.missing and own <= both

    @property
    def contradicts(self) -> bool:
        """Whether MD contradicts the surrogate whose transitions count with its own."""
        return self.is_joint and any(s.moved > _CONTRADICTS for s in self.states)

    @property
    def in_short(self) -> tuple[str, str, str]:
        """Three lines: whether to use it, for what and what is missing, why."""
        weighted = self._weighed
        widest = 100 * max((s.error for s in weighted), default=0.0)
        if self.is_joint:
            use = "Use MD's and the surrogate's populations together, for now."
            what = f"For {len(weighted)} states, each to {widest:.2g} % or better (one standard error; the surrogate "
            what += f"is taken to be off by {100 * MODEL_ERROR:.0f} %)."
        elif not self.states and self.holds:
            use, what = f"Use {self.whose} frames.", "For all distributions: no torsion has two states to weigh."
        elif not self.is_sure:
            what, shown = "No torsion has two states.", "frames"
            if n := len(self.states):
                what, shown = f"They show which states there are: {n}.", "populations"
            use = f"Do not use {self.whose} {shown} yet."
        else:
            use = "Use the reweighted rollout" if self.is_of_rollout else "Use MD's answer"
            use += ", except for states that few or no transitions connect." if self.missing else "."
            what = f"For populations and free energies of {len(weighted)} states, each to {widest:.2g} % or better"
            what += " (one standard error)" + (", and relaxation times." if self.relaxation_ps else ".")
        missing = f" Missing{' in MD' * self.is_joint}: {'; '.join(self.missing)}." if self.missing else ""
        slow = ""
        if self.relaxation_ps:
            error = f" ± {format_time_ps(self.timescale_errors_ps[0], 2)}" if self.timescale_errors_ps else ""
            slow = f"; the slowest process takes {format_time_ps(self.relaxation_ps[0], 2)}{error}"
        length = f"{self.n_replicas} replicas of {format_time_ps(self.replica_ps, 2)}"
        length += ", each with its mirror image" * self.has_images
        if self.is_joint:
            off = 100 * max((s.by_md[1] for s in weighted if not s.missing), default=0.0)
            not_yet = f" and by itself off by up to {off:.2g} %" if off else " and connects no states"
        else:
            not_yet = (
                "" if self.is_sure else "; it has not converged" if self.is_of_rollout else " and has not converged"
            )
        by = f"MD is {length}, weighed by {self.tests}"
        asked, effective = self.energies
        if self.under_umbrella:
            by = f"MD under an umbrella potential of torsions is {length}, weighed by {self.tests} and by it, which "
            by += f"leaves {effective:.0f} of {asked} frames effective"
        if self.is_of_rollout:
            by = f"the rollout is {length}, weighed by {self.tests} and by its reference's energies at {asked} frames, "
            by += f"of which {effective:.0f} are effective"
        return use, what + missing, f"Why: {by}{not_yet}{slow}."

    @property
    def on_surrogate(self) -> str:
        """One sentence about the surrogate's populations; empty where there is none."""
        weighted = [s for s in self.states if s.surrogate is not None and not s.missing]
        if not weighted:
            return ""
        if self.is_joint:
            most = max(weighted, key=lambda s: abs(s.share - (s.surrogate or 0.0)))
            to = percent(most.share, most.error)
            rolled = f"{100 * (most.surrogate or 0.0):.3g} %"
            return f"MD moves the surrogate's populations most in {most.torsion} {most.state}: {rolled} becomes {to}."
        off = sorted((s for s in weighted if s.differs), key=lambda s: -abs((s.surrogate or 0.0) - s.by_md[0]))
        if not off:
            widest = max(s.by_md[1] for s in weighted)
            return (
                f"The surrogate's populations agree with {self._theirs} in all {len(weighted)} states, within errors "
                f"of up to {100 * widest:.2g} %."
            )
        worst = off[0]
        instead = f"{100 * (worst.surrogate or 0.0):.3g} % instead of {percent(*worst.by_md)}"
        return (
            f"The surrogate's populations differ from {self._theirs} in {len(off)} of {len(weighted)} states, most in "
            f"{worst.torsion} {worst.state}: {instead}."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values; weights are in the trajectories."""
        found = {key: value for key, value in vars(self).items() if key not in ("weights", "states", "maps")}
        states = [vars(s) | {"differs": s.differs, "is_known": s.is_known} for s in self.states]
        maps = {k: [[x if math.isfinite(x) else None for x in row] for row in m.tolist()] for k, m in self.maps.items()}
        own = {
            "in_short": list(self.in_short),
            "populations_by": "MD and surrogate" if self.is_joint else "reweighting" if self.is_of_rollout else "MD",
            "on_surrogate": self.on_surrogate,
            "states": states,
            "maps_kj_mol": maps,
        }
        if self.is_reweighted:
            own |= {"timescales_ps": [], "timescale_errors_ps": []}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in found.items()} | own

    def table(self) -> list[tuple[str, str]]:
        """Return the states as lines of a name and a text."""
        lines = []
        for s in self.states:
            text = percent(s.share, s.error) if s.is_known else s.missing
            if s.is_known and s.free_energy_kj_mol is not None and s.free_energy_kj_mol > 0.0:
                text += f", {s.free_energy_kj_mol:.1f} ± {s.free_energy_error or 0.0:.1f} kJ/mol"
            if s.is_known and s.md_share is not None:
                text += f"; MD {s.missing or percent(*s.by_md)}"
            if s.surrogate is not None:
                text += f"; surrogate {percent(s.surrogate, s.surrogate_error or 0.0)}{', differs' * s.differs}"
            lines.append((f"{s.torsion} {s.state}", text))
        return lines


def percent(share: float, error: float) -> str:
    """Return a share and its error in per cent."""
    return f"{100 * share:.1f} ± {100 * error:.1f} %"
