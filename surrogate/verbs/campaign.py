"""The verb `campaign`: runs on Dask with one progress bar, and a summary of what its folder holds."""

from __future__ import annotations

import sys
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.campaign.manifest import COMPLETE, FAILED, campaign_folder, read_manifest
from surrogate.progress import progress_bar
from surrogate.verbs.options import CampaignOptions, PathLike
from systems.options import options_as_keywords
from systems.units import format_time_ps

if TYPE_CHECKING:
    from md_reference.campaign.campaign_file import Campaign
    from md_reference.campaign.scheduler import CampaignProgress
    from surrogate.progress import ProgressFn

# The speed shown is that of the last so many seconds.
_SPEED_OVER_S = 30.0


@options_as_keywords(CampaignOptions)
def campaign(file: PathLike, out: PathLike | None = None, *, options: CampaignOptions) -> dict[str, Any]:
    """Simulate many scenes, temperatures and replicas as a TOML file says, on Dask, and return `info` of the folder.

    Runs on `workers` processes of this machine (one per core), on a Dask `scheduler` (tcp://host:port), or on the jobs
    of the file's [cluster]. What is finished is not done again; what fails stands in the result's `failed`. `dry_run`:
    return what would be run, and start nothing. `out` replaces the folder that the file names.
    Raises InputError for a file that cannot be meant, and for the folder of another campaign.
    """
    from md_reference.campaign.campaign_file import read_campaign

    asked = read_campaign(file, folder=out)
    if options.dry_run:
        return _list_runs(asked)
    return _run(asked, options)


def _run(campaign: Campaign, options: CampaignOptions) -> dict[str, Any]:
    """Run what a campaign lacks, on local workers, a scheduler or a cluster, and return `describe_campaign`.

    What fails is said on stderr when it happens. Raises what `md_reference.campaign.scheduler.run_campaign` raises.
    """
    from md_reference.campaign.cluster import open_client
    from md_reference.campaign.scheduler import open_campaign, run_campaign

    manifest = open_campaign(campaign)  # another campaign's folder is refused before any worker starts
    if manifest.counts().get(COMPLETE, 0) == len(manifest.runs):
        return describe_campaign(campaign.folder)

    def failed(name: str, reason: str) -> None:
        if not options.quiet:
            sys.stderr.write(f"{name}: {reason}\n")

    try:
        with (
            open_client(
                workers=options.workers,
                scheduler=options.scheduler,
                cluster=campaign.cluster,
                retries=campaign.retries,
                folder=campaign.folder,
            ) as client,
            progress_bar(f"campaign {campaign.name}", quiet=options.quiet) as advance,
        ):
            run_campaign(campaign, client, progress=None if advance is None else _Meter(advance), failed=failed)
    except KeyboardInterrupt as stop:
        if stop.args:
            raise
        # While workers start or end.
        summary = describe_campaign(campaign.folder)["summary"]
        raise KeyboardInterrupt(f"{campaign.folder}: {summary}; the same command goes on") from None
    return describe_campaign(campaign.folder)


class _Meter:
    """Turns a campaign's progress into the bar's: frames, finished runs, frames per second."""

    def __init__(self, advance: ProgressFn) -> None:
        self._advance = advance
        self._seen: deque[tuple[float, int]] = deque()

    def __call__(self, progress: CampaignProgress) -> None:
        now = time.monotonic()
        self._seen.append((now, progress.frames_done))
        while now - self._seen[0][0] > _SPEED_OVER_S:
            self._seen.popleft()
        (began, first), (ended, last) = self._seen[0], self._seen[-1]
        speed = max(last - first, 0) / (ended - began) if ended > began else 0.0
        failed = f", {progress.runs_failed} failed" if progress.runs_failed else ""
        note = f"{progress.runs_complete}/{progress.runs_total} runs{failed}, {len(progress.active)} workers, "
        self._advance(progress.frames_done, max(progress.frames_total, 1), f"{note}{speed:.3g} frames/s")


def _list_runs(campaign: Campaign) -> dict[str, Any]:
    """Return what a campaign will run, before anything is started (JSON-able)."""
    lengths = {run.name: format_time_ps(run.config.time_ps) for run in campaign.runs}
    return {
        "file": str(campaign.folder),
        "type": "campaign (not started)",
        "summary": f"{len(campaign.runs)} runs of {len(campaign.scenes)} scenes, "
        f"{format_time_ps(sum(run.config.time_ps for run in campaign.runs))} in all",
        "scenes": {scene.name: scene.source for scene in campaign.scenes},
        "runs": {run.name: f"{lengths[run.name]}, seed {run.config.seed}" for run in campaign.runs},
    }


def describe_campaign(folder: Path) -> dict[str, Any]:
    """Return a JSON-able summary of a campaign's folder; `summary` is one line, `failed` the reasons.

    Raises InputError when the folder holds no manifest.
    """
    manifest = read_manifest(campaign_folder(folder) or folder)
    runs = list(manifest.runs.values())
    complete = [run for run in runs if run.status == COMPLETE]
    simulated_ps = sum(run.simulated_ps for run in complete)
    counts = manifest.counts()
    temperatures = sorted({run.temperature_k for run in runs})
    done = f", {format_time_ps(simulated_ps)} simulated" if complete else ""
    others = "".join(f", {n} {state}" for state, n in counts.items() if state != COMPLETE)
    return {
        "file": str(folder),
        "type": "campaign",
        "summary": f"{len(complete)} of {len(runs)} runs complete{others}{done}",
        "name": manifest.name,
        "seed": manifest.seed,
        "started": manifest.started,
        "programs": manifest.programs,
        "temperatures_k": temperatures,
        "n_frames": sum(run.n_frames for run in complete),
        "simulated_ps": simulated_ps,
        "wall_s": sum(run.wall_s for run in complete),
        "size_mb": sum(run.size_bytes for run in complete) / 1e6,
        "runs": counts,
        "scenes": {
            name: f"{sum(run.scene == name and run.status == COMPLETE for run in runs)} of "
            f"{sum(run.scene == name for run in runs)} runs"
            + (f", {scene.n_atoms} atoms, {scene.formula}" if scene.n_atoms else "")
            for name, scene in manifest.scenes.items()
        },
        "failed": {run.name: run.reason for run in runs if run.status == FAILED} or None,
    }
