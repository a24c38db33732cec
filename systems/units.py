"""Quantities as users write them (`50ns`, `2fs`, `300K`) to the units inside: ps, K, dalton, 1/ps."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable
from numbers import Real
from typing import Any, NamedTuple, overload

from systems.errors import UnitError

GAS_CONSTANT_KJ_MOL_K = 8.31446261815324e-3
# Minus the logarithm of how often chance may be taken for a blow-up.
_UNLIKELINESS = 50.0
# What a verb takes for a quantity: a number in the unit that the name ends in, or a text with its own: `10ns`; also a
# quantity of `openmm.unit`, which is not named here, for this package imports no simulator.
Quantity = float | str

# Both signs for micro: U+00B5, which keyboards type, and U+03BC, which other programs print.
_TIME_PS = {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6, "\u00b5s": 1e6, "\u03bcs": 1e6, "ms": 1e9}
_NUMBER = re.compile(r"^\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*(\S*)\s*$")


class _Dimension(NamedTuple):
    """The units that a text may have, with what each is in ours; where a bare number means ours, "" is among them.
    `shown`: our unit; `what`, `example`: how messages call such a quantity, and write one; `may_be_zero`: as it
    says."""

    units: dict[str, float]
    shown: str
    what: str
    example: str
    may_be_zero: bool = False


# By what a name ends in; the longest ending first: a friction ends in _ps, too.
DIMENSIONS = {
    # "1/ps" is the number 1 with the unit "/ps", while "1 1/ps" spells the unit out.
    "_per_ps": _Dimension(
        {"/ps": 1.0, "1/ps": 1.0, "ps^-1": 1.0, "/fs": 1e3, "1/fs": 1e3, "/ns": 1e-3, "1/ns": 1e-3, "": 1.0},
        "1/ps", "friction", "1/ps",
    ),
    "_ps": _Dimension(_TIME_PS, "ps", "time", "10ns"),
    "_k": _Dimension({"K": 1.0, "": 1.0}, "K", "temperature", "300K"),
    "_da": _Dimension({"Da": 1.0, "u": 1.0, "amu": 1.0, "": 1.0}, "Da", "hydrogen mass", "3Da"),
    "_nm": _Dimension({"nm": 1.0, "A": 0.1, "Å": 0.1, "angstrom": 0.1, "pm": 1e-3}, "nm", "length", "1nm"),
    "_molar": _Dimension(
        {"M": 1.0, "mM": 1e-3, "mol/l": 1.0, "mol/L": 1.0, "": 1.0}, "M", "concentration", "0.15M", True
    ),
    "_bar": _Dimension({"bar": 1.0, "atm": 1.01325, "": 1.0}, "bar", "pressure", "1bar"),
    "_s": _Dimension({"s": 1.0, "min": 60.0, "h": 3600.0, "hr": 3600.0}, "s", "budget", "30min"),
}  # fmt: skip


def _parse(text: str, what: str = "", *, ending: str, zero: bool = False) -> float:
    """Return the value of a text in our unit. Raises UnitError for a missing, unknown or non-positive quantity."""
    dimension = DIMENSIONS[ending]
    what, like = f"{what or dimension.what} {text!r}", f"write it like {dimension.example}"
    known = ", ".join(unit for unit in dimension.units if unit and unit != "\u03bcs")
    match = _NUMBER.match(text)
    if match is None:
        raise UnitError(f"{what} is not a number with a unit; {like} (units: {known}).")
    number, unit = match.groups()
    if unit not in dimension.units:
        problem = f"unknown unit {unit!r}" if unit else "no unit"
        raise UnitError(f"{what} has {problem}; {like} (units: {known}).")
    try:
        value = float(number) * dimension.units[unit]
    except ValueError:
        raise UnitError(f"{what} is not a number with a unit; {like}.") from None
    zero = zero or dimension.may_be_zero
    if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
        raise UnitError(f"{what} must be {'not negative' if zero else 'positive'} and finite; {like}.")
    return value


def format_wall(seconds: float) -> str:
    """Return a wall time for people: 12 s, 5 min, 3.2 h, 2.1 days."""
    for unit, size, limit in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < limit:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 86_400.0:.3g} days"


def _ending(name: str) -> str:
    return next((ending for ending in DIMENSIONS if name.endswith(ending)), "")


def parser_of(name: str) -> Callable[..., float]:
    """Return what reads the text of a setting by its name (`time_ps`): text and what to call it -> its value inside."""
    return functools.partial(_parse, ending=_ending(name), zero=name == "equilibrate_ps")


# A simulated duration in ps (`10ns`), a wall-clock one in seconds (`30min`, `2h`).
parse_time_ps, parse_wall_s = parser_of("time_ps"), parser_of("wall_s")


def unit_of(name: str) -> str:
    """Return the unit that a setting's name ends in (`ps` of `time_ps`), or an empty string."""
    ending = _ending(name)
    return DIMENSIONS[ending].shown if ending else ""


def stem_of(name: str) -> str:
    """Return a setting's name without its unit: `time` of `time_ps`."""
    return name.removesuffix(_ending(name))


@overload
def quantity(name: str, value: Quantity, what: str = ...) -> float: ...
@overload
def quantity(name: str, value: None, what: str = ...) -> None: ...
def quantity(name: str, value: Any, what: str = "") -> float | None:
    """Return what a setting called `name` (`time_ps`) is in the unit that its name ends in.

    `value` is a number in that unit, a text with its own, such as '10ns', or a quantity of `openmm.unit`, whose
    symbols are those of texts; None stays None. `what`: how messages call
    it, by default as it is called. Raises UnitError for another kind of value, and for a number that is negative or not
    finite.
    """
    if value is None:
        return None
    what = what or name
    if hasattr(value, "value_in_unit"):
        value = f"{float(value / value.unit)!r}{value.unit.get_symbol()}"
    if isinstance(value, str):
        return parser_of(name)(value, what)
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
    if ending == "_s":
        size, unit = next(((n, u) for n, u in ((3600, "h"), (60, "min")) if value and value % n == 0), (1, "s"))
        return f"{value / size:g}{unit}"
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
