"""Records from files made into the dataclasses that they stand for: annotations are the schema."""

from __future__ import annotations

import json
import re
import types
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import (
    Annotated,
    Any,
    Literal,
    NotRequired,
    Self,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

import numpy as np

from systems.errors import InputError, SurromdError, nearest

T = TypeVar("T")
_LARGEST = 2**63
# What neither names a file nor can be written as text.
_NO_TEXT = re.compile("[\0\ud800-\udfff]")
_NAMES: dict[Any, str] = {str: "a text", int: "a whole number", float: "a finite number", bool: "true or false"}


def built(cls: type[T], record: Any, where: str = "") -> T:
    """Return the dataclass `cls` made of a record. Raises ValueError, in one line, for keys that are missing or unknown
    (with the nearest), for values of the wrong type or size, and what the class itself refuses.

    A list stands for a tuple, nested lists for an array, a whole number for a float, a table for a dataclass; numbers
    are finite and of 64 bits, text is without NUL. `Annotated[int, range(1, 10)]`: one of these numbers;
    `Annotated[array, (-1, 3)]`: of that shape, where it may also be empty; `Annotated[float, ...]`: also one that is
    not finite. A TypedDict is a table that may hold more.
    """
    if not isinstance(record, Mapping):
        raise ValueError(f"{where.rstrip('.') or cls.__name__} must be a table, not {_shown(record)}")
    known = {f.name: f for f in fields(cast(Any, cls))}
    for key in record:
        if key not in known:
            meant = nearest(str(key), list(known)).strip() or f"known: {', '.join(known)}"
            raise ValueError(f"unknown key {where}{key} ({meant})")
    for name, f in known.items():
        if name not in record and f.default is MISSING and f.default_factory is MISSING:
            raise ValueError(f"{where}{name} is missing")
    hints = _hints(cast(Any, cls))
    values = {key: fitted(value, hints[key], f"{where}{key}") for key, value in record.items()}
    try:
        return cls(**values)
    except SurromdError as error:
        raise ValueError(str(error).rstrip(".")) from error


class Recorded:
    """Base of dataclasses of arrays, texts and numbers that are kept as JSON."""

    def to_dict(self) -> dict[str, Any]:
        """Return lists, texts and numbers that `from_dict` and JSON take back exactly."""
        out: dict[str, Any] = {f.name: np.asarray(getattr(self, f.name)).tolist() for f in fields(cast(Any, self))}
        return out

    @classmethod
    def from_dict(cls, record: dict[str, Any]) -> Self:
        """Rebuild it. Raises InputError when an entry is missing, unknown or malformed."""
        try:
            return built(cls, record)
        except ValueError as error:
            raise InputError(f"{cls.__name__} record is malformed: {error}.") from error


def parsed(text: Any, read: Callable[[Any], Any] = json.loads) -> Any:
    """Return the value of JSON text, or what else `read` takes. Raises ValueError."""
    try:
        return read(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


@cache
def _hints(cls: type[Any]) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


def fitted(value: Any, hint: Any, where: str) -> Any:
    """Return a value as the annotation `hint` wants it. Raises ValueError where it does not fit; see `built`."""
    origin, args = get_origin(hint), get_args(hint)
    if hasattr(origin, "__value__"):  # an alias by `type`, as NumPy's NDArray is from 2.5 on
        return fitted(value, origin.__value__[args], where)
    if hint is Any:
        return value
    if is_typeddict(hint):
        return _table(value, hint, where)
    if origin is NotRequired:
        return fitted(value, args[0], where)
    if origin is Annotated and args[1] is ...:
        return value if isinstance(value, float) else fitted(value, args[0], where)
    if origin is Annotated:
        found, shape = fitted(value, args[0], where), args[1]
        if isinstance(shape, range):
            return found if found in shape else _refuse(value, hint, where)
        fits = found.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, found.shape, strict=True))
        if found.size and not fits:
            raise ValueError(f"{where} is an array of shape {found.shape}, not {shape}")
        return found if fits else found.reshape([max(n, 0) for n in shape])
    if origin in (Union, types.UnionType):
        kinds = [kind for kind in args if kind is not types.NoneType]
        if value is None and len(kinds) < len(args):
            return None
        for kind in kinds[:-1]:
            try:
                return fitted(value, kind, where)
            except ValueError:
                continue
        return fitted(value, kinds[-1], where)
    if origin is Literal and any(value == known and type(value) is type(known) for known in args):
        return value
    if origin is np.ndarray:
        return _array(value, get_args(args[1])[0], where)
    if origin in (tuple, list, Sequence) and isinstance(value, list | tuple):
        kinds = list(args) if origin is tuple and args[-1] is not Ellipsis else [args[0]] * len(value)
        if len(kinds) == len(value):
            entries = [fitted(v, kind, f"{where}[{k}]") for k, (v, kind) in enumerate(zip(value, kinds, strict=True))]
            return entries if origin is list else tuple(entries)
    if origin in (dict, Mapping) and isinstance(value, Mapping):
        return {fitted(k, args[0], where): fitted(v, args[1], f"{where}.{k}") for k, v in value.items()}
    if is_dataclass(hint):
        return value if isinstance(value, cast(type, hint)) else built(cast(type, hint), value, f"{where}.")
    if hint is float and ((isinstance(value, float) and abs(value) < float("inf")) or _is_whole(value)):
        return float(value)
    if hint is int and _is_whole(value):
        return value
    if hint is str and isinstance(value, str) and not _NO_TEXT.search(value):
        return value
    if hint not in (int, float, str) and isinstance(hint, type) and isinstance(value, hint):
        return value
    return _refuse(value, hint, where)


def _table(value: Any, hint: Any, where: str) -> dict[str, Any]:
    known = _hints(hint)
    needed = {key for key in hint.__required_keys__ if get_origin(known[key]) is not NotRequired}
    if not isinstance(value, dict) or not needed <= value.keys():
        raise ValueError(f"{where} must be a table of {', '.join(known)}, not {_shown(value)}")
    return {key: fitted(v, known.get(key, Any), f"{where}.{key}") for key, v in value.items()}


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < _LARGEST


def _array(value: Any, kind: type[Any], where: str) -> Any:
    """Return nested lists as an array of float64 (or of a kind of integers)."""
    kind = get_origin(kind) or kind
    whole = issubclass(kind, np.integer)
    with suppress(ValueError, TypeError, OverflowError):
        found = np.asarray(value)
        if found.ndim and (found.dtype.kind in ("iu" if whole else "iuf") or not found.size):
            found = np.array(found, dtype=np.float64 if kind is np.floating else kind)
            if np.isfinite(found).all():
                return found
    raise ValueError(f"{where} must be an array of {'whole' if whole else 'finite'} numbers")


def _refuse(value: Any, hint: Any, where: str) -> Any:
    args, meant, name = get_args(hint), "", _NAMES.get(hint, "")
    if get_origin(hint) is Annotated:
        name = f"a whole number from {args[1].start} to {args[1].stop - 1}"
    elif get_origin(hint) is Literal:
        name, meant = f"one of {', '.join(args)}", nearest(str(value), list(args))
    elif not name:
        name = str(hint) if args else getattr(hint, "__name__", str(hint))
    raise ValueError(f"{where} = {_shown(value)} must be {name}" + (f" ({meant.strip()})" if meant else ""))


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except ValueError:  # more digits than Python prints
        text = f"a number of {value.bit_length()} bits"
    return text if len(text) <= 60 else f"{text[:57]}..."
