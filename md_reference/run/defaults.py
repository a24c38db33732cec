"""The settings of a run: what the user gave, else the protocol asked for by name, else the program's defaults.

The defaults are those of the molecule, under whichever name it is asked for. Model systems bring settings of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from typing import Any

from md_reference.forces.spec import QUANTUM, ForceFieldSpec
from md_reference.run.config import MDConfig
from systems.errors import InputError
from systems.library import named_scenes
from systems.library.protocols import find_protocol
from systems.scene import Scene
from systems.units import format_time_ps

# Bonds to hydrogen of natural mass swing in 9 fs; a longer step than this needs them rigid.
LONGEST_FLEXIBLE_STEP_PS = 0.001
# A quantum-mechanical force takes a thousand times as long as a classical one: steps are as long as they may be, with
# hydrogens so heavy and their bonds rigid, and flexible bonds of natural hydrogens, where asked for, get short ones.
LONGEST_QUANTUM_STEP_PS = 0.004
_HYDROGEN_MASS_DA = 3.0
_FLEXIBLE_QUANTUM_STEP_PS = 0.0005
_QUANTUM_EQUILIBRATION_PS = 1.0
_WORDS = {
    "force_field": "force field",
    "temperature_k": "temperature",
    "friction_per_ps": "friction",
    "timestep_ps": "time step",
    "hydrogen_mass_da": "hydrogen mass",
    "save_every_ps": "saved every",
    "equilibrate_ps": "equilibration",
}


def defaults() -> dict[str, Any]:
    """Return the program's own settings: those of MDConfig and ForceFieldSpec but the seed, the forces left open."""
    found: dict[str, Any] = {f.name: f.default for kind in (MDConfig, ForceFieldSpec) for f in fields(kind)
                             if f.default is not MISSING and f.name != "seed"}  # fmt: skip
    return found | {"force_field": "auto", "solvent": "auto"}


def settle(scene: Scene, given: Mapping[str, Any], protocol: str | None = None) -> tuple[dict[str, Any], str]:
    """Return all settings of a run of `scene`, and a line about what its protocol decided, empty where nothing.

    `given` holds what the user asked for, by the names of MDConfig and ForceFieldSpec; `protocol` names one of
    `systems.library.protocols`. Its solvent goes with its force field and is left out when the user names another one;
    its flexible bonds are left out above a time step of 1 fs. Quantum forces have flexible bonds and natural hydrogens
    up to that step (at 0.5 fs if only these are asked for).
    Raises UnknownNameError, and InputError for a model system, whose settings are its own.
    """
    name = scene.provenance.get("library_name")
    return settle_by_name(name if isinstance(name, str) else "", given, protocol)


def settle_by_name(name: str, given: Mapping[str, Any], protocol: str | None = None) -> tuple[dict[str, Any], str]:
    """Return what `settle` does for the scene of this name, or any other if the library does not know it."""
    decisive, said_as = _decisive(name, protocol)
    if "force_field" in given:
        decisive.pop("solvent", None)
    own = defaults()
    if given.get("force_field") == QUANTUM:
        own |= _of_quantum(decisive | dict(given))
        decisive.pop("equilibrate_ps", None)
    settings = own | decisive | dict(given)
    if settings["timestep_ps"] > LONGEST_FLEXIBLE_STEP_PS and "constrain_hydrogens" not in given:
        settings["constrain_hydrogens"] = True
    decided = {key: settings[key] for key in decisive if key not in given and settings[key] != own[key]}
    if not decided:
        return settings, ""
    what, source = said_as
    return settings, f"{what}: {', '.join(_say(key, value) for key, value in decided.items())} ({source})"


def to_config(values: Mapping[str, Any], *, seed: int) -> MDConfig:
    """Return a run of these settings, by the names of MDConfig and ForceFieldSpec; forces left open are settled for its
    scene later. Raises InputError where its length is not given, and what the fields refuse."""
    if "time_ps" not in values:
        raise InputError("time is missing; write, for example, time = '10ns'.")
    of_forces = {f.name for f in fields(ForceFieldSpec)}
    force = {"force_field": "auto", "solvent": "auto"} | {k: v for k, v in values.items() if k in of_forces}
    own = {key: value for key, value in values.items() if key not in of_forces}
    return MDConfig(**own, seed=seed, force=ForceFieldSpec(**force))


def _of_quantum(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults at quantum level beside what is asked for. Raises InputError for too long a step."""
    is_flexible = asked.get("constrain_hydrogens") is False or asked.get("hydrogen_mass_da", _HYDROGEN_MASS_DA) is None
    step_ps = asked.get("timestep_ps", _FLEXIBLE_QUANTUM_STEP_PS if is_flexible else LONGEST_QUANTUM_STEP_PS)
    if step_ps > LONGEST_QUANTUM_STEP_PS:
        raise InputError(f"{format_time_ps(step_ps)} is too long for {QUANTUM}; use `timestep_ps='4fs'` or less.")
    is_long = step_ps > LONGEST_FLEXIBLE_STEP_PS
    return {
        "timestep_ps": step_ps,
        "equilibrate_ps": _QUANTUM_EQUILIBRATION_PS,
        "hydrogen_mass_da": _HYDROGEN_MASS_DA if is_long else None,
        "constrain_hydrogens": is_long,
    }


def _decisive(name: str, protocol: str | None) -> tuple[dict[str, Any], tuple[str, str]]:
    """Return the settings that come before the program's defaults, and how they and their source are called."""
    own = named_scenes.own_settings(name) if named_scenes.knows(name) else {}
    if protocol is None:
        return own, ("by the system's own settings", named_scenes.source_of_settings(name) if own else "")
    if own:
        raise InputError(f"{name} brings its own law and its own settings; leave `protocol` out.")
    found = find_protocol(protocol)
    return dict(found.settings), (f"by protocol {found.name}", found.source)


def _say(key: str, value: Any) -> str:
    word = _WORDS.get(key, key)
    if key.endswith("_per_ps"):
        return f"{word} {value:g}/ps"
    if key.endswith("_ps"):
        return f"no {word}" if value == 0 else f"{word} {format_time_ps(value)}"
    if key.endswith("_k"):
        return f"{word} {value:g} K"
    if key == "hydrogen_mass_da":
        return "natural hydrogen mass" if value is None else f"{word} {value:g} Da"
    if key == "constrain_hydrogens":
        return f"bonds to hydrogen {'rigid' if value else 'flexible'}"
    return f"{word} {value}"
