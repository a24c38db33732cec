"""A campaign: many scenes, temperatures and replicas on Dask workers; whatever dies, what is left goes on from the
files. `manifest.json`, written by this process alone, says what is done."""

from __future__ import annotations

import itertools
import platform
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from md_reference.campaign.campaign_file import Campaign, Run, SceneSpec, first_seed
from md_reference.campaign.cluster import guarded, poll, result_of, stop
from md_reference.campaign.manifest import (
    COMPLETE,
    FAILED,
    MANIFEST_NAME,
    RUNNING,
    WAITING,
    Manifest,
    RunEntry,
    SceneEntry,
    read_manifest,
    write_manifest,
)
from md_reference.run.config import MDConfig, settings_of
from systems.errors import InputError, TrajectoryError
from systems.files.whole_file import OutputLock
from systems.interrupts import deferred_interrupt

_TICK_S = 0.1
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


def new_manifest(campaign: Campaign) -> Manifest:
    """Return the manifest of a campaign that has not begun."""
    from importlib.metadata import version

    programs = {name: version(name) for name in ("openmm", "distributed")}
    runs = {}
    for run in campaign.runs:
        name, kelvin, settings = run.name, run.config.temperature_k, settings_of(run.config)
        seed = settings.pop("seed")  # which belongs to the run's place among others
        runs[name] = RunEntry(name, run.scene, kelvin, run.replica, seed, run.file, settings, run.config.n_frames)
    return Manifest(
        name=campaign.name,
        seed=campaign.seed,
        scenes={s.name: SceneEntry(s.name, s.source, s.source_sha256, s.preparation) for s in campaign.scenes},
        runs=runs,
        programs={"python": platform.python_version(), **programs},
        started=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def check_same_campaign(old: Manifest, new: Manifest, folder: Path) -> Manifest:
    """Return the manifest to go on with: what `old` has done, and what `new` asks for besides.

    A campaign may grow, never change: seeds and settings of every old run must be those of the file. What is no longer
    as it was written (a trajectory that is gone or of another size) waits again, and so does what failed. Raises
    InputError with the first key that differs.
    """

    def same(key: str, was: Any, now: Any) -> None:
        if was != now:
            raise InputError(
                f"{folder} belongs to another campaign: there {key} is {was!r}, in this file {now!r}; restore it, or "
                "name another folder (out = ..., or `out`)."
            )

    scenes, runs = dict(new.scenes), dict(new.runs)
    same("seed", old.seed, new.seed)
    for name, scene in old.scenes.items():
        same("scenes", name, name if name in scenes else "without it")
        asked = scenes[name]
        is_moved = scene.source_sha256 and scene.source_sha256 == asked.source_sha256
        for key in ("source_sha256", "preparation") if is_moved else ("source", "source_sha256", "preparation"):
            same(f"{key} of scene {name}", getattr(scene, key), getattr(asked, key))
        scenes[name] = replace(scene, status=WAITING, reason="") if scene.status == FAILED else scene
    # A setting that an older version did not know counts as its default.
    defaults = settings_of(MDConfig(time_ps=0.0))
    for name, run in old.runs.items():
        if name not in runs:
            same(f"runs of scene {run.scene}", f"with {name}", "without it")
        same(f"file of {name}", run.file, runs[name].file)
        for key in {**run.settings, **runs[name].settings}:
            was, now = (given.get(key, defaults.get(key)) for given in (run.settings, runs[name].settings))
            same(f"{key} of scene {run.scene}", was, now)
        file = folder / run.file
        if run.status != COMPLETE or not file.is_file() or file.stat().st_size != run.size_bytes:
            run = replace(run, status=WAITING, reason="", n_frames=0)
        runs[name] = run
    return replace(new, scenes=scenes, runs=runs, started=old.started)


def open_campaign(campaign: Campaign) -> Manifest:
    """Create the campaign's folder, or take up the one that is there, and return its manifest. Raises InputError when
    the folder belongs to another campaign (with the first key that differs), or holds other things; StorageError when
    it cannot be written."""
    folder = campaign.folder
    manifest = new_manifest(campaign)
    if (folder / MANIFEST_NAME).is_file():
        manifest = check_same_campaign(read_manifest(folder), manifest, folder)
    elif folder.is_file():
        raise InputError(f"{folder} is a file; name another folder (out = ..., or `out`).")
    elif folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise InputError(f"{folder} is not empty and no campaign's folder; name another (out = ..., or `out`).")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "campaign.toml").write_bytes(campaign.file.read_bytes())
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

    `failed(name, reason)` is called when a scene or a run is given up: after `retries` further attempts, or at once
    where its input is at fault. The others run on. Ctrl-C and SIGTERM stop the active runs between two frames, with
    checkpoints: KeyboardInterrupt with a summary. Raises what `open_campaign` raises, and InputError when another
    process runs the same campaign.
    """
    with _only_process(campaign.folder), deferred_interrupt() as asked_to_stop:
        job = _Job(campaign, client, open_campaign(campaign), failed or (lambda name, reason: None))
        try:
            with job.polling(poll_every_s):
                while job.tick():
                    if progress is not None:
                        progress(job.progress())
                    if asked_to_stop():
                        job.stop()
                        done, n = job.manifest.counts().get(COMPLETE, 0), len(job.manifest.runs)
                        raise KeyboardInterrupt(
                            f"{done} of {n} runs in {campaign.folder} are complete, unfinished ones are kept; run "
                            "the same command to continue"
                        )
                if progress is not None:
                    progress(job.progress())
        finally:
            write_manifest(campaign.folder, job.manifest)
    return job.manifest


class _Job:
    """The tasks of one campaign: scenes first, each scene's runs when it is prepared, what failed once more."""

    def __init__(self, campaign: Campaign, client: Any, manifest: Manifest, failed: Callable[[str, str], None]) -> None:
        from distributed import as_completed

        self.manifest = manifest
        self._campaign, self._client, self._failed = campaign, client, failed
        self._folder = campaign.folder.resolve()  # as workers see it
        self._token = uuid.uuid4().hex
        self._ended = as_completed(loop=client.loop)
        # Of each task that is out, by its key: what it does, which attempt it is, its future.
        self._out: dict[str, tuple[SceneSpec | Run, int, Any]] = {}
        self._numbers = itertools.count()
        self._active: dict[int, dict[str, int]] = {}
        self._is_written, self._write_at = True, 0.0
        self._runs: dict[str, list[Run]] = {}
        for run in campaign.runs:
            if manifest.runs[run.name].status != COMPLETE:
                self._runs.setdefault(run.scene, []).append(run)
        for spec in campaign.scenes:
            if spec.name in self._runs:
                self._submit(spec)

    def tick(self) -> bool:
        """Take what has ended, write the manifest now and then, and return whether anything is out still."""
        if not self._ended.has_ready():
            time.sleep(_TICK_S)
        self._collect()
        for name in {name for runs in self._active.values() for name in runs}:
            if self.manifest.runs[name].status == WAITING:
                self._note(self.manifest.runs, name, status=RUNNING)
        if not self._is_written and time.monotonic() > self._write_at:
            began = time.monotonic()
            write_manifest(self._campaign.folder, self.manifest)
            ended = time.monotonic()
            # A manifest of many thousand runs takes its time: at most a twentieth of all.
            self._is_written, self._write_at = True, ended + _WRITE_EVERY_S + 20 * (ended - began)
        return bool(self._out)

    def stop(self) -> None:
        """Stop active runs between two frames and withdraw the others; return when they have stopped."""
        active = {name for runs in self._active.values() for name in runs}
        withdrawn = {key: future for key, (task, _, future) in self._out.items() if task.name not in active}
        self._out = {key: out for key, out in self._out.items() if key not in withdrawn}
        self._client.cancel(list(withdrawn.values()))
        with suppress(Exception):  # workers that are gone have stopped
            self._client.run(stop, self._token, on_error="ignore")
        deadline = time.monotonic() + _STOP_PATIENCE_S
        while self._out and time.monotonic() < deadline:
            time.sleep(_TICK_S)
            self._collect(again=False)
        for name, entry in list(self.manifest.runs.items()):
            if entry.status == RUNNING:
                self._note(self.manifest.runs, name, status=WAITING)

    def progress(self) -> CampaignProgress:
        """Return how far the campaign is; an active run counts the frames that its worker last reported."""
        entries, active = self.manifest.runs, dict(self._active)
        done = sum(run.n_frames for run in entries.values() if run.status == COMPLETE)
        done += sum(n for runs in active.values() for name, n in runs.items() if entries[name].status != COMPLETE)
        states = [run.status for run in entries.values()]
        total = sum(run.n_frames_wanted for run in entries.values() if run.status != FAILED)
        return CampaignProgress(done, total, states.count(COMPLETE), states.count(FAILED), len(states), active)

    @contextmanager
    def polling(self, every_s: float) -> Iterator[None]:
        """Ask the workers how far they are, in a thread of its own: a worker that hangs must not stop the campaign."""
        over = threading.Event()

        def ask() -> None:
            while not over.wait(every_s):
                with suppress(Exception):  # asked again soon
                    found = self._client.run(poll, self._token, on_error="ignore")
                    reports = [report for report in found.values() if isinstance(report, dict)]
                    self._active = {report["pid"]: report["frames"] for report in reports}

        thread = threading.Thread(target=ask, name="campaign-poll", daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join(timeout=5.0)

    def _submit(self, task: SceneSpec | Run, attempt: int = 1) -> None:
        """Hand out a task. Scenes go first, then long runs, so that the workers end together. A key of its own for each
        attempt: Dask takes a key that it knows for a result that is there."""
        key = f"surromd-{self._token}-{task.name}-{next(self._numbers)}"
        own: tuple[Any, ...]
        if isinstance(task, SceneSpec):
            runs, seed = self._runs[task.name], first_seed(self._campaign.seed, task.name, 0.0)
            own = ("prepare_scene", task, runs[0].config, seed, 1 + max(run.replica for run in runs))
            priority = 1 << 62
        else:
            own = ("simulate_run", self._token, task)
            n_steps = task.config.n_frames * task.config.steps_per_frame
            priority = (self.manifest.scenes[task.scene].n_atoms or 1) * n_steps
        future = self._client.submit(_work, self._token, self._folder, *own, key=key, priority=priority)
        self._out[key] = (task, attempt, future)
        self._ended.add(future)

    def _collect(self, *, again: bool = True) -> None:
        """Note what ended tasks returned, and hand out what that made possible, or what failed `again`."""
        for future in self._ended.next_batch(block=False):
            task, attempt, _ = self._out.pop(future.key, (None, 0, None))
            if task is None:
                continue  # withdrawn
            result = result_of(future)
            status = result.pop("status")
            if status == COMPLETE:
                self._done(task, attempt, status=COMPLETE, reason="", **result)
            elif not again:
                continue
            elif status == "stopped":  # it had not heard of us for long, as when this machine slept
                self._submit(task, attempt)
            elif result["hopeless"] or attempt > self._campaign.retries:
                reason = " ".join(result["reason"].split())
                self._failed(task.name, reason)
                self._done(task, attempt, status=FAILED, reason=reason)
            else:
                self._submit(task, attempt + 1)

    def _done(self, task: SceneSpec | Run, attempt: int, **entries: Any) -> None:
        if isinstance(task, Run):
            attempts = self.manifest.runs[task.name].attempts + attempt
            self._note(self.manifest.runs, task.name, attempts=attempts, **entries)
            return
        self._note(self.manifest.scenes, task.name, **entries)
        for run in self._runs[task.name]:
            if entries["status"] == COMPLETE:
                self._submit(run)
            else:
                reason = f"scene {task.name}: {entries['reason']}"
                self._note(self.manifest.runs, run.name, status=FAILED, reason=reason)

    def _note(self, table: dict[str, Any], name: str, **entries: Any) -> None:
        table[name] = replace(table[name], **entries)
        self._is_written = False


def _work(token: str, folder: Path, name: str, *given: Any) -> dict[str, Any]:
    """Do a task of `md_reference.campaign.worker`, which imports OpenMM: only workers do."""

    def work() -> dict[str, Any]:
        from md_reference.campaign import worker

        result: dict[str, Any] = getattr(worker, name)(folder, *given)
        return result

    return guarded(token, folder / MANIFEST_NAME, work)


@contextmanager
def _only_process(folder: Path) -> Iterator[None]:
    """Hold the campaign's lock. Raises InputError when another process runs the campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = OutputLock(folder / MANIFEST_NAME)
    except TrajectoryError:
        raise InputError(f"{folder}: another process runs this campaign; wait for it, or stop it first.") from None
    with lock:
        yield
