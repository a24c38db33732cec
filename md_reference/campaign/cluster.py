"""Workers for a campaign: processes of this machine, a Dask scheduler that runs already, or jobs of a batch system."""

from __future__ import annotations

import importlib
import logging
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from md_reference.campaign.campaign_file import JOB_LOGS, ClusterSpec
from md_reference.forces.small_molecules.programs import scratch_folder
from md_reference.run.machine import available_cores
from systems.errors import InputError, SimulationError
from systems.interrupts import deferred_interrupt, stop_if_asked

_CLASSES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "sge": "SGECluster",
    "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster",
    "moab": "MoabCluster",
    "oar": "OARCluster",
    "local": "LocalCluster",
}
_ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OPENMM_CPU_THREADS": "1"}
# Dask listens for browsers in any case: where nobody does, and at no port that another asks for.
_NO_PAGE = "127.0.0.1:0"
_NO_PAGES = {"DASK_DISTRIBUTED__WORKER__HTTP__ROUTES": "[]"}
# So long a scheduler may take to answer.
_ANSWER_S = 20.0
_PRELOAD = "md_reference.campaign.worker"


@contextmanager
def open_client(
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: ClusterSpec | None = None,
    retries: int = 2,
    folder: Path = Path(),
) -> Iterator[Any]:
    """Yield a `distributed.Client` and close what was started for it. An interruption waits until all is started.

    `scheduler` (tls://host:port, or tcp:// if its owner wants no lock) goes before `cluster`, and both before local
    workers, one thread each (`workers`, as many as there are cores by default). Who can reach a scheduler runs code as
    its user, so what is started here talks by TLS with a certificate of its own, which nobody else has, on one network
    interface, local workers on the loopback, and shows no status page unless `[cluster] dashboard` asks for one.
    Raises InputError when no scheduler answers or dask-jobqueue is not installed.
    """
    _refuse_both(workers, scheduler)
    import dask
    from distributed import Client

    settings = {"distributed.scheduler.allowed-failures": retries, "distributed.worker.http.routes": []}
    if cluster is None or not cluster.dashboard:
        settings["distributed.scheduler.http.routes"] = []
    with _quiet(), dask.config.set(settings), ExitStack() as stack:
        if scheduler is not None:
            try:
                client = stack.enter_context(Client(scheduler, timeout=_ANSWER_S, set_as_default=False))
            except (OSError, ValueError) as error:
                raise InputError(f"no Dask scheduler answers at {scheduler} ({error}).") from error
        else:
            if cluster is None:
                scratch = stack.enter_context(scratch_folder("surromd-dask-"))
                stack.enter_context(dask.config.set({"temporary-directory": str(scratch)}))
            with deferred_interrupt():  # Dask cannot be stopped while it starts
                started = _local(workers or available_cores()) if cluster is None else _jobs(cluster, folder)
                client = stack.enter_context(Client(stack.enter_context(started), set_as_default=False))
                stop_if_asked()
        yield client


def _refuse_both(workers: int | None, scheduler: str | None) -> None:
    if workers is not None and scheduler is not None:
        raise InputError("`workers` starts workers here, `scheduler` uses those that are there; give one of them.")


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Dask's loggers: what matters of them stands in the campaign's own account."""
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado", "asyncio", "dask_jobqueue")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


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
        preload=[_PRELOAD],
    )


def _jobs(spec: ClusterSpec, folder: Path) -> Any:
    started = job_cluster(spec, folder)
    # Jobs end with their walltime: new ones are asked for as long as there is work.
    started.adapt(minimum_jobs=0, maximum_jobs=spec.jobs, interval="5s")
    return started


def job_cluster(spec: ClusterSpec, folder: Path) -> Any:
    """Return dask-jobqueue's cluster for the `[cluster]` table, without any job yet (`job_script()` shows one).

    Each of its jobs holds `cores` worker processes of one thread. The certificate by which scheduler and workers know
    each other lies in the folder of the jobs' logs, readable for this user alone, until the cluster is closed. Raises
    InputError where dask-jobqueue is not installed or refuses an entry.
    """
    on_ctrl_c = signal.getsignal(signal.SIGINT)
    try:
        # LocalCluster stands in its own module only.
        classes = importlib.import_module(f"dask_jobqueue.{spec.kind}")
    except ImportError:
        raise InputError("[cluster] needs dask-jobqueue: pip install 'surromd[cluster]'.") from None
    finally:
        # Importing dask-jobqueue makes Ctrl-C a silent success of the whole program.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, on_ctrl_c)
    from distributed import Security
    from distributed.utils import get_ip

    one_thread = [f"{name}={value}" for name, value in (_ONE_THREAD | _NO_PAGES).items()]
    python, prologue = spec.python, [*(f"export {entry}" for entry in one_thread), *spec.prologue]
    if spec.kind == "local":
        # Its jobs are started without a shell: the command is all there can be.
        if spec.prologue:
            raise InputError("[cluster] local takes no prologue; what it holds must be done before surromd is started.")
        python, prologue = " ".join(["env", *one_thread, spec.python or sys.executable]), []
    logs = (folder / JOB_LOGS).resolve()
    logs.mkdir(parents=True, exist_ok=True)
    scheduler: dict[str, Any] = {"dashboard": bool(spec.dashboard), "dashboard_address": spec.dashboard or _NO_PAGE}
    if not spec.interface:
        scheduler["host"] = "127.0.0.1" if spec.kind == "local" else get_ip()
    arguments: dict[str, Any] = {
        "protocol": "tls://",
        "security": Security.temporary(),
        "shared_temp_directory": str(logs),
        "scheduler_options": scheduler,
        "cores": spec.cores,
        "processes": spec.cores,
        "memory": spec.memory,
        "job_extra_directives": list(spec.directives),
        "job_script_prologue": prologue,
        "worker_extra_args": ["--preload", _PRELOAD, "--no-dashboard"],
        "log_directory": str(logs),
    }
    named = ("walltime", "queue", "account", "interface")
    arguments |= {key: value for key in named if (value := getattr(spec, key))}
    if python:
        arguments["python"] = python
    try:
        return getattr(classes, _CLASSES[spec.kind])(**arguments)
    except (TypeError, ValueError) as error:
        raise InputError(f"[cluster] {spec.kind} does not take this: {error}.") from error
    except OSError as error:
        raise SimulationError(f"[cluster] {spec.kind} cannot be started here: {error}.") from error
