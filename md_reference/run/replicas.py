"""Several independent replicas of one run, one process and one thread each."""

from __future__ import annotations

import multiprocessing
import os
import queue
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from md_reference.run.batch import simulate_batch
from md_reference.run.config import SIMD, MDConfig, check_run
from md_reference.run.machine import available_cores
from md_reference.run.plan import plan_line
from md_reference.run.platforms import measured_platform, simd_choice
from md_reference.run.simulate import ProgressFn, checkpoint_path, simulate, tell_preparing
from md_reference.run.starts import many_starts
from md_reference.simd.force_field import n_replicas
from systems.errors import SimulationError, SurromdError
from systems.interrupts import deferred_interrupt
from systems.parent_watch import end_with_parent
from systems.scene import Scene


@dataclass(frozen=True)
class _Board:
    """What processes write and their parent reads: frames done, shares equilibrated (both by process), last words."""

    done: Any
    equilibrated: Any
    errors: Any


def simulate_replicas(
    scene: Scene | Sequence[Scene],
    config: MDConfig,
    outs: Sequence[Path],
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    announce: Callable[[str | SimulationError], None] | None = None,
    workers: int | None = None,
) -> list[Path]:
    """Run `len(outs)` replicas with seeds config.seed, config.seed + 1, ..., at most one per core at a time.

    `scene`: what they start from, each from a state of its own unless `config.starts` is one (`starts.many_starts`); or
    a start for each replica.
    Each replica is a process with its share of the cores, one thread where there are as many replicas as cores: on
    small scenes the fastest use of them. On platform simd up to sixteen replicas share a process. The platform is
    measured once, for all, and `announce` gets the plan in one line, and the error of a replica that fails while others
    run, which it may raise to end them too; `progress` counts the frames of all replicas.
    Ctrl-C and SIGTERM stop them all with checkpoints: KeyboardInterrupt. When this process is killed outright they stop
    by themselves. Raises SimulationError with the first replica's reason when the others have ended; finished replicas
    stay on disk.
    """
    given = None if isinstance(scene, Scene) else list(scene)
    scene = scene if isinstance(scene, Scene) else scene[0]
    for out in outs:
        config = check_run(scene, config, out)
    configs = [replace(config, seed=config.seed + k) for k in range(len(outs))]
    jobs = [[k] for k in range(len(outs))]
    if config.platform == SIMD:
        size = n_replicas()
        jobs = [list(range(k, min(k + size, len(outs)))) for k in range(0, len(outs), size)]
    width = workers or min(len(jobs), available_cores())
    # What goes on keeps its platform.
    fresh = [out for out in outs if not (resume and (out.exists() or checkpoint_path(out).exists()))]
    choice = None
    if fresh and config.platform == SIMD:
        if announce is not None:
            announce(plan_line(scene, config, simd_choice(), replicas=len(outs)))
    elif fresh:
        choice = measured_platform(scene, config, max_threads=max(1, available_cores() // width), side_by_side=width)
        if announce is not None:
            announce(plan_line(scene, config, choice, replicas=len(outs)))
    scenes = [scene] * len(outs) if given is None else given
    if fresh and given is None and config.starts == "many" and len(outs) > 1:
        tell_preparing(progress, 0.0)
        starts = many_starts(scene, config, len(outs))
        scenes = list(starts.scenes)
        if announce is not None:
            announce(starts.how)
    how: dict[str, Any] = {"resume": resume, "overwrite": overwrite, "choice": choice}
    if len(jobs) == 1:
        _run([scenes[k] for k in jobs[0]], [configs[k] for k in jobs[0]], list(outs), how, progress)
        return list(outs)
    context = multiprocessing.get_context("spawn")
    # Without a lock, which a killed process would never give back: each number has one writer.
    board = _Board(context.Array("Q", len(jobs), lock=False), context.Array("d", len(jobs), lock=False),
                   context.Queue())  # fmt: skip
    waiting = list(range(len(jobs)))
    running: dict[int, Any] = {}
    failures: dict[int, str] = {}
    reasons: dict[int, str] = {}
    with deferred_interrupt() as asked_to_stop:
        try:
            while waiting or running:
                while waiting and len(running) < width:
                    k = waiting.pop(0)
                    of_job = [configs[i] for i in jobs[k]], [outs[i] for i in jobs[k]]
                    once = {id(scenes[i]): scenes[i].to_dict() for i in jobs[k]}
                    args = ([once[id(scenes[i])] for i in jobs[k]], *of_job, how, board, k)
                    running[k] = context.Process(target=_replicas, args=args, name=f"replica-{jobs[k][0]}")
                    running[k].start()
                time.sleep(0.1)
                if asked_to_stop():
                    raise KeyboardInterrupt
                n_done = int(sum(board.done[:]))
                if n_done == 0:
                    tell_preparing(progress, sum(board.equilibrated[:]) / len(jobs))
                elif progress is not None:
                    progress(n_done, config.n_frames * len(outs))
                for k in [k for k, process in running.items() if not process.is_alive()]:
                    process = running.pop(k)
                    process.join()
                    if process.exitcode != 0:
                        _collect(board.errors, reasons, k)
                        failures[k] = reasons.get(k, f"exit code {process.exitcode}")
                        if announce is not None and (waiting or running):
                            announce(_error(failures, jobs))
        finally:
            for process in running.values():
                process.terminate()
            for process in running.values():
                process.join()
    if failures:
        raise _error(failures, jobs)
    return list(outs)


def _error(failures: dict[int, str], jobs: list[list[int]]) -> SimulationError:
    k = min(failures)
    failed, of_all = sum(len(jobs[i]) for i in failures), sum(map(len, jobs))
    return SimulationError(f"{failed} of {of_all} replicas failed; replica {jobs[k][0]}: {failures[k]}")


def _collect(errors: Any, reasons: dict[int, str], wanted: int) -> None:
    """Read what replicas said when they failed, until `wanted` is among them; a killed one says nothing."""
    try:
        while wanted not in reasons:
            k, reason = errors.get(timeout=1)
            reasons[k] = reason
    except queue.Empty:
        pass


def _run(
    scenes: Sequence[Scene], configs: Sequence[MDConfig], outs: Sequence[Path], how: dict[str, Any],
    progress: ProgressFn | None,
) -> None:  # fmt: skip
    """Run one replica, or on platform simd a batch of them; `how`: what else `simulate` takes."""
    if configs[0].platform == SIMD:
        starts = None if all(s is scenes[0] for s in scenes[1:]) else np.stack([s.positions_nm for s in scenes])
        of_files = {"resume": how["resume"], "overwrite": how["overwrite"], "progress": progress}
        simulate_batch(scenes[0], configs[0], outs, starts_nm=starts, **of_files)
    else:
        simulate(scenes[0], configs[0], outs[0], progress=progress, **how)


def _replicas(
    scenes: Sequence[dict[str, Any]],
    configs: Sequence[MDConfig],
    outs: Sequence[Path],
    how: dict[str, Any],
    board: _Board,
    k: int,
) -> None:
    """Run the k-th job in a process of its own."""
    end_with_parent()
    os.environ["OPENMM_CPU_THREADS"] = "1"

    def report(done: int, total: int, note: str | None = None) -> None:
        if note is None:
            board.done[k] = done
        else:
            board.equilibrated[k] = done / total

    try:
        made = {id(s): Scene.from_dict(s) for s in scenes}  # those that are one stay one
        _run([made[id(s)] for s in scenes], configs, outs, how, report)
    except SurromdError as error:
        board.errors.put((k, str(error)))
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
