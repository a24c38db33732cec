"""The report: one self-contained HTML file that opens offline, the same numbers as JSON and Markdown beside it, and how
they are worded."""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from surrogate.comparison.comparison import Comparison, Evaluation, Summary
from surrogate.comparison.convergence import Convergence
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.report.definitions import DEFINITIONS
from surrogate.comparison.report.figures import Figure, albums
from surrogate.comparison.rows.rows import GROUPS, Row
from systems.errors import InputError, StorageError
from systems.files.outside import printable
from systems.options import flag_of
from systems.units import format_time_ps

_STYLES = ("report.css", "viewer.css")
_SCRIPTS = ("viewer.js", "tables.js")
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


class Foreword(NamedTuple):
    """What whoever had the trajectories made says of them: a `headline`, before everything else, and how they came
    about, lines of a name and a text, under `title`; `pictures` of what the comparison does not draw."""

    headline: str
    title: str
    lines: Sequence[tuple[str, str]]
    pictures: Sequence[Figure] = ()


class Written(NamedTuple):
    """The files of one report."""

    html: Path
    json: Path
    markdown: Path


def write_report(
    comparison: Comparison, path: str | Path, *, command: str | None = None, foreword: Foreword | None = None
) -> Written:
    """Write `path` (HTML), and the JSON and the Markdown beside it; return the three paths.

    `command` is printed as the way to reproduce the report (by default one is put together from the file names).
    All files appear whole or not at all. Raises InputError for a name that does not end in .html, StorageError when
    they cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{target}: a report is written as .html (its JSON and Markdown go beside it).")
    written = Written(target, target.with_suffix(".json"), target.with_suffix(".md"))
    _check_place(*written)
    said = command or _command(comparison, target)
    text = json.dumps(comparison.to_dict(), indent=1, allow_nan=False, ensure_ascii=False)
    page = render(comparison, command=said, foreword=foreword)
    prose = to_markdown(comparison, command=said, headline=foreword.headline if foreword else "")
    _write_together({written.json: text + "\n", written.markdown: prose, written.html: page})
    return written


def render(comparison: Comparison, *, command: str, foreword: Foreword | None = None) -> str:
    """Return the report as HTML text."""
    from jinja2 import DictLoader, Environment, StrictUndefined
    from markupsafe import Markup

    package = files("surrogate.comparison.report")

    def text_of(name: str) -> str:
        return package.joinpath(name).read_text("utf-8")

    loader = DictLoader({name: text_of(name) for name in ("report.html.j2", "macros.html.j2")})
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters.update(
        number=number, interval=interval, time=format_time_ps, plain=plain, setting=setting, sort_key=sort_key
    )
    candidates = [
        {
            "evaluation": j,
            "anchor": f"candidate-{i + 1}",
            "cards": cards(j),
            "groups": [(GROUP_TITLES[g], [r for r in j.rows if r.group == g]) for g in GROUPS],
            "albums": albums(j.charts, comparison.temperature_k),
            "movie": comparison.movies[i] if i < len(comparison.movies) else None,
        }
        for i, j in enumerate(comparison.evaluations)
    ]
    return environment.get_template("report.html.j2").render(
        comparison=comparison,
        candidates=candidates,
        side_by_side=side_by_side(comparison) if len(candidates) > 1 else [],
        summaries=_summaries(comparison),
        state_heads=STATE_HEADS,
        state_lines=[] if comparison.convergence is None else state_lines(comparison.convergence),
        definitions=DEFINITIONS,
        group_titles=GROUP_TITLES,
        marks=MARKS,
        status_marks=STATUS_MARKS,
        severity=severity,
        command=command,
        foreword=foreword,
        embed=lambda value: Markup(_embed(value)),
        style=Markup("\n".join(text_of(name) for name in _STYLES)),
        script=Markup("\n".join(text_of(name) for name in _SCRIPTS)),
    )


def _embed(value: object) -> str:
    """Return JSON that may stand inside a script element: nothing in it can end that element or start another."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c").replace("&", "\\u0026")


def _summaries(comparison: Comparison) -> list[tuple[str, Summary, str]]:
    """Every trajectory with its role and its speed in words."""
    listed = [("Reference", comparison.reference), *(("Candidate", j.summary) for j in comparison.evaluations)]
    listed += [] if comparison.replicate is None else [("Replicate", comparison.replicate)]
    return [(role, a, per_day(a.ns_per_day)) for role, a in listed]


def _command(comparison: Comparison, target: Path) -> str:
    """The command line that makes this report again, as far as the file names tell."""
    summaries = [comparison.reference, *(j.summary for j in comparison.evaluations)]
    words = ["surromd", "compare", *(",".join(a.sources) or a.label for a in summaries)]
    if comparison.replicate is not None:
        words += [flag_of("replicate"), ",".join(comparison.replicate.sources) or comparison.replicate.label]
    if comparison.reference.top is not None:
        words += [flag_of("top"), comparison.reference.top]
    if comparison.reference.stated_lag_ps is not None:
        words += [flag_of("dt_ps"), format_time_ps(comparison.reference.stated_lag_ps).replace(" ", "")]
    return shlex.join([*words, "-o", target.name])


def _check_place(*paths: Path) -> None:
    """Fail before anything is drawn where it is plain that nothing can be written."""
    for path in paths:
        if not path.parent.is_dir():
            raise StorageError(f"Cannot write {path}: its folder does not exist; choose another place with -o.")
        if path.is_dir():
            raise StorageError(f"Cannot write {path}: it is a folder; choose another name with -o.")


def _write_together(texts: dict[Path, str]) -> None:
    """Write all files under other names first, so that a full disk leaves neither one nor half a file."""
    partial = {path: path.with_name(f".{path.name}.partial") for path in texts}
    try:
        for path, text in texts.items():
            partial[path].write_text(text, "utf-8")
        for path in texts:
            partial[path].replace(path)
    except OSError as error:
        raise StorageError(
            f"Cannot write {error.filename or 'the report'}: {error.strerror or error}; choose another place with -o."
        ) from error
    finally:
        for leftover in partial.values():
            leftover.unlink(missing_ok=True)


def to_markdown(comparison: Comparison, *, command: str, headline: str = "") -> str:
    """Return the report as Markdown text: a headline, verdicts, one table per candidate, what was left out, costs."""
    title = f"{comparison.scene_name} ({comparison.formula}, {comparison.n_atoms} atoms)"
    parts = [f"# {_text(title)} against {_text(comparison.reference.label)}"]
    parts += [_text(headline)] if headline else []
    for evaluation in comparison.evaluations:
        mark = STATUS_MARKS[evaluation.status]
        use, for_what, why = map(_text, evaluation.in_short)
        parts.append(f"**{mark} {_text(evaluation.summary.label)}**: {use}\n- {for_what}\n- {why}")
        parts.append(_text(evaluation.verdict))
    if comparison.convergence is not None:
        drifts = _table(STATE_HEADS, state_lines(comparison.convergence))
        parts += ["## Has the reference forgotten its start?", _text(comparison.convergence.verdict), drifts]
    if len(comparison.evaluations) > 1:
        parts += ["## Side by side", _side_by_side(comparison)]
    for evaluation in comparison.evaluations:
        parts += _candidate(evaluation)
    parts += ["## Trajectories and what they cost", _costs(comparison)]
    parts += _list("Notes", comparison.notes)
    parts.append("## What the numbers mean")
    parts += [f"**{d.term}**: {_text(d.meaning)} {_text(d.source)}".rstrip() for d in DEFINITIONS]
    parts += ["## How to make this report again", "```\n{}\n```".format(command.replace("`", "'"))]
    versions = ", ".join(f"{k} {v}" for k, v in comparison.versions.items())
    parts.append(f"Random draws: seed {comparison.options.seed}. {versions}.")
    return "\n\n".join(parts) + "\n"


def _candidate(evaluation: Evaluation) -> list[str]:
    shown = [
        f"- {card.title}: {_text(card.value)}" + (f" ({_text(card.note)})" if card.note else "")
        for card in cards(evaluation)
    ]
    out = [f"## {_text(evaluation.summary.label)}", "\n".join(shown)]
    if evaluation.findings:
        out.append("What is off, worst first:")
        out.append("\n".join(f"{k}. {_text(x)}" for k, x in enumerate(evaluation.findings, 1)))
    rows, group = [], ""
    for row in evaluation.rows:
        rows.append(_metric(row, "" if row.group == group else GROUP_TITLES[row.group]))
        group = row.group
    out.append(_table(("", "Metric", "Reference", "Candidate", "Replicate", "Ratio", "Tolerance", "Verdict"), rows))
    out.append(
        f"Compared over {format_time_ps(evaluation.compared_ps)} ({evaluation.n_frames} frames) each; in brackets 95 % "
        f"intervals from {evaluation.n_blocks} blocks of {format_time_ps(evaluation.block_ps)}."
    )
    out += _list("Left out, and why", [f"{what}: {why}." for what, why in evaluation.skipped])
    return out + _list("Equal terms", evaluation.notes)


def _metric(row: Row, title: str) -> tuple[str, ...]:
    name = f"{row.metric} / {row.unit}" if row.unit else row.metric
    values = [f"{number(e)} {interval(e)}".rstrip() for e in (row.reference, row.candidate, row.replicate)]
    return (title, name, *values, plain(row.ratio), row.tolerance_text, f"{MARKS[row.verdict]} {row.verdict}")


def _side_by_side(comparison: Comparison) -> str:
    labels = [j.summary.label for j in comparison.evaluations]
    rows = []
    for line in side_by_side(comparison):
        name = f"{line.metric} / {line.unit}" if line.unit else line.metric
        cells = ["–" if row is None else f"{MARKS[row.verdict]} {number(row.candidate)}" for row in line.rows]
        rows.append((name, number(line.first.reference or line.first.replicate), *cells))
    return _table(("Metric", "Reference (of a distance: the replicate's)", *labels), rows)


def _costs(comparison: Comparison) -> str:
    rows = [
        (
            f"{role}: {a.label}",
            a.length,
            f"{a.n_frames}, every {format_time_ps(a.lag_ps)}",
            "not recorded" if a.wall_s is None else f"{a.wall_s:.4g} s",
            speed,
        )
        for role, a, speed in _summaries(comparison)
    ]
    return _table(("Trajectory", "Length", "Frames", "Wall time", "Speed"), rows)


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_text(cell) for cell in line) + " |" for line in lines)


def _list(title: str, entries: Sequence[str]) -> list[str]:
    return [f"### {title}", "\n".join(f"- {_text(x)}" for x in entries)] if entries else []


def _text(value: str) -> str:
    """What came from outside must not start a tag or a cell, nor end one."""
    escaped = printable(value).replace("\\", "\\\\").replace("<", "&lt;").replace("|", "\\|").replace("`", "\\`")
    return escaped.replace("*", "\\*").replace("_", "\\_").replace("\n", " ")


def number(estimate: Estimate | None) -> str:
    """Return the value, with as many digits as its error leaves meaningful (one more than the first uncertain one)."""
    if estimate is None:
        return "–"
    value, error = estimate.value, estimate.error
    if not math.isfinite(value):
        return "not defined"
    if math.isfinite(error) and error > 0:
        return _rounded(value, _decimals(abs(value), error))
    return f"{value:.4g}"


def _decimals(size: float, error: float) -> int:
    return min(max(1 - math.floor(math.log10(error)), 0), 4 if size < 10 else 3)


def _rounded(value: float, decimals: int) -> str:
    """Return the value with so many decimals, or with two digits where it would read as zero."""
    shown = f"{value:.{decimals}f}"
    return f"{value:.2g}" if value and not float(shown) else shown


def interval(estimate: Estimate | None) -> str:
    """Return the 95 % interval in brackets, or an empty string."""
    if estimate is None or not (math.isfinite(estimate.low) and math.isfinite(estimate.high)):
        return ""
    if estimate.low == estimate.high:
        return ""
    low, high, error = estimate.low, estimate.high, estimate.error
    if not (math.isfinite(error) and error > 0):
        return f"[{low:.4g}, {high:.4g}]"
    decimals = _decimals(max(abs(low), abs(high)), error)
    if f"{low:.{decimals}f}" == f"{high:.{decimals}f}":
        return f"[{low:.2g}, {high:.2g}]"
    return f"[{low:.{decimals}f}, {high:.{decimals}f}]"


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
    return f"{ns_per_day / 1000:.3g} µs/day" if ns_per_day >= 1000 else f"{ns_per_day:.3g} ns/day"


def severity(row: Row) -> int:
    """Return how bad a row's word is, 0 for 'agrees'."""
    return _SEVERITY.index(row.verdict)


def worst(rows: Sequence[Row]) -> Row | None:
    """Return the row with the worst word, among equals the one with the greatest value; None for no rows."""
    return max(rows, key=lambda r: (severity(r), r.candidate.value), default=None)


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
            f"{100 * s.low:.2g} to {100 * s.high:.2g} %" if is_state else "",
        ))  # fmt: skip
    return out


class Card(NamedTuple):
    """One headline number; `verdict` is the word of the row behind it, or empty."""

    title: str
    value: str
    note: str
    verdict: str


class Line(NamedTuple):
    """One metric over all candidates: the first reference's row, and each candidate's own (None where it has none)."""

    group: str
    metric: str
    unit: str
    first: Row
    rows: tuple[Row | None, ...]

    @property
    def all_agree(self) -> bool:
        """Whether no candidate is off in this metric."""
        return all(row is None or row.verdict == "agrees" for row in self.rows)


def cards(evaluation: Evaluation) -> list[Card]:
    """Return the headline numbers: what it is worth, validity, the worst joint map and relaxation time, speed."""
    valid = evaluation.row("valid:all")
    others = "" if valid.reference is None else f"reference {number(valid.reference)} %"
    out = []
    if evaluation.equivalent_time_words and evaluation.equivalent_time:
        best = evaluation.equivalent_time[0]
        words = best.in_words()
        out.append(Card(f"Equivalent MD time, by its {best.measure}", f"{words.split(' [')[0]} of MD", words, ""))
    out.append(Card("Valid frames", f"{number(valid.candidate)} %", others, valid.verdict))
    joint = worst([r for r in evaluation.rows if r.key.startswith("joint_jsd")])
    if joint is not None:
        note = f"{plain(joint.ratio)} × a replicate's ({number(joint.replicate)})" if joint.ratio else ""
        out.append(Card(joint.metric, number(joint.candidate), note, joint.verdict))
    slow = worst([r for r in evaluation.rows if r.key.startswith("correlation_time")])
    if slow is not None and slow.reference is not None:
        note = f"reference {number(slow.reference)} ps, ratio {plain(slow.ratio)}"
        out.append(Card(slow.metric, f"{number(slow.candidate)} ps", note, slow.verdict))
    ratio = evaluation.speed_ratio
    if evaluation.summary.ns_per_day is None:
        note = "the file's record holds no cost"
    else:
        note = f"{ratio:.3g} × the reference's" if ratio is not None else "the reference's cost is not recorded"
    return [*out, Card("Speed", per_day(evaluation.summary.ns_per_day), note, "")]


def side_by_side(comparison: Comparison) -> list[Line]:
    """Return every metric that any candidate has, in the table's order, with the row of each candidate.

    Rows are matched by key, so that a metric whose name carries its finding (which bond is farthest off) is one line.
    """
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
        lines.append(Line(first.group, metric, first.unit, first, tuple(found)))
    return sorted(lines, key=lambda line: GROUPS.index(line.first.group))
