"""`surromd reference` with its ensembles, and `surromd bench`, as a user types them."""

from __future__ import annotations

from pathlib import Path

import pytest

from command_line import run
from systems.trajectory.codec import open_trajectory

FAST = ("--time", "0.4ps", "--save-every", "0.02ps", "--timestep", "1fs", "--hydrogen-mass", "natural", "--solvent",
        "vacuum")  # fmt: skip


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    # The library's protocol equilibrates for longer than a test may take.
    from md_reference.run import config

    shortened = config.defaults() | {"equilibrate_ps": 0.2}
    monkeypatch.setattr(config, "defaults", lambda: shortened)
    return tmp_path


def test_a_run_says_its_plan_first_and_its_summary_last(here: Path) -> None:
    result = run("reference", "alanine-dipeptide", *FAST, "--ensemble", "nve", "--save-velocities", "-o", "a.h5")
    assert result.exit_code == 0, result.output
    assert "velocity Verlet, 1 fs, no bath" in result.stderr
    assert "Reference on 1 thread" in result.stderr
    assert "temperature" in result.stdout and "kJ/mol/ns per degree of freedom" in result.stdout
    assert "bath 300 K" not in result.stdout
    with open_trajectory(here / "a.h5") as reader:
        velocities = reader.read_velocities()
        assert velocities is not None and velocities.shape == (20, 22, 3)
        assert reader.read_forces() is None
    in_bath = run("reference", "alanine-dipeptide", *FAST, "-o", "b.h5")
    assert "(bath 300 K)" in in_bath.stdout and "drifts" not in in_bath.stdout
    silent = run("reference", "alanine-dipeptide", *FAST, "-o", "b.h5", "--overwrite", "--equilibrate", "50fs", "-q")
    for name, equilibrate_ps in (("a.h5", 0.2), ("b.h5", 0.05)):
        with open_trajectory(here / name) as reader:
            assert reader.record["equilibrate_ps"] == equilibrate_ps
    assert not silent.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["-o", "a.dcd", "--save-forces"], "write an .h5 to keep forces"),
        (["-o", "a.h5", "--ensemble", "npt"], "no periodic cell"),
        (["-o", "a.h5", "--ensemble", "nvve"], "Did you mean 'nve'"),
    ],
)
def test_what_cannot_be_is_one_line_before_anything_runs(here: Path, arguments: list[str], said: str) -> None:
    result = run("reference", "alanine-dipeptide", *FAST, *arguments)
    assert result.exit_code == 1
    assert said in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not list(here.iterdir())
