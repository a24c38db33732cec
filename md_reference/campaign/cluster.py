"""Dask for campaigns: workers of this machine or of a scheduler that runs already; and the sessions by which a worker's
tasks report how far they are, and stop when the command that started them is gone."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from md_reference.forces.programs import scratch_folder
from systems.errors import InputError, SimulationError, StorageError, SurromdError
from systems.interrupts import deferred_interrupt, stop_if_asked, stop_when

# Without a word from the command that started them for so long, runs stop.
LEASE_S = 60.0
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENMM_CPU_THREADS": "1"}
# Dask listens for browsers in any case: where nobody does, and at no port that another asks for.
_NO_PAGE = "127.0.0.1:0"
# So long a scheduler may take to answer.
_ANSWER_S = 20.0


@contextmanager
def open_client(*, workers: int | None = None, scheduler: str | None = None, retries: int = 2) -> Iterator[Any]:
    """Yield a `distributed.Client` and close what was started for it. An interruption waits until all is started.

    `scheduler` (tls://host:port, or tcp:// if its owner wants no lock) goes before local workers, one thread each
    (`workers`, as many as there are cores by default). Who can reach a scheduler runs code as its user, so what is
    started here talks by TLS with a certificate of its own, which nobody else has, on the loopback, and shows no status
    page. Raises InputError when no scheduler answers.
    """
    if workers is not None and scheduler is not None:
        raise InputError("`workers` starts workers here, `scheduler` uses those that are there; give one of them.")
    import dask
    from distributed import Client

    from md_reference.run.machine import available_cores  # slow to import

    no_pages: dict[str, list[str]] = {f"distributed.{part}.http.routes": [] for part in ("worker", "scheduler")}
    with ExitStack() as stack:
        # What matters of Dask's messages stands in the campaign's own summary.
        for logger in map(logging.getLogger, ("distributed", "tornado", "asyncio")):
            stack.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        stack.enter_context(dask.config.set({"distributed.scheduler.allowed-failures": retries, **no_pages}))
        if scheduler is not None:
            try:
                client = stack.enter_context(Client(scheduler, timeout=_ANSWER_S, set_as_default=False))
            except (OSError, ValueError) as error:
                raise InputError(f"no Dask scheduler answers at {scheduler} ({error}).") from error
        else:
            scratch = stack.enter_context(scratch_folder("surromd-dask-"))
            stack.enter_context(dask.config.set({"temporary-directory": str(scratch)}))
            with deferred_interrupt():  # Dask cannot be stopped while it starts
                started = stack.enter_context(_local(workers or available_cores()))
                client = stack.enter_context(Client(started, set_as_default=False))
                stop_if_asked()
        yield client


def _local(workers: int) -> Any:
    from distributed import LocalCluster, Security

    return LocalCluster(
        n_workers=workers,
        host="127.0.0.1",
        protocol="tls://",
        security=Security.temporary(),
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": _NO_PAGE},
        memory_limit=0,
        silence_logs=logging.CRITICAL,
        env=_ONE_THREAD,
        preload=[__name__],
    )


@dataclass
class Session:
    """One command as its worker sees it: when it was last heard of, and the frames done per active run."""

    heard_at: float = field(default_factory=time.monotonic)
    stopped: bool = False
    frames: dict[str, int] = field(default_factory=dict)

    def should_stop(self) -> bool:
        return self.stopped or time.monotonic() - self.heard_at > LEASE_S


_sessions: dict[str, Session] = {}
_sessions_lock = threading.Lock()


def session_of(token: str) -> Session:
    """Return this worker's session of the command that goes by `token`."""
    with _sessions_lock:
        return _sessions.setdefault(token, Session())


def poll(token: str) -> dict[str, Any]:
    """Return this worker's process and the frames done by each of its active runs; the command is heard of."""
    session = session_of(token)
    session.heard_at = time.monotonic()
    return {"pid": os.getpid(), "frames": dict(session.frames)}


def stop(token: str) -> None:
    """Have the runs of a command stop between two frames, with a checkpoint."""
    session_of(token).stopped = True


def dask_setup(_: Any) -> None:
    """Called by Dask in a worker that starts: Ctrl-C goes to the command, which tells its workers."""
    with suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def guarded(token: str, witness: Path, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what `work` returns, or how it ended; nothing is raised into Dask, which would count it as its own.
    `witness`: a file that whoever started the task has written where the task is to write. What waits within it, for a
    frame or for another program's charges, hears when the command is to stop."""
    session = session_of(token)
    if session.stopped:
        return {"status": "stopped"}
    try:
        # A file system that lags behind, or is not shared, is the only reason for its absence.
        if not witness.is_file():
            raise StorageError(f"{socket.gethostname()} does not see {witness}; all workers must share that folder.")
        with stop_when(session.should_stop):
            return {"status": "complete", **work()}
    except KeyboardInterrupt:
        return {"status": "stopped"}
    except SurromdError as error:
        return {"status": "failed", "reason": str(error), "hopeless": isinstance(error, InputError)}
    except Exception as error:
        return {"status": "failed", "reason": f"{type(error).__name__}: {error}", "hopeless": False}


def result_of(future: Any) -> dict[str, Any]:
    """Return what a task returned; one that Dask itself gave up counts as failed, and may be tried again."""
    if future.status == "cancelled":
        raise SimulationError("the Dask scheduler is gone; run the same command to continue with another.")
    if future.status == "error":
        error = future.exception()
        killed = type(error).__name__ == "KilledWorker"
        reason = "its workers were killed repeatedly" if killed else f"{type(error).__name__}: {error}"
        return {"status": "failed", "reason": reason, "hopeless": False}
    return dict(future.result())
