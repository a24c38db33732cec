"""Several independent replicas of one run: one process and one thread each, or up to sixteen at once in one core's
vector registers (`md_reference.simd`), whose one checkpoint lies beside the first file."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from md_reference.forces.forcefield import build_system
from md_reference.run.config import SIMD, MDConfig, check_run
from md_reference.run.engine import Engine, refuse_damaged
from md_reference.run.machine import available_cores, platform_for, simd_choice
from md_reference.run.plan import plan_line
from md_reference.run.simulate import (
    ProgressFn,
    StoredRun,
    already_complete,
    own_scalars,
    record_of,
    report_preparing,
    simulate,
    system_of,
)
from md_reference.run.starts import many_starts
from md_reference.simd.force_field import CENTRED_STEPS, SimdReplicas, n_replicas
from md_reference.simd.system_terms import read_terms
from systems.errors import InputError, SimulationError, SurromdError
from systems.interrupts import deferred_interrupt, end_with_parent
from systems.scene import FloatArray, Scene
from systems.trajectory.base import TrajectoryWriter
from systems.trajectory.checkpoint import (
    checkpoint_path,
    locked_outputs,
    read_checkpoint,
    supported_checkpoint,
    writer_at,
)


def simulate_batch(
    scene: Scene,
    config: MDConfig,
    outs: Sequence[Path],
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressFn | None = None,
    starts_nm: npt.NDArray[np.floating] | None = None,
    notes: Sequence[dict[str, Any]] = (),
) -> None:
    """Run a replica for each of `outs`, at most `n_replicas()`; all have `config.seed` and their number in the batch.

    They start from the scene, its energy minimised, or from `starts_nm` (n, n_atoms, 3) as they stand; `notes` are
    added to their records. Frames and checkpoint are written about every two seconds; `resume` goes on from there, as
    it would have gone on. `progress` counts the frames of all replicas. Raises SimdUnavailableError for what the
    platform cannot do, SimulationError when a replica blows up (the frames before stay in the files, which say
    `completed: false`), and what `simulate` raises.
    """
    config = check_run(scene, config, outs[0])
    if len(outs) > n_replicas():
        raise InputError(f"{len(outs)} replicas are more than the {n_replicas()} of a batch.")
    state_path = checkpoint_path(outs[0])
    with deferred_interrupt() as asked_to_stop, locked_outputs(list(outs), may_exist=resume or overwrite):
        if resume and not state_path.exists() and any(out.exists() for out in outs):
            for out in outs:
                already_complete(out, config)
            return
        kept = supported_checkpoint(state_path, list(outs)) if resume and state_path.exists() else None
        batch = _Batch(scene, config, outs, kept, overwrite=overwrite, asked_to_stop=asked_to_stop, progress=progress)
        batch.start(starts_nm)
        record = record_of(scene, config, simd_choice())
        with ExitStack() as stack:
            writers = []
            for k, out in enumerate(outs):
                own = {**record, "replica": k, "of_replicas": len(outs), "batch": [k, len(outs)]}
                own |= notes[k] if notes else {}
                writer = writer_at(out, batch.written, own, batch.header, k, resumed=batch.resumed)
                writers.append(stack.enter_context(writer))
            batch.produce(writers)
        state_path.unlink(missing_ok=True)


def where_left(scene: Scene, config: MDConfig, outs: Sequence[Path]) -> FloatArray:
    """Return the positions `(n, n_atoms, 3)` nm, water and all, of SIMD replicas that were stopped; none of a batch
    that ended."""
    found = [np.zeros((0, scene.n_atoms, 3))]
    for first in range(0, len(outs), n_replicas()):
        batch = list(outs[first : first + n_replicas()])
        if not checkpoint_path(batch[0]).exists():
            continue
        simd = _simd(config, system_of(scene, config))
        simd.restore(read_checkpoint(checkpoint_path(batch[0]))[1])
        found.append(simd.positions_nm[: len(batch)])
    return np.concatenate(found)


def _simd(config: MDConfig, system: Any) -> SimdReplicas:
    bath: dict[str, Any] = {"temperature_k": config.temperature_k, "friction_per_ps": config.friction_per_ps}
    return SimdReplicas(system, **bath, timestep_ps=config.timestep_ps, seed=config.seed)


class _Batch(StoredRun):
    """Replicas in the vector registers of one core."""

    block_s = 2.0
    others = " and each other file of this batch"

    def start(self, starts_nm: npt.NDArray[np.floating] | None) -> None:
        """Go to where the batch was left, or to the starts, and equilibrate. Raises SimulationError."""
        config, system = self.config, system_of(self.scene, self.config)
        self.simd = _simd(config, system)
        self.n_dof = self.simd.n_dof
        if self.resumed:
            self.simd.restore(self.blob)
            return
        report_preparing(self.progress, 0.0)
        if starts_nm is None:
            # The Reference platform has no neighbour lists.
            platform = "Reference" if self.scene.cell_nm is None else "CPU"
            with Engine(self.scene, replace(config, platform=platform), system=system) as engine:
                engine.minimise()
                starts_nm = engine.positions()[None]
                refuse_damaged(self.scene, starts_nm[0])
        self.simd.check(system, starts_nm[0])
        # Replicas left over repeat the last start; they cost nothing and are not kept.
        self.simd.set_positions(starts_nm[np.minimum(np.arange(self.simd.n_replicas), len(starts_nm) - 1)])
        self.simd.thermalise()
        n_steps = math.ceil(round(config.equilibrate_ps / config.timestep_ps, 6))
        piece = max(1, min(1000, n_steps))
        for done in range(0, n_steps, piece):
            if self.asked_to_stop():
                raise KeyboardInterrupt
            self.simd.step(min(piece, n_steps - done))
            report_preparing(self.progress, min(1.0, (done + piece) / n_steps))
        self.blob = self.simd.checkpoint()
        self.save()

    def save(self) -> None:
        self.keep(self.blob, platform=SIMD)

    def frame(self) -> tuple[npt.NDArray[np.float32], dict[str, FloatArray]] | None:
        """Return positions and scalars of all replicas."""
        per_frame = self.config.steps_per_frame
        # As many at once as `SimdReplicas.step` would take of a frame's.
        for done in range(0, per_frame, CENTRED_STEPS):
            if self.asked_to_stop():
                return None
            self.simd.step(min(CENTRED_STEPS, per_frame - done))
        self.blob = self.simd.checkpoint()
        positions = self.simd.positions_nm
        scalars = {"potential_kj_mol": self.simd.energies(), "temperature_k": self.simd.temperatures_k()}
        return positions[:, self.atoms].astype(np.float32), own_scalars(self.config, scalars, positions)

    def append(self, writers: Sequence[TrajectoryWriter], frames: Sequence[Any], times_ps: npt.ArrayLike) -> None:
        positions = np.stack([positions for positions, _ in frames], axis=1)
        cell = self.scene.cell_nm
        cells = None if cell is None else np.repeat(cell[None], len(frames), axis=0)
        for k, writer in enumerate(writers):
            scalars = {name: np.array([each[name][k] for _, each in frames]) for name in frames[0][1]}
            writer.append(positions[k], times_ps, scalars=scalars, cell_nm=cells)


# ---- processes ------------------------------------------------------------------------------------------------------


# The exit status of a process that would start others while it imports the script which has started it.
_UNGUARDED = 79
_HELD = {signal.Signals[name] for name in {"SIGINT", "SIGHUP"} & set(signal.Signals.__members__)}


def refuse_within_import() -> None:
    """End this process if it is one that a script has started and that has not come further than that script."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(_UNGUARDED)


@contextmanager
def signals_held() -> Iterator[None]:
    """Have Ctrl-C and a hang-up wait, here until the block ends, in processes that it starts until they unblock them:
    what is still importing would print a traceback. Nothing where there are no signal masks (Windows)."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # which unblocks signals when it starts, in Python 3.11
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
    a start for each replica. Each is a process with its share of the cores; on platform simd up to sixteen share a
    process. `announce` gets the plan in one line, and the error of a replica that fails while others run, which it may
    raise to end them too; `progress` counts the frames of all replicas. Ctrl-C and SIGTERM stop them all with
    checkpoints: KeyboardInterrupt; without this process they stop by themselves. Raises InputError for a script that
    starts them outside `if __name__ == '__main__':`, SimulationError with the first replica's reason when the others
    have ended.
    """
    refuse_within_import()
    given = None if isinstance(scene, Scene) else list(scene)
    scene = scene if isinstance(scene, Scene) else scene[0]
    for out in outs:
        config = check_run(scene, config, out)
    size = n_replicas() if config.platform == SIMD else 1
    jobs = [range(k, min(k + size, len(outs))) for k in range(0, len(outs), size)]
    width = workers or min(len(jobs), available_cores())
    # What goes on keeps its platform.
    fresh = [out for out in outs if not (resume and (out.exists() or checkpoint_path(out).exists()))]
    choice = None
    if fresh:
        if config.platform != SIMD:
            each = max(1, available_cores() // width)
            choice = platform_for(scene, config, max_threads=each)
        if announce is not None:
            announce(plan_line(scene, config, choice or simd_choice(), replicas=len(outs)))
    scenes, found = [scene] * len(outs) if given is None else given, ""
    if fresh and given is None and config.starts == "many" and len(outs) > 1:
        report_preparing(progress, 0.0)
        if config.platform == SIMD:  # what it cannot compute is refused before any MD
            read_terms(build_system(scene, config.force), (), size)
        starts, found = many_starts(scene, config, len(outs))
        scenes = list(starts)
        if announce is not None:
            announce(found)

    def job(k: int) -> tuple[list[Scene], MDConfig, list[Path], dict[str, Any]]:
        own = replace(config, seed=config.seed + jobs[k][0])
        begun = {"starting_structures": found} if found else {}
        notes = [{"replica": i, "of_replicas": len(outs), **begun} for i in jobs[k]]
        how = {"resume": resume, "overwrite": overwrite, "choice": choice, "notes": notes}
        return [scenes[i] for i in jobs[k]], own, [outs[i] for i in jobs[k]], how

    if len(jobs) == 1:
        _run(*job(0), progress)
        return list(outs)
    context = multiprocessing.get_context("spawn")
    waiting = list(range(len(jobs)))
    running: dict[int, tuple[Any, Any]] = {}
    # Of each job, by its process: frames done, share equilibrated, the reason why it failed.
    said: list[dict[str, Any]] = [{} for _ in jobs]

    def error() -> SimulationError | None:
        failed = [k for k, words in enumerate(said) if "failed" in words]
        if not failed:
            return None
        reason = f"replica {jobs[failed[0]][0]}: {said[failed[0]]['failed']}"
        return SimulationError(f"{sum(len(jobs[k]) for k in failed)} of {len(outs)} replicas failed; {reason}")

    with deferred_interrupt() as asked_to_stop:
        try:
            while waiting or running:
                while waiting and len(running) < width:
                    k = waiting.pop(0)
                    pipe, end = context.Pipe(duplex=False)
                    process = context.Process(target=_replicas, args=(*job(k), end), name=f"replica-{jobs[k][0]}")
                    with signals_held():
                        process.start()
                    end.close()
                    running[k] = process, pipe
                time.sleep(0.1)
                if asked_to_stop():
                    raise KeyboardInterrupt
                for k, (process, pipe) in list(running.items()):
                    is_over = not process.is_alive()
                    with suppress(EOFError, OSError):
                        while pipe.poll():
                            said[k].update([pipe.recv()])
                    if not is_over:
                        continue
                    del running[k]
                    process.join()
                    if process.exitcode == _UNGUARDED:
                        raise InputError(
                            "each replica's process imports this script, which starts replicas again; put what starts "
                            "them below `if __name__ == '__main__':`."
                        )
                    if process.exitcode != 0:
                        said[k].setdefault("failed", f"exit code {process.exitcode}")
                        if announce is not None and (waiting or running):
                            announce(cast(SimulationError, error()))
                n_done = sum(words.get("done", 0) for words in said)
                if n_done == 0:
                    report_preparing(progress, sum(words.get("equilibrated", 0.0) for words in said) / len(jobs))
                elif progress is not None:
                    progress(n_done, config.n_frames * len(outs))
        finally:
            for process, _ in running.values():
                process.terminate()
            for process, _ in running.values():
                process.join()
    if failure := error():
        raise failure
    return list(outs)


def _run(
    scenes: Sequence[Scene], config: MDConfig, outs: Sequence[Path], how: dict[str, Any], progress: ProgressFn | None
) -> None:
    """Run one replica, or on platform simd a batch of them; `how`: what else `simulate` takes."""
    if config.platform == SIMD:
        starts = None if all(s is scenes[0] for s in scenes[1:]) else np.stack([s.positions_nm for s in scenes])
        of_files = {key: value for key, value in how.items() if key != "choice"}
        simulate_batch(scenes[0], config, outs, starts_nm=starts, progress=progress, **of_files)
    else:
        simulate(scenes[0], config, outs[0], progress=progress, **how)


def _replicas(scenes: Sequence[Scene], config: MDConfig, outs: Sequence[Path], how: dict[str, Any], pipe: Any) -> None:
    """Run a job in a process of its own, which says into `pipe` how far it is, or why it failed."""
    end_with_parent()
    os.environ["OPENMM_CPU_THREADS"] = "1"

    def report(done: int, total: int, note: str | None = None) -> None:
        with suppress(OSError):  # the parent is gone, and this process ends, too
            pipe.send(("done", done) if note is None else ("equilibrated", done / total))

    try:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _HELD)  # see `signals_held`
        _run(scenes, config, outs, how, report)
    except SurromdError as error:
        pipe.send(("failed", str(error)))
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        raise SystemExit(130) from None
