"""Units by the names that trajectory files give them."""

from __future__ import annotations

from typing import Any

_NM = {"nanometer": 1.0, "nm": 1.0, "angstrom": 0.1, "a": 0.1, "å": 0.1, "bohr": 0.0529177210903, "pm": 1e-3}
_PS = {"picosecond": 1.0, "ps": 1.0, "femtosecond": 1e-3, "fs": 1e-3, "nanosecond": 1e3, "ns": 1e3, "microsecond": 1e6,
       "us": 1e6, "second": 1e12, "s": 1e12}  # fmt: skip


def nm_per(unit: Any) -> float | None:
    """Return the unit of length in nm, None of one that is not known."""
    return _NM.get(_name(unit))


def ps_per(unit: Any) -> float | None:
    """Return the unit of time in ps, None of one that is not known."""
    return _PS.get(_name(unit))


def _name(unit: Any) -> str:
    name = (unit.decode(errors="replace") if isinstance(unit, bytes) else str(unit)).strip().lower()
    return name[:-1] if len(name) > 2 and name.endswith("s") else name
