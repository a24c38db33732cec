"""Plan of a reference run: what it will compute, what it leaves out and why, and what that saves on this machine."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.mixture import molecules_of
from md_reference.forces.nonstandard import lacking_residues
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import SIMD, MDConfig, resolved
from md_reference.run.engine import Engine
from md_reference.run.machine import as_records, available_cores
from md_reference.run.platforms import PlatformChoice, choose_platform, measured_platform, simd_choice
from md_reference.simd.force_field import SimdReplicas, n_replicas
from systems.scene import FloatArray, Scene, part_of
from systems.units import format_time_ps, format_wall

# Above this step a hydrogen of natural mass is integrated badly even with its bond constrained.
_LONGEST_NATURAL_STEP_PS = 0.0025
_STEPS_AT_ONCE = 50


@dataclass(frozen=True)
class Skip:
    """Something a general MD program would do and this run does not: why that is exact, and what it saves."""

    what: str
    why: str
    saves: str = ""


@dataclass(frozen=True)
class Plan:
    """A run before it starts. `terms` counts the interactions of each force; what was not measured is None.

    `wall_s`: seconds for all replicas of the asked length, equilibration included, if the cores are free. `line` says
    it all in one; `timings` is the table the platform was chosen by.
    """

    line: str

    scene: str
    formula: str
    n_atoms: int
    force_field: str
    solvent: str
    integrator: str
    platform: str
    platform_reason: str
    timings: tuple[dict[str, Any], ...]
    threads: int
    parallel: str
    hydrogen_mass: str
    constraints: str
    terms: dict[str, int]
    us_per_step: float | None
    ns_per_day: float | None
    length: str | None
    wall_s: float | None
    skipped: tuple[Skip, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return asdict(self)


def make_plan(scene: Scene, config: MDConfig, *, replicas: int = 1, measure_s: float = 0.3) -> Plan:
    """Return the plan of a run with these settings; one whose `time_ps` is 0 has no length yet.

    The platform is the one that `reference` would measure. For `measure_s` of wall time each, steps are timed as
    planned and as OpenMM would do it unasked; 0 times nothing, and the size of the scene decides.
    Raises PreparationError (no parameters), UnknownNameError (platform), SimulationError (the scene cannot be stepped).
    """
    config = resolved(scene, config)
    spec = config.force
    system = build_system(scene, spec)
    n_constraints = int(system.getNumConstraints())
    cores = available_cores()
    side_by_side = min(replicas, cores)
    by_simd = config.platform == SIMD
    if by_simd:
        choice = simd_choice()
    elif measure_s > 0:
        choice = measured_platform(
            scene,
            config,
            max_threads=max(1, cores // side_by_side),
            side_by_side=side_by_side,
            system=lambda: system,
        )
    else:
        choice = choose_platform(scene.n_atoms, config.platform, born=spec.solvent != "vacuum")
    planned = default = None
    if measure_s > 0 and by_simd:
        planned = _time_simd_s(scene, config, measure_s, system) / min(replicas, n_replicas())
    elif measure_s > 0:
        planned, relaxed_nm = _time_step_s(scene, config, measure_s, choice)
        if spec.force_field not in ("gfn2-xtb", "model"):
            alone = PlatformChoice("CPU", 1, "OpenMM's own")
            default, _ = _time_step_s(scene, config, measure_s, alone, relaxed_nm=relaxed_nm)
    wall_s = _wall_s(config, replicas, planned) if config.time_ps else None
    return Plan(
        line=plan_line(scene, config, choice, step_s=planned, replicas=replicas),
        scene=scene.name,
        formula=scene.formula,
        n_atoms=scene.n_atoms,
        force_field=spec.force_field,
        solvent=spec.solvent,
        integrator=_integrator(config),
        platform=choice.name,
        platform_reason=choice.reason,
        timings=tuple(as_records(list(choice.timings))),
        threads=choice.threads,
        parallel=f"{replicas} replicas, {n_replicas()} at once on a core"
        if by_simd
        else _parallel(replicas, cores, choice.threads),
        hydrogen_mass="natural"
        if spec.hydrogen_mass_da is None
        else f"{spec.hydrogen_mass_da:g} Da, taken from the atom it is bonded to",
        constraints=f"{n_constraints} bonds to hydrogen" if n_constraints else "none",
        terms=_terms(system),
        us_per_step=None if planned is None else planned * 1e6,
        ns_per_day=None if planned is None else config.timestep_ps * 1e-3 * 86_400.0 / planned,
        length=format_time_ps(config.time_ps) if config.time_ps else None,
        wall_s=wall_s,
        skipped=_skips(scene, config, n_constraints, planned, default),
        warnings=(*spec.warnings, *_warnings(scene, spec, config.timestep_ps)),
    )


def _time_simd_s(scene: Scene, config: MDConfig, wall_s: float, system: Any) -> float:
    """Return the seconds of processor time of one step of all replicas, the fastest of all batches measured.

    Raises SimdUnavailableError, and SimulationError where the replicas differ from OpenMM or cannot be stepped.
    """
    run = SimdReplicas(
        system,
        temperature_k=config.temperature_k,
        friction_per_ps=config.friction_per_ps,
        timestep_ps=min(config.timestep_ps, 0.001),
        seed=config.seed,
    )
    platform = "Reference" if scene.cell_nm is None else "CPU"
    with Engine(scene, replace(config, platform=platform), system=system) as engine:
        engine.minimise(max_iterations=100)
        relaxed_nm = engine.positions()
    run.check(system, relaxed_nm)
    run.set_positions(np.repeat(relaxed_nm[None], run.n_replicas, axis=0))
    run.step(20)
    fastest = math.inf
    began = time.perf_counter()
    while math.isinf(fastest) or time.perf_counter() - began < wall_s:
        start = time.process_time()
        run.step(100)
        fastest = min(fastest, (time.process_time() - start) / 100)
    return fastest


def _time_step_s(
    scene: Scene, config: MDConfig, wall_s: float, choice: PlatformChoice, *, relaxed_nm: FloatArray | None = None
) -> tuple[float, FloatArray]:
    """Return the seconds of one step, the fastest of all batches measured for `wall_s`, and the positions before them.

    On one core it is processor time, which other work on the machine does not lengthen. With `relaxed_nm` OpenMM's own
    way to the same forces is timed from there: to minimise by it would take minutes from a thousand atoms on.
    """
    timed = replace(config, ensemble="nvt", platform=choice.name)
    with Engine(scene, timed, threads=choice.threads, native_gb=relaxed_nm is None) as engine:
        if relaxed_nm is None:
            engine.minimise(max_iterations=100)
            relaxed_nm = engine.state().positions_nm
        else:
            engine.set_positions(relaxed_nm)
        engine.thermalise()
        began = time.perf_counter()
        engine.step(1)
        at_once = max(1, min(_STEPS_AT_ONCE, round(0.25 * wall_s / max(time.perf_counter() - began, 1e-9))))
        engine.step(at_once)
        on_one_core = engine.platform_name in ("Reference", "CPU") and engine.threads == 1
        clock = time.process_time if on_one_core else time.perf_counter
        fastest = math.inf
        began = time.perf_counter()
        while math.isinf(fastest) or time.perf_counter() - began < wall_s:
            start = clock()
            engine.step(at_once)
            fastest = min(fastest, (clock() - start) / at_once)
        return fastest, relaxed_nm


def _wall_s(config: MDConfig, replicas: int, step_s: float | None) -> float | None:
    """Return the seconds of all replicas, as many at once as there are cores, equilibration included."""
    if step_s is None:
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
    scene: Scene,
    config: MDConfig,
    choice: PlatformChoice,
    *,
    step_s: float | None = None,
    replicas: int = 0,
) -> str:
    """Return the plan in one line: what runs on what, what is left out, and how long it takes where that is known.

    `config`: `resolved`. `step_s`: seconds of a step, by the timing that chose the platform where it is not given;
    `replicas`: of how many the wall time is told, 0 for no such time.
    """
    if step_s is None:
        chosen = (t.us_per_step for t in choice.timings if (t.platform, t.threads) == (choice.name, choice.threads))
        timed = next(chosen, None)
        step_s = None if timed is None else timed * 1e-6
    wall_s = _wall_s(config, replicas, step_s) if replicas and config.time_ps else None
    spec = config.force
    periodic = scene.cell_nm is not None
    threads = "1 thread" if choice.threads == 1 else f"{choice.threads} threads"
    law = spec.force_field if scene.interactions is None else str(scene.interactions.get("kind"))
    born = " (native GBSAOBCForce)" if spec.solvent == "obc2" else ""
    rigid = spec.constrain_hydrogens and "H" in scene.elements
    parts = [
        f"{scene.n_atoms} atoms, {law} in {spec.solvent}{born}",
        f"{choice.name} on {threads} ({choice.reason})",
        _integrator(config),
        "bonds to hydrogen rigid" if rigid else "no constraints",
        "PME in a cell" if periodic else "all pairs; no cut-off, cell, PME or barostat without a cell",
    ]
    if step_s is not None:
        parts.append(f"about {config.timestep_ps * 1e-3 * 86_400.0 / step_s:.3g} ns/day")
    if wall_s is not None:
        parts.append(f"about {format_wall(wall_s)}")
    return "; ".join(parts)


def _parallel(replicas: int, cores: int, threads: int) -> str:
    each = "one thread" if threads == 1 else f"{threads} threads"
    if replicas == 1:
        return f"one replica, {each}"
    side_by_side = min(replicas, cores)
    return f"{replicas} replicas, {side_by_side} side by side, one process and {each} each"


def _terms(system: Any) -> dict[str, int]:
    counters = {
        "HarmonicBondForce": "getNumBonds",
        "HarmonicAngleForce": "getNumAngles",
        "PeriodicTorsionForce": "getNumTorsions",
        "CMAPTorsionForce": "getNumTorsions",
        "NonbondedForce": "getNumParticles",
        "GBSAOBCForce": "getNumParticles",
    }
    found = {}
    for force in system.getForces():
        name = force.getName()
        found[name] = int(getattr(force, counters[name])()) if name in counters else 1
    return found


def _skips(
    scene: Scene, config: MDConfig, n_constraints: int, planned: float | None, default: float | None
) -> tuple[Skip, ...]:
    spec, ensemble = config.force, config.ensemble
    skips = []
    if scene.cell_nm is None:
        skips.append(
            Skip("periodic box, PME, neighbour lists", "the scene has no periodic cell; all pairs are computed exactly")
        )
        skips.append(Skip("barostat", "there is no volume to control"))
    elif ensemble != "npt":
        skips.append(Skip("barostat", f"the ensemble is {ensemble}; npt has one"))
    if ensemble == "nve":
        skips.append(Skip("thermostat", "the ensemble is nve"))
        own = scene.interactions is not None
        why = "it is part of the model system" if own else "it is put at rest once and stays there"
        skips.append(Skip("removal of centre-of-mass motion", why))
    else:
        skips.append(Skip("removal of centre-of-mass motion", "the Langevin bath acts on it like on everything else"))
    if not config.save_velocities:
        skips.append(Skip("velocities on disk", "nobody asked for them (`save_velocities=True`)", "half of the file"))
    kept = config.kept_atoms(scene)
    if kept is not None:
        share = f"{1 - len(kept) / scene.n_atoms:.0%} of the file"
        skips.append(Skip("water and ions on disk", "it is simulated and not kept (`keep='all'` keeps it)", share))
    skips.append(Skip("energies and copies between saved frames", "nobody keeps them"))
    if spec.solvent == "vacuum":
        skips.append(Skip("generalised Born term", "the solvent is vacuum"))
    elif spec.solvent == "obc2":
        skips.append(
            Skip("CustomGBForce of implicit/obc2.xml", "the native GBSAOBCForce has the same energies and forces")
        )
    if n_constraints == 0:
        why = "there is no hydrogen" if "H" not in scene.elements else "bonds to hydrogen move freely here"
        skips.append(Skip("constraints", why))
    if planned is not None and default is not None:
        skips.append(
            Skip(
                "OpenMM's own choice of platform and forces (CPU)",
                "timed here, on one thread",
                f"{default * 1e6:.0f} -> {planned * 1e6:.0f} µs a step, {default / planned:.1f} times faster",
            )
        )
    return tuple(skips)


def _warnings(scene: Scene, spec: ForceFieldSpec, timestep_ps: float) -> tuple[str, ...]:
    found = []
    if spec.force_field.endswith("+gaff2"):
        lacking = [name for m in molecules_of(scene) for name in lacking_residues(part_of(scene, m))]
        if lacking:
            found.append(
                f"{', '.join(lacking)}: not in {spec.protein}; side chains by GAFF2, charges by AM1-BCC of the residue "
                "with its neighbours' ends."
            )
    natural = spec.hydrogen_mass_da is None or spec.hydrogen_mass_da < 1.5
    if timestep_ps > _LONGEST_NATURAL_STEP_PS and natural and "H" in scene.elements:
        found.append(
            f"{timestep_ps * 1000:g} fs is long for hydrogens of natural mass; use `hydrogen_mass_da='3Da'` or 2fs."
        )
    if timestep_ps > 0.001 and not spec.constrain_hydrogens and "H" in scene.elements:
        found.append(f"{timestep_ps * 1000:g} fs is long for unconstrained bonds to hydrogen; use at most 1fs.")
    return tuple(found)
