"""The report: one self-contained HTML file that opens offline, the same numbers as JSON and Markdown beside it, and how
they are worded."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from importlib.resources import files
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from surrogate.comparison.comparison import Comparison
from surrogate.comparison.convergence import Convergence
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.report.figures import Figure, albums
from surrogate.comparison.rows.rows import GROUPS, Row
from systems.errors import InputError
from systems.files.outside import printable
from systems.files.whole_file import create_whole
from systems.options import flag_of
from systems.units import format_time_ps

PAGE, PROSE = "report.html.j2", "report.md.j2"
MARKS = {"agrees": "✓", "close": "≈", "differs": "✗", "fails": "‼", "undecided": "?"}
STATUS_MARKS = {"indistinguishable": "✓", "close": "≈", "different": "✗", "broken": "‼", "undecided": "?"}
GROUP_TITLES = {
    "validity": "Validity of frames",
    "structure": "Structure",
    "populations": "Populations",
    "distributions": "Distributions",
    "kinetics": "Kinetics",
}
_SEVERITY = ("agrees", "undecided", "close", "differs", "fails")
_UNITS = {"_per_ps": "/ps", "_k": "K", "_ps": "ps", "_da": "Da", "_nm": "nm", "_s": "s"}


class Definition(NamedTuple):
    """One term of the report, what it means, and where that comes from."""

    term: str
    meaning: str
    source: str


def definitions() -> list[Definition]:
    """Return the terms of definitions.txt: a term, its meaning, and in some its source; an empty line between two."""
    text = files("surrogate.comparison.report").joinpath("definitions.txt").read_text("utf-8")
    found = []
    for block in text.strip().split("\n\n"):
        term, _, rest = block.partition("\n")
        meaning, _, source = rest.replace("\n", " ").partition(" Source: ")
        found.append(Definition(term, meaning, source))
    return found


class Foreword(NamedTuple):
    """What whoever had the trajectories made says of them: a `headline`, before everything else, and how they came
    about, lines of a name and a text, under `title`; `pictures` of what the comparison does not draw."""

    headline: str
    title: str
    lines: Sequence[tuple[str, str]]
    pictures: Sequence[Figure] = ()


def write_report(
    comparison: Comparison, path: str | Path, *, command: str | None = None, foreword: Foreword | None = None
) -> Path:
    """Write `path` (HTML), and the JSON and the Markdown beside it; return the path.

    `command` is printed as the way to reproduce the report (by default one is put together from the file names).
    Each file appears whole or not at all, the page first. Raises InputError for a name that does not end in .html,
    StorageError when they cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{target}: a report is written as .html (its JSON and Markdown go beside it).")
    command = command or _command(comparison, target)
    create_whole(target, render(comparison, PAGE, command=command, foreword=foreword))
    text = json.dumps(comparison.to_dict(), indent=1, allow_nan=False, ensure_ascii=False)
    create_whole(target.with_suffix(".json"), text + "\n")
    create_whole(target.with_suffix(".md"), render(comparison, PROSE, command=command, foreword=foreword))
    return target


def render(comparison: Comparison, template: str = PAGE, *, command: str, foreword: Foreword | None = None) -> str:
    """Return the report by one of its templates, as HTML or as Markdown."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("surrogate.comparison", "report"),
        autoescape=template == PAGE,
        finalize=None
        if template == PAGE
        else lambda value: value if isinstance(value, Markup) else escaped(str(value)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number, interval=interval, time=format_time_ps, plain=plain, setting=setting, sort_key=sort_key,
        sentence=lambda text: text[:1].upper() + text[1:],
    )  # fmt: skip

    def joined(*names: str) -> Markup:
        assert environment.loader is not None
        return Markup("\n".join(environment.loader.get_source(environment, name)[0] for name in names))

    evaluations = comparison.evaluations
    return environment.get_template(template).render(
        comparison=comparison,
        candidates=[
            {"evaluation": j, "anchor": f"candidate-{k + 1}", "movie": movie}
            for k, (j, movie) in enumerate(zip_longest(evaluations, comparison.movies[: len(evaluations)]))
        ],
        albums=lambda charts: albums(charts, comparison.temperature_k),
        side_by_side=side_by_side(comparison) if len(evaluations) > 1 else [],
        trajectories=[
            ("Reference", comparison.reference),
            *(("Candidate", j.summary) for j in evaluations),
            *([] if comparison.replicate is None else [("Replicate", comparison.replicate)]),
        ],
        per_day=per_day,
        state_heads=STATE_HEADS,
        state_lines=[] if comparison.convergence is None else state_lines(comparison.convergence),
        definitions=definitions(),
        group_titles=GROUP_TITLES,
        marks=MARKS,
        status_marks=STATUS_MARKS,
        severity=_SEVERITY.index,
        command=command if template == PAGE else Markup(command.replace("`", "'")),
        foreword=foreword,
        # JSON inside a script element: nothing in it can end that element or start another.
        embed=lambda value: Markup(
            json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c").replace("&", "\\u0026")
        ),
        joined=joined,
    )


def escaped(value: str) -> str:
    """Return text for Markdown: what came from outside must not start a tag or a cell, nor end one."""
    plain_text = printable(value).replace("\\", "\\\\").replace("<", "&lt;").replace("|", "\\|").replace("`", "\\`")
    return plain_text.replace("*", "\\*").replace("_", "\\_").replace("\n", " ")


def _command(comparison: Comparison, target: Path) -> str:
    """The command line that makes this report again, as far as the file names tell."""
    summaries = [comparison.reference, *(j.summary for j in comparison.evaluations)]
    words = ["surromd", "compare", *(",".join(a.sources) or a.label for a in summaries)]
    if comparison.replicate is not None:
        words += [flag_of("replicate"), ",".join(comparison.replicate.sources) or comparison.replicate.label]
    everyone = [*summaries, *([] if comparison.replicate is None else [comparison.replicate])]
    lags = [s.stated_lag_ps and format_time_ps(s.stated_lag_ps).replace(" ", "") for s in everyone]
    for name, given in (("top", [s.top for s in everyone]), ("dt_ps", lags)):
        # One stands for all.
        for x in given if len(set(given)) > 1 else filter(None, given[:1]):
            words += [flag_of(name), str(x or "-")]
    return shlex.join([*words, "-o", target.name])


def number(estimate: Estimate | None) -> str:
    """Return the value, with as many digits as its error leaves meaningful (one more than the first uncertain one)."""
    if estimate is None:
        return "–"
    return _shown(estimate.value, estimate.error) if math.isfinite(estimate.value) else "not defined"


def _shown(value: float, error: float) -> str:
    if not (math.isfinite(error) and error > 0):
        return f"{value:.4g}"
    decimals = min(max(1 - math.floor(math.log10(error)), 0), 4 if abs(value) < 10 else 3)
    shown = f"{value:.{decimals}f}"
    # Two digits where it would read as zero.
    return f"{value:.2g}" if value and not float(shown) else shown


def interval(estimate: Estimate | None) -> str:
    """Return the 95 % interval in brackets, or an empty string."""
    if estimate is None or not math.isfinite(estimate.high - estimate.low) or estimate.low == estimate.high:
        return ""
    return f"[{_shown(estimate.low, estimate.error)}, {_shown(estimate.high, estimate.error)}]"


def plain(estimate: Estimate | None) -> str:
    """Return a ratio with two or three digits."""
    if estimate is None or not math.isfinite(estimate.value):
        return "–"
    return f"{estimate.value:.2f}" if estimate.value < 10 else f"{estimate.value:.3g}"


def sort_key(estimate: Estimate | None) -> str:
    """Return the number that a table sorts by; empty where there is none."""
    return "" if estimate is None or not math.isfinite(estimate.value) else f"{estimate.value:.9g}"


def setting(key: str, value: object) -> str:
    """Return an entry of a record for people: ('temperature_k', 300.0) -> 'temperature 300 K'."""
    shown = f"{value:g}" if isinstance(value, float) else str(value)
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{key.removesuffix(ending).replace('_', ' ')} {shown} {unit}"
    return f"{key.replace('_', ' ')} {shown}"


def per_day(ns_per_day: float | None) -> str:
    """Return a speed, or that it is not recorded."""
    if ns_per_day is None:
        return "not recorded"
    return f"{float(f'{ns_per_day / 1e3:.3g}'):,g} µs/day" if ns_per_day >= 1e3 else f"{ns_per_day:.3g} ns/day"


STATE_HEADS = ("State", "Share", "By quarters of each replica", "Drift, p", "Split R-hat", "Relaxes in", "In, out",
               "Left their start", "Allowed")  # fmt: skip
_MOST_STATES = 40


def state_lines(found: Convergence) -> list[tuple[str, ...]]:
    """Return the states of a convergence as lines of `STATE_HEADS`, what is not converged first; no more than forty."""
    order = sorted(found.states, key=lambda s: (not s.fault, min(s.share, 1.0 - s.share) < 1e-3))
    out: list[tuple[str, ...]] = []
    for s in order[:_MOST_STATES]:
        is_state = s.entries is not None
        quarters = "; ".join(f"{100 * q:.3g} ± {100 * e:.2g}" if is_state else f"{q:.2g} ± {e:.2g}"
                             for q, e in zip(s.quarters, s.quarter_errors, strict=True))  # fmt: skip
        out.append((
            s.label,
            f"{100 * s.share:.3g} ± {100 * s.error:.2g} %" if is_state else "",
            quarters + (" %" if is_state else ""),
            f"{s.drift_p:.2g}" if math.isfinite(s.drift_p) else "–",
            f"{s.r_hat:.3g}" if math.isfinite(s.r_hat) else "–",
            format_time_ps(s.relaxation_ps, 2) if math.isfinite(s.relaxation_ps) else "–",
            f"{s.entries}, {s.exits}" if is_state else "",
            f"{s.left} of {s.started}" if is_state else "",
            f"{100 * s.low:.2g} to {100 * s.high:.3g} %" if is_state else "",
        ))  # fmt: skip
    return out


class Line(NamedTuple):
    """One metric over all candidates: the first one's row, and each candidate's own (None where it has none)."""

    metric: str
    first: Row
    rows: tuple[Row | None, ...]

    @property
    def all_agree(self) -> bool:
        """Whether no candidate is off in this metric."""
        return all(row is None or row.verdict == "agrees" for row in self.rows)


def side_by_side(comparison: Comparison) -> list[Line]:
    """Return every metric that any candidate has, in the table's order, with the row of each candidate, matched by key:
    a metric whose name carries its finding (which bond is furthest off) is one line."""
    by_key: dict[str, list[Row | None]] = {}
    n = len(comparison.evaluations)
    for k, evaluation in enumerate(comparison.evaluations):
        for row in evaluation.rows:
            by_key.setdefault(row.key, [None] * n)[k] = row
    lines = []
    for found in by_key.values():
        first = next(row for row in found if row is not None)
        names = {row.metric for row in found if row is not None}
        metric = first.metric if len(names) == 1 else first.metric.split(":")[0]
        lines.append(Line(metric, first, tuple(found)))
    return sorted(lines, key=lambda line: GROUPS.index(line.first.group))
