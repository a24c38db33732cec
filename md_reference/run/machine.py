"""The machine: its name, its cores, OpenMM's platforms and their properties; what a step of a scene takes on each.

Timings are measured side by side and remembered on disk.
"""

from __future__ import annotations

import json
import math
import os
import platform as machine
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from systems.errors import SurromdError, first_line
from systems.files.native import cache_folder
from systems.files.outside import content
from systems.files.schema import parsed
from systems.files.whole_file import create_whole


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


def measuring_allowed() -> bool:
    """False where the user has switched timings off: SURROMD_TIMING=off."""
    return os.environ.get("SURROMD_TIMING", "").lower() not in ("off", "0", "no", "false")


def size_class(n_atoms: int) -> int:
    """Return the class of a size: scenes within about a tenth of each other share one."""
    return round(math.log(max(n_atoms, 1)) / math.log(1.1))


def time_platforms(
    system: Any,
    positions_nm: Any,
    candidates: list[tuple[str, int]],
    make_integrator: Callable[[], Any],
    *,
    temperature_k: float,
) -> list[Timing]:
    """Time steps of an `openmm.System` on each `(platform, threads)`, in turn, and return the fastest batch of each.

    On one core it is processor time, which other work on the machine does not lengthen. With several threads, or on a
    device, only the wall counts; threads are not timed at all while other work takes the cores, for the number would
    be about that work. Positions `(n_particles, 3)` nm are relaxed first.
    """
    import openmm

    contexts: dict[tuple[str, int], Any] = {}
    found: dict[tuple[str, int], float] = {}
    notes: dict[tuple[str, int], str] = {}
    stretch: list[float] = []
    relaxed = None
    for candidate in candidates:
        name, threads = candidate
        try:
            context = openmm.Context(
                system, make_integrator(), openmm.Platform.getPlatform(name), platform_properties(name, threads)
            )
            context.setPositions(positions_nm if relaxed is None else relaxed)
            context.computeVirtualSites()
            if relaxed is None:
                openmm.LocalEnergyMinimizer.minimize(context, maxIterations=50)
                relaxed = context.getState(positions=True).getPositions()
            context.setVelocitiesToTemperature(temperature_k, 1)
            context.getIntegrator().step(1)  # kernels are compiled, neighbour lists built
            found[candidate], _ = _batch(context, candidate, 1)
        except openmm.OpenMMException as error:
            notes[candidate] = first_line(error)
            continue
        if found[candidate] < max(_HOPELESS * min(found.values()), _BATCH_S / 10):
            contexts[candidate] = context
    n_steps = {c: max(1, min(2000, round(_BATCH_S / found[c]))) for c in contexts}
    for _ in range(_ROUNDS):
        for candidate, context in list(contexts.items()):
            if candidate[1] > 1 and len(stretch) > 1 and sorted(stretch)[len(stretch) // 2] > _BUSY:
                notes[candidate] = "not timed: other work takes the cores"
                found.pop(candidate, None)
                del contexts[candidate]
                continue
            try:
                seconds, ratio = _batch(context, candidate, n_steps[candidate])
            except openmm.OpenMMException as error:
                notes[candidate] = first_line(error)
                found.pop(candidate, None)
                del contexts[candidate]
                continue
            found[candidate] = min(found[candidate], seconds)
            if ratio is not None:
                stretch.append(ratio)
    return [
        Timing(*c, found[c] * 1e6 if c in found else None, notes.get(c, "") if c not in found else "")
        for c in candidates
    ]


def _batch(context: Any, candidate: tuple[str, int], n_steps: int) -> tuple[float, float | None]:
    """Return the seconds of one step, and wall over processor time where the processor's is what counts."""
    one_core = candidate[0] in _ONE_CORE and candidate[1] == 1
    began, began_cpu = time.perf_counter(), time.process_time()
    context.getIntegrator().step(n_steps)
    if not one_core:
        context.getState(energy=True)  # a device works on after `step` has returned
    wall, cpu = time.perf_counter() - began, time.process_time() - began_cpu
    if not one_core:
        return wall / n_steps, None
    return max(cpu, 1e-9) / n_steps, wall / max(cpu, 1e-9)


# ---- the memory ----------------------------------------------------------------------------------------------------


def cache_file() -> Path:
    """Where timings are remembered."""
    return cache_folder() / "platform-timings.json"


def recall(key: str) -> dict[str, float]:
    """Return remembered µs a step by `platform/threads`; nothing where there is no file, or none that can be read."""
    entry = _read().get(machine_name(), {})
    entry = entry.get(key, {}) if isinstance(entry, dict) else {}
    if not isinstance(entry, dict):
        return {}
    return {
        str(name): float(us)
        for name, us in entry.items()
        if isinstance(us, int | float) and math.isfinite(us) and us > 0
    }


def remember(key: str, timings: list[Timing]) -> None:
    """Add timings to the file, which is replaced as a whole. A cache that cannot be written is done without."""
    fresh = {t.name: t.us_per_step for t in timings if t.us_per_step is not None}
    if not fresh:
        return
    machines = _read()
    mine = machines.get(machine_name())
    machines[machine_name()] = {**(mine if isinstance(mine, dict) else {}), key: {**recall(key), **fresh}}
    text = json.dumps({"format": _FORMAT, "us_per_step": machines}, indent=1)
    try:
        cache_file().parent.mkdir(parents=True, exist_ok=True)
        create_whole(cache_file(), text)
    except (OSError, SurromdError):
        pass


def _read() -> dict[str, Any]:
    """Return µs a step by machine, scene class and platform."""
    try:
        stored = parsed(content(cache_file()))
        return dict(stored["us_per_step"]) if stored["format"] == _FORMAT else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def as_records(timings: list[Timing]) -> list[dict[str, Any]]:
    """Return the table JSON-able."""
    return [asdict(t) for t in timings]
