"""Ctrl-C, SIGTERM and SIGHUP: each ends what this process has started, and a long run waits for a good moment: it stops
between frames, never inside a write. A worker process ends with the process that started it, whatever ended that one.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from types import FrameType
from typing import Any

# Pressed again after this long, Ctrl-C means now.
_PATIENCE_S = 1.0
# So often it is looked whether an interruption is still on its way out.
_LOOK_S = 0.5
# For so long a second signal does not disturb what is ending.
_CLEAN_UP_S = 30.0

_thread = threading.local()


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Have SIGTERM and SIGHUP interrupt the block as Ctrl-C does: KeyboardInterrupt in the main thread.

    For a program of ours, all of it: Python's own way, to end at once, leaves folders and processes behind. SIGINT
    is heeded also where a shell has started the program in the background and had it ignored; SIGHUP stays ignored
    where it is (nohup). What cleans up after the first signal is not disturbed by another one for half a minute, but
    by Ctrl-C a second later. An interruption that somebody swallows (a library that catches everything while it is
    imported) is raised again.
    """
    asked_at: float | None = None
    raised: KeyboardInterrupt | None = None
    over = False

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal asked_at, raised
        now = time.monotonic()
        if asked_at is None or now - asked_at > (_PATIENCE_S if number == signal.SIGINT else _CLEAN_UP_S):
            asked_at, raised = now, KeyboardInterrupt()
            raise raised

    def insist() -> None:
        nonlocal asked_at, raised
        missed = 0
        while not over:
            time.sleep(_LOOK_S)
            missed = 0 if raised is None or _is_under_way(raised, thread) else missed + 1
            if missed > 1 and not over:
                asked_at, raised, missed = None, None, 0
                os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.get_ident()
    previous = {number: signal.signal(number, handle) for number in _numbers()}
    threading.Thread(target=insist, name="interruption-watch", daemon=True).start()
    try:
        yield
    finally:
        over = True
        for number, handler in previous.items():
            signal.signal(number, handler)


def _is_under_way(interrupt: KeyboardInterrupt, thread: int) -> bool:
    """True while a thread handles this exception, or another one that came of it: what cleans up runs so."""
    handled: Any = sys._current_exceptions().get(thread)
    error = handled[1] if isinstance(handled, tuple) else handled  # a tuple before Python 3.12
    while error is not None and error is not interrupt:
        error = error.__context__
    return error is not None


def stop_if_asked() -> None:
    """Raise KeyboardInterrupt where this thread has been asked to stop, through `deferred_interrupt` or `stop_when`.
    For whoever waits within a run, for another program, say: nothing would look otherwise."""
    asked: Callable[[], bool] | None = getattr(_thread, "deferred", None) or getattr(_thread, "asked", None)
    if asked is not None and asked():
        raise KeyboardInterrupt


def _numbers() -> list[signal.Signals]:
    """The signals that ask a process to end. A hang-up that is ignored (nohup) is none."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    hang_up: signal.Signals | None = getattr(signal, "SIGHUP", None)  # not on Windows
    if hang_up is not None and signal.getsignal(hang_up) is not signal.SIG_IGN:
        numbers.append(hang_up)
    return numbers


@contextmanager
def stop_when(asked: Callable[[], bool]) -> Iterator[None]:
    """Have `deferred_interrupt` ask `asked` in this thread: how to stop a run outside the main thread."""
    previous = getattr(_thread, "asked", None)
    _thread.asked = asked
    try:
        yield
    finally:
        _thread.asked = previous


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether the user (SIGINT, SIGHUP) or the system (SIGTERM) asked to stop.

    The caller looks at it where stopping leaves everything whole, and then raises KeyboardInterrupt. A second Ctrl-C, a
    second later, raises it at once. Outside the main thread, where Python takes no signals, the question goes to the
    function given to `stop_when`; without one nothing asks to stop.
    """
    if threading.current_thread() is not threading.main_thread():
        yield getattr(_thread, "asked", None) or (lambda: False)
        return
    asked_at: float | None = None

    def handle(number: int, _: FrameType | None) -> None:
        nonlocal asked_at
        now = time.monotonic()
        if asked_at is None:
            asked_at = now
        elif number == signal.SIGINT and now - asked_at > _PATIENCE_S:
            raise KeyboardInterrupt

    def asked() -> bool:
        return asked_at is not None

    outer = getattr(_thread, "deferred", None)
    previous = {number: signal.signal(number, handle) for number in _numbers()}
    _thread.deferred = asked
    try:
        yield asked
    finally:
        _thread.deferred = outer
        for number, handler in previous.items():
            signal.signal(number, handler)


# ---- a worker and its parent ----------------------------------------------------------------------------------------


# A run that is asked to stop does so after the frame in hand; after this long it is ended as it stands.
_GRACE_S = 10.0


def end_with_parent() -> None:
    """Watch the parent of this worker process from a thread of its own; to be called once, when the worker starts. When
    the parent is gone (killed, even by `kill -9`) this process gets SIGTERM, at which a run stops between two frames
    with a checkpoint, and ten seconds later it exits. In a process without a parent of ours: nothing."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
        # A daemon thread: an orderly end of the process comes first.
        threading.Event().wait(_GRACE_S)
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
