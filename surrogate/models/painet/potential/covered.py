"""What weights of a potential cover: how frames look at its truth, and how far they move from one to the next."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from surrogate.data.weights import TrainingDomain
from surrogate.models.painet.potential.config import PotentialConfig
from surrogate.models.painet.potential.samples import Samples
from systems.chemistry.validity import WIDENING, geometry_from_frames, limits_from_frames
from systems.scene import Scene


def domain_of(scene: Scene, samples: Samples, moving: list[Any], config: PotentialConfig) -> TrainingDomain:
    """Return what the weights cover: the truth's quieter samples say what frames look like; runs of cheap MD, `moving`
    (n, n_atoms, 3) each, how far they move from one to the next, hot ones since hydroxyls turn at their own rate."""
    conditions = {
        "force_field": "gfn2-xtb", "solvent": "vacuum", "temperature_k": config.temperature_k,
        "friction_per_ps": config.friction_per_ps, "timestep_ps": config.timestep_ps,
        "hydrogen_mass_da": config.hydrogen_mass_da, "constrain_hydrogens": config.constrain_hydrogens,
    }  # fmt: skip
    quiet = samples.positions_nm[np.argsort(samples.energies_kj_mol)[: max(2, len(samples) // 2)]]
    looks = limits_from_frames(scene, quiet, quiet)
    before, after = (np.concatenate([run[part] for run in moving]) for part in (slice(-1), slice(1, None)))
    moves = limits_from_frames(scene, before, after)
    middles = [run[:, np.unique(moves.jump_idx)].mean(axis=1) for run in moving]
    drift_nm = max((np.linalg.norm(np.diff(m, axis=0), axis=-1).max(initial=0.0) for m in middles), default=0.0)
    jumps = {key: getattr(moves, key) for key in ("jump_idx", "jump_max_nm", "jump_min_nm")}
    limits = replace(looks, **jumps, drift_max_nm=WIDENING * float(drift_nm))
    geometry = geometry_from_frames(scene, quiet)
    return TrainingDomain(scene, config.lag_ps, conditions, geometry.to_dict(), limits.to_dict(), ())
