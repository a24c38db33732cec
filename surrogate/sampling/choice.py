"""Choice of the shipped weights that roll a scene, where the user names none."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from surrogate.data.shipped import shipped_weights
from surrogate.data.weights import load_weights, read_header
from surrogate.models.peptides.model import PeptideConfig
from surrogate.models.registry import architecture
from surrogate.sampling.domain import match_known
from systems.errors import OutOfDomainError

if TYPE_CHECKING:
    from surrogate.data.weights import Weights
    from systems.scene import Scene


def choose_weights(scene: Scene, *, temperature_k: float | None = None) -> tuple[Weights, str]:
    """Return the shipped weights that cover a scene, and why these.

    Weights that were trained on the molecule come before those that know molecules like it; those that draw frames
    from the ensemble before those that carry velocities, whose temperature is only refreshed between chunks; those that
    step as far as frames are saved before those for one lag. Headers tell all of this: only those chosen are loaded.
    Raises OutOfDomainError, which says what the nearest lack, when none covers the scene.
    """
    found, refusals = [], []
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
        carries_velocities = getattr(arch.model, "carries_velocities", False)
        found.append((not match.seen, carries_velocities, not header.domain.jumps, name, path))
    if not found:
        nearest = min(refusals, key=lambda one: one[:3])[3] if refusals else OutOfDomainError("none are shipped.")
        raise OutOfDomainError(
            f"no shipped weights cover {scene.name}, and none are named. The nearest: {nearest}", brief=nearest.brief
        )
    unseen, *_, name, path = min(found)
    others = sorted(other for *_, other, _ in found if other != name)
    why = "they cover it without having seen it" if unseen else "they were trained on this molecule"
    beside = f"; {', '.join(others)} would do, too" if others else ""
    return load_weights(path), f"weights not named, taken are the shipped {name}: {why}{beside}"


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
