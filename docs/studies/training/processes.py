"""Shared by the commands that simulate many peptides: one process a core takes tasks in order until a deadline."""

from __future__ import annotations

import fcntl
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from systems.errors import SimulationError
from systems.interrupts import end_with_parent


def in_order(
    tasks: Callable[[], Sequence[Any]], do: Callable[..., None], budget_s: float, workers: int, *how: Any
) -> None:
    """Call `do(task, deadline, *how)` on each of `tasks()` in order, in processes of low priority.

    No task is begun after `budget_s` of wall time; `deadline` is in `time.time()`. A SimulationError is printed and the
    next task is taken. `tasks`, `do` and `how` are sent to spawned processes, so they are functions of modules.
    """
    os.nice(10)
    context = multiprocessing.get_context("spawn")
    todo, deadline = context.Value("i", 0), time.time() + budget_s
    running = [context.Process(target=_work, args=(tasks, do, deadline, todo, how)) for _ in range(workers)]
    for worker in running:
        worker.start()
    try:
        for worker in running:
            worker.join()
    finally:
        for worker in running:
            worker.terminate()


def _work(tasks: Callable[[], Sequence[Any]], do: Callable[..., None], deadline: float, todo: Any, how: Any) -> None:
    end_with_parent()
    order = tasks()
    while time.time() < deadline:
        with todo.get_lock():
            place = todo.value
            todo.value += 1
        if place >= len(order):
            return
        try:
            do(order[place], deadline, *how)
        except SimulationError as error:
            print(f"{order[place]}: {error}", file=sys.stderr, flush=True)  # noqa: T201


@contextmanager
def only_here(folder: Path) -> Iterator[bool]:
    """Make the folder and hold it while something works in it; yield False where another process holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "a") as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def is_trained(out: Path) -> bool:
    """Return whether weights `out` are there and no state of an interrupted training is beside them."""
    return out.exists() and not list(out.parent.glob(f"{out.stem}.*.train.safetensors"))
