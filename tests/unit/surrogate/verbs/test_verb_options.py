"""The options of a reference run: one list for Python, the command line, campaigns and the settings themselves."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import surrogate
from md_reference.campaign.campaign_file import SETTINGS, read_settings
from md_reference.run.config import defaults
from surrogate import api
from surrogate.cli import main
from surrogate.verbs.options import PlanOptions, ReferenceOptions, RolloutOptions
from systems.library.named_scenes import prepare
from systems.options import Preparation, options_of

FLAGS = {name: each for name, each in options_of(PlanOptions).items() if name != "time_ps"}
# How many runs there are, whose settings, and what makes the box: no fields of MDConfig or ForceFieldSpec.
ELSEWHERE = {"replicas", "level", "protocol", "padding_nm", "ionic_strength_molar"}
TYPED = {
    "force_field": ("ff19SB", "ff19SB"),
    "solvent": ("opc", "opc"),
    "level": ("mm", "mm"),
    "protocol": ("md17", "md17"),
    "padding_nm": ("12A", 1.2),
    "ionic_strength_molar": ("150mM", 0.15),
    "temperature_k": ("310K", 310.0),
    "friction_per_ps": ("0.1/fs", 100.0),
    "timestep_ps": ("2fs", 0.002),
    "hydrogen_mass_da": ("natural", None),
    "equilibrate_ps": ("0ps", 0.0),
    "ensemble": ("npt", "npt"),
    "pressure_bar": ("2.5", 2.5),
    "replicas": ("3", 3),
    "platform": ("CPU", "CPU"),
    "ph": ("5", 5.0),
    "keep_ligand": (None, True),
    "drop_ligand": (None, True),
    "drop_water": (None, True),
    "cap_breaks": (None, True),
    "starts": ("one", "one"),
    "keep_water": (None, True),
}


def called(monkeypatch: pytest.MonkeyPatch, verb: str, arguments: list[str]) -> dict[str, Any]:
    """Return the keywords that a command gives to its verb."""
    seen: dict[str, Any] = {}

    def spy(*_: Any, **keywords: Any) -> Any:
        seen.update(vars(keywords["options"]))
        return {} if verb == "plan" else []

    monkeypatch.setattr(api, verb, spy)
    result = CliRunner().invoke(main.app, [verb, *arguments])
    assert result.exit_code == 0, result.output
    return seen


ARGUMENTS = {
    "plan": ["ethanol"],
    "reference": ["ethanol", "--time", "1ps", "-o", "x.h5"],
    "rollout": ["ethanol", "--weights", "w", "--time", "1ps", "-o", "x.h5"],
}


@pytest.mark.parametrize("verb", ["plan", "reference"])
def test_every_flag_arrives_in_our_units(monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    assert set(TYPED) == set(FLAGS)
    typed = [word for name, (text, _) in TYPED.items() for word in (FLAGS[name].flags[0], text) if word is not None]
    seen = called(monkeypatch, verb, [*ARGUMENTS[verb], *typed])
    assert {name: seen[name] for name in FLAGS} == pytest.approx({name: value for name, (_, value) in TYPED.items()})


@pytest.mark.parametrize(
    ("verb", "options"), [("plan", PlanOptions), ("reference", ReferenceOptions), ("rollout", RolloutOptions)]
)
def test_a_flag_left_out_is_the_keyword_left_out(monkeypatch: pytest.MonkeyPatch, verb: str, options: Any) -> None:
    stated = inspect.signature(getattr(surrogate, verb)).parameters
    seen = called(monkeypatch, verb, ARGUMENTS[verb])
    for name in options_of(options):
        given = 1.0 if name == "time_ps" and verb != "plan" else stated[name].default
        assert seen[name] == given, name
        assert stated[name].kind is inspect.Parameter.KEYWORD_ONLY
    assert not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in stated.values())


def test_a_run_warns_as_its_plan_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    natural = {"hydrogen_mass_da": None, "timestep_ps": "4fs"}
    (warning,) = surrogate.plan("ACE-ALA-NME", **natural)["warnings"]
    what = warning.partition(";")[0]  # advice names options as Python or the command line do
    surrogate.reference("ACE-ALA-NME", tmp_path / "a.h5", time_ps="1ps", equilibrate_ps="0.1ps", **natural)
    assert what == "4 fs is too long for hydrogens of natural mass"
    assert capsys.readouterr().err.count(f"warning: {what}") == 1


def test_a_keyword_that_is_none_is_refused_before_anything_else() -> None:
    with pytest.raises(TypeError, match=r"reference\(\) .*tempeature_k"):
        surrogate.reference("no such scene", "x.h5", time_ps=1.0, tempeature_k=300.0)
    with pytest.raises(TypeError, match=r"reference\(\) .*time_ps"):
        surrogate.reference("no such scene", "x.h5")


def test_the_verbs_own_documentation_stays() -> None:
    assert "counter-ions" in (surrogate.reference.__doc__ or "")
    assert surrogate.rollout.__name__ == "rollout"


def test_settings_and_campaigns_have_the_same_names_and_the_help_their_defaults() -> None:
    known = defaults()
    switches = inspect.signature(prepare).parameters
    for name, flag in FLAGS.items():
        if name in ELSEWHERE:
            continue
        key = flag.key
        if name in Preparation.__annotations__:
            assert (key, flag.default) == (name, switches[name].default)
            continue
        assert SETTINGS[key].name == name
        text = flag.shown_default
        if flag.default is not None and flag.default != "default":
            assert flag.default == known[name], name
            continue
        value = flag.reader(text, name) if flag.reader else type(known[name])(text)
        assert value == pytest.approx(known[name]), name
        assert read_settings({key: text})


def test_another_default_in_the_help_would_be_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = {**defaults(), "timestep_ps": 0.002}
    monkeypatch.setattr(f"{__name__}.defaults", lambda: wrong)
    with pytest.raises(AssertionError, match="timestep_ps"):
        test_settings_and_campaigns_have_the_same_names_and_the_help_their_defaults()


def test_help_shows_the_defaults() -> None:
    """In brackets, which the library that prints help takes for markup and swallows unless they are escaped."""
    wide = {"COLUMNS": "200", "TERM": "dumb"}
    shown = " ".join(CliRunner().invoke(main.app, ["reference", "--help"], env=wide).output.split())
    for text in (
        "Integration time step. [default: 4fs]",
        "Thermostat temperature. [default: 300K]",
        "saved frames. [default: 1ps]",
    ):
        assert text in shown
    assert "\\[" not in shown


def test_no_help_text_loses_its_brackets() -> None:
    from rich.text import Text
    from typer.main import get_command

    def helps(command: Any) -> list[str]:
        own = [p.help for p in command.params if getattr(p, "help", None)]
        return own + [text for sub in getattr(command, "commands", {}).values() for text in helps(sub)]

    found = helps(get_command(main.app))
    lost = [text for text in found if Text.from_markup(text).plain != text.replace("\\[", "[")]
    assert len(found) > 100 and not lost, lost
    # Negative control: what an unescaped default comes to.
    assert Text.from_markup("Step. [default: 4fs]").plain == "Step. "
