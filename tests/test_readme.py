"""README: what it shows works as it stands, what it points to is there, and it stays short."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

MOST_BYTES, LARGEST_FIGURE = 7_000, 200_000
# What .ci/run does itself: installing, this test suite, the manual.
ELSEWHERE = re.compile(r"^pip install \S+( && (pytest|sphinx-build .*))?$|^pip install \S+ && ", re.MULTILINE)
LINK = re.compile(r"\]\(([^)#]+)\)")


def blocks(text: str, language: str) -> list[str]:
    """Return the code blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def broken_links(text: str, root: Path) -> list[str]:
    """Return the links of a page that lead to no file of the repository."""
    found = LINK.findall(text)
    return [link for link in found if "://" not in link and not (root / link).exists()]


def test_it_is_short(repository: Path) -> None:
    assert len((repository / "README.md").read_bytes()) < MOST_BYTES


def test_its_links_and_figures_are_there(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert broken_links(text, repository) == []
    assert broken_links(text + "[gone](docs/gone.md)", repository) == ["docs/gone.md"]
    figures = [repository / link for link in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)]
    assert len(figures) == 2
    assert all(figure.stat().st_size < LARGEST_FIGURE for figure in figures)


def test_only_what_ci_does_itself_is_left_out(repository: Path) -> None:
    shell = blocks((repository / "README.md").read_text(encoding="utf-8"), "sh")
    left = [line for block in shell for line in ELSEWHERE.sub("", block).splitlines() if line and line[0] != "#"]
    assert [line.split()[:2] for line in left] == [
        ["surromd", verb] for verb in ("demo", "run", "reference", "rollout", "compare")
    ]


def programs() -> list[list[str]]:
    """Return README's blocks as commands, without what CI runs itself."""
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    shell = [ELSEWHERE.sub("", block).strip() for block in blocks(text, "sh")]
    return [
        *(["bash", "-euo", "pipefail", "-c", block] for block in shell if block),
        *([sys.executable, "-c", block] for block in blocks(text, "python")),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("program", programs(), ids=["demo", "your own molecule", "the three jobs", "python"])
def test_its_code_runs(tmp_path: Path, program: list[str]) -> None:
    search = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(program, cwd=tmp_path, env={**os.environ, "PATH": search}, capture_output=True, text=True)
    assert done.returncode == 0, f"{program[-1]}\n{done.stdout}\n{done.stderr}"
    assert list(tmp_path.rglob("report.html"))
