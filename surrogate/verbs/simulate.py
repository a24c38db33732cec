"""Trajectories as verbs: `plan` says what a reference run will do, `reference` does it, `campaign` does many on Dask;
`rollout` is the surrogate's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from md_reference.campaign.manifest import COMPLETE, FAILED, campaign_folder, read_manifest
from md_reference.forces.spec import QUANTUM, ForceFieldSpec, at_level
from md_reference.run.config import MDConfig, resolve_settings, resolved, to_config
from surrogate.models.architecture import weights_path
from surrogate.progress import progress_bar
from surrogate.sampling.config import RolloutConfig
from surrogate.verbs.inputs import check_outputs, prepare_scene, summarised_outputs
from surrogate.verbs.options import (
    CampaignOptions,
    PathLike,
    PlanOptions,
    ReferenceOptions,
    RolloutOptions,
    tell,
)
from systems.errors import InputError
from systems.files.whole_file import replica_paths
from systems.options import options_as_keywords, part_of
from systems.scene import Scene
from systems.trajectory.codec import WRITTEN
from systems.trajectory.joined import join
from systems.units import format_time_ps

if TYPE_CHECKING:
    from md_reference.campaign.scheduler import CampaignProgress


@options_as_keywords(PlanOptions)
def plan(scene: str | Path | Scene, options: PlanOptions) -> dict[str, Any]:
    """Return what `reference` will do with these settings, what it skips, why, and what that saves here (JSON-able).

    Steps are timed for about a second; with `time_ps` the wall time of a run of that length is estimated. Raises what
    `reference` raises for settings that cannot be.
    """
    from md_reference.run.plan import make_plan

    molecule = prepare_scene(scene, options, quiet=False)
    molecule, config, protocol = resolve_run(molecule, options, {"time_ps": options.time_ps or 0.0}, quiet=True)
    found = asdict(make_plan(molecule, config, replicas=options.replicas))
    return {"line": found.pop("line"), **found.pop("rows"), **found} | ({"protocol": protocol} if protocol else {})


@options_as_keywords(ReferenceOptions)
def reference(scene: str | Path | Scene, out: str | Path, options: ReferenceOptions) -> list[Path]:
    """Simulate a scene with OpenMM and return the trajectories written; each record ends with a `summary` of its run.

    `ensemble`: 'nvt' (Langevin middle integrator), 'nve' (velocity Verlet) or 'npt' (Monte Carlo barostat at
    `pressure_bar`; periodic scenes only). `save_velocities` (nm/ps) and `save_forces` (kJ/mol/nm) need an .h5.

    `force_field`, `solvent`: see `md_reference.forces.forcefield.ForceFieldSpec`; `level='gfn2-xtb'` is that force
    field. Explicit solvents ('tip3p', 'opc') put a scene that has no periodic cell into one: water to `padding_nm` (1
    nm) between the solute and its images, counter-ions, and NaCl at `ionic_strength_molar` (0), drawn with `seed`.

    `out` ends in .h5, .dcd or .xtc; with several replicas NAME.h5 becomes NAME_r0.h5, NAME_r1.h5, ..., with seeds
    `seed`, `seed + 1`, ..., and `join` writes them into NAME.h5, too, one after another, whose record says where each
    begins. Settings that are not given are those of `protocol` (a paper's, by
    name), else ff14SB in OBC2 for peptides and GAFF2 in vacuum for other molecules, 300 K, 1/ps,
    4 fs, 3 Da, 100 ps of equilibration that is not written, nvt, frames every ps, whatever name the molecule is asked
    for by; model systems bring their own. `hydrogen_mass_da=None` keeps natural masses. `ph` to `cap_breaks`: see
    `systems.library.named_scenes.prepare`. `resume` goes on from the checkpoint beside `out`.
    Raises InputError, PreparationError (no parameters), SimulationError (the good frames stay) and StorageError.
    """
    from md_reference.run.replicas import simulate_replicas

    files = _outputs(Path(out), options)
    molecule = prepare_scene(scene, options, quiet=options.quiet)
    molecule, config, protocol = resolve_run(molecule, options, {"time_ps": options.time_ps}, quiet=options.quiet)
    _ = config.n_frames, config.steps_per_frame  # uneven intervals are refused before anything runs
    if protocol and not options.quiet:
        tell(molecule.name, protocol)
    make = partial(simulate_replicas, molecule, config)
    return _written("OpenMM", molecule.name, files, config.save_every_ps, options, make)


def _outputs(out: Path, options: ReferenceOptions | RolloutOptions) -> tuple[list[Path], list[Path]]:
    """Return the files of replicas, and the one that joins them, if asked for; what cannot be meant is refused."""
    outs = replica_paths(out, options.replicas)
    joined = [out] if options.join and len(outs) > 1 else []
    check_outputs([*outs, *joined], WRITTEN, resume=options.resume, overwrite=options.overwrite)
    return outs, joined


def _written(
    program: str, name: str, files: tuple[list[Path], list[Path]], ps_per_frame: float,
    options: ReferenceOptions | RolloutOptions, make: Callable[..., list[Path]],
) -> list[Path]:  # fmt: skip
    """Return the trajectories of a scene that `make` writes, and the one that joins them, if asked for (`files`, of
    `_outputs`); its progress is shown, and on Ctrl-C it is said what is kept."""
    outs, joined = files
    label = f"{program} {name}" + (f" x {len(outs)}" if len(outs) > 1 else "")
    with (
        summarised_outputs(outs, resumable="the same again with `resume=True` goes on"),
        progress_bar(label, quiet=options.quiet, ps_per_frame=ps_per_frame) as progress,
    ):
        written = make(
            outs,
            resume=options.resume,
            overwrite=options.overwrite,
            progress=progress,
            announce=None if options.quiet else lambda said: tell(name, str(said)),
        )
    return [*written, *(join(written, path, overwrite=options.resume or options.overwrite) for path in joined)]


def resolve_run(
    scene: Scene, options: PlanOptions | ReferenceOptions, length: dict[str, float], *, quiet: bool
) -> tuple[Scene, MDConfig, str]:
    """Return the scene, solvated if asked, the settings of a run, and a line about what the protocol decided. Of the
    options those count that are settings of a run (MDConfig, ForceFieldSpec) or make its box. Raises InputError."""
    from md_reference.forces.forcefield import resolve
    from md_reference.forces.solvation import require_molecules, solvate_if_asked
    from md_reference.run.plan import warnings_of

    given = asdict(options) | {"force_field": at_level(options.level, options.force_field)}
    settings_of_a_run = {f.name for kind in (MDConfig, ForceFieldSpec) for f in fields(kind)} - {"hydrogen_mass_da"}
    asked = {name: value for name, value in given.items() if name in settings_of_a_run}
    # What is left open, and a switch that is off, leaves the word to the protocol.
    asked = {name: value for name, value in asked.items() if value is not None and value is not False}
    seed = asked.pop("seed", 0)
    if options.hydrogen_mass_da != "default":
        asked["hydrogen_mass_da"] = options.hydrogen_mass_da
    settings, protocol = resolve_settings(scene, asked, options.protocol)
    config = to_config(settings | length, seed=seed)
    config = replace(config, force=resolve(scene, config.force))
    if options.keep_water:
        require_molecules(config.force)
    dry = scene
    scene = solvate_if_asked(
        scene, config.force, seed=seed, temperature_k=config.temperature_k, padding_nm=options.padding_nm,
        ionic_strength_molar=options.ionic_strength_molar,
    )  # fmt: skip
    config = resolved(scene, config)
    if scene is not dry:
        tell(scene.name, scene.provenance["repairs"][-1], quiet=quiet)
    for warning in warnings_of(scene, config):
        tell(scene.name, f"warning: {warning}", quiet=quiet)
    return scene, config, protocol


@options_as_keywords(RolloutOptions)
def rollout(
    scene: str | Path | Scene, weights: str | Path | None, out: str | Path, options: RolloutOptions
) -> list[Path]:
    """Roll a scene forward with a trained surrogate, in chunks, and return the trajectories written.

    `weights`: the name of shipped weights or a .safetensors file; None takes the shipped ones that cover the scene, of
    this `level` of theory, and says which and why; 'gfn2-xtb' is of any drug-like molecule. Atoms are written in the
    scene's own order, frames at the interval of the weights or a multiple of it (`save_every_ps`), each marked with its
    chunk and validity. Weights that were trained for several lags step at `lag_ps`, by default at the longest that
    `save_every_ps` is a multiple of (peptides: 501 ps to 1 ns or up to 100 ps, in TIP3P up to 20 ps); weights of
    several peptides take others of the same residues, and of weights that were trained in several solvents `solvent`
    names one. Replicas run in one batch, are named as by `reference` and joined as there. `solver`: 'multistep',
    'fitted' (for few `solver_steps`, 2 to 10), 'euler' or the adaptive 'dopri5', None for the one that suits the
    weights. `precision`: 'fp32', 'bf16' or 'auto'.

    Every frame is checked as it is made against what the training reference does. `guard` says what is done about one
    that fails: 'flag' marks it, 'resample' draws the chunk again, 'repair' relaxes it with OpenMM, 'fallback' runs real
    MD from the last valid frame ('off': marked, and nothing stops the run). A learned potential's energy is compared
    with the reference's at every `energy_every`-th frame. What was done is in the record (`interventions`) and in a
    column, frame by frame. `select` (MDTraj's language) and `atoms` ('all', 'heavy') say which atoms are written.
    `force` rolls a scene that leaves the training domain where that is possible. `temperature_k` is refused
    unless it is that of the weights; a learned potential takes any, and `friction_per_ps`, `timestep_ps`,
    `hydrogen_mass_da` and `ensemble`. `ph` to `cap_breaks`: see `systems.library.named_scenes.prepare`.
    Raises OutOfDomainError for a molecule the weights do not cover, InputError, WeightsError, SimulationError (the
    guard cannot bring a chunk through), StorageError.
    """
    files = _outputs(Path(out), options)
    file = None if weights is None else weights_path(weights)
    molecule = prepare_scene(scene, options, quiet=options.quiet)

    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import assumed_solvent, choose_lag, choose_weights, under_conditions
    from surrogate.sampling.runner import rollout as roll

    config = part_of(options, RolloutConfig)
    conditions = {"force_field": at_level(options.level, None), "solvent": config.solvent}
    if file is None:
        loaded, why = choose_weights(molecule, temperature_k=config.temperature_k, conditions=conditions)
        tell(molecule.name, why, quiet=options.quiet)
    else:
        whole = load_weights(file)
        loaded = under_conditions(whole, conditions)
        if said := assumed_solvent(whole.domain, conditions):
            tell(molecule.name, said, quiet=options.quiet)
    if options.level == "mm" and loaded.domain.conditions.get("force_field") == QUANTUM:
        raise InputError(f"{loaded.path.name} is of {QUANTUM}; leave `level` out, or ask for that.")
    saved_ps = choose_lag(loaded, config.lag_ps, None) if config.save_every_ps is None else config.save_every_ps
    # The verb counts the frames of one replica; all advance together.
    ps_per_frame = saved_ps * len(files[0])
    make = partial(roll, molecule, loaded, config=config)
    return _written("surrogate", molecule.name, files, ps_per_frame, options, make)


# ---- campaigns -----------------------------------------------------------------------------------------------------


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
        total = format_time_ps(sum(run.config.time_ps for run in asked.runs))
        return {
            "file": str(asked.folder),
            "type": "campaign (not started)",
            "summary": f"{len(asked.runs)} runs of {len(asked.scenes)} scenes, {total} in all",
            "scenes": {scene.name: scene.source for scene in asked.scenes},
            "runs": {run.name: f"{format_time_ps(run.config.time_ps)}, seed {run.config.seed}" for run in asked.runs},
        }
    manifest = open_campaign(asked)  # another campaign's folder is refused before any worker starts
    if manifest.counts().get(COMPLETE, 0) == len(manifest.runs):
        return describe_campaign(asked.folder)

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

            run_campaign(asked, client, progress=shown, failed=partial(tell, quiet=options.quiet))
    except KeyboardInterrupt as stop:
        if stop.args:
            raise
        # While workers start or end.
        summary = describe_campaign(asked.folder)["summary"]
        raise KeyboardInterrupt(f"{asked.folder}: {summary}; run the same command to continue") from None
    return describe_campaign(asked.folder)


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
