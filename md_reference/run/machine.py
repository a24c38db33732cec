"""The machine: its name and cores, OpenMM's platforms, and which of them a scene runs on.

Steps are timed side by side and remembered on disk; where nothing may be timed, the size of the scene decides.
"""

from __future__ import annotations

import json
import math
import os
import platform as machine
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import median_high
from typing import Annotated, Any

import numpy as np

from md_reference.forces.forcefield import build_system
from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import SIMD, Conditions
from md_reference.simd.force_field import n_replicas
from systems.errors import InputError, SurromdError, UnknownNameError, first_line, nearest
from systems.files.native import cache_folder
from systems.files.outside import content
from systems.files.schema import parsed
from systems.files.whole_file import create_whole
from systems.scene import Scene


@cache
def machine_name() -> str:
    """Return what the speed depends on: processor, number of cores, version and platforms of OpenMM."""
    import openmm

    model = machine.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
    except OSError:
        pass
    return " | ".join([machine.machine(), model, f"{os.cpu_count()} cores", openmm.__version__, *platforms()])


@cache
def platforms() -> tuple[str, ...]:
    """Return the names of OpenMM's platforms that are installed here."""
    import openmm

    return tuple(openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms()))


def available_cores() -> int:
    """Cores this process may use (affinity respected where the system tells)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def platform_properties(name: str, threads: int) -> dict[str, str]:
    """Return the properties of a Context. Forces are added up in a fixed order, so that runs repeat: in a periodic cell
    one thread does not do so by itself."""
    return {"Threads": str(threads), "DeterministicForces": "true"} if name == "CPU" else {}


def make_context(system: Any, integrator: Any, name: str, threads: int) -> Any:
    """Return an `openmm.Context` on a platform. Raises OpenMMException where it cannot run the system."""
    import openmm

    return openmm.Context(system, integrator, openmm.Platform.getPlatform(name), platform_properties(name, threads))


# ---- timings --------------------------------------------------------------------------------------------------------


_FORMAT = 1
_BATCH_S = 0.02
_ROUNDS = 5
# A platform this many times slower than the best so far is timed by its first steps alone.
_HOPELESS = 4.0
# Wall time over processor time of a single thread, above which other work is taking the cores.
_BUSY = 1.25
_ONE_CORE = ("Reference", "CPU")


@dataclass(frozen=True)
class Timing:
    """One platform with so many threads: µs a step, or None and a note why there is no number."""

    platform: str
    threads: int
    us_per_step: float | None
    note: str = ""

    @property
    def name(self) -> str:
        return f"{self.platform}/{self.threads}"


def time_platforms(
    system: Any, positions_nm: Any, candidates: list[tuple[str, int]], make_integrator: Callable[[], Any], *,
    temperature_k: float,
) -> list[Timing]:  # fmt: skip
    """Time steps of an `openmm.System` on each `(platform, threads)`, in turn, and return the fastest batch of each.

    On one core it is processor time, which other work on the machine does not lengthen. With several threads, or on a
    device, only the wall counts; threads are not timed at all while other work takes the cores, for the number would
    be about that work. Positions `(n_particles, 3)` nm are relaxed first.
    """
    import openmm

    contexts: dict[tuple[str, int], Any] = {}
    found: dict[tuple[str, int], float] = {}
    notes: dict[tuple[str, int], str] = {}
    wall_over_cpu: list[float] = []

    def leave_out(candidate: tuple[str, int], why: str) -> None:
        notes[candidate] = why
        found.pop(candidate, None)
        contexts.pop(candidate, None)

    relaxed = None
    for candidate in candidates:
        try:
            context = make_context(system, make_integrator(), *candidate)
            context.setPositions(positions_nm if relaxed is None else relaxed)
            context.computeVirtualSites()
            if relaxed is None:
                openmm.LocalEnergyMinimizer.minimize(context, maxIterations=50)
                relaxed = context.getState(positions=True).getPositions()
            context.setVelocitiesToTemperature(temperature_k, 1)
            context.getIntegrator().step(1)  # kernels are compiled, neighbour lists built
            found[candidate], _ = _batch(context, candidate, 1)
        except openmm.OpenMMException as error:
            leave_out(candidate, first_line(error))
            continue
        if found[candidate] < max(_HOPELESS * min(found.values()), _BATCH_S / 10):
            contexts[candidate] = context
    n_steps = {c: max(1, min(2000, round(_BATCH_S / found[c]))) for c in contexts}
    for _ in range(_ROUNDS):
        for candidate, context in list(contexts.items()):
            if candidate[1] > 1 and len(wall_over_cpu) > 1 and median_high(wall_over_cpu) > _BUSY:
                leave_out(candidate, "not timed: other work takes the cores")
                continue
            try:
                seconds, ratio = _batch(context, candidate, n_steps[candidate])
            except openmm.OpenMMException as error:
                leave_out(candidate, first_line(error))
                continue
            found[candidate] = min(found[candidate], seconds)
            if ratio is not None:
                wall_over_cpu.append(ratio)
    return [Timing(*c, found[c] * 1e6 if c in found else None, notes.get(c, "")) for c in candidates]


def _batch(context: Any, candidate: tuple[str, int], n_steps: int) -> tuple[float, float | None]:
    """Return the seconds of one step, and wall over processor time where the processor's is what counts."""
    one_core = candidate[0] in _ONE_CORE and candidate[1] == 1
    began, began_cpu = time.perf_counter(), time.process_time()
    context.getIntegrator().step(n_steps)
    if not one_core:
        context.getState(energy=True)  # a device works on after `step` has returned
    wall, cpu = time.perf_counter() - began, max(time.process_time() - began_cpu, 1e-9)
    return (cpu / n_steps, wall / cpu) if one_core else (wall / n_steps, None)


def cache_file() -> Path:
    """Where timings are remembered."""
    return cache_folder() / "platform-timings.json"


def recall(key: str) -> dict[str, float]:
    """Return remembered µs a step by `platform/threads`; nothing where there is no file, or none that can be read."""
    try:
        known = dict(_remembered()[machine_name()][key])
        return {name: float(us) for name, us in known.items() if 0 < float(us) < math.inf}
    except (KeyError, TypeError, ValueError):
        return {}


def remember(key: str, timings: list[Timing]) -> None:
    """Add timings to the file, which is replaced as a whole. A cache that cannot be written is done without."""
    fresh = {t.name: t.us_per_step for t in timings if t.us_per_step is not None}
    if not fresh:
        return
    machines = _remembered()
    mine = machines.get(machine_name())
    machines[machine_name()] = {**(mine if isinstance(mine, dict) else {}), key: {**recall(key), **fresh}}
    try:
        cache_file().parent.mkdir(parents=True, exist_ok=True)
        create_whole(cache_file(), json.dumps({"format": _FORMAT, "us_per_step": machines}, indent=1))
    except (OSError, SurromdError):
        pass


def _remembered() -> dict[str, Any]:
    """Return µs a step by machine, scene class and platform."""
    try:
        stored = parsed(content(cache_file()))
        return dict(stored["us_per_step"]) if stored["format"] == _FORMAT else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


# ---- the choice -----------------------------------------------------------------------------------------------------


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
_WORTH_MORE_THREADS = 1.2


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
    if requested not in ("auto", *available):
        raise UnknownNameError(
            f"platform {requested!r} is not available here; there are: {', '.join(available)}."
            + nearest(requested, available)
        )
    if requested != "auto":
        return PlatformChoice(requested, 1, "asked for")
    largest = REFERENCE_MAX_ATOMS_BORN if born else REFERENCE_MAX_ATOMS_VACUUM
    if n_atoms <= largest:
        return PlatformChoice("Reference", 1, f"{n_atoms} atoms: no neighbour lists and no threads to wait for")
    device = next((name for name in _DEVICES if name in available and n_atoms > GPU_MIN_ATOMS), None)
    if device is not None:
        return PlatformChoice(device, 1, f"{n_atoms} atoms and a {device} device")
    return PlatformChoice("CPU", 1, f"{n_atoms} atoms: vector instructions win above {largest}")


def measured_platform(
    scene: Scene, conditions: Conditions, *, max_threads: int = 1, side_by_side: int = 1,
    system: Callable[[], Any] | None = None,
) -> PlatformChoice:  # fmt: skip
    """Return the fastest platform for this scene, timed on it unless one as large has been timed here before.

    `conditions`: the forces resolved (`forcefield.resolve`); a platform that they name is kept. `max_threads`: cores
    for each of the `side_by_side` replicas, which share a device where there is one. `system` returns the
    `openmm.System` where the caller has it. With SURROMD_TIMING=off, for quantum forces, whose program takes all the
    time, and where nothing can be timed, the size decides.
    Raises UnknownNameError for a platform that is not here, PreparationError for a scene without parameters.
    """
    spec, requested = conditions.force, conditions.platform
    by_size = choose_platform(scene.n_atoms, requested, born=spec.solvent != "vacuum")
    # Unmeasured: the CPU platform's threads are worth it from about a thousand atoms on.
    if by_size.name == "CPU" and scene.n_atoms >= 1000 and max_threads > 1:
        reason = f"{by_size.reason}, {max_threads} threads from 1000 on"
        by_size = replace(by_size, threads=max_threads, reason=reason)
    is_off = os.environ.get("SURROMD_TIMING", "").lower() in ("off", "0", "no", "false")
    if is_off or requested not in ("auto", "CPU") or (requested == "CPU" and max_threads == 1):
        return by_size
    if spec.force_field == QUANTUM:
        return replace(by_size, name="Reference", threads=1, reason="the quantum program takes all the time of a step")
    candidates = _candidates(scene.n_atoms, requested, max_threads)
    key = timing_key(scene, spec)
    known = recall(key)
    missing = [(name, threads) for name, threads in candidates if f"{name}/{threads}" not in known]
    if any(threads > 1 for _, threads in missing) and ("CPU", 1) not in missing:
        missing.insert(0, ("CPU", 1))  # by which it is seen whether the cores are free
    fresh: dict[tuple[str, int], Timing] = {}
    if missing:
        timed = time_steps(scene, conditions, missing, build_system(scene, spec) if system is None else system())
        remember(key, timed)
        fresh = {(t.platform, t.threads): t for t in timed}
    timings = [fresh.get(c) or Timing(*c, known.get(f"{c[0]}/{c[1]}"), "remembered") for c in candidates]
    return choose_fastest(timings, by_size, n_atoms=scene.n_atoms, side_by_side=side_by_side)


def choose_fastest(
    timings: list[Timing], by_size: PlatformChoice, *, n_atoms: int, side_by_side: int = 1
) -> PlatformChoice:
    """Return the platform with the shortest step; the size rule's where there is no timing. More threads are taken
    where they are 1.2 times faster. A device is shared by the replicas that run side by side."""
    cost = {
        t: t.us_per_step * (side_by_side if t.platform in _DEVICES else 1) for t in timings if t.us_per_step is not None
    }
    if not cost:
        return replace(by_size, timings=tuple(timings))
    best = min([t for t in cost if t.threads == 1] or cost, key=lambda t: cost[t])
    for t in sorted(cost, key=lambda t: t.threads):
        if t.threads > best.threads and cost[t] * _WORTH_MORE_THREADS < cost[best]:
            best = t
    named = {t: t.platform if t.threads == 1 else f"{t.platform} on {t.threads} threads" for t in cost}
    others = [f"{named[t]} {cost[t]:.3g}" for t in sorted(cost, key=lambda t: cost[t]) if t is not best]
    reason = f"measured here on {n_atoms} atoms: {cost[best]:.3g} µs a step"
    return PlatformChoice(
        best.platform, best.threads, reason + (f" ({', '.join(others)})" if others else ""), tuple(timings)
    )


def _candidates(n_atoms: int, requested: str, max_threads: int) -> list[tuple[str, int]]:
    """Return what is worth timing, the likeliest winners first."""
    most = max_threads if n_atoms >= _THREADS_TIMED_ATOMS else 1
    found = [("CPU", n) for n in sorted({most, *(2**k for k in range(most.bit_length()))})]
    if requested != "CPU":
        found += [("Reference", 1)] * (n_atoms <= _REFERENCE_TIMED_ATOMS) + [(name, 1) for name in _DEVICES]
    return [candidate for candidate in found if candidate[0] in platforms()]


def timing_key(scene: Scene, spec: ForceFieldSpec) -> str:
    """Return under what name timings of scenes like this one are remembered: same law and solvent, same size class,
    which scenes within about a tenth of each other share."""
    law = spec.force_field if scene.interactions is None else str(scene.interactions.get("kind"))
    size = round(math.log(max(scene.n_atoms, 1)) / math.log(1.1))
    return f"{law} {spec.solvent} {'cell' if scene.cell_nm is not None else 'free'} size {size}"


def time_steps(scene: Scene, conditions: Conditions, candidates: list[tuple[str, int]], system: Any) -> list[Timing]:
    """Return what a step of a scene takes on each `(platform, threads)`, by its `openmm.System`."""
    import openmm

    n_virtual = system.getNumParticles() - scene.n_atoms
    positions = np.concatenate([scene.positions_nm, np.zeros((n_virtual, 3))])
    temperature_k, timestep_ps = conditions.temperature_k, min(conditions.timestep_ps, _TIMED_STEP_PS)

    def integrator() -> Any:
        # A step takes as long at any length; a short one stands the starting positions.
        return openmm.LangevinMiddleIntegrator(temperature_k, conditions.friction_per_ps, timestep_ps)

    return time_platforms(system, positions, candidates, integrator, temperature_k=temperature_k)
