"""Surrogate rollouts as a verb."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from surrogate.models.architecture import weights_path
from surrogate.progress import progress_bar
from surrogate.sampling.config import RolloutConfig
from surrogate.verbs.options import RolloutOptions, tell
from surrogate.verbs.outputs import check_outputs, summarised_outputs
from surrogate.verbs.scenes import prepare_scene
from systems.options import options_as_keywords, part_of
from systems.trajectory.codec import WRITTEN

if TYPE_CHECKING:
    from systems.scene import Scene


@options_as_keywords(RolloutOptions)
def rollout(
    scene: str | Path | Scene, weights: str | Path | None, out: str | Path, options: RolloutOptions
) -> list[Path]:
    """Roll a scene forward with a trained surrogate, in chunks, and return the trajectories written.

    `weights`: the name of shipped weights or a .safetensors file; None takes the shipped ones that cover the scene, and
    says which and why. Atoms are written in the scene's own order, frames at the interval of the weights or a multiple
    of it (`save_every_ps`), each marked with its chunk and validity. Weights that were trained for several lags step at
    `lag_ps`, by default at the longest that `save_every_ps` is a multiple of; weights of several peptides take others
    of the same residues. Replicas run in one batch, are named as by `reference` and joined as there. `solver`:
    'multistep', 'fitted' (for few `solver_steps`, 2 to 10), 'euler' or the adaptive 'dopri5', None for the
    one that suits the weights.
    `precision`: 'fp32', 'bf16' or 'auto'. `compile`: the networks, by torch; it takes a C++ compiler and about a
    minute, and pays in long rollouts.

    Every frame is checked as it is made against what the training reference does. `guard` says what is done about one
    that fails: 'flag' marks it, 'resample' draws the chunk again, 'repair' relaxes it with OpenMM, 'fallback' runs real
    MD from the last valid frame ('off': marked, and nothing stops the run). The energy of every `energy_every`-th frame
    is checked after stiff bonds are relaxed. `md_between_ps` of real MD follow each chunk. What was done stands in the
    record (`interventions`) and in a column, frame by frame. `select` (MDTraj's language) and `atoms` ('all', 'heavy')
    say which atoms are written. `force` rolls a scene that leaves the training domain where that is possible.
    `temperature_k` is refused unless it is that of the weights; a learned potential takes any, and `friction_per_ps`,
    `timestep_ps`, `hydrogen_mass_da` and `ensemble`. `ph` to `cap_breaks`: see `systems.library.named_scenes.prepare`.
    Raises OutOfDomainError for a molecule the weights do not cover, InputError, WeightsError, SimulationError (the
    guard cannot bring a chunk through), StorageError.
    """
    from systems.files.whole_file import replica_paths

    outs = replica_paths(Path(out), options.replicas)
    check_outputs(outs, WRITTEN, resume=options.resume, overwrite=options.overwrite)
    file = None if weights is None else weights_path(weights)
    molecule = prepare_scene(scene, options, quiet=options.quiet)

    from surrogate.models.weights import load_weights
    from surrogate.sampling.domain import choose_lag
    from surrogate.sampling.runner import rollout as roll

    config = part_of(options, RolloutConfig)
    if file is None:
        from surrogate.sampling.domain import choose_weights

        loaded, why = choose_weights(molecule, temperature_k=config.temperature_k)
        if not options.quiet:
            tell(molecule.name, why)
    else:
        loaded = load_weights(file)
    label = f"surrogate {molecule.name}" + (f" x {len(outs)}" if len(outs) > 1 else "")
    saved_ps = config.save_every_ps
    if saved_ps is None:
        saved_ps = choose_lag(loaded, config.lag_ps, None)
    with (
        summarised_outputs(outs, resumable="the same again with `resume=True` goes on"),
        # The verb counts the frames of one replica; all advance together.
        progress_bar(label, quiet=options.quiet, ps_per_frame=saved_ps * len(outs)) as progress,
    ):
        return roll(
            molecule,
            loaded,
            outs,
            config,
            resume=options.resume,
            overwrite=options.overwrite,
            progress=progress,
            announce=None if options.quiet else lambda line: tell(molecule.name, line),
        )
