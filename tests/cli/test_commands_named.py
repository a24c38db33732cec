"""Commands that the README, manual, cards of weights, notebooks, changelog and docstrings name exist."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import typer.main

# In code, between backticks or at a line's start: prose says "surromd makes ...", too.
_CODE = re.compile(r"```[^\n]*\n(.*?)```|``?([^`]+)``?|^ {4}(\S[^\n]*)$", re.S | re.M)
_CONTINUED = re.compile(r"\\?\n\s*")
_PYTHON = re.compile(r"python3? (-m )?([\w./]+)([^\n;&|]*)")
_SURROMD = re.compile(r"(?:^|(?<=[\s$!/]))surromd ((?:[a-z][\w-]*)|-[\w-]+)([^\n;&|#]*)", re.M)
_FLAG = re.compile(r"(?<![\w-])(--[a-z][\w-]*|-[a-zA-Z])(?![\w-])")


def documents(root: Path) -> list[Path]:
    """Return what tells people which commands to type."""
    manual = [p for p in (root / "docs").rglob("*.md") if "_build" not in p.parts]
    code = [p for top in ("systems", "md_reference", "surrogate", "docs/studies") for p in (root / top).rglob("*.py")]
    others = [*(root / "notebooks").glob("*.ipynb"), *(root / "docs" / "results").rglob("*.json"),
              *(root / "surrogate" / "pretrained").glob("*.md")]  # fmt: skip
    return sorted([*(root / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")), *manual, *code, *others])


def text_of(path: Path) -> str:
    """Return a document's text: of the changelog the unreleased part, of a module its docstrings, of results the
    command that made them."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        sources = ["".join(cell["source"]) for cell in json.loads(text)["cells"]]
        return "\n\n".join(f"```\n{s}\n```" if cell["cell_type"] == "code" else s
                           for s, cell in zip(sources, json.loads(text)["cells"], strict=True))  # fmt: skip
    if path.suffix == ".json":
        found = json.loads(text)
        return f"`{found['command']}`" if isinstance(found, dict) and "command" in found else ""
    if path.suffix == ".py":
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
        return "\n\n".join(ast.get_docstring(n) or "" for n in ast.walk(ast.parse(text)) if isinstance(n, kinds))
    return text


def commands(text: str) -> Iterator[tuple[str, str]]:
    """Yield (`python FILE.py`, `python -m MODULE` or `surromd VERB`, the rest of the line) of each command in code."""
    for fenced, inline, indented in _CODE.findall(text):
        code = fenced or inline or indented
        code = code if fenced and "\\\n" not in code else _CONTINUED.sub(" ", code)
        for module, name, rest in _PYTHON.findall(code):
            if module or name.endswith(".py"):
                yield f"python {module}{name}", rest
        for verb, rest in _SURROMD.findall(code):
            yield f"surromd {verb}", rest


def problem(command: str, rest: str, root: Path) -> str | None:
    """Return what is wrong with a command, or None."""
    program, _, name = command.partition(" ")
    if program == "surromd":
        return _problem_of_verb(name, rest)
    if name.startswith("-m "):
        module = name[3:]
        if module.split(".")[0] not in ("systems", "md_reference", "surrogate"):
            return None
        path = root / (module.replace(".", "/") + ".py")
    else:
        path = root / name
    if not path.is_file():
        return f"{path} does not exist"
    tree = ast.parse(path.read_text())
    # Studies of one folder may share their command line.
    imported = [path.with_name(f"{n.module}.py") for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    trees = [tree, *(ast.parse(p.read_text()) for p in imported if p.is_file())]
    known = {node.value for t in trees for node in ast.walk(t) if isinstance(node, ast.Constant)}
    unknown = [flag for flag in _FLAG.findall(rest) if flag not in known]
    return f"{name} knows no {unknown[0]}" if unknown else None


def _problem_of_verb(verb: str, rest: str) -> str | None:
    known = _flags_of_verbs()
    if verb.startswith("-"):
        return None if verb in known[""] else f"surromd knows no {verb}"
    words = rest.split()
    name = next((f"{verb} {word}" for word in words[:1] if f"{verb} {word}" in known), verb)
    if name not in known:
        return f"surromd has no verb {verb}"
    unknown = [flag for flag in _FLAG.findall(rest) if flag not in known[name]]
    return f"surromd {name} knows no {unknown[0]}" if unknown else None


@cache
def _flags_of_verbs() -> dict[str, frozenset[str]]:
    from surrogate.cli.main import app

    found: dict[str, frozenset[str]] = {}

    def collect(name: str, command: Any) -> None:
        flags = {flag for p in command.params for flag in (*p.opts, *p.secondary_opts)}
        found[name] = frozenset(flags | {"--help", "-h"})
        for sub, child in getattr(command, "commands", {}).items():
            collect(f"{name} {sub}".strip(), child)

    collect("", typer.main.get_command(app))
    return found


def test_every_command_that_is_named_exists(repository: Path) -> None:
    found = {
        f"{path.relative_to(repository)}: {command}{rest}": wrong
        for path in documents(repository)
        for command, rest in commands(text_of(path))
        if (wrong := problem(command, rest, repository)) is not None
    }
    assert not found


def test_commands_are_found_at_all(repository: Path) -> None:
    named = {command for path in documents(repository) for command, _ in commands(text_of(path))}
    assert {"surromd reference", "surromd rollout", "surromd compare", "surromd bench", "surromd stress"} <= named
    assert sum(command.startswith("python docs/studies") for command in named) > 10


def test_a_command_that_does_not_exist_would_be_noticed(repository: Path, tmp_path: Path) -> None:
    text = """
Prose: surromd makes trajectories. `surromd simulate ala.pdb` and `python docs/studies/comparison/nothing.py REF`.

```bash
surromd rollout ala2.pdb --wieghts alanine-dipeptide
surromd bench cost-error A B --weights alanine-dipeptide
python -m surrogate.bench.nothing
```
"""
    wrong = [problem(command, rest, repository) for command, rest in commands(text)]
    assert len(wrong) == 5
    assert [str(w).split(" ", 1)[1] for w in wrong if w and w.startswith("surromd")] == [
        "has no verb simulate",
        "rollout knows no --wieghts",
    ]
    assert sum("does not exist" in str(w) for w in wrong) == 2 and wrong.count(None) == 1
