"""Programs end with the process that asked for them, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest

from md_reference.forces import programs
from md_reference.forces.programs import run_program, scratch_folder
from process_table import needs_process_table, processes_with, runs, wait_until
from systems.errors import PreparationError, StorageError
from systems.interrupts import deferred_interrupt, stop_when

# A program that starts another, as antechamber starts sqm; it says so in its folder, and then both stay.
SLOW = ["/bin/sh", "-c", "sleep 1000 & echo $! > started.new; mv started.new started; wait"]


def grandchild(folder: Path) -> int:
    wait_until((folder / "started").exists, "the program did not start")
    return int((folder / "started").read_text())


def test_what_a_program_says_and_how_it_ended(tmp_path: Path) -> None:
    environment = {"PATH": os.environ["PATH"], "WORD": "Å"}
    talk = 'echo "$WORD here: $(pwd)"; echo oh >&2; read x; echo "[$x]"; exit 3'
    status, printed = run_program(["/bin/sh", "-c", talk], tmp_path, environment)
    assert (status, printed) == (3, f"Å here: {tmp_path.resolve()}\noh\n[]\n")
    assert run_program(["true"], tmp_path, environment) == (0, "")
    assert run_program(["/bin/sh", "-c", "kill -SEGV $$"], tmp_path, environment)[0] == 128 + signal.SIGSEGV
    assert run_program(["./absent"], tmp_path, environment)[0] == 127


def test_a_failure_of_ambertools_is_said_in_its_own_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bad").write_text("#!/bin/sh\necho 'Error: no such atom type'\nexit 3\n")
    (tmp_path / "bad").chmod(0o755)
    monkeypatch.setattr(programs, "ambertools", lambda: programs.AmberTools(tmp_path, "test", "test", tmp_path))
    with pytest.raises(PreparationError, match="bad failed: Error: no such atom type"):
        programs.run("bad", [], tmp_path)


@needs_process_table
@pytest.mark.parametrize("deferred", [False, True], ids=["at once", "within a run"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_program_and_its_children(tmp_path: Path, deferred: bool, number: signal.Signals) -> None:
    process = _start(tmp_path, deferred=deferred)
    pid = grandchild(tmp_path)
    process.send_signal(number)
    assert process.wait() == 130
    wait_until(lambda: not runs(pid), "the program's child outlives the interruption")
    wait_until(lambda: not _left(tmp_path), f"there remains {_left(tmp_path)}")


@needs_process_table
def test_kill_minus_nine_ends_the_program_and_its_children_too(tmp_path: Path) -> None:
    process = _start(tmp_path)
    pid = grandchild(tmp_path)
    assert len(_left(tmp_path)) > 2, "the question finds processes and folders"
    process.kill()
    process.wait()
    wait_until(lambda: not runs(pid), "the program's child outlives its parent")


_CHILD = """
import contextlib, os, sys
from pathlib import Path
from md_reference.forces.programs import run_program, scratch_folder
from systems.interrupts import deferred_interrupt, interrupted_by_signals

try:
    with interrupted_by_signals(), deferred_interrupt() if sys.argv[1] == "deferred" else contextlib.nullcontext():
        with scratch_folder("surromd-test-") as folder:
            (folder / "deep").mkdir()
            (folder / "deep" / "file").touch()
            run_program(sys.argv[2:], Path.cwd(), os.environ)
except KeyboardInterrupt:
    sys.exit(130)
"""


def _start(folder: Path, *, deferred: bool = False) -> subprocess.Popen[bytes]:
    """A process of its own that runs SLOW in `folder`, with a scratch folder beside."""
    root = str(Path(__file__).parents[4])
    environment = os.environ | {"TMPDIR": str(folder), "PYTHONPATH": root, "SURROMD_TEST": str(folder)}
    command = [sys.executable, "-c", _CHILD, "deferred" if deferred else "at once", *SLOW]
    return subprocess.Popen(command, cwd=folder, env=environment)


def _left(folder: Path) -> list[str]:
    """Scratch folders in `folder`, and processes that descend from what `_start` started there."""
    return [*map(str, folder.glob("surromd-test-*")), *processes_with(f"SURROMD_TEST={folder}").values()]


@needs_process_table
def test_a_thread_that_is_asked_to_stop_ends_its_program(tmp_path: Path) -> None:
    asked, ended = threading.Event(), threading.Event()

    def work() -> None:
        with stop_when(asked.is_set):
            try:
                run_program(SLOW, tmp_path, os.environ)
            except KeyboardInterrupt:
                ended.set()

    thread = threading.Thread(target=work)
    thread.start()
    pid = grandchild(tmp_path)
    assert runs(pid)
    asked.set()
    thread.join()
    assert ended.is_set()
    wait_until(lambda: not runs(pid), "the program's child outlives the interruption")


def test_a_scratch_folder_is_there_for_the_block_alone() -> None:
    with scratch_folder("surromd-test-") as folder:
        assert folder.parent == Path(tempfile.gettempdir()) and folder.name.startswith("surromd-test-")
        assert list(folder.iterdir()) == [] and folder.stat().st_mode & 0o777 == 0o700
        (folder / "file").write_text("x")
    assert not folder.exists()
    with pytest.raises(ZeroDivisionError), scratch_folder("surromd-test-") as other:
        _ = 1 / 0
    assert not other.exists() and other != folder


def test_a_scratch_folder_that_cannot_be_made_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "absent"))
    with (
        pytest.raises(StorageError, match=r"no temporary folder can be made: .*; free space or set TMPDIR"),
        scratch_folder("surromd-test-"),
    ):
        raise AssertionError("there is a folder after all")


def test_a_deferred_interrupt_ends_with_its_block(tmp_path: Path) -> None:
    with deferred_interrupt():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            run_program(SLOW, tmp_path, os.environ)
    assert run_program(["true"], tmp_path, os.environ) == (0, "")
