"""The directive `results`: a table of measured figures, made from JSON, with what measured them.

```{results} lags
```

reads docs/results/tables/lags.json: `columns` (titles), `rows` (lists of as many texts or numbers), `command` (what
measured them), `machine` (where) and, where there is more to say, `note`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

TABLES = Path(__file__).resolve().parents[1] / "results" / "tables"


def read_table(path: Path) -> dict[str, Any]:
    """Return a table's record. Raises ValueError, naming the file, where it is not one."""
    record = json.loads(path.read_text(encoding="utf-8"))
    missing = [key for key in ("columns", "rows", "command", "machine") if not record.get(key)]
    if missing:
        raise ValueError(f"{path.name} lacks {', '.join(missing)}")
    width = len(record["columns"])
    uneven = [row for row in record["rows"] if len(row) != width]
    if uneven:
        raise ValueError(f"{path.name}: the row of {uneven[0][0]!r} has {len(uneven[0])} cells, the head {width}")
    return dict(record)


def table_markdown(record: dict[str, Any]) -> str:
    """Return the table and the line below it in MyST."""
    lines = [_line(record["columns"]), "|" + "---|" * len(record["columns"]), *map(_line, record["rows"])]
    about = f"Measured by `{record['command']}`; {record['machine']}."
    return "\n".join([*lines, "", about, *(["", record["note"]] if record.get("note") else [])])


def _line(cells: list[Any]) -> str:
    return "| " + " | ".join(f"{cell:g}" if isinstance(cell, float) else str(cell) for cell in cells) + " |"


class ResultsDirective(SphinxDirective):
    """`{results} NAME`."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        path = TABLES / f"{self.arguments[0]}.json"
        self.env.note_dependency(str(path))
        return self.parse_text_to_nodes(table_markdown(read_table(path)))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("results", ResultsDirective)
    return {"parallel_read_safe": True}
