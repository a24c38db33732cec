"""Which processes run, as Linux's process table says."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

needs_process_table = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="reads the process table of Linux"
)


def runs(pid: int) -> bool:
    """True while the process is there and has not ended (nobody may have asked yet how)."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state not in "ZX"


def processes_with(marker: str) -> dict[int, str]:
    """Return the processes, other than this one, that were started with `marker` (NAME=value) in their environment,
    with their command lines: what a program has started, however it has changed its group, session or parent."""
    found = {}
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
        except OSError:
            continue
        if marker.encode() in environment and runs(int(entry.name)):
            found[int(entry.name)] = command
    return found


def wait_until(true: Callable[[], object], what: str, patience_s: float = 120.0) -> None:
    """Return when `true()` is; after two minutes, which no loaded machine needs, fail with `what`."""
    deadline = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)
