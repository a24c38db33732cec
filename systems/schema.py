"""Records from files held against the dataclass that they are to become: its annotations are the schema."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

_LARGEST = 2**63


def check_types(cls: type[Any], record: Any, where: str = "") -> None:
    """Raise ValueError for an entry whose value has not the type that the field of that name has in `cls`.

    A list stands for a tuple, a whole number for a float, a table for a dataclass; numbers are finite and of 64 bits.
    Keys that are missing or unknown are for the constructor to refuse.
    """
    if not isinstance(record, Mapping):
        raise ValueError(f"{where or cls.__name__} is no table but {_shown(record)}")
    hints = get_type_hints(cls)
    for key, value in record.items():
        if key in hints and not _fits(value, hints[key]):
            name = getattr(hints[key], "__name__", str(hints[key])) if not get_args(hints[key]) else str(hints[key])
            raise ValueError(f"{where}{key} is {_shown(value)}, which is no {name}")


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _fits(value: Any, hint: Any) -> bool:
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in (Union, types.UnionType):
        return any(_fits(value, kind) for kind in args)
    if origin is Literal:
        return value in args
    if origin is tuple and (len(args) != 2 or args[1] is not Ellipsis):
        listed = isinstance(value, list | tuple) and len(value) == len(args)
        return listed and all(_fits(entry, kind) for entry, kind in zip(value, args, strict=True))
    if origin in (tuple, list, Sequence):
        return isinstance(value, list | tuple) and all(_fits(entry, args[0]) for entry in value)
    if origin in (dict, Mapping):
        return isinstance(value, dict) and all(_fits(k, args[0]) and _fits(v, args[1]) for k, v in value.items())
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < _LARGEST
    if hint is float:
        return _fits(value, int) or (isinstance(value, float) and abs(value) < float("inf"))
    if is_dataclass(hint):
        return isinstance(value, dict | hint)
    return not isinstance(hint, type) or isinstance(value, hint)
