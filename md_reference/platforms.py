"""Which OpenMM platform wins for a scene of this size, and why."""

from __future__ import annotations

from dataclasses import dataclass

from systems.errors import UnknownNameError, nearest

# Up to so many atoms a thread of the Reference platform is at least as fast as one of the CPU platform. Measured with
# OpenMM 8.6.1 on peptides of 22 to 108 atoms: level with native OBC2 at 47 atoms on free cores (102 against 115
# µs a step at 42, 205 against 167 at 62) and near 62 on busy ones, in vacuum at about 105 (9 against 47 µs at 22).
REFERENCE_MAX_ATOMS_BORN = 55
REFERENCE_MAX_ATOMS_VACUUM = 100
# Below this a step is too short for a GPU: launching its kernels costs more than the forces.
GPU_MIN_ATOMS = 500


@dataclass(frozen=True)
class PlatformChoice:
    """An OpenMM platform, the threads it runs on, and the reason in words."""

    name: str
    threads: int
    reason: str


def choose_platform(n_atoms: int, requested: str = "auto", *, born: bool = True) -> PlatformChoice:
    """Return the platform for `n_atoms`, with a generalised Born term or without; a request is checked and kept.

    One thread in any case: below some hundreds of atoms a second thread slows a step down, and replicas, which run side
    by side, use the other cores. Raises UnknownNameError (with the nearest name) for a platform that is not here.
    """
    import openmm

    available = [openmm.Platform.getPlatform(i).getName() for i in range(openmm.Platform.getNumPlatforms())]
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
    for gpu in ("CUDA", "HIP", "OpenCL"):
        if gpu in available and n_atoms > GPU_MIN_ATOMS:
            return PlatformChoice(gpu, 1, f"{n_atoms} atoms and a {gpu} device")
    return PlatformChoice("CPU", 1, f"{n_atoms} atoms: vector instructions win above {largest}")
