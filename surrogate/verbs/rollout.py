"""Surrogate rollouts as a verb."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from surrogate.data.shipped import weights_path
from surrogate.progress import progress_bar
from surrogate.verbs.md_options import Preparation, takes
from surrogate.verbs.outputs import TRAJECTORY_SUFFIXES, accounted_outputs, check_outputs
from surrogate.verbs.scene_listing import prepare_scene, tell
from systems.units import Quantity, quantity

if TYPE_CHECKING:
    from systems.scene import Scene


@takes(Preparation)
def rollout(
    scene: str | Path | Scene,
    weights: str | Path,
    out: str | Path,
    *,
    time_ps: Quantity,
    save_every_ps: Quantity | None = None,
    lag_ps: Quantity | None = None,
    replicas: int = 1,
    seed: int = 0,
    solver: str | None = None,
    solver_steps: int | None = None,
    precision: str = "auto",
    compile: bool = False,
    stiff: str | None = None,
    guard: str = "flag",
    energy_every: int = 0,
    md_between_ps: Quantity = 0.0,
    select: str | None = None,
    atoms: str = "all",
    force: bool = False,
    temperature_k: Quantity | None = None,
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
    **preparation: Unpack[Preparation],
) -> list[Path]:
    """Roll a scene forward with a trained surrogate, in chunks, and return the trajectories written.

    `weights`: the name of shipped weights or a .safetensors file. Atoms are written in the scene's own order, frames at
    the interval of the weights or a multiple of it (`save_every_ps`), each marked with its chunk and validity. Weights
    that were trained for several lags step at `lag_ps`, by default at the longest that `save_every_ps` is a multiple
    of; weights that know atoms by their bonds take molecules that look like those they were trained on. Replicas
    run in one batch and are named as by `reference`. `solver`: 'multistep', 'fitted' (for few `solver_steps`, 2 to
    10), 'euler' or the adaptive 'dopri5', None for the one that suits the weights. `precision`: 'fp32', 'bf16' or
    'auto'. `compile`: the networks, by torch; it takes a C++ compiler and about a minute, and pays in long rollouts.
    `stiff`: bonds and angles 'modelled' by the network, or 'imposed': rigid bonds as long as the reference's, the width
    of the others drawn given the torsions, as far as the weights hold that; None imposes what they hold. The record
    names imposed terms (`imposed`), and `compare` leaves them out of its verdict.

    Every frame is checked as it is made against what the training reference does. `guard` says what is done about one
    that fails: 'flag' marks it, 'resample' draws the chunk again, 'repair' relaxes it with OpenMM, 'fallback' runs real
    MD from the last valid frame ('off': marked, and nothing stops the run). The energy of every `energy_every`-th frame
    is checked after stiff bonds are relaxed. `md_between_ps` of real MD follow each chunk. What was done stands in the
    record (`interventions`) and in a column, frame by frame. `select` (MDTraj's language) and `atoms` ('all', 'heavy')
    say which atoms are written. `force` rolls a scene that leaves the training domain where that is possible.
    `temperature_k` is refused unless it is that of the weights. `ph` to `cap_breaks`: see
    `systems.source.prepare`. Raises OutOfDomainError for a molecule the weights do not cover, InputError,
    WeightsError, SimulationError (the guard cannot bring a chunk through), StorageError.
    """
    from md_reference.run.replicas import replica_paths

    time_ps, save_every_ps = quantity("time_ps", time_ps), quantity("save_every_ps", save_every_ps)
    lag_ps, md_between_ps = quantity("lag_ps", lag_ps), quantity("md_between_ps", md_between_ps)
    temperature_k = quantity("temperature_k", temperature_k)
    outs = replica_paths(Path(out), replicas)
    check_outputs(outs, TRAJECTORY_SUFFIXES, resume=resume, overwrite=overwrite)
    file = weights_path(weights)
    molecule = prepare_scene(scene, preparation, quiet=quiet)

    from surrogate.data.weights import load_weights
    from surrogate.sampling.lags import choose_lag
    from surrogate.sampling.runner import RolloutConfig
    from surrogate.sampling.runner import rollout as roll

    config = RolloutConfig(
        time_ps=time_ps,
        save_every_ps=save_every_ps,
        lag_ps=lag_ps,
        seed=seed,
        solver=solver,
        precision=precision,
        compile=compile,
        stiff=stiff,
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
    saved_ps = choose_lag(loaded, lag_ps, save_every_ps) if save_every_ps is None else save_every_ps
    with (
        accounted_outputs(outs, resumable="the same command with --resume goes on"),
        # The verb counts the frames of one replica; all advance together.
        progress_bar(label, quiet=quiet, ps_per_frame=saved_ps * replicas) as progress,
    ):
        return roll(
            molecule,
            loaded,
            outs,
            config,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            announce=None if quiet else lambda line: tell(molecule.name, line),
        )
