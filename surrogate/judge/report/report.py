"""The report: one self-contained HTML file that opens offline, and the same numbers as JSON and Markdown beside it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from surrogate.judge.comparison import Account, Comparison
from surrogate.judge.report.definitions import DEFINITIONS
from surrogate.judge.report.figures import albums
from surrogate.judge.report.markdown import to_markdown
from surrogate.judge.report.wording import (
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
from surrogate.judge.rows.rows import GROUPS
from systems.errors import InputError, StorageError
from systems.options import flag_of
from systems.units import format_time_ps

_STYLES = ("report.css", "viewer.css")
_SCRIPTS = ("viewer.js", "tables.js")


class Foreword(NamedTuple):
    """What whoever had the trajectories made says of them: a `headline`, before everything else, and how they came
    about, lines of a name and a text, under `title`."""

    headline: str
    title: str
    lines: Sequence[tuple[str, str]]


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

    package = files("surrogate.judge.report")

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
            "judgement": j,
            "anchor": f"candidate-{i + 1}",
            "cards": cards(j),
            "groups": [(GROUP_TITLES.get(g, g.capitalize()), [r for r in j.rows if r.group == g]) for g in GROUPS],
            "albums": albums(j.charts, comparison.temperature_k),
            "movie": comparison.movies[i] if i < len(comparison.movies) else None,
        }
        for i, j in enumerate(comparison.judgements)
    ]
    return environment.get_template("report.html.j2").render(
        comparison=comparison,
        candidates=candidates,
        side_by_side=side_by_side(comparison) if len(candidates) > 1 else [],
        accounts=_accounts(comparison),
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


def _accounts(comparison: Comparison) -> list[tuple[str, Account, str]]:
    """Every trajectory with its role and its speed in words."""
    listed = [("Reference", comparison.reference)]
    listed += [("Candidate", j.account) for j in comparison.judgements]
    if comparison.replicate is not None:
        listed.append(("Replicate", comparison.replicate))
    return [(role, a, per_day(a.ns_per_day)) for role, a in listed]


def _command(comparison: Comparison, target: Path) -> str:
    """The command line that makes this report again, as far as the file names tell."""
    accounts = [comparison.reference, *(j.account for j in comparison.judgements)]
    words = ["surromd", "compare", *(",".join(a.sources) or a.label for a in accounts)]
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
