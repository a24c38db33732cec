"""Options declared once: what Python, the command line, files and tables make of them, and what each refuses."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from surrogate.cli.main import with_options
from surrogate.cli.render import as_flags
from systems.errors import InputError, UnitError, UnknownNameError
from systems.options import (
    MissingOptionError,
    check_options,
    gather,
    option,
    options_as_keywords,
    options_of,
)


@dataclass(frozen=True, kw_only=True)
class Timing:
    time_ps: float = option("Simulated time.")
    save_every_ps: float | None = option("Between frames.", None, unset="1ps")


@dataclass(frozen=True, kw_only=True)
class Settings(Timing):
    temperature_k: float = option("Of the bath.", 300.0)
    guard: str = option("What is done.", "flag", choices=("flag", "repair"))
    replicas: int = option("Side by side.", 1, within=(1, 8))
    lags_ps: Sequence[float] | None = option("Repeatable.", None)
    start_from: str | None = option("Weights.", None, words=("from", "f"))
    labels: str | None = option("For people.", None, words=None)
    solver_steps: int = option("A chunk.", 10, section="sampling")
    quiet: bool = option("No bar.", False)


SEEN: list[Any] = []


@options_as_keywords(Settings)
def verb(scene: str, options: Settings) -> Settings:
    """Do something."""
    return options


def command(scene: str, options: Settings) -> None:
    """Do something."""
    SEEN.append(options)


def typed(*words: str) -> Any:
    app = typer.Typer()
    app.command()(with_options(command))
    return CliRunner().invoke(app, list(words))


def test_python_and_the_command_line_come_to_the_same(tmp_path: Path) -> None:
    asked = verb("x", time_ps="2ns", save_every_ps=0.5, guard="repair", replicas=np.int64(3), lags_ps=["1ps", 2],
                 start_from="w")  # fmt: skip
    result = typed("x", "--time", "2ns", "--save-every", "500fs", "--guard", "repair", "--replicas", "3", "--lags",
                   "1ps", "--lags", "2ps", "-f", "w")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert SEEN.pop() == asked == verb("x", options=asked)
    assert (asked.time_ps, asked.save_every_ps, asked.lags_ps) == (2000.0, 0.5, [1.0, 2.0])


def test_a_file_says_the_same_and_what_is_given_comes_before_it(tmp_path: Path) -> None:
    file = tmp_path / "run.toml"
    file.write_text('time = "2ns"\nguard = "repair"\nfrom = "w"\nlabels = "a"\ntemperature = 310\nlags = ["1ps"]\n'
                    "[sampling]\nsolver-steps = 4\n")  # fmt: skip
    asked = verb("x", config=file)
    assert (asked.time_ps, asked.guard, asked.start_from, asked.labels) == (2000.0, "repair", "w", "a")
    assert (asked.temperature_k, asked.lags_ps, asked.solver_steps) == (310.0, [1.0], 4)
    assert verb("x", config=file, guard="flag", solver_steps=5).solver_steps == 5
    assert typed("x", "--config", str(file), "--time", "1ps").exit_code == 0
    assert SEEN.pop() == verb("x", config=file, time_ps=1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tiem = '1ps'", "unknown key 'tiem'. Did you mean 'time'?"),
        ("time_ps = '1ps'", "Did you mean 'time'?"),
        ("time = 10", "time '10' has no unit"),
        ("time = true", "time = True must be a number in ps"),
        ("replicas = '3'", "replicas = '3' must be a whole number"),
        ("replicas = 9", "replicas 9 must be at most 8"),
        ("guard = 'repare'", "Did you mean 'repair'?"),
        ("solver_steps = 3", "It stands in [sampling]."),
        ("[sampling]\nguard = 'flag'", "It stands before the first table."),
        ("sampling = 3", "sampling is a table"),
        ("quiet = 'yes'", "quiet = 'yes' must be true or false"),
        ("time = ", "is not valid TOML"),
    ],
)
def test_what_a_file_may_not_say(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(InputError) as refusal:
        gather(Settings, {"time_ps": 1.0}, file=tmp_path / "bad.toml")
    assert said in str(refusal.value) and "bad.toml" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_what_python_may_not_say() -> None:
    with pytest.raises(TypeError, match=r"verb\(\) .*'tiem_ps'.* Did you mean 'time_ps'"):
        verb("x", tiem_ps=1.0)
    with pytest.raises(TypeError, match=r"verb\(\) needs time_ps: Simulated time"):
        verb("x")
    with pytest.raises(TypeError, match=r"verb\(\) .*'scene'"):
        verb(time_ps=1.0)
    with pytest.raises(TypeError, match="options must be a Settings"):
        verb("x", options=Timing(time_ps=1.0))
    for wrong, kind in (
        ({"time_ps": "10"}, UnitError),
        ({"time_ps": -1.0}, UnitError),
        ({"guard": "repare"}, UnknownNameError),
        ({"replicas": 0}, InputError),
        ({"replicas": True}, InputError),
        ({"replicas": 1.5}, InputError),
        ({"quiet": 1}, InputError),
    ):
        with pytest.raises(kind, match=next(iter(wrong))):
            verb("x", **{"time_ps": 1.0} | wrong)


def test_what_the_command_line_may_not_say() -> None:
    assert typed("x").exit_code == 2
    assert "needs --time: Simulated time" in " ".join(typed("x").output.split())
    for words in (["--guard", "repare"], ["--replicas", "9"], ["--labels", "a"], ["--solver-steps", "3"]):
        assert typed("x", "--time", "1ps", *words).exit_code == 2
    refused = typed("x", "--time", "10")
    assert isinstance(refused.exception, UnitError) and "--time '10' has no unit" in str(refused.exception)
    assert not SEEN


def test_a_signature_lists_them_with_their_documentation() -> None:
    shown = inspect.signature(verb).parameters
    assert list(shown)[:3] == ["scene", "temperature_k", "guard"], "its own before those of its base"
    assert list(shown).index("time_ps") > list(shown).index("quiet")
    assert list(shown)[-2:] == ["options", "config"]
    assert shown["time_ps"].default is inspect.Parameter.empty and shown["temperature_k"].default == 300.0
    text = inspect.getdoc(verb) or ""
    assert text.startswith("Do something.")
    assert "temperature_k (K, default 300K)\n    Of the bath." in text and "time_ps (ps, required)" in text
    assert "guard (flag | repair, default flag)" in text


def test_what_a_table_of_the_manual_shows() -> None:
    found = options_of(Settings)
    assert (found["time_ps"].flags, found["time_ps"].unit, found["time_ps"].required) == (("--time",), "ps", True)
    assert (found["start_from"].flags, found["start_from"].key) == (("--from", "-f"), "from")
    assert (found["solver_steps"].flags, found["solver_steps"].section) == ((), "sampling")
    assert found["save_every_ps"].shown_default == "1ps" and found["guard"].choices == ("flag", "repair")


def test_a_dataclass_made_by_hand_can_be_checked() -> None:
    check_options(Settings(time_ps=1.0))
    with pytest.raises(UnknownNameError, match="choose flag or repair"):
        check_options(Settings(time_ps=1.0, guard="repare"))
    with pytest.raises(MissingOptionError):
        gather(Settings, {})


def test_messages_name_options_in_the_words_of_who_asks() -> None:
    told = "add `overwrite=True`, use `timestep_ps='1fs'`, leave `start_from` out, try `precision='fp32'`; see `x info`"
    assert as_flags(told) == (
        'add --overwrite, use --timestep 1fs, leave --from out, try precision = "fp32" in [sampling] of --config; '
        "see `x info`"
    )


# CSS variables, switches of other programs, and modules that are commands of their own.
_NO_FLAGS_OF_OURS = re.compile(r"var\(--|--preload|--no-dashboard")


def flags_outside(repository: Path) -> list[str]:
    """Return the lines outside the command line that name a flag."""
    found = []
    for package in ("systems", "md_reference", "surrogate"):
        for path in sorted((repository / package).rglob("*.py")):
            text = path.read_text()
            if "surrogate/cli/" in path.as_posix() or "import argparse" in text:
                continue
            found += [f"{path.relative_to(repository)}: {line.strip()}" for line in text.splitlines()
                      if re.search(r"(?<![\w-])--[a-z]", line) and not _NO_FLAGS_OF_OURS.search(line)]  # fmt: skip
    return found


def test_no_flag_stands_outside_the_command_line(repository: Path, tmp_path: Path) -> None:
    assert not flags_outside(repository)
    (tmp_path / "systems").mkdir()
    (tmp_path / "systems" / "wrong.py").write_text('raise InputError("exists; add --overwrite.")\n')
    assert len(flags_outside(tmp_path)) == 1
