"""Rollouts in a process of their own, for tests that stop it or take its disk away.

Such a process is forked by a server that has no threads (`forkserver`): a fork of the test's own process, in which
libraries have started threads, may wait for ever for a lock that one of them held.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

INTERRUPTED, FAILED = 130, 1
LONGEST_S = 120.0  # that any step of it may take on a busy machine
CHUNKS_UNTIL_STOPPED = 6
PATIENCE_S = 2.0
UNDER_WAY = "under way"


@dataclass
class Child:
    """A running process, and the line on which it says what went wrong."""

    process: ForkServerProcess
    line: Connection

    def wait_for_chunk(self) -> None:
        """Return when it has drawn and written a chunk; AssertionError if it ends before, or takes too long."""
        assert self.line.poll(LONGEST_S), f"no chunk after {LONGEST_S:g} s"
        said = self.line.recv()
        assert said == UNDER_WAY, said

    def stop(self, number: signal.Signals) -> None:
        """Send a signal and say so until the process ends: Python loses a Ctrl-C that comes while it imports."""
        assert self.process.pid is not None
        deadline = time.monotonic() + LONGEST_S
        while self.process.exitcode is None and time.monotonic() < deadline:
            with suppress(OSError):  # it is gone
                os.kill(self.process.pid, number)
                self.line.send(None)
            self.process.join(PATIENCE_S)

    def end(self) -> tuple[int | None, str]:
        """Wait for its end; return its exit status (negative: the signal) and its error, "" without one."""
        self.process.join(LONGEST_S)
        status, said = self.process.exitcode, ""
        with suppress(EOFError, OSError):
            while self.line.poll():
                heard = self.line.recv()
                said = said if heard == UNDER_WAY else heard
        if status is None:
            self.process.kill()
        return status, said


def start(work: Callable[..., None], *arguments: Any) -> Child:
    """Run `work(line, *arguments)`, a function of this module, and return once it heeds signals."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["rollout_child", "surrogate.sampling.runner", "systems.library.named_scenes"])
    ours, theirs = context.Pipe()
    process = context.Process(target=_guarded, args=(work, theirs, *arguments), daemon=True)
    process.start()
    theirs.close()
    assert ours.poll(LONGEST_S), "the process did not start"
    ours.recv()
    return Child(process, ours)


def _guarded(work: Callable[..., None], line: Connection, *arguments: Any) -> None:
    status = FAILED
    try:
        line.send("ready")
        work(line, *arguments)
        status = 0
    except KeyboardInterrupt:
        status = INTERRUPTED
    except BaseException as error:
        line.send(f"{type(error).__name__}: {error}\n{traceback.format_exc()}")
    os._exit(status)


def until_stopped(line: Connection, weights: Path, outs: list[Path], config: Any) -> None:
    """Go on with a rollout, for a few chunks at most: then it waits for each further one until it hears of a signal."""
    chunks = 0

    def wait_for_signal(done: int, total: int, note: str) -> None:
        nonlocal chunks
        chunks += 1
        if chunks == 1:
            line.send(UNDER_WAY)
        time.sleep(0.01)
        if chunks >= CHUNKS_UNTIL_STOPPED and line.poll(LONGEST_S):
            line.recv()

    _roll(weights, outs, config, progress=wait_for_signal)


def within_file_size(line: Connection, weights: Path, outs: list[Path], config: Any, limit: int) -> None:
    """Go on with a rollout whose files may have `limit` bytes at most, as on a disk that fills up."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    _roll(weights, outs, config)


def _roll(weights: Path, outs: list[Path], config: Any, **more: Any) -> None:
    from surrogate.models.weights import load_weights
    from surrogate.sampling.runner import rollout
    from systems.library.named_scenes import load

    rollout(load("alanine-dipeptide"), load_weights(weights), outs, config, resume=True, flush_every_s=0.0, **more)
