"""A campaign's manifest, made from its file, and held against the one that a folder already has."""

from __future__ import annotations

import platform
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from md_reference.campaign.campaign_file import Campaign
from md_reference.campaign.manifest import COMPLETE, FAILED, WAITING, Manifest, RunEntry, SceneEntry
from md_reference.campaign.run_options import default_of, flat_settings, key_of
from systems.errors import InputError


def new_manifest(campaign: Campaign) -> Manifest:
    """Return the manifest of a campaign that has not begun."""
    from importlib.metadata import version

    scenes = [SceneEntry(s.name, s.source, s.source_sha256, s.preparation) for s in campaign.scenes]
    runs = [
        RunEntry(
            name=run.name,
            scene=run.scene,
            temperature_k=run.config.temperature_k,
            replica=run.replica,
            seed=run.config.seed,
            file=run.file,
            settings=flat_settings(run.config),
            n_frames_wanted=run.config.n_frames,
        )
        for run in campaign.runs
    ]
    return Manifest(
        name=campaign.name,
        seed=campaign.seed,
        scenes={scene.name: scene for scene in scenes},
        runs={run.name: run for run in runs},
        programs={"python": platform.python_version()} | {name: version(name) for name in ("openmm", "distributed")},
        started=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def check_same_campaign(old: Manifest, new: Manifest, folder: Path) -> Manifest:
    """Return the manifest to go on with: what `old` has done, and what `new` asks for besides.

    A campaign may grow (scenes, temperatures, replicas are added), never change: seeds and settings of every old run
    must be those of the file. Raises InputError with the first key that differs. What is no longer as it was written
    (a trajectory that is gone or of another size) waits again, and so does what failed.
    """

    def refuse(key: str, was: Any, now: Any) -> InputError:
        return InputError(
            f"{folder} belongs to another campaign: there {key} is {was!r}, in this file {now!r}; restore it, or "
            "name another folder (out = ..., or `out`)."
        )

    if old.seed != new.seed:
        raise refuse("seed", old.seed, new.seed)
    for name, scene in old.scenes.items():
        if name not in new.scenes:
            raise refuse("scenes", name, "without it")
        asked = new.scenes[name]
        for key in ("source", "source_sha256", "preparation"):
            was, now = getattr(scene, key), getattr(asked, key)
            if key == "source" and scene.source_sha256 and scene.source_sha256 == asked.source_sha256:
                continue  # the same file, moved
            if was != now:
                raise refuse(f"{key.replace('_', ' ')} of scene {name}", was, now)
    for name, run in old.runs.items():
        if name not in new.runs:
            same_temperature = any(
                r.scene == run.scene and r.temperature_k == run.temperature_k for r in new.runs.values()
            )
            key = "replicas" if same_temperature else "temperatures"
            raise refuse(f"{key} of scene {run.scene}", f"with {name}", "without it")
        asked_run = new.runs[name]
        if run.file != asked_run.file:
            raise refuse("format", Path(run.file).suffix[1:], Path(asked_run.file).suffix[1:])
        for key in {**run.settings, **asked_run.settings}:
            was = run.settings.get(key, default_of(key))
            now = asked_run.settings.get(key, default_of(key))
            if was != now:
                raise refuse(f"{key_of(key)} of scene {run.scene} ({key})", was, now)
    scenes = {name: _again(old.scenes[name]) if name in old.scenes else scene for name, scene in new.scenes.items()}
    runs = {name: _kept(old.runs[name], folder) if name in old.runs else run for name, run in new.runs.items()}
    return replace(new, scenes=scenes, runs=runs, started=old.started)


def _again(scene: SceneEntry) -> SceneEntry:
    return replace(scene, status=WAITING, reason="") if scene.status == FAILED else scene


def _kept(run: RunEntry, folder: Path) -> RunEntry:
    file = folder / run.file
    if run.status == COMPLETE and file.is_file() and file.stat().st_size == run.size_bytes:
        return run
    # What is gone is made anew, and need not come out the same on another machine; what is there must be what it was.
    expected = run.frames_sha256 if file.is_file() else ""
    return replace(run, status=WAITING, reason="", n_frames=0, frames_sha256=expected)
