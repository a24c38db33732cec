"""Training on heavy atoms alone: find hydrogen sites and residues, and wrap the trained network with their placer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from surrogate.data.features.hydrogen_shapes import fit_hydrogens, plan_hydrogens
from surrogate.data.features.residue_layout import residue_layout
from surrogate.data.frames import TrainingFrames
from surrogate.data.molecules import FrameSets
from surrogate.data.parts import part_of_frames
from surrogate.data.weights import TrainingDomain, Weights
from surrogate.models.hydrogens import HydrogenPlacer
from surrogate.models.interface import Surrogate
from surrogate.models.lam_slide.config import LamSlideConfig
from surrogate.models.lam_slide.heavy_atoms import HeavyLamSlide
from surrogate.models.lam_slide.model import LamSlide
from surrogate.training.provenance import training_domain
from systems.errors import InputError
from systems.selection import part_of


@dataclass(frozen=True, eq=False)
class HeavyTraining:
    """Frames, configuration and weights to go on from as a training of LaM-SLidE takes them, of heavy atoms alone, and
    what its weights are wrapped with: the placer of hydrogens and the domain of all atoms."""

    frames: TrainingFrames
    config: LamSlideConfig
    start: Weights | None
    placer: HydrogenPlacer
    domain: TrainingDomain

    def dressed(self, model: LamSlide) -> tuple[Surrogate, TrainingDomain]:
        """Return the model as it is rolled, with hydrogens, and its domain."""
        return HeavyLamSlide(model.config, model, self.placer), self.domain


def on_heavy_atoms(
    frames: TrainingFrames | FrameSets, config: LamSlideConfig, start: Weights | None, *, several_lags: bool = False
) -> HeavyTraining:
    """Return the training on heavy atoms that the configuration asks for; statistics of hydrogens are measured on
    `frames` of all atoms, or taken over from `start`.

    Raises InputError for several molecules or lags, whose hydrogens move differently; for hydrogens that cannot be
    placed, and residues without a layout.
    """
    if isinstance(frames, FrameSets):
        if len(frames.trained) > 1 or frames.unseen:
            raise InputError(
                f'{frames.names}: hydrogens are placed for one molecule; train with hydrogens = "modelled".'
            )
        frames = frames.trained[0]
    if several_lags or config.approximator.lag_range_ps is not None:
        raise InputError('hydrogens are placed at one lag; leave `longest_lag_ps` out, or set hydrogens = "modelled".')
    domain = training_domain(frames)
    if start is not None:
        assert isinstance(start.model, HeavyLamSlide)
        heavy = start.model.hydrogens.plan.heavy
        scene = part_of(start.domain.scene, np.array(heavy))
        within = replace(start, model=start.model.model, domain=replace(start.domain, scene=scene))
        return HeavyTraining(part_of_frames(frames, heavy), config, within, start.model.hydrogens, domain)
    plan = plan_hydrogens(frames)
    placer = HydrogenPlacer(plan)
    fit_hydrogens(placer, frames)
    seen = part_of_frames(frames, plan.heavy)
    residues = residue_layout(seen.scene) if config.entities == "residue" else None
    return HeavyTraining(seen, replace(config, hydrogen_plan=plan, residues=residues), None, placer, domain)
