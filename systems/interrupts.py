"""Ctrl-C and SIGTERM that wait for a good moment: a long run stops between frames, never inside a write."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# Pressed again after this long, Ctrl-C means now.
_PATIENCE_S = 1.0

_thread = threading.local()


@contextmanager
def stop_when(asked: Callable[[], bool]) -> Iterator[None]:
    """Have `deferred_interrupt` ask `asked` in this thread: how a run outside the main thread is told to stop."""
    previous = getattr(_thread, "asked", None)
    _thread.asked = asked
    try:
        yield
    finally:
        _thread.asked = previous


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether the user (SIGINT) or the system (SIGTERM) asked to stop.

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

    previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked_at is not None
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
