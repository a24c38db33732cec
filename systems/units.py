"""Quantities as users write them (`50ns`, `2fs`, `300K`) to the units inside: ps, K, dalton, 1/ps."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from numbers import Real
from typing import Any, overload

from systems.errors import UnitError

GAS_CONSTANT_KJ_MOL_K = 8.31446261815324e-3
# Minus the logarithm of how often chance may be taken for a blow-up.
_UNLIKELINESS = 50.0
# What a verb takes for a quantity: a number in the unit that the name ends in, or a text with its own: `10ns`; also a
# quantity of `openmm.unit`, which is not named here, for this package imports no simulator.
Quantity = float | str

# Both signs for micro: U+00B5, which keyboards type, and U+03BC, which other programs print.
_TIME_PS = {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6, "\u00b5s": 1e6, "\u03bcs": 1e6, "ms": 1e9}
_WALL_S = {"s": 1.0, "min": 60.0, "h": 3600.0}
# These three mean the same in every MD program, so a bare number is accepted, too.
_TEMPERATURE_K = {"K": 1.0, "": 1.0}
_RATE_PER_PS = {"/ps": 1.0, "1/ps": 1.0, "ps^-1": 1.0, "/fs": 1e3, "1/fs": 1e3, "/ns": 1e-3, "1/ns": 1e-3, "": 1.0}
_LENGTH_NM = {"nm": 1.0, "A": 0.1, "Å": 0.1, "angstrom": 0.1, "pm": 1e-3}
_MOLAR = {"M": 1.0, "mM": 1e-3, "mol/l": 1.0, "mol/L": 1.0, "": 1.0}
_MASS_DA = {"Da": 1.0, "u": 1.0, "amu": 1.0, "": 1.0}
_PRESSURE_BAR = {"bar": 1.0, "atm": 1.01325, "": 1.0}
_NUMBER = re.compile(r"^\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(\S*)\s*$")


def _parse(text: str, table: dict[str, float], what: str, example: str, *, zero: bool = False) -> float:
    match = _NUMBER.match(text)
    known = ", ".join(unit for unit in table if unit and unit != "\u03bcs")
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
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        least = "not negative" if zero else "positive"
        raise UnitError(f"{what} {text!r} must be {least} and finite; write it like {example}.")
    return value


def parse_time_ps(text: str, what: str = "time") -> float:
    """Return a simulated duration in ps. Raises UnitError for a missing, unknown or non-positive quantity."""
    return _parse(text, _TIME_PS, what, "10ns")


def parse_time_or_none_ps(text: str, what: str = "time") -> float:
    """Return a simulated duration in ps, which may be none: `0ps`. Raises UnitError."""
    return _parse(text, _TIME_PS, what, "100ps", zero=True)


def parse_wall_s(text: str, what: str = "budget") -> float:
    """Return a wall-clock duration in seconds (`30min`, `2h`). Raises UnitError."""
    return _parse(text, _WALL_S, what, "30min")


def parse_temperature_k(text: str, what: str = "temperature") -> float:
    """Return a temperature in K (`300K` or `300`). Raises UnitError."""
    return _parse(text, _TEMPERATURE_K, what, "300K")


def parse_rate_per_ps(text: str, what: str = "friction") -> float:
    """Return a rate in 1/ps (`1/ps`, `91/ps`, `0.1/fs` or a bare number). Raises UnitError."""
    # "1/ps" is the number 1 with the unit "/ps", while "1 1/ps" spells the unit out; both are in the table.
    return _parse(text, _RATE_PER_PS, what, "1/ps")


def parse_mass_da(text: str, what: str = "hydrogen mass") -> float:
    """Return a mass in dalton (`3Da` or `3`). Raises UnitError."""
    return _parse(text, _MASS_DA, what, "3Da")


def parse_length_nm(text: str, what: str = "length") -> float:
    """Return a length in nm (`1nm`, `10A`). Raises UnitError for a missing, unknown or non-positive quantity."""
    return _parse(text, _LENGTH_NM, what, "1nm")


def parse_molar(text: str, what: str = "concentration") -> float:
    """Return a concentration in mol/l (`0.15M`, `150mM`, `0.15` or `0`). Raises UnitError."""
    return _parse(text, _MOLAR, what, "0.15M", zero=True)


def parse_pressure_bar(text: str, what: str = "pressure") -> float:
    """Return a pressure in bar (`1bar`, `1atm` or `1`). Raises UnitError."""
    return _parse(text, _PRESSURE_BAR, what, "1bar")


def format_wall(seconds: float) -> str:
    """Return a wall time for people: 12 s, 5 min, 3.2 h, 2.1 days."""
    for unit, size, limit in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < limit:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 86_400.0:.3g} days"


# By what a name ends in; the longest ending first: a friction ends in _ps, too.
PARSERS: dict[str, Callable[[str, str], float]] = {
    "_per_ps": parse_rate_per_ps,
    "_ps": parse_time_ps,
    "_k": parse_temperature_k,
    "_da": parse_mass_da,
    "_nm": parse_length_nm,
    "_molar": parse_molar,
    "_bar": parse_pressure_bar,
    "_s": parse_wall_s,
}

_UNITS = {"_per_ps": "1/ps", "_ps": "ps", "_k": "K", "_da": "Da", "_nm": "nm", "_molar": "M", "_bar": "bar", "_s": "s"}


def parser_of(name: str) -> Callable[[str, str], float]:
    """Return what reads the text of a setting by its name (`time_ps`): text and what to call it -> its value inside."""
    if name == "equilibrate_ps":
        return parse_time_or_none_ps
    return next(parse for ending, parse in PARSERS.items() if name.endswith(ending))


def _ending(name: str) -> str:
    return next((ending for ending in PARSERS if name.endswith(ending)), "")


def unit_of(name: str) -> str:
    """Return the unit that a setting's name ends in (`ps` of `time_ps`), or an empty string."""
    return _UNITS.get(_ending(name), "")


def stem_of(name: str) -> str:
    """Return a setting's name without its unit: `time` of `time_ps`."""
    return name.removesuffix(_ending(name))


# The units of the endings as `openmm.unit` calls them, with their powers.
_OPENMM = {
    "_per_ps": ("picosecond", -1),
    "_ps": ("picosecond", 1),
    "_k": ("kelvin", 1),
    "_da": ("dalton", 1),
    "_nm": ("nanometer", 1),
    "_molar": ("molar", 1),
    "_bar": ("bar", 1),
    "_s": ("second", 1),
}


def is_openmm_quantity(value: Any) -> bool:
    """Whether this is a quantity of `openmm.unit`, told without importing OpenMM."""
    return hasattr(value, "value_in_unit") and hasattr(value, "unit")


def openmm_number(name: str, value: Any, what: str = "") -> Any:
    """Return what a quantity of `openmm.unit` is in the unit that the name ends in.

    Raises UnitError for another dimension, and for a setting whose name ends in no unit.
    """
    what, ending = what or name, _ending(name)
    if not ending:
        raise UnitError(f"{what} = {value} has a unit, and takes none.")
    # Whoever holds a quantity has imported its module.
    units = sys.modules[type(value).__module__.rpartition(".")[0]]
    unit, power = _OPENMM[ending]
    try:
        return value.value_in_unit(getattr(units, unit) ** power)
    except TypeError:
        raise UnitError(
            f"{what} = {value} cannot be turned into {_UNITS[ending]}; give a quantity of that dimension."
        ) from None


@overload
def quantity(name: str, value: Quantity, what: str = ...) -> float: ...
@overload
def quantity(name: str, value: None, what: str = ...) -> None: ...
def quantity(name: str, value: Any, what: str = "") -> float | None:
    """Return what a setting called `name` (`time_ps`) is in the unit that its name ends in.

    `value` is a number in that unit, a text with its own, such as '10ns', or a quantity of `openmm.unit`; None stays
    None. `what`: how messages call it, by default as it is called. Raises UnitError for another kind of value, and for
    a number that is negative or not finite.
    """
    if value is None:
        return None
    what = what or name
    if isinstance(value, str):
        return parser_of(name)(value, what)
    if is_openmm_quantity(value):
        value = openmm_number(name, value, what)
    if isinstance(value, bool) or not isinstance(value, Real):
        raise UnitError(f"{what} = {value!r} must be a number in {unit_of(name)}, or a text with its unit.")
    number = float(value)
    if not math.isfinite(number) or number < 0:
        raise UnitError(f"{what} = {value!r} must be finite and not negative.")
    return number


def format_quantity(name: str, value: float) -> str:
    """Return the text that `quantity` reads as this value: `10ns` for time_ps = 10000."""
    ending = _ending(name)
    if ending == "_ps" and value > 0:
        return format_time_ps(value).replace(" ", "")
    if ending == "_per_ps":
        return f"{value:g}/ps"
    return f"{value:g}{unit_of(name)}"


def format_time_ps(time_ps: float, digits: int = 6) -> str:
    """Return a duration, rounded to so many digits, with the largest unit that keeps it at or above one: 1500.0 ->
    '1.5 ns'."""
    time_ps = float(f"{time_ps:.{digits}g}")
    for unit in ("us", "ns", "ps", "fs"):
        if time_ps >= _TIME_PS[unit] or unit == "fs":
            return f"{time_ps / _TIME_PS[unit]:.6g} {unit}"
    raise AssertionError("unreachable")


def whole_steps(duration_ps: float, step_ps: float, what: str) -> int:
    """Return duration / step as a whole number, refusing (UnitError) what does not divide evenly."""
    ratio = duration_ps / step_ps
    n = round(ratio)
    # In steps, not relative to the duration: over a microsecond a relative bound would forgive whole steps.
    if n < 1 or abs(ratio - n) > 1e-3:
        raise UnitError(f"{what}: {format_time_ps(duration_ps)} is not a whole multiple of {format_time_ps(step_ps)}.")
    return n


def hottest_k(bath_k: float, n_dof: int) -> float:
    """Return the kinetic temperature that chance exceeds in one frame of 10^21: 1 + 2 sqrt(x/n) + 2 x/n times the
    bath's, n degrees of freedom, x = 50 (Laurent and Massart, Ann. Statist. 28, 1302 (2000), lemma 1)."""
    x = _UNLIKELINESS / n_dof
    return bath_k * (1.0 + 2.0 * math.sqrt(x) + 2.0 * x)
