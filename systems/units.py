"""Quantities as users write them (`50ns`, `2fs`, `300K`) to the units inside: ps, K, dalton, 1/ps."""

from __future__ import annotations

import math
import re

from systems.errors import UnitError

_TIME_PS = {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6, "µs": 1e6, "ms": 1e9}
_WALL_S = {"s": 1.0, "min": 60.0, "h": 3600.0}
_NUMBER = re.compile(r"^\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(\S*)\s*$")


def _parse(text: str, table: dict[str, float], what: str, example: str) -> float:
    match = _NUMBER.match(text)
    known = ", ".join(table)
    if match is None:
        raise UnitError(f"{what} {text!r} is not a number with a unit; write it like {example} (units: {known}).")
    number, unit = match.groups()
    if unit not in table:
        problem = f"unknown unit {unit!r}" if unit else "no unit"
        raise UnitError(f"{what} {text!r} has {problem}; write it like {example} (units: {known}).")
    try:
        value = float(number) * table[unit]
    except ValueError:
        raise UnitError(f"{what} {text!r} is not a number with a unit; write it like {example}.") from None
    if not math.isfinite(value) or value <= 0:
        raise UnitError(f"{what} {text!r} must be positive and finite; write it like {example}.")
    return value


def parse_time_ps(text: str, what: str = "time") -> float:
    """Return a simulated duration in ps. Raises UnitError for a missing, unknown or non-positive quantity."""
    return _parse(text, _TIME_PS, what, "10ns")


def parse_wall_s(text: str, what: str = "budget") -> float:
    """Return a wall-clock duration in seconds (`30min`, `2h`). Raises UnitError."""
    return _parse(text, _WALL_S, what, "30min")


def format_time_ps(time_ps: float) -> str:
    """Return a duration with the largest unit that keeps it at or above one: 1500.0 -> '1.5 ns'."""
    for unit in ("us", "ns", "ps", "fs"):
        if time_ps >= _TIME_PS[unit] or unit == "fs":
            return f"{time_ps / _TIME_PS[unit]:.6g} {unit}"
    raise AssertionError("unreachable")


def whole_steps(duration_ps: float, step_ps: float, what: str) -> int:
    """Return duration / step as a whole number, refusing (UnitError) what does not divide evenly."""
    n = round(duration_ps / step_ps)
    if n < 1 or abs(n * step_ps - duration_ps) > 1e-6 * max(duration_ps, step_ps):
        raise UnitError(
            f"{what}: {format_time_ps(duration_ps)} is not a whole multiple of {format_time_ps(step_ps)}."
        )
    return n
