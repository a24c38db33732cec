"""`surromd systems`, and protocols in `plan` and `reference`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from command_line import run
from systems.library import named_scenes
from systems.trajectory.codec import open_trajectory


def test_systems_lists_every_scene_in_its_group() -> None:
    printed = run("systems").stdout
    lines = printed.splitlines()
    for group, names in named_scenes.groups().items():
        start = lines.index(group) + 1
        assert [line.split()[0] for line in lines[start : start + len(names)]] == names
    assert "ACE-ALA-GLY-NME" in printed  # what can be had besides
    listed = json.loads(run("systems", "--json").stdout)
    assert [entry["name"] for entry in listed] == [name for names in named_scenes.groups().values() for name in names]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("uracil", ["md17", "gaff2", "500", "0.0005", "natural"]),
        ("double-well", ["barrier_kj_mol", "minimum_nm", "this program's own"]),
        ("SDFS", ["SER-ASP-PHE-SER", "mdgen", "gbn2", "350"]),
    ],
)
def test_systems_shows_a_scene_with_its_protocols_or_its_own_settings(name: str, words: list[str]) -> None:
    printed = run("systems", name).stdout
    for word in words:
        assert word in printed
    described = json.loads(run("systems", name, "--json").stdout)[0]
    assert list(described["protocols"]) == list(named_scenes.entry(name).protocols)
    assert described.get("settings", {}) == named_scenes.entry(name).own_settings


def test_plan_takes_the_protocol_and_says_so() -> None:
    assert "300 K" in json.loads(run("plan", "ethanol", "--json").stdout)["integrator"]
    told = json.loads(run("plan", "ethanol", "--protocol", "md17", "--json").stdout)
    assert "500K" in told["protocol"]
    assert (told["force_field"], told["solvent"], told["constraints"]) == ("gaff2", "vacuum", "none")
    assert "0.5 fs" in told["integrator"]
    assert "500 K" in told["integrator"]
    asked = ("--protocol", "md17", "--temperature", "300K", "--timestep", "2fs")
    other = json.loads(run("plan", "ethanol", *asked, "--json").stdout)
    assert "2 fs, 300 K" in other["integrator"]
    assert "temperature" not in other["protocol"]
    assert other["constraints"] == "6 bonds to hydrogen"
    assert "protocol" not in json.loads(run("plan", "alanine-dipeptide", "--json").stdout)
    moved = json.loads(run("plan", "double-well", "--ensemble", "nve", "--json").stdout)
    assert moved["integrator"] == "velocity Verlet, 10 fs, no bath (started at 300 K)"


def test_reference_takes_a_model_system_s_own_settings_and_says_so(tmp_path: Path) -> None:
    out = tmp_path / "a.h5"
    result = run("reference", "double-well", "--ensemble", "nve", "--time", "1ps", "-o", str(out))
    assert result.exit_code == 0, result.output
    assert "time step 10 fs" in result.stderr or "10 fs" in result.stderr
    with open_trajectory(out) as reader:
        record = reader.record
        assert reader.n_frames == 10
    assert (record["ensemble"], record["timestep_ps"], record["save_every_ps"]) == ("nve", 0.01, 0.1)
    assert record["integrator"] == "VelocityVerlet"
    quiet = run("reference", "harmonic-oscillator", "--time", "1ps", "--temperature", "400K", "-o",
                str(tmp_path / "b.h5"), "--quiet")  # fmt: skip
    assert quiet.exit_code == 0, quiet.output
    assert quiet.stderr == ""
    with open_trajectory(tmp_path / "b.h5") as reader:
        assert (reader.record["temperature_k"], reader.record["timestep_ps"]) == (400.0, 0.01)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["systems", "asprin"], "Did you mean 'aspirin'?"),
        (["plan", "aspirin", "--temperature", "hot"], "--temperature"),
        (["plan", "aspirin", "--protocol", "md71"], "Did you mean 'md17'?"),
        (["plan", "double-well", "--protocol", "md17"], "leave --protocol out"),
        (["plan", "double-well", "--force-field", "ff14SB"], "its own potential"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments: list[str], said: str) -> None:
    result = run(*arguments)
    assert result.exit_code == 1
    assert said in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
