"""Tasks of a campaign's workers: prepare a scene, simulate one run from wherever it stands, report progress, stop.

A run's file belongs to one task at a time (systems.trajectory.claim), and a task stops by itself, with a checkpoint,
when the campaign that started it has not been heard of for a minute.
"""

from __future__ import annotations

import os
import platform
import signal
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from md_reference.campaign.campaign_file import Run, SceneSpec
from md_reference.campaign.manifest import MANIFEST_NAME, file_sha256, frames_sha256
from systems.errors import InputError, StorageError, SurromdError
from systems.interrupts import stop_when

# Without a word from the campaign for so long its runs stop.
LEASE_S = 60.0
# So long a task waits for another one, which is about to end, to let go of its file.
_CLAIM_PATIENCE_S = 2 * LEASE_S


@dataclass
class _Session:
    """One `surromd campaign` as its worker sees it: when it was last heard of, and the frames done per active run."""

    heard_at: float = field(default_factory=time.monotonic)
    stopped: bool = False
    frames: dict[str, int] = field(default_factory=dict)

    def should_stop(self) -> bool:
        return self.stopped or time.monotonic() - self.heard_at > LEASE_S


_sessions: dict[str, _Session] = {}
_sessions_lock = threading.Lock()


def _session(token: str) -> _Session:
    with _sessions_lock:
        return _sessions.setdefault(token, _Session())


def poll(token: str) -> dict[str, Any]:
    """Return this worker's process and the frames done by each of its active runs; the campaign is heard of."""
    session = _session(token)
    session.heard_at = time.monotonic()
    return {"pid": os.getpid(), "host": socket.gethostname(), "frames": dict(session.frames)}


def stop(token: str) -> None:
    """Have the runs of a campaign stop between two frames, with a checkpoint."""
    _session(token).stopped = True


def dask_setup(_: Any) -> None:
    """Called by Dask in a worker that starts: Ctrl-C goes to the campaign, which tells its workers."""
    with suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@dataclass(frozen=True)
class SceneTask:
    """Prepare a scene: `run` is any of its runs (they share all but temperature and seed), `seed` the scene's
    own, `replicas` how many begin apart."""

    token: str
    folder: str
    spec: SceneSpec
    run: Run
    seed: int
    replicas: int = 1


@dataclass(frozen=True)
class RunTask:
    """Simulate one run. `expected` is the hash of its frames where the manifest already has one."""

    token: str
    folder: str
    run: Run
    checkpoint_every_s: float
    expected: str = ""


def scene_path(folder: Path, name: str) -> Path:
    """Where the prepared scene lies, from which all its runs start."""
    return folder / "scenes" / f"{name}.json"


def prepare_scene(task: SceneTask) -> dict[str, Any]:
    """Prepare a scene once, decide what all its replicas share, write `scenes/NAME.json` and return its account.

    Force-field parameters are made here, so that replicas find them in the cache.
    """

    def work() -> dict[str, Any]:
        from md_reference.campaign.start_scene import prepare_once

        path = scene_path(Path(task.folder), task.spec.name)
        return prepare_once(path, task.spec, task.run.config, task.seed, task.replicas).account()

    return guarded(task.token, Path(task.folder) / MANIFEST_NAME, work)


def simulate_run(task: RunTask) -> dict[str, Any]:
    """Simulate a run, or go on with it, and return what the manifest says of it when it is complete."""
    folder, session = Path(task.folder), _session(task.token)

    def work() -> dict[str, Any]:
        # Read when OpenMM creates its first Context: one thread per replica.
        os.environ["OPENMM_CPU_THREADS"] = "1"
        session.frames[task.run.name] = 0
        try:
            return _simulate(task, folder, session)
        finally:
            session.frames.pop(task.run.name, None)

    return guarded(task.token, folder / MANIFEST_NAME, work)


def guarded(token: str, witness: Path, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what `work` returns, or how it ended; nothing is raised into Dask, which would count it as its own.

    `witness`: a file that whoever started the task has written where the task is to write. What waits within it, for a
    frame or for another program's charges, hears when the campaign is to stop.
    """
    session = _session(token)
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


def _simulate(task: RunTask, folder: Path, session: _Session) -> dict[str, Any]:
    from md_reference.campaign.start_scene import load_prepared
    from md_reference.run.simulate import simulate
    from systems.trajectory.claim import Claim
    from systems.trajectory.codec import companions, open_trajectory
    from systems.trajectory.topology_file import topology_path

    def report(done: int, total: int, note: str | None = None) -> None:
        if note is None:
            session.frames[task.run.name] = done

    prepared = load_prepared(scene_path(folder, task.run.scene))
    config = replace(task.run.config, force=prepared.force)
    out = folder / task.run.file
    out.parent.mkdir(parents=True, exist_ok=True)
    # A worker that this one stands in for, cut off and not yet stopped, may still have the file.
    Claim(out, patience_s=_CLAIM_PATIENCE_S, stopped=session.should_stop).close()
    simulate(
        prepared.start_of(task.run.replica, task.run.config),
        config,
        out,
        resume=True,
        progress=report,
        checkpoint_every_s=task.checkpoint_every_s,
        choice=prepared.platform,
    )
    with open_trajectory(out) as reader:
        record, n_frames = dict(reader.record), reader.n_frames
    digest = frames_sha256(out)
    if task.expected and digest != task.expected:
        raise InputError(
            f"{out} is not what this campaign once wrote there (its frames differ from {MANIFEST_NAME}); delete it to "
            "have the run made again."
        )
    # The PDB is for other programs: a run without it is whole.
    files = [path for path in (out, *companions(out)) if path.is_file() and path != topology_path(out)]
    return {
        "n_frames": n_frames,
        "size_bytes": out.stat().st_size,
        "sha256": {path.relative_to(folder).as_posix(): file_sha256(path) for path in files},
        "frames_sha256": digest,
        "platform": record.get("platform", ""),
        "programs": {"python": platform.python_version(), **record.get("program", {})},
        "host": socket.gethostname(),
        "wall_s": round(float(record.get("cost", {}).get("wall_s", 0.0)), 3),
    }
