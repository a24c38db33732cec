"""Plan of a reference run: what it will compute, what it leaves out and why, and how long a step takes here."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import is_water, molecules_of
from md_reference.forces.nonstandard import find_chain
from md_reference.forces.spec import MODEL, QUANTUM, ForceFieldSpec
from md_reference.run.config import SIMD, MDConfig, resolved
from md_reference.run.engine import Engine
from md_reference.run.machine import PlatformChoice, available_cores, platform_for, simd_choice
from md_reference.simd.force_field import SimdReplicas, n_replicas
from systems.errors import SimulationError
from systems.scene import Scene, part_of
from systems.units import format_wall

_ALL_PAIRS = "all pairs computed (not periodic: no cut-off, PME or barostat)"
# Above this step a hydrogen of natural mass is integrated badly even with its bond constrained.
_LONGEST_NATURAL_STEP_PS = 0.0025
# A short step stands the starting positions, and takes as long as any.
_TIMED_STEP_PS = 0.001
_TIMED_S, _BATCH_S = 0.3, 0.02


@dataclass(frozen=True)
class Plan:
    """A run before it starts, in one `line` and in `rows`; what was not measured is None. `wall_s`: seconds for all
    replicas of the asked length, equilibration included, if the cores are free. `skipped`: what a general MD program
    would do and this run does not, and why, or what it saves."""

    line: str
    rows: dict[str, str | int]
    us_per_step: float | None
    ns_per_day: float | None
    wall_s: float | None
    skipped: dict[str, str]
    warnings: tuple[str, ...]


def make_plan(scene: Scene, config: MDConfig, *, replicas: int = 1, timed: bool = True) -> Plan:
    """Return the plan of a run with these settings; one whose `time_ps` is 0 has no length yet. Steps are timed as
    planned and on the CPU platform, unless nothing is to be `timed`. Raises PreparationError (no parameters),
    UnknownNameError (platform), SimulationError (the scene cannot be stepped)."""
    config = resolved(scene, config)
    spec = config.force
    system = build_system(scene, spec)
    n_constraints = int(system.getNumConstraints())
    cores, by_simd = available_cores(), config.platform == SIMD
    side_by_side = min(replicas, cores)
    planned = default = None
    if by_simd:
        choice = simd_choice()
        if timed:
            planned = _simd_step_s(scene, config, system) / min(replicas, n_replicas())
    else:
        choice = platform_for(scene, config, max_threads=max(1, cores // side_by_side))
        if timed:
            planned = _openmm_step_s(scene, config, system, choice.name, choice.threads)
        if timed and choice.name != "CPU" and spec.force_field not in (QUANTUM, MODEL):
            with suppress(SimulationError):
                default = _openmm_step_s(scene, config, system, "CPU", 1)
    threads = "one thread" if choice.threads == 1 else f"{choice.threads} threads"
    parallel = f"one replica, {threads}"
    if by_simd:
        parallel = f"{replicas} replicas, {n_replicas()} at once on a core"
    elif replicas > 1:
        parallel = f"{replicas} replicas, {side_by_side} side by side, one process and {threads} each"
    heavy = spec.hydrogen_mass_da
    rows: dict[str, str | int] = {
        "scene": scene.name,
        "formula": scene.formula,
        "n_atoms": scene.n_atoms,
        "force_field": spec.force_field,
        "solvent": spec.solvent,
        "integrator": _integrator(config),
        "platform": choice.name,
        "platform_reason": choice.reason,
        "threads": choice.threads,
        "parallel": parallel,
        "hydrogen_mass": "natural" if heavy is None else f"{heavy:g} Da, taken from the atom it is bonded to",
        "constraints": _constraints(n_constraints, rigid_waters(scene, spec)),
    }
    return Plan(
        line=plan_line(scene, config, choice, step_s=planned, replicas=replicas),
        rows=rows,
        us_per_step=None if planned is None else planned * 1e6,
        ns_per_day=None if planned is None else _ns_per_day(config, planned),
        wall_s=_wall_s(config, replicas, planned),
        skipped=_skipped(scene, config, n_constraints, planned, default),
        warnings=warnings_of(scene, config),
    )


def _fastest_s(step: Callable[[int], None], clock: Callable[[], float]) -> float:
    """Return the seconds of one step, the fastest of all batches measured."""
    step(1)  # kernels are compiled, neighbour lists built
    fastest, n, began = math.inf, 1, time.perf_counter()
    while math.isinf(fastest) or time.perf_counter() - began < _TIMED_S:
        start = clock()
        step(n)
        took = max(clock() - start, 1e-9)
        fastest = min(fastest, took / n)
        n = max(1, min(2 * n, round(n * _BATCH_S / took)))
    return fastest


def _simd_step_s(scene: Scene, config: MDConfig, system: Any) -> float:
    """Return the seconds of processor time of one step of all replicas. Raises SimdUnavailableError, and
    SimulationError where the replicas differ from OpenMM or cannot be stepped."""
    run = SimdReplicas(
        system,
        temperature_k=config.temperature_k,
        friction_per_ps=config.friction_per_ps,
        timestep_ps=min(config.timestep_ps, _TIMED_STEP_PS),
        seed=config.seed,
    )
    platform = "Reference" if scene.cell_nm is None else "CPU"
    with Engine(scene, replace(config, platform=platform), system=system) as engine:
        engine.minimise(max_iterations=100)
        relaxed_nm = engine.positions()
    run.check(system, relaxed_nm)
    run.set_positions(np.repeat(relaxed_nm[None], run.n_replicas, axis=0))
    return _fastest_s(run.step, time.process_time)


def _openmm_step_s(scene: Scene, config: MDConfig, system: Any, platform: str, threads: int) -> float:
    """Return the seconds of one step: processor time where it is that of one core, which other work on the machine does
    not lengthen, else wall time. Raises SimulationError where the scene cannot be stepped."""
    short = replace(config, platform=platform, ensemble="nvt", timestep_ps=min(config.timestep_ps, _TIMED_STEP_PS))
    with Engine(scene, short, threads=threads, system=system) as engine:
        engine.minimise(max_iterations=50)
        engine.thermalise()
        if platform in ("Reference", "CPU"):
            return _fastest_s(engine.step, time.process_time if threads == 1 else time.perf_counter)

        def step(n: int) -> None:
            engine.step(n)
            engine.energy()  # a device works on after `step` has returned

        return _fastest_s(step, time.perf_counter)


def _ns_per_day(config: MDConfig, step_s: float) -> float:
    return config.timestep_ps * 1e-3 * 86_400.0 / step_s


def _wall_s(config: MDConfig, replicas: int, step_s: float | None) -> float | None:
    """Return the seconds of all replicas, as many at once as there are cores, equilibration included; None for a run
    without a length, or a step that was not timed."""
    if step_s is None or not replicas or not config.time_ps:
        return None
    at_once = n_replicas() if config.platform == SIMD else 1
    rounds = math.ceil(math.ceil(replicas / at_once) / available_cores()) * min(replicas, at_once)
    return rounds * (config.time_ps + config.equilibrate_ps) / config.timestep_ps * step_s


def _integrator(config: MDConfig) -> str:
    step = f"{config.timestep_ps * 1000:g} fs"
    if config.ensemble == "nve":
        return f"velocity Verlet, {step}, no bath (started at {config.temperature_k:g} K)"
    text = f"Langevin middle, {step}, {config.temperature_k:g} K, {config.friction_per_ps:g}/ps"
    return text + (f"; Monte Carlo barostat at {config.pressure_bar:g} bar" if config.ensemble == "npt" else "")


def plan_line(
    scene: Scene, config: MDConfig, choice: PlatformChoice, *, step_s: float | None = None, replicas: int = 0
) -> str:
    """Return the plan in one line: what runs on what, what is left out, and how long it takes where that is known.
    `config`: `resolved`. `step_s`: seconds of a step; `replicas`: for how many the wall time is stated, 0 for no such
    time."""
    wall_s = _wall_s(config, replicas, step_s)
    spec = config.force
    threads = "1 thread" if choice.threads == 1 else f"{choice.threads} threads"
    law = spec.force_field if scene.interactions is None else str(scene.interactions.get("kind"))
    born = " (native GBSAOBCForce)" if spec.solvent == "obc2" else ""
    rigid = "no constraints"
    if spec.constrain_hydrogens and "H" in scene.elements:
        rigid = "bonds to hydrogen rigid"
    elif rigid_waters(scene, spec):
        rigid = "only water rigid"
    parts = [
        f"{scene.n_atoms} atoms, {law} in {spec.solvent}{born}",
        f"{choice.name} on {threads} ({choice.reason})",
        _integrator(config),
        rigid,
        "PME in a cell" if scene.cell_nm is not None else _ALL_PAIRS,
    ]
    if step_s is not None:
        parts.append(f"about {_ns_per_day(config, step_s):.3g} ns/day")
    if wall_s is not None:
        parts.append(f"about {format_wall(wall_s)}")
    return "; ".join(parts)


def rigid_waters(scene: Scene, spec: ForceFieldSpec) -> int:
    """Return the number of waters, which are rigid under every classical force field."""
    if spec.force_field in (QUANTUM, MODEL):
        return 0
    return sum(is_water(scene.elements, m) for m in molecules_of(scene))


def _constraints(n: int, n_waters: int) -> str:
    """Return n constraints in words; three of them hold a water."""
    bonds = [f"{n - 3 * n_waters} bonds to hydrogen"] if n > 3 * n_waters else []
    return ", ".join(bonds + [f"{n_waters} rigid waters"] * bool(n_waters)) or "none"


def _skipped(
    scene: Scene, config: MDConfig, n_constraints: int, planned: float | None, default: float | None
) -> dict[str, str]:
    ensemble, solvent = config.ensemble, config.force.solvent
    skipped: dict[str, str] = {}
    if scene.cell_nm is None:
        skipped["periodic box, PME, neighbour lists"] = "the scene has no periodic cell; all pairs are computed exactly"
    if ensemble != "npt":
        skipped["barostat"] = f"the ensemble is {ensemble}"
    rest = "not needed: the Langevin thermostat also acts on the centre of mass"
    if ensemble == "nve":
        skipped["thermostat"] = "the ensemble is nve"
        rest = "set to zero once; NVE conserves it"
    skipped["removal of centre-of-mass motion"] = rest
    if not config.save_velocities:
        skipped["velocities on disk"] = "not requested (`save_velocities=True`); halves the file size"
    kept = config.kept_atoms(scene)
    if kept is not None:
        share = f"{1 - len(kept) / scene.n_atoms:.0%} of the file"
        skipped["water and ions on disk"] = f"simulated and not kept (`keep='all'` keeps it): {share}"
    if solvent == "vacuum":
        skipped["generalised Born term"] = "the solvent is vacuum"
    elif solvent == "obc2":
        skipped["CustomGBForce of implicit/obc2.xml"] = "the native GBSAOBCForce has the same energies and forces"
    if n_constraints == 0:
        skipped["constraints"] = "no bond to hydrogen is rigid"
    if planned is not None and default is not None:
        times = f"{default * 1e6:.0f} -> {planned * 1e6:.0f} µs a step, {default / planned:.1f} times faster"
        skipped["OpenMM's CPU platform"] = f"timed here, on one thread: {times}"
    return skipped


def warnings_of(scene: Scene, config: MDConfig) -> tuple[str, ...]:
    """Return what is known to go badly with these settings, one line each. `config`: `resolved`."""
    spec, timestep_ps = config.force, config.timestep_ps
    found = [*spec.warnings]
    if spec.force_field.endswith("+gaff2"):
        chains = [find_chain(part_of(scene, m)) for m in molecules_of(scene)]
        lacking = [name for chain in chains if chain is not None for name in chain.lacking]
        if lacking:
            found.append(
                f"{', '.join(lacking)}: not in {spec.protein}; side chains by GAFF2, charges by AM1-BCC of the residue "
                "with its neighbours' ends."
            )
    natural = spec.hydrogen_mass_da is None or spec.hydrogen_mass_da < 1.5
    if timestep_ps > _LONGEST_NATURAL_STEP_PS and natural and "H" in scene.elements:
        found.append(
            f"{timestep_ps * 1000:g} fs is too long for hydrogens of natural mass; use `hydrogen_mass_da='3Da'` or "
            "`timestep_ps='2fs'`."
        )
    if timestep_ps > 0.001 and not spec.constrain_hydrogens and "H" in scene.elements:
        found.append(f"{timestep_ps * 1000:g} fs is too long for flexible bonds to hydrogen; use `timestep_ps='1fs'`.")
    return tuple(found)
