"""The manual's table of trajectory formats, which the tests hold the readers to."""

from __future__ import annotations

from pathlib import Path

MANUAL = Path(__file__).parents[2] / "docs" / "files.md"


def format_rows() -> dict[str, dict[str, str]]:
    """Return the rows of the manual's table by the format's name, each by column."""
    lines = MANUAL.read_text(encoding="utf-8").splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("| format | read by |"))
    rows = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return {row[0].partition(" (`")[0]: dict(zip(rows[0], row, strict=True)) for row in rows[2:]}


def tried_with(name: str) -> str:
    """Return the programs with whose files a format was tried."""
    return format_rows()[name]["tried with files of"]
