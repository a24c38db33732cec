"""A campaign that is disturbed against one that is not: `python docs/studies/reference/disturbed_campaign.py`.

Forty short runs (ten library scenes, two temperatures, two replicas) on two workers of this machine, three times: left
alone; with a worker killed (SIGKILL) half-way, in the middle of a run; and with everything killed half-way and started
again. Each must be complete, and every frame, bit for bit, that of the first. Exits with 1 where one is not.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.campaign.campaign_file import Campaign, read_campaign
from md_reference.campaign.cluster import open_client
from md_reference.campaign.manifest import COMPLETE, Manifest, campaign_trajectories, read_manifest
from md_reference.campaign.scheduler import run_campaign
from systems.errors import SurromdError
from systems.library import named_scenes

if TYPE_CHECKING:
    from md_reference.campaign.scheduler import CampaignProgress

# Shipped with their parameters, so that no time goes into AmberTools.
SCENES = (
    "aspirin",
    "benzene",
    "ethanol",
    "malonaldehyde",
    "naphthalene",
    "salicylic-acid",
    "toluene",
    "uracil",
    "alanine-dipeptide",
    "double-well",
)
WORKERS = 2


def campaign_text(time_ps: float) -> str:
    """Return the campaign's file. The Reference platform: its runs are bit-identical wherever they are resumed."""
    both = 'temperatures = ["300K", "500K"]'
    tables = []
    for name in SCENES:
        # A scene's own protocol outweighs what the campaign says.
        own = [f'protocol = "{one}", {both}, save_every = "20fs"' for one in named_scenes.entry(name).protocols]
        tables.append("{ " + ", ".join([f'scene = "{name}"', *own]) + " }")
    return (
        f"scenes = [{', '.join(tables)}]\n"
        f"{both}\n"
        "replicas = 2\n"
        f'time = "{time_ps:g}ps"\n'
        'save_every = "20fs"\n'
        'timestep = "0.5fs"\n'
        'equilibrate = "1ps"\n'
        'platform = "Reference"\n'
    )


def frames_of(manifest: Manifest) -> dict[str, str]:
    """Return the hash of each run's frames."""
    return {name: run.frames_sha256 for name, run in manifest.runs.items()}


def run_here(campaign: Campaign, look: Callable[[CampaignProgress], None] | None = None) -> Manifest:
    """Run a campaign on two workers of this process."""
    with open_client(workers=WORKERS) as client:
        return run_campaign(campaign, client, progress=look, poll_every_s=0.1)


class Killer:
    """Kills one worker when half of all frames are there and it is in the middle of a run."""

    def __init__(self) -> None:
        self.said = ""

    def __call__(self, progress: CampaignProgress) -> None:
        if self.said or progress.frames_done < progress.frames_total / 2:
            return
        whole = progress.frames_total / progress.runs_total
        for pid, runs in progress.active.items():
            for name, frames in runs.items():
                if 0.1 * whole < frames < 0.9 * whole:
                    os.kill(pid, signal.SIGKILL)
                    done = f"{progress.runs_complete} of {progress.runs_total} runs were complete"
                    self.said = f"killed worker {pid} at frame {frames} of {name}; {done}"
                    return


def run_killed_and_again(file: Path, folder: Path) -> tuple[Manifest, str]:
    """Run the command, kill it and thereby all its workers half-way, and run it again."""
    command = [sys.executable, "-m", "surrogate.cli.main", "campaign", str(file), "-o", str(folder), "--quiet"]
    command += ["--workers", str(WORKERS)]
    with subprocess.Popen(command) as process:
        complete = 0
        while process.poll() is None and complete < 2 * len(SCENES):
            time.sleep(0.2)
            try:
                complete = read_manifest(folder).counts().get(COMPLETE, 0)
            except SurromdError:
                continue  # it has not come that far
        process.kill()
    subprocess.run(command, check=True)
    return read_manifest(folder), f"killed all at {complete} complete runs, and started it again"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ps", type=float, default=20.0, help="length of each run")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        rows = list(_cases(Path(scratch), args.ps))
    sys.stdout.write(f"{'campaign':<14}{'complete':>10}{'same frames':>13}{'wall s':>9}  what happened\n")
    for row in rows:
        sys.stdout.write(
            f"{row['case']:<14}{row['complete']:>7}/{row['runs']}{row['identical']:>10}/{row['runs']}"
            f"{row['wall_s']:>9.1f}  {row['what']}\n"
        )
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1))
    if any(row["complete"] < row["runs"] or row["identical"] < row["runs"] or not row["what"] for row in rows):
        sys.exit(1)


def _cases(scratch: Path, time_ps: float) -> list[dict[str, Any]]:
    file = scratch / "forty.toml"
    file.write_text(campaign_text(time_ps))
    rows: list[dict[str, Any]] = []
    reference: dict[str, str] = {}
    for case in ("undisturbed", "worker killed", "all killed"):
        folder = scratch / case.replace(" ", "-")
        began = time.monotonic()
        if case == "all killed":
            manifest, what = run_killed_and_again(file, folder)
        else:
            killer = Killer() if case == "worker killed" else None
            manifest = run_here(read_campaign(file, folder=folder), killer)
            what = "nothing" if killer is None else killer.said
        wall_s = time.monotonic() - began
        found = frames_of(manifest)
        reference = reference or found
        campaign_trajectories(folder, verify=True)
        rows.append(
            {
                "case": case,
                "runs": len(manifest.runs),
                "complete": manifest.counts().get(COMPLETE, 0),
                "identical": sum(bool(found[name]) and found[name] == reference[name] for name in reference),
                "frames": sum(run.n_frames for run in manifest.runs.values()),
                "wall_s": wall_s,
                "what": what,
            }
        )
        sys.stderr.write(f"{case}: {rows[-1]['complete']} runs complete in {wall_s:.0f} s; {what}\n")
    return rows


if __name__ == "__main__":
    main()
