"""Models' settings: frozen dataclasses built from records and TOML files; unknown keys are refused."""

from __future__ import annotations

import json
from typing import Any, TypeVar

from systems.errors import InputError
from systems.files.schema import built

T = TypeVar("T")


def build(cls: type[T], record: dict[str, Any], prefix: str = "") -> T:
    """Return the settings `cls` of a record. Raises InputError as `systems.files.schema.built` does."""
    try:
        return built(cls, record, prefix)
    except ValueError as error:
        raise InputError(f"settings: {error}.") from error


def toml_text(record: dict[str, Any], table: str = "") -> str:
    """Return a record as the TOML of `systems.options.read_toml`; keys whose value is None are left out.

    Values are texts, numbers, booleans, and lists and tables of these; tables in lists are written in one line.
    """
    kept = {key: value for key, value in record.items() if value is not None}
    lines = [f"{key} = {_inline(value)}" for key, value in kept.items() if not isinstance(value, dict)]
    text = "".join(f"{line}\n" for line in lines)
    if table and (lines or not kept):
        text = f"[{table}]\n{text}"
    for key, value in kept.items():
        if isinstance(value, dict):
            text += ("\n" if text else "") + toml_text(value, f"{table}.{key}" if table else key)
    return text


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        pairs = [f"{key} = {_inline(each)}" for key, each in value.items() if each is not None]
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(each) for each in value) + "]"
    # JSON's texts, booleans and finite numbers are TOML's.
    return json.dumps(value)
