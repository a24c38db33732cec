"""What the command line prints: records, what was written, verdicts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from surrogate.cli.flags import as_flags
from systems.files.outside import printable

if TYPE_CHECKING:
    from surrogate.comparison.comparison import Comparison, Evaluation


def _say(text: str) -> None:
    """Print text of files, in which nothing steers the terminal."""
    typer.echo(printable(as_flags(text)))


def print_json(value: Any) -> None:
    """Print a value as indented JSON on stdout."""
    import json

    _say(json.dumps(value, indent=2, default=str))


def print_pairs(record: dict[str, Any], indent: int = 0) -> None:
    """Print a record as aligned lines; nested records are indented, lists of plain values joined."""
    shown = {k: v for k, v in record.items() if v is not None and v != () and v != []}
    width = max((len(k) for k in shown), default=0)
    for key, value in shown.items():
        margin = " " * indent
        if isinstance(value, dict):
            _say(f"{margin}{key}")
            print_pairs(value, indent + 2)
        elif isinstance(value, (list, tuple)) and any(isinstance(v, dict) or " " in str(v) for v in value):
            _say(f"{margin}{key}")
            for entry in value:
                _say(f"{margin}  {_one_line(entry)}")
        else:
            text = ", ".join(map(_plain, value)) if isinstance(value, (list, tuple)) else _plain(value)
            _say(f"{margin}{key:<{width}}  {text}")


def _one_line(entry: Any) -> str:
    if not isinstance(entry, dict):
        return str(entry)
    if "what" in entry:
        saves = f" ({entry['saves']})" if entry.get("saves") else ""
        return f"{entry['what']}: {entry['why']}{saves}"
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
    from surrogate import api

    records = [api.info(path) for path in paths] if as_json or not quiet else []
    if as_json:
        print_json(records)
    for path, record in zip(paths, records, strict=False):
        if not as_json:
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
        print_json(result.to_dict())
        return
    for evaluation in () if quiet else result.evaluations:
        use, *more = evaluation.in_short
        for line in (f"{evaluation.summary.label}: {use}", *(f"  {x}" for x in (*more, evaluation.verdict))):
            _say(line)
        if show_all:
            for finding in evaluation.findings:
                _say(f"  - {finding}")
            _print_rows(evaluation)
        if evaluation.speed_ratio is not None:
            _say(f"  simulated time per wall time: {evaluation.speed_ratio:.3g} times the reference's")
        for note in evaluation.notes:
            _say(f"  note: {note}")
    for note in () if quiet else result.notes:
        _say(f"note: {note}")
    _say(f"report: {report}")


def _print_rows(evaluation: Evaluation) -> None:
    _say(f"  {'':<52} {'reference':>10} {'candidate':>10} {'replicate':>10}")
    for row in evaluation.rows:
        figures = (row.reference, row.candidate, row.replicate)
        numbers = " ".join(f"{'-' if e is None else _plain(e.value, 4):>10}" for e in figures)
        _say(f"  {row.metric[:52]:<52} {numbers} {row.unit:<8} {row.verdict}")
