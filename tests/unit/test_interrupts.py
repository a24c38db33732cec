"""Ctrl-C waits for the caller to look, and the old handlers come back."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator

import pytest

from systems import interrupts
from systems.interrupts import deferred_interrupt, stop_when


@pytest.fixture(autouse=True)
def python_handles_ctrl_c() -> Iterator[None]:
    """A shell starts background jobs with SIGINT ignored, which Python leaves as it is."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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
