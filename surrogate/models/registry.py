"""The installed architectures: entry points of the group `surromd.architectures`, loaded when they are used."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from surrogate.models.architecture import Architecture
from systems.errors import InputError, UnknownNameError, first_line, nearest

GROUP = "surromd.architectures"


def names() -> list[str]:
    """Return the names of all installed architectures; none is imported."""
    return sorted(_found())


@cache
def architecture(name: str) -> Architecture:
    """Return the architecture of this name.

    Raises UnknownNameError, naming the nearest, and InputError where its package cannot be imported or offers
    something else under that name.
    """
    found = _found().get(name)
    if found is None:
        raise UnknownNameError(f"unknown architecture {name!r}; known: {', '.join(names())}.{nearest(name, names())}")
    try:
        loaded = found.load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"architecture {name!r} ({found.value}) cannot be loaded: {first_line(error)}.") from error
    if not isinstance(loaded, Architecture) or loaded.name != name:
        raise InputError(f"architecture {name!r}: {found.value} is no Architecture of this name; correct its package.")
    return loaded


@cache
def _found() -> dict[str, EntryPoint]:
    """Return the entry points by name. Raises InputError where two packages offer different ones under one name."""
    found = {point.name: point for point in _own()}
    for point in entry_points(group=GROUP):
        known = found.setdefault(point.name, point)
        if known.value != point.value:
            raise InputError(
                f"two installed packages offer the architecture {point.name!r} ({known.value} and {point.value}); "
                "uninstall one."
            )
    return found


def _own() -> list[EntryPoint]:
    """Return surromd's own entry points of a source tree, which may be used without being installed."""
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if not project.is_file():
        return []
    record = tomllib.loads(project.read_text("utf-8")).get("project", {})
    if record.get("name") != "surromd":
        return []
    declared = record.get("entry-points", {}).get(GROUP, {})
    return [EntryPoint(name, value, GROUP) for name, value in declared.items()]
