"""Settings of a reference run as a file writes them: `timestep = "4fs"` for MDConfig.timestep_ps, checked and typed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from typing import Any, get_args, get_type_hints

from md_reference.forces.spec import ForceFieldSpec
from md_reference.run.config import MDConfig, settings_of
from systems.errors import InputError, nearest
from systems.files.schema import fitted
from systems.options import Option
from systems.units import parser_of

# Settings whose names end so are written without it, as texts with a unit.
_ENDINGS = ("_per_ps", "_ps", "_k", "_da")
# These belong to a run's place in the campaign.
_NOT_SETTINGS = ("seed", "force")
# As on the command line: what the user leaves open is settled for the scene.
_OPEN = {"force_field": "auto", "solvent": "auto"}


@dataclass(frozen=True)
class Settings:
    """What one table says: fields of MDConfig and ForceFieldSpec by name, switches of `prepare`, and the axes."""

    values: dict[str, Any]
    preparation: dict[str, Any]
    axes: dict[str, Any]


def _known_fields() -> dict[str, Field[Any]]:
    return {f.name: f for kind in (MDConfig, ForceFieldSpec) for f in fields(kind) if f.name not in _NOT_SETTINGS}


def key_of(name: str) -> str:
    """Return the key in a file of a field: `timestep` of `timestep_ps`."""
    return next((name.removesuffix(ending) for ending in _ENDINGS if name.endswith(ending)), name)


def read_settings(
    table: dict[str, Any],
    *,
    axes: Mapping[str, Any],
    preparation: Mapping[str, Option],
    others: Iterable[str],
    where: str,
) -> Settings:
    """Return a table's settings, in our units. `axes`: the annotations of what else it may say of runs; `preparation`:
    the options of how a scene is made.

    Raises InputError for a key that is neither (with the nearest that is; `others` are keys the caller has read),
    ValueError for values of the wrong kind.
    """
    hints = get_type_hints(MDConfig) | get_type_hints(ForceFieldSpec)
    by_key = {key_of(name): name for name in _known_fields()}
    found = Settings({}, {}, {})
    for key, value in table.items():
        if key in axes:
            found.axes[key] = fitted(value, axes[key], f"{where}{key}")
        elif key in preparation:
            found.preparation[key] = preparation[key].value(value, f"{where}{key}")
        elif key in by_key:
            name = by_key[key]
            found.values[name] = _value(name, hints[name], value, f"{where}{key}")
        else:
            meant = nearest(key, [*by_key, *preparation, *axes, *others])
            raise InputError(f"{where}unknown key {key!r}.{meant}")
    return found


def _value(name: str, hint: Any, value: Any, where: str) -> Any:
    if type(None) in get_args(hint) and value in ("natural", "none"):
        return None
    if name.endswith(_ENDINGS):
        return parser_of(name)(str(fitted(value, float | str, where)), where)
    return fitted(value, hint, where)


def to_config(values: dict[str, Any], *, seed: int) -> MDConfig:
    """Return a run's settings. Raises InputError where its length is not given, and what the fields refuse."""
    force = {f.name for f in fields(ForceFieldSpec)}
    missing = [f.name for f in fields(MDConfig) if f.default is MISSING and f.default_factory is MISSING]
    for name in missing:
        if name not in values:
            raise InputError(f"{key_of(name)} is missing; write, for example, {key_of(name)} = '10ns'.")
    return MDConfig(
        **{key: value for key, value in values.items() if key not in force},
        seed=seed,
        force=ForceFieldSpec(**{**_OPEN, **{key: value for key, value in values.items() if key in force}}),
    )


def flat_settings(config: MDConfig) -> dict[str, Any]:
    """Return a run's settings as one level of names and plain values, without its seed."""
    return {key: value for key, value in settings_of(config).items() if key != "seed"}


def default_of(name: str) -> Any:
    """Return the default of a setting, or None where it has none."""
    known = _known_fields().get(name)
    return None if known is None or known.default is MISSING else known.default
