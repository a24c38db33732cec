"""Charts as plain numbers, which the report draws each by its type: nothing here knows colours or pixels, and all of it
goes into the JSON as it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any, Literal

import numpy as np

from surrogate.comparison.measure.statistics import Estimate, FloatArray

Section = Literal["structure", "distributions", "kinetics", "equivalent_time"]
Role = Literal["reference", "candidate", "replicate", "other"]
ROLES: tuple[Role, Role, Role] = ("reference", "candidate", "replicate")


class Curve:
    """Base of the records below."""

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values, and under "type" which chart it is."""
        return {name: jsonable(value) for name, value in vars(self).items()} | {"type": type(self).__name__}


def jsonable(value: Any) -> Any:
    """Return JSON-able values of dataclasses, arrays (six digits) and numbers; what is not finite becomes None."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if is_dataclass(value):
        return {name: jsonable(x) for name, x in vars(value).items()}
    if isinstance(value, dict):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(x) for x in value]
    if isinstance(value, np.ndarray):
        return jsonable([float(f"{x:.6g}") for x in value] if value.ndim == 1 else list(value))
    if isinstance(value, np.generic):
        value = value.item()
    return value if not isinstance(value, float) or math.isfinite(value) else None


@dataclass(frozen=True, eq=False)
class Histogram(Curve):
    """Densities of one quantity over `edges` `(n + 1,)`; `outside` is the share beyond the range or not finite."""

    label: str
    unit: str
    edges: FloatArray
    reference: FloatArray
    candidate: FloatArray
    replicate: FloatArray
    outside: tuple[float, float, float]
    section: Section = "distributions"


@dataclass(frozen=True, eq=False)
class Line(Curve):
    """One line of a chart: `x` and `y` `(n,)`, NaN in gaps, with a 95 % band where `low` and `high` are given. `role`
    gives the colour."""

    name: str
    role: Role
    x: FloatArray
    y: FloatArray
    low: FloatArray | None = None
    high: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class LineChart(Curve):
    """Lines over one pair of axes; labels carry their units ("lag / ps"), `caption` says what is seen."""

    section: Section
    title: str
    caption: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    log_x: bool = False
    log_y: bool = False


@dataclass(frozen=True, eq=False)
class Landscape(Curve):
    """Counts `(n_x, n_y)` over two coordinates, drawn as free energies: φ and ψ of a residue. `x_edges` `(n_x + 1,)`,
    `y_edges` `(n_y + 1,)`."""

    section: Section
    title: str
    x_label: str
    y_label: str
    x_edges: FloatArray
    y_edges: FloatArray
    reference: FloatArray
    candidate: FloatArray
    replicate: FloatArray


@dataclass(frozen=True, eq=False)
class BarChart(Curve):
    """A number for each of `names`; `lines`: of reference, candidate and replicate, `x` counting the names."""

    section: Section
    title: str
    caption: str
    y_label: str
    names: tuple[str, ...]
    lines: tuple[Line, ...]


def bar_chart(
    section: Section, title: str, caption: str, y_label: str, names: Sequence[str], made: Sequence[Sequence[Estimate]]
) -> BarChart:
    """Return the chart of numbers with the 95 % intervals of all but the replicate's; `made`: of (reference, candidate,
    replicate), one estimate for each name. Intervals of shares in % end at 0 and 100."""
    lines = []
    for role, estimates in zip(ROLES, made, strict=True):
        y, low, high = np.array([(e.value, e.low, e.high) for e in estimates]).reshape(-1, 3).T
        if y_label.endswith("/ %"):
            low, high = np.clip(low, 0.0, 100.0), np.clip(high, 0.0, 100.0)
        ends = (None, None) if role == "replicate" else (low, high)
        lines.append(Line(role, role, np.arange(len(y), dtype=np.float64), y, *ends))
    return BarChart(section, title, caption, y_label, tuple(names), tuple(lines))


Chart = LineChart | Landscape | BarChart | Histogram
