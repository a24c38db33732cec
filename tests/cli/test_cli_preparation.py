"""Options of the command line that say how a SCENE is prepared."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from surrogate.cli.main import app
from systems.library import named_scenes
from systems.trajectory.companion_writer import pdb_text

RUNNER = CliRunner()
WATER = "HETATM  900  O   HOH A 101      20.000  20.000  20.000  1.00  0.00           O\n"
CHLORIDE = "HETATM  920 CL    CL A 301      30.000  30.000  20.000  1.00  0.00          CL\n"


@pytest.fixture
def wet(tmp_path: Path) -> str:
    text = pdb_text(named_scenes.load("alanine-dipeptide"))
    atoms = [line for line in text.splitlines(keepends=True) if line.startswith("ATOM")]
    path = tmp_path / "wet.pdb"
    path.write_text("".join(atoms) + CHLORIDE + WATER + "END\n")
    return str(path)


@pytest.mark.parametrize("verb", ["plan", "reference", "rollout"])
def test_bound_ions_wait_for_a_word_in_every_verb(tmp_path: Path, wet: str, verb: str) -> None:
    extra = {
        "plan": [],
        "reference": ["--time", "1ps", "-o", str(tmp_path / "x.h5")],
        "rollout": ["--weights", "alanine-dipeptide", "--time", "1ns", "-o", str(tmp_path / "x.h5")],
    }[verb]
    path = Path(wet)
    oxygen = named_scenes.load("alanine-dipeptide").positions_nm[5] * 10  # of the cap's carbonyl
    place = "".join(f"{x:8.3f}" for x in oxygen + (0.0, 0.0, 2.9))
    path.write_text(path.read_text().replace("  30.000  30.000  20.000", place))
    refused = RUNNER.invoke(app, [verb, wet, *extra])
    assert refused.exit_code == 1 and refused.stderr.count("\n") == 1
    assert "CL A301" in refused.stderr and "--keep-ligand" in refused.stderr and "--drop-ligand" in refused.stderr
    refused = RUNNER.invoke(app, [verb, wet, *extra, "--keep-water", "--drop-water"])
    assert "exclude each other" in refused.stderr
    refused = RUNNER.invoke(app, [verb, wet, *extra, "--keep-ligand", "--drop-ligand"])
    assert "exclude each other" in refused.stderr
    assert RUNNER.invoke(app, [verb, wet, *extra, "--ph", "15"]).exit_code == 2
    assert not (tmp_path / "x.h5").exists()


def test_what_was_left_out_is_said_once_a_line(tmp_path: Path, wet: str) -> None:
    done = RUNNER.invoke(app, ["plan", wet, "--json"])
    assert done.exit_code == 0
    assert done.stderr == f"{wet}: 1 water molecule and free ion CL left out\n"
    refused = RUNNER.invoke(app, ["plan", wet, "--keep-water"])
    assert refused.exit_code == 1 and "--keep-water needs an explicit solvent" in refused.stderr
