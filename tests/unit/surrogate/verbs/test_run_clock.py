"""The clock of a run: stages end when their time is up, interruptions and errors come through, spent time is kept."""

from __future__ import annotations

import math
import os
import signal
import threading
import time

import pytest

from surrogate.verbs.run.one_scene import Clock
from systems.errors import SimulationError
from systems.interrupts import deferred_interrupt, stop_if_asked, stop_when


def until_asked() -> str:
    """Work that only a request ends, as MD's."""
    with deferred_interrupt() as asked:
        while not asked():
            time.sleep(0.01)
    raise KeyboardInterrupt("it holds 7 frames")


def clock(kept: list[float] | None = None, spent_s: float = 0.0) -> Clock:
    return Clock(100.0, spent_s, (kept if kept is not None else []).append)


def test_a_stage_is_stopped_when_its_time_is_up() -> None:
    began = time.monotonic()
    assert clock().work("md", 0.3, until_asked) is None
    assert time.monotonic() - began >= 0.3
    assert clock().work("md", 60.0, lambda: "done") == "done", "control"


def test_time_of_earlier_sittings_counts() -> None:
    kept: list[float] = []
    found = clock(kept, spent_s=40.0)
    found.work("md", 0.1, until_asked)
    assert 40.1 <= kept[-1] <= found.spent_s


def test_ctrl_c_stops_a_stage_and_says_what_is_kept() -> None:
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt, match="7 frames"):
        clock().work("md", 60.0, until_asked)


def test_a_run_inside_a_worker_is_stopped_by_the_worker() -> None:
    began, caught = time.monotonic(), []

    def run() -> None:
        with stop_when(lambda: time.monotonic() - began > 0.3):
            try:
                clock().work("md", 60.0, until_asked)
            except KeyboardInterrupt as stop:
                caught.append(stop)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(30.0)
    assert len(caught) == 1


def test_errors_of_a_stage_come_through() -> None:
    def fail() -> None:
        raise SimulationError("it blew up")

    with pytest.raises(SimulationError, match="blew up"):
        clock().work("md", 60.0, fail)


def test_work_that_only_looks_now_and_then_is_stopped_too() -> None:
    def loop() -> None:
        while True:
            stop_if_asked()
            time.sleep(0.01)

    assert clock().work("train", 0.2, loop) is None


def test_a_budget_that_is_overrun_is_said_once_while_it_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("surrogate.verbs.run.one_scene._SAVE_EVERY_S", 0.1)
    said: list[tuple[str, bool]] = []
    done: list[bool] = []

    def work() -> None:
        time.sleep(1.0)
        done.append(True)

    late = Clock(0.3, 0.0, lambda _: None, None, lambda line: said.append((line, bool(done))))
    late.work("report", math.inf, work)
    assert len(said) == 1 and said[0][0].startswith("report: over the budget of") and not said[0][1]
    said.clear()
    Clock(60.0, 0.0, lambda _: None, None, lambda line: said.append((line, True))).work("report", math.inf, work)
    assert not said, "control"
