"""Shared by the commands that simulate many peptides: one process a core takes tasks in order until a deadline; batches
of SIMD replicas."""

from __future__ import annotations

import argparse
import fcntl
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from md_reference.run.config import MDConfig
from md_reference.run.machine import available_cores
from md_reference.run.replicas import simulate_batch
from systems.errors import SimulationError
from systems.interrupts import end_with_parent
from systems.scene import Scene
from systems.trajectory.companion_writer import topology_path
from systems.units import parse_wall_s


def arguments_of(
    about: str | None, switches: Mapping[str, str], given: Sequence[str] | None, solvents: Collection[str] = ()
) -> argparse.Namespace:  # fmt: skip
    """Read the command line that these commands have in common, switches of their own with a help text each, and the
    solvent, by default the first, and molecules where there is a choice."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--budget", default="3h", help="wall time after which no further run is begun")
    parser.add_argument("--workers", type=int, default=available_cores())
    for switch, help in switches.items():
        parser.add_argument(switch, action="store_true", help=help)
    if solvents:
        parser.add_argument("--solvent", choices=list(solvents), default=next(iter(solvents)))
        parser.add_argument("--molecules", nargs="+", default=(), metavar="NAME", help="these alone")
    chosen = parser.parse_args(given)
    chosen.budget_s = parse_wall_s(chosen.budget, "--budget")
    return chosen


def run_path(folder: Path, k: int) -> Path:
    return folder / f"run_{k:03d}.h5"


def parts_of(folder: Path, numbers: Sequence[int]) -> list[Path]:
    """Where the files of runs lie while they lack frames."""
    return [folder / f".{run_path(folder, k).stem}.part.h5" for k in numbers]


def simulate_runs(scene: Scene, config: MDConfig, folder: Path, numbers: Sequence[int], **how: Any) -> None:
    """Simulate the runs of these numbers at once, from wherever they stand; files get their names when all frames are
    there. `how`: further arguments of `simulate_batch`. Raises SimulationError, KeyboardInterrupt."""
    parts = parts_of(folder, numbers)
    simulate_batch(scene, config, parts, resume=True, **how)
    for k, part in zip(numbers, parts, strict=True):
        os.replace(topology_path(part), topology_path(run_path(folder, k)))
        os.replace(part, run_path(folder, k))


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
