"""The verbs, as plain functions: each does what the command of the same name does, and returns what it printed.

Times are in ps, temperatures in K, frictions in 1/ps, masses in dalton; a text carries its own unit (`time_ps="10ns"`,
`temperature_k="310K"`). A `scene` is a `systems.scene.Scene`, or what the command line takes: a library name, a path,
`smiles:CCO` or `sequence:ACE-ALA-NME`. Everything a user can get wrong
raises a `systems.errors.SurromdError` whose message is one line.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.data.shipped import weights_path
from surrogate.progress import progress_bar
from surrogate.verbs.compare import compare
from surrogate.verbs.outputs import PathLike, Trajectories, check_outputs, find_trajectories
from surrogate.verbs.reference import plan, reference
from surrogate.verbs.rollout import rollout
from surrogate.verbs.scene_listing import systems, tell
from systems.errors import InputError, UnknownNameError, nearest
from systems.trajectory.claim import Claim
from systems.units import Quantity, quantity

if TYPE_CHECKING:
    from surrogate.judge.comparison import Comparison

__all__ = ["campaign", "compare", "demo", "info", "plan", "reference", "rollout", "systems", "train", "windows"]


def demo(
    out_dir: PathLike = "surromd-demo",
    *,
    reference_ps: Quantity = 3_000.0,
    rollout_ps: Quantity = 2_500.0,
    rollout_replicas: int = 8,
    seed: int = 0,
    quiet: bool = False,
) -> Comparison:
    """The whole way on alanine dipeptide: two OpenMM runs, longer rollouts with shipped weights, the comparison.

    Writes reference_r0.h5, reference_r1.h5 (the replicate), surrogate_r0.h5, ..., report.html and report.json into
    `out_dir`, replacing those of an earlier demo.
    """
    reference_ps, rollout_ps = quantity("reference_ps", reference_ps), quantity("rollout_ps", rollout_ps)
    folder = Path(out_dir)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InputError(f"{folder} is a file; name a folder with --out.") from None
    name = "alanine-dipeptide"
    weights_path(name)  # missing weights are noticed before anything is simulated
    try:
        truth, replicate = reference(
            name, folder / "reference.h5", time_ps=reference_ps, replicas=2, seed=seed, overwrite=True, quiet=quiet
        )
        rolled = rollout(
            name,
            name,
            folder / "surrogate.h5",
            time_ps=rollout_ps,
            replicas=rollout_replicas,
            seed=seed,
            overwrite=True,
            quiet=quiet,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"what was written is in {folder}; the demo starts over when it is run again") from None
    return compare(truth, [rolled], folder / "report.html", replicate=replicate, labels=["surrogate"], overwrite=True)


def campaign(
    file: PathLike,
    *,
    out: PathLike | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    dry_run: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Simulate many scenes, temperatures and replicas as a TOML file says, on Dask, and return `info` of the folder.

    Runs on `workers` processes of this machine (one per core), on a Dask `scheduler` (tcp://host:port), or on the jobs
    of the file's [cluster]. What is finished is not done again; what fails stands in the result's `failed`. `dry_run`:
    return what would be run, and start nothing. `out` replaces the folder that the file names.
    Raises InputError for a file that cannot be meant, and for the folder of another campaign.
    """
    from md_reference.campaign.campaign_file import read_campaign
    from surrogate.verbs.campaign import list_runs, run_campaign

    asked = read_campaign(file, folder=out)
    if dry_run:
        return list_runs(asked)
    return run_campaign(asked, workers=workers, scheduler=scheduler, quiet=quiet)


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


def windows(
    references: Trajectories,
    out: PathLike,
    *,
    validation: Trajectories | None = None,
    canonical: bool = True,
    velocities: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
) -> Path:
    """Read reference trajectories of one scene, canonicalise them once, and write one compact file for training.

    They may be larger than memory. `validation`: trajectories held out whole; without any, the last twentieth of each
    is. `velocities` keeps these as well, for PAINET, and leaves frames in their own pose. Raises InputError when
    scenes, save intervals or conditions differ, TrajectoryError for damaged files.
    """
    from surrogate.data.frames import load_frames, write_windows

    out = Path(out)
    check_outputs([out], [".h5"], overwrite=overwrite)
    paths = find_trajectories(references, verify=True)
    held = [] if validation is None else find_trajectories(validation, verify=True)
    write_windows(paths, out, canonical=canonical and not velocities, velocities=velocities, held=held)
    try:
        load_frames(out).refuse_leaks()
    except InputError:
        out.unlink()
        raise
    return out


def train(
    references: Trajectories,
    out: PathLike,
    *,
    arch: str = "lam-slide",
    config: PathLike | None = None,
    budget_s: Quantity | None = None,
    steps: int | None = None,
    start_from: PathLike | None = None,
    validation: Trajectories | None = None,
    time_reversal: bool = False,
    rare_draws: float = 0.0,
    rare_kinds: bool = False,
    hydrogens: str | None = None,
    entities: str | None = None,
    graph: bool = False,
    longest_lag_ps: Quantity | None = None,
    seed: int = 0,
    device: str = "auto",
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
) -> Path:
    """Train a surrogate on trajectories, or on one windows file, and return the weights written (.safetensors).

    `arch`: lam-slide; painet or its decoder alone, egnn, which learn from velocities (a reference made with
    --save-velocities and natural hydrogen masses); or a baseline that is fitted in one go: frozen, constant-velocity,
    resampling, normal-modes, msm. The others end after `budget_s` seconds of training or `steps` optimiser steps over
    all stages, whichever is given. `config`: a TOML file of model settings. `start_from`: weights (name or file) whose
    second stage is trained further, with their configuration. `validation`: trajectories that the curves are measured
    on; without any it is the last twentieth of each. A stretch of motion that would be both trained on and validated
    on is refused. `time_reversal` shows every other window backwards,
    right for a reference in equilibrium; `rare_draws` is the share of windows drawn for a rare state they show
    (surrogate.data.rarity), `rare_kinds` also tells the network which, and learns how often each comes.
    `hydrogens` 'placed': lam-slide learns heavy atoms alone, and rollouts get their hydrogens from the reference's
    local geometry; `entities` 'residue': of peptides, whose residues are then what it codes; both as in `config`.
    `graph`: lam-slide knows atoms by their bonds, so that references may be of many molecules and the weights cover
    unseen ones that look like them (surrogate.sampling.coverage); trajectories in `validation` of molecules that are
    not trained on hold those out whole; each atom is then a latent of its own, or, with `atoms.latents = "set"` in
    `config`, an autoencoder codes them as it does for one molecule. `longest_lag_ps`: lam-slide learns every spacing of
    frames from that of the references to this one, and takes it as an input. Beside `out`, a
    CSV holds the training curves and, until done, files the state that `resume` goes on from; at the end the curves are
    drawn (.svg), and a short rollout that is checked frame by frame says whether the weights are usable and, where they
    are not, what would help (NAME.verdict.json, surrogate.verbs.train_verdict). `device`: 'auto', 'cpu' or 'cuda';
    several devices by torchrun (surrogate.training.devices).
    Raises InputError, TrajectoryError, SimulationError (training diverged), StorageError.
    """
    from surrogate.verbs.train import FITTED, FORECASTERS, GENERATIVE, TrainingRequest, prepare_training

    architectures = [*GENERATIVE, *FORECASTERS, *FITTED]
    if arch not in architectures:
        raise UnknownNameError(
            f"unknown architecture {arch!r}; known: {', '.join(architectures)}.{nearest(arch, architectures)}"
        )
    out = Path(out)
    request = TrainingRequest(
        arch=arch,
        paths=[],
        held=[],
        out=out,
        config=None if config is None else Path(config),
        budget_s=quantity("budget_s", budget_s),
        steps=steps,
        start_from=None if start_from is None else weights_path(start_from),
        time_reversal=time_reversal,
        rare_draws=rare_draws,
        rare_kinds=rare_kinds,
        hydrogens=hydrogens,
        entities=entities,
        graph=graph,
        longest_lag_ps=quantity("longest_lag_ps", longest_lag_ps),
        seed=seed,
        device=device,
        resume=resume,
    )
    request.check()
    check_outputs([out], [".safetensors"], resume=resume, overwrite=overwrite)
    states = sorted(out.parent.glob(f"{out.stem}.*.train.safetensors"))
    if states and not (resume or overwrite):
        raise InputError(f"{states[0]} is the state of an interrupted training; add --resume or --overwrite.")
    if resume and out.exists() and not states:
        return out
    paths = find_trajectories(references, verify=True)
    held = [] if validation is None else find_trajectories(validation, verify=True)
    from surrogate.training.devices import choose_device, is_first_process

    prepared = prepare_training(replace(request, paths=paths, held=held, device=choose_device(device)))
    first = is_first_process()
    claim = Claim(out) if first else nullcontext()
    with claim, progress_bar(f"training {prepared.scene}", quiet=quiet or not first) as bar:

        def advance(stage: str, share: float) -> None:
            if bar is not None:
                bar(round(1000 * share), 1000, stage)

        try:
            written = prepared.start(advance)
        except KeyboardInterrupt:
            kept = sorted(out.parent.glob(f"{out.stem}.*.train.safetensors"))
            if not kept:
                raise KeyboardInterrupt("no training state had been saved yet") from None
            raise KeyboardInterrupt(f"the state is in {kept[-1]}; the same command with --resume goes on") from None
    curves = out.with_suffix(".csv")
    if curves.exists() and is_first_process():
        from surrogate.training.loss_curves import plot_curves

        plot_curves(curves)
    if arch not in FITTED and is_first_process():
        from surrogate.verbs.train_verdict import judge_training, write_verdict

        try:
            verdict = judge_training(written)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"{written} is written; only the rollout that tries it was cut short") from None
        write_verdict(written, verdict)
        if not quiet:
            for line in verdict.lines():
                tell(written.name, line)
    return written
