"""A verb that is ended while another program computes charges leaves neither that program nor its folder behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from process_table import needs_process_table, processes_with, runs, wait_until

SURROMD = [sys.executable, "-m", "surrogate.cli.main"]


@pytest.fixture
def slow_charges(tmp_path: Path) -> dict[str, str]:
    """An environment with an AmberTools whose sqm, as a child of antechamber, takes for ever."""
    home = tmp_path / "bin"
    home.mkdir()
    (home / "antechamber").write_text("#!/bin/sh\nsh -c sqm\n")
    (home / "sqm").write_text(
        f"#!/bin/sh\necho $$ > {tmp_path}/new\nmv {tmp_path}/new {tmp_path}/sqm\nexec sleep 1000\n"
    )
    for name in ("parmchk2", "tleap"):
        (home / name).write_text("#!/bin/sh\nexit 1\n")
    for program in home.iterdir():
        program.chmod(0o755)
    (tmp_path / "tmp").mkdir()
    return os.environ | {
        "PATH": f"{home}{os.pathsep}{os.environ['PATH']}",
        "TMPDIR": str(tmp_path / "tmp"),
        "SURROMD_CACHE": str(tmp_path / "cache"),
        "SURROMD_TEST": str(tmp_path),
        "PYTHONPATH": str(Path(__file__).parents[2]),
    }


@needs_process_table
@pytest.mark.parametrize(
    ("number", "arguments"),
    [
        (signal.SIGTERM, ["plan", "smiles:CCCCCCOCCCO"]),
        (signal.SIGHUP, ["reference", "smiles:CCCCCCOCCCO", "--time", "1ps", "-o", "x.h5"]),
        (signal.SIGKILL, ["plan", "smiles:CCCCCCOCCCO"]),
    ],
    ids=["SIGTERM", "SIGHUP", "kill -9"],
)
def test_nothing_is_left_of_charges_being_computed(
    tmp_path: Path, slow_charges: dict[str, str], number: signal.Signals, arguments: list[str]
) -> None:
    mark = f"SURROMD_TEST={tmp_path}"
    process = subprocess.Popen(
        [*SURROMD, *arguments], cwd=tmp_path, env=slow_charges, stderr=subprocess.PIPE, text=True
    )
    try:
        wait_until((tmp_path / "sqm").exists, "sqm was not started")
        sqm = int((tmp_path / "sqm").read_text())
        assert runs(sqm) and list((tmp_path / "tmp").glob("surromd-gaff-*")), "what is looked for can be found"
        process.send_signal(number)
        said = process.communicate()[1]
    finally:
        process.kill()
    assert process.returncode == (-signal.SIGKILL if number == signal.SIGKILL else 130), said
    assert "Traceback" not in said
    wait_until(lambda: not runs(sqm), "sqm outlives the verb")
    wait_until(lambda: not processes_with(mark), f"there remain {processes_with(mark)}")
    wait_until(lambda: not list((tmp_path / "tmp").glob("surromd-*")), "the folder is left")
    assert not (tmp_path / "x.h5").exists()


@needs_process_table
@pytest.mark.slow
def test_verbs_ended_at_three_moments_leave_nothing(repository: Path) -> None:
    """A part of the table that docs/studies/reference/endings.py prints for all verbs at ten moments."""
    study = [
        sys.executable,
        str(repository / "docs" / "studies" / "reference" / "endings.py"),
        "--moments",
        "3",
        "--longest",
        "15",
    ]
    verbs = ["plan", "reference x 2", "campaign", "train", "rollout", "compare"]
    table = subprocess.run(
        [*study, *(word for verb in verbs for word in ("--verb", verb))], capture_output=True, text=True, check=False
    )
    assert table.returncode == 0, table.stdout + table.stderr
