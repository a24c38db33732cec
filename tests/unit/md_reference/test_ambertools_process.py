"""An interrupted parametrisation leaves no program running behind it."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from md_reference import ambertools
from systems.errors import PreparationError


@pytest.fixture
def fake_tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of programs that stands for AmberTools: `slow` starts a grandchild and waits for it, `bad` fails."""
    home = tmp_path / "bin"
    home.mkdir()
    (home / "slow").write_text("#!/bin/sh\nsleep 60 &\necho $! > grandchild\nwait\n")
    (home / "bad").write_text("#!/bin/sh\necho 'Error: no such atom type'\nexit 3\n")
    for program in home.iterdir():
        program.chmod(0o755)
    monkeypatch.setattr(ambertools, "ambertools", lambda: ambertools.AmberTools(home, "test", "test"))
    return tmp_path


def _runs(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads the process table of Linux")
def test_an_interruption_ends_the_program_and_its_children(fake_tools: Path) -> None:
    note = fake_tools / "grandchild"

    def interrupt() -> None:
        deadline = time.monotonic() + 10.0
        while not (note.exists() and note.read_text().strip()) and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            ambertools.run("slow", [], fake_tools)
    finally:
        signal.signal(signal.SIGINT, before)
    thread.join()
    pid = int(note.read_text())
    deadline = time.monotonic() + 5.0
    while _runs(pid) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _runs(pid)


def test_a_failure_is_told_in_its_own_words(fake_tools: Path) -> None:
    with pytest.raises(PreparationError, match="bad failed: Error: no such atom type"):
        ambertools.run("bad", [], fake_tools)
