"""The clock of a run: stages are told to stop when their time is up, and the time that is left is shown."""

from __future__ import annotations

import contextvars
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from surrogate.progress import ProgressFn
from systems.interrupts import deferred_interrupt, stop_when
from systems.units import format_wall

T = TypeVar("T")
_TICK_S = 0.2
_SAVE_EVERY_S = 2.0


class Clock:
    """Counts the wall time of a run, of earlier sittings too (`spent_s`). `save` is told every few seconds what is
    spent, so that a run that is killed does not start its budget over; `advance` shows it, `warn` says once, and while
    it happens, that the budget is overrun."""

    def __init__(
        self,
        budget_s: float,
        spent_s: float,
        save: Callable[[float], None],
        advance: ProgressFn | None = None,
        warn: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.budget_s = budget_s
        self._before_s, self._began = spent_s, time.monotonic()
        self._save, self._advance, self._warn = save, advance, warn
        self._is_over = spent_s > budget_s

    @property
    def spent_s(self) -> float:
        return self._before_s + time.monotonic() - self._began

    def work(self, said: str, may_take_s: float, stage: Callable[[], T]) -> T | None:
        """Do a stage and return its result; None where it was asked to stop, as Ctrl-C asks, when its time was up.

        A stage runs in a thread of its own, and must end with KeyboardInterrupt when it is asked to
        (`deferred_interrupt`, `stop_if_asked`). Ctrl-C stops it likewise: KeyboardInterrupt with the stage's own words.
        Raises what it raises.
        """
        until = time.monotonic() + may_take_s
        results: list[T] = []
        errors: list[BaseException] = []
        with deferred_interrupt() as asked_to_stop:

            def body() -> None:
                try:
                    with stop_when(lambda: asked_to_stop() or time.monotonic() > until):
                        results.append(stage())
                except BaseException as error:
                    errors.append(error)

            thread = threading.Thread(target=contextvars.copy_context().run, args=(body,), name=said, daemon=True)
            thread.start()
            saved = time.monotonic()
            while thread.is_alive():
                thread.join(_TICK_S)
                self._show(said)
                if time.monotonic() - saved > _SAVE_EVERY_S:
                    saved = time.monotonic()
                    self._save(self.spent_s)
            self._save(self.spent_s)
            if errors and isinstance(errors[0], KeyboardInterrupt):
                if asked_to_stop():
                    raise KeyboardInterrupt(*errors[0].args) from None
                return None
            if errors:
                raise errors[0]
            if asked_to_stop():
                raise KeyboardInterrupt
        return results[0]

    def _show(self, said: str) -> None:
        spent_s = self.spent_s
        if spent_s > self.budget_s + _SAVE_EVERY_S and not self._is_over:
            self._is_over = True
            self._warn(
                f"{said}: over the budget of {format_wall(self.budget_s)}, as busy as the machine is; it goes on"
            )
        if self._advance is not None:
            note = f"{said}, {format_wall(round(spent_s))} of {format_wall(self.budget_s)}"
            spent_s = min(spent_s, self.budget_s)
            self._advance(round(10 * spent_s), round(10 * self.budget_s), note)
