"""Models' settings: frozen dataclasses built from records and TOML files; unknown keys are refused."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from systems.errors import InputError
from systems.schema import built

T = TypeVar("T")


def build(cls: type[T], record: dict[str, Any], prefix: str = "") -> T:
    """Return the settings `cls` of a record. Raises InputError as `systems.schema.built` does."""
    try:
        return built(cls, record, prefix)
    except ValueError as error:
        raise InputError(f"settings: {error}.") from error


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return a TOML file's record. Raises InputError when it is missing or malformed."""
    try:
        with open(path, "rb") as handle:
            return tomllib.load(handle)
    except FileNotFoundError:
        raise InputError(f"configuration {path} does not exist.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"configuration {path} is not valid TOML: {error}") from error
