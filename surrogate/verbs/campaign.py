"""The verb `campaign`: runs on Dask with one progress bar, and a summary of what its folder holds."""

from __future__ import annotations

import sys
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


@options_as_keywords(CampaignOptions)
def campaign(file: PathLike, out: PathLike | None = None, *, options: CampaignOptions) -> dict[str, Any]:
    """Simulate many scenes, temperatures and replicas as a TOML file says, on Dask, and return `info` of the folder.

    Runs on `workers` processes of this machine (one per core), or on a Dask `scheduler` (tcp://host:port). What is
    finished is not done again; what fails stands in the result's `failed`. `dry_run`: return what would be run, and
    start nothing. `out` replaces the folder that the file names.
    Raises InputError for a file that cannot be meant, and for the folder of another campaign.
    """
    from md_reference.campaign.campaign_file import read_campaign
    from md_reference.campaign.cluster import open_client
    from md_reference.campaign.scheduler import open_campaign, run_campaign

    asked = read_campaign(file, folder=out)
    if options.dry_run:
        return _list_runs(asked)
    manifest = open_campaign(asked)  # another campaign's folder is refused before any worker starts
    if manifest.counts().get(COMPLETE, 0) == len(manifest.runs):
        return describe_campaign(asked.folder)

    def failed(name: str, reason: str) -> None:
        if not options.quiet:
            sys.stderr.write(f"{name}: {reason}\n")

    try:
        with (
            open_client(workers=options.workers, scheduler=options.scheduler, retries=asked.retries) as client,
            progress_bar(f"campaign {asked.name}", quiet=options.quiet) as advance,
        ):

            def shown(now: CampaignProgress) -> None:
                failures = f", {now.runs_failed} failed" if now.runs_failed else ""
                note = f"{now.runs_complete}/{now.runs_total} runs{failures}, {len(now.active)} workers"
                if advance is not None:
                    advance(now.frames_done, max(now.frames_total, 1), note)

            run_campaign(asked, client, progress=shown, failed=failed)
    except KeyboardInterrupt as stop:
        if stop.args:
            raise
        # While workers start or end.
        summary = describe_campaign(asked.folder)["summary"]
        raise KeyboardInterrupt(f"{asked.folder}: {summary}; the same command goes on") from None
    return describe_campaign(asked.folder)


def _list_runs(campaign: Campaign) -> dict[str, Any]:
    """Return what a campaign will run, before anything is started (JSON-able)."""
    runs = campaign.runs
    total = format_time_ps(sum(run.config.time_ps for run in runs))
    return {
        "file": str(campaign.folder),
        "type": "campaign (not started)",
        "summary": f"{len(runs)} runs of {len(campaign.scenes)} scenes, {total} in all",
        "scenes": {scene.name: scene.source for scene in campaign.scenes},
        "runs": {run.name: f"{format_time_ps(run.config.time_ps)}, seed {run.config.seed}" for run in runs},
    }


def describe_campaign(folder: Path) -> dict[str, Any]:
    """Return a JSON-able summary of a campaign's folder; `summary` is one line, `failed` the reasons. Raises InputError
    when the folder holds no manifest."""
    manifest = read_manifest(campaign_folder(folder) or folder)
    runs, counts = list(manifest.runs.values()), manifest.counts()
    complete = [run for run in runs if run.status == COMPLETE]
    simulated_ps = sum(run.simulated_ps for run in complete)
    done = f", {format_time_ps(simulated_ps)} simulated" if complete else ""
    others = "".join(f", {n} {state}" for state, n in counts.items() if state != COMPLETE)
    scenes = {}
    for name, scene in manifest.scenes.items():
        n_done, n_all = (sum(run.scene == name for run in these) for these in (complete, runs))
        made_of = f", {scene.n_atoms} atoms, {scene.formula}" if scene.n_atoms else ""
        scenes[name] = f"{n_done} of {n_all} runs{made_of}"
    return {
        "file": str(folder),
        "type": "campaign",
        "summary": f"{len(complete)} of {len(runs)} runs complete{others}{done}",
        "name": manifest.name,
        "seed": manifest.seed,
        "started": manifest.started,
        "programs": manifest.programs,
        "temperatures_k": sorted({run.temperature_k for run in runs}),
        "n_frames": sum(run.n_frames for run in complete),
        "simulated_ps": simulated_ps,
        "wall_s": sum(run.wall_s for run in complete),
        "size_mb": sum(run.size_bytes for run in complete) / 1e6,
        "runs": counts,
        "scenes": scenes,
        "failed": {run.name: run.reason for run in runs if run.status == FAILED} or None,
    }
