"""The directive `all-commands`: a section for each verb with its arguments and options, read from the command line.

A section shows what `surromd VERB --help` says, as a table.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

_HEAD = ("| | |", "|---|---|")
# Verbs that measure the others come last.
_MEASURING = ("bench", "stress")


def find_command(words: list[str]) -> Any:
    """Return the command that `surromd WORDS` runs, as click has it."""
    from typer.main import get_command

    from surrogate.cli.main import app

    command: Any = get_command(app)
    for word in words:
        command = command.commands[word]
    return command


def all_commands() -> list[list[str]]:
    """Return the words of every verb, those of groups included: [['demo'], ..., ["bench", "cost-error"], ...]."""
    found = []
    for name, command in find_command([]).commands.items():
        inner = getattr(command, "commands", None)
        found += [[name]] if inner is None else [[name, one] for one in inner]
    return sorted(found, key=lambda words: words[0] in _MEASURING)


def command_rows(command: Any) -> list[tuple[str, str]]:
    """Return (how it is written, what it says) of each argument and option, arguments first."""
    context = command.context_class(command, info_name=command.name)
    rows = []
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None and parameter.name != "help":
            rows.append((_plain(record[0]), _plain(record[1])))
    return rows


def _plain(text: str) -> str:
    """Return a text of typer's help without the marks that keep rich from reading brackets as its own."""
    return " ".join(text.replace("\\[", "[").split())


def file_rows(words: list[str]) -> list[tuple[str, str]]:
    """Return (table and key, what it says) of each option of a verb that the command line has no flag for."""
    from surrogate.verbs.options import VERB_OPTIONS
    from systems.options import options_of

    rows = options_of(VERB_OPTIONS[words[0]]).values() if words[0] in VERB_OPTIONS else ()
    found = []
    for row in (row for row in rows if not row.flags):
        choices = f" One of {', '.join(row.choices)}." if row.choices else ""
        shown = "required" if row.required else row.shown_default
        default = f" [default: {shown}]" if shown else ""
        found.append((f"[{row.section}] {row.key}" if row.section else row.key, f"{row.help}{choices}{default}"))
    return found


def command_markdown(words: list[str]) -> str:
    """Return a verb's section in MyST: what it does, how it is called, and its table."""
    command = find_command(words)
    context = command.context_class(command, info_name=" ".join(["surromd", *words]))
    usage = " ".join(command.get_usage(context).split()).removeprefix("Usage: ")
    usage = usage.replace("{", "").replace("}", "").replace("[[", "[").replace("]]", "]")
    said = "\n\n".join(" ".join(part.split()) for part in (command.help or "").split("\n\n"))
    table = [f"| `{_cell(written)}` | {_text(text)} |" for written, text in command_rows(command)]
    further = [f"| `{_cell(written)}` | {_text(text)} |" for written, text in file_rows(words)]
    if further:
        further = ["", "In `--config` files, and as keywords in Python:", "", *_HEAD, *further]
    return "\n".join([said, "", "```text", usage, "```", "", *_HEAD, *table, *further])


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _text(text: str) -> str:
    """Return a text in which nothing is Markdown."""
    return "".join("\\" + c if c in "\\`*_[]<>|$" else c for c in text)


class AllCommands(SphinxDirective):
    """`{all-commands}`, below a page's title."""

    def run(self) -> list[nodes.Node]:
        sections = [f"## surromd {' '.join(words)}\n\n{command_markdown(words)}\n" for words in all_commands()]
        return self.parse_text_to_nodes("\n".join(sections), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("all-commands", AllCommands)
    return {"parallel_read_safe": True}
