"""Rules of the source tree that neither ruff nor import-linter checks. Each has a negative control."""

from __future__ import annotations

import ast
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import grimp
import networkx as nx
import pytest

PACKAGES = ("systems", "md_reference", "surrogate")
MOST_PARAMETERS = 8
# What every architecture or room has one of.
COMMON_NAMES = {"__init__", "architecture", "config", "model", "base", "choices", "trainer"}

# May only become shorter: a line goes when what it names is mended.
MANY_PARAMETERS = {
    "surrogate/sampling/runner.py:rollout": "callbacks beside the settings",
}


def sources(root: Path) -> list[Path]:
    """Return the files of code below `root`: the packages and the studies."""
    return sorted(f for top in (*PACKAGES, "docs/studies") for f in (root / top).rglob("*.py"))


def repeated_names(root: Path) -> dict[str, list[Path]]:
    found: dict[str, list[Path]] = {}
    for package in PACKAGES:
        by_name: dict[str, list[Path]] = defaultdict(list)
        for file in (root / package).rglob("*.py"):
            by_name[file.stem].append(file)
        found |= {n: files for n, files in by_name.items() if len(files) > 1 and n not in COMMON_NAMES}
    return found


def wide_functions(file: Path) -> Iterator[str]:
    """Yield the functions of a file that take more parameters than a reader keeps in mind."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            names = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            if len(names) - (names[:1] in (["self"], ["cls"])) > MOST_PARAMETERS:
                yield node.name


def circles(*packages: str) -> list[list[str]]:
    """Return the groups of modules that import each other, imports inside functions and for types alone included."""
    graph = grimp.build_graph(*packages, exclude_type_checking_imports=False, cache_dir=None)
    edges = ((m, other) for m in graph.modules for other in graph.find_modules_directly_imported_by(m))
    return sorted(sorted(group) for group in nx.strongly_connected_components(nx.DiGraph(edges)) if len(group) > 1)


def test_no_name_stands_twice_in_a_package(repository: Path, tmp_path: Path) -> None:
    assert not repeated_names(repository)
    for room in ("surrogate/data", "surrogate/comparison"):
        (tmp_path / room).mkdir(parents=True)
        (tmp_path / room / "frames.py").touch()
        (tmp_path / room / "config.py").touch()
    assert list(repeated_names(tmp_path)) == ["frames"]


def test_a_function_has_at_most_eight_parameters(repository: Path, tmp_path: Path) -> None:
    found = {f"{file.relative_to(repository)}:{name}" for file in sources(repository) for name in wide_functions(file)}
    assert found == MANY_PARAMETERS.keys()
    (tmp_path / "wide.py").write_text(
        "class A:\n"
        "    def fits(self, a, b, c, d, *, e, f, g, h): ...\n"
        "    def is_wide(self, a, b, c, d, *, e, f, g, h, i): ...\n"
    )
    assert list(wide_functions(tmp_path / "wide.py")) == ["is_wide"]


def test_no_modules_import_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not circles(*PACKAGES)
    room = tmp_path / "circular_example"
    room.mkdir()
    (room / "__init__.py").touch()
    (room / "first.py").write_text("from circular_example.second import b\n\na = b\n")
    (room / "second.py").write_text("def b():\n    from circular_example import first\n\n    return first.a\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert circles("circular_example") == [["circular_example.first", "circular_example.second"]]


def untyped(root: Path) -> set[str]:
    """Return the packages whose annotations a type checker of other people does not see: installed without py.typed."""
    data = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    return {p for p in PACKAGES if "py.typed" not in data.get(p, []) or not (root / p / "py.typed").is_file()}


def test_every_package_is_typed_where_it_is_installed(repository: Path, tmp_path: Path) -> None:
    assert not untyped(repository)
    (tmp_path / "systems").mkdir()
    (tmp_path / "systems" / "py.typed").touch()
    (tmp_path / "pyproject.toml").write_text('[tool.setuptools.package-data]\nsystems = ["py.typed"]\n')
    assert untyped(tmp_path) == {"md_reference", "surrogate"}
