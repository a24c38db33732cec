"""Choice of the shipped weights that roll a scene, where the user names none."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from surrogate.data.shipped import shipped_weights
from surrogate.data.weights import load_weights, read_header
from surrogate.models.peptides.model import PeptideConfig
from surrogate.models.registry import architecture
from surrogate.sampling.domain import match_known
from systems.errors import OutOfDomainError

if TYPE_CHECKING:
    from surrogate.data.weights import Weights
    from systems.scene import Scene


def choose_weights(
    scene: Scene, *, temperature_k: float | None = None, conditions: Mapping[str, Any] | None = None
) -> tuple[Weights, str]:
    """Return the shipped weights that cover a scene, and why these.

    Weights that were trained on the molecule come before those that know molecules like it; those that draw frames
    from the ensemble before those that carry velocities, whose temperature is only refreshed between chunks; those that
    step as far as frames are saved before those for one lag. Headers tell all of this: only those chosen are loaded.
    `conditions`: force field and solvent that they must have been trained under; all do where nothing is said.
    Raises OutOfDomainError, which says what the nearest lack, when none covers the scene.
    """
    found, refusals, levels = [], [], {}
    for name, path in shipped_weights().items():
        header = read_header(path)
        arch = architecture(header.arch)
        config = arch.config(header.config)
        peptides = config if isinstance(config, PeptideConfig) else None
        try:
            match = match_known(scene, header.domain, path.name, peptides, temperature_k=temperature_k)
        except OutOfDomainError as error:
            refusals.append((not error.forcible, len(error.args[0].split("; ")), name, error))
            continue
        try:
            check_conditions(header.domain.conditions, conditions or {}, path.name)
        except OutOfDomainError as error:
            refusals.append((False, 0, name, error))  # nothing else is apart
            continue
        carries_velocities = getattr(arch.model, "carries_velocities", False)
        levels[name] = header.domain.conditions.get("force_field")
        found.append((not match.seen, carries_velocities, not header.domain.jumps, name, path))
    if not found:
        nearest = min(refusals, key=lambda one: one[:3])[3] if refusals else OutOfDomainError("none are shipped.")
        raise OutOfDomainError(
            f"no shipped weights cover {scene.name}, and none are named. The nearest: {nearest}", brief=nearest.brief
        )
    unseen, *_, name, path = min(found)
    others = sorted(other for other, level in levels.items() if other != name and level == levels[name])
    why = "they cover it without having seen it" if unseen else "they were trained on this molecule"
    beside = f"; {', '.join(others)} would do, too" if others else ""
    return load_weights(path), f"weights not named, taken are the shipped {name}: {why}{beside}"


def check_conditions(known: Mapping[str, Any], asked: Mapping[str, Any], name: str) -> None:
    """Raise OutOfDomainError where weights of that name say that they were trained under other conditions."""
    apart = [f"{key} {known[key]}, not {value}" for key, value in asked.items() if known.get(key) not in (None, value)]
    if apart:
        raise OutOfDomainError(f"{name} was trained under other conditions: {', '.join(apart)}")


def weights_to_go_on_from(scene: Scene) -> str | None:
    """Return the name of shipped weights of peptides that know all residues of a scene, so that a training on MD of it
    may begin with them, whatever keeps them from covering it; None where none do."""
    for name, path in shipped_weights().items():
        header = read_header(path)
        config = architecture(header.arch).config(header.config)
        if isinstance(config, PeptideConfig):
            with suppress(OutOfDomainError):
                match_known(scene, header.domain, path.name, config, force=True)
                return name
    return None
