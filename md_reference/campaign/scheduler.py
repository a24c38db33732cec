"""A campaign: many scenes, temperatures and replicas on Dask workers; whatever dies, what is left goes on.

Every run is one task, and its state is its files: a task that starts again, on whichever worker, goes on from the run's
checkpoint. `manifest.json` says what is done; it is written by this process alone.
"""

from __future__ import annotations

import queue
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from md_reference.campaign.campaign_file import JOB_LOGS, Campaign, Run, first_seed
from md_reference.campaign.manifest import (
    COMPLETE,
    FAILED,
    MANIFEST_NAME,
    RUNNING,
    WAITING,
    Manifest,
    read_manifest,
    write_manifest,
)
from md_reference.campaign.planned_manifest import check_same_campaign, new_manifest
from md_reference.campaign.worker import RunTask, SceneTask, poll, prepare_scene, simulate_run, stop
from systems.errors import InputError, SimulationError, TrajectoryError
from systems.interrupts import deferred_interrupt
from systems.trajectory.claim import Claim

_TICK_S = 0.25
_WRITE_EVERY_S = 2.0
# Runs that were asked to stop have so long to come to the end of a frame.
_STOP_PATIENCE_S = 60.0


@dataclass(frozen=True)
class CampaignProgress:
    """How far a campaign is: frames over all runs, runs by state, and the frames of active runs by worker process."""

    frames_done: int
    frames_total: int
    runs_complete: int
    runs_failed: int
    runs_total: int
    active: dict[int, dict[str, int]]


@dataclass
class _State:
    """What the campaign's process keeps while running."""

    manifest: Manifest
    futures: dict[str, Any] = field(default_factory=dict)
    attempts: dict[str, int] = field(default_factory=dict)
    active: dict[int, dict[str, int]] = field(default_factory=dict)
    changed: bool = True

    def update(self, name: str, **entries: Any) -> None:
        self.manifest = self.manifest.with_run(replace(self.manifest.runs[name], **entries))
        self.changed = True


def open_campaign(campaign: Campaign) -> Manifest:
    """Create the campaign's folder, or take up the one that is there, and return its manifest.

    Raises InputError when the folder belongs to another campaign (with the first key that differs), or holds other
    things; StorageError when it cannot be written.
    """
    folder = campaign.folder
    manifest = new_manifest(campaign)
    if (folder / MANIFEST_NAME).is_file():
        manifest = check_same_campaign(read_manifest(folder), manifest, folder)
    elif folder.is_file():
        raise InputError(f"{folder} is a file; name another folder (out = ..., or `out`).")
    elif folder.is_dir() and any(not path.name.startswith(".") and path.name != JOB_LOGS for path in folder.iterdir()):
        raise InputError(f"{folder} is not empty and no campaign's folder; name another (out = ..., or `out`).")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "campaign.toml").write_text(campaign.text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder} cannot be made or written: {error.strerror}.") from error
    write_manifest(folder, manifest)
    return manifest


def run_campaign(
    campaign: Campaign,
    client: Any,
    *,
    progress: Callable[[CampaignProgress], None] | None = None,
    failed: Callable[[str, str], None] | None = None,
    poll_every_s: float = 1.0,
) -> Manifest:
    """Run what is not yet complete on a Dask client's workers and return the manifest, which is on disk.

    `progress` is called several times a second with what the workers said when last asked. `failed(name, reason)` is
    called when a scene or a run is given up: after `retries` further attempts, or at once where its input is at fault.
    The others run on.
    Ctrl-C and SIGTERM stop the active runs between two frames, with checkpoints: KeyboardInterrupt with an account.
    Raises what `open_campaign` raises, and InputError when another process runs the same campaign.
    """
    with _only_process(campaign.folder):
        state = _State(open_campaign(campaign))
        job = _Job(campaign, client, state, failed or (lambda name, reason: None), poll_every_s)
        with deferred_interrupt() as asked_to_stop, job.polling():
            try:
                job.start()
                while state.futures:
                    job.tick()
                    if progress is not None:
                        progress(job.progress())
                    if asked_to_stop():
                        job.stop()
                        raise KeyboardInterrupt(_account(state.manifest, campaign.folder))
                if progress is not None:
                    progress(job.progress())
            finally:
                write_manifest(campaign.folder, state.manifest)
    return state.manifest


def _account(manifest: Manifest, folder: Path) -> str:
    done = sum(run.status == COMPLETE for run in manifest.runs.values())
    return (
        f"{done} of {len(manifest.runs)} runs in {folder} are complete, begun ones are kept; the same command goes on"
    )


class _Job:
    """The tasks of one campaign: handed out, collected, tried again."""

    def __init__(
        self,
        campaign: Campaign,
        client: Any,
        state: _State,
        failed: Callable[[str, str], None],
        poll_every_s: float,
    ) -> None:
        self._campaign, self._client, self._state, self._failed = campaign, client, state, failed
        self._poll_every_s = poll_every_s
        self._token = uuid.uuid4().hex
        self._ended: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._runs: dict[str, list[Run]] = {}
        self._written_at = 0.0
        for run in campaign.runs:
            if state.manifest.runs[run.name].status != COMPLETE:
                self._runs.setdefault(run.scene, []).append(run)

    def start(self) -> None:
        """Hand out the preparation of every scene that has runs left; its runs follow when it is done."""
        for name in self._runs:
            self._submit_scene(name)

    def tick(self) -> None:
        """Wait a moment for tasks that end, take their results, and write the manifest now and then."""
        with suppress(queue.Empty):
            self._collect(*self._ended.get(timeout=min(_TICK_S, self._poll_every_s)))
            while True:
                self._collect(*self._ended.get_nowait())
        for name in {name for runs in self._state.active.values() for name in runs}:
            entry = self._state.manifest.runs.get(name)
            if entry is not None and entry.status == WAITING:
                self._state.update(name, status=RUNNING)
        if self._state.changed and time.monotonic() - self._written_at > _WRITE_EVERY_S:
            began = time.monotonic()
            write_manifest(self._campaign.folder, self._state.manifest)
            self._state.changed = False
            # A manifest of many thousand runs takes its time: at most a twentieth of all.
            self._written_at = time.monotonic() + 20 * (time.monotonic() - began)

    def stop(self) -> None:
        """Stop active runs between two frames and withdraw the others; return when they have stopped."""
        state = self._state
        active = {name for runs in state.active.values() for name in runs}
        self._client.cancel([future for name, future in state.futures.items() if name not in active])
        state.futures = {name: future for name, future in state.futures.items() if name in active}
        with suppress(Exception):  # workers that are gone have stopped
            self._client.run(stop, self._token, on_error="ignore")
        deadline = time.monotonic() + _STOP_PATIENCE_S
        while state.futures and time.monotonic() < deadline:
            with suppress(queue.Empty):
                self._collect(*self._ended.get(timeout=_TICK_S), again=False)
        for name, entry in state.manifest.runs.items():
            if entry.status == RUNNING:
                state.update(name, status=WAITING)

    def progress(self) -> CampaignProgress:
        """Return how far the campaign is; an active run counts the frames that its worker last reported."""
        entries = self._state.manifest.runs
        done = sum(run.n_frames for run in entries.values() if run.status == COMPLETE)
        active = dict(self._state.active)
        for runs in active.values():
            done += sum(n for name, n in runs.items() if entries[name].status != COMPLETE)
        states = [run.status for run in entries.values()]
        total = sum(run.n_frames_wanted for run in entries.values() if run.status != FAILED)
        return CampaignProgress(done, total, states.count(COMPLETE), states.count(FAILED), len(states), active)

    @contextmanager
    def polling(self) -> Iterator[None]:
        """Ask the workers how far they are, in a thread of its own: a worker that hangs must not stop the campaign."""
        over = threading.Event()

        def ask() -> None:
            while not over.wait(self._poll_every_s):
                with suppress(Exception):  # asked again soon
                    found = self._client.run(poll, self._token, on_error="ignore")
                    reports = [report for report in found.values() if isinstance(report, dict)]
                    self._state.active = {report["pid"]: report["frames"] for report in reports}

        thread = threading.Thread(target=ask, name="campaign-poll", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join(timeout=5.0)

    def _submit_scene(self, name: str) -> None:
        spec = next(scene for scene in self._campaign.scenes if scene.name == name)
        seed = first_seed(self._campaign.seed, name, 0.0)
        runs = self._runs[name]
        replicas = 1 + max(run.replica for run in runs)
        task = SceneTask(self._token, str(self._campaign.folder.resolve()), spec, runs[0], seed, replicas)
        self._submit(f"scene/{name}", prepare_scene, task, priority=1 << 62)

    def _submit_run(self, run: Run) -> None:
        task = RunTask(
            self._token,
            str(self._campaign.folder.resolve()),
            run,
            self._campaign.checkpoint_every_s,
            self._state.manifest.runs[run.name].frames_sha256,
        )
        # Long runs first: the workers then end together.
        atoms = self._state.manifest.scenes[run.scene].n_atoms or 1
        self._submit(run.name, simulate_run, task, priority=atoms * run.config.n_frames * run.config.steps_per_frame)

    def _submit(self, name: str, work: Callable[[Any], dict[str, Any]], task: Any, *, priority: int) -> None:
        attempt = self._state.attempts[name] = self._state.attempts.get(name, 0) + 1
        key = f"surromd-{self._token}-{name}-{attempt}"
        future = self._client.submit(work, task, key=key, priority=priority, pure=False)
        self._state.futures[name] = future
        future.add_done_callback(lambda done: self._ended.put((name, done)))

    def _collect(self, name: str, future: Any, *, again: bool = True) -> None:
        """Take what a task returned: note it, hand out what it made possible, or try again."""
        if self._state.futures.get(name) is not future:
            return
        del self._state.futures[name]
        result = result_of(future)
        kind, _, scene = name.partition("/")
        is_scene = kind == "scene" and bool(scene)
        if result["status"] == "complete":
            result.pop("status")
            self._scene_done(scene, result) if is_scene else self._run_done(name, result)
            return
        if not again:
            return
        if result["status"] == "stopped":  # it had not heard of us for long, as when this machine slept
            self._state.attempts[name] -= 1
        elif result["hopeless"] or self._state.attempts[name] > self._campaign.retries:
            self._give_up(scene if is_scene else name, result["reason"], is_scene=is_scene)
            return
        if is_scene:
            self._submit_scene(scene)
        else:
            self._submit_run(next(run for run in self._campaign.runs if run.name == name))

    def _scene_done(self, name: str, account: dict[str, Any]) -> None:
        account["repairs"] = tuple(account["repairs"])
        self._update_scene(name, status=COMPLETE, reason="", **account)
        for run in self._runs[name]:
            self._submit_run(run)

    def _run_done(self, name: str, account: dict[str, Any]) -> None:
        attempts = self._state.manifest.runs[name].attempts + self._state.attempts[name]
        self._state.update(name, status=COMPLETE, reason="", attempts=attempts, **account)

    def _give_up(self, name: str, reason: str, *, is_scene: bool) -> None:
        reason = " ".join(reason.split())
        self._failed(name, reason)
        if not is_scene:
            attempts = self._state.manifest.runs[name].attempts + self._state.attempts[name]
            self._state.update(name, status=FAILED, reason=reason, attempts=attempts)
            return
        self._update_scene(name, status=FAILED, reason=reason)
        for run in self._runs[name]:
            self._state.update(run.name, status=FAILED, reason=f"scene {name}: {reason}")

    def _update_scene(self, name: str, **entries: Any) -> None:
        manifest = self._state.manifest
        scene = replace(manifest.scenes[name], **entries)
        self._state.manifest = replace(manifest, scenes={**manifest.scenes, name: scene})
        self._state.changed = True


def result_of(future: Any) -> dict[str, Any]:
    """Return what a task returned; one that Dask itself gave up counts as failed, and may be tried again."""
    if future.status == "cancelled":
        raise SimulationError("the Dask scheduler is gone; the same command goes on with another.")
    if future.status == "error":
        error = future.exception()
        killed = type(error).__name__ == "KilledWorker"
        reason = "its workers were killed again and again" if killed else f"{type(error).__name__}: {error}"
        return {"status": "failed", "reason": reason, "hopeless": False}
    return dict(future.result())


@contextmanager
def _only_process(folder: Path) -> Iterator[None]:
    """Hold the campaign's claim. Raises InputError when another process runs the campaign."""
    existed = folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    try:
        claim = Claim(folder / MANIFEST_NAME)
    except TrajectoryError:
        raise InputError(f"{folder}: another process runs this campaign; wait for it, or stop it first.") from None
    try:
        with claim:
            yield
    finally:
        if not existed and not (folder / MANIFEST_NAME).exists():
            with suppress(OSError):
                folder.rmdir()
