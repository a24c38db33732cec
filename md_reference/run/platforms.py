"""Choice of the OpenMM platform for a scene: by measurement, or by its size where nothing may be timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import SIMD, Conditions
from md_reference.run.machine import Timing, measuring_allowed, platforms, recall, remember, size_class, time_platforms
from md_reference.simd.force_field import n_replicas
from systems.errors import InputError, UnknownNameError, nearest
from systems.scene import Scene

# Up to so many atoms a thread of the Reference platform is at least as fast as one of the CPU platform. Measured with
# OpenMM 8.6.1 on peptides of 22 to 108 atoms: level with native OBC2 at 47 atoms on free cores (102 against 115
# µs a step at 42, 205 against 167 at 62) and near 62 on busy ones, in vacuum at about 105 (9 against 47 µs at 22).
REFERENCE_MAX_ATOMS_BORN = 55
REFERENCE_MAX_ATOMS_VACUUM = 100
# Below this a step is too short for a GPU: launching its kernels costs more than the forces.
GPU_MIN_ATOMS = 500
# The Reference platform has no neighbour lists: far beyond the size where it can win, a single step takes seconds.
_REFERENCE_TIMED_ATOMS = 500
_TIMED_STEP_PS = 0.001
# Below this a second thread only waits for the first: 90 µs a step for 44 at 22 atoms.
_THREADS_TIMED_ATOMS = 100
_DEVICES = ("CUDA", "HIP", "OpenCL")
# More threads must pay for themselves: the cores they take could run another replica.
_EQUIVALENT_TIME_A_THREAD = 1.2


@dataclass(frozen=True)
class PlatformChoice:
    """An OpenMM platform, the threads it runs on, the reason in words, and the timings it rests on."""

    name: str
    threads: Annotated[int, range(1, 1025)]
    reason: str
    timings: tuple[Timing, ...] = ()


def simd_choice() -> PlatformChoice:
    """Return the platform as plans and records name it. Raises SimdUnavailableError."""
    return PlatformChoice(SIMD, 1, f"{n_replicas()} replicas at once on a core, forces checked against OpenMM's")


def choose_platform(n_atoms: int, requested: str = "auto", *, born: bool = True) -> PlatformChoice:
    """Return the platform for `n_atoms` by size alone, with a generalised Born term or without; a request is checked.

    One thread in any case: below some hundreds of atoms a second thread slows a step down, and replicas, which run side
    by side, use the other cores. Raises UnknownNameError (with the nearest name) for a platform that is not here,
    InputError for simd, in which OpenMM does not run.
    """
    available = [*platforms(), SIMD]
    if requested == SIMD:
        raise InputError("platform simd is for replicas of `reference` and `run`; take another platform here.")
    if requested != "auto":
        if requested not in available:
            raise UnknownNameError(
                f"platform {requested!r} is not available here; there are: {', '.join(available)}."
                + nearest(requested, available)
            )
        return PlatformChoice(requested, 1, "asked for")
    largest = REFERENCE_MAX_ATOMS_BORN if born else REFERENCE_MAX_ATOMS_VACUUM
    if n_atoms <= largest:
        return PlatformChoice("Reference", 1, f"{n_atoms} atoms: no neighbour lists and no threads to wait for")
    for gpu in _DEVICES:
        if gpu in available and n_atoms > GPU_MIN_ATOMS:
            return PlatformChoice(gpu, 1, f"{n_atoms} atoms and a {gpu} device")
    return PlatformChoice("CPU", 1, f"{n_atoms} atoms: vector instructions win above {largest}")


def measured_platform(
    scene: Scene,
    conditions: Conditions,
    *,
    max_threads: int = 1,
    side_by_side: int = 1,
    system: Callable[[], Any] | None = None,
) -> PlatformChoice:
    """Return the fastest platform for this scene, timed on it unless one as large has been timed here before.

    `conditions`: the forces settled (`forcefield.resolve`); a platform that they name is kept.

    `max_threads`: cores for each of the `side_by_side` replicas, which share a device where there is one. `system`
    returns the `openmm.System` where the caller has it. With SURROMD_TIMING=off, for quantum
    forces, whose program takes all the time, and where nothing can be timed, the size decides.
    Raises UnknownNameError for a platform that is not here, PreparationError for a scene without parameters.
    """
    spec, requested = conditions.force, conditions.platform
    by_size = _by_size(scene.n_atoms, spec, requested, max_threads)
    if requested not in ("auto", "CPU") or (requested == "CPU" and max_threads == 1) or not measuring_allowed():
        return by_size
    if spec.force_field == "gfn2-xtb":
        return replace(by_size, name="Reference", threads=1, reason="the quantum program takes all the time of a step")
    candidates = _candidates(scene.n_atoms, requested, max_threads)
    key = timing_key(scene, spec)
    known = recall(key)
    missing = [(name, threads) for name, threads in candidates if f"{name}/{threads}" not in known]
    if any(threads > 1 for _, threads in missing) and ("CPU", 1) not in missing:
        missing.insert(0, ("CPU", 1))  # by which it is seen whether the cores are free
    fresh: list[Timing] = []
    if missing:
        fresh = _time(scene, conditions, missing, system)
        remember(key, fresh)
    timings = [
        next((t for t in fresh if (t.platform, t.threads) == c), None)
        or Timing(*c, known.get(f"{c[0]}/{c[1]}"), "remembered")
        for c in candidates
    ]
    return choose_fastest(timings, by_size, n_atoms=scene.n_atoms, side_by_side=side_by_side)


def choose_fastest(
    timings: list[Timing], by_size: PlatformChoice, *, n_atoms: int, side_by_side: int = 1
) -> PlatformChoice:
    """Return the platform with the shortest step; the size rule's where there is no timing.

    More threads are taken where they are 1.2 times faster. A device is shared by the replicas that run side by side.
    """
    cost = {
        t: t.us_per_step * (side_by_side if t.platform in _DEVICES else 1) for t in timings if t.us_per_step is not None
    }
    if not cost:
        return replace(by_size, timings=tuple(timings))
    single = [t for t in cost if t.threads == 1]
    best = min(single or cost, key=lambda t: cost[t])
    for t in sorted(cost, key=lambda t: t.threads):
        if t.threads > best.threads and cost[t] * _EQUIVALENT_TIME_A_THREAD < cost[best]:
            best = t
    others = [f"{_name(t)} {cost[t]:.3g}" for t in sorted(cost, key=lambda t: cost[t]) if t is not best]
    reason = f"measured here on {n_atoms} atoms: {cost[best]:.3g} µs a step"
    if others:
        reason += f" ({', '.join(others)})"
    return PlatformChoice(best.platform, best.threads, reason, tuple(timings))


def _name(timing: Timing) -> str:
    return timing.platform if timing.threads == 1 else f"{timing.platform} on {timing.threads} threads"


def _by_size(n_atoms: int, spec: ForceFieldSpec, requested: str, max_threads: int) -> PlatformChoice:
    choice = choose_platform(n_atoms, requested, born=spec.solvent != "vacuum")
    # Unmeasured: the CPU platform's threads are worth it from about a thousand atoms on.
    if choice.name == "CPU" and n_atoms >= 1000 and max_threads > 1:
        return replace(choice, threads=max_threads, reason=f"{choice.reason}, {max_threads} threads from 1000 on")
    return choice


def _candidates(n_atoms: int, requested: str, max_threads: int) -> list[tuple[str, int]]:
    """Return what is worth timing, the likeliest winners first."""
    threads = [1]
    if n_atoms < _THREADS_TIMED_ATOMS:
        max_threads = 1
    while threads[-1] * 2 <= max_threads:
        threads.append(threads[-1] * 2)
    if threads[-1] < max_threads:
        threads.append(max_threads)
    found = [("CPU", n) for n in threads if "CPU" in platforms()]
    if requested == "CPU":
        return found
    if n_atoms <= _REFERENCE_TIMED_ATOMS:
        found.append(("Reference", 1))
    return found + [(name, 1) for name in _DEVICES if name in platforms()]


def timing_key(scene: Scene, spec: ForceFieldSpec) -> str:
    """Return under what name timings of scenes like this one are remembered: same law and solvent, same size class."""
    law = spec.force_field if scene.interactions is None else str(scene.interactions.get("kind"))
    return " ".join(
        [law, spec.solvent, "cell" if scene.cell_nm is not None else "free", f"size {size_class(scene.n_atoms)}"]
    )


def _time(
    scene: Scene, conditions: Conditions, candidates: list[tuple[str, int]], system: Callable[[], Any] | None
) -> list[Timing]:
    import openmm

    built = build_system(scene, conditions.force) if system is None else system()
    n_virtual = built.getNumParticles() - scene.n_atoms
    positions = np.concatenate([scene.positions_nm, np.zeros((n_virtual, 3))])
    temperature_k, timestep_ps = conditions.temperature_k, min(conditions.timestep_ps, _TIMED_STEP_PS)

    def integrator() -> Any:
        # A step takes as long at any length; a short one stands the starting positions.
        return openmm.LangevinMiddleIntegrator(temperature_k, conditions.friction_per_ps, timestep_ps)

    return time_platforms(built, positions, candidates, integrator, temperature_k=temperature_k)
