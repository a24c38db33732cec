"""Reference MD as verbs: `plan` says what a run will do, `reference` does it."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surrogate.progress import progress_bar
from surrogate.verbs.options import PlanOptions, ReferenceOptions, tell
from surrogate.verbs.outputs import check_outputs, summarised_outputs
from surrogate.verbs.scenes import prepare_scene
from systems.options import options_as_keywords
from systems.trajectory.codec import WRITTEN

if TYPE_CHECKING:
    from md_reference.run.simulate import MDConfig
    from systems.scene import Scene


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
    nm) on each side, counter-ions, and NaCl at `ionic_strength_molar` (0), drawn with `seed`.

    `out` ends in .h5, .dcd or .xtc; with several replicas NAME.h5 becomes NAME_r0.h5, NAME_r1.h5, ..., with seeds
    `seed`, `seed + 1`, .... Settings that are not given are those of `protocol` (a paper's, by name), else ff14SB in
    OBC2 for peptides and GAFF2 in vacuum for other molecules, 300 K, 1/ps, 4 fs, 3 Da, 100 ps of equilibration that is
    not written, nvt, frames every ps, whatever name the molecule is asked for by; model systems bring their own.
    `hydrogen_mass_da=None` keeps natural masses. `ph` to `cap_breaks`: see `systems.library.named_scenes.prepare`.
    `resume` goes on from the checkpoint beside `out`.
    Raises InputError, PreparationError (no parameters), SimulationError (the good frames stay) and StorageError.
    """
    from md_reference.run.replicas import simulate_replicas
    from systems.files.whole_file import replica_paths

    outs = replica_paths(Path(out), options.replicas)
    check_outputs(outs, WRITTEN, resume=options.resume, overwrite=options.overwrite)
    molecule = prepare_scene(scene, options, quiet=options.quiet)
    molecule, config, protocol = resolve_run(molecule, options, {"time_ps": options.time_ps}, quiet=options.quiet)
    _ = config.n_frames, config.steps_per_frame  # uneven intervals are refused before anything runs
    if protocol and not options.quiet:
        tell(molecule.name, protocol)
    label = f"OpenMM {molecule.name}" + (f" x {len(outs)}" if len(outs) > 1 else "")
    with (
        summarised_outputs(outs, resumable="the same again with `resume=True` goes on"),
        progress_bar(label, quiet=options.quiet, ps_per_frame=config.save_every_ps) as progress,
    ):
        return simulate_replicas(
            molecule,
            config,
            outs,
            resume=options.resume,
            overwrite=options.overwrite,
            progress=progress,
            announce=None if options.quiet else lambda said: tell(molecule.name, str(said)),
        )


def resolve_run(
    scene: Scene, options: PlanOptions | ReferenceOptions, length: dict[str, float], *, quiet: bool
) -> tuple[Scene, MDConfig, str]:
    """Return the scene, solvated if asked, the settings of a run, and a line about what the protocol decided. Of the
    options those count that are settings of a run (MDConfig, ForceFieldSpec) or make its box. Raises InputError."""
    from md_reference.forces.forcefield import resolve
    from md_reference.forces.solvation import require_molecules, solvate_if_asked
    from md_reference.forces.spec import ForceFieldSpec, at_level
    from md_reference.run.config import MDConfig, resolve_settings, resolved, to_config

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
    if not quiet:
        if scene is not dry:
            tell(scene.name, scene.provenance["repairs"][-1])
        for warning in config.force.warnings:
            tell(scene.name, f"warning: {warning}")
    return scene, config, protocol
