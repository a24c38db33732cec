"""The machine: its name, its cores, OpenMM's platforms and their properties."""

from __future__ import annotations

import os
import platform as machine
from functools import cache
from pathlib import Path


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
