"""One progress bar for every long verb: share done, speed in the verb's own unit, time left. Always on stderr."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from systems.units import format_time_ps

_LONGEST = 44


class ProgressFn(Protocol):
    """Called by a running verb with what is done and what there is to do; `note` replaces the default summary, as
    for a stage that comes before what is counted."""

    def __call__(self, done: int, total: int, note: str | None = None) -> None: ...


@contextmanager
def progress_bar(label: str, *, quiet: bool, ps_per_frame: float | None = None) -> Iterator[ProgressFn | None]:
    """Yield a function that a running verb calls with (done, total), or None when `quiet`.

    With `ps_per_frame` the bar shows simulated time and speed in µs/day, otherwise plain counts. The first call sets
    the starting point, so that a resumed run does not count as speed what was there before.
    """
    if quiet:
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}", markup=False),  # SMILES have brackets, too
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(compact=True),
        TextColumn("left"),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    first: tuple[int, float] | None = None
    started = False
    task = bar.add_task(label if len(label) <= _LONGEST else label[: _LONGEST - 3] + "...", total=None, note="")

    def advance(done: int, total: int, note: str | None = None) -> None:
        nonlocal first, started
        now = time.monotonic()
        if not started:
            started = True
            bar.start()  # only now, so that input refused by the verb leaves no empty bar behind
        if note is not None:
            bar.update(task, completed=done, total=total, note=note)
            return
        if first is None:
            first = (done, now)
            bar.reset(task, total=total)  # what came before, such as an equilibration, is no guide to the time left
        rate = (done - first[0]) / (now - first[1]) if now > first[1] else 0.0
        bar.update(task, completed=done, total=total, note=_note(done, total, rate, ps_per_frame))

    try:
        yield advance
    finally:
        if started:
            bar.stop()


def _note(done: int, total: int, per_s: float, ps_per_frame: float | None) -> str:
    if ps_per_frame is None:
        return f"{done}/{total}"
    text = f"{format_time_ps(total * ps_per_frame)}"
    if per_s > 0:
        text += f" at {per_s * ps_per_frame * 86400e-6:.3g} µs/day"
    return text
