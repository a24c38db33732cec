"""The command line from outside: start-up time, exit codes, one clear line for every bad input, nothing left behind."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from command_line import refused, run
from surrogate import api
from systems.errors import SurromdError
from systems.library.named_scenes import load
from systems.trajectory.companion_writer import pdb_text

COMMANDS = ["demo", "run", "systems", "plan", "reference", "windows", "train", "rollout", "compare", "info"]
SURROMD = [sys.executable, "-m", "surrogate.cli.main"]
HEAVY = ["numpy", "torch", "openmm", "h5py", "mdtraj", "rdkit", "scipy", "matplotlib"]


# ---- starting ------------------------------------------------------------------------------------------------------


def test_help_takes_little_longer_than_that_of_a_program_of_one_command(tmp_path: Path) -> None:
    """Side by side, in processor time, so that a slow or busy machine makes no difference."""
    bare = tmp_path / "bare.py"
    bare.write_text("import typer\n\ndef only(name: str) -> None:\n    ...\n\ntyper.run(only)\n")
    spent: dict[str, list[float]] = {"ours": [], "bare": []}
    for _ in range(3):
        for name, program in (("ours", SURROMD), ("bare", [sys.executable, str(bare)])):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            done = subprocess.run([*program, "--help"], capture_output=True, text=True, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            spent[name].append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
            assert name == "bare" or all(command in done.stdout for command in COMMANDS)
    assert min(spent["ours"]) < 1.9 * min(spent["bare"]), f"{spent} s"


def test_starting_loads_no_heavy_library() -> None:
    code = f"import sys, surrogate.cli.main, surrogate; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_rollout_of_a_pdb_file_loads_no_library_that_it_does_not_need(tmp_path: Path) -> None:
    (tmp_path / "my.pdb").write_text(pdb_text(load("alanine-dipeptide")))
    arguments = ["rollout", str(tmp_path / "my.pdb"), "--time", "1ps", "-o", str(tmp_path / "out.h5"), "--quiet"]
    unneeded = ("openmm", "pdbfixer", "rdkit", "scipy", "mdtraj", "MDAnalysis", "matplotlib", "torch._dynamo")
    code = (
        f"import atexit, sys; atexit.register(lambda: print([m for m in {unneeded} if m in sys.modules]))\n"
        f"from surrogate.cli.main import main; sys.argv = ['surromd', *{arguments}]; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_help_of_a_campaign_shows_a_file() -> None:
    shown = run("campaign", "--help").stdout
    assert 'temperatures = ["300K", "350K"]' in shown
    assert "temperatures" not in run("reference", "--help").stdout, "control"


DUMP = "".join(
    f"ITEM: TIMESTEP\n{k}\nITEM: NUMBER OF ATOMS\n1\nITEM: BOX BOUNDS pp pp pp\n0 9\n0 9\n0 9\n"
    f"ITEM: ATOMS id type x y z\n1 1 1.0 2.0 {k}.0\n"
    for k in range(3)
)


@pytest.mark.parametrize("debug", ["0", "1"])
def test_warnings_of_other_libraries_do_not_reach_the_terminal(tmp_path: Path, debug: str) -> None:
    (tmp_path / "x.lammpsdump").write_text(DUMP)
    (tmp_path / "x.pdb").write_text(
        "HETATM    1 AR   AR  A   1       1.000   2.000   0.000  1.00  0.00          AR\nEND\n"
    )
    code = (
        "import sys, warnings; from surrogate.cli import main as cli; from systems.trajectory.codec import *\n"
        "def read():\n"
        "    reader = open_trajectory(cli.Path(sys.argv[1]), top=cli.Path(sys.argv[2]))\n"
        "    warnings.warn('our own'); reader.read(0, 2)\n"
        "cli.app = lambda **_: read(); cli.main()"
    )
    files = [str(tmp_path / "x.lammpsdump"), str(tmp_path / "x.pdb")]
    done = subprocess.run([sys.executable, "-c", code, *files], capture_output=True, text=True, check=True,
                          env={**os.environ, "SURROMD_DEBUG": debug})  # fmt: skip
    assert "our own" in done.stderr, "control"
    assert ("MDAnalysis" in done.stderr) == (debug == "1"), done.stderr


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ["no-such-command"],
        ["reference"],
        ["reference", "alanine-dipeptide", "--time", "1ns"],
        ["rollout", "alanine-dipeptide", "--no-such-flag"],
        ["reference", "alanine-dipeptide", "--time", "1ns", "-o", "x.h5", "--replicas", "0"],
        ["rollout", "x", "--weights", "w", "--time", "1ns", "-o", "x.h5", "--precision", "fp8"],
        ["rollout", "x", "--weights", "w", "--time", "1ns", "-o", "x.h5", "--guard", "repare"],
    ],
)
def test_bad_usage_exits_with_2(here: Path, arguments: list[str]) -> None:
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr
    assert not list(here.iterdir())


# ---- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["systems", "alanine-dipeptid"], "Did you mean 'alanine-dipeptide'?"),
        (["reference", "alanin-dipeptide", "--time", "1ps", "-o", "x.h5"], "Did you mean 'alanine-dipeptide'?"),
        (["reference", "missing.pdb", "--time", "1ps", "-o", "x.h5"], "missing.pdb"),
        (["reference", "alanine-dipeptide", "--time", "10", "-o", "x.h5"], "no unit"),
        (["reference", "alanine-dipeptide", "--time", "10 parsec", "-o", "x.h5"], "unknown unit"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "--temperature", "25C", "-o", "x.h5"], "--temperature"),
        (["reference", "alanine-dipeptide", "--time", "10ps", "--save-every", "3ps", "-o", "x.h5"], "whole multiple"),
        (["reference", "alanine-dipeptide", "--time", "10ps", "--timestep", "3fs", "-o", "x.h5"], "whole multiple"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.xyz"], ".h5 or .hdf5 or .dcd"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "no/such/x.h5"], "folder does not exist"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.h5", "--force-field", "ff14sb"], "ff14SB"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.h5", "--solvent", "obc"], "obc2"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.h5", "--ensemble", "npt"], "nvt"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.h5", "--platform", "Abacus"], "Reference"),
        (["reference", "alanine-dipeptide", "--time", "1ps", "-o", "x.h5", "--resume", "--overwrite"], "exclude"),
        (["reference", "sequence:ACE-XYZ-NME", "--time", "1ps", "-o", "x.h5"], "XYZ"),
        (["info", "missing.h5"], "missing.h5: no such file"),
        (["compare", "missing.h5", "also-missing.h5"], "missing.h5: no such file"),
        (["compare", "no-*.h5", "also-missing.h5"], "no file matches"),
        (["train", "missing.h5", "-o", "w.safetensors", "--budget", "1ns"], "--budget '1ns'"),
        (["rollout", "alanine-dipeptide", "--weights", "alanine", "--time", "1ns", "-o", "x.h5"], "alanine-dipeptide"),
        (
            ["rollout", "alanine-dipeptide", "--weights", "no.safetensors", "--time", "1ns", "-o", "x.h5"],
            "no.safetensors",
        ),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(here: Path, arguments: list[str], said: str) -> None:
    message = refused(run(*arguments))
    assert said in message
    assert not list(here.iterdir())


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"this is not a structure\n",
        bytes(range(256)),
        b"ATOM      1  N   ALA A   1      xx.xxx   0.000   0.000  1.00  0.00           N\nEND\n",
    ],
    ids=["empty", "text", "binary", "bad number"],
)
def test_unreadable_pdb(here: Path, content: bytes) -> None:
    (here / "bad.pdb").write_bytes(content)
    message = refused(run("reference", "bad.pdb", "--time", "1ps", "-o", "x.h5"))
    assert "bad.pdb" in message
    assert [p.name for p in here.iterdir()] == ["bad.pdb"]


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_truncated_hdf5_is_refused_not_read_as_far_as_it_goes(here: Path, short_run: Path, keep: float) -> None:
    whole = short_run.read_bytes()
    (here / "cut.h5").write_bytes(whole[: int(keep * len(whole))])
    assert "cut.h5" in refused(run("info", "cut.h5"))
    assert "cut.h5" in refused(run("compare", str(short_run), "cut.h5", "-o", "report.html"))
    assert [p.name for p in here.iterdir()] == ["cut.h5"]


def test_a_molecule_the_weights_do_not_cover(here: Path, tiny_weights: Path) -> None:
    message = refused(
        run("rollout", "sequence:ACE-GLY-NME", "--weights", str(tiny_weights), "--time", "1ns", "-o", "x.h5")
    )
    assert "alanine-dipeptide (C6H12N2O2, 22 atoms)" in message, "it says what they cover"
    assert "surromd reference" in message and "surromd train" in message, "and what to run instead"
    assert not list(here.iterdir())


def test_existing_output_is_kept_unless_overwritten(here: Path) -> None:
    (here / "x.h5").write_bytes(b"precious")
    arguments = ["reference", "alanine-dipeptide", "--time", "400fs", "--save-every", "40fs", "-o", "x.h5", "--quiet"]
    assert "--overwrite" in refused(run(*arguments))
    assert (here / "x.h5").read_bytes() == b"precious"
    assert run(*arguments, "--overwrite").exit_code == 0
    assert api.info("x.h5")["n_frames"] == 10


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device", "x.h5"), OSError("Can't write data (errno = 28, ...)")]
)
def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch, error: OSError) -> None:
    def full(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(api, "info", full)
    assert "the disk is full" in refused(run("info", "x.h5"))


def test_a_fault_of_ours_is_one_line_unless_debugging(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("of all things")

    monkeypatch.setattr(api, "info", broken)
    assert "SURROMD_DEBUG=1" in refused(run("info", "x.h5"))
    monkeypatch.setenv("SURROMD_DEBUG", "1")
    assert isinstance(run("info", "x.h5").exception, ZeroDivisionError)


# ---- working -------------------------------------------------------------------------------------------------------


def test_systems_lists_and_describes() -> None:
    listed = run("systems")
    assert listed.exit_code == 0
    assert "alanine-dipeptide" in listed.stdout
    described = json.loads(run("systems", "alanine-dipeptide", "--json").stdout)[0]
    assert described["n_atoms"] == 22
    assert described["torsions"] == {"phi": 1, "psi": 1, "omega": 2}


def test_plan_says_what_is_skipped() -> None:
    result = run("plan", "alanine-dipeptide")
    assert result.exit_code == 0, result.stderr
    assert "Reference" in result.stdout
    assert "skipped" in result.stdout
    assert json.loads(run("plan", "alanine-dipeptide", "--json").stdout)


def test_reference_to_json_and_info(short_run: Path) -> None:
    found = json.loads(run("info", str(short_run), "--json").stdout)
    assert found["n_frames"] == 200
    assert found["n_atoms"] == 22
    assert found["save_every_ps"] == pytest.approx(0.1)
    assert found["record"]["force_field"] == "ff14SB"
    text = run("info", str(short_run))
    assert "200 frames of 22 atoms" in text.stdout


def test_replicas_are_numbered_and_differ(here: Path) -> None:
    result = run(
        *["reference", "alanine-dipeptide", "--time", "400fs", "--save-every", "40fs", "--replicas", "2"],
        *["-o", "x.dcd", "--json", "--quiet"],
    )
    assert result.exit_code == 0, result.stderr
    assert [Path(r["file"]).name for r in json.loads(result.stdout)] == ["x_r0.dcd", "x_r1.dcd"]
    expected = {f"x_r{k}{suffix}" for k in (0, 1) for suffix in (".dcd", ".pdb", ".meta.h5")}
    assert {p.name for p in here.iterdir()} == expected
    import mdtraj

    a, b = (mdtraj.load(f"x_r{k}.dcd", top=f"x_r{k}.pdb").xyz for k in (0, 1))
    assert a.shape == (10, 22, 3)
    assert abs(a - b).max() > 1e-3


def test_compare_writes_its_three_reports(here: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    made = tmp_path_factory.mktemp("compare")
    assert (
        run("reference", "alanine-dipeptide", "--time", "20ps", "--save-every", "40fs", "--replicas", "2",
            "-o", str(made / "x.h5"), "--quiet").exit_code == 0
    )  # fmt: skip
    result = run("compare", str(made / "x_r0.h5"), str(made / "x_r1.h5"), "-o", "report.html")
    assert result.exit_code == 0, result.stderr
    assert {p.name for p in here.iterdir()} == {"report.html", "report.json", "report.md"}
    assert "report.html" in result.stdout
    for name in ("report.html", "report.json", "report.md"):
        for other in ("report.html", "report.json", "report.md"):
            (here / other).rename(here / f"{other}.away") if other != name else None
        before = (here / name).read_bytes()
        again = refused(run("compare", str(made / "x_r0.h5"), str(made / "x_r1.h5"), "-o", "report.html"))
        assert f"{name} exists; add --overwrite" in again
        assert (here / name).read_bytes() == before
        for away in here.glob("*.away"):
            away.rename(here / away.stem)
    page = (here / "report.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page.replace(
        "https://doi.org", ""
    )


def _n_frames(path: Path) -> int:
    """Frames in a file that another process may be writing; 0 while there is none to read."""
    try:
        return int(api.info(path)["n_frames"])
    except SurromdError:
        return 0


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_says_what_is_kept_and_resume_goes_on(here: Path) -> None:
    arguments = ["reference", "alanine-dipeptide", "--time", "200ps", "--save-every", "100fs", "-o", "x.h5", "--quiet"]
    with subprocess.Popen([*SURROMD, *arguments], stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline and not _n_frames(here / "x.h5"):
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert len(stderr.splitlines()) == 1, stderr
    assert "--resume" in stderr
    kept = _n_frames(here / "x.h5")
    assert 0 < kept < 2000
    assert f"x.h5 holds {kept} frames" in stderr
    assert run(*arguments, "--resume").exit_code == 0
    assert {p.name for p in here.iterdir()} == {"x.h5", "x.pdb"}, "the checkpoint goes when the run is complete"

    import numpy as np

    from systems.trajectory.codec import open_trajectory

    with open_trajectory("x.h5") as reader:
        np.testing.assert_allclose(reader.time_ps, 0.1 * np.arange(1, 2001), rtol=1e-9)
