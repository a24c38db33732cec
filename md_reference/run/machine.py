"""The machine: its name and cores, OpenMM's platforms, and which of them a scene runs on by its size."""

from __future__ import annotations

import os
import platform as machine
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from md_reference.forces.spec import QUANTUM
from md_reference.run.config import SIMD, Conditions
from md_reference.simd.force_field import n_replicas
from systems.errors import InputError, UnknownNameError, nearest
from systems.scene import Scene


@cache
def machine_name() -> str:
    """Return what the speed depends on: processor, number of cores, version and platforms of OpenMM."""
    import openmm

    model = machine.processor()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), model)
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


# Up to so many atoms a thread of the Reference platform is at least as fast as one of the CPU platform. Measured with
# OpenMM 8.6.1 on peptides of 22 to 108 atoms: level with native OBC2 at 47 atoms on free cores (102 against 115
# µs a step at 42, 205 against 167 at 62) and near 62 on busy ones, in vacuum at about 105 (9 against 47 µs at 22).
REFERENCE_MAX_ATOMS_BORN = 55
REFERENCE_MAX_ATOMS_VACUUM = 100
# Below this a step is too short for a GPU: launching its kernels costs more than the forces.
GPU_MIN_ATOMS = 500
# From this size on the CPU platform's threads pay; below, a second one only waits for the first.
_THREADS_MIN_ATOMS = 1000
_DEVICES = ("CUDA", "HIP", "OpenCL")


@dataclass(frozen=True)
class PlatformChoice:
    """An OpenMM platform, the threads it runs on, and the reason in words."""

    name: str
    threads: Annotated[int, range(1, 1025)]
    reason: str


def simd_choice() -> PlatformChoice:
    """Return the platform as plans and records name it. Raises SimdUnavailableError."""
    return PlatformChoice(SIMD, 1, f"{n_replicas()} replicas at once on a core, forces checked against OpenMM's")


def platform_for(scene: Scene, conditions: Conditions, *, max_threads: int = 1) -> PlatformChoice:
    """Return the platform for a scene under these conditions, the forces resolved: the one that they name, else by the
    scene's size, so that the same run takes the same one everywhere. `max_threads`: cores for this replica.

    Raises UnknownNameError (with the nearest name) for a platform that is not here, InputError for simd, in which
    OpenMM does not run, and for Reference in a cell that is not rectangular.
    """
    n_atoms, requested, born = scene.n_atoms, conditions.platform, conditions.force.solvent != "vacuum"
    available = [*platforms(), SIMD]
    if requested == SIMD:
        raise InputError("platform simd is for replicas of `reference` and `run`; use another platform here.")
    if requested not in ("auto", *available):
        raise UnknownNameError(
            f"platform {requested!r} is not available here; there are: {', '.join(available)}."
            + nearest(requested, available)
        )
    # OpenMM 8.6's Reference platform leaves out pairs there (see `SimdReplicas.check`).
    is_slanted = scene.cell_nm is not None and np.count_nonzero(scene.cell_nm) > 3
    if requested == "Reference" and is_slanted:
        raise InputError(
            "OpenMM's Reference platform omits pairs in non-rectangular cells, as this scene's; use platform CPU."
        )
    largest = REFERENCE_MAX_ATOMS_BORN if born else REFERENCE_MAX_ATOMS_VACUUM
    device = next((name for name in _DEVICES if name in available and n_atoms > GPU_MIN_ATOMS), None)
    if requested != "auto":
        name, reason = requested, "asked for"
    elif conditions.force.force_field == QUANTUM:
        name, reason = "Reference", "the xTB calculation dominates the cost of a step"
    elif n_atoms <= largest and not is_slanted:
        name, reason = "Reference", f"{n_atoms} atoms: no neighbour lists and no threads to wait for"
    elif device is not None:
        name, reason = device, f"{n_atoms} atoms and a {device} device"
    else:
        name, reason = "CPU", f"{n_atoms} atoms: vector instructions win above {largest}"
    if name == "CPU" and n_atoms >= _THREADS_MIN_ATOMS and max_threads > 1:
        return PlatformChoice(name, max_threads, f"{reason}, {max_threads} threads from {_THREADS_MIN_ATOMS} on")
    return PlatformChoice(name, 1, reason)
