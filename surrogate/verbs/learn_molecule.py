"""Training on a molecule itself: a potential that learns the energies and forces of an expensive level of theory."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from surrogate.models.architecture import architecture
from surrogate.verbs.messages import tell
from surrogate.verbs.options import TrainOptions, Trajectories
from surrogate.verbs.scene_listing import prepare_scene
from systems.errors import InputError
from systems.options import Preparation
from systems.scene import Scene

if TYPE_CHECKING:
    from surrogate.models.architecture import TrainingRequest

POTENTIAL = "painet-potential"


def learn_molecule(
    given: Trajectories | Scene, request: TrainingRequest, options: TrainOptions, advance: Callable[[str, float], None]
) -> Path:
    """Learn the molecule that `given` names from `options.level` and return the weights.

    The budget is of wall time for all of it: the molecule's preparation, answers, steps, and the verdict that the
    caller comes to (`train_verdict.compare_training`). Raises InputError for what means nothing here, PreparationError
    for what the level of theory refuses.
    """
    began = time.monotonic()
    from md_reference.forces.spec import QUANTUM, at_level

    if at_level(options.level, None) != QUANTUM:
        raise InputError(
            f"a level is worth learning where it is expensive; use `level='{QUANTUM}'`, or a reference of MD."
        )
    if request.arch not in ("", "painet", POTENTIAL):
        raise InputError(f"{request.arch} learns from trajectories; use `arch='painet'`, or leave `level` out.")
    unknown = {"`start_from`": options.start_from, "`longest_lag_ps`": options.longest_lag_ps,
               "`validation`": options.validation}  # fmt: skip
    if told := [name for name, value in unknown.items() if value is not None]:
        raise InputError(f"{', '.join(told)}: a potential learns from states that it asks about; leave it out.")
    if request.budget_s is None and request.steps is None:
        raise InputError("say how long to train: `budget_s='30min'` or `steps=10000`.")
    if not isinstance(given, str | Path | Scene):
        named = list(given)
        if len(named) != 1:
            raise InputError(f"one molecule a model: {len(named)} are given.")
        given = named[0]
    scene = prepare_scene(given, Preparation(), quiet=options.quiet)

    from md_reference.run.labeller import Labeller
    from surrogate.models.painet.energy import PainetPotential
    from surrogate.models.painet.potential_trainer import PotentialTrainer
    from surrogate.verbs.train_verdict import trial_s

    trainer: PotentialTrainer = architecture(POTENTIAL).trainer()
    config = trainer.settings(request).model  # what is wrong with it is known before anything is computed
    with Labeller(scene) as reference:
        if not options.quiet:
            tell(request.out.name, f"{scene.name} ({scene.formula}) by {QUANTUM}; weights know this molecule alone")
        after_s = trial_s(PainetPotential(config), scene)
        out = trainer.learn(reference, request, advance, before_s=time.monotonic() - began, after_s=after_s)
        if reference.n_rearranged and not options.quiet:
            tell(
                out.name, f"{reference.n_rearranged} states left out: they are another molecule, by bonds or handedness"
            )
        return out
