"""Model systems in OpenMM: the law of a scene as a custom force."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from systems.errors import InputError
from systems.library.model_systems import check_law
from systems.scene import Scene


def build_model_system(scene: Scene) -> Any:
    """Return the `openmm.System` of a scene with `interactions`: particles with the scene's masses, one custom force.

    No constraints, no cell, no centre-of-mass removal. Raises InputError for a law that is unknown or incomplete.
    """
    from openmm import System

    law = scene.interactions
    if law is None:
        raise InputError(f"scene {scene.name!r} is no model system: it has no `interactions`.")
    check_law(law)
    system = System()
    for mass_da in scene.masses_da.tolist():
        system.addParticle(mass_da)
    force = _FORCES[law["kind"]](law, scene)
    force.setName(f"{law['kind']} law")
    system.addForce(force)
    return system


def _harmonic(law: dict[str, Any], scene: Scene) -> Any:
    names = dict(zip(("kx", "ky", "kz"), law["force_constants_kj_mol_nm2"], strict=True))
    return _external_force("0.5*(kx*x^2+ky*y^2+kz*z^2)", names, scene.n_atoms)


def _double_well(law: dict[str, Any], scene: Scene) -> Any:
    energy = "barrier_kj_mol*((x/minimum_nm)^2-1)^2 + tilt_kj_mol_nm*x + 0.5*transverse_kj_mol_nm2*(y^2+z^2)"
    return _external_force(energy, {key: value for key, value in law.items() if key != "kind"}, scene.n_atoms)


def _external_force(energy: str, constants: dict[str, float], n_particles: int) -> Any:
    from openmm import CustomExternalForce

    force = CustomExternalForce(energy)
    for name, value in constants.items():
        force.addGlobalParameter(name, value)
    for k in range(n_particles):
        force.addParticle(k, [])
    return force


_FORCES: dict[str, Callable[[dict[str, Any], Scene], Any]] = {
    "harmonic": _harmonic,
    "double-well": _double_well,
}
