"""Ctrl-C waits for the caller to look, and the old handlers come back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from systems import interrupts
from systems.interrupts import deferred_interrupt, interrupted_by_signals, stop_if_asked, stop_when


@pytest.fixture(autouse=True)
def signals_as_at_a_terminal() -> Iterator[None]:
    """A shell starts background jobs with SIGINT ignored, nohup with SIGHUP, and Python leaves both as they are."""
    usual = {signal.SIGINT: signal.default_int_handler}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_noted_and_interrupts_nothing(number: signal.Signals) -> None:
    with deferred_interrupt() as asked_to_stop:
        assert not asked_to_stop()
        signal.raise_signal(number)
        assert asked_to_stop()


def test_without_it_ctrl_c_interrupts_at_once() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_handlers_come_back_after_an_exception_too() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(ZeroDivisionError), deferred_interrupt():
        assert signal.getsignal(signal.SIGINT) is not before[0]
        raise ZeroDivisionError
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_a_second_ctrl_c_means_now_but_not_one_that_follows_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    with deferred_interrupt():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        monkeypatch.setattr(interrupts, "_PATIENCE_S", -1.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_outside_the_main_thread_nothing_is_deferred() -> None:
    seen: list[bool] = []

    def work() -> None:
        with deferred_interrupt() as asked_to_stop:
            seen.append(asked_to_stop())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]


def test_a_thread_is_asked_to_stop_by_whoever_runs_it() -> None:
    asked = threading.Event()
    seen: list[bool] = []

    def run() -> None:
        with stop_when(asked.is_set), deferred_interrupt() as asked_to_stop:
            seen.append(asked_to_stop())
            asked.set()
            seen.append(asked_to_stop())
        with deferred_interrupt() as asked_to_stop:
            seen.append(asked_to_stop())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [False, True, False]
    with stop_when(asked.is_set), deferred_interrupt() as asked_to_stop:
        assert not asked_to_stop(), "the main thread listens to signals"


@pytest.fixture
def as_a_program() -> Iterator[None]:
    """The handlers of a program of ours, for one test."""
    with interrupted_by_signals():
        yield


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no hang-up on this system")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_program_is_interrupted_once_and_then_cleans_up_in_peace(as_a_program: None, name: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.Signals[name])
    signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGHUP)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no hang-up on this system")
def test_a_program_asked_again_much_later_is_interrupted_again(
    as_a_program: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)
    now = time.monotonic()
    with monkeypatch.context() as patch:
        patch.setattr(time, "monotonic", lambda: now + 2.0)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        patch.setattr(time, "monotonic", lambda: now + 60.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGHUP)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no hang-up on this system")
def test_nohup_stays_nohup_and_the_old_handlers_come_back() -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with interrupted_by_signals():
            signal.raise_signal(signal.SIGHUP)
            with deferred_interrupt() as asked_to_stop:
                signal.raise_signal(signal.SIGHUP)
                assert not asked_to_stop()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGTERM) is before[signal.SIGTERM]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_whoever_waits_within_a_run_hears_of_the_wish_to_stop() -> None:
    stop_if_asked()
    with deferred_interrupt():
        stop_if_asked()
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            stop_if_asked()
        with deferred_interrupt():
            stop_if_asked()
        with pytest.raises(KeyboardInterrupt):
            stop_if_asked()
    stop_if_asked()
    with stop_when(lambda: True), pytest.raises(KeyboardInterrupt):
        stop_if_asked()
    stop_if_asked()


_SWALLOWS = """
import os, signal, time
from systems.interrupts import interrupted_by_signals

def clean_up():
    try:
        raise ValueError
    except ValueError:
        time.sleep(1.5)

try:
    with interrupted_by_signals():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except:  # as some libraries do while they are imported
            print("swallowed", flush=True)
        try:
            while True:
                time.sleep(0.05)
        finally:
            clean_up()
            print("cleaned up", flush=True)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signals on this system")
def test_an_interruption_that_is_swallowed_comes_again_and_cleaning_up_is_not_disturbed() -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])}
    said = subprocess.run(
        [sys.executable, "-c", _SWALLOWS], env=environment, capture_output=True, text=True, check=True
    )
    assert said.stdout.split("\n") == ["swallowed", "cleaned up", "interrupted", ""], said.stderr
