"""Rates of a scene on this machine, measured in seconds: what MD and the weights that cover it simulate."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from md_reference.forces.spec import QUANTUM, QUANTUM_SOLVENTS
from md_reference.run.config import SIMD, MDConfig
from surrogate.models.architecture import shipped_weights, weights_path
from systems.errors import OutOfDomainError, SimulationError
from systems.scene import Scene
from systems.units import format_time_ps

if TYPE_CHECKING:
    from surrogate.models.weights import Weights

# Rollouts side by side: one batch, which costs little more than one of them. Of a potential's, sixteen run at once on
# each core; by torch a step of 32 is half as expensive for each as of 8.
REPLICAS, _POTENTIAL_REPLICAS, _REPLICAS_A_CORE = 8, 32, 16
# Weights for several lags step so far, or as near to it as they can; while they are measured so many times as far, as
# far as they go, which costs the same and shows how slowly the molecule relaxes.
LONG_LAG_PS = 10.0
_FURTHER = 10
_CHUNKS = 6
# Taken for the slowest relaxation of what nothing has been seen of: ps.
UNSEEN_PS = 1000.0
_LONGEST_STRETCH = 30.0
# Steps of OpenMM that minimising the energy of a cell of water costs, and ps of a replica that it takes to begin.
_MINIMISED_STEPS, _BEGINS_PS = 2500, 16.0
# Beyond this SIMD replicas are not tried: all compute the same pairs of waters, the more in vain the larger the cell.
_MOST_ATOMS_BY_SIMD = 3000


@dataclass(frozen=True)
class Rolls:
    """How weights (a name or a file) roll: frames `lag_ps` apart, ps in a second of wall time, replicas together;
    `relaxation_ps` of the slowest motion in the rollouts that were measured, and `usual_ps` of all torsion states, by
    which their populations become known (`usual_relaxation_ps`); 0 where rollouts are too short to show them."""

    weights: str
    lag_ps: float
    ps_per_s: float
    replicas: int = REPLICAS
    relaxation_ps: float = 0.0
    usual_ps: float = 0.0


@dataclass(frozen=True)
class Rates:
    """What was measured. `n_atoms`: that are written; `stretch`: wall seconds of a second of processor time with all
    `cores` in use, 1 where no other work shares them. `step_s`: processor seconds of a step of OpenMM's on one
    core; `md_ps_per_s`: of MD on all cores in a second of wall time, by the fastest way: on this `platform`, `at_once`
    replicas on each core; `md`: in words; `expensive`: it is quantum mechanics. `rolls`: of weights that cover the
    scene, None where none do; `coverage`: why these, or none. `without_simd`: why MD is not run by SIMD, where it might
    have been; `in_water`: in ALPB water, in which no potential learns; `explicit`: in a cell of water.
    """

    n_atoms: int
    cores: int
    stretch: float
    expensive: bool
    md: str
    step_s: float
    timestep_ps: float
    md_ps_per_s: float
    coverage: str
    rolls: Rolls | None = None
    platform: str = "auto"
    at_once: int = 1
    without_simd: str = ""
    in_water: bool = False
    explicit: bool = False

    @property
    def replicas(self) -> int:
        """How many replicas of MD run at once."""
        return self.cores * self.at_once

    @property
    def relaxation_ps(self) -> float:
        """The slowest relaxation that is reckoned with, ps."""
        return (self.rolls.relaxation_ps if self.rolls else 0.0) or UNSEEN_PS

    @property
    def usual_ps(self) -> float:
        """The relaxation by which the populations of all torsion states become known, ps."""
        return (self.rolls.usual_ps if self.rolls else 0.0) or self.relaxation_ps

    @property
    def relaxation_words(self) -> str:
        """Both in words."""
        seen = "as the first rollouts show" if self.rolls and self.rolls.relaxation_ps else "assumed"
        usual = f", that of states {format_time_ps(self.usual_ps, 2)}" if self.usual_ps != self.relaxation_ps else ""
        return f"a slowest relaxation of {format_time_ps(self.relaxation_ps, 2)}{usual}, {seen}"

    @property
    def begins_s(self) -> float:
        """Wall seconds, about, before MD in explicit water makes frames: its energy is minimised, replicas are turned
        to torsions of their own and come to equilibrium, all for as short as may be."""
        if not self.explicit:
            return 0.0
        return _MINIMISED_STEPS * self.step_s * self.stretch + _BEGINS_PS * self.replicas / self.md_ps_per_s

    @property
    def openmm_ps_per_s(self) -> float:
        """What OpenMM simulates in a second of wall time, a replica on each core."""
        return self.cores * self.timestep_ps / self.step_s / self.stretch


def measure(scene: Scene, config: MDConfig, named: str | Path | None, cores: int | None = None) -> Rates:
    """Return the rates of a scene: of MD with these settings, and of the weights `named`, or of shipped ones;
    `cores`: how many may be used, all by default.

    Raises OutOfDomainError where weights are named and do not cover the scene, and what MD of it raises.
    """
    from md_reference.forces.mixture import dry_part
    from md_reference.run.machine import available_cores
    from md_reference.run.plan import make_plan

    cores = min(cores or available_cores(), available_cores())
    stretch = measured_stretch(cores)
    by_openmm = replace(config, platform="auto") if config.platform == SIMD else config
    plan = make_plan(scene, by_openmm, replicas=cores)
    assert plan.us_per_step is not None
    dry = dry_part(scene)  # no weights roll water
    weights, coverage = _covering(dry, config, named)
    rates = Rates(
        n_atoms=_n_written(scene, by_openmm), cores=cores, stretch=stretch,
        expensive=config.force.force_field == QUANTUM, in_water=config.force.solvent in QUANTUM_SOLVENTS,
        explicit=config.force.is_explicit, md=plan.line, step_s=plan.us_per_step * 1e-6,
        timestep_ps=config.timestep_ps, md_ps_per_s=0.0, coverage=coverage, platform=by_openmm.platform,
        rolls=None if weights is None else rollout_rate(dry, weights, config.temperature_k, stretch, cores),
    )  # fmt: skip
    rates = replace(rates, md_ps_per_s=rates.openmm_ps_per_s)
    return rates if rates.expensive or config.platform not in ("auto", SIMD) else _by_simd(rates, scene, config)


def _by_simd(rates: Rates, scene: Scene, config: MDConfig) -> Rates:
    """Return the rates with MD by SIMD replicas where that is faster, else with the reason why it is not.

    Raises SimulationError where SIMD was asked for and cannot run the scene.
    """
    from md_reference.run.plan import make_plan
    from md_reference.simd.force_field import n_replicas

    asked_for = config.platform == SIMD
    if not asked_for and config.ensemble != "nvt":
        return replace(rates, without_simd=f"not in {config.ensemble}: they run in a bath (nvt) alone")
    if not asked_for and scene.n_atoms > _MOST_ATOMS_BY_SIMD:
        return replace(rates, without_simd=f"not tried: more than {_MOST_ATOMS_BY_SIMD} atoms")
    try:
        at_once = n_replicas()
        plan = make_plan(scene, replace(config, platform=SIMD), replicas=rates.cores * at_once)
    except SimulationError as error:
        if asked_for:
            raise
        return replace(rates, without_simd=str(error).removesuffix("; use another platform."))
    assert plan.us_per_step is not None
    ps_per_s = rates.cores * config.timestep_ps / (plan.us_per_step * 1e-6) / rates.stretch
    if ps_per_s <= rates.md_ps_per_s and not asked_for:
        return replace(rates, without_simd="no faster than OpenMM here")
    n_atoms = _n_written(scene, replace(config, platform=SIMD))
    return replace(rates, n_atoms=n_atoms, md=plan.line, md_ps_per_s=ps_per_s, platform=SIMD, at_once=at_once)


def _n_written(scene: Scene, config: MDConfig) -> int:
    """Return how many atoms MD of a scene writes: not its water, where that is left out."""
    kept = config.kept_atoms(scene)
    return scene.n_atoms if kept is None else len(kept)


def by_openmm(rates: Rates, scene: Scene, config: MDConfig, why: str) -> Rates:
    """Return the rates without SIMD, which is because of `why`."""
    from md_reference.run.machine import platform_for
    from md_reference.run.plan import plan_line

    choice = platform_for(scene, replace(config, platform="auto"))
    line = plan_line(scene, config, choice, step_s=rates.step_s)
    n_atoms = _n_written(scene, replace(config, platform="auto"))
    return replace(
        rates, n_atoms=n_atoms, md=line, md_ps_per_s=rates.openmm_ps_per_s, platform="auto", at_once=1, without_simd=why
    )


def rollout_rate(scene: Scene, weights: Weights, temperature_k: float, stretch: float, cores: int) -> Rolls:
    """Return how weights roll a scene that they cover, by a few chunks of it; `stretch`, `cores`: see `Rates`."""
    from surrogate.models.potential import Potential
    from surrogate.sampling.domain import in_bath
    from surrogate.sampling.runner import RolloutConfig, rollout

    lag_ps = weights.domain.lag_ps
    if weights.domain.jumps:
        lag_ps = min(max(LONG_LAG_PS, lag_ps), weights.domain.longest_lag_ps)
    replicas, relaxations_ps = REPLICAS, (0.0, 0.0)
    seen_ps = min(_FURTHER * lag_ps, weights.domain.longest_lag_ps) if weights.domain.jumps else lag_ps
    if isinstance(weights.model, Potential):  # so many steps a frame that one frame tells
        weights, replicas = in_bath(weights, {"n_new": 1}), max(_POTENTIAL_REPLICAS, _REPLICAS_A_CORE * cores)
    seen: list[tuple[float, float]] = []
    with tempfile.TemporaryDirectory(prefix="surromd-rate-") as folder:
        files = [Path(folder) / f"r{k}.h5" for k in range(replicas)]
        time_ps = _CHUNKS * weights.model.n_new * seen_ps
        rollout(
            scene,
            weights,
            files,
            RolloutConfig(time_ps=time_ps, save_every_ps=seen_ps, temperature_k=temperature_k),
            progress=lambda done, total, note: seen.append((time.monotonic(), time.process_time())),
            flush_every_s=3600.0,
        )
        if not isinstance(weights.model, Potential):
            relaxations_ps = _relaxations_ps(files)
    # As of MD the fastest batch counts: the first chunk makes what all others use again, the last one is flushed. Where
    # other work interrupts them all, processor time tells what a chunk takes; on several cores by itself, wall time.
    passed = [(wall - wall0, own - own0) for (wall0, own0), (wall, own) in pairwise(seen[:-1])]
    fastest_s = max(min(min(both) for both in passed), 1e-6)
    name = weights.path.stem if shipped_weights().get(weights.path.stem) == weights.path else str(weights.path)
    ps_per_s = replicas * weights.model.n_new * lag_ps / fastest_s / stretch
    return Rolls(name, lag_ps, ps_per_s, replicas, *relaxations_ps)


def _relaxations_ps(files: list[Path]) -> tuple[float, float]:
    """Return the longest integrated correlation time in trajectories, about the mean of all, and the usual one of
    torsion states."""
    from surrogate.comparison.measure.slow_motion import angles_of, longest_correlation
    from surrogate.comparison.measure.structure import Baseline
    from surrogate.comparison.read.ensemble import load_ensemble

    rolled = load_ensemble(files)
    baseline = Baseline.of(rolled, parent=rolled.scene, kept=rolled.kept)
    measured = baseline.measure(rolled)
    usual = usual_relaxation([segments for _, segments in angles_of([measured], baseline.torsions)])
    return round(longest_correlation(measured) * rolled.lag_ps, 3), round(usual * rolled.lag_ps, 3)


def usual_relaxation(torsions: Sequence[Sequence[npt.NDArray[np.floating]]]) -> float:
    """Return the relaxation time, in frames, of a process between two equal states whose populations are as uncertain
    as, in the mean square, those of all states of `torsions`, runs of angles in rad each: 4 <τ p (1 - p)>, τ the
    correlation time of being in a state of population p. 0 where no torsion has two states."""
    from surrogate.comparison.measure.kinetics import zero_crossing
    from surrogate.comparison.measure.torsions import find_wells

    found: list[float] = []
    for segments in torsions:
        wells = find_wells(segments)
        if len(wells.names) < 2:
            continue
        states = wells.assign(segments)
        for state in range(len(wells.names)):
            inside = [(x == state).astype(np.float64) for x in states]
            share, frames = float(np.concatenate(inside).mean()), zero_crossing(inside)[1]
            found.append(frames * share * (1.0 - share) if math.isfinite(frames) else 0.0)
    return 4.0 * float(np.mean(found)) if found else 0.0


def _covering(scene: Scene, config: MDConfig, named: str | Path | None) -> tuple[Weights | None, str]:
    """Return the weights that cover the scene under these conditions, and why these or why none."""
    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import choose_weights, match_domain, under_conditions

    asked = {"force_field": config.force.force_field, "solvent": config.force.solvent}
    if named is None:
        try:
            return choose_weights(scene, temperature_k=config.temperature_k, conditions=asked)
        except OutOfDomainError as error:
            return None, error.brief
    weights = load_weights(weights_path(named))
    match_domain(scene, weights, temperature_k=config.temperature_k)
    try:
        weights = under_conditions(weights, asked)
    except OutOfDomainError as error:
        raise OutOfDomainError(f"{error}; leave `weights` out, or ask for these conditions.") from error
    return weights, "asked for"


def measured_stretch(cores: int, seconds: float = 1.0) -> float:
    """Return the wall seconds of a second of processor time when so many threads compute at once; at least 1, and at
    most thirty, beyond which so short a look tells no more."""
    block = bytes(2**20)
    used_s = [0.0] * cores
    began = time.perf_counter()

    def compute(k: int) -> None:
        while time.perf_counter() - began < seconds:
            sha256(block)  # leaves the other threads alone
        used_s[k] = time.thread_time()

    threads = [threading.Thread(target=compute, args=(k,)) for k in range(cores)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = cores * (time.perf_counter() - began) / max(sum(used_s), 1e-3)
    return round(min(max(found, 1.0), _LONGEST_STRETCH), 2)
