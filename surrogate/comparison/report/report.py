"""The report: one self-contained HTML file that opens offline, and the same numbers as JSON and Markdown beside it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from surrogate.comparison.comparison import Comparison, Evaluation, Summary
from surrogate.comparison.measure.statistics import Estimate
from surrogate.comparison.report.definitions import DEFINITIONS
from surrogate.comparison.report.figures import Figure, albums
from surrogate.comparison.report.wording import (
    GROUP_TITLES,
    MARKS,
    STATE_HEADS,
    STATUS_MARKS,
    cards,
    interval,
    number,
    per_day,
    plain,
    setting,
    severity,
    side_by_side,
    sort_key,
    state_lines,
)
from surrogate.comparison.rows.rows import GROUPS, Row
from systems.errors import InputError, StorageError
from systems.files.outside import printable
from systems.options import flag_of
from systems.units import format_time_ps

_STYLES = ("report.css", "viewer.css")
_SCRIPTS = ("viewer.js", "tables.js")


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

    environment = Environment(
        loader=DictLoader({name: text_of(name) for name in ("report.html.j2", "macros.html.j2")}),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number, interval=interval, time=format_time_ps, plain=plain, setting=setting, sort_key=sort_key
    )
    candidates = [
        {
            "evaluation": j,
            "anchor": f"candidate-{i + 1}",
            "cards": cards(j),
            "groups": [(GROUP_TITLES.get(g, g.capitalize()), [r for r in j.rows if r.group == g]) for g in GROUPS],
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
    listed = [("Reference", comparison.reference)]
    listed += [("Candidate", j.summary) for j in comparison.evaluations]
    if comparison.replicate is not None:
        listed.append(("Replicate", comparison.replicate))
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
        parts += [
            "## Has the reference forgotten its start?",
            _text(comparison.convergence.verdict),
            _drifts(comparison),
        ]
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
    headline = [
        f"- {card.title}: {_text(card.value)}" + (f" ({_text(card.note)})" if card.note else "")
        for card in cards(evaluation)
    ]
    out = [f"## {_text(evaluation.summary.label)}", "\n".join(headline)]
    if evaluation.findings:
        out.append("What is off, worst first:")
        out.append("\n".join(f"{k}. {_text(x)}" for k, x in enumerate(evaluation.findings, 1)))
    rows = [_metric(row, title) for g in GROUPS for title, row in _of_group(evaluation.rows, g)]
    out.append(_table(("", "Metric", "Reference", "Candidate", "Replicate", "Ratio", "Tolerance", "Verdict"), rows))
    out.append(
        f"Compared over {format_time_ps(evaluation.compared_ps)} ({evaluation.n_frames} frames) each; in brackets 95 % "
        f"intervals from {evaluation.n_blocks} blocks of {format_time_ps(evaluation.block_ps)}."
    )
    out += _list("Left out, and why", [f"{what}: {why}." for what, why in evaluation.skipped])
    return out + _list("Equal terms", evaluation.notes)


def _of_group(rows: Sequence[Row], group: str) -> list[tuple[str, Row]]:
    mine = [row for row in rows if row.group == group]
    return [(GROUP_TITLES.get(group, group.capitalize()) if k == 0 else "", row) for k, row in enumerate(mine)]


def _metric(row: Row, title: str) -> tuple[str, ...]:
    name = f"{row.metric} / {row.unit}" if row.unit else row.metric
    values = [f"{number(e)} {interval(e)}".rstrip() for e in (row.reference, row.candidate, row.replicate)]
    return (title, name, *values, plain(row.ratio), row.tolerance_text, f"{MARKS[row.verdict]} {row.verdict}")


def _side_by_side(comparison: Comparison) -> str:
    def cell(row: Row | None) -> str:
        return "–" if row is None else f"{MARKS[row.verdict]} {number(row.candidate)}"

    labels = [j.summary.label for j in comparison.evaluations]
    rows = []
    for line in side_by_side(comparison):
        name = f"{line.metric} / {line.unit}" if line.unit else line.metric
        ref: Estimate | None = line.first.reference or line.first.replicate
        rows.append((name, number(ref), *(cell(row) for row in line.rows)))
    return _table(("Metric", "Reference (of a distance: the replicate's)", *labels), rows)


def _costs(comparison: Comparison) -> str:
    listed = [("Reference", comparison.reference)]
    listed += [("Candidate", j.summary) for j in comparison.evaluations]
    if comparison.replicate is not None:
        listed.append(("Replicate", comparison.replicate))
    rows = [
        (
            f"{role}: {a.label}",
            a.length,
            f"{a.n_frames}, every {format_time_ps(a.lag_ps)}",
            "not recorded" if a.wall_s is None else f"{a.wall_s:.4g} s",
            per_day(a.ns_per_day),
        )
        for role, a in listed
    ]
    return _table(("Trajectory", "Length", "Frames", "Wall time", "Speed"), rows)


def _drifts(comparison: Comparison) -> str:
    return _table(STATE_HEADS, state_lines(comparison.convergence)) if comparison.convergence else ""


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(_text(cell) for cell in line) + " |" for line in lines)


def _list(title: str, entries: Sequence[str]) -> list[str]:
    return [f"### {title}", "\n".join(f"- {_text(x)}" for x in entries)] if entries else []


def _text(value: str) -> str:
    """What came from outside must not start a tag or a cell, nor end one."""
    escaped = printable(value).replace("\\", "\\\\").replace("<", "&lt;").replace("|", "\\|").replace("`", "\\`")
    return escaped.replace("*", "\\*").replace("_", "\\_").replace("\n", " ")
