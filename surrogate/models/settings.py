"""Models' settings: frozen dataclasses built from records and TOML files; unknown keys are refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from systems.errors import InputError
from systems.files.outside import content
from systems.files.schema import built, parsed

T = TypeVar("T")


def build(cls: type[T], record: dict[str, Any], prefix: str = "") -> T:
    """Return the settings `cls` of a record. Raises InputError as `systems.files.schema.built` does."""
    try:
        return built(cls, record, prefix)
    except ValueError as error:
        raise InputError(f"settings: {error}.") from error


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return a TOML file's record. Raises InputError when it is missing or malformed."""
    try:
        return dict(parsed(content(Path(path)).decode(), tomllib.loads))
    except FileNotFoundError:
        raise InputError(f"configuration {path} does not exist.") from None
    except (OSError, ValueError) as error:
        raise InputError(f"configuration {path} is not valid TOML: {error}.") from error
