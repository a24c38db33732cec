"""The verbs, as plain functions: each does what the command of the same name does, and returns what it printed.

Times are in ps, temperatures in K, frictions in 1/ps, masses in dalton. A `scene` is a `systems.scene.Scene`, or what
the command line takes: a library name, a path, `smiles:CCO` or `sequence:ACE-ALA-NME`. Everything a user can get wrong
raises a `systems.errors.SurromdError` whose message is one line.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from surrogate.data.shipped import weights_path
from surrogate.outputs import TRAJECTORY_SUFFIXES, check_outputs, find_trajectories, guarded_outputs
from surrogate.progress import progress_bar
from systems.errors import InputError, UnknownNameError, nearest

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from md_reference.simulate import MDConfig
    from surrogate.judge.comparison import Comparison
    from systems.scene import Scene

PathLike = str | Path
Trajectories = PathLike | Sequence[PathLike]
# Where None says something itself.
Default = Literal["default"]


def systems(name: str | None = None) -> list[dict[str, Any]]:
    """Return what the library holds: one record per named scene, or the one asked for, with its protocol and atoms.

    Raises UnknownNameError (with the nearest name).
    """
    from systems import library

    if name is not None:
        return [_describe(name, whole=True)]
    groups = library.groups()
    return [_describe(each, whole=False) | {"group": group} for group in groups for each in groups[group]]


def _describe(name: str, *, whole: bool) -> dict[str, Any]:
    from systems import library

    scene = library.load(name)
    record: dict[str, Any] = {
        "name": name,
        "title": library.describe(name),
        "n_atoms": scene.n_atoms,
        "formula": scene.formula,
    }
    if whole:
        from systems.chemistry import backbone_torsions

        record |= {
            "n_bonds": len(scene.bonds),
            "residues": list(scene.residue_names),
            "atoms": list(scene.atom_names),
            "mass_da": float(scene.masses_da.sum()),
            "charge_e": int(scene.formal_charges.sum()),
            "torsions": {key: len(quads) for key, quads in backbone_torsions(scene).items() if len(quads)},
            "topology_hash": scene.topology_hash,
            "molecule_key": scene.molecule_key,
            "protocol": {k: "natural" if v is None else v for k, v in library.protocol(name).items()},
            "protocol_source": library.protocol_source(name),
        }
        if scene.interactions is not None:
            record["law"] = scene.interactions
    return record


def _prepare(
    scene: str | Scene, *, ph: float, keep_ligand: bool, drop_ligand: bool, drop_water: bool, quiet: bool
) -> Scene:
    """Return a Scene for what a user may write; what had to be repaired is said on stderr."""
    if not isinstance(scene, str):
        return scene
    from systems.prepare import prepare

    prepared = prepare(scene, ph=ph, keep_ligand=keep_ligand, drop_ligand=drop_ligand, drop_water=drop_water)
    for line in [] if quiet else prepared.provenance.get("repairs", []):
        sys.stderr.write(f"{scene}: {line}\n")
    return prepared


def plan(
    scene: str | Scene,
    *,
    force_field: str | None = None,
    solvent: str | None = None,
    level: str | None = None,
    padding_nm: float | None = None,
    ionic_strength_molar: float | None = None,
    temperature_k: float | None = None,
    friction_per_ps: float | None = None,
    timestep_ps: float | None = None,
    hydrogen_mass_da: float | Default | None = "default",
    equilibrate_ps: float | None = None,
    ensemble: str | None = None,
    pressure_bar: float | None = None,
    replicas: int = 1,
    platform: str = "auto",
    ph: float = 7.0,
    keep_ligand: bool = False,
    drop_ligand: bool = False,
    drop_water: bool = False,
    time_ps: float | None = None,
) -> dict[str, Any]:
    """Return what `reference` will do with these settings, what it skips, why, and what that saves here (JSON-able).

    `ph`, `keep_ligand`, `drop_ligand`, `drop_water`: see `systems.prepare.prepare`; `level` to `ionic_strength_molar`:
    see `reference`. Steps are timed for about a second; with `time_ps` the wall time of a run of that length is
    estimated. Raises what `reference` raises for settings that cannot be.
    """
    from md_reference.plan import make_plan

    molecule = _prepare(
        scene, ph=ph, keep_ligand=keep_ligand, drop_ligand=drop_ligand, drop_water=drop_water, quiet=False
    )
    molecule, config, protocol = _settle(
        molecule,
        time_ps=1.0 if time_ps is None else time_ps,
        seed=0,
        quiet=True,
        force_field=force_field,
        solvent=solvent,
        level=level,
        padding_nm=padding_nm,
        ionic_strength_molar=ionic_strength_molar,
        temperature_k=temperature_k,
        friction_per_ps=friction_per_ps,
        timestep_ps=timestep_ps,
        hydrogen_mass_da=hydrogen_mass_da,
        equilibrate_ps=equilibrate_ps,
        ensemble=ensemble,
        pressure_bar=pressure_bar,
        platform=platform,
    )
    found = make_plan(
        molecule,
        config.force,
        temperature_k=config.temperature_k,
        friction_per_ps=config.friction_per_ps,
        timestep_ps=config.timestep_ps,
        platform=platform,
        replicas=replicas,
        time_ps=time_ps,
        equilibrate_ps=config.equilibrate_ps,
        ensemble=config.ensemble,
        pressure_bar=config.pressure_bar,
    ).to_dict()
    return found | ({"protocol": protocol} if protocol else {})


def reference(
    scene: str | Scene,
    out: PathLike,
    *,
    time_ps: float,
    save_every_ps: float | None = None,
    force_field: str | None = None,
    solvent: str | None = None,
    level: str | None = None,
    padding_nm: float | None = None,
    ionic_strength_molar: float | None = None,
    temperature_k: float | None = None,
    friction_per_ps: float | None = None,
    timestep_ps: float | None = None,
    hydrogen_mass_da: float | Default | None = "default",
    equilibrate_ps: float | None = None,
    ensemble: str | None = None,
    pressure_bar: float | None = None,
    replicas: int = 1,
    platform: str = "auto",
    ph: float = 7.0,
    keep_ligand: bool = False,
    drop_ligand: bool = False,
    drop_water: bool = False,
    save_velocities: bool = False,
    save_forces: bool = False,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
) -> list[Path]:
    """Simulate a scene with OpenMM and return the trajectories written; each record ends with a `summary` of its run.

    `ensemble`: 'nvt' (Langevin middle integrator), 'nve' (velocity Verlet) or 'npt' (Monte Carlo barostat at
    `pressure_bar`; periodic scenes only). `save_velocities` (nm/ps) and `save_forces` (kJ/mol/nm) need an .h5.

    `force_field`, `solvent`: see `md_reference.forcefield.ForceFieldSpec`; `level='gfn2-xtb'` is that force field.
    Explicit solvents ('tip3p', 'opc') put a scene that has no periodic cell into one: water to `padding_nm` (1 nm) on
    each side, counter-ions, and NaCl at `ionic_strength_molar` (0), drawn with `seed`.

    `out` ends in .h5 or .dcd; with several replicas NAME.h5 becomes NAME_r0.h5, NAME_r1.h5, ..., with seeds `seed`,
    `seed + 1`, ... Settings that are not given are those of the library's protocol for a scene of the library
    (`systems(name)`), else ff14SB in OBC2 for peptides and GAFF2 in vacuum for other molecules, 300 K, 1/ps, 4 fs,
    3 Da, 100 ps of equilibration that is not written, nvt, frames every ps. `hydrogen_mass_da=None` keeps natural
    masses. `ph` to `drop_water`: see `systems.prepare.prepare`. `resume` goes on from the checkpoint beside `out`.
    Raises InputError, PreparationError (no parameters), SimulationError (the good frames stay) and StorageError.
    """
    from md_reference.replicas import replica_paths, simulate_replicas

    outs = replica_paths(Path(out), replicas)
    check_outputs(outs, TRAJECTORY_SUFFIXES, resume=resume, overwrite=overwrite)
    molecule = _prepare(
        scene, ph=ph, keep_ligand=keep_ligand, drop_ligand=drop_ligand, drop_water=drop_water, quiet=quiet
    )
    molecule, config, protocol = _settle(
        molecule,
        time_ps=time_ps,
        save_every_ps=save_every_ps,
        seed=seed,
        quiet=quiet,
        force_field=force_field,
        solvent=solvent,
        level=level,
        padding_nm=padding_nm,
        ionic_strength_molar=ionic_strength_molar,
        temperature_k=temperature_k,
        friction_per_ps=friction_per_ps,
        timestep_ps=timestep_ps,
        hydrogen_mass_da=hydrogen_mass_da,
        equilibrate_ps=equilibrate_ps,
        ensemble=ensemble,
        pressure_bar=pressure_bar,
        platform=platform,
    )
    _ = config.n_frames, config.steps_per_frame  # uneven intervals are refused before anything runs
    if protocol and not quiet:
        sys.stderr.write(f"{molecule.name}: {protocol}\n")
    label = f"OpenMM {molecule.name}" + (f" x {replicas}" if replicas > 1 else "")
    with (
        guarded_outputs(outs, resumable="the same command with --resume goes on"),
        progress_bar(label, quiet=quiet, ps_per_frame=config.save_every_ps) as progress,
    ):

        def preparing(share: float) -> None:
            if progress is not None:
                progress(round(1000 * share), 1000, "equilibrating" if share else "minimising")

        return simulate_replicas(
            molecule,
            replace(
                config,
                save_velocities=save_velocities or config.save_velocities,
                save_forces=save_forces or config.save_forces,
            ),
            outs,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            preparing=preparing,
            announce=None if quiet else lambda line: _tell(molecule.name, line),
        )


def _tell(name: str, line: str) -> None:
    sys.stderr.write(f"{name}: {line}\n")


def _settle(
    scene: Scene,
    *,
    time_ps: float,
    seed: int,
    quiet: bool,
    level: str | None,
    padding_nm: float | None,
    ionic_strength_molar: float | None,
    hydrogen_mass_da: float | Default | None,
    **given: Any,
) -> tuple[Scene, MDConfig, str]:
    """Return the scene, solvated if asked, the settings of a run, and a line about what the library's protocol decided.

    `given`: fields of MDConfig and ForceFieldSpec, None where the user leaves them open. Raises InputError.
    """
    from md_reference.campaign_settings import to_config
    from md_reference.forcefield import at_level, resolve
    from md_reference.integrators import check_ensemble
    from md_reference.protocol import settle
    from md_reference.solvation import solvate_if_asked

    given["force_field"] = at_level(level, given.get("force_field"))

    asked = {key: value for key, value in given.items() if value is not None}
    if hydrogen_mass_da != "default":
        asked["hydrogen_mass_da"] = hydrogen_mass_da
    settings, protocol = settle(scene, asked)
    config = to_config(settings | {"time_ps": time_ps}, seed=seed)
    config = replace(config, force=resolve(scene, config.force))
    dry, scene = scene, solvate_if_asked(scene, config.force, padding_nm, ionic_strength_molar, seed=seed)
    config = replace(config, ensemble=check_ensemble(config.ensemble, scene))
    if not quiet:
        if scene is not dry:
            _tell(scene.name, scene.provenance["repairs"][-1])
        for warning in config.force.warnings:
            _tell(scene.name, f"warning: {warning}")
    return scene, config, protocol


def rollout(
    scene: str | Scene,
    weights: PathLike,
    out: PathLike,
    *,
    time_ps: float,
    save_every_ps: float | None = None,
    replicas: int = 1,
    ph: float = 7.0,
    keep_ligand: bool = False,
    drop_ligand: bool = False,
    drop_water: bool = False,
    seed: int = 0,
    solver: str | None = None,
    solver_steps: int | None = None,
    precision: str = "auto",
    guard: str = "flag",
    energy_every: int = 0,
    md_between_ps: float = 0.0,
    select: str | None = None,
    atoms: str = "all",
    force: bool = False,
    temperature_k: float | None = None,
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
) -> list[Path]:
    """Roll a scene forward with a trained surrogate, in chunks, and return the trajectories written.

    `weights`: the name of shipped weights or a .safetensors file. Atoms are written in the scene's own order, frames at
    the interval of the weights or a multiple of it (`save_every_ps`), each marked with its chunk and validity. Replicas
    run in one batch and are named as by `reference`. `solver`: 'multistep', 'euler' or the adaptive 'dopri5', None for
    the one that suits the weights. `precision`: 'fp32', 'bf16' or 'auto'.

    Every frame is checked as it is made against what the training reference does. `guard` says what is done about one
    that fails: 'flag' marks it, 'resample' draws the chunk again, 'repair' relaxes it with OpenMM, 'fallback' runs real
    MD from the last valid frame ('off': marked, and nothing stops the run). The energy of every `energy_every`-th frame
    is checked after stiff bonds are relaxed. `md_between_ps` of real MD follow each chunk. What was done stands in the
    record (`interventions`) and in a column, frame by frame. `select` (MDTraj's language) and `atoms` ('all', 'heavy')
    say which atoms are written. `force` rolls a scene that leaves the training domain where that is possible.
    `temperature_k` is refused unless it is that of the weights.
    Raises OutOfDomainError for a molecule the weights do not cover, InputError, WeightsError, SimulationError (the
    guard cannot bring a chunk through), StorageError.
    """
    from md_reference.replicas import replica_paths

    outs = replica_paths(Path(out), replicas)
    check_outputs(outs, TRAJECTORY_SUFFIXES, resume=resume, overwrite=overwrite)
    file = weights_path(weights)
    molecule = _prepare(
        scene, ph=ph, keep_ligand=keep_ligand, drop_ligand=drop_ligand, drop_water=drop_water, quiet=quiet
    )

    from surrogate.data.weights import load_weights
    from surrogate.sampling.rollout import RolloutConfig
    from surrogate.sampling.rollout import rollout as roll

    config = RolloutConfig(
        time_ps=time_ps,
        save_every_ps=save_every_ps,
        seed=seed,
        solver=solver,
        precision=precision,
        guard=guard,
        energy_every=energy_every,
        md_between_ps=md_between_ps,
        select=select,
        atoms=atoms,
        force=force,
        temperature_k=temperature_k,
    )
    if solver_steps is not None:
        config = replace(config, solver_steps=solver_steps)
    loaded = load_weights(file)
    label = f"surrogate {molecule.name}" + (f" x {replicas}" if replicas > 1 else "")
    saved_ps = loaded.domain.lag_ps if save_every_ps is None else save_every_ps
    with (
        guarded_outputs(outs, resumable="the same command with --resume goes on"),
        # The verb counts the frames of one replica; all advance together.
        progress_bar(label, quiet=quiet, ps_per_frame=saved_ps * replicas) as progress,
    ):
        return roll(molecule, loaded, outs, config, resume=resume, overwrite=overwrite, progress=progress)


def demo(
    out_dir: PathLike = "surromd-demo",
    *,
    reference_ps: float = 3_000.0,
    rollout_ps: float = 2_500.0,
    rollout_replicas: int = 8,
    seed: int = 0,
    quiet: bool = False,
) -> Comparison:
    """The whole way on alanine dipeptide: two OpenMM runs, longer rollouts with shipped weights, the comparison.

    Writes reference_r0.h5, reference_r1.h5 (the replicate), surrogate_r0.h5, ..., report.html and report.json into
    `out_dir`, replacing those of an earlier demo.
    """
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
    return compare(truth, [rolled], folder / "report.html", replicate=replicate, labels=["surrogate"])


def compare(
    reference: Trajectories,
    candidates: Sequence[Trajectories],
    out_html: PathLike | None = None,
    *,
    replicate: Trajectories | None = None,
    top: PathLike | None = None,
    lag_ps: float | None = None,
    labels: Sequence[str] | None = None,
    energies: bool = False,
) -> Comparison:
    """Judge candidates against a reference, write the report (NAME.html, .json and .md) and return the comparison.

    The reference, each candidate and the replicate (another run of the truth, the floor of every figure) is a file, a
    folder, a glob, a comma-separated list or a sequence of files that are replicas of each other. `top`: topology for
    files that carry none. `lag_ps`: the time between frames, where the files do not say or say it wrongly. `energies`:
    judge the potential energy of every k-th frame too, by the force field that the reference's file names.
    Raises InputError, TrajectoryError, OutOfDomainError.
    """
    from surrogate.judge.comparison import compare as judge
    from surrogate.judge.ensemble import load_ensemble

    if not candidates:
        raise InputError("Nothing to compare: name at least one trajectory besides the reference.")
    if labels is not None and len(labels) != len(candidates):
        raise InputError(f"{len(labels)} labels for {len(candidates)} candidates.")
    if out_html is not None:
        check_outputs([Path(out_html)], [".html"], overwrite=True)
    truth = load_ensemble(find_trajectories(reference), top=top, lag_ps=lag_ps)
    others = [
        load_ensemble(
            find_trajectories(candidate),
            label=labels[k] if labels else None,
            template=truth.scene,
            top=top,
            lag_ps=lag_ps,
        )
        for k, candidate in enumerate(candidates)
    ]
    floor = None
    if replicate is not None:
        floor = load_ensemble(find_trajectories(replicate), template=truth.scene, top=top, lag_ps=lag_ps)
    energy_fn = _relaxed_energy(truth.scene, truth.record) if energies else None
    result = judge(truth, others, floor, truth.scene, energy_fn=energy_fn)
    if out_html is not None:
        from surrogate.judge.report import write_report

        write_report(result, Path(out_html))
    return result


def _relaxed_energy(scene: Scene, record: dict[str, Any]) -> Callable[[npt.NDArray[np.float64]], float]:
    """Return what gives the energy in kJ/mol of a frame with its stiff bonds at rest, infinity where there is none."""
    from md_reference.forcefield import ForceFieldSpec, build_system, resolve
    from md_reference.relaxation import Relaxer
    from systems.errors import SimulationError

    name, solvent = record.get("force_field"), record.get("solvent")
    if name is None or solvent is None:
        raise InputError("--energies: the reference's file does not say with which force field it was made.")
    spec = resolve(scene, ForceFieldSpec(name, solvent, record.get("hydrogen_mass_da")))
    relaxer = Relaxer(scene, build_system(scene, spec), born=spec.is_born)

    def energy(positions_nm: npt.NDArray[np.float64]) -> float:
        try:
            return relaxer.relax(positions_nm).potential_kj_mol
        except SimulationError:
            return math.inf

    return energy


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
    from md_reference.campaign_file import read_campaign
    from surrogate.campaigns import list_runs, run_campaign

    asked = read_campaign(file, folder=out)
    if dry_run:
        return list_runs(asked)
    return run_campaign(asked, workers=workers, scheduler=scheduler, quiet=quiet)


def info(path: PathLike) -> dict[str, Any]:
    """Return what a trajectory, a windows or weights file or a campaign's folder is and where it came from (JSON-able).

    Raises InputError when there is no such file, TrajectoryError or WeightsError when it is damaged.
    """
    from surrogate.describe import describe_file

    if Path(path).is_dir():
        from surrogate.campaigns import describe_campaign

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
    budget_s: float | None = None,
    steps: int | None = None,
    start_from: PathLike | None = None,
    validation: Trajectories | None = None,
    time_reversal: bool = False,
    rare_draws: float = 0.0,
    rare_kinds: bool = False,
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
    (surrogate.data.rarity), `rare_kinds` also tells the network which, and learns how often each comes. Beside `out`, a
    CSV holds the training curves and, until done, files the state that `resume` goes on from; at the end the curves are
    drawn (.svg). `device`: 'auto', 'cpu' or 'cuda'; several devices by torchrun (surrogate.training.devices).
    Raises InputError, TrajectoryError, SimulationError (training diverged), StorageError.
    """
    from surrogate.trainings import FITTED, FORECASTERS, GENERATIVE, TrainingRequest, prepare_training

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
        budget_s=budget_s,
        steps=steps,
        start_from=None if start_from is None else weights_path(start_from),
        time_reversal=time_reversal,
        rare_draws=rare_draws,
        rare_kinds=rare_kinds,
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
    quiet = quiet or not is_first_process()
    with progress_bar(f"training {prepared.scene}", quiet=quiet) as bar:

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
        from surrogate.training.curves import plot_curves

        plot_curves(curves)
    return written
