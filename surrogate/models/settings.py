"""Models' settings: frozen dataclasses built from records and TOML files; unknown keys are refused."""

from __future__ import annotations

import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from systems.errors import InputError, nearest
from systems.schema import check_types

T = TypeVar("T")


def build(cls: type[T], record: dict[str, Any], prefix: str) -> T:
    """Return cls(**record), refusing (InputError) unknown keys with the nearest known one."""
    known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
    for key in record:
        if key not in known:
            raise InputError(f"unknown setting {prefix}{key}; known: {', '.join(known)}.{nearest(key, known)}")
    try:
        check_types(cls, record, prefix)
    except ValueError as error:
        raise InputError(f"setting {error}.") from error
    return cls(**record)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return a TOML file's record. Raises InputError when it is missing or malformed."""
    try:
        with open(path, "rb") as handle:
            return tomllib.load(handle)
    except FileNotFoundError:
        raise InputError(f"configuration {path} does not exist.") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"configuration {path} is not valid TOML: {error}") from error
