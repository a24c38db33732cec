"""The table of many runs: index.html with a link to each report, and results.json."""

from __future__ import annotations

import json
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from systems.files.whole_file import create_whole
from systems.units import format_time_ps, format_wall

PAGE_NAME, RESULTS_NAME = "index.html", "results.json"
_HEADS = ("Molecule", "Way", "Evaluated", "Held-out MD", "EquivalentTime", "Speed-up at least", "Verdict", "Wall time")


def write_results(folder: Path, results: list[dict[str, Any]]) -> None:
    """Write the table of results into a folder whose subfolders hold the runs, those that failed with their reasons."""
    create_whole(folder / RESULTS_NAME, json.dumps(results, indent=1) + "\n")
    style = files("surrogate.comparison.report").joinpath("report.css").read_text("utf-8")
    heads = "".join(f"<th>{head}</th>" for head in _HEADS)
    rows = "\n".join(_row(result) for result in results)
    n_failed = sum(bool(result["failed"]) for result in results)
    page = f"""<!doctype html> <html lang="en"> <head> <meta charset="utf-8"> <meta http-equiv="Content-Security-Policy"
content="default-src 'none'; style-src 'unsafe-inline'"> <meta name="viewport" content="width=device-width,
initial-scale=1"> <meta name="color-scheme" content="light dark"> <title>{len(results)} molecules</title> <style>
{style} </style> </head> <body> <h1>{len(results)} molecules, {n_failed} failed</h1> <table class="stack">
<thead><tr>{heads}</tr></thead> <tbody> {rows} </tbody> </table> </body> </html>
"""
    create_whole(folder / PAGE_NAME, page)


def _row(result: dict[str, Any]) -> str:
    name = escape(result["name"])
    if result["failed"]:
        reason = f'<td colspan="{len(_HEADS) - 1}">failed: {escape(result["failed"])}</td>'
        return f'<tr><th scope="row">{name}</th>{reason}</tr>'
    link = f'<a href="{quote(result["name"])}/report.html">{name}</a>'
    speed_up = "" if result["speed_up"] is None else f"{result['speed_up']:.2g}"
    cells = (
        result["way"],
        format_time_ps(result["rolled_ps"], 2),
        format_time_ps(result["held_out_ps"], 2),
        result["equivalent_time"] or "not told",
        speed_up,
        result["verdict"],
        format_wall(result["wall_s"]),
    )
    labelled = zip(_HEADS[1:], cells, strict=True)
    columns = "".join(f'<td data-label="{head}">{escape(cell)}</td>' for head, cell in labelled)
    return f'<tr><th scope="row">{link}</th>{columns}</tr>'
