"""The verbs, as plain functions: each does what the command of the same name does, and returns what it printed.

Times are in ps, temperatures in K, frictions in 1/ps, masses in dalton; a text carries its own unit (`time_ps="10ns"`,
`temperature_k="310K"`). A `scene` is a `systems.scene.Scene`, or what the command line takes: a library name, a path,
`smiles:CCO` or `sequence:ACE-ALA-NME`. Everything a user can get wrong
raises a `systems.errors.SurromdError` whose message is one line.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.data.shipped import weights_path
from surrogate.verbs.bursts import bursts
from surrogate.verbs.compare import compare
from surrogate.verbs.options import CampaignOptions, DemoOptions, PathLike, Trajectories, WindowsOptions
from surrogate.verbs.outputs import check_outputs, find_trajectories
from surrogate.verbs.reference import plan, reference
from surrogate.verbs.rollout import rollout
from surrogate.verbs.scene_listing import systems
from surrogate.verbs.takes import takes
from surrogate.verbs.train import explain_training, train
from systems.errors import InputError

if TYPE_CHECKING:
    from surrogate.judge.comparison import Comparison

__all__ = [
    "bursts",
    "campaign",
    "compare",
    "demo",
    "explain_training",
    "info",
    "plan",
    "reference",
    "rollout",
    "systems",
    "train",
    "windows",
]


@takes(DemoOptions)
def demo(out_dir: PathLike = "surromd-demo", *, options: DemoOptions) -> Comparison:
    """The whole way on alanine dipeptide: two OpenMM runs, longer rollouts with shipped weights, the comparison.

    Writes reference_r0.h5, reference_r1.h5 (the replicate), surrogate_r0.h5, ..., report.html and report.json into
    `out_dir`, replacing those of an earlier demo.
    """
    folder = Path(out_dir)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder} is a file; name a folder with `out`.") from None
    name = "alanine-dipeptide"
    weights_path(name)  # missing weights are noticed before anything is simulated
    try:
        shared = {"seed": options.seed, "quiet": options.quiet, "overwrite": True}
        out = folder / "reference.h5"
        truth, replicate = reference(name, out, time_ps=options.reference_ps, replicas=2, **shared)
        out, n = folder / "surrogate.h5", options.rollout_replicas
        rolled = rollout(name, name, out, time_ps=options.rollout_ps, replicas=n, **shared)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what was written is in {folder}; the demo starts over when it is run again") from None
    return compare(truth, [rolled], folder / "report.html", replicate=replicate, labels=["surrogate"], overwrite=True)


@takes(CampaignOptions)
def campaign(file: PathLike, out: PathLike | None = None, *, options: CampaignOptions) -> dict[str, Any]:
    """Simulate many scenes, temperatures and replicas as a TOML file says, on Dask, and return `info` of the folder.

    Runs on `workers` processes of this machine (one per core), on a Dask `scheduler` (tcp://host:port), or on the jobs
    of the file's [cluster]. What is finished is not done again; what fails stands in the result's `failed`. `dry_run`:
    return what would be run, and start nothing. `out` replaces the folder that the file names.
    Raises InputError for a file that cannot be meant, and for the folder of another campaign.
    """
    from md_reference.campaign.campaign_file import read_campaign
    from surrogate.verbs.campaign import list_runs, run_campaign

    asked = read_campaign(file, folder=out)
    if options.dry_run:
        return list_runs(asked)
    return run_campaign(asked, workers=options.workers, scheduler=options.scheduler, quiet=options.quiet)


def info(path: PathLike) -> dict[str, Any]:
    """Return what a trajectory, a windows or weights file or a campaign's folder is and where it came from (JSON-able).
    Shipped weights may be given by name.

    Raises InputError when there is no such file, TrajectoryError or WeightsError when it is damaged.
    """
    from surrogate.data.shipped import shipped_weights
    from surrogate.verbs.info import describe_file

    if not Path(path).exists():
        return describe_file(shipped_weights().get(str(path), Path(path)))
    if Path(path).is_dir():
        from surrogate.verbs.campaign import describe_campaign

        return describe_campaign(Path(path))
    return describe_file(Path(path))


@takes(WindowsOptions)
def windows(references: Trajectories, out: PathLike, options: WindowsOptions) -> Path:
    """Read reference trajectories of one scene, canonicalise them once, and write one compact file for training.

    They may be larger than memory. `validation`: trajectories held out whole; without any, the last twentieth of each
    is. `velocities` keeps these as well, for PAINET, and leaves frames in their own pose. Raises InputError when
    scenes, save intervals or conditions differ, TrajectoryError for damaged files.
    """
    from surrogate.data.frames import load_frames, write_windows

    out = Path(out)
    check_outputs([out], [".h5"], overwrite=options.overwrite)
    paths = find_trajectories(references, verify=True)
    held = [] if options.validation is None else find_trajectories(options.validation, verify=True)
    canonical = options.canonical and not options.velocities
    write_windows(paths, out, canonical=canonical, velocities=options.velocities, held=held)
    try:
        load_frames(out).refuse_leaks()
    except InputError:
        out.unlink()
        raise
    return out
