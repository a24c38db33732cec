"""A program of AmberTools that fails, and one that is interrupted."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from md_reference.forces.small_molecules import programs
from process_table import needs_process_table, runs, wait_until
from systems.errors import PreparationError


@pytest.fixture
def fake_tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of programs that stands for AmberTools: `slow` starts a grandchild and waits for it, `bad` fails."""
    home = tmp_path / "bin"
    home.mkdir()
    (home / "slow").write_text("#!/bin/sh\nsleep 1000 &\necho $! > new\nmv new grandchild\nwait\n")
    (home / "bad").write_text("#!/bin/sh\necho 'Error: no such atom type'\nexit 3\n")
    for program in home.iterdir():
        program.chmod(0o755)
    monkeypatch.setattr(programs, "ambertools", lambda: programs.AmberTools(home, "test", "test"))
    return tmp_path


@needs_process_table
def test_an_interruption_ends_the_program_and_its_children(fake_tools: Path) -> None:
    note = fake_tools / "grandchild"

    def interrupt() -> None:
        wait_until(note.exists, "the program did not start")
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            programs.run("slow", [], fake_tools)
    finally:
        signal.signal(signal.SIGINT, before)
    thread.join()
    pid = int(note.read_text())
    wait_until(lambda: not runs(pid), "the program's child outlives the interruption")


def test_a_failure_is_told_in_its_own_words(fake_tools: Path) -> None:
    with pytest.raises(PreparationError, match="bad failed: Error: no such atom type"):
        programs.run("bad", [], fake_tools)
