"""What the command line prints: records, what was written, verdicts; in messages, options that are named as Python's
keywords become flags."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import surrogate as sm
from surrogate.verbs.options import VERB_OPTIONS, CostErrorOptions, StressOptions
from systems.files.outside import printable
from systems.options import Option, options_of

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison, Evaluation


# `overwrite`, `overwrite=True`, `timestep_ps='1fs'`
_NAMED = re.compile(r"`([a-z][a-z_]*)(?:=([^`]+))?`")
# Arguments of the Python calls that are options on the command line, and one that is nowhere else.
_ARGUMENTS = {"out": "--out", "weights": "--weights", "config": "--config"}


@cache
def _known() -> dict[str, Option]:
    # Of a name that several have the last one counts.
    kinds = [CostErrorOptions, StressOptions, *VERB_OPTIONS.values()]
    return {name: found for kind in kinds for name, found in options_of(kind).items()}


def as_flags(text: str) -> str:
    """Return a message in which `overwrite=True` is --overwrite and `timestep_ps='1fs'` is --timestep 1fs. What stands
    in a table of a `config` file alone is said so; any other word in backticks stays."""
    return _NAMED.sub(_flag, text)


def _flag(match: re.Match[str]) -> str:
    name, value = match.groups()
    found = _known().get(name)
    flag = _ARGUMENTS.get(name) or (found.flags[0] if found is not None and found.flags else None)
    if flag is not None:
        return flag if value in (None, "True") else f"{flag} {value.strip(chr(39))}"
    if found is not None and found.section:
        said = found.key if value is None else f"{found.key} = {value.replace(chr(39), chr(34))}"
        return f"{said} in [{found.section}] of --config"
    return match.group()


def _say(text: str) -> None:
    """Print text of files, in which nothing steers the terminal."""
    typer.echo(printable(as_flags(text)))


def print_json(value: Any) -> None:
    """Print a value as indented JSON on stdout."""
    _say(json.dumps(value, indent=2, default=str))


# Of more numbers than that by name, and of more files, a few are shown.
_MOST, _MOST_FILES, _FEW = 18, 6, 3


def print_pairs(record: Any, indent: int = 0, *, as_json: bool = False) -> None:
    """Print a record as aligned lines, nested records indented, lists of plain values joined, of long ones the first
    entries; or as JSON, all of it."""
    if as_json:
        return print_json(record)
    shown = {k: v for k, v in record.items() if v is not None and v != () and v != []}
    numbers = len(shown) > _MOST and all(isinstance(v, (int, float)) for v in shown.values())
    more = len(shown) - _FEW if numbers else 0
    shown = dict(list(shown.items())[: len(shown) - more])
    width = max((len(k) for k in shown), default=0)
    for key, value in shown.items():
        margin = " " * indent
        if isinstance(value, dict):
            _say(f"{margin}{key}")
            print_pairs(value, indent + 2)
        elif isinstance(value, (list, tuple)) and any(isinstance(v, dict) or " " in str(v) for v in value):
            _say(f"{margin}{key}")
            files = len(value) > _MOST_FILES and all(isinstance(v, dict) and "what" not in v for v in value)
            for entry in value[:_FEW] if files else value:
                _say(f"{margin}  {_one_line(entry)}")
            _say_more(len(value) - _FEW if files else 0, indent + 2)
        else:
            text = ", ".join(map(_plain, value)) if isinstance(value, (list, tuple)) else _plain(value)
            _say(f"{margin}{key:<{width}}  {text}")
    _say_more(more, indent)


def _say_more(n: int, indent: int) -> None:
    if n:
        _say(f"{' ' * indent}and {n} more (--json has all)")


def _one_line(entry: Any) -> str:
    if not isinstance(entry, dict):
        return str(entry)
    if "what" in entry:
        saves = f" ({entry['saves']})" if entry.get("saves") else ""
        return f"{entry['what']}: {entry.get('why') or entry.get('reason')}{saves}"
    return ", ".join(f"{key} {_plain(value)}" for key, value in entry.items())


def _plain(value: Any, digits: int = 6) -> str:
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def print_library(entries: list[dict[str, Any]]) -> None:
    """Print the named scenes in their groups, a line each, and what can be had besides."""
    from systems.library.named_scenes import ON_DEMAND

    group = ""
    for entry in entries:
        if entry["group"] != group:
            _say(f"{chr(10) if group else ''}{entry['group']}")
            group = entry["group"]
        size = f"{entry['n_atoms']:>4} atoms  {entry['formula']}"
        _say(f"  {entry['name']:<20} {size:<26} {entry['title']}")
    _say(f"{chr(10)}{ON_DEMAND}")


def print_written(paths: list[Path], as_json: bool, quiet: bool) -> None:
    """Say what was written: its length, what it cost, and how the run went."""
    records = [sm.info(path) for path in paths] if as_json or not quiet else []
    if as_json:
        return print_json(records)
    for path, record in zip(paths, records, strict=False):
        _say(f"{path}: {record['summary']}")
        for line in record.get("details", []):
            _say(f"  {line}")


def print_run(record: dict[str, Any], *, as_json: bool) -> None:
    """Print what came of a run: use it or not, for what, why, and where the report is; of a dry run the decision."""
    if as_json:
        print_json(record)
    elif "molecules" in record:
        for result in record["molecules"]:
            came = f"failed: {result['failed']}" if result["failed"] else result["headline"]
            _say(f"{result['name']}: {came}")
        _say(f"{record['summary']}: {Path(record['file']) / 'index.html'}")
    elif (outcome := record.get("outcome")) is None:
        print_pairs(record["decision_table"])
    else:
        for line in (*outcome["in_short"], outcome["details"], *outcome["notes"]):
            _say(line)
        _say(f"report: {Path(record['file']) / 'report.html'}")


def print_comparison(result: Comparison, report: Path, *, as_json: bool, quiet: bool, show_all: bool = False) -> None:
    """Print each candidate's three lines (use it or not, for what, why) and its verdict, as its report has them; with
    `show_all` what is wrong and every row between reference and replicate."""
    if as_json:
        return print_json(result.to_dict())
    for evaluation in () if quiet else result.evaluations:
        use, *more = evaluation.in_short
        lines = [f"{evaluation.summary.label}: {use}", *(f"  {line}" for line in (*more, evaluation.verdict))]
        if show_all:
            lines += [*(f"  - {finding}" for finding in evaluation.findings), *_rows(evaluation)]
        if evaluation.speed_ratio is not None:
            lines.append(f"  simulated time per wall time: {evaluation.speed_ratio:.3g} times the reference's")
        for line in (*lines, *(f"  note: {note}" for note in evaluation.notes)):
            _say(line)
    for note in () if quiet else result.notes:
        _say(f"note: {note}")
    _say(f"report: {report}")


def _rows(evaluation: Evaluation) -> Iterator[str]:
    yield f"  {'':<52} {'reference':>10} {'candidate':>10} {'replicate':>10}"
    for row in evaluation.rows:
        figures = (row.reference, row.candidate, row.replicate)
        numbers = " ".join(f"{'-' if e is None else _plain(e.value, 4):>10}" for e in figures)
        yield f"  {row.metric[:52]:<52} {numbers} {row.unit:<8} {row.verdict}"
